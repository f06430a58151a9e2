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

from dataclasses import replace
from functools import cached_property
from typing import Any

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
from hrc_learn.dmp.closed_loop_step import DMPState
from hrc_learn.dmp.joint_dmp import JointDMP
from hrc_learn.dmp.linear_primitive import Boundary
from hrc_learn.dmp.samples import Samples
from hrc_learn.dmp.solvers import REGULARIZATION, ridge_inverse
from hrc_learn.dmp.trajectory import Trajectory, output
from hrc_learn.geometry.quaternion import axis_drift, drift_free_rate, drift_free_slope

MAXIMUM_STEP = 1 / 200
"""Longest integration step of a rollout, in s; the error is of fourth order in it."""
SAMPLES_PER_FUNCTION = 10
"""Times per basis function at which the force of a demonstration is evaluated."""


class UdePrimitive(JointDMP):
    """Error columns in which (e, v) moves linearly except for the drift of the axis."""

    @classmethod
    def refitted(cls, linear: JointDMP, errors: Samples) -> "UdePrimitive":
        """Primitive with the force that this state needs to follow the path of a linear one.

        Args:
            linear: Fitted to the errors.
            errors: Samples for the fit report.

        Raises:
            ValueError: The demonstration passes a whole turn from its goal, where e' has no
                bound.
        """
        motion = UdePrimitive.of(linear)
        count = SAMPLES_PER_FUNCTION * motion.basis.count
        s = torch.linspace(0, 1, count, dtype=torch.float64, device=motion.weights.device)
        with torch.no_grad():
            shown = linear.rollout_columns(Boundary(), _unit_duration(motion), s)
            e, rate, second = (
                x.double() for x in (shown.position, shown.velocity, shown.acceleration)
            )
            if (e.norm(dim=-1) >= 2 * torch.pi).any():
                raise ValueError(
                    "orientation is a whole turn or more from its end: formulation 'ude' "
                    "cannot follow that, use 'log'"
                )
            v, slope = drift_free_rate(e, rate), drift_free_slope(e, rate, second)
            force = slope - second + motion.spring.alpha * (v - rate)
            change = (ridge_inverse(motion.basis.forcing(s), REGULARIZATION) @ force).mT
            # A new tensor, because both primitives share the weights until here.
            motion.weights = torch.nn.Parameter(motion.weights + change.to(motion.weights))
            motion.fit_report = errors.compare(motion.rollout().position)
        return motion

    @classmethod
    def of(cls, linear: JointDMP) -> "UdePrimitive":
        """Primitive that shares the weights of a linear one."""
        return cls(**linear.arguments())

    def config(self) -> dict[str, Any]:
        """Contents of a saved primitive besides its tensors, as JSON values."""
        return super().config() | {"formulation": "ude"}

    def coordinates(self) -> Tensor:
        """Refuse: the motion is not a linear map of coordinates.

        Raises:
            ValueError: Always.
        """
        raise ValueError("formulation 'ude' is not linear: fit with 'log' instead")

    def with_coordinates(self, *_: Any, **__: Any) -> Any:
        """Refuse, as `coordinates` does."""
        return self.coordinates()

    def rollout_columns(
        self,
        boundary: Boundary,
        duration: Tensor,
        time: Times | None = None,
        forcing_gain: Scalars | None = None,
    ) -> "UdeMotion":
        """Motion of the error, of order 4 in `MAXIMUM_STEP`."""
        s = self.timestamps if time is None else normalised_time(time, duration)
        start, _, per_s = self.resolve_boundary(boundary, duration)
        return UdeMotion(self, s, start, duration, per_s, forcing_gain)

    def step_columns(self, state: DMPState, dt: Scalars, **inputs: Any) -> DMPState:
        """State of the error after `dt` [s], of order 4 in it."""
        v = drift_free_rate(state.position, state.rate)
        begin = replace(state, rate=v)
        half = to_tensor(dt, v.dtype, v.device) / 2
        middle = super().step_columns(begin, half, **inputs)
        end = super().step_columns(middle, half, **inputs)
        linear = [torch.stack([x.position, x.rate], dim=-2) for x in (begin, middle, end)]
        change = deviation(torch.zeros_like(linear[0]), end.s - state.s, self, linear)
        e, v = (linear[2] + change).unbind(-2)
        return replace(end, position=e, rate=v + axis_drift(e, v))


def to_reference(state: DMPState, old: Tensor, new: Tensor) -> DMPState:
    """State of the error to another reference, for the same motion of the orientation."""
    q = orientation_error.to_orientation(state.position, old)
    error = orientation_error.to_error(q, new)
    error = orientation_error.nearest_turn(error, state.position)
    v = drift_free_rate(state.position, state.rate)
    # The spring force alpha beta (e - goal) is unchanged if both move alike.
    return replace(
        state,
        position=error,
        rate=v + axis_drift(error, v),
        goal=state.goal + error - state.position,
    )


class UdeMotion(Trajectory):
    """Error over time: linear motion plus deviation, integrated once on a fixed grid."""

    def __init__(
        self,
        motion: UdePrimitive,
        s: Float[Tensor, "*#batch T"],
        start: Float[Tensor, "*#batch 3"],
        duration: Float[Tensor, "*#batch"],
        per_s: Float[Tensor, "*#batch 3"],
        forcing_gain: Scalars | None,
    ):
        """Describe a motion.

        Args:
            motion: Weights and gains.
            s: Normalised times.
            start: Error at the start [rad].
            duration: [s].
            per_s: Rate de/ds of the error at the start [rad].
            forcing_gain: Factor on the forcing term.
        """
        start, per_s = torch.broadcast_tensors(start, per_s)
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
        linear = super(UdePrimitive, self._motion).rollout_columns
        return linear(boundary, duration, s, self._forcing_gain)


def deviation(
    z: Float[Tensor, "*#batch 2 3"],
    h: Float[Tensor, "*#batch"],
    motion: JointDMP,
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


def _unit_duration(motion: JointDMP) -> Tensor:
    """Duration of one, for which times are s and velocities derivatives by s."""
    return motion.resolve_duration(1.0, None)
