"""Rest of the arm, and demonstrations trimmed or split at it."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float64

from hrc_learn.demos.demonstration import Demonstration
from hrc_learn.demos.preprocessing.filters import local_polynomial


def cut(demo: Demonstration, start: int, stop: int) -> Demonstration:
    """Frames `start` to `stop` (exclusive) of a demonstration; time begins at zero again.

    Raises:
        ValueError: The range is empty or exceeds the demonstration.
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


@dataclass(frozen=True, kw_only=True)
class RestCriterion:
    """Criterion of rest, with hysteresis.

    A rest begins when the speed falls below the lower bound and ends when it rises above the
    upper one, so that a speed close to one bound does not split the recording. The speed is
    that of the fastest joint, or of the end effector if no joints are recorded.
    """

    joint_speed: tuple[float, float] = (0.01, 0.04)
    """Lower and upper bound of the joint speed [rad/s]."""
    linear_speed: tuple[float, float] = (0.003, 0.01)
    """Lower and upper bound of the end-effector speed [m/s]."""
    shortest: float = 0.3
    """Shortest rest [s]; shorter ones, as at a turning point, belong to the motion."""
    window: float = 0.15
    """Width of the neighbourhood for speeds [s]."""

    def __post_init__(self) -> None:
        for low, high in (self.joint_speed, self.linear_speed):
            if not 0 <= low <= high:
                raise ValueError(
                    f"the lower bound of a rest must not exceed the upper one: got {low} and "
                    f"{high}"
                )


def resting(
    demo: Demonstration, criterion: RestCriterion | None = None
) -> Bool[np.ndarray, " _frames"]:
    """Mask of frames in which the arm rests.

    Raises:
        ValueError: The demonstration holds neither joint nor Cartesian positions, or too few
            frames to estimate a speed.
    """
    criterion = criterion or RestCriterion()
    speed, (low, high) = _speed(demo, criterion)
    state = np.where(speed > high, 1, np.where(speed < low, -1, 0))
    # Between the bounds the last state persists; the arm moves before the first one.
    last = np.maximum.accumulate(np.where(state != 0, np.arange(len(demo)), -1))
    still = np.where(last >= 0, state[last], 1) < 0
    for start, stop in _runs(still):
        if demo.time[stop - 1] - demo.time[start] < criterion.shortest:
            still[start:stop] = False
    return still


def trim_rest(
    demo: Demonstration, criterion: RestCriterion | None = None, keep: float | int = 0.1
) -> Demonstration:
    """Trim the rest before and after the motion.

    Args:
        demo: The demonstration.
        criterion: Criterion of rest.
        keep: Rest left at either end [s], so that the motion begins and ends at rest.

    Raises:
        ValueError: As in `resting`, or the arm never moves.
    """
    moving = np.flatnonzero(~resting(demo, criterion))
    if not len(moving):
        raise ValueError(f"episode {demo.episode}: the arm rests all the time")
    return _with_margin(demo, int(moving[0]), int(moving[-1]) + 1, keep)


def split_at_rest(
    demo: Demonstration,
    criterion: RestCriterion | None = None,
    *,
    shortest: float | int = 0.5,
    keep: float | int = 0.1,
) -> list[Demonstration]:
    """Split a demonstration into the motions between rests.

    Args:
        demo: Demonstration of several motions, such as the parts of a task.
        criterion: Criterion of rest.
        shortest: Duration below which motions are left out [s].
        keep: Rest left at either end of each motion [s].

    Raises:
        ValueError: As in `resting`.
    """
    return [
        _with_margin(demo, start, stop, keep)
        for start, stop in _runs(~resting(demo, criterion))
        if demo.time[stop - 1] - demo.time[start] >= shortest
    ]


def _speed(
    demo: Demonstration, criterion: RestCriterion
) -> tuple[Float64[np.ndarray, " frames"], tuple[float, float]]:
    values = demo.position if demo.joint_position is None else demo.joint_position
    if values is None:
        raise ValueError("rest is found in joint positions or positions; neither is recorded")
    _, rates = local_polynomial(demo.time, values, window=criterion.window, degree=2)
    if demo.joint_position is None:
        return np.linalg.norm(rates, axis=1), criterion.linear_speed
    return np.abs(rates).max(1), criterion.joint_speed


def _runs(flags: Bool[np.ndarray, " frames"]) -> list[tuple[int, int]]:
    """First frame and exclusive end of every run of true flags."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(int)))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))


def _with_margin(
    demo: Demonstration, start: int, stop: int, keep: float | int
) -> Demonstration:
    time = demo.time
    first = int(np.searchsorted(time, time[start] - keep))
    behind = int(np.searchsorted(time, time[stop - 1] + keep, side="right"))
    return cut(demo, first, behind)
