"""Oddities of the data: single values and columns, the motion, the timestamps."""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Bool, Float64, Shaped

from hrc_learn.demos.format.dataset_folder import DatasetFolder, EpisodeEntry
from hrc_learn.demos.format.metadata import Feature
from hrc_learn.demos.issue import ValidationReport
from hrc_learn.demos.read.frames import RawFrames
from hrc_learn.demos.read.roles import INDEX_KEYS, is_hand

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
    state = [v for v in state if not is_clock(v)]
    if not state or length < 2:
        return np.zeros(length, dtype=bool)
    same = np.logical_and.reduce([(v[1:] == v[:-1]).all(1) for v in state])
    return np.concatenate([[False], same])


class ColumnSummary:
    """What the values of one feature reach, gathered episode by episode."""

    def __init__(self) -> None:
        self.count = 0
        self.finite = True
        self.low = self.high = self.total = np.zeros(0)
        self._at_low = self._at_high = np.zeros(0)

    def add(self, values: Shaped[np.ndarray, "frames components"]) -> None:
        """Take an episode into account."""
        if not len(values) or not self.finite:
            return
        values = values.astype(float)
        if not np.isfinite(values).all() or (self.count and values.shape[1] != len(self.low)):
            self.finite = False
            return
        low, high = values.min(0), values.max(0)
        at_low, at_high = (values == low).sum(0), (values == high).sum(0)
        if not self.count:
            self.low, self.high, self.total = low, high, values.sum(0)
            self._at_low, self._at_high = at_low, at_high
        else:
            self._at_low = _joined(low, self.low, at_low, self._at_low)
            self._at_high = _joined(-high, -self.high, at_high, self._at_high)
            self.low, self.high = np.minimum(low, self.low), np.maximum(high, self.high)
            self.total = self.total + values.sum(0)
        self.count += len(values)

    @property
    def at_end(self) -> Float64[np.ndarray, " components"]:
        """Share of the frames in which each component sits at the end it sits at more."""
        return np.maximum(self._at_low, self._at_high) / max(self.count, 1)

    @property
    def binary(self) -> Bool[np.ndarray, " components"]:
        """Components with two values, such as a gripper that is open or closed."""
        return self._at_low + self._at_high >= self.count


def _joined(
    end: np.ndarray, other: np.ndarray, count: np.ndarray, others: np.ndarray
) -> np.ndarray:
    """How many values sit at the lower of two ends."""
    return np.where(end < other, count, np.where(end > other, others, count + others))


def check_columns(
    folder: DatasetFolder, columns: Mapping[str, ColumnSummary], report: ValidationReport
) -> None:
    """Components that never change, or that sit at an end of their range."""
    for key in sorted({*columns} - {*INDEX_KEYS}):
        summary, feature = columns[key], folder.features.get(key)
        if not summary.count or not summary.finite:
            continue
        constant = summary.low == summary.high
        if constant.any():
            report.warning(f"never changes: {_names(feature, constant)}", key=key)
        at_end = summary.at_end
        saturated = (at_end > _SATURATED) & ~constant & ~summary.binary
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


def is_clock(values: np.ndarray) -> bool:
    """Whether a column only ever counts up, frame by frame."""
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
    # Fingers are faster, and often counted in units of their own.
    usual = {name: np.inf if is_hand(name) else _FASTEST_ARM for name in joint_names}
    limits = np.array([speed_limits.get(name, usual[name]) for name in joint_names])
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
        names=(joint_names[joint],),
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


_EMPTY = 1e-4
"""Motion below which nothing was shown [rad or m]: less than encoders and trackers see."""


def check_motion(
    entry: EpisodeEntry, motion: Float64[np.ndarray, "frames _"], report: ValidationReport
) -> None:
    """Demonstrations that show nothing: no primitive can be fitted to them."""
    span = float(np.ptp(motion, axis=0).max())
    if span < _EMPTY:
        report.error(
            f"moves by {span:.2g} in all: nothing was demonstrated; leave the episode out",
            **entry.location,
        )


# A spike is so many times a usual fast step, and such a part of the usual range.
_SPIKE, _SPIKE_SHARE, _JUMP, _JUMP_SHARE = 4.0, 0.03, 8.0, 0.1
_LEAST_SPIKE, _LEAST_JUMP = 0.03, 0.1
"""Smaller ones are noise [rad]."""


