"""Oddities of the motion itself, once columns are known for what they mean."""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float64

from ..layout import EpisodeEntry
from .report import Report

_FASTEST_ARM = 12.0
"""No joint of an arm turns faster [rad/s]; quicker steps are faults of the recording."""
_STILL_SECONDS = 1.0
_SAME_EPISODE = 1e-3

Joints = Float64[np.ndarray, "frames joints"]
Times = Float64[np.ndarray, " frames"]


def check_jumps(
    entry: EpisodeEntry,
    time: Times,
    joint_position: Joints,
    joint_names: Sequence[str],
    speed_limits: Mapping[str, float | int],
    report: Report,
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
    wrapped = abs(abs(step) - 2 * np.pi) < 0.3
    cause = (
        "the encoder wrapped: repair_dataset.py unwraps it"
        if wrapped
        else "a glitch, or frames were lost: look at it, or leave the episode out"
    )
    report.warning(
        f"{joint_names[joint]} jumps by {step:.3g} rad in one frame "
        f"({speed[frame, joint]:.3g} rad/s, limit {limits[joint]:.3g}); {cause}. "
        f"{int(too_fast.any(1).sum())} such frames in the episode",
        file=entry.file,
        episode=entry.index,
        frame=frame + 1,
        key=f"joint_position ({joint_names[joint]})",
    )


def check_stillness(
    entry: EpisodeEntry, time: Times, motion: Float64[np.ndarray, "frames _"], report: Report
) -> None:
    """Waiting before or after the motion, which a fit would reproduce."""
    span = float(np.ptp(motion, axis=0).max())
    if span == 0:
        return  # reported as a state that never changes
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
                f"{place} with {seconds:.1f} s of standing still: repair_dataset.py trims it",
                file=entry.file,
                episode=entry.index,
                frame=frame,
            )


def check_commands(
    entry: EpisodeEntry, joint_position: Joints, command: Joints, report: Report
) -> None:
    """Actions that are the state over again teach a policy to stand still."""
    if joint_position.shape == command.shape and np.array_equal(joint_position, command):
        report.warning(
            "is a copy of the state at the same frame; a policy learns to stay where it is",
            file=entry.file,
            episode=entry.index,
            key="action",
        )


def check_duplicates(
    episodes: Sequence[tuple[EpisodeEntry, Float64[np.ndarray, "_frames _"]]], report: Report
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
                    file=entry.file,
                    episode=entry.index,
                )
                break
        seen.append((entry, sketch))
