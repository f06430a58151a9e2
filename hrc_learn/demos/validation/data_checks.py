"""Oddities of the data: single values and columns, the motion, the timestamps."""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Bool, Float64

from hrc_learn.demos.format.dataset_folder import DatasetFolder, EpisodeEntry
from hrc_learn.demos.format.metadata import Feature
from hrc_learn.demos.issue import ValidationReport
from hrc_learn.demos.read.frames import RawFrames
from hrc_learn.demos.read.roles import INDEX_KEYS

# Faults of single values and columns.

_SATURATED = 0.25
"""Share of the frames from which a component that sits at an end of its range is odd."""
_REPEATED = 0.05
"""Share of repeated frames that is put up with."""


def check_finite(
    features: Mapping[str, Feature],
    entry: EpisodeEntry,
    frames: RawFrames,
    report: ValidationReport,
) -> None:
    """Every number is one."""
    for key, values in frames.items():
        bad = np.argwhere(~np.isfinite(values.astype(float)))
        if len(bad):
            frame, component = (int(i) for i in bad[0])
            name = component_name(features.get(key), component)
            report.error(
                f"{name} is {values[frame, component]} ({len(bad)} values are not finite); "
                f"hrc repair --drop-bad-frames (or --drop-bad-episodes) makes a copy "
                f"without",
                **entry.location,
                frame=frame,
                key=key,
            )


