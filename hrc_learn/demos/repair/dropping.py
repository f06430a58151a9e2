"""Frames that a dataset is better without."""

from typing import Any

import numpy as np
from jaxtyping import Bool

from ..checks.values import repeated_frames
from ..demonstration import Demonstration
from ..preparation import trim_rest
from .draft import Draft, Meaning

_PAUSE = 0.1
"""Longest time between two reports of a robot that moves [s]."""


def drop_bad_frames(draft: Draft, meaning: Meaning, allowed: bool) -> Draft:
    """Without the frames that hold values that are not finite.

    Raises:
        DatasetError: There are some, and dropping them is not allowed; or too few are left.
    """
    bad = ~_finite(draft, meaning)
    if bad.any() and not allowed:
        raise draft.bad(
            f"holds values that are not finite in {bad.sum()} frames; drop those "
            f"(drop_bad_frames), or the episode (drop_bad_episodes)",
            frame=int(bad.argmax()),
        )
    return draft.only(~bad, f"dropped {bad.sum()} frames with values that are not finite")


def drop_late(draft: Draft) -> Draft:
    """Without the frames whose stamp is not later than all before.

    Raises:
        DatasetError: No two frames are left.
    """
    highest = np.maximum.accumulate(draft.time)
    later = np.concatenate([[True], draft.time[1:] > highest[:-1]])
    return draft.only(later, f"dropped {(~later).sum()} frames whose stamp does not increase")


def drop_repeats(draft: Draft) -> Draft:
    """Without the frames that repeat the one before, because the robot reports more slowly.

    A frame repeated for longer than `_PAUSE` shows an arm that stands still; it stays.

    Raises:
        DatasetError: No two frames are left.
    """
    repeated = repeated_frames(draft.frames)
    begin = np.maximum.accumulate(np.where(repeated, 0, np.arange(len(draft))))
    end = np.append(np.flatnonzero(~repeated)[1:], len(draft))[np.cumsum(~repeated) - 1] - 1
    repeated &= draft.time[end] - draft.time[begin] <= _PAUSE
    return draft.only(~repeated, f"dropped {repeated.sum()} repeated frames")


def trim(draft: Draft, meaning: Meaning, keep: float | int) -> Draft:
    """Without standing still before and after the motion.

    Raises:
        DatasetError: The arm stands still all the time, or stamps do not increase.
    """
    quantities, units = draft.quantities(meaning), meaning.units
    role = next((r for r in ("joint_position", "position") if r in quantities), None)
    if role is None:
        return draft
    moving: dict[str, Any] = {role: quantities[role] * units[role].factor}
    names = meaning.matching.joint_names if role == "joint_position" else ()
    try:
        demo = Demonstration(
            time=draft.time - draft.time[0],
            joint_names=names,
            fps=1.0,
            episode=draft.entry.index,
            extra={"frame": np.arange(len(draft), dtype=float)[:, None]},
            **moving,
        )
        left = trim_rest(demo, keep=keep).extra["frame"][:, 0].astype(int)
    except ValueError as error:
        raise draft.bad(str(error)) from error
    wanted = np.zeros(len(draft), dtype=bool)
    wanted[left] = True
    lead = demo.time[left[0]]
    tail = demo.time[-1] - demo.time[left[-1]]
    return draft.only(wanted, f"trimmed {lead:.2f} s at the beginning, {tail:.2f} s at the end")


def _finite(draft: Draft, meaning: Meaning) -> Bool[np.ndarray, " _frames"]:
    """Frames whose values all are; a feature that was not seen need not be."""
    finite = np.isfinite(draft.time)
    unseen = _unseen_columns(draft, meaning)
    for key, values in draft.frames.items():
        sound = np.isfinite(values.astype(float))
        for index, lost in unseen.get(key, ()):
            sound[lost, index] = True
        finite &= sound.all(1)
    return finite


def _unseen_columns(
    draft: Draft, meaning: Meaning
) -> dict[str, list[tuple[int, Bool[np.ndarray, " frames"]]]]:
    selections = meaning.matching.selections
    if not {"feature", "feature_visible"} <= selections.keys():
        return {}
    ((key, index),) = selections["feature_visible"].columns
    lost = ~(draft.frames[key][:, index] > 0)
    columns: dict[str, list] = {}
    for key, index in selections["feature"].columns:
        columns.setdefault(key, []).append((index, lost))
    return columns
