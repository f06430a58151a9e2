"""Checks of single episodes: values, stamps and motion."""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from jaxtyping import Bool, Float64

from hrc_learn.demos.demonstration import Demonstration
from hrc_learn.demos.issues import Issue
from hrc_learn.demos.read.dataset_folder import DatasetFolder, EpisodeEntry
from hrc_learn.demos.read.frames import RawFrames
from hrc_learn.demos.read.naming import is_hand
from hrc_learn.demos.read.units import Quantities

_REPEATED = 0.05
"""Tolerated fraction of repeated frames."""
_RATE_TOLERANCE = 0.05
_JITTER_TOLERANCE = 0.10
_REGULAR = 0.04
_GAP = 1.6
"""Multiple of the usual step above which a frame was lost."""
# Episodes with fewer frames or seconds are false starts.
_SHORT_FRAMES, _SHORT_SECONDS = 10, 0.5
_FASTEST_ARM = 12.0
"""Largest joint speed of an arm [rad/s]; faster steps are faults of the recording."""
_ALIKE = 0.8
"""Correlation above which two motions are the same, apart from their scale."""
_STILL_SECONDS = 1.0
"""Longest rest before or after the motion that is not reported [s]."""
_SMALLEST_MOTION = 1e-4
"""Smallest motion [rad or m]; encoders and trackers do not resolve smaller ones."""
_SAME_EPISODE = 1e-3
"""Largest difference of two copies of an episode, relative to the span of the motion."""
# Smallest spikes and jumps: multiples of the usual fast step, and fractions of the usual range.
# A spike or jump must reach both.
_SPIKE, _SPIKE_FRACTION, _JUMP, _JUMP_FRACTION = 4.0, 0.03, 8.0, 0.1
_LEAST_SPIKE, _LEAST_JUMP = 0.03, 0.1
"""Allowances for noise [rad], which are added to these smallest sizes."""


def finite_values(
    folder: DatasetFolder, entry: EpisodeEntry, frames: RawFrames
) -> Iterator[Issue]:
    """Check that all values are finite."""
    for key, values in frames.items():
        # If the sum is finite, all values are. The sum is far cheaper than a mask.
        if np.isfinite(values.sum(dtype=float)):
            continue
        bad = np.argwhere(~np.isfinite(values.astype(float)))
        if len(bad):
            frame, component = (int(i) for i in bad[0])
            text = (
                f"{folder.features[key].component(component)} is {values[frame, component]} "
                f"({len(bad)} values are not finite); hrc repair --drop bad-frames (or "
                f"bad-episodes) makes a copy without them"
            )
            yield entry.fault(text, frame=frame, key=key)


def repetitions(
    folder: DatasetFolder, entry: EpisodeEntry, frames: RawFrames
) -> Iterator[Issue]:
    """Report frames that equal the previous one: the robot is read too fast or stands still."""
    if entry.length < 3:
        return
    same = repeated_frames(frames)[1:]
    if same.all():
        text = "the state never changes: the recorder lost the robot"
        yield entry.warning(text, frame=0, key="observation.state")
    elif same.mean() > _REPEATED:
        yield entry.warning(
            f"{100 * same.mean():.0f} % of the frames repeat the one before: the robot reports "
            f"more slowly than it is recorded, or stood still; hrc repair --drop repeats "
            f"removes them",
            frame=int(same.argmax()) + 1,
        )


def repeated_frames(frames: RawFrames) -> Bool[np.ndarray, " frames"]:
    """Mask of frames whose observations equal the previous ones, clocks excepted."""
    length = len(next(iter(frames.values())))
    state = [v for key, v in frames.items() if key.startswith("observation.")]
    state = [v for v in state if not is_clock(v)]
    if not state or length < 2:
        return np.zeros(length, dtype=bool)
    same = np.logical_and.reduce([(v[1:] == v[:-1]).all(1) for v in state])
    return np.concatenate([[False], same])


