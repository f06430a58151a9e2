"""Edits of one episode: frames dropped, angles unwrapped, signs made continuous, frames
put on a regular grid.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int64
from numpy.lib.stride_tricks import sliding_window_view

from hrc_learn.demos.demonstration import Demonstration
from hrc_learn.demos.format.dataset_folder import EpisodeEntry
from hrc_learn.demos.issue import DatasetError
from hrc_learn.demos.preprocessing import resample, trim_rest
from hrc_learn.demos.preprocessing.resampling import nearest_frames
from hrc_learn.demos.read.column_mapping import ColumnMapping
from hrc_learn.demos.read.episodes import Quantities, select_quantities
from hrc_learn.demos.read.frames import RawFrames
from hrc_learn.demos.read.profiles import is_discrete, profile_columns
from hrc_learn.demos.read.reader import to_quaternion
from hrc_learn.demos.read.roles import UnitDecision
from hrc_learn.demos.validation.data_checks import is_clock, repeated_frames
from hrc_learn.geometry import quaternion

# One episode on its way from the old dataset to the new.


@dataclass(frozen=True, kw_only=True)
class ColumnSemantics:
    """What the columns of the dataset mean, and in which units."""

    column_mapping: ColumnMapping
    units: dict[str, UnitDecision]
    hands: frozenset[str] = frozenset()
    """Joints that are fingers or grippers."""
    bad: dict[int | None, DatasetError] = field(default_factory=dict)
    """Episodes that contradict the units of the rest."""


@dataclass(frozen=True, kw_only=True)
class EpisodeEdit:
    """One episode as far as it has been repaired."""

    entry: EpisodeEntry
    """Its place in the old dataset."""
    frames: RawFrames
    """Columns that will be written, LeRobot's own but for `task_index` left out."""
    time: Float64[np.ndarray, " _frames"]
    """True stamps [s] where there are any, LeRobot's otherwise."""
    kept: Int64[np.ndarray, " _frames"]
    """Frame of the old episode that each is, or lies nearest to once resampled."""
    resampled: bool = False
    changes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.time)

    def quantities(self, semantics: ColumnSemantics) -> Quantities:
        """Quantities in the units on disk."""
        return select_quantities(self.frames, semantics.column_mapping.selections)

    def only(self, wanted: Bool[np.ndarray, " _frames"], change: str) -> "EpisodeEdit":
        """The wanted frames alone.

        Raises:
            DatasetError: Less than two would be left.
        """
        if wanted.all():
            return self
        if wanted.sum() < 2:
            raise self.bad(f"{change}: no two frames are left")
        return replace(
            self,
            frames={key: values[wanted] for key, values in self.frames.items()},
            time=self.time[wanted],
            kept=self.kept[wanted],
            changes=(*self.changes, change),
        )

    def bad(
        self, message: str, frame: int | None = None, key: str | None = None
    ) -> DatasetError:
        """An error that names the episode."""
        original = None if frame is None or self.resampled else int(self.kept[frame])
        return DatasetError(message, **self.entry.location, frame=original, key=key)


# Turns taken out of angles, and signs out of quaternions.

_MEASURED_ANGLES = ("joint_position", "euler_xyz", "euler_intrinsic_xyz")
_MOST_LEFT = 0.3 / (2 * np.pi)
"""What may be left of a jump without its whole turns, in turns: what moves in a frame."""
_NEIGHBOURS = 4
"""Steps on either side that say how fast the joint was moving."""


