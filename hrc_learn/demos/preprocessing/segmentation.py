"""Where the arm rests, and demonstrations cut there."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float64

from hrc_learn.demos.demonstration import Demonstration
from hrc_learn.demos.preprocessing.filters import local_polynomial

# A part of a demonstration.


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


# Where the arm rests: before, between and after its motions.


@dataclass(frozen=True, kw_only=True)
class RestCriterion:
    """When an arm counts as resting.

    With hysteresis: a rest begins when the speed falls below the lower bound and ends when it
    rises above the upper one, so that a speed that hovers about one bound does not chop the
    recording up. The speed is that of the fastest joint; without joints, that of the end
    effector.
    """

    joint_speed: tuple[float, float] = (0.01, 0.04)
    """Lower and upper bound [rad/s]."""
    linear_speed: tuple[float, float] = (0.003, 0.01)
    """Lower and upper bound for demonstrations without joints [m/s]."""
    shortest: float = 0.3
    """Rests shorter than this are part of the motion, as at a turning point [s]."""
    window: float = 0.15
    """Width of the neighbourhood that speeds are estimated from [s]."""

    def __post_init__(self) -> None:
        for low, high in (self.joint_speed, self.linear_speed):
            if not 0 <= low <= high:
                raise ValueError(
                    f"a rest begins below the first speed and ends above the second, which "
                    f"must not be lower: got {low} and {high}"
                )


def resting(
    demo: Demonstration, criterion: RestCriterion | None = None
) -> Bool[np.ndarray, " _frames"]:
    """Whether the arm rests, frame by frame.

    Raises:
        ValueError: The demonstration holds neither joint nor Cartesian positions, or too few
            frames to tell a speed.
    """
    criterion = criterion or RestCriterion()
    speed, (low, high) = _speed(demo, criterion)
    verdict = np.where(speed > high, 1, np.where(speed < low, -1, 0))
    # Between the bounds the last verdict holds; before the first one, that the arm moves.
    last = np.maximum.accumulate(np.where(verdict != 0, np.arange(len(demo)), -1))
    still = np.where(last >= 0, verdict[last], 1) < 0
    for start, stop in _runs(still):
        if demo.time[stop - 1] - demo.time[start] < criterion.shortest:
            still[start:stop] = False
    return still


def trim_rest(
    demo: Demonstration, criterion: RestCriterion | None = None, keep: float | int = 0.1
) -> Demonstration:
    """The demonstration without the rest before and after its motion.

    Args:
        demo: A demonstration.
        criterion: When the arm rests.
        keep: Rest left at either end [s], so that the motion still begins and ends in it.

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
    """The motions between the rests, each a demonstration of its own.

    Args:
        demo: A demonstration of several motions, such as the parts of a task.
        criterion: When the arm rests.
        shortest: Motions shorter than this are left out [s].
        keep: Rest left at either end of each [s].

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
        raise ValueError("rest shows in joint positions or positions; neither is recorded")
    _, rates = local_polynomial(demo.time, values, window=criterion.window, degree=2)
    if demo.joint_position is None:
        return np.linalg.norm(rates, axis=1), criterion.linear_speed
    return np.abs(rates).max(1), criterion.joint_speed


def _runs(flags: Bool[np.ndarray, " frames"]) -> list[tuple[int, int]]:
    """First frame and the one behind the last of every stretch of true flags."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(int)))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))


def _with_margin(
    demo: Demonstration, start: int, stop: int, keep: float | int
) -> Demonstration:
    time = demo.time
    first = int(np.searchsorted(time, time[start] - keep))
    behind = int(np.searchsorted(time, time[stop - 1] + keep, side="right"))
    return cut(demo, first, behind)
