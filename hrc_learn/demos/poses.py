"""Orientations in the encodings datasets use, as continuous unit quaternions."""

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from ..geometry import quaternion


def to_quaternion(
    role: str, values: Float64[np.ndarray, "frames components"]
) -> Float64[np.ndarray, "frames 4"]:
    """Unit quaternions (w, x, y, z), neighbours on the same half of the sphere.

    Args:
        role: One of `roles.ORIENTATION_ROLES`.
        values: Its components in our units.

    Raises:
        ValueError: Quaternions are far from unit length, matrices are no transforms, or two
            columns span no plane.
    """
    numbers = torch.from_numpy(values)
    match role:
        case "quaternion_wxyz":
            orientation = _unit(numbers)
        case "quaternion_xyzw":
            orientation = _unit(numbers.roll(1, dims=-1))
        case "rotation_vector":
            orientation = quaternion.exp(numbers)
        case "euler_xyz":
            orientation = _from_euler(numbers, (2, 1, 0))
        case "euler_intrinsic_xyz":
            orientation = _from_euler(numbers, (0, 1, 2))
        case "rotation_6d":
            orientation = _from_two_columns(numbers)
        case _:
            orientation = quaternion.from_matrix(as_transforms(numbers)[:, :3, :3])
    return quaternion.continuous(orientation).numpy()


def matrix_position(
    values: Float64[np.ndarray, "frames 16"],
) -> Float64[np.ndarray, "frames 3"]:
    """Translation of flattened 4x4 transforms."""
    return as_transforms(torch.from_numpy(values))[:, :3, 3].numpy()


def as_transforms(values: Tensor) -> Tensor:
    """4x4 transforms from 16 numbers, whether written by rows or, as libfranka, by columns.

    Raises:
        ValueError: Neither reading has (0, 0, 0, 1) for its last row.
    """
    by_rows = values.reshape(-1, 4, 4)
    last = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=values.dtype)
    for matrices in (by_rows, by_rows.mT):
        if torch.allclose(matrices[:, 3], last.expand(len(matrices), 4), atol=1e-4):
            return matrices
    raise ValueError("16 numbers that are no 4x4 transform: no last row 0, 0, 0, 1")


def _unit(q: Tensor) -> Tensor:
    wrong = ((q.norm(dim=-1) - 1).abs() > 0.01).nonzero()
    if len(wrong):
        k = int(wrong[0])
        raise ValueError(
            f"quaternion of length {float(q[k].norm()):.4g} at frame {k}: the columns hold no "
            f"quaternion, or it was lost there"
        )
    return quaternion.normalize(q)


def _from_euler(angles: Tensor, order: tuple[int, int, int]) -> Tensor:
    """Turns about the axes x, y, z, multiplied from left to right in this order.

    About fixed axes, R = Rz(yaw) Ry(pitch) Rx(roll); about turning ones, R = Rx Ry Rz.
    """
    axes = torch.eye(3, dtype=angles.dtype)
    first, second, third = (quaternion.exp(angles[:, k, None] * axes[k]) for k in order)
    return quaternion.multiply(first, quaternion.multiply(second, third))


def _from_two_columns(values: Tensor) -> Tensor:
    """Two columns of a rotation matrix, made orthonormal (Zhou et al., CVPR 2019, eq. 15)."""
    first, second = values[:, :3], values[:, 3:]
    third = torch.linalg.cross(first, second)
    lost = (third.norm(dim=-1) < 1e-6).nonzero()
    if len(lost):
        raise ValueError(
            f"the two columns at frame {int(lost[0])} span no plane: they hold no rotation"
        )
    first = first / first.norm(dim=-1, keepdim=True)
    third = third / third.norm(dim=-1, keepdim=True)
    matrix = torch.stack([first, torch.linalg.cross(third, first), third], dim=-1)
    return quaternion.from_matrix(matrix)
