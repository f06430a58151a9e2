"""Edits of an episode's values: unwrapped angles, continuous quaternions, a regular grid."""

from dataclasses import replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float64
from numpy.lib.stride_tricks import sliding_window_view

from hrc_learn.demos.demonstration import Demonstration
from hrc_learn.demos.preprocessing import nearest_frames, resample
from hrc_learn.demos.quality.frame_edits import ColumnSemantics, EpisodeEdit
from hrc_learn.demos.read.frames import RawFrames
from hrc_learn.demos.read.profiles import is_discrete, profile_columns
from hrc_learn.demos.read.quantities import is_hand, to_quaternion
from hrc_learn.geometry import quaternion

_MEASURED_ANGLES = ("joint_position", "euler_xyz", "euler_intrinsic_xyz")
_LARGEST_REMAINDER = 0.3 / (2 * np.pi)
"""Largest motion within a frame: what may be left of a jump without its whole turns [turns]."""
_NEIGHBOURS = 4
"""Steps on either side that tell the speed of the joint."""
_SMOOTH = ("joint_position", "joint_velocity", "position")


def unwrap(edit: EpisodeEdit, semantics: ColumnSemantics) -> EpisodeEdit:
    """Remove jumps by whole turns from joints, Euler angles and rotation vectors.

    Only measurements of the arm change: commands, hands, grippers and switches stay as they
    are. A joint whose command jumps with it stays too, so that the two agree.
    """
    quantities = edit.quantities(semantics)
    roles = [role for role in (*_MEASURED_ANGLES, "rotation_vector") if role in quantities]
    for role in roles:
        values, turn = quantities[role], semantics.turn(role)
        if role == "rotation_vector":
            scaled = torch.from_numpy(values * 2 * np.pi / turn)
            smooth = quaternion.unwrap_log(scaled).numpy() * turn / (2 * np.pi)
        else:
            smooth = values - turn * _turns(values / turn)
            fixed = ~_may_turn(edit, semantics, role)
            smooth[:, fixed] = values[:, fixed]
        if role == "joint_position" and "command_position" in quantities:
            other = quantities["command_position"] / semantics.turn("command_position")
            together = _turns(other).any(0)
            smooth[:, together] = values[:, together]
        # Scaling changes a rotation vector in its last digit.
        changed = np.abs(smooth - values).max(0) > 1e-6 * turn
        smooth[:, ~changed] = values[:, ~changed]
        if changed.any():
            selection = semantics.selections[role]
            names = ", ".join(selection.labels[int(i)] for i in np.flatnonzero(changed))
            before, after = (
                np.abs(np.diff(v[:, changed], axis=0)).max() for v in (values, smooth)
            )
            change = (
                f"unwrapped {role} ({names}): largest step {before:.4g} -> {after:.4g} "
                f"{semantics.units[role].unit}"
            )
            edit = edit.with_quantity(selection, smooth, change)
    return edit


def _may_turn(edit: EpisodeEdit, semantics: ColumnSemantics, role: str) -> np.ndarray:
    """Mask of components that are angles of the arm: no fingers, no switches."""
    values = edit.quantities(semantics)[role]
    discrete = is_discrete(profile_columns({role: values})[role], len(edit))
    if role != "joint_position":
        return ~discrete
    hands = [
        label in semantics.joint_names and is_hand(label)
        for label in semantics.selections[role].labels
    ]
    return ~discrete & ~np.array(hands)


def _turns(
    values: Float64[np.ndarray, "frames columns"],
) -> Float64[np.ndarray, "frames columns"]:
    """Whole turns by which each value has jumped since the first frame.

    A jump counts only if its remainder fits the motion before and after: a two-level signal of
    -3 and 3 rad leaves 0.28 rad while it rests otherwise, which is no turn.
    """
    steps = np.diff(values, axis=0)
    whole = np.rint(steps)
    left = np.abs(steps - whole)
    jumps = np.where(left < _LARGEST_REMAINDER, whole, 0.0)
    usual = np.where(whole == 0, np.abs(steps), 0.0)
    padded = np.pad(usual, ((_NEIGHBOURS, _NEIGHBOURS), (0, 0)))
    around = sliding_window_view(padded, 2 * _NEIGHBOURS + 1, axis=0).max(-1)
    # Three times the neighbouring steps, and a thousandth of a turn for noise.
    # The factor allows for acceleration between neighbouring frames.
    jumps[left > 3 * around + 1e-3] = 0.0
    return np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(jumps, axis=0)])


