"""Faults of single values and columns."""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Bool

from ..features import Feature
from ..frames import RawFrames
from ..layout import DatasetFolder, EpisodeEntry
from ..roles import INDEX_KEYS
from .report import Report

_SATURATED = 0.25
_REPEATED = 0.05


def check_finite(
    features: Mapping[str, Feature], entry: EpisodeEntry, frames: RawFrames, report: Report
) -> None:
    """Every number is one."""
    for key, values in frames.items():
        bad = np.argwhere(~np.isfinite(values.astype(float)))
        if len(bad):
            frame, component = (int(i) for i in bad[0])
            name = component_name(features.get(key), component)
            report.error(
                f"{name} is {values[frame, component]} ({len(bad)} values are not finite); "
                f"repair_dataset.py --drop-bad-frames (or --drop-bad-episodes) makes a copy "
                f"without",
                file=entry.file,
                episode=entry.index,
                frame=frame,
                key=key,
            )


def check_repeats(entry: EpisodeEntry, frames: RawFrames, report: Report) -> None:
    """Frames that are copies of the one before: the robot was read too seldom, or stood."""
    if entry.length < 3:
        return
    same = repeated_frames(frames)[1:]
    if same.all():
        report.warning(
            "the state never changes: the recorder lost the robot",
            file=entry.file,
            episode=entry.index,
            frame=0,
            key="observation.state",
        )
    elif same.mean() > _REPEATED:
        report.warning(
            f"{100 * same.mean():.0f} % of the frames repeat the one before; the recording is "
            f"faster than the robot reports, or the robot stood still; repair_dataset.py drops "
            f"them",
            file=entry.file,
            episode=entry.index,
            frame=int(same.argmax()) + 1,
        )


def repeated_frames(frames: RawFrames) -> Bool[np.ndarray, " frames"]:
    """Frames whose observations are all those of the frame before, clocks left aside."""
    length = len(next(iter(frames.values())))
    state = [v for key, v in frames.items() if key.startswith("observation.")]
    state = [v for v in state if not _is_clock(v)]
    if not state or length < 2:
        return np.zeros(length, dtype=bool)
    same = np.logical_and.reduce([(v[1:] == v[:-1]).all(1) for v in state])
    return np.concatenate([[False], same])


def check_columns(
    folder: DatasetFolder, episodes: Sequence[tuple[EpisodeEntry, RawFrames]], report: Report
) -> None:
    """Components that never change, or that sit at an end of their range."""
    keys = {key for _, frames in episodes for key in frames} - {*INDEX_KEYS}
    for key in sorted(keys):
        values = np.concatenate([frames[key] for _, frames in episodes if key in frames])
        if not len(values) or not np.isfinite(values.astype(float)).all():
            continue
        low, high = values.min(0), values.max(0)
        constant = low == high
        feature = folder.features.get(key)
        if constant.any():
            report.warning(f"never changes: {_names(feature, constant)}", key=key)
        at_end = np.maximum((values == low).mean(0), (values == high).mean(0))
        saturated = (at_end > _SATURATED) & ~constant & ~_binary(values)
        if saturated.any() and key.startswith(("observation.state", "action", "state")):
            report.warning(
                f"sits at an end of its range for up to {100 * at_end[saturated].max():.0f} % "
                f"of the frames: {_names(feature, saturated)}",
                key=key,
            )


def component_name(feature: Feature | None, index: int) -> str:
    """Name of a component, its number where it has none."""
    if feature is None or feature.names is None:
        return f"component {index}"
    return feature.names[index]


def _names(feature: Feature | None, chosen: np.ndarray) -> str:
    if chosen.all():
        return "all components" if len(chosen) > 1 else component_name(feature, 0)
    return ", ".join(component_name(feature, int(i)) for i in np.flatnonzero(chosen))


def _binary(values: np.ndarray) -> np.ndarray:
    """Components with two values, such as a flag or a gripper that is open or closed."""
    return ((values == values.min(0)) | (values == values.max(0))).all(0)


def _is_clock(values: np.ndarray) -> bool:
    return values.shape[1] == 1 and bool((np.diff(values[:, 0]) > 0).all())