def is_clock(values: np.ndarray) -> bool:
    """True for a single component that increases with every frame."""
    return values.shape[1] == 1 and bool((np.diff(values[:, 0]) > 0).all())


def episode_length(
    folder: DatasetFolder, entry: EpisodeEntry, frames: RawFrames
) -> Iterator[Issue]:
    """Report episodes that are too short for a demonstration."""
    seconds = entry.length / folder.fps
    if entry.length < _SHORT_FRAMES or seconds < _SHORT_SECONDS:
        yield entry.warning(f"only {entry.length} frames ({seconds:.2g} s): a false start?")


def recorded_stamps(
    folder: DatasetFolder, entry: EpisodeEntry, frames: RawFrames
) -> Iterator[Issue]:
    """Check LeRobot's own time stamps."""
    if "timestamp" in frames:
        time = frames["timestamp"][:, 0].astype(float)
        yield from stamps(entry, "timestamp", time, folder.fps)


def stamps(
    entry: EpisodeEntry, key: str, time: Float64[np.ndarray, " frames"], fps: float
) -> Iterator[Issue]:
    """Check time stamps [s]: order, offset, rate, gaps and jitter."""
    steps = np.diff(time)
    if not np.isfinite(time).all() or not len(steps):
        return  # values that are not finite are reported as such
    stalled = np.flatnonzero(steps <= 0)
    if len(stalled):
        k = int(stalled[0])
        text = (
            f"stamps must increase, but go from {time[k]:.6f} s to {time[k + 1]:.6f} s "
            f"({len(stalled)} times); hrc repair drops the repeated frames"
        )
        yield entry.fault(text, frame=k + 1, key=key)
        return
    if key == "timestamp" and abs(time[0]) > 0.5 / fps:
        text = "LeRobot's stamps count from the start of the episode"
        yield entry.warning(f"begins at {time[0]:.6g} s, not at 0: {text}", frame=0, key=key)
    if (np.abs(steps * fps - 1) < _REGULAR).all():
        return  # within all tolerances below; the checks below are far slower
    # The median step ignores gaps and repetitions.
    usual = float(np.median(steps))
    if abs(usual * fps - 1) > _RATE_TOLERANCE:
        text = (
            f"frames are {1e3 * usual:.4g} ms apart ({1 / usual:.4g} Hz), but fps says "
            f"{fps:g}; hrc repair --fps {1 / usual:.3g} resamples to the true rate"
        )
        yield entry.warning(text, key=key)
    gaps = np.flatnonzero(steps > _GAP * usual)
    rate = 1 / float(steps.mean())
    if not len(gaps) and abs(usual * fps - 1) <= _RATE_TOLERANCE < abs(rate / fps - 1):
        # A loop that is sometimes late keeps its usual step, but not its mean rate.
        text = (
            f"{len(time)} frames in {time[-1] - time[0]:.4g} s are {rate:.4g} Hz, but fps says "
            f"{fps:g}: the loop was late; hrc repair --fps {fps:g} resamples"
        )
        yield entry.warning(text, key=key)
    if len(gaps):
        lost = int(np.rint(steps[gaps] / usual - 1).sum())
        text = (
            f"{len(gaps)} gaps, about {lost} frames lost; the first is "
            f"{1e3 * steps[gaps[0]]:.4g} ms long; hrc repair --fps {fps:g} fills them in"
        )
        yield entry.warning(text, frame=int(gaps[0]) + 1, key=key)
    jitter = float(np.quantile(np.abs(np.delete(steps, gaps) - usual), 0.95)) / usual
    if jitter > _JITTER_TOLERANCE:
        text = f"steps vary by {100 * jitter:.0f} % (95th percentile)"
        yield entry.warning(f"{text}; hrc repair --fps {fps:g} resamples", key=key)


UsualMotion = Mapping[str, tuple[np.ndarray, np.ndarray]]
"""Role -> usual fast step (99 % quantile) and usual range of each joint [rad]."""