def fix_signs(edit: EpisodeEdit, semantics: ColumnSemantics) -> EpisodeEdit:
    """Choose the signs of quaternions such that they do not jump."""
    for role, values in edit.quantities(semantics).items():
        if not role.startswith("quaternion"):
            continue
        flips = (values[1:] * values[:-1]).sum(1) < 0
        if flips.any():
            sign = np.concatenate([[1.0], np.cumprod(np.where(flips, -1.0, 1.0))])
            change = f"fixed {flips.sum()} jumps of the sign of {role}: {flips.sum()} -> 0"
            edit = edit.with_quantity(
                semantics.selections[role], values * sign[:, None], change
            )
    return edit


def resample_to_grid(
    edit: EpisodeEdit, semantics: ColumnSemantics, fps: float | int
) -> EpisodeEdit:
    """Resample every column, as `preprocessing.resample` does.

    Angles that jump by whole turns are unwrapped, interpolated and wrapped again. Rotation
    vectors are interpolated as they are: unwrap them first.

    Raises:
        DatasetError: The stamps do not increase, the episode is shorter than a period, or it
            holds transforms, which cannot be interpolated by their entries.
    """
    smooth, wrapped = _unwrapped_all(edit, semantics)
    quantities = smooth.quantities(semantics)
    if "pose_matrix" in quantities:
        raise edit.fault(
            "holds poses as matrices, which are not resampled; map them away "
            "(mapping={'pose_matrix': None}) or leave the frames as they are (no fps)",
            key="pose_matrix",
        )
    fields: dict[str, Any] = {role: quantities[role] for role in _SMOOTH if role in quantities}
    columns_of = {name: semantics.selections[name].columns for name in fields}
    encoding = next((role for role in quantities if role.startswith("quaternion")), "")
    try:
        if encoding:
            fields["orientation"] = to_quaternion(encoding, quantities[encoding])
            columns_of["orientation"] = semantics.selections[encoding].columns
        demo = Demonstration(
            time=edit.time - edit.time[0],
            joint_names=semantics.joint_names,
            fps=fps,
            extra={key: values.astype(float) for key, values in smooth.frames.items()},
            **fields,
        )
        moved = resample(demo, fps)
    except ValueError as error:
        raise edit.fault(str(error)) from error
    columns: RawFrames = dict(moved.extra)
    for name, places in columns_of.items():
        values = getattr(moved, name)
        if name == "orientation" and encoding == "quaternion_xyzw":
            values = np.roll(values, -1, axis=1)
        for number, (key, index) in enumerate(places):
            columns[key][:, index] = values[:, number]
    for (key, index), (turn, middle) in wrapped.items():
        column = columns[key][:, index]
        columns[key][:, index] = column - turn * np.rint((column - middle) / turn)
    nearest = nearest_frames(demo.time, np.minimum(moved.time, demo.time[-1]))
    _hold_levels(columns, edit, semantics, nearest)
    return replace(
        edit,
        frames=columns,
        time=moved.time + edit.time[0],
        kept=edit.kept[nearest],
        resampled=True,
        changes=(*edit.changes, f"resampled {len(edit)} frames to {len(moved)} at {fps:g} Hz"),
    )


def _hold_levels(
    columns: RawFrames, edit: EpisodeEdit, semantics: ColumnSemantics, nearest: np.ndarray
) -> None:
    """Take the nearest frame for integers, switches and hands, which have no value between."""
    hands, profiles = semantics.hand_columns(), profile_columns(edit.frames)
    for key, values in edit.frames.items():
        if values.dtype.kind not in "f":
            columns[key] = values[nearest]
            continue
        held = np.array([(key, index) in hands for index in range(values.shape[1])])
        if key in profiles:
            held |= is_discrete(profiles[key], len(edit))
        columns[key][:, held] = values[nearest][:, held]


def _unwrapped_all(
    edit: EpisodeEdit, semantics: ColumnSemantics
) -> tuple[EpisodeEdit, dict[tuple[str, int], tuple[float, float]]]:
    """Angles and commands without jumps by whole turns.

    Returns:
        The episode, and for each column that jumps a turn and the middle of its range, in its
        unit.
    """
    quantities, wrapped = edit.quantities(semantics), {}
    for role in (*_MEASURED_ANGLES, "command_position"):
        if role not in quantities:
            continue
        values, turn = quantities[role], semantics.turn(role)
        turns = _turns(values / turn)
        if not turns.any():
            continue
        selection = semantics.selections[role]
        for k in np.flatnonzero(turns.any(0)):
            middle = float(values[:, k].min() + values[:, k].max()) / 2
            wrapped[selection.columns[k]] = float(turn[k]), middle
        edit = edit.with_quantity(selection, values - turn * turns)
    return edit, wrapped
