"""The step of an arm that is told velocities, run as loops run it."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
import torch
from unchecked import shapes_unchecked

from hrc_learn.controller import VelocityStep, WantedVelocity
from hrc_learn.deploy import EagerRunner, PackageRunner, export_step
from hrc_learn.kinematics import panda

DT = 1e-3
STEP = VelocityStep(panda)
EXAMPLE = WantedVelocity(
    joint_position=panda.ready,
    joint_velocity=torch.zeros(7, dtype=torch.float64),
    stop=torch.tensor(False),
    dt=DT,
)
READY = panda.ready.numpy()


@pytest.fixture(autouse=True)
def _no_shape_checks() -> Iterator[None]:
    """Tracers cannot follow them."""
    with shapes_unchecked():
        yield


def test_a_state_that_is_set_is_where_the_next_step_begins():
    runner = EagerRunner(STEP, EXAMPLE)
    velocity, acceleration = np.linspace(-0.3, 0.3, 7), np.linspace(1.0, 2.0, 7)
    runner.state["safety.velocity"][:] = velocity
    runner.state["safety.acceleration"][:] = acceleration
    np.testing.assert_array_equal(runner.state["safety.velocity"], velocity)
    runner.observation["joint_velocity"][:] = velocity
    change = (runner.step() - velocity) / DT - acceleration
    # One step of the jerk from there, for all joints in proportion.
    assert (np.abs(change) <= panda.limits.jerk.numpy() * DT * (1 + 1e-9)).all()
    assert np.abs(change).max() > 1.0


def test_the_exported_step_equals_the_eager_one(tmp_path):
    loaded = replace(EXAMPLE, load=torch.tensor([0.0, 0.05, 0.2], dtype=torch.float64))
    runners = [EagerRunner(STEP, loaded), PackageRunner(export_step(STEP, loaded, tmp_path))]
    runners[1].observe(loaded)
    rng, q = np.random.default_rng(0), READY.copy()
    for runner in runners:
        runner.start(q)
    for k in range(200):
        if k % 20 == 0:
            wanted, stop = rng.normal(size=7) * 3, rng.random() < 0.2
        if k % 47 == 0:
            velocity = rng.normal(size=7) * 0.1
            for runner in runners:
                runner.state["safety.velocity"][:] = velocity
        sent = []
        for runner in runners:
            runner.observation["joint_position"][:] = q
            runner.observation["joint_velocity"][:] = wanted
            runner.observation["stop"][...] = stop
            sent.append(runner.step().copy())
        np.testing.assert_allclose(sent[1], sent[0], rtol=0, atol=1e-12)
        q += DT * sent[0]


def test_a_runner_starts_from_the_measured_motion():
    runner = EagerRunner(STEP, EXAMPLE)
    velocity, acceleration = np.linspace(-0.3, 0.3, 7), np.linspace(1.0, 2.0, 7)
    runner.start(READY, velocity, acceleration)
    runner.observation["joint_velocity"][:] = velocity
    state = STEP.initial_state(*(torch.from_numpy(x) for x in (READY, velocity, acceleration)))
    wanted = replace(EXAMPLE, joint_velocity=torch.from_numpy(velocity))
    expected, _ = STEP.step(state, wanted)
    np.testing.assert_allclose(runner.step(), expected.joint_velocity.numpy(), atol=1e-15)
    runner.start(READY)
    assert not runner.state["safety.velocity"].any()