def check_repeats(entry: EpisodeEntry, frames: RawFrames, report: ValidationReport) -> None:
    """Frames that are copies of the one before: the robot was read too seldom, or stood."""
    if entry.length < 3:
        return
    same = repeated_frames(frames)[1:]
    if same.all():
        report.warning(
            "the state never changes: the recorder lost the robot",
            **entry.location,
            frame=0,
            key="observation.state",
        )
    elif same.mean() > _REPEATED:
        report.warning(
            f"{100 * same.mean():.0f} % of the frames repeat the one before; the recording is "
            f"faster than the robot reports, or the robot stood still; hrc repair drops "
            f"them",
            **entry.location,
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
    folder: DatasetFolder,
    episodes: Sequence[tuple[EpisodeEntry, RawFrames]],
    report: ValidationReport,
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


# Oddities of the motion itself, once columns are known for what they mean.

_FASTEST_ARM = 12.0
"""No joint of an arm turns faster [rad/s]; quicker steps are faults of the recording."""
_STILL_SECONDS = 1.0
"""Longest rest at an end that is no oddity."""
_SAME_EPISODE = 1e-3

Joints = Float64[np.ndarray, "frames joints"]
Times = Float64[np.ndarray, " frames"]


def check_jumps(
    entry: EpisodeEntry,
    time: Times,
    joint_position: Joints,
    joint_names: Sequence[str],
    speed_limits: Mapping[str, float | int],
    report: ValidationReport,
) -> None:
    """Steps no joint can make: lost frames, glitches, encoders that wrapped."""
    change = np.diff(joint_position, axis=0)
    speed = np.abs(change) / np.diff(time)[:, None]
    limits = np.array([speed_limits.get(name, _FASTEST_ARM) for name in joint_names])
    too_fast = speed > limits
    if not too_fast.any():
        return
    frame = int(too_fast.any(1).argmax())
    joint = int((speed[frame] / limits).argmax())
    step = change[frame, joint]
    # As far from a turn as what moves in a frame.
    wrapped = abs(abs(step) - 2 * np.pi) < 0.3
    cause = (
        "the encoder wrapped: hrc repair unwraps it"
        if wrapped
        else "a glitch, or frames were lost: look at it, or leave the episode out"
    )
    report.warning(
        f"{joint_names[joint]} jumps by {step:.3g} rad in one frame "
        f"({speed[frame, joint]:.3g} rad/s, limit {limits[joint]:.3g}); {cause}. "
        f"{int(too_fast.any(1).sum())} such frames in the episode",
        **entry.location,
        frame=frame + 1,
        key=f"joint_position ({joint_names[joint]})",
    )


def check_stillness(
    entry: EpisodeEntry,
    time: Times,
    motion: Float64[np.ndarray, "frames _"],
    report: ValidationReport,
) -> None:
    """Waiting before or after the motion, which a fit would reproduce."""
    span = float(np.ptp(motion, axis=0).max())
    if span == 0:
        return  # reported as a state that never changes
    # Half a percent of the motion: beyond the noise of encoders.
    away = np.abs(motion - motion[0]).max(1) > 0.005 * span
    not_there = np.abs(motion - motion[-1]).max(1) > 0.005 * span
    lead = float(time[away.argmax()] - time[0])
    tail = float(time[-1] - time[len(time) - 1 - not_there[::-1].argmax()])
    for place, seconds, frame in (
        ("begins", lead, 0),
        ("ends", tail, len(time) - 1 - int(not_there[::-1].argmax())),
    ):
        if seconds > _STILL_SECONDS:
            report.warning(
                f"{place} with {seconds:.1f} s of standing still: hrc repair trims it",
                **entry.location,
                frame=frame,
            )


def check_commands(
    entry: EpisodeEntry, joint_position: Joints, command: Joints, report: ValidationReport
) -> None:
    """Actions that are the state over again teach a policy to stand still."""
    if joint_position.shape == command.shape and np.array_equal(joint_position, command):
        report.warning(
            "is a copy of the state at the same frame; a policy learns to stay where it is",
            **entry.location,
            key="action",
        )


def check_duplicates(
    episodes: Sequence[tuple[EpisodeEntry, Float64[np.ndarray, "_frames _"]]],
    report: ValidationReport,
) -> None:
    """Episodes that show the same motion to within a thousandth of its span."""
    seen: list[tuple[EpisodeEntry, np.ndarray]] = []
    for entry, motion in episodes:
        sketch = motion[np.linspace(0, len(motion) - 1, 20).round().astype(int)]
        span = float(np.ptp(motion, axis=0).max())
        for earlier, other in seen:
            close = abs(earlier.length - entry.length) <= 0.02 * entry.length
            if close and span and np.abs(sketch - other).max() < _SAME_EPISODE * span:
                report.warning(
                    f"shows the same motion as episode {earlier.index}: recorded once, "
                    f"stored twice?",
                    **entry.location,
                )
                break
        seen.append((entry, sketch))


# Oddities of the stamps.

_RATE_TOLERANCE = 0.05
_JITTER_TOLERANCE = 0.10
_GAP = 1.6
"""Steps longer than this many usual ones have lost a frame between them."""
# Less is a start that was broken off.
_SHORT_FRAMES = 10
_SHORT_SECONDS = 0.5


def check_timestamps(
    entry: EpisodeEntry,
    key: str,
    time: Float64[np.ndarray, " frames"],
    fps: float,
    report: ValidationReport,
) -> None:
    """Order, rate, regularity and gaps of the stamps [s] of one episode."""
    place = entry.location | {"key": key}
    if not np.isfinite(time).all():
        return  # reported with the values that are not finite
    steps = np.diff(time)
    if not len(steps):
        return
    stalled = np.flatnonzero(steps <= 0)
    if len(stalled):
        k = int(stalled[0])
        report.error(
            f"stamps must increase, but go from {time[k]:.6f} s to {time[k + 1]:.6f} s "
            f"({len(stalled)} times); hrc repair drops the repeated "
            f"frames",
            frame=k + 1,
            **place,
        )
        return
    usual = float(np.median(steps))
    if abs(usual * fps - 1) > _RATE_TOLERANCE:
        report.warning(
            f"frames are {1e3 * usual:.4g} ms apart ({1 / usual:.4g} Hz), but fps says "
            f"{fps:g}; hrc repair --fps {round(1 / usual)} resamples to the true rate",
            **place,
        )
    gaps = np.flatnonzero(steps > _GAP * usual)
    if len(gaps):
        lost = int(np.rint(steps[gaps] / usual - 1).sum())
        report.warning(
            f"{len(gaps)} gaps, about {lost} frames lost; the first is "
            f"{1e3 * steps[gaps[0]]:.4g} ms long; hrc repair --fps {fps:g} fills them "
            f"in",
            frame=int(gaps[0]) + 1,
            **place,
        )
    jitter = float(np.quantile(np.abs(np.delete(steps, gaps) - usual), 0.95)) / usual
    if jitter > _JITTER_TOLERANCE:
        report.warning(
            f"steps vary by {100 * jitter:.0f} % (95th percentile); hrc repair "
            f"--fps {fps:g} resamples",
            **place,
        )


def check_length(entry: EpisodeEntry, fps: float, report: ValidationReport) -> None:
    """Episodes too short to be a demonstration."""
    seconds = entry.length / fps
    if entry.length < _SHORT_FRAMES or seconds < _SHORT_SECONDS:
        report.warning(
            f"only {entry.length} frames ({seconds:.2g} s): a false start?",
            **entry.location,
        )