def unwrap(edit: EpisodeEdit, semantics: ColumnSemantics, commands: bool) -> EpisodeEdit:
    """Joints, Euler angles and rotation vectors without jumps by whole turns.

    Of the arm's own measurements alone: hands, grippers and whatever switches between levels
    stay as they are, and commands too unless asked for. A joint whose command jumps along with
    it stays with its command, so that the two are not torn apart.
    """
    quantities = edit.quantities(semantics)
    roles = [role for role in (*_MEASURED_ANGLES, "rotation_vector") if role in quantities]
    roles += ["command_position"] * (commands and "command_position" in quantities)
    for role in roles:
        values = quantities[role]
        turn = _turn_of(values, semantics, role)
        if role == "rotation_vector":
            scaled = torch.from_numpy(values * 2 * np.pi / turn)
            smooth = quaternion.unwrap_log(scaled).numpy() * turn / (2 * np.pi)
        else:
            smooth = values - turn * _turns(values / turn)
            smooth[:, ~_may_turn(edit, semantics, role)] = values[
                :, ~_may_turn(edit, semantics, role)
            ]
        if role == "joint_position" and not commands and "command_position" in quantities:
            other = quantities["command_position"]
            bound = _turn_of(other, semantics, "command_position")
            together = _turns(other / bound).any(0)
            smooth[:, together] = values[:, together]
        # Beyond rounding: a rotation vector is changed in its last digit by scaling.
        changed = np.abs(smooth - values).max(0) > 1e-6 * turn
        smooth[:, ~changed] = values[:, ~changed]
        if changed.any():
            labels = semantics.column_mapping.selections[role].labels
            names = ", ".join(labels[int(i)] for i in np.flatnonzero(changed))
            before, after = (
                np.abs(np.diff(v[:, changed], axis=0)).max() for v in (values, smooth)
            )
            change = (
                f"unwrapped {role} ({names}): largest step {before:.4g} -> {after:.4g} "
                f"{semantics.units[role].unit}"
            )
            edit = _with_quantity(edit, semantics, role, smooth, change)
    return edit


def _may_turn(edit: EpisodeEdit, semantics: ColumnSemantics, role: str) -> np.ndarray:
    """Components that are angles of the arm: no fingers, nothing that switches."""
    selection = semantics.column_mapping.selections[role]
    values = edit.quantities(semantics)[role]
    discrete = is_discrete(profile_columns({role: values})[role], len(edit))
    if role not in ("joint_position", "command_position"):
        return ~discrete
    hands = np.array([label in semantics.hands for label in selection.labels])
    return ~discrete & ~hands


def fix_signs(edit: EpisodeEdit, semantics: ColumnSemantics) -> EpisodeEdit:
    """Quaternions whose sign does not jump."""
    for role, values in edit.quantities(semantics).items():
        if not role.startswith("quaternion"):
            continue
        flips = (values[1:] * values[:-1]).sum(1) < 0
        if flips.any():
            sign = np.concatenate([[1.0], np.cumprod(np.where(flips, -1.0, 1.0))])
            change = f"fixed {flips.sum()} jumps of the sign of {role}: {flips.sum()} -> 0"
            edit = _with_quantity(edit, semantics, role, values * sign[:, None], change)
    return edit


def _turns(
    values: Float64[np.ndarray, "frames columns"],
) -> Float64[np.ndarray, "frames columns"]:
    """Whole turns by which each value has jumped since the first frame.

    A jump is one of whole turns only where what is left of it goes on with the motion before
    and after: a two-level signal of -3 and 3 leaves 0.28 rad out of rest, which is none.
    """
    steps = np.diff(values, axis=0)
    whole = np.rint(steps)
    left = np.abs(steps - whole)
    jumps = np.where(left < _MOST_LEFT, whole, 0.0)
    usual = np.where(whole == 0, np.abs(steps), 0.0)
    padded = np.pad(usual, ((_NEIGHBOURS, _NEIGHBOURS), (0, 0)))
    around = sliding_window_view(padded, 2 * _NEIGHBOURS + 1, axis=0).max(-1)
    # Three times the steps about it, and a thousandth of a turn for noise.
    jumps[left > 3 * around + 1e-3] = 0.0
    return np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(jumps, axis=0)])


def _with_quantity(
    edit: EpisodeEdit,
    semantics: ColumnSemantics,
    role: str,
    values: Float64[np.ndarray, "frames columns"],
    change: str | None,
) -> EpisodeEdit:
    columns: RawFrames = {}
    for number, (key, index) in enumerate(semantics.column_mapping.selections[role].columns):
        column = columns.setdefault(key, edit.frames[key].copy())
        column[:, index] = values[:, number]
    said = edit.changes if change is None else (*edit.changes, change)
    return replace(edit, frames=edit.frames | columns, changes=said)


# An episode at the frames of a regular grid.

_SMOOTH = ("joint_position", "joint_velocity", "position")


