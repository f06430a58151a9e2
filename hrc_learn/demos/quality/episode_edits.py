"""Edits of an episode: frames removed, values corrected, frames resampled to a grid."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int64
from numpy.lib.stride_tricks import sliding_window_view

from hrc_learn.demos.demonstration import Demonstration
from hrc_learn.demos.issues import DatasetError
from hrc_learn.demos.preprocessing import motion_range, nearest_frames, regular_grid, resting
from hrc_learn.demos.quality.episode_checks import is_clock, repeated_frames
from hrc_learn.demos.read.columns import ColumnMapping, ColumnSelection
from hrc_learn.demos.read.dataset_folder import EpisodeEntry
from hrc_learn.demos.read.frames import RawFrames, recorded_stamps, select_quantities
from hrc_learn.demos.read.naming import is_hand
from hrc_learn.demos.read.profiles import is_discrete, profile_columns
from hrc_learn.demos.read.quantities import INDEX_KEYS
from hrc_learn.demos.read.source import OpenedDataset
from hrc_learn.demos.read.units import Quantities, UnitDecision
from hrc_learn.geometry import quaternion

_PAUSE = 0.1
"""Longest time between two reports of a moving robot [s]."""
_RESTING = 0.01
"""Largest change of a value at rest, relative to its range; more than the noise of encoders."""
_MEASURED_ANGLES = ("joint_position", "euler_xyz", "euler_intrinsic_xyz")
_LARGEST_REMAINDER = 0.3 / (2 * np.pi)
"""Largest difference between a jump and a whole number of turns [turns]. There is a difference
because the joint also moves from one frame to the next."""
_NEIGHBOURS = 4
"""Number of steps before and after a jump from which the speed of a joint is estimated."""
_SMOOTH = ("joint_position", "joint_velocity", "position")


@dataclass(frozen=True, kw_only=True)
class EpisodeEdit:
    """One episode during its repair."""

    entry: EpisodeEntry
    """Entry in the old dataset."""
    columns: ColumnMapping
    units: Mapping[str, UnitDecision]
    frames: RawFrames
    """Columns to be written; of LeRobot's index columns, only `task_index`."""
    time: Float64[np.ndarray, " _frames"]
    """Recorded times if a column holds them, otherwise LeRobot's stamps [s]."""
    kept: Int64[np.ndarray, " _frames"]
    """Index of each frame in the old episode; after resampling, that of the nearest frame."""
    resampled: bool = False
    changes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.time)

    @property
    def selections(self) -> dict[str, ColumnSelection]:
        """Columns by role."""
        return self.columns.selections

    @property
    def quantities(self) -> Quantities:
        """Quantities in the units on disk."""
        return select_quantities(self.frames, self.selections)

    def turn(self, role: str) -> Float64[np.ndarray, " components"]:
        """A full turn in the unit of each component."""
        width = len(self.selections[role].columns)
        return 2 * np.pi / np.broadcast_to(self.units[role].factor, width)

    def hands(self, role: str) -> Bool[np.ndarray, " components"]:
        """Mask of the fingers and grippers among the columns of a role."""
        labels, joints = self.selections[role].labels, self.columns.joint_names
        named = [label in joints and is_hand(label) for label in labels]
        return np.array(named) | (role == "gripper")

    def only(self, wanted: Bool[np.ndarray, " _frames"], change: str) -> "EpisodeEdit":
        """The episode with the wanted frames only.

        Raises:
            DatasetError: Fewer than two frames would be left.
        """
        if wanted.all():
            return self
        if wanted.sum() < 2:
            raise self.fault(f"{change}: fewer than two frames are left")
        return replace(
            self,
            frames={key: values[wanted] for key, values in self.frames.items()},
            time=self.time[wanted],
            kept=self.kept[wanted],
            changes=(*self.changes, change),
        )

    def with_quantity(
        self, role: str, values: Float64[np.ndarray, "frames columns"], *changes: str
    ) -> "EpisodeEdit":
        """The episode with other values of a quantity, in the unit on disk."""
        columns: RawFrames = {}
        for number, (key, index) in enumerate(self.selections[role].columns):
            column = columns.setdefault(key, self.frames[key].copy())
            column[:, index] = values[:, number]
        return replace(self, frames=self.frames | columns, changes=(*self.changes, *changes))

    def fault(
        self, message: str, frame: int | None = None, key: str | None = None
    ) -> DatasetError:
        """An error that names the episode, and the frame of the old dataset."""
        original = None if frame is None or self.resampled else int(self.kept[frame])
        return self.entry.error(message, frame=original, key=key)


