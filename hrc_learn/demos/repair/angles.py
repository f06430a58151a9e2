"""Turns taken out of angles, and signs out of quaternions."""

import numpy as np
import torch
from jaxtyping import Float64

from ...geometry import quaternion
from ..frames import RawFrames
from .draft import Draft, Meaning

_ANGLES = ("joint_position", "command_position", "euler_xyz", "euler_intrinsic_xyz")
_TOLERANCE = 0.3 / (2 * np.pi)
"""How far a jump may be from whole turns and still be one, in turns: what moves in a frame."""


def unwrap(draft: Draft, meaning: Meaning) -> Draft:
    """Joints, Euler angles and rotation vectors without jumps by whole turns."""
    for role, values in draft.quantities(meaning).items():
        turn = meaning.whole_turn(role) if role in (*_ANGLES, "rotation_vector") else None
        if turn is None:
            continue
        if role == "rotation_vector":
            scaled = torch.from_numpy(values * 2 * np.pi / turn)
            smooth = quaternion.unwrap_log(scaled).numpy() * turn / (2 * np.pi)
        else:
            smooth = values - turn * _turns(values / turn)
        # Beyond rounding: a rotation vector is changed in its last digit by scaling.
        changed = np.abs(smooth - values).max(0) > 1e-6 * turn
        if changed.any():
            labels = meaning.matching.selections[role].labels
            names = ", ".join(labels[int(i)] for i in np.flatnonzero(changed))
            draft = _with_quantity(draft, meaning, role, smooth, f"unwrapped {role} ({names})")
    return draft


def fix_signs(draft: Draft, meaning: Meaning) -> Draft:
    """Quaternions whose sign does not jump."""
    for role, values in draft.quantities(meaning).items():
        if not role.startswith("quaternion"):
            continue
        flips = (values[1:] * values[:-1]).sum(1) < 0
        if flips.any():
            sign = np.concatenate([[1.0], np.cumprod(np.where(flips, -1.0, 1.0))])
            change = f"fixed {flips.sum()} jumps of the sign of {role}"
            draft = _with_quantity(draft, meaning, role, values * sign[:, None], change)
    return draft


def _turns(
    values: Float64[np.ndarray, "frames columns"],
) -> Float64[np.ndarray, "frames columns"]:
    """Whole turns by which each value has jumped since the first frame."""
    steps = np.diff(values, axis=0)
    whole = np.rint(steps)
    jumps = np.where(np.abs(steps - whole) < _TOLERANCE, whole, 0.0)
    return np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(jumps, axis=0)])


def _with_quantity(
    draft: Draft,
    meaning: Meaning,
    role: str,
    values: Float64[np.ndarray, "frames columns"],
    change: str,
) -> Draft:
    columns: RawFrames = {}
    for number, (key, index) in enumerate(meaning.matching.selections[role].columns):
        column = columns.setdefault(key, draft.frames[key].copy())
        column[:, index] = values[:, number]
    return draft.with_columns(columns, change)
