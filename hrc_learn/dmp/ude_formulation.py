"""The orientation primitive of Ude et al. 2014, whose state is the angular velocity.

eta' = alpha (beta log(g conj q) - eta) + f,   q' = (0, eta) q / 2,   eta = tau omega

("Orientation in Cartesian space dynamic movement primitives", eq. 16; primes by s = t / tau,
the logarithm here the full angle). With the error e = log(g conj q) and v = -eta,

    v' = alpha (beta (0 - e) - v) - f,   e' = v + n(e, v),   n = e x v / 2 + c e x (e x v)

which is the linear primitive except for n, zero while the axis of rotation is constant. The
linear part is solved exactly, and n is integrated by the Runge-Kutta method of order 4 in the
frame of the linear motion (Lawson 1967, "Generalized Runge-Kutta processes for stable
systems"): a step is stable at any length and exact about one axis. The logarithm is followed
continuously.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.dmp import orientation_error
from hrc_learn.dmp._arguments import (
    Scalars,
    Times,
    broadcast_shapes,
    normalised_time,
    to_tensor,
)
from hrc_learn.dmp._system.trajectory import Trajectory, output
from hrc_learn.dmp.closed_loop_step import DMPState
from hrc_learn.dmp.fitting.samples import Samples
from hrc_learn.dmp.fitting.solvers import REGULARIZATION, ridge_inverse
from hrc_learn.dmp.linear_primitive import Boundary, LinearPrimitive
from hrc_learn.dmp.orientation_dmp import FORMULATIONS, OrientationCoordinates
from hrc_learn.geometry.quaternion import axis_drift, drift_free_rate, drift_free_slope

MAXIMUM_STEP = 1 / 200
"""Longest integration step of a rollout, in s; the error is of fourth order in it."""
SAMPLES_PER_FUNCTION = 10
"""Times per basis function at which the force of a demonstration is evaluated."""


@dataclass(frozen=True, eq=False)
class UdeCoordinates(OrientationCoordinates):
    """Error columns in which (e, v) moves linearly except for the drift of the axis."""

    linear: ClassVar[bool] = False

    @staticmethod
    def refit(motion: LinearPrimitive, errors: Samples) -> None:
        """Add to fitted weights the force that this state needs to follow the same path.

        Raises:
            ValueError: The demonstration passes a whole turn from its goal, where e' has no
                bound.
        """
        count = SAMPLES_PER_FUNCTION * motion.basis.count
        s = torch.linspace(0, 1, count, dtype=torch.float64, device=motion.weights.device)
        start_rate = motion.start_velocity * motion.duration[..., None]
        with torch.no_grad():
            boundary = Boundary(start_velocity=start_rate)
            linear = motion.rollout_columns(boundary, _unit_duration(motion), s)
            e, rate, second = (
                x.double() for x in (linear.position, linear.velocity, linear.acceleration)
            )
            if (e.norm(dim=-1) >= 2 * torch.pi).any():
                raise ValueError(
                    "orientation is a whole turn or more from its end: formulation 'ude' "
                    "cannot follow that, use 'log'"
                )
            v, slope = drift_free_rate(e, rate), drift_free_slope(e, rate, second)
            force = slope - second + motion.spring.alpha * (v - rate)
            change = (ridge_inverse(motion.basis.forcing(s), REGULARIZATION) @ force).mT
            motion.weights += change.to(motion.weights)
            ends = motion.start, motion.duration, motion.start_velocity
            reproduction = UdeMotion(motion, motion.timestamps, *ends, None).position
        motion.fit_report = errors.compare(reproduction)

    def rollout(
        self,
        motion: LinearPrimitive,
        boundary: Boundary,
        duration: Tensor,
        time: Times | None,
        forcing_gain: Scalars | None,
    ) -> "UdeMotion":
        """Motion of the error, of order 4 in `MAXIMUM_STEP`."""
        s = motion.timestamps if time is None else normalised_time(time, duration)
        start, rate = boundary.start, boundary.start_velocity
        return UdeMotion(motion, s, start, duration, rate, forcing_gain)

    def step(
        self, motion: LinearPrimitive, columns: DMPState, dt: Scalars, **inputs: Any
    ) -> DMPState:
        """State of the error after `dt` [s], of order 4 in it."""
        v = drift_free_rate(columns.position, columns.rate)
        begin = replace(columns, rate=v)
        half = to_tensor(dt, v.dtype, v.device) / 2
        middle = motion.step_columns(begin, half, **inputs)
        end = motion.step_columns(middle, half, **inputs)
        linear = [torch.stack([x.position, x.rate], dim=-2) for x in (begin, middle, end)]
        h = end.s - columns.s
        change = deviation(torch.zeros_like(linear[0]), h, motion, linear)
        e, v = (linear[2] + change).unbind(-2)
        return replace(end, position=e, rate=v + axis_drift(e, v))

    def external_acceleration(
        self, motion: LinearPrimitive, columns: DMPState, frame: Tensor, coupling: Any
    ) -> Tensor | None:
        """Minus the angular acceleration, because v is minus the angular velocity."""
        if coupling is None:
            return None
        return -to_tensor(coupling, frame.dtype, frame.device)

    def _to_reference(
        self, motion: LinearPrimitive, columns: DMPState, old: Tensor, new: Tensor
    ) -> DMPState:
        q = orientation_error.to_orientation(columns.position, old)
        error = orientation_error.to_error(q, new)
        error = orientation_error.nearest_turn(error, columns.position)
        v = drift_free_rate(columns.position, columns.rate)
        # The spring force alpha beta (e - goal) is unchanged if both move alike.
        return replace(
            columns,
            position=error,
            rate=v + axis_drift(error, v),
            goal=columns.goal + error - columns.position,
        )


class UdeMotion:
    """Error over time: linear motion plus deviation, integrated once on a fixed grid."""

    def __init__(
        self,
        motion: LinearPrimitive,
        s: Float[Tensor, "*#batch T"],
        start: Float[Tensor, "*#batch 3"],
        duration: Float[Tensor, "*#batch"],
        rate: Float[Tensor, "*#batch 3"],
        forcing_gain: Scalars | None,
    ):
        """Describe a motion.

        Args:
            motion: Weights and gains.
            s: Normalised times.
            start: Error at the start [rad].
            duration: [s].
            rate: Rate of the error at the start [rad/s].
            forcing_gain: Factor on the forcing term.
        """
        start, per_s = torch.broadcast_tensors(start, rate * duration[..., None])
        self._motion = motion
        self._forcing_gain = forcing_gain
        self._s = s
        self._duration = duration[..., None, None]
        self._start = start
        self._first = drift_free_rate(start, per_s)
        self._batch = broadcast_shapes(
            motion.weights.shape[:-2], start.shape[:-1], duration.shape, s.shape[:-1]
        )

    @output
    def time(self) -> Float[Tensor, "*batch T"]:
        """Time since the start of the motion [s]."""
        return (self._s * self._duration[..., 0]).to(self._start).expand(*self._batch, -1)

    @cached_property
    def position(self) -> Float[Tensor, "*batch T 3"]:
        """Error [rad]."""
        return self._state[..., 0, :]

    @cached_property
    def velocity(self) -> Float[Tensor, "*batch T 3"]:
        """Rate of the error [rad/s]."""
        return self._rate / self._duration

    @cached_property
    def acceleration(self) -> Float[Tensor, "*batch T 3"]:
        """Second derivative of the error [rad/s^2]."""
        e, v = self._state.unbind(-2)
        linear = self._rolled_out(self._s)
        z = self._state - torch.stack([linear.position, linear.velocity], dim=-2)
        free = self._motion.spring.acceleration(z[..., 0, :], z[..., 1, :])
        slope = linear.acceleration + free
        drift = torch.func.jvp(axis_drift, (e, v), (self._rate, slope))[1]
        return (slope + drift) / self._duration**2

    @property
    def _rate(self) -> Tensor:
        e, v = self._state.unbind(-2)
        return v + axis_drift(e, v)

    @cached_property
    def _state(self) -> Float[Tensor, "*batch T 2 3"]:
        """State (e, v) at the requested times: one step from the knot before each."""
        # No longer than the interval on which the forcing is smooth.
        size = min(MAXIMUM_STEP, self._motion.response.forced.interval / 2)
        s = self._s.expand(*self._batch, -1) if self._s.ndim > 1 else self._s
        knot = (s.detach() / size).floor()
        z = self._deviations(int(knot.max()), size)
        index = knot.long()[..., None, None].expand(*self._batch, -1, 2, 3)
        z = z.expand(*self._batch, *z.shape[-3:]).gather(-3, index)
        h = s - knot * size
        linear = [self._linear(x) for x in (knot * size, s - h / 2, s)]
        return linear[2] + deviation(z, h, self._motion, linear)

    def _deviations(self, count: int, size: float) -> Float[Tensor, "*batch K 2 3"]:
        """Deviations at the knots 0 to `count`, which are `size` apart."""
        halves = size / 2 * torch.arange(2 * count + 1, dtype=torch.float64)
        linear = self._linear(halves.to(self._s.device)).unbind(-3)
        z = [torch.zeros_like(linear[0])]
        h = torch.tensor(size, dtype=torch.float64, device=self._s.device)
        for k in range(count):
            z.append(deviation(z[-1], h, self._motion, linear[2 * k : 2 * k + 3]))
        return torch.stack(z, dim=-3)

    def _linear(self, s: Tensor) -> Float[Tensor, "*#batch T 2 3"]:
        """State (e, v) without the deviation."""
        motion = self._rolled_out(s)
        return torch.stack([motion.position, motion.velocity], dim=-2)

    def _rolled_out(self, s: Tensor) -> Trajectory:
        boundary, duration = (
            Boundary(self._start, None, self._first),
            _unit_duration(self._motion),
        )
        return self._motion.rollout_columns(boundary, duration, s, self._forcing_gain)


def deviation(
    z: Float[Tensor, "*#batch 2 3"],
    h: Float[Tensor, "*#batch"],
    motion: LinearPrimitive,
    linear: list[Tensor] | tuple[Tensor, ...],
) -> Float[Tensor, "*batch 2 3"]:
    """Deviation z = (e, v) - linear after a step of `h`, with z' = A z + (n, 0).

    Args:
        z: Deviation before the step.
        h: Step in normalised time.
        motion: Primitive with the spring of A.
        linear: Linear (e, v) at the beginning, the middle and the end of the step.
    """
    begin, middle, end = linear
    E = motion.spring.propagator(h.double() / 2).to(z)
    h = h.to(z)[..., None, None]
    # The spring propagates each slope by half a step.
    k1 = _slope(begin + z)
    free = E @ z
    k2 = _slope(middle + free + E @ k1 * (h / 2))
    k3 = _slope(middle + free + k2 * (h / 2))
    k4 = _slope(end + E @ (free + k3 * h))
    return E @ (E @ (z + k1 * (h / 6)) + (k2 + k3) * (h / 3)) + k4 * (h / 6)


def _slope(x: Float[Tensor, "*batch 2 3"]) -> Float[Tensor, "*batch 2 3"]:
    """Nonlinear part (n, 0) of the derivative."""
    drift = axis_drift(x[..., 0, :], x[..., 1, :])
    return torch.stack([drift, torch.zeros_like(drift)], dim=-2)


def _unit_duration(motion: LinearPrimitive) -> Tensor:
    """Duration of one, for which times are s and velocities derivatives by s."""
    return motion.resolve_duration(1.0, None)


# Registered here, so that no module below has to know this one.
FORMULATIONS["ude"] = UdeCoordinates
