"""Quantities of a dataset: their roles, and encodings of orientation."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from hrc_learn.demos.demonstration import JOINT_FIELDS
from hrc_learn.geometry import quaternion
from hrc_learn.store import read_toml


@dataclass(frozen=True, kw_only=True)
class Role:
    """Quantity that a group of columns can hold."""

    unit: str
    """Unit in a `Demonstration`."""
    width: int | None = None
    """Number of columns; None for one per joint."""


_TABLES = read_toml(Path(__file__).with_name("quantities.toml"))

ROLES = {name: Role(**row) for name, row in _TABLES["roles"].items()}
"""Every role. `euler_xyz` is roll, pitch, yaw about the fixed axes x, y, z and
`euler_intrinsic_xyz` are angles about the moving axes x, y, z; `rotation_6d` is the first two
columns of the rotation matrix, one after the other, and `rotation_6d_rows` its first two rows;
`rotation_matrix` is flattened in row order; `pose_matrix` is a flattened 4x4 homogeneous
transform."""
SIZES: dict[str, list[tuple[float, str, float, str]]] = _TABLES["sizes"]
"""Quantity whose unit is guessed from the size of its values -> rows of largest value, unit,
confidence and second candidate."""

ORIENTATION_ROLES: tuple[str, ...] = tuple(_TABLES["orientations"]["roles"])
"""Encodings of an orientation, preferred first."""
DIMENSIONS: dict[str, dict[str, float]] = _TABLES["dimensions"]
"""Dimension -> unit -> factor to the SI unit. A tick is 1/4096 of a turn, as the encoders of
hobby servos count; the position of their zero is unknown. A byte counts from 0 to 255, as
grippers and hands of Robotiq and Inspire do."""
CONTRACT_QUANTITIES: dict[str, str] = _TABLES["contract"]
"""Role in a contract -> quantity of a demonstration, "" for none. All other roles have the same
name in both."""
RECORDED: dict[str, list[str]] = _TABLES["recorded"]
"""Keyword of `DatasetWriter.add_frame` -> role, feature and component names."""

INDEX_KEYS = ("timestamp", "frame_index", "episode_index", "index", "task_index")
"""Index columns that LeRobot maintains."""


def demonstration_fields(
    quantities: Mapping[str, Float64[np.ndarray, "frames _columns"]],
    factors: Mapping[str, float | Float64[np.ndarray, " _columns"]],
) -> dict[str, Any]:
    """Fields of a `Demonstration` in SI units, except its time.

    Args:
        quantities: Quantities in the units on disk, by role.
        factors: Factors from the units on disk to SI units, by role.

    Raises:
        ValueError: The orientations are invalid.
    """
    values = {
        r: x if np.all(factors[r] == 1) else x * factors[r] for r, x in quantities.items()
    }
    known = (*JOINT_FIELDS, "position", "feature")
    fields: dict[str, Any] = {role: values[role] for role in known if role in values}
    if "gripper" in values:
        opening = values["gripper"]
        # robomimic stores two fingers with opposite signs: their distance is the opening.
        two = opening.shape[1] == 2
        fields["gripper"] = opening[:, 0] - opening[:, 1] if two else opening[:, 0]
    if "feature_visible" in values:
        fields["feature_visible"] = values["feature_visible"][:, 0] > 0
    if "pose_matrix" in values:  # only the translation of a transform has a unit
        values["pose_matrix"] = quantities["pose_matrix"]
        moved = transforms(torch.from_numpy(values["pose_matrix"]))[:, :3, 3].numpy()
        fields.setdefault("position", moved * factors["pose_matrix"])
    for role in [role for role in ORIENTATION_ROLES if role in values][:1]:
        fields["orientation"] = to_quaternion(role, values[role])
    return fields


def to_quaternion(
    role: str, values: Float64[np.ndarray, "frames components"]
) -> Float64[np.ndarray, "frames 4"]:
    """Unit quaternions (w, x, y, z), their sign continuous along the frames.

    Args:
        role: Encoding, one of `ORIENTATION_ROLES`.
        values: Components in SI units.

    Raises:
        ValueError: Quaternions are far from unit length, matrices are no transforms, or two
            columns span no plane.
    """
    return quaternion.continuous(_DECODERS[role](torch.from_numpy(values))).numpy()


_DECODERS: dict[str, Callable[[Tensor], Tensor]] = {
    "quaternion_wxyz": lambda q: _normalized(q),
    "quaternion_xyzw": lambda q: _normalized(q.roll(1, dims=-1)),
    "rotation_vector": quaternion.exp,
    # Fixed axes: R = Rz(yaw) Ry(pitch) Rx(roll); moving axes: R = Rx Ry Rz.
    "euler_xyz": lambda angles: _from_euler(angles, (2, 1, 0)),
    "euler_intrinsic_xyz": lambda angles: _from_euler(angles, (0, 1, 2)),
    "rotation_6d": lambda columns: _from_two_columns(columns),
    "rotation_6d_rows": lambda rows: quaternion.conjugate(_from_two_columns(rows)),
    "rotation_matrix": lambda m: quaternion.from_matrix(_rotations(m.reshape(-1, 3, 3))),
    "pose_matrix": lambda m: quaternion.from_matrix(_rotations(transforms(m)[:, :3, :3])),
}
"""Encoding of an orientation -> function from its components to quaternions."""


def transforms(values: Float64[Tensor, "frames 16"]) -> Tensor:
    """4x4 transforms from 16 numbers, in row order or, as in libfranka, in column order.

    Raises:
        ValueError: The last row is (0, 0, 0, 1) in neither order.
    """
    by_rows = values.reshape(-1, 4, 4)
    last = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=by_rows.dtype)
    for matrices in (by_rows, by_rows.mT):
        # The tolerance allows for float32 and for few printed digits.
        if torch.allclose(matrices[:, 3], last.expand(len(matrices), 4), atol=1e-4):
            return matrices
    raise ValueError("the 16 numbers are no 4x4 transform: its last row must be 0, 0, 0, 1")


def _rotations(matrices: Tensor) -> Tensor:
    """Return the matrices; raise ValueError unless all are rotations without reflection."""
    product = matrices @ matrices.mT
    # The tolerance allows for float32 and for few printed digits.
    wrong = ((product - torch.eye(3, dtype=product.dtype)).abs() > 1e-2).flatten(1).any(1)
    wrong |= torch.linalg.det(matrices) < 0
    if wrong.any():
        frame = int(wrong.nonzero()[0])
        raise ValueError(f"the 3x3 numbers at frame {frame} are no rotation matrix")
    return matrices


def _normalized(q: Tensor) -> Tensor:
    # Rounding changes the length by far less than 1 %.
    wrong = ((q.norm(dim=-1) - 1).abs() > 0.01).nonzero()
    if len(wrong):
        k = int(wrong[0])
        text = f"quaternion of length {float(q[k].norm()):.4g} at frame {k}"
        raise ValueError(f"{text}: the columns hold no quaternion, or tracking was lost there")
    return quaternion.normalize(q)


def _from_euler(angles: Tensor, order: tuple[int, int, int]) -> Tensor:
    """Product of the rotations about x, y and z, multiplied from left to right in `order`."""
    axes = torch.eye(3, dtype=angles.dtype)
    first, second, third = (quaternion.exp(angles[:, k, None] * axes[k]) for k in order)
    return quaternion.multiply(first, quaternion.multiply(second, third))


def _from_two_columns(values: Tensor) -> Tensor:
    """Two columns of a rotation matrix, made orthonormal (Zhou et al., CVPR 2019, eq. 15)."""
    first, second = values[:, :3], values[:, 3:]
    third = torch.linalg.cross(first, second)
    # Parallel columns, or zeros where nothing was recorded.
    lost = (third.norm(dim=-1) < 1e-6).nonzero()
    if len(lost):
        text = f"the two columns at frame {int(lost[0])} span no plane"
        raise ValueError(f"{text}: they hold no rotation")
    first = first / first.norm(dim=-1, keepdim=True)
    third = third / third.norm(dim=-1, keepdim=True)
    matrix = torch.stack([first, torch.linalg.cross(third, first), third], dim=-1)
    return quaternion.from_matrix(matrix)
