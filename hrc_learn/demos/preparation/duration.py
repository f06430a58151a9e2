"""Demonstrations brought to the same duration."""

from dataclasses import replace

import numpy as np

from ..demonstration import Demonstration
from ..demonstration_set import DemonstrationSet


def set_duration(demo: Demonstration, duration: float | int) -> Demonstration:
    """The same path, gone through evenly faster or slower.

    Velocities change with the pace, and so does the nominal frame rate: no frame is added or
    lost (`resample` sets another rate). Efforts are left as measured.

    Args:
        demo: At least two frames.
        duration: Its new duration [s].

    Raises:
        ValueError: The duration is not positive, or there is only one frame.
    """
    if not duration > 0 or len(demo) < 2:
        raise ValueError(
            f"a demonstration of {len(demo)} frames cannot be made to last {duration} s"
        )
    stretch = duration / demo.duration
    scaled = {
        name: getattr(demo, name) / stretch
        for name in ("joint_velocity", "command_velocity")
        if name in demo.recorded
    }
    return replace(demo, time=demo.time * stretch, fps=demo.fps / stretch, **scaled)


def equalise_durations(
    demos: DemonstrationSet, duration: float | int | None = None
) -> DemonstrationSet:
    """All demonstrations with one duration.

    Args:
        demos: At least one.
        duration: Duration wanted [s]; None: the median of theirs.

    Raises:
        ValueError: The set is empty, or as in `set_duration`.
    """
    if not len(demos):
        raise ValueError("an empty set of demonstrations has no duration")
    common = (
        float(np.median([demo.duration for demo in demos])) if duration is None else duration
    )
    return demos.map(lambda demo: set_duration(demo, common))
