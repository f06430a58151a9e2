"""Edits that remove frames of an episode: late, repeated, faulty, or at rest at the ends."""

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64, Int64

from hrc_learn.demos.demonstration import Demonstration
from hrc_learn.demos.format.dataset_folder import EpisodeEntry
from hrc_learn.demos.issues import DatasetError
from hrc_learn.demos.preprocessing import trim_rest
from hrc_learn.demos.quality.episode_checks import is_clock, repeated_frames
from hrc_learn.demos.read.columns import ColumnSelection
from hrc_learn.demos.read.frames import RawFrames, select_quantities
from hrc_learn.demos.read.quantities import is_hand
from hrc_learn.demos.read.source import OpenedDataset
from hrc_learn.demos.read.units import Quantities, UnitDecision

_PAUSE = 0.1
"""Longest time between two reports of a moving robot [s]."""
_RESTING = 0.01
"""Fraction of its range within which a value rests: more than the noise of encoders."""


@dataclass(frozen=True, kw_only=True)
class ColumnSemantics:
    """Meaning and units of the columns of a dataset."""

    dataset: OpenedDataset
    units: dict[str, UnitDecision]
    bad: dict[int | None, DatasetError] = field(default_factory=dict)
    """Episodes that contradict the units of the others."""

    @property
    def selections(self) -> dict[str, ColumnSelection]:
        """Columns by role."""
        return self.dataset.columns.selections

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the joints."""
        return self.dataset.columns.joint_names

    def turn(self, role: str) -> Float64[np.ndarray, " components"]:
        """A full turn in the unit of each component."""
        width = len(self.selections[role].columns)
        return 2 * np.pi / np.broadcast_to(self.units[role].factor, width)

    def hand_columns(self) -> set[tuple[str, int]]:
        """Columns of grippers and fingers, positions and commands."""
        return {
            column
            for role in ("joint_position", "gripper", "command_position")
            if role in self.selections
            for column, label in zip(
                self.selections[role].columns, self.selections[role].labels, strict=True
            )
            if role == "gripper" or (label in self.joint_names and is_hand(label))
        }


@dataclass(frozen=True, kw_only=True)
class EpisodeEdit:
    """One episode during its repair."""

    entry: EpisodeEntry
    """Entry in the old dataset."""
    frames: RawFrames
    """Columns to be written; of LeRobot's own, only `task_index`."""
    time: Float64[np.ndarray, " _frames"]
    """True stamps if there are any, LeRobot's otherwise [s]."""
    kept: Int64[np.ndarray, " _frames"]
    """Frame of the old episode; the nearest one after resampling."""
    resampled: bool = False
    changes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.time)

    def quantities(self, semantics: ColumnSemantics) -> Quantities:
        """Quantities in the units on disk."""
        return select_quantities(self.frames, semantics.selections)

    def only(self, wanted: Bool[np.ndarray, " _frames"], change: str) -> "EpisodeEdit":
        """The wanted frames alone.

        Raises:
            DatasetError: Fewer than two frames would be left.
        """
        if wanted.all():
            return self
        if wanted.sum() < 2:
            raise self.fault(f"{change}: no two frames are left")
        return replace(
            self,
            frames={key: values[wanted] for key, values in self.frames.items()},
            time=self.time[wanted],
            kept=self.kept[wanted],
            changes=(*self.changes, change),
        )

    def with_quantity(
        self,
        selection: ColumnSelection,
        values: Float64[np.ndarray, "frames columns"],
        change: str | None = None,
    ) -> "EpisodeEdit":
        """The episode with other values of a quantity, in the unit on disk."""
        columns: RawFrames = {}
        for number, (key, index) in enumerate(selection.columns):
            column = columns.setdefault(key, self.frames[key].copy())
            column[:, index] = values[:, number]
        changes = self.changes if change is None else (*self.changes, change)
        return replace(self, frames=self.frames | columns, changes=changes)

    def fault(
        self, message: str, frame: int | None = None, key: str | None = None
    ) -> DatasetError:
        """An error that names the episode, and the frame of the old dataset."""
        original = None if frame is None or self.resampled else int(self.kept[frame])
        return self.entry.error(message, frame=original, key=key)


