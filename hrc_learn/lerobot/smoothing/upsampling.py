"""Curve through a policy's actions, as setpoints at the rate of the motors."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from .action_limits import ActionLimits, MotionState

LARGEST_DEGREE = 3
_LATEST = 1.5
"""Frames for which the curve is continued when no action comes; then it comes to rest."""


class ActionUpsampler:
    """Setpoints between actions, on a B-spline, within limits.

    The last d + 1 actions are the control points of a uniform B-spline of degree d: 0 holds the
    newest, 1 is a line from the one before it, 2 and 3 have continuous velocity and
    acceleration. The derivatives of such a curve lie between the differences of its control
    points, so actions that keep the limits at their own rate lead to setpoints that keep them
    at any. A `MotionFilter` at the rate of the setpoints keeps them whatever the actions are.

    A curve of degree d is (d + 1)/2 actions late. A smaller latency puts each control point
    ahead, along the difference of the last two actions, which makes their noise larger.

    Attributes:
        latency: Latency of the curve behind the actions [s].
        position: Setpoint handed out last.
    """

    def __init__(
        self,
        limits: ActionLimits,
        rate: float,
        *,
        degree: int = LARGEST_DEGREE,
        latency: float | None = None,
    ):
        """Begin with `reset`.

        Args:
            limits: Limits of the actions, with their rate.
            rate: Setpoints a second; at least as many as actions.
            degree: Degree of the curve, 0 to 3.
            latency: Latency of the curve, in actions; None: (degree + 1)/2, the largest.

        Raises:
            ValueError: An argument is out of its range.
        """
        if not 0 <= degree <= LARGEST_DEGREE:
            raise ValueError(f"degree must be 0 to {LARGEST_DEGREE}, got {degree}")
        if not limits.fps <= rate < float("inf"):
            raise ValueError(
                f"rate must be at least the {limits.fps:g} actions a second, got {rate:g}"
            )
        own = (degree + 1) / 2
        latency = own if latency is None else latency
        if not 0 <= latency <= own:
            raise ValueError(
                f"latency must be 0 to {own:g} actions for a curve of degree {degree}, got "
                f"{latency:g}"
            )
        self.limits, self.rate, self.degree = limits, rate, degree
        self.latency = latency / limits.fps
        self._lead = own - latency
        self._filter = limits.motion_filter(1 / rate)
        self._points: np.ndarray | None = None
        self._phase = 0.0

    @property
    def position(self) -> Float[np.ndarray, "*batch D"]:
        return self._state.position

    def reset(self, position: Float[np.ndarray, "*batch D"]) -> None:
        """Start at rest at the present position; several robots move at once if there are.

        Raises:
            ValueError: It has another number of values than the limits.
        """
        position = self._checked(position)
        self._state = MotionState.moving(position)
        self._points = np.repeat(position[None], self.degree + 1, axis=0)
        self._newest, self._phase = position, 0.0

    def push(self, action: Float[np.ndarray, "*batch D"]) -> None:
        """Take the next action; the phase of `setpoint` counts from now on.

        Values that are not finite are taken for those before.

        Raises:
            ValueError: It has another number of values than the limits.
            RuntimeError: There was no `reset`.
        """
        if self._points is None:
            raise RuntimeError("reset() says where the robot is: call it first")
        action = self._checked(action)
        action = np.where(np.isfinite(action), action, self._newest)
        ahead = action + self._lead * (action - self._newest)
        self._points = np.concatenate([self._points[1:], ahead[None]])
        self._newest = action

    def repeat(self) -> None:
        """Take the newest action once more: with no other ones, the motion comes to rest."""
        self.push(self._newest)

    def setpoint(self, phase: float) -> Float[np.ndarray, "*batch D"]:
        """The next setpoint, 1/rate after the last.

        Args:
            phase: Time since the newest action, in actions. Beyond one, where the next action
                is late, the curve goes on for half an action.
        """
        assert self._points is not None  # reset() comes before push()
        weights = _weights(self.degree, min(phase, _LATEST))
        self._state = self._filter.step(self._state, np.tensordot(weights, self._points, 1))
        return self._state.position

    def frame(self, action: Float[np.ndarray, "*batch D"]) -> Float[np.ndarray, "n *batch D"]:
        """All setpoints until the next action is due.

        Where the rates do not divide, their number changes from one action to the next.

        Raises:
            ValueError: Same as `push`.
        """
        self.push(action)
        made, step = [], self.limits.fps / self.rate
        # Rounding must not make one more of them, just before the next action.
        while self._phase < 1 - 1e-9:
            made.append(self.setpoint(self._phase))
            self._phase += step
        self._phase -= 1
        return np.stack(made)

    def _checked(self, values: np.ndarray) -> np.ndarray:
        values = np.asarray(values, dtype=np.float64)
        if values.shape[-1:] != (len(self.limits.names),):
            raise ValueError(
                f"limits are given for {', '.join(self.limits.names)}, but there are values "
                f"of shape {values.shape}"
            )
        return values


def _weights(degree: int, u: float) -> Float[np.ndarray, " points"]:
    """Weights of the control points, oldest first, by the recursion of Cox and de Boor."""
    weights = np.array([1.0])
    for d in range(1, degree + 1):
        k = np.arange(d)
        rising = (u + d - 1 - k) / d
        weights = np.append(weights * (1 - rising), 0.0) + np.append(0.0, weights * rising)
    return weights