def unedited(
    dataset: OpenedDataset,
    units: Mapping[str, UnitDecision],
    entry: EpisodeEntry,
    frames: RawFrames,
) -> EpisodeEdit:
    """All frames of an episode, as they are."""
    time = recorded_stamps(dataset.folder, frames)
    if "time" in dataset.columns.selections:
        ((key, index),) = dataset.columns.selections["time"].columns
        time = frames[key][:, index].astype(float) * units["time"].factor
    unused = {*INDEX_KEYS} - {"task_index"}
    return EpisodeEdit(
        entry=entry,
        columns=dataset.columns,
        units=units,
        frames={key: values for key, values in frames.items() if key not in unused},
        time=time,
        kept=np.arange(entry.length),
    )


def renew_stamps(edit: EpisodeEdit, fps: float) -> EpisodeEdit:
    """Replace LeRobot's own stamps by frame / fps if they do not increase."""
    stalled = int((~(np.diff(edit.time) > 0)).sum())
    if not stalled or "time" in edit.selections:
        return edit
    change = f"renewed the stamps: {stalled} steps that did not increase -> 0"
    time = np.arange(len(edit)) / fps
    return replace(edit, time=time, changes=(*edit.changes, change))


def drop_bad_frames(edit: EpisodeEdit, allowed: bool) -> EpisodeEdit:
    """Drop the frames with values that are not finite.

    A feature that was not visible need not be finite.

    Raises:
        DatasetError: There are such frames and `allowed` is False, or too few are left.
    """
    faulty = {key: ~np.isfinite(values.astype(float)) for key, values in edit.frames.items()}
    if {"feature", "feature_visible"} <= edit.selections.keys():
        hidden = ~(edit.quantities["feature_visible"][:, 0] > 0)
        for key, index in edit.selections["feature"].columns:
            faulty[key][hidden, index] = False
    rows = [~np.isfinite(edit.time), *(mask.any(1) for mask in faulty.values())]
    bad = np.logical_or.reduce(rows)
    if bad.any() and not allowed:
        text = f"holds values that are not finite in {bad.sum()} frames; drop those"
        text += " (--drop bad-frames), or the episode (--drop bad-episodes)"
        raise edit.fault(text, frame=int(bad.argmax()))
    return edit.only(~bad, f"dropped {bad.sum()} frames with values that are not finite")


def drop_late(edit: EpisodeEdit) -> EpisodeEdit:
    """Drop the frames whose stamp is not later than all earlier ones.

    Raises:
        DatasetError: Fewer than two frames are left.
    """
    highest = np.maximum.accumulate(edit.time)
    later = np.concatenate([[True], edit.time[1:] > highest[:-1]])
    dropped = f"{(~later).sum()} frames whose stamp does not increase"
    return edit.only(later, f"dropped {dropped}: {len(edit)} -> {later.sum()}")


