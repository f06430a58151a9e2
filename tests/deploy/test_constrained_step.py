"""The exported step with the constraint layer against the eager one."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from step_equality import controller_and_observation
from unchecked import shapes_unchecked

from hrc_learn.controller import (
    AdaptiveController,
    ConstraintConfig,
    ControllerConfig,
    Distances,
    Observation,
    SafetyConfig,
    WayMakingConfig,
)
from hrc_learn.deploy import EagerRunner, PackageRunner, export_step
from hrc_learn.kinematics import panda

DOUBLE = torch.float64
pytestmark = pytest.mark.slow  # compiles for half a minute


@pytest.fixture(autouse=True)
def _no_shape_checks() -> Iterator[None]:
    """Tracers cannot follow them."""
    with shapes_unchecked():
        yield


@pytest.fixture
def observed() -> tuple[AdaptiveController, Observation]:
    plain, observation = controller_and_observation()
    config = ControllerConfig(
        way_making=WayMakingConfig(), safety=SafetyConfig(constraints=ConstraintConfig())
    )
    law = AdaptiveController(panda, plain.estimator, plain.goals, config=config)
    near = Distances(
        distance=torch.ones(4, dtype=DOUBLE),
        gradient=torch.zeros(4, 7, dtype=DOUBLE),
        approach_speed=torch.zeros(4, dtype=DOUBLE),
    )
    return law, replace(observation, distances=near)


def test_it_does_what_the_eager_one_does(observed, tmp_path: Path):
    law, observation = observed
    eager = EagerRunner(law, observation)
    compiled = PackageRunner(export_step(law, observation, tmp_path))
    for runner in (eager, compiled):
        runner.observe(observation)
    rng, bound = np.random.default_rng(0), 0
    q = panda.ready.numpy().copy()
    for k in range(500):
        seen = {
            "joint_position": q,
            "nullspace_input": 2 * rng.standard_normal(7),
            "distances.distance": rng.uniform(0.0, 0.4, 4),
            "distances.gradient": 0.3 * rng.standard_normal((4, 7)),
            "distances.approach_speed": rng.uniform(-0.3, 0.3, 4),
        }
        if k % 50 == 49:
            seen["distances.distance"][0] = np.nan
        for runner in (eager, compiled):
            for name, value in seen.items():
                runner.observation[name][:] = value
        before, after = eager.step(), compiled.step()
        np.testing.assert_allclose(after, before, rtol=0, atol=1e-9)
        for name in ("slowed", "violation", "solved"):
            field = f"safety.constraints.{name}"
            np.testing.assert_allclose(
                compiled.command[field], eager.command[field], rtol=0, atol=1e-7
            )
        bound += bool(eager.command["safety.constraints.slowed"] > 0.01)
        q = q + 0.002 * before
    assert bound > 50