def resample_to_grid(
    edit: EpisodeEdit, semantics: ColumnSemantics, fps: float | int
) -> EpisodeEdit:
    """Resample every column, as `preprocessing.resample` does.

    Angles that jump by whole turns are interpolated without these, and jump again afterwards.
    Rotation vectors are interpolated as they are: unwrap them first.

    Raises:
        DatasetError: The stamps do not increase, or the episode is shorter than a period, or
            holds transforms, which cannot be interpolated by their entries.
    """
    source = edit
    edit, jumping = _without_turns(edit, semantics)
    quantities = edit.quantities(semantics)
    if "pose_matrix" in quantities:
        raise edit.bad(
            "holds poses as matrices, which are not resampled; map them away "
            "(mapping={'pose_matrix': None}) or leave the frames as they are (no fps)",
            key="pose_matrix",
        )
    fields: dict[str, Any] = {role: quantities[role] for role in _SMOOTH if role in quantities}
    role = next((role for role in quantities if role.startswith("quaternion")), "")
    try:
        if role:
            fields["orientation"] = to_quaternion(role, quantities[role])
        demo = Demonstration(
            time=edit.time - edit.time[0],
            joint_names=semantics.column_mapping.joint_names,
            fps=fps,
            extra={key: values.astype(float) for key, values in edit.frames.items()},
            **fields,
        )
        moved = resample(demo, fps)
    except ValueError as error:
        raise edit.bad(str(error)) from error
    columns: RawFrames = dict(moved.extra)
    for name in fields:
        values = getattr(moved, name)
        if name == "orientation" and role == "quaternion_xyzw":
            values = np.roll(values, -1, axis=1)
        taken = semantics.column_mapping.selections[
            role if name == "orientation" else name
        ].columns
        for number, (key, index) in enumerate(taken):
            columns[key][:, index] = values[:, number]
    for (key, index), (turn, middle) in jumping.items():
        column = columns[key][:, index]
        columns[key][:, index] = column - turn * np.rint((column - middle) / turn)
    nearest = nearest_frames(demo.time, np.minimum(moved.time, demo.time[-1]))
    hands = {
        column
        for role in ("joint_position", "gripper", "command_position")
        if role in semantics.column_mapping.selections
        for column, label in zip(
            semantics.column_mapping.selections[role].columns,
            semantics.column_mapping.selections[role].labels,
            strict=True,
        )
        if role == "gripper" or label in semantics.hands
    }
    profiles = profile_columns(source.frames)
    for key, values in source.frames.items():
        if values.dtype.kind not in "f":
            columns[key] = values[nearest]
            continue
        # What switches between levels takes none in between.
        kept = np.zeros(values.shape[1], dtype=bool)
        if key in profiles:
            kept |= is_discrete(profiles[key], len(edit))
        kept |= [(key, index) in hands for index in range(values.shape[1])]
        columns[key][:, kept] = values[nearest][:, kept]
    return replace(
        edit,
        frames=columns,
        time=moved.time + edit.time[0],
        kept=edit.kept[nearest],
        resampled=True,
        changes=(
            *edit.changes,
            f"resampled {len(edit)} frames to {len(moved)} at {fps:g} Hz",
        ),
    )


def _without_turns(
    edit: EpisodeEdit, semantics: ColumnSemantics
) -> tuple[EpisodeEdit, dict[tuple[str, int], tuple[float, float]]]:
    """Angles and commands without jumps by whole turns.

    Returns:
        The episode, and of each component that jumps a turn, and the middle of its range, in
        its unit.
    """
    quantities, jumping = edit.quantities(semantics), {}
    for role in (*_MEASURED_ANGLES, "command_position"):
        if role not in quantities:
            continue
        values = quantities[role]
        turn = _turn_of(values, semantics, role)
        turns = _turns(values / turn)
        if not turns.any():
            continue
        selection = semantics.column_mapping.selections[role]
        for k in np.flatnonzero(turns.any(0)):
            middle = float(values[:, k].min() + values[:, k].max()) / 2
            jumping[selection.columns[k]] = float(turn[k]), middle
        edit = _with_quantity(edit, semantics, role, values - turn * turns, None)
    return edit, jumping


def _turn_of(
    values: Float64[np.ndarray, "frames columns"], semantics: ColumnSemantics, role: str
) -> Float64[np.ndarray, " columns"]:
    """A whole turn in the unit of each component."""
    return 2 * np.pi / np.broadcast_to(semantics.units[role].factor, values.shape[1])


