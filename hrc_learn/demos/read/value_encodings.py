"""How values are encoded on disk: their units, declared or guessed, and the encodings of
orientations.
"""

import math
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from hrc_learn.demos.format.features import SIDECAR_PATH
from hrc_learn.demos.issue import DatasetError
from hrc_learn.demos.read.component_names import ROLES
from hrc_learn.geometry import quaternion

# Units of a dataset's values: declared, given, or guessed from their size.
#
# LeRobot declares none, and radians, degrees, encoder ticks and -100..100 all occur.

_DIMENSIONS: dict[str, dict[str, float]] = {
    "angle": {"rad": 1.0, "deg": math.pi / 180, "tick": 2 * math.pi / 4096},
    "angular velocity": {
        "rad/s": 1.0,
        "deg/s": math.pi / 180,
        "tick/s": 2 * math.pi / 4096,
    },
    "length": {"m": 1.0, "cm": 1e-2, "mm": 1e-3},
    "time": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9},
    "torque": {"N m": 1.0, "N mm": 1e-3},
    "pixels": {"px": 1.0},
    "ratio": {"1": 1.0, "%": 1e-2},
}
"""Dimension -> unit -> its size in the unit we keep. A tick is 1/4096 of a turn, as the
encoders of hobby servos count; where their zero lies is not known."""

# Two turns: wrists go past one, and no demonstration stays within 13 degrees.
_JOINT_LIMITS = {"rad": 4 * math.pi, "deg": 400.0}
_REACH = {"m": 5.0, "cm": 500.0}
_ROTATION_LIMIT = {
    "euler_xyz": 2 * math.pi + 0.1,
    "euler_intrinsic_xyz": 2 * math.pi + 0.1,
    "rotation_vector": 4 * math.pi,
}

_FOLLOWERS = {
    "joint_velocity": "joint_position",
    "command_position": "joint_position",
    "command_velocity": "joint_position",
}
"""Quantities taken to be in the unit of another where nothing is said of them."""

_GUESSABLE = ("joint_position", "command_position", "position", *_ROTATION_LIMIT)


@dataclass(frozen=True, kw_only=True)
class UnitDecision:
    """The unit of one quantity on disk, and how it is known."""

    role: str
    unit: str
    note: str | None = None
    """What was guessed and how to overrule it; None where nothing had to be."""
    converts: bool = False
    """Whether a guess changes the values."""

    @property
    def factor(self) -> float:
        """What values on disk are multiplied by."""
        return unit_factor(self.role, self.unit)


def unit_factor(role: str, unit: str) -> float:
    """Size of a unit in the one we keep for a quantity.

    Raises:
        DatasetError: The quantity is unknown, or does not come in this unit.
    """
    if role not in ROLES:
        raise DatasetError(
            f"units are given for the unknown quantity {role!r}; known are {', '.join(ROLES)}"
        )
    own = ROLES[role].unit
    options = next(units for units in _DIMENSIONS.values() if own in units)
    if role == "gripper":
        options = options | _DIMENSIONS["ratio"]
    if unit not in options:
        raise DatasetError(
            f"{role} does not come in {unit!r}; known units are {', '.join(options)}"
        )
    return options[unit]


def decide_units(
    largest: Mapping[str, float],
    declared: Mapping[str, str],
    given: Mapping[str, str],
    frame_step: float = 1.0,
) -> dict[str, UnitDecision]:
    """Decide on a unit for every quantity.

    Args:
        largest: Largest absolute value of each quantity on disk, by role.
        declared: Units by role from the dataset's sidecar.
        given: Units by role from the caller; they win.
        frame_step: Step of the true stamps on disk, as a multiple of the nominal period [s].

    Raises:
        DatasetError: A unit is unknown, or does not fit its quantity.
    """
    for role, unit in given.items():
        unit_factor(role, unit)
    _check_declared(declared)
    stated = {**declared, **given}
    decisions: dict[str, UnitDecision] = {}
    for role in sorted(largest, key=lambda role: role in _FOLLOWERS):
        if role in stated:
            decisions[role] = UnitDecision(role=role, unit=stated[role])
        elif (leader := decisions.get(_FOLLOWERS.get(role, ""))) is not None:
            decisions[role] = UnitDecision(role=role, unit=_following_unit(role, leader.unit))
        elif role == "time":
            decisions[role] = _guess_time(frame_step)
        elif role in _GUESSABLE:
            decisions[role] = _guess(role, largest[role])
        else:
            decisions[role] = UnitDecision(role=role, unit=ROLES[role].unit)
    return decisions


def guessed_from_values(roles: Iterable[str], stated: Collection[str]) -> list[str]:
    """Quantities whose unit can only be told from the size of their values."""
    return [role for role in roles if role in _GUESSABLE and role not in stated]


def _check_declared(declared: Mapping[str, str]) -> None:
    for role, unit in declared.items():
        try:
            unit_factor(role, unit)
        except DatasetError as error:
            raise DatasetError(str(error), file=SIDECAR_PATH, key=f"units.{role}") from error


def _following_unit(role: str, unit: str) -> str:
    return f"{unit}/s" if role.endswith("velocity") else unit


def _guess(role: str, largest: float) -> UnitDecision:
    if role == "position":
        unit = next((unit for unit, limit in _REACH.items() if largest <= limit), "mm")
    elif role in _ROTATION_LIMIT:
        unit = "rad" if largest <= _ROTATION_LIMIT[role] else "deg"
    else:
        unit = next((unit for unit, limit in _JOINT_LIMITS.items() if largest <= limit), "tick")
    caution = {
        "deg": " (LeRobot's -100..100 look alike)" if role not in _ROTATION_LIMIT else "",
        "tick": " (1/4096 of a turn, zero unknown)",
    }.get(unit, "")
    return UnitDecision(
        role=role,
        unit=unit,
        note=(
            f"{role}: no unit declared, values reach {largest:.4g}: taken for {unit}{caution}; "
            f"overrule with units={{{role!r}: ...}}"
        ),
        converts=unit != ROLES[role].unit,
    )


def _guess_time(frame_step: float) -> UnitDecision:
    """The unit of stamps, from how far their step is off the frame rate."""
    sizes = _DIMENSIONS["time"]
    off = {unit: abs(math.log10(max(frame_step, 1e-3) * size)) for unit, size in sizes.items()}
    unit = min(off, key=off.__getitem__)
    if unit == "s":
        return UnitDecision(role="time", unit=unit)
    note = (
        f"time: no unit declared, steps are {frame_step:.3g} times 1/fps: taken for {unit}; "
        f"overrule with units={{'time': ...}}"
    )
    return UnitDecision(role="time", unit=unit, note=note, converts=True)


# Orientations in the encodings datasets use, as continuous unit quaternions.


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
