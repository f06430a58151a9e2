"""Errors of a learned image Jacobian against the true one of the simulated camera."""

import itertools

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.geometry import Pose, quaternion
from hrc_learn.jacobian import RBFImageJacobian
from hrc_learn.kinematics import gripper_down
from hrc_learn.vision import CameraModel

ROTATION_SCALE = 0.15
"""Weight of a radian in the norm of a Jacobian [m/rad]: a typical lever arm."""
REACH = 0.02
"""Points this close to a demonstrated one are inside the demonstrated workspace [m]."""


def held_out_grid(
    demonstrated: Float[Tensor, "frames 3"], points: int = 9, tilt: float = 0.0, seed: int = 0
) -> Pose:
    """Poses inside the demonstrated workspace, on a grid that no demonstration follows.

    Args:
        demonstrated: Positions of the end effector [m].
        points: Number of points along each axis, over the demonstrated range.
        tilt: Largest tilt of the end effector from pointing down, about each axis [rad].
        seed: Seed of the tilts.
    """
    low, high = demonstrated.amin(dim=0), demonstrated.amax(dim=0)
    axes = [
        torch.linspace(float(a), float(b), points, dtype=torch.float64)
        for a, b in zip(low, high, strict=True)
    ]
    grid = torch.tensor(list(itertools.product(*axes)), dtype=torch.float64)
    inside = torch.cdist(grid, demonstrated).amin(dim=1) < REACH
    grid = grid[inside]
    rng = torch.Generator().manual_seed(seed)
    turn = tilt * (2 * torch.rand(len(grid), 3, generator=rng, dtype=torch.float64) - 1)
    down = gripper_down().expand(len(grid), 4)
    return Pose(grid, quaternion.multiply(quaternion.exp(turn), down))


def compare_with_truth(
    network: RBFImageJacobian,
    poses: Pose,
    camera: CameraModel,
    offset: Float[np.ndarray, "3"],
) -> dict[str, float]:
    """Relative errors of the estimate, and calibration of its uncertainty.

    Args:
        network: Learned image Jacobian with its covariance.
        poses: Poses of the tool, (n,).
        camera: True camera.
        offset: Offset of the marker in the frame of the tool centre point [m].

    Returns:
        `relative_error_median` and `_p95`: |estimate - truth| / |truth|, Frobenius norms with
        rotation counted in metres. `within_1_sigma` and `within_2_sigma`: fractions of
        the entries that close to the truth; 0.68 and 0.95 of a Gaussian.
    """
    scale = torch.tensor([1.0] * 3 + [1 / ROTATION_SCALE] * 3, dtype=torch.float64)
    marker = poses.apply(torch.from_numpy(offset)).numpy()
    truth = torch.from_numpy(camera.image_jacobian(marker, poses.position.numpy()))
    with torch.no_grad():
        error = network(poses) - truth
        sigmas = error.abs() / network.uncertainty(poses)[..., None, :]
    relative = (error * scale).flatten(-2).norm(dim=-1) / (truth * scale).flatten(-2).norm(
        dim=-1
    )
    return {
        "relative_error_median": float(relative.median()),
        "relative_error_p95": float(relative.quantile(0.95)),
        "within_1_sigma": float((sigmas < 1).double().mean()),
        "within_2_sigma": float((sigmas < 2).double().mean()),
    }