# Frames that a dataset is better without.

_PAUSE = 0.1
"""Longest time between two reports of a robot that moves [s]."""


def drop_bad_frames(
    edit: EpisodeEdit, semantics: ColumnSemantics, allowed: bool
) -> EpisodeEdit:
    """Without the frames that hold values that are not finite.

    Raises:
        DatasetError: There are some, and dropping them is not allowed; or too few are left.
    """
    bad = ~_finite(edit, semantics)
    if bad.any() and not allowed:
        raise edit.bad(
            f"holds values that are not finite in {bad.sum()} frames; drop those "
            f"(drop_bad_frames), or the episode (drop_bad_episodes)",
            frame=int(bad.argmax()),
        )
    return edit.only(~bad, f"dropped {bad.sum()} frames with values that are not finite")


def renew_stamps(edit: EpisodeEdit, fps: float) -> EpisodeEdit:
    """LeRobot's own stamps anew where they do not increase: they are frame / fps."""
    stalled = int((~(np.diff(edit.time) > 0)).sum())
    if not stalled:
        return edit
    change = f"made the stamps anew: {stalled} steps that did not increase -> 0"
    time = np.arange(len(edit)) / fps
    return replace(edit, time=time, changes=(*edit.changes, change))


def drop_late(edit: EpisodeEdit) -> EpisodeEdit:
    """Without the frames whose stamp is not later than all before.

    Raises:
        DatasetError: No two frames are left.
    """
    highest = np.maximum.accumulate(edit.time)
    later = np.concatenate([[True], edit.time[1:] > highest[:-1]])
    return edit.only(
        later,
        f"dropped {(~later).sum()} frames whose stamp does not increase: {len(edit)} -> "
        f"{later.sum()}",
    )


def drop_repeats(edit: EpisodeEdit) -> EpisodeEdit:
    """Without the frames that repeat the one before, because the robot reports more slowly.

    A frame whose command or whatever else differs is none. One repeated for longer than
    `_PAUSE` shows an arm that stands still; it stays.

    Raises:
        DatasetError: No two frames are left.
    """
    repeated = repeated_frames(edit.frames)
    for values in edit.frames.values():
        if not is_clock(values):
            repeated[1:] &= (values[1:] == values[:-1]).all(1)
    begin = np.maximum.accumulate(np.where(repeated, 0, np.arange(len(edit))))
    end = np.append(np.flatnonzero(~repeated)[1:], len(edit))[np.cumsum(~repeated) - 1] - 1
    repeated &= edit.time[end] - edit.time[begin] <= _PAUSE
    return edit.only(
        ~repeated,
        f"dropped {repeated.sum()} repeated frames: {len(edit)} -> {(~repeated).sum()}",
    )


def trim(edit: EpisodeEdit, semantics: ColumnSemantics, keep: float | int) -> EpisodeEdit:
    """Without standing still before and after the motion.

    Raises:
        DatasetError: The arm stands still all the time, or stamps do not increase.
    """
    quantities, units = edit.quantities(semantics), semantics.units
    role = next((r for r in ("joint_position", "position") if r in quantities), None)
    if role is None:
        return edit
    moving: dict[str, Any] = {role: quantities[role] * units[role].factor}
    names = semantics.column_mapping.joint_names if role == "joint_position" else ()
    try:
        demo = Demonstration(
            time=edit.time - edit.time[0],
            joint_names=names,
            fps=1.0,
            episode=edit.entry.index,
            extra={"frame": np.arange(len(edit), dtype=float)[:, None]},
            **moving,
        )
        left = trim_rest(demo, keep=keep).extra["frame"][:, 0].astype(int)
    except ValueError as error:
        raise edit.bad(str(error)) from error
    first, last = _while_all_rest(edit, int(left[0]), int(left[-1]))
    wanted = np.zeros(len(edit), dtype=bool)
    wanted[first : last + 1] = True
    lead = demo.time[first]
    tail = demo.time[-1] - demo.time[last]
    return edit.only(
        wanted,
        f"trimmed {lead:.2f} s at the beginning, {tail:.2f} s at the end: {len(edit)} -> "
        f"{wanted.sum()} frames",
    )


_RESTING = 0.01
"""Share of its range within which a value rests: beyond the noise of encoders."""


