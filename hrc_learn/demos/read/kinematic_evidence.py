"""Comparison of joint positions with recorded end-effector positions, by forward kinematics.

The forward kinematics of a known arm give the recorded positions only if the unit, order, signs
and zeros of the recorded joints are right. The positions of base and tool need not be known.
"""

import itertools
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float64

from hrc_learn.demos.issues import DatasetError
from hrc_learn.demos.read.naming import is_hand
from hrc_learn.geometry import quaternion
from hrc_learn.kinematics import Arm

_FRAMES = 80
"""Number of frames that are compared."""
_LEAST_MOTION = 0.01
"""Smallest motion of the end effector for a comparison [m]."""
_AGREES, _AGREES_RELATIVE = 4e-3, 0.03
"""`_AGREES`: residual up to which positions agree [m]; arms are calibrated to millimetres.
`_AGREES_RELATIVE`: the same, relative to the motion. The larger bound counts."""
_WORSE = 3.0
"""Ratio of residuals above which one interpretation is preferred to another."""
_UNITS = {"rad": 1.0, "deg": math.pi / 180, "rev": 2 * math.pi}
_LEAST_OFFSET = math.radians(0.5)


@dataclass(frozen=True, kw_only=True)
class Agreement:
    """Interpretation of the joints for which forward kinematics give the recorded positions."""

    unit: str
    residual: float
    """Root mean square distance between computed and recorded positions [m]."""
    other: float
    """Residual of the unchanged joints, read in rad or in deg, whichever fits better [m]."""
    change: str = ""
    """Change of signs or order that the recorded joints need, in words; "" if none."""


def arm_columns(names: Sequence[str], arm: Arm) -> tuple[int, ...]:
    """Column of each of the arm's joints among the joints of a dataset.

    Raises:
        DatasetError: The dataset's joints are not the arm's.
    """
    plain = [_plain(name) for name in names]
    wanted = [_plain(name) for name in arm.joint_names]
    if set(wanted) <= set(plain):
        return tuple(plain.index(name) for name in wanted)
    joints = [i for i, name in enumerate(names) if not is_hand(name)]
    if len(joints) != arm.joints:
        raise DatasetError(
            f"the dataset's joints ({', '.join(names) or 'none'}) are not those of {arm.name} "
            f"({', '.join(arm.joint_names)}): --robot NAME|FILE names another arm"
        )
    return tuple(joints)


def _plain(name: str) -> str:
    """A joint's name in lower case, without separators and a suffix such as `pos`."""
    return re.sub("[^a-z0-9]", "", re.sub(r"[._ ](pos|position|q)$", "", name.lower()))


def agreement(
    arm: Arm,
    joints: Float64[np.ndarray, "frames joints"],
    position: Float64[np.ndarray, "frames 3"],
) -> Agreement | None:
    """The interpretation of recorded joints that explains the positions; None if none does.

    Args:
        arm: The arm; the columns of `joints` are its joints.
        joints: Joint positions as recorded.
        position: Positions of the end effector [m], in any frame parallel to the base.
    """
    some = np.unique(np.linspace(0, len(joints) - 1, _FRAMES).astype(int))
    joints, position = joints[some], position[some]
    motion = float(np.linalg.norm(np.std(position, axis=0)))
    if motion < _LEAST_MOTION:
        return None
    units = {u: residual(arm, f * joints, position) for u, f in _UNITS.items()}
    usual = min(units["rad"], units["deg"])
    bound = max(_AGREES, _AGREES_RELATIVE * motion)
    unit = min(units, key=units.__getitem__)
    if units[unit] < bound:
        clear = all(size > _WORSE * units[unit] for u, size in units.items() if u != unit)
        return Agreement(unit=unit, residual=units[unit], other=usual) if clear else None
    for unit in ("rad", "deg"):
        for change, changed in _changes(arm.joint_names, _UNITS[unit] * joints):
            if (left := residual(arm, changed, position)) < bound and _WORSE * left < usual:
                return Agreement(unit=unit, residual=left, other=usual, change=change)
    return None


def _changes(
    names: tuple[str, ...], joints: Float64[np.ndarray, "frames joints"]
) -> Iterator[tuple[str, Float64[np.ndarray, "frames joints"]]]:
    """Joints with other signs or in another order, and the change in words."""
    count = len(names)
    for size in (1, 2, 3):
        for turned in itertools.combinations(range(count), size):
            signs = np.ones(count)
            signs[[*turned]] = -1
            yield f"{', '.join(names[i] for i in turned)} with opposite sign", joints * signs
    for a, b in itertools.combinations(range(count), 2):
        order = [*range(count)]
        order[a], order[b] = b, a
        yield f"{names[a]} and {names[b]} exchanged", joints[:, order]


def residual(
    arm: Arm, q: Float64[np.ndarray, "frames joints"], position: Float64[np.ndarray, "frames 3"]
) -> float:
    """Root mean square distance between positions and forward kinematics [m].

    The positions of the base and of the tool on the flange are fitted.
    """
    left = _left(arm, q, position)
    return float(np.sqrt((left**2).mean() * 3))


def _left(
    arm: Arm, q: Float64[np.ndarray, "frames joints"], position: Float64[np.ndarray, "frames 3"]
) -> Float64[np.ndarray, " numbers"]:
    """Differences of the positions from p_flange + R_flange tool + base [m].

    The pose of the flange (p_flange, R_flange) comes from forward kinematics; the constant
    vectors `tool` and `base` are fitted.
    """
    pose = arm.forward(torch.from_numpy(np.ascontiguousarray(q)))
    turns = quaternion.to_matrix(pose.orientation).numpy()
    free = np.concatenate([turns, np.broadcast_to(np.eye(3), turns.shape)], axis=2)
    free, apart = free.reshape(-1, 6), (position - pose.position.numpy()).ravel()
    return apart - free @ np.linalg.lstsq(free, apart, rcond=1e-6)[0]


def zero_offsets(
    arm: Arm, q: Float64[np.ndarray, "frames joints"], position: Float64[np.ndarray, "frames 3"]
) -> Float64[np.ndarray, " joints"]:
    """Offsets of joints [rad] with which forward kinematics give the recorded positions.

    The offsets must be added to the joints. Offsets below 0.5 degrees are set to 0. All offsets
    are 0 if they do not explain the error of the positions.

    Args:
        arm: The arm.
        q: Joint positions [rad].
        position: Positions of the end effector [m], in any frame parallel to the base.
    """
    from scipy.optimize import least_squares

    some = np.unique(np.linspace(0, len(q) - 1, _FRAMES).astype(int))
    q, position = q[some], position[some]
    nothing, before = np.zeros(q.shape[1]), residual(arm, q, position)
    # An offset of 0.1 rad costs as much as a position error of 1 mm. This removes offsets that
    # a displaced tool explains equally well.
    found = least_squares(
        lambda offset: np.append(_left(arm, q + offset, position), 1e-2 * offset), nothing
    ).x
    after = residual(arm, q + found, position)
    explained = after < _AGREES and _WORSE * after < before
    return np.where(np.abs(found) > _LEAST_OFFSET, found, 0.0) if explained else nothing
