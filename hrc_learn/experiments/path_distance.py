"""How far an end effector was off the path that its goals went along."""

import numpy as np
from jaxtyping import Float

_LAG = 0.5
"""How long ago a goal may have been for the end effector to be still on its path [s]: servos
lag, and a motion that waits for a limit lags further."""
_LEAST_WAY = 0.002
"""Way of the goal in that time from which on it has a direction [m]."""


def path_distance(
    position: Float[np.ndarray, "time 3"],
    goal: Float[np.ndarray, "time 3"],
    time: Float[np.ndarray, " time"],
) -> Float[np.ndarray, " time"]:
    """Distance of each position from the path of the goals [m]; NaN where there was none.

    The end effector may be anywhere along the path: behind, as servos lag, or ahead, where it
    stops. So the distance counts from the nearest of the goals shortly before, and from the
    line on which the goal moved last.

    Args:
        position: Of the end effector [m].
        goal: Where it was to be; NaN where there was no path [m].
        time: Of both [s].
    """
    nearest = _beside(position - goal, goal, time)
    start, way = goal[:-1], np.diff(goal, axis=0)
    length = (way**2).sum(axis=1)
    for lag in range(_samples(time)):
        here = position[lag + 1 :]
        a, d, square = start[: len(here)], way[: len(here)], length[: len(here)]
        share = ((here - a) * d).sum(axis=1) / np.maximum(square, 1e-12)
        away = np.linalg.norm(here - a - np.clip(share, 0, 1)[:, None] * d, axis=1)
        # A segment of which an end is not known is none: fmin leaves NaN out.
        nearest[lag + 1 :] = np.fmin(nearest[lag + 1 :], away)
    return np.where(np.isfinite(goal).all(axis=1), nearest, np.nan)


def _beside(
    error: Float[np.ndarray, "time 3"],
    goal: Float[np.ndarray, "time 3"],
    time: Float[np.ndarray, " time"],
) -> Float[np.ndarray, " time"]:
    """Part of an error that is across the direction in which the goal moved last [m]."""
    lag = min(_samples(time), len(time))
    way = np.full_like(goal, np.nan)
    way[lag:] = goal[lag:] - goal[: len(goal) - lag]
    length = np.linalg.norm(way, axis=1, keepdims=True)
    # A goal that hardly moved has no direction.
    direction = np.where(length > _LEAST_WAY, way / np.maximum(length, _LEAST_WAY), 0.0)
    along = (error * direction).sum(axis=1, keepdims=True) * direction
    return np.linalg.norm(error - along, axis=1)


def _samples(time: Float[np.ndarray, " time"]) -> int:
    """Of the time by which an end effector lags."""
    return round(_LAG / float(np.median(np.diff(time)))) if len(time) > 1 else 0