def quaternion_signs(entry: EpisodeEntry, quantities: Quantities) -> Iterator[Issue]:
    """Check that the signs of quaternions are continuous."""
    for role, values in quantities.items():
        flips = role.startswith("quaternion") and (values[1:] * values[:-1]).sum(1) < 0
        if np.any(flips):
            text = (
                f"the quaternion changes its sign {np.sum(flips)} times without turning; "
                f"load_demos makes it continuous, hrc repair does so on disk"
            )
            yield entry.warning(text, frame=int(np.argmax(flips)) + 1, key=role)


def arm_motion(demo: Demonstration) -> Float64[np.ndarray, "frames _"] | None:
    """Joint positions, or the end-effector position if no joints are known."""
    return demo.position if demo.joint_position is None else demo.joint_position


def motion_present(entry: EpisodeEntry, demo: Demonstration) -> Iterator[Issue]:
    """Check that the arm moves: no primitive can be fitted to an arm at rest."""
    motion = arm_motion(demo)
    span = np.inf if motion is None else float(np.ptp(motion, axis=0).max())
    if span < _SMALLEST_MOTION:
        yield entry.fault(
            f"moves by {span:.2g} in all: nothing was demonstrated; leave the episode out"
        )


def rest_at_ends(entry: EpisodeEntry, demo: Demonstration) -> Iterator[Issue]:
    """Report long rests before or after the motion, which a fit would reproduce."""
    motion, time = arm_motion(demo), demo.time
    span = 0.0 if motion is None else float(np.ptp(motion, axis=0).max())
    if motion is None or span == 0:
        return  # reported as a state that never changes
    # Half a percent of the motion exceeds the noise of encoders.
    away = np.abs(motion - motion[0]).max(1) > 0.005 * span
    not_there = np.abs(motion - motion[-1]).max(1) > 0.005 * span
    arrived = len(time) - 1 - int(not_there[::-1].argmax())
    for place, seconds, frame in (
        ("begins", float(time[away.argmax()] - time[0]), 0),
        ("ends", float(time[-1] - time[arrived]), arrived),
    ):
        if seconds > _STILL_SECONDS:
            text = f"{place} with {seconds:.1f} s of standing still: hrc repair trims it"
            yield entry.warning(text, frame=frame)


def spikes_and_jumps(
    entry: EpisodeEntry, demo: Demonstration, usual: UsualMotion
) -> Iterator[Issue]:
    """Report frames far from both neighbours, and steps far larger than usual."""
    for role, (step, span) in usual.items():
        steps = np.diff(getattr(demo, role), axis=0)
        smooth = (step > 0) & (step < 0.2 * span)  # other joints switch between levels
        there, back = steps[:-1], steps[1:]
        bound = np.maximum(_SPIKE * step, _SPIKE_FRACTION * span) + _LEAST_SPIKE
        spike = (there * back < 0) & smooth
        spike &= np.minimum(np.abs(there), np.abs(back)) > bound
        bound = np.maximum(_JUMP * step, _JUMP_FRACTION * span) + _LEAST_JUMP
        jump = (np.abs(steps) > bound) & smooth
        jump[:-1] &= ~spike
        jump[1:] &= ~spike
        for odd, what in ((spike, "leaps away for one frame"), (jump, "jumps")):
            if not odd.any():
                continue
            size = np.where(odd, np.abs(steps[: len(odd)]) / np.maximum(step, 1e-9), 0.0)
            frame, joint = divmod(int(size.argmax()), size.shape[1])
            name = demo.joint_names[joint]
            text = (
                f"{name} {what} by {steps[frame, joint]:.3g}, "
                f"{size[frame, joint]:.3g} times its usual fast step; "
                f"{int(odd.any(1).sum())} such frames in the episode"
            )
            key, worst = f"{role} ({name})", float(size.max())
            yield entry.warning(
                text, frame=frame + 1, key=key, components=(name,), severity=worst
            )