def drop_repeats(edit: EpisodeEdit) -> EpisodeEdit:
    """Drop the frames that repeat the previous one because the robot reports too slowly.

    A frame with a different command, or any other difference, stays. Repetitions that last
    longer than `_PAUSE` show an arm at rest, and stay too.

    Raises:
        DatasetError: Fewer than two frames are left.
    """
    repeated = repeated_frames(edit.frames)
    for values in edit.frames.values():
        if not is_clock(values):
            repeated[1:] &= (values[1:] == values[:-1]).all(1)
    begin = np.maximum.accumulate(np.where(repeated, 0, np.arange(len(edit))))
    end = np.append(np.flatnonzero(~repeated)[1:], len(edit))[np.cumsum(~repeated) - 1] - 1
    repeated &= edit.time[end] - edit.time[begin] <= _PAUSE
    dropped = f"{repeated.sum()} repeated frames"
    return edit.only(~repeated, f"dropped {dropped}: {len(edit)} -> {(~repeated).sum()}")


def trim(edit: EpisodeEdit) -> EpisodeEdit:
    """Shorten the standstill before and after the motion to 0.1 s.

    Raises:
        DatasetError: The arm never moves, or the stamps do not increase.
    """
    quantities = edit.quantities
    role = next((r for r in ("joint_position", "position") if r in quantities), None)
    if role is None or len(edit) < 3:
        return edit
    moving: dict[str, Any] = {role: quantities[role] * edit.units[role].factor}
    names = edit.columns.joint_names if role == "joint_position" else ()
    time, number = edit.time - edit.time[0], edit.entry.index
    try:
        demo = Demonstration(time=time, joint_names=names, fps=1.0, episode=number, **moving)
        first, stop = motion_range(demo, resting(demo))
    except ValueError as error:
        raise edit.fault(str(error)) from error
    first, last = _while_all_rest(edit, first, stop - 1)
    wanted = np.zeros(len(edit), dtype=bool)
    wanted[first : last + 1] = True
    cut = f"{time[first]:.2f} s at the beginning, {time[-1] - time[last]:.2f} s at the end"
    return edit.only(wanted, f"trimmed {cut}: {len(edit)} -> {wanted.sum()} frames")


def _while_all_rest(edit: EpisodeEdit, first: int, last: int) -> tuple[int, int]:
    """First and last frame to keep; all state and action columns rest outside this range."""
    for key, values in edit.frames.items():
        if not key.startswith(("observation.", "action", "state")) or is_clock(values):
            continue
        values = values.astype(float)
        margin = _RESTING * np.ptp(values, axis=0)
        # One frame of rest stays before the first change and after the last.
        before = (np.abs(values[: first + 1] - values[0]) > margin).any(1)
        after = (np.abs(values[last:] - values[-1]) > margin).any(1)
        if before.any():
            first = max(0, int(before.argmax()) - 1)
        if after.any():
            last = min(len(values) - 1, last + len(after) - int(after[::-1].argmax()))
    return first, last


def move_zeros(edit: EpisodeEdit, offsets: Mapping[str, float]) -> EpisodeEdit:
    """Add angles [deg] to measured joint positions, by joint.

    Raises:
        DatasetError: There is no such joint, or it is not measured as an angle.
    """
    role = "joint_position"
    labels = [*edit.selections[role].labels] if role in edit.selections else []
    for joint, angle in offsets.items():
        if joint not in labels or edit.units[role].si_unit != "rad":
            known = ", ".join(labels) or "none"
            text = f"{joint!r} is no joint with a measured angle; measured joints: {known}"
            raise edit.fault(text, key=role)
        moved = edit.quantities[role].copy()
        moved[:, labels.index(joint)] += angle / 360 * edit.turn(role)[labels.index(joint)]
        edit = edit.with_quantity(role, moved, f"moved {joint} by {angle:+g} deg")
    return edit


def apply_calibration(edit: EpisodeEdit) -> EpisodeEdit:
    """Convert joints and their commands from -100..100 to degrees."""
    for role in ("joint_position", "command_position"):
        if role in edit.selections and (plain := edit.units[role].plain) != edit.units[role]:
            degrees = edit.quantities[role] * (edit.units[role].factor / plain.factor)
            edit = edit.with_quantity(role, degrees, f"{role} converted to {plain.unit}")
            edit = replace(edit, units={**edit.units, role: plain})
    return edit


