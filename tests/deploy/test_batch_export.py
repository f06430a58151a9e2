"""The step of many arms, compiled as one loop over them."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import sampling
import torch
from step_equality import assert_equal_steps, controller_and_observation
from torch import nn
from unchecked import shapes_unchecked

from hrc_learn.controller import VelocityStep, WantedVelocity
from hrc_learn.deploy import (
    EagerRunner,
    PackageRunner,
    UnknownOperationError,
    export_step,
)
from hrc_learn.deploy.package import load
from hrc_learn.kinematics import panda

ARMS = 43
"""No multiple of the numbers in a vector register."""


@pytest.fixture(autouse=True, scope="module")
def _no_shape_checks() -> Iterator[None]:
    """Tracers cannot follow them."""
    with shapes_unchecked():
        yield


@pytest.fixture(scope="module")
def package(tmp_path_factory, _no_shape_checks) -> Path:
    controller, observation = controller_and_observation(panda.ready.expand(ARMS, 7))
    return export_step(controller, observation, tmp_path_factory.mktemp("packages"))


def told(*batch: int, dtype: torch.dtype) -> WantedVelocity:
    q = panda.ready + 0.3 * torch.randn(
        *batch, 7, generator=sampling.generator(), dtype=torch.float64
    )
    return WantedVelocity(
        joint_position=q.to(dtype),
        joint_velocity=torch.zeros(*batch, 7, dtype=dtype),
        stop=torch.zeros(batch, dtype=torch.bool),
        dt=torch.tensor(0.004, dtype=dtype),
    )


@pytest.mark.parametrize(
    ("batch", "dtype", "tolerance"),
    [
        ((ARMS,), torch.float32, 2e-5),
        pytest.param((3, 2), torch.float64, 1e-12, marks=pytest.mark.slow),
        pytest.param((1,), torch.float64, 1e-12, marks=pytest.mark.slow),
    ],
)
def test_commanded_velocities_equal_the_eager_ones(tmp_path, batch, dtype, tolerance):
    step, example = VelocityStep(panda).to(dtype), told(*batch, dtype=dtype)
    runners = [EagerRunner(step, example), PackageRunner(export_step(step, example, tmp_path))]
    rng, q = np.random.default_rng(0), example.joint_position.numpy().copy()
    for runner in runners:
        runner.observe(example)
        runner.start(q)
    for k in range(60):
        if k % 20 == 0:
            wanted, stop = 3 * rng.normal(size=(*batch, 7)), rng.random(batch) < 0.2
        sent = []
        for runner in runners:
            runner.observation["joint_position"][:] = q
            runner.observation["joint_velocity"][:] = wanted
            runner.observation["stop"][...] = stop
            sent.append(runner.step().copy())
        np.testing.assert_allclose(sent[1], sent[0], rtol=0, atol=tolerance * (k + 1))
        q += 0.004 * sent[0]
    assert np.abs(sent[0]).max() > 0.5


@pytest.mark.long
def test_threads_share_a_large_batch(tmp_path):
    arms = 1040
    step, example = VelocityStep(panda), told(arms, dtype=torch.float64)
    example = replace(example, joint_velocity=torch.ones(arms, 7, dtype=torch.float64))
    runner = PackageRunner(export_step(step, example, tmp_path))
    velocities = []
    for threads in (1, 3):
        before = torch.get_num_threads()
        torch.set_num_threads(threads)
        try:
            runner.observe(example)
            runner.start(example.joint_position.numpy())
            velocities.append(runner.step().copy())
        finally:
            torch.set_num_threads(before)
    np.testing.assert_array_equal(velocities[1], velocities[0])
    eager, _ = step.step(step.initial_state(example.joint_position), example)
    np.testing.assert_allclose(velocities[0], eager.joint_velocity, rtol=0, atol=1e-12)


class Mixed(VelocityStep):
    """The arms of a batch all move as the fastest of them."""

    def step(self, state, observation):
        wanted = observation.joint_velocity.amax(0, keepdim=True)
        wanted = wanted.expand_as(observation.joint_velocity)
        return super().step(state, replace(observation, joint_velocity=wanted))


@pytest.mark.long
def test_arms_that_depend_on_each_other_are_refused(tmp_path):
    with pytest.raises(UnknownOperationError, match="an arm of the batch reads observation"):
        export_step(Mixed(panda), told(4, dtype=torch.float64), tmp_path)
    assert not list(tmp_path.glob("step-*"))
    assert isinstance(Mixed(panda), nn.Module)


@pytest.mark.slow
class TestBatch:
    """Everything that a controller does."""

    def test_it_equals_the_eager_step(self, package):
        controller, observation = controller_and_observation(panda.ready.expand(ARMS, 7))
        assert_equal_steps(controller, observation, load(package)[0], 250)

    def test_it_equals_the_eager_step_in_closed_loop(self, package):
        """Each step may add 1e-12 rad/s to the difference."""
        noise = torch.randn(ARMS, 7, generator=sampling.generator(), dtype=torch.float64)
        controller, observation = controller_and_observation(panda.ready + 0.3 * noise)
        runners = [EagerRunner(controller, observation), PackageRunner(package)]
        q = observation.joint_position.numpy()
        for runner in runners:
            runner.observe(observation)
            runner.start(q)
            runner.observation["feature"][:] += 100 * q[:, :2]
            runner.observation["feature_visible"][:] = np.arange(ARMS) % 4 != 0
            runner.observation["nullspace_input"][:] = 0.1 * q
        steps = 200
        for _ in range(steps):
            eager, exported = (runner.step() for runner in runners)
            np.testing.assert_allclose(exported, eager, rtol=0, atol=steps * 1e-12)
            for runner in runners:
                for field in ("joint_position", "image_joint_position"):
                    runner.observation[field][:] += 0.002 * runner.joint_velocity
                runner.observation["feature"][:] += runner.joint_velocity[:, :2]
        assert np.abs(runners[0].joint_velocity).max() > 0.1