def check_spikes(
    entry: EpisodeEntry,
    role: str,
    values: Joints,
    names: Sequence[str],
    step: Float64[np.ndarray, " joints"],
    span: Float64[np.ndarray, " joints"],
    report: ValidationReport,
) -> None:
    """Frames out of line with both neighbours, and steps far beyond those usual here.

    Args:
        entry: The episode.
        role: What the values are.
        values: Positions of joints, or of their commands.
        names: Of the joints.
        step: Usual fast step of each (one in a hundred is above).
        span: Usual range of each.
        report: Receives what is found.
    """
    steps = np.diff(values, axis=0)
    bound = np.maximum(_SPIKE * step, _SPIKE_SHARE * span) + _LEAST_SPIKE
    moves = (step > 0) & (step < 0.2 * span)  # others switch between levels
    there, back = steps[:-1], steps[1:]
    opposite = there * back < 0
    spike = opposite & (np.minimum(np.abs(there), np.abs(back)) > bound) & moves
    jump = (np.abs(steps) > np.maximum(_JUMP * step, _JUMP_SHARE * span) + _LEAST_JUMP) & moves
    jump[:-1] &= ~spike
    jump[1:] &= ~spike
    for odd, what, offset in ((spike, "leaps away for one frame", 1), (jump, "jumps", 1)):
        if not odd.any():
            continue
        size = np.where(odd, np.abs(steps[: len(odd)]) / np.maximum(step, 1e-9), 0.0)
        frame, joint = (int(i) for i in np.unravel_index(int(size.argmax()), size.shape))
        report.warning(
            f"{names[joint]} {what} by {steps[frame, joint]:.3g}, "
            f"{size[frame, joint]:.0f} times its usual fast step; {int(odd.any(1).sum())} such "
            f"frames in the episode",
            **entry.location,
            frame=int(frame) + offset,
            key=f"{role} ({names[joint]})",
            names=(names[joint],),
            severity=float(size.max()),
        )


def check_frozen(
    entry: EpisodeEntry,
    joints: Joints,
    command: Joints,
    names: Sequence[str],
    span: Float64[np.ndarray, " joints"],
    report: ValidationReport,
) -> None:
    """Joints that stay exactly where they are while their command goes elsewhere.

    Not those of hands: a finger at an object does so too.
    """
    if joints.shape != command.shape or len(joints) < 20:
        return
    arm = np.array([not is_hand(name) for name in names])
    for joint in np.flatnonzero((span > 0) & arm):
        moves = np.flatnonzero(np.diff(joints[:, joint]) != 0)
        edges = np.concatenate([[-1], moves, [len(joints) - 1]])
        longest = int(np.diff(edges).argmax())
        first, last = int(edges[longest]) + 1, int(edges[longest + 1])
        if last - first < 10:
            continue
        asked = float(np.ptp(command[first : last + 1, joint]))
        if asked > 0.25 * span[joint] and asked > 0.02:
            report.warning(
                f"{names[joint]} stays exactly the same for {last - first} frames while its "
                f"command moves by {asked:.3g}: the encoder froze?",
                **entry.location,
                frame=first,
                key=f"joint_position ({names[joint]})",
                names=(names[joint],),
                severity=asked,
            )


class Duplicates:
    """Episodes that show the same motion, at any pace, to within a thousandth of its span."""

    def __init__(self) -> None:
        self._entries: list[EpisodeEntry] = []
        self._sketches: list[np.ndarray] = []
        self._spans: list[float] = []

    def add(self, entry: EpisodeEntry, motion: Float64[np.ndarray, "frames _"]) -> None:
        """Remember 20 moments of an episode."""
        places = np.linspace(0, len(motion) - 1, 20)
        before = places.astype(int)
        share = (places - before)[:, None]
        after = np.minimum(before + 1, len(motion) - 1)
        sketch = (1 - share) * motion[before] + share * motion[after]
        self._entries.append(entry)
        self._sketches.append(sketch.reshape(-1))
        self._spans.append(float(np.ptp(motion, axis=0).max()))

    def report(self, report: ValidationReport) -> None:
        """Tell those that are the same as an earlier one."""
        from scipy.spatial import KDTree

        if len({sketch.shape for sketch in self._sketches}) != 1:
            return
        tree = KDTree(np.stack(self._sketches))
        for number, (entry, span) in enumerate(zip(self._entries, self._spans, strict=True)):
            radius = _SAME_EPISODE * span
            close = tree.query_ball_point(self._sketches[number], radius, p=np.inf)
            for other in sorted(close):
                earlier = self._entries[other]
                if other < number and span:
                    report.warning(
                        f"shows the same motion as episode {earlier.index}: recorded once, "
                        f"stored twice?",
                        **entry.location,
                    )
                    break


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
    if key == "timestamp" and abs(time[0]) > 0.5 / fps:
        report.warning(
            f"begins at {time[0]:.6g} s, not at 0: LeRobot's stamps count from the start of "
            f"the episode",
            frame=0,
            **place,
        )
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
