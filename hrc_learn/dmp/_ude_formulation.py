"""The orientation primitive of Ude et al. 2014, whose state is the angular velocity.

eta' = alpha (beta log(g conj q) - eta) + f,   q' = (0, eta) q / 2,   eta = tau omega

("Orientation in Cartesian space dynamic movement primitives", eq. 16; primes by s = t / tau,
the logarithm here the full angle). With the error e = log(g conj q) and v = -eta,

    v' = alpha (beta (0 - e) - v) - f,   e' = v + n(e, v),   n = e x v / 2 + c e x (e x v)

which is the linear primitive but for n, zero while the axis of the turn stays. So the linear
part is solved exactly, as ever, and n is integrated by Runge and Kutta's method of order 4 on
what is left (Lawson 1967, "Generalized Runge-Kutta processes for stable systems"): a step is
stable at any length and exact about one axis. The logarithm is followed continuously.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.dmp import orientation_error
from hrc_learn.dmp._arguments import Samples, Scalars, Times, to_tensor
from hrc_learn.dmp._closed_loop_step import DMPState
from hrc_learn.dmp._fitting import ridge_inverse
from hrc_learn.dmp._system.response import Trajectory, broadcast_shapes
from hrc_learn.dmp.linear_primitive import Ends, LinearPrimitive
from hrc_learn.dmp.orientation_dmp import FORMULATIONS, OrientationCoordinates
from hrc_learn.geometry.quaternion import axis_drift, drift_free_rate, drift_free_slope

LONGEST = 1 / 200
"""Longest step of a rollout, in s; the fourth power of it is what the rollout is off by."""

SAMPLES = 10
"""Times per basis function at which the force of a demonstration is read."""

RIDGE = 1e-7
"""Of the regression of that force, relative to its largest singular value: as in `fit`."""


@dataclass(frozen=True, eq=False)
class UdeCoordinates(OrientationCoordinates):
    """The error as ever, but what moves linearly is (e, v), up to the drift of its axis."""

    linear: ClassVar[bool] = False

    @staticmethod
    def follow(motion: LinearPrimitive, errors: Samples) -> None:
        """Add to fitted weights what the other state takes to follow the same path.

        Raises:
            ValueError: The demonstration passes a whole turn from its goal, where e' has no
                bound.
        """
        count = SAMPLES * motion.basis.count
        s = torch.linspace(0, 1, count, dtype=torch.float64, device=motion.weights.device)
        with torch.no_grad():
            linear = motion.roll(Ends(velocity=_per_s(motion)), _one(motion), s)
            e, rate, curvature = (
                x.double() for x in (linear.position, linear.velocity, linear.acceleration)
            )
            if (e.norm(dim=-1) >= 2 * torch.pi).any():
                raise ValueError(
                    "orientation is a whole turn or more from its end: formulation 'ude' "
                    "cannot follow that, use 'log'"
                )
            v, slope = drift_free_rate(e, rate), drift_free_slope(e, rate, curvature)
            force = slope - curvature + motion.spring.alpha * (v - rate)
            change = (ridge_inverse(motion.basis.forcing(s), RIDGE) @ force).mT
            motion.weights += change.to(motion.weights)
            ends = motion.start, motion.duration, motion.start_velocity
            reproduction = UdeMotion(motion, motion.timestamps, *ends, None).position.mT
        motion.fit_report = errors.compare(reproduction.reshape(errors.position.shape))

    def roll(
        self,
        motion: LinearPrimitive,
        ends: Ends,
        duration: Tensor,
        time: Times | None,
        forcing_gain: Scalars | None,
    ) -> "UdeMotion":
        """Of order 4 in `LONGEST`."""
        s = motion.normalised_time(time, duration)
        start, velocity = to_tensor(ends.start), to_tensor(ends.velocity)  # pyright: ignore[reportArgumentType]
        return UdeMotion(motion, s, start, duration, velocity, forcing_gain)

    def advance(
        self, motion: LinearPrimitive, columns: DMPState, dt: Any, **step: Any
    ) -> DMPState:
        """Of order 4 in `dt`."""
        v = drift_free_rate(columns.position, columns.rate)
        begin = replace(columns, rate=v)
        half = to_tensor(dt, v.dtype, v.device) / 2
        middle = motion.advance(begin, half, **step)
        end = motion.advance(middle, half, **step)
        linear = [torch.stack([x.position, x.rate], dim=-2) for x in (begin, middle, end)]
        h = end.s - columns.s
        left = deviation(torch.zeros_like(linear[0]), h, motion, linear)
        e, v = (linear[2] + left).unbind(-2)
        return replace(end, position=e, rate=v + axis_drift(e, v))

    def external_acceleration(
        self, motion: LinearPrimitive, columns: DMPState, frame: Tensor, coupling: Any
    ) -> Tensor | None:
        """On v, which is minus the angular velocity."""
        if coupling is None:
            return None
        return -to_tensor(coupling, frame.dtype, frame.device)

    def _to_reference(
        self, motion: LinearPrimitive, columns: DMPState, old: Tensor, new: Tensor
    ) -> DMPState:
        """With a goal filter the angular acceleration goes on as it was."""
        q = orientation_error.to_orientation(columns.position, old)
        error = orientation_error.to_error(q, new)
        error = orientation_error.nearest_turn(error, columns.position)
        v = drift_free_rate(columns.position, columns.rate)
        # The pull is alpha beta (e - goal): it stays when both move alike.
        return replace(
            columns,
            position=error,
            rate=v + axis_drift(error, v),
            goal=columns.goal + error - columns.position,
        )


class UdeMotion:
    """The error over time: linear motion plus deviation, integrated once on a fixed grid."""

    def __init__(
        self,
        motion: LinearPrimitive,
        s: Float[Tensor, "*#batch T"],
        start: Float[Tensor, "*#batch 3"],
        duration: Float[Tensor, "*#batch"],
        rate: Float[Tensor, "*#batch 3"],
        forcing_gain: Scalars | None,
    ):
        """Describe the motion.

        Args:
            motion: Weights and gains.
            s: Normalised times.
            start: Error [rad].
            duration: [s].
            rate: Of the error [rad/s].
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

    @cached_property
    def time(self) -> Float[Tensor, "*batch T"]:
        """Since the start of the motion [s]."""
        return (self._s * self._duration[..., 0]).to(self._start).expand(*self._batch, -1)

    @cached_property
    def position(self) -> Float[Tensor, "*batch T 3"]:
        """[rad]."""
        return self._state[..., 0, :]

    @cached_property
    def velocity(self) -> Float[Tensor, "*batch T 3"]:
        """[rad/s]."""
        return self._rate / self._duration

    @cached_property
    def acceleration(self) -> Float[Tensor, "*batch T 3"]:
        """[rad/s^2]."""
        e, v = self._state.unbind(-2)
        linear = self._linear(self._s)
        z = self._state - linear
        slope = self._curvature + self._motion.spring.acceleration(z[..., 0, :], z[..., 1, :])
        drift = torch.func.jvp(axis_drift, (e, v), (self._rate, slope))[1]
        return (slope + drift) / self._duration**2

    @property
    def _rate(self) -> Tensor:
        e, v = self._state.unbind(-2)
        return v + axis_drift(e, v)

    @cached_property
    def _state(self) -> Float[Tensor, "*batch T 2 3"]:
        """(e, v) at the times asked for: from the knot before each, by one step."""
        # No longer than what the forcing changes smoothly over.
        size = min(LONGEST, self._motion.response.forced.interval / 2)
        s = self._s.expand(*self._batch, -1) if self._s.ndim > 1 else self._s
        knot = (s.detach() / size).floor()
        z = self._deviations(int(knot.max()), size)
        index = knot.long()[..., None, None].expand(*self._batch, -1, 2, 3)
        z = z.expand(*self._batch, *z.shape[-3:]).gather(-3, index)
        h = s - knot * size
        linear = [self._linear(x) for x in (knot * size, s - h / 2, s)]
        return linear[2] + deviation(z, h, self._motion, linear)

    def _deviations(self, count: int, size: float) -> Float[Tensor, "*batch K 2 3"]:
        """At the knots, `size` apart, from the start to number `count`."""
        halves = size / 2 * torch.arange(2 * count + 1, dtype=torch.float64)
        linear = self._linear(halves.to(self._s.device)).unbind(-3)
        z = [torch.zeros_like(linear[0])]
        h = torch.tensor(size, dtype=torch.float64, device=self._s.device)
        for k in range(count):
            z.append(deviation(z[-1], h, self._motion, linear[2 * k : 2 * k + 3]))
        return torch.stack(z, dim=-3)

    def _linear(self, s: Tensor) -> Float[Tensor, "*#batch T 2 3"]:
        """(e, v) without the deviation."""
        motion = self._rolled(s)
        return torch.stack([motion.position, motion.velocity], dim=-2)

    @property
    def _curvature(self) -> Tensor:
        return self._rolled(self._s).acceleration

    def _rolled(self, s: Tensor) -> Trajectory:
        # A duration of one: times are s, velocities per s.
        ends = Ends(self._start, None, self._first)
        return self._motion.roll(ends, _one(self._motion), s, self._forcing_gain)