def joint_speeds(entry: EpisodeEntry, demo: Demonstration) -> Iterator[Issue]:
    """Report joint speeds due to lost frames, glitches or wrapped encoders."""
    joints, names = demo.joint_position, demo.joint_names
    if joints is None:
        return
    change = np.diff(joints, axis=0)
    speed = np.abs(change) / np.diff(demo.time)[:, None]
    # Fingers are faster, and often have units of their own.
    limits = np.array([np.inf if is_hand(name) else _FASTEST_ARM for name in names])
    too_fast = (speed > limits).any(1)
    if not too_fast.any():
        return
    frame = int(too_fast.argmax())
    joint = int((speed[frame] / limits).argmax())
    step, name = change[frame, joint], names[joint]
    cause = "a glitch, or frames were lost: look at it, or leave the episode out"
    if abs(abs(step) - 2 * np.pi) < 0.3:  # tolerates motion within a frame
        cause = "the encoder wrapped: hrc repair unwraps it"
    text = (
        f"{name} jumps by {step:.3g} rad in one frame ({speed[frame, joint]:.3g} rad/s, limit "
        f"{_FASTEST_ARM:g}); {cause}. {int(too_fast.sum())} such frames in the episode"
    )
    key = f"joint_position ({name})"
    yield entry.warning(text, frame=frame + 1, key=key, components=(name,))


def joint_rates(entry: EpisodeEntry, demo: Demonstration) -> Iterator[Issue]:
    """Report joint velocities in another unit than the rates of the joint positions."""
    joints, velocity = demo.joint_position, demo.joint_velocity
    if joints is None or velocity is None or len(joints) < 3:
        return
    rate = np.gradient(joints, demo.time, axis=0)
    sizes = [float(np.linalg.norm(x)) for x in (velocity, rate)]
    ratio = sizes[0] / max(sizes[1], 1e-9)
    if (rate * velocity).sum() > _ALIKE * sizes[0] * sizes[1] and not 1 / 3 < ratio < 3:
        text = f"is {ratio:.3g} times the rate of joint_position: in another unit?"
        yield entry.warning(f"{text} --units joint_velocity deg/s", key="joint_velocity")


def copied_commands(entry: EpisodeEntry, demo: Demonstration) -> Iterator[Issue]:
    """Report actions that equal the state: they teach a policy to stand still."""
    joints, command = demo.joint_position, demo.command_position
    if joints is not None and command is not None and np.array_equal(joints, command):
        text = "is a copy of the state at the same frame; a policy learns to stay where it is"
        yield entry.warning(text, key="action")


def duplicates(
    motions: Sequence[tuple[EpisodeEntry, Float64[np.ndarray, " numbers"], float]],
) -> Iterator[Issue]:
    """Report episodes that show the same motion.

    Args:
        motions: Episode, its motion at a fixed number of phases (`motion_sketch`), and the
            span of the motion.
    """
    if len({sketch.shape for _, sketch, _ in motions}) != 1:
        return
    sketches = np.stack([sketch for _, sketch, _ in motions])
    # Equal motions have nearly equal means: only motions of similar means are compared.
    means = sketches.mean(1)
    order = np.argsort(means)
    for number, (entry, sketch, span) in enumerate(motions):
        near = means[number] + _SAME_EPISODE * span * np.array([-1.0, 1.0])
        others = order[slice(*np.searchsorted(means[order], near))]
        others = others[others < number]
        same = np.abs(sketches[others] - sketch).max(1, initial=0) <= _SAME_EPISODE * span
        if span and same.any():
            earlier = motions[others[same].min()][0]
            text = f"shows the same motion as episode {earlier.index}"
            yield entry.warning(f"{text}: recorded once, stored twice?")


def motion_sketch(
    motion: Float64[np.ndarray, "frames components"], phases: int = 20
) -> Float64[np.ndarray, " numbers"]:
    """The motion at evenly spaced phases, independent of its duration."""
    phase = np.linspace(0, 1, len(motion))
    at = np.linspace(0, 1, phases)
    return np.stack([np.interp(at, phase, column) for column in motion.T], axis=1).ravel()
