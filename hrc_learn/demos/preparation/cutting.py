"""A part of a demonstration."""

from dataclasses import replace

from ..demonstration import Demonstration


def cut(demo: Demonstration, start: int, stop: int) -> Demonstration:
    """Frames `start` to `stop` (not included); time begins at zero again.

    Raises:
        ValueError: That is no range of its frames.
    """
    if not 0 <= start < stop <= len(demo):
        raise ValueError(
            f"frames {start} to {stop} are no part of a demonstration of {len(demo)} frames"
        )
    rows = {name: getattr(demo, name)[start:stop] for name in demo.recorded}
    rows["time"] = demo.time[start:stop] - demo.time[start]
    return replace(
        demo,
        **rows,
        start_time=demo.start_time + float(demo.time[start]),
        extra={key: values[start:stop] for key, values in demo.extra.items()},
    )