def renew_stamps(edit: EpisodeEdit, fps: float) -> EpisodeEdit:
    """Replace LeRobot's own stamps if they do not increase: they are frame / fps."""
    stalled = int((~(np.diff(edit.time) > 0)).sum())
    if not stalled:
        return edit
    change = f"renewed the stamps: {stalled} steps that did not increase -> 0"
    time = np.arange(len(edit)) / fps
    return replace(edit, time=time, changes=(*edit.changes, change))


def drop_bad_frames(
    edit: EpisodeEdit, semantics: ColumnSemantics, allowed: bool
) -> EpisodeEdit:
    """Drop the frames with values that are not finite.

    Raises:
        DatasetError: There are such frames and `allowed` is False, or too few are left.
    """
    bad = ~_finite(edit, semantics)
    if bad.any() and not allowed:
        raise edit.fault(
            f"holds values that are not finite in {bad.sum()} frames; drop those "
            f"(drop_bad_frames), or the episode (drop_bad_episodes)",
            frame=int(bad.argmax()),
        )
    return edit.only(~bad, f"dropped {bad.sum()} frames with values that are not finite")


def _finite(edit: EpisodeEdit, semantics: ColumnSemantics) -> Bool[np.ndarray, " _frames"]:
    """Mask of finite frames; a feature that was not visible need not be finite."""
    selections, feature = semantics.selections, set()
    hidden = np.zeros(len(edit), dtype=bool)
    if {"feature", "feature_visible"} <= selections.keys():
        ((key, index),) = selections["feature_visible"].columns
        hidden = ~(edit.frames[key][:, index] > 0)
        feature = {*selections["feature"].columns}
    finite = np.isfinite(edit.time)
    for key, values in edit.frames.items():
        sound = np.isfinite(values.astype(float))
        for index in range(values.shape[1]):
            if (key, index) in feature:
                sound[hidden, index] = True
        finite &= sound.all(1)
    return finite


def drop_late(edit: EpisodeEdit) -> EpisodeEdit:
    """Drop the frames whose stamp is not later than all before.

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
    """Drop the frames that repeat the previous one because the robot reports more slowly.

    A frame with a different command, or any other difference, stays. Repetitions that last
    longer than `_PAUSE` show an arm at rest, and stay too.

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
    """Trim the rest before and after the motion.

    Args:
        edit: The episode.
        semantics: Meaning of its columns.
        keep: Rest left at either end [s].

    Raises:
        DatasetError: The arm never moves, or the stamps do not increase.
    """
    quantities, units = edit.quantities(semantics), semantics.units
    role = next((r for r in ("joint_position", "position") if r in quantities), None)
    if role is None:
        return edit
    moving: dict[str, Any] = {role: quantities[role] * units[role].factor}
    try:
        demo = Demonstration(
            time=edit.time - edit.time[0],
            joint_names=semantics.joint_names if role == "joint_position" else (),
            fps=1.0,
            episode=edit.entry.index,
            extra={"frame": np.arange(len(edit), dtype=float)[:, None]},
            **moving,
        )
        left = trim_rest(demo, keep=keep).extra["frame"][:, 0].astype(int)
    except ValueError as error:
        raise edit.fault(str(error)) from error
    first, last = _while_all_rest(edit, int(left[0]), int(left[-1]))
    wanted = np.zeros(len(edit), dtype=bool)
    wanted[first : last + 1] = True
    lead, tail = demo.time[first], demo.time[-1] - demo.time[last]
    return edit.only(
        wanted,
        f"trimmed {lead:.2f} s at the beginning, {tail:.2f} s at the end: {len(edit)} -> "
        f"{wanted.sum()} frames",
    )


def _while_all_rest(edit: EpisodeEdit, first: int, last: int) -> tuple[int, int]:
    """First and last frame to keep, such that grippers, hands and commands rest outside."""
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
