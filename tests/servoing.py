"""An arm that servoes on a marker over a box: camera, controller, starts and observations."""

import torch
from pinhole_camera import PinholeCamera
from torch import Tensor

from hrc_learn.controller import AdaptiveController, ControllerConfig, Goals, Observation
from hrc_learn.geometry import Pose, quaternion
from hrc_learn.jacobian import FixedEstimator, RBFImageJacobian, paper_grid
from hrc_learn.kinematics import panda

DOUBLE = torch.float64
LIMITS = panda.limits
DOWN = quaternion.normalize(torch.tensor([-0.28, 0.63, 0.66, 0.28], dtype=DOUBLE))
CENTRE = torch.tensor([0.3, 0.4, 0.3], dtype=DOUBLE)
MARKER = torch.tensor([0.05, 0.0, -0.08], dtype=DOUBLE)
POSTURE = torch.tensor(
    [-0.9590, 1.2335, 1.6717, -2.5717, -1.3091, 2.6191, 0.7714], dtype=DOUBLE
)
"""The tool is at CENTRE, pointing DOWN, far from limits and singularities."""


def overhead_camera(*batch: int, roll: float = 0.0, tilt: float = 0.2) -> PinholeCamera:
    one = torch.ones(batch, dtype=DOUBLE)
    return PinholeCamera.above(
        CENTRE.expand(*batch, 3),
        height=1.0 * one,
        roll=roll * one,
        tilt=tilt * one,
        bearing=0.5 * one,
        marker=MARKER,
    )


def target_in(camera: PinholeCamera, *batch: int, rng: torch.Generator) -> tuple[Tensor, Pose]:
    """Where the marker appears for a random tool pose in the box."""
    offset = 0.04 * (2 * torch.rand(*batch, 3, generator=rng, dtype=DOUBLE) - 1)
    tool = Pose(CENTRE + offset, DOWN.expand(*batch, 4))
    return camera.project(tool)[0], tool


def near_starts(*batch: int, rng: torch.Generator, spread: float = 0.4) -> Tensor:
    q = panda.ready + spread * torch.randn(*batch, 7, generator=rng, dtype=DOUBLE)
    return q.clamp(LIMITS.lower + 0.03, LIMITS.upper - 0.03)


def network(J: Tensor) -> RBFImageJacobian:
    return RBFImageJacobian.from_jacobian(J, paper_grid(), 0.1)


def grasping(
    *batch: int, rng: torch.Generator, config: ControllerConfig | None = None
) -> tuple[AdaptiveController, PinholeCamera]:
    """A controller whose Jacobian is right at one pose of the box."""
    camera = overhead_camera(*batch)
    target, _ = target_in(camera, *batch, rng=rng)
    J = overhead_camera().image_jacobian(Pose(CENTRE, DOWN))
    goals = Goals.at(CENTRE, DOWN, target)
    controller = AdaptiveController(panda, FixedEstimator(network(J)), goals, config=config)
    return controller, camera


def observe(q: Tensor, **fields) -> Observation:
    batch = q.shape[:-1]
    defaults = {
        "joint_position": q,
        "feature": torch.full((*batch, 2), 700.0, dtype=DOUBLE),
        "feature_visible": torch.ones(batch, dtype=torch.bool),
        "dt": 0.002,
    }
    return Observation(**(defaults | fields))