def _while_all_rest(edit: EpisodeEdit, first: int, last: int) -> tuple[int, int]:
    """First and last frame to keep, so that grippers, hands and commands rest in what goes."""
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


def _finite(edit: EpisodeEdit, semantics: ColumnSemantics) -> Bool[np.ndarray, " _frames"]:
    """Frames whose values all are; a feature that was not seen need not be."""
    finite = np.isfinite(edit.time)
    unseen = _unseen_columns(edit, semantics)
    for key, values in edit.frames.items():
        sound = np.isfinite(values.astype(float))
        for index, lost in unseen.get(key, ()):
            sound[lost, index] = True
        finite &= sound.all(1)
    return finite


def _unseen_columns(
    edit: EpisodeEdit, semantics: ColumnSemantics
) -> dict[str, list[tuple[int, Bool[np.ndarray, " frames"]]]]:
    selections = semantics.column_mapping.selections
    if not {"feature", "feature_visible"} <= selections.keys():
        return {}
    ((key, index),) = selections["feature_visible"].columns
    lost = ~(edit.frames[key][:, index] > 0)
    columns: dict[str, list] = {}
    for key, index in selections["feature"].columns:
        columns.setdefault(key, []).append((index, lost))
    return columns


# What a repair may change.


@dataclass(frozen=True, kw_only=True)
class RepairOptions:
    """What a repair may change. All of it happens in a copy."""

    trim: bool = True
    """Cut off standing still before and after the motion."""
    keep_rest: float | int = 0.1
    """Standing still that is left at either end [s]."""
    drop_late: bool = True
    """Drop frames that a column of true stamps has no later than the one before."""
    drop_repeats: bool = False
    """Drop frames that repeat the one before, commands and all, for up to 0.1 s."""
    unwrap: bool = True
    """Take whole turns out of measured joints and angles of the arm that jump by one."""
    unwrap_commands: bool = False
    """Do so to commands too, and to joints whose command jumps along."""
    fix_signs: bool = True
    """Choose the signs of quaternions so that they do not jump."""
    drop_bad_frames: bool = False
    """Drop frames with values that are not finite."""
    drop_bad_episodes: bool = False
    """Leave out episodes that cannot be read or repaired."""
    fps: float | int | None = None
    """Resample to a regular grid of this rate [1/s]; None leaves the frames as they are."""
    videos: bool = True
    """Keep the videos. Frames dropped in the middle and resampling would need new ones."""
    dry_run: bool = False
    """Only say what would be changed; nothing is written."""

    def __post_init__(self) -> None:
        if self.fps is not None and not self.fps > 0:
            raise ValueError(f"fps must be positive, got {self.fps}")
        if self.keep_rest < 0:
            raise ValueError(f"keep_rest must not be negative, got {self.keep_rest}")


# What a repair changed.


@dataclass(kw_only=True)
class RepairReport:
    """What became of each episode."""

    path: Path
    """The new dataset."""
    changes: dict[int, tuple[str, ...]] = field(default_factory=dict)
    """Index of an episode that was kept, in the old dataset -> what was changed."""
    left_out: dict[int, str] = field(default_factory=dict)
    """Index of an episode that was left out -> why."""
    notes: list[str] = field(default_factory=list)
    """What was changed in all."""
    frames_before: int = 0
    frames: int = 0
    """Frames of the new dataset."""
    dry_run: bool = False
    """Whether nothing was written."""

    @property
    def changed(self) -> int:
        """Episodes of which something was changed."""
        return sum(map(bool, self.changes.values()))

    def lines(self) -> Iterator[str]:
        yield from self.notes
        for new, (old, changes) in enumerate(self.changes.items()):
            name = f"episode {old}" if new == old else f"episode {old} (now {new})"
            yield f"{name}: {'; '.join(changes) or 'as it was'}"
        for old, reason in self.left_out.items():
            yield f"episode {old}: left out: {reason}"
        yield (
            f"{self.path}{' (nothing written)' * self.dry_run}: "
            f"{len(self.changes)} episodes, {self.frames} of "
            f"{self.frames_before} frames, {self.changed} episodes changed, "
            f"{len(self.left_out)} left out"
        )

    def __str__(self) -> str:
        return "\n".join(self.lines())