def unwrap(edit: EpisodeEdit) -> EpisodeEdit:
    """Remove jumps by whole turns from joints, Euler angles and rotation vectors.

    Only measurements of the arm change: commands, hands, grippers and switches stay as they
    are. If the command of a joint jumps, the joint also stays as it is, so that joint and
    command still agree.
    """
    quantities = edit.quantities
    for role in (*_MEASURED_ANGLES, "rotation_vector"):
        if role not in quantities:
            continue
        values, turn = quantities[role], edit.turn(role)
        if role == "rotation_vector":
            scaled = torch.from_numpy(values * 2 * np.pi / turn)
            smooth = quaternion.unwrap_log(scaled).numpy() * turn / (2 * np.pi)
        else:
            smooth = values - turn * _turns(values / turn)
            fixed = is_discrete(profile_columns({role: values})[role], len(edit))
            fixed |= edit.hands(role)
            if role == "joint_position" and "command_position" in quantities:
                other = quantities["command_position"] / edit.turn("command_position")
                fixed |= _turns(other).any(0)
            smooth[:, fixed] = values[:, fixed]
        # Conversion alters the last digit of rotation vectors: do not count this as a change.
        changed = np.abs(smooth - values).max(0) > 1e-6 * turn
        smooth[:, ~changed] = values[:, ~changed]
        if changed.any():
            labels = edit.selections[role].labels
            names = ", ".join(labels[int(i)] for i in np.flatnonzero(changed))
            old, new = (np.abs(np.diff(v[:, changed], axis=0)).max() for v in (values, smooth))
            steps = f"largest step {old:.4g} -> {new:.4g} {edit.units[role].unit}"
            edit = edit.with_quantity(role, smooth, f"unwrapped {role} ({names}): {steps}")
    return edit


def _turns(
    values: Float64[np.ndarray, "frames columns"],
) -> Float64[np.ndarray, "frames columns"]:
    """Whole turns by which each value has jumped since the first frame.

    The remainder of a jump is its difference from a whole number of turns. A jump counts only
    if its remainder fits the motion before and after the jump. For example, a signal that
    switches between -3 and 3 rad leaves a remainder of 0.28 rad, but rests before and after:
    it does not turn.
    """
    if len(values) < 2:
        return np.zeros_like(values)
    steps = np.diff(values, axis=0)
    whole = np.rint(steps)
    left = np.abs(steps - whole)
    jumps = np.where(left < _LARGEST_REMAINDER, whole, 0.0)
    usual = np.where(whole == 0, np.abs(steps), 0.0)
    padded = np.pad(usual, ((_NEIGHBOURS, _NEIGHBOURS), (0, 0)))
    around = sliding_window_view(padded, 2 * _NEIGHBOURS + 1, axis=0).max(-1)
    # The remainder may be up to three times the neighbouring steps, since the joint may
    # accelerate, plus a thousandth of a turn for noise.
    jumps[left > 3 * around + 1e-3] = 0.0
    return np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(jumps, axis=0)])


def fix_signs(edit: EpisodeEdit) -> EpisodeEdit:
    """Choose the signs of quaternions such that they do not jump."""
    for role, values in edit.quantities.items():
        if role.startswith("quaternion"):
            flips = int(((values[1:] * values[:-1]).sum(1) < 0).sum())
            change = f"fixed {flips} jumps of the sign of {role}: {flips} -> 0"
            if flips:
                smooth = quaternion.continuous(torch.from_numpy(values)).numpy()
                edit = edit.with_quantity(role, smooth, change)
    return edit