def deviation(
    z: Float[Tensor, "*#batch 2 3"],
    h: Float[Tensor, "*#batch"],
    motion: LinearPrimitive,
    linear: list[Tensor] | tuple[Tensor, ...],
) -> Float[Tensor, "*batch 2 3"]:
    """What z = (e, v) - linear, z' = A z + (n, 0), becomes over a step of `h`.

    Args:
        z: At the beginning.
        h: Step in normalised time.
        motion: Whose spring A is.
        linear: The linear (e, v) at the beginning, the middle and the end of the step.
    """
    begin, middle, end = linear
    E = motion.spring.propagator(h.double() / 2).to(z)
    h = h.to(z)[..., None, None]
    # Slopes are carried along by the spring, by half a step each.
    k1 = _slope(begin + z)
    free = E @ z
    k2 = _slope(middle + free + E @ k1 * (h / 2))
    k3 = _slope(middle + free + k2 * (h / 2))
    k4 = _slope(end + E @ (free + k3 * h))
    return E @ (E @ (z + k1 * (h / 6)) + (k2 + k3) * (h / 3)) + k4 * (h / 6)


def _slope(x: Float[Tensor, "*batch 2 3"]) -> Float[Tensor, "*batch 2 3"]:
    """(n, 0)."""
    drift = axis_drift(x[..., 0, :], x[..., 1, :])
    return torch.stack([drift, torch.zeros_like(drift)], dim=-2)


def _per_s(motion: LinearPrimitive) -> Tensor:
    """Demonstrated start velocity, per s."""
    return motion.start_velocity * motion.duration[..., None]


def _one(motion: LinearPrimitive) -> Tensor:
    """The duration of a motion whose times are s."""
    return motion.resolve_duration(1.0, None)


# Where `OrientationDMP` finds it: nothing below this module has to know of it.
FORMULATIONS["ude"] = UdeCoordinates
