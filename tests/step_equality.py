"""A controller's step on vectors against the eager one: from any state, whatever is seen."""

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from hrc_learn.controller import (
    GRIPPER_DOWN,
    INITIAL_IMAGE_JACOBIAN,
    AdaptiveController,
    Goals,
    Observation,
)
from hrc_learn.deploy.package import PackedStep, StepLayouts, Vectors
from hrc_learn.geometry import quaternion
from hrc_learn.jacobian import KalmanEstimator, RBFImageJacobian, paper_grid
from hrc_learn.kinematics import SerialChain, panda

Arrays = dict[str, np.ndarray]

# Largest difference allowed where it is not 1e-12.
TOLERANCES = {
    # That of a velocity over a step of 2 ms.
    "safety.acceleration": 1e-12 / 0.002,
    # Scaled for one joint to touch its limit: errors of the task are divided by what this joint
    # moves in the null space.
    "null_velocity": 1e-11,
    # Sums of products of weights up to 2e4, of variances up to 2.5e6.
    "image_jacobian": 2e4 * 1e-12,
    "weight_norm": 2e5 * 1e-12,
    "estimator.covariance": 2.5e6 * 1e-12,
    # What 1500 px within a millimetre ask for, with positions right to 1e-15 m.
    "estimator.weight": (1500 / 1e-3) * 1e-12,
}


def controller_and_observation(
    q: Tensor = panda.ready,
    arm: SerialChain = panda,
) -> tuple[AdaptiveController, Observation]:
    """The recommended controller and all that it may be told but people's distances."""
    J = torch.tensor(INITIAL_IMAGE_JACOBIAN, dtype=torch.float64)
    # Five of the paper's nine neurons: the same operations, and fewer of them to compile.
    network = RBFImageJacobian.from_jacobian(J, paper_grid()[::2], 0.1)
    down = quaternion.normalize(q.new_tensor(GRIPPER_DOWN))
    goals = Goals.at(q.new_tensor((0.4, 0.1, 0.4)), down, q.new_tensor((700.0, 500.0)))
    controller = AdaptiveController(arm, KalmanEstimator(network), goals)
    batch = q.shape[:-1]
    observation = Observation(
        joint_position=q,
        feature=torch.full((*batch, 2), 600.0, dtype=q.dtype),
        feature_visible=torch.ones(batch, dtype=torch.bool),
        feature_new=torch.ones(batch, dtype=torch.bool),
        feature_age=torch.zeros(batch, dtype=q.dtype),
        image_joint_position=q,
        nullspace_input=torch.zeros_like(q),
        goals=goals,
        dt=0.002,
    )
    return controller, observation


def assert_equal_steps(
    controller: AdaptiveController,
    observation: Observation,
    run: Callable[[list[Tensor]], object],
    steps: int,
) -> None:
    """Compares single steps from states that the eager step has reached."""
    step = PackedStep(controller, observation)
    expected = step.example(observation)
    first = expected.state.clone()
    arms = _of_each_arm(step.layouts.observation.arrays(expected.observation))
    active = step.layouts.state.arrays(expected.state)["blending.active"]
    rng, followed = np.random.default_rng(0), 0.0
    for k in range(steps):
        for arm in arms:
            _observe_at_random(arm, rng)
        if k % 100 == 0:
            expected.state.copy_(first)
        actual = Vectors(*(x.clone() for x in expected))
        with torch.no_grad():
            step(*expected)
            run(list(actual))
        _assert_equal(step.layouts, expected, actual, k)
        followed += active.mean()
    assert 0.1 * steps < followed < 0.9 * steps


def _assert_equal(layouts: StepLayouts, expected: Vectors, actual: Vectors, step: int) -> None:
    for layout, e, a in zip(layouts, expected, actual, strict=True):
        for field, x, y in zip(layout.fields, layout.views(e), layout.views(a), strict=True):
            exact = not field.dtype.is_floating_point
            atol = 0 if exact else TOLERANCES.get(field.name, 1e-12)
            torch.testing.assert_close(
                y,
                x,
                rtol=0,
                atol=atol,
                equal_nan=True,
                msg=lambda why, name=field.name: f"step {step}, {name}: {why}",
            )


def _of_each_arm(arrays: Arrays) -> list[Arrays]:
    """Views of an observation's arrays, without a batch; goals are the same for all arms."""
    batch = arrays["joint_position"].shape[:-1]
    return [
        {name: x if name.startswith("goals") else x[(*arm, ...)] for name, x in arrays.items()}
        for arm in np.ndindex(batch)
    ]


def _observe_at_random(arrays: Arrays, rng: np.random.Generator) -> None:
    """Anything a robot may report: lost and NaN features, people, NaN and fast joints."""
    if not np.isfinite(arrays["joint_position"]).all():
        arrays["joint_position"][:] = panda.ready.numpy()
    lower, upper = panda.limits.lower.numpy(), panda.limits.upper.numpy()
    near = arrays["joint_position"] + 0.003 * rng.standard_normal(7)
    anywhere = rng.uniform(lower, upper)
    arrays["image_joint_position"][:] = near
    arrays["joint_position"][:] = near if rng.random() < 0.9 else anywhere
    arrays["feature"][:] += 3 * rng.standard_normal(2)
    if rng.random() < 0.1 or not np.isfinite(arrays["feature"]).all():
        arrays["feature"][:] = rng.uniform(-100, 1500, 2)
    arrays["feature_visible"][...] = rng.random() < 0.8
    arrays["feature_new"][...] = rng.random() < 0.5
    arrays["feature_age"][...] = rng.uniform(0, 0.3)
    arrays["nullspace_input"][:] = 2 * rng.standard_normal(7) * (rng.random() < 0.5)
    arrays["goals.vision.target"][:] = rng.uniform(200, 900, 2)
    arrays["goals.vision_enabled"][...] = rng.random() < 0.9
    for name, share in (("feature", 0.1), ("joint_position", 0.02), ("nullspace_input", 0.01)):
        if rng.random() < share:
            arrays[name].flat[0] = np.nan