def resample_to_grid(edit: EpisodeEdit, fps: float | int) -> EpisodeEdit:
    """Resample every column to a regular grid that begins at the first frame.

    Joints, joint velocities, positions and quaternions follow cubic splines. Integers, switches
    and hands have the values of the nearest frame. All other columns follow straight lines.
    Joints, commands and Euler angles that jump by whole turns are unwrapped. Rotation vectors
    are interpolated as they are: unwrap them first. Stamps must increase.

    Raises:
        DatasetError: The episode is shorter than a period, or it holds values that cannot be
            interpolated: commands that are changes per step, or poses as matrices.
    """
    from scipy.interpolate import CubicSpline, make_interp_spline

    known = edit.time - edit.time[0]
    try:
        grid = regular_grid(float(known[-1]), fps)
    except ValueError as error:
        raise edit.fault(str(error)) from error
    if "pose_matrix" in edit.selections:
        text = "holds poses as matrices, which are not resampled: leave them out"
        text += " (mapping={'pose_matrix': None}), or keep the frame rate (give no fps)"
        raise edit.fault(text, key="pose_matrix")
    if "command_position" in edit.units and edit.units["command_position"].steps.any():
        text = "holds changes per step, which would be wrong at another frame rate: give no fps"
        raise edit.fault(text, key="command_position")
    time = np.minimum(grid, known[-1])
    smooth, seen = fix_signs(_unwrapped_all(edit)), None
    if {"feature", "feature_visible"} <= edit.selections.keys():
        seen = edit.quantities["feature_visible"] > 0
        pixels = edit.quantities["feature"]  # pixels need not be finite while not visible
        sound = np.where(np.isfinite(pixels) | seen, pixels, 0.0)
        smooth = smooth.with_quantity("feature", sound)
    frames = {
        key: make_interp_spline(known, values.astype(float), k=1)(time)
        for key, values in smooth.frames.items()
    }
    moved = replace(smooth, frames=frames, time=grid + edit.time[0])
    for role, values in smooth.quantities.items():
        if role in _SMOOTH:
            moved = moved.with_quantity(role, CubicSpline(known, values)(time))
        elif role.startswith("quaternion"):
            q = CubicSpline(known, values)(time)
            q /= np.linalg.norm(q, axis=1, keepdims=True)
            moved = moved.with_quantity(role, q)
    nearest = nearest_frames(known, time)
    for key, held in _levels(edit):
        moved.frames[key][:, held] = edit.frames[key][nearest][:, held]
    if seen is not None:  # visible in both neighbours, as in `preprocessing.at_times`
        both = np.interp(time, known, seen[:, 0]) > 1 - 1e-9
        moved = moved.with_quantity("feature_visible", both[:, None])
    return replace(
        moved,
        kept=edit.kept[nearest],
        resampled=True,
        changes=(*edit.changes, f"resampled {len(edit)} frames to {len(grid)} at {fps:g} Hz"),
    )


def _levels(edit: EpisodeEdit) -> Iterator[tuple[str, Bool[np.ndarray, " components"]]]:
    """Components of each column that are not interpolated: integers, switches and hands."""
    profiles = profile_columns(edit.frames)
    hands: set[tuple[str, int]] = set()
    for role in {"joint_position", "gripper", "command_position"} & edit.selections.keys():
        columns = edit.selections[role].columns
        hands |= {columns[i] for i in np.flatnonzero(edit.hands(role))}
    for key, values in edit.frames.items():
        held = np.array([(key, index) in hands for index in range(values.shape[1])])
        if key in profiles:
            held |= is_discrete(profiles[key], len(edit))
        yield key, held | (values.dtype.kind != "f")


def _unwrapped_all(edit: EpisodeEdit) -> EpisodeEdit:
    """The episode without jumps of angles and commands by whole turns, for interpolation."""
    quantities = edit.quantities
    for role in (*_MEASURED_ANGLES, "command_position"):
        if role in quantities:
            turn = edit.turn(role)
            turns = _turns(quantities[role] / turn)
            if turns.any():
                edit = edit.with_quantity(role, quantities[role] - turn * turns)
    return edit
