"""Streams of one demonstration that were stamped late."""

from collections.abc import Mapping
from dataclasses import replace

from ..demonstration import Demonstration
from .resampling import at_times


def compensate_delay(demo: Demonstration, delays: Mapping[str, float]) -> Demonstration:
    """Move fields to the time they were measured at.

    An image that takes 40 ms from the lens to its stamp shows where the arm was 40 ms ago.

    Args:
        demo: A demonstration.
        delays: By how much fields lag behind the stamps of their frames [s], such as
            {"feature": 0.04}. The end of the demonstration, for which no later frame shows
            them, is cut off.

    Raises:
        ValueError: A field is not recorded, or a delay is negative or too long.
    """
    for name, delay in delays.items():
        if name not in demo.recorded or name == "time":
            raise ValueError(
                f"{name} is not recorded; there are {', '.join(demo.recorded[1:])}"
            )
        if not 0 <= delay < demo.duration:
            raise ValueError(
                f"the delay of {name} must be between 0 and {demo.duration:.4g} s, got {delay}"
            )
    longest = max(delays.values(), default=0.0)
    kept = demo.time[demo.time <= demo.time[-1] - longest]
    moved = {
        field: getattr(shifted, field)
        for name, delay in delays.items()
        for shifted in [at_times(demo, kept + delay)]
        for field in _together(name, shifted)
    }
    return replace(at_times(demo, kept), **moved)


def _together(name: str, demo: Demonstration) -> list[str]:
    """A feature and whether it is seen belong together."""
    both = ("feature", "feature_visible")
    return [n for n in both if n in demo.recorded] if name in both else [name]
