"""The orientation primitive of Ude et al. 2014, whose state contains the angular velocity.

eta' = alpha (beta log(g conj q) - eta) + f,   q' = (0, eta) q / 2,   eta = tau omega

This is equation 16 of "Orientation in Cartesian space dynamic movement primitives". Primes are
derivatives with respect to s = t / tau, f is the forcing term, and the logarithm is the
rotation vector with the full angle. With e = log(g conj q) and v = -eta,

    v' = alpha (beta (0 - e) - v) - f,   e' = v + n(e, v),   n = e x v / 2 + c e x (e x v)

with the factor c of `quaternion.axis_drift`. The equations are those of the linear primitive
except for the drift n, which is zero while the axis of rotation is constant. The linear part is
solved exactly, and n is integrated by the Runge-Kutta method of order 4 in the frame of the
linear motion (Lawson 1967, "Generalized Runge-Kutta processes for stable systems"). A step is
stable at any length and exact for rotations about one axis. The logarithm is continuous over
time.
"""

from dataclasses import replace
from functools import cached_property, partial
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.dmp import orientation_error
from hrc_learn.dmp._arguments import Scalars, Times, normalised_time, to_tensor
from hrc_learn.dmp.closed_loop_step import DMPState
from hrc_learn.dmp.dynamics import ROUNDING, SpringDamper
from hrc_learn.dmp.joint_dmp import JointDMP
from hrc_learn.dmp.linear_primitive import Boundary
from hrc_learn.dmp.response import named_response
from hrc_learn.dmp.samples import Samples
from hrc_learn.dmp.solvers import REGULARIZATION, ridge_inverse
from hrc_learn.dmp.trajectory import Trajectory
from hrc_learn.geometry.quaternion import axis_drift, drift_free_rate, drift_free_slope

MAXIMUM_STEP = 1 / 200
"""Longest integration step of a rollout, in normalised time; the error is of fourth order."""
SAMPLES_PER_FUNCTION = 10
"""Times per basis function at which the force of a demonstration is evaluated."""


class UdePrimitive(JointDMP):
    """Primitive of error columns whose state (e, v) is linear except for the axis drift n."""

    @classmethod
    def refitted(cls, linear: JointDMP, errors: Samples) -> "UdePrimitive":
        """Primitive whose forcing makes (e, v) follow the motion of a linear primitive.

        Args:
            linear: Linear primitive fitted to the errors.
            errors: Samples for the fit report.

        Raises:
            ValueError: The demonstration passes a whole turn from its goal, where e' has no
                bound.
        """
        motion = cls(**linear.arguments())
        count = SAMPLES_PER_FUNCTION * motion.basis.count
        s = torch.linspace(0, 1, count, dtype=torch.float64, device=motion.weights.device)
        with torch.no_grad():
            unit = linear.resolve_duration(1.0, None)
            shown = linear.rollout_columns(Boundary(), unit, s)
            e, rate, second = (
                x.double() for x in (shown.position, shown.velocity, shown.acceleration)
            )
            if (e.norm(dim=-1) >= 2 * torch.pi).any():
                raise ValueError(
                    "orientation is a whole turn or more from its end: formulation 'ude' "
                    "cannot follow such a motion, use 'log'"
                )
            v, slope = drift_free_rate(e, rate), drift_free_slope(e, rate, second)
            force = slope - second + motion.spring.alpha * (v - rate)
            change = (ridge_inverse(motion.basis.forcing(s), REGULARIZATION) @ force).mT
            # A new tensor, because `linear` holds the same tensor of weights.
            motion.weights = torch.nn.Parameter(motion.weights + change.to(motion.weights))
            motion.fit_report = errors.compare(motion.rollout().position)
        return motion

    def config(self) -> dict[str, Any]:
        """Contents of a saved primitive besides its tensors, as JSON values."""
        return super().config() | {"formulation": "ude"}

    def coordinates(self) -> Tensor:
        """Raise ValueError, because the motion is not a linear map of coordinates.

        Raises:
            ValueError: Raised in every call.
        """
        raise ValueError("formulation 'ude' is not linear: fit with 'log' instead")

    def with_coordinates(self, *_: Any, **__: Any) -> Any:
        """Raise ValueError, as `coordinates` does."""
        return self.coordinates()

    def rollout_columns(
        self,
        boundary: Boundary,
        duration: Tensor,
        time: Times | None = None,
        forcing_gain: Scalars | None = None,
    ) -> "UdeMotion":
        """Motion of the error, integrated with order 4 in steps up to `MAXIMUM_STEP`."""
        s = self.timestamps if time is None else normalised_time(time, duration)
        start, _, per_s = self.resolve_boundary(boundary, duration)
        start, per_s = torch.broadcast_tensors(start, per_s)
        # Linear part of the state (e, v): a motion of unit duration with the velocity v.
        linear = Boundary(start, None, drift_free_rate(start, per_s))
        unit = self.resolve_duration(1.0, None).expand(self.duration.shape)
        x = self._motion_coordinates(linear, unit, forcing_gain)
        return UdeMotion(coordinates=x, s=s, duration=duration, response=self.response)

    def step_columns(self, state: DMPState, dt: Scalars, **inputs: Any) -> DMPState:
        """State of the error after `dt` [s], by a method of order 4."""
        v = drift_free_rate(state.position, state.rate)
        begin = replace(state, rate=v)
        half = to_tensor(dt, v.dtype, v.device) / 2
        middle = super().step_columns(begin, half, **inputs)
        end = super().step_columns(middle, half, **inputs)
        linear = [torch.stack([x.position, x.rate], dim=-2) for x in (begin, middle, end)]
        change = deviation(torch.zeros_like(linear[0]), end.s - state.s, self.spring, linear)
        e, v = (linear[2] + change).unbind(-2)
        return replace(end, position=e, rate=v + axis_drift(e, v))


def to_reference(state: DMPState, old: Tensor, new: Tensor) -> DMPState:
    """State of the error to another reference, at the same orientation and angular velocity."""
    error, rate = orientation_error.retarget(state.position, state.rate, old, new)
    # The spring force alpha beta (e - goal) is unchanged if e and goal change equally.
    goal = state.goal + error - state.position
    return replace(state, position=error, rate=rate, goal=goal)


class UdeMotion(Trajectory):
    """Error over time: linear motion plus deviation, integrated once on a fixed grid.

    Its coordinates describe the linear part of the state (e, v) at unit duration.
    """

    def _derivative(self, order: int) -> Float[Tensor, "*batch T 3"]:
        e, v = self._state.unbind(-2)
        if order == 0:
            return e
        rate, tau = v + axis_drift(e, v), self.duration[..., None, None]
        if order == 1:
            return rate / tau
        if order > 2:
            raise ValueError("formulation 'ude' has no jerk: fit with 'log' instead")
        linear = self._rolled_out(self.s)
        z = self._state - torch.stack([linear.position, linear.velocity], dim=-2)
        free = self._response.spring.acceleration(z[..., 0, :], z[..., 1, :])
        slope = linear.acceleration + free
        # v' is linear in e'', with the same map as from e' to v; `axis_drift` inverts this map.
        rest = slope - drift_free_slope(e, rate, torch.zeros_like(rate))
        return (rest + axis_drift(e, rest)) / tau**2

    @cached_property
    def _state(self) -> Float[Tensor, "*batch T 2 3"]:
        """State (e, v) at the requested times."""
        if torch.compiler.is_compiling():
            return _state_operator(
                self._coordinates, self.s.expand(*self._batch, -1), self._response.name
            )
        return self.integrate()

    def integrate(self) -> Float[Tensor, "*batch T 2 3"]:
        """State (e, v) at the requested times, by one step from the knot before each time."""
        # Steps are at most half a piece of the response, on which the forcing is smooth.
        size = min(MAXIMUM_STEP, self._response.forced.interval / 2)
        s = self.s.expand(*self._batch, -1) if self.s.ndim > 1 else self.s
        # Later, the motion rests at its goal.
        end = self._response.forced.end + _settling(self._response.spring)
        s = s if self._response.basis.periodic else s.clamp(max=end)
        knot = (s.detach() / size).floor()
        z = self._deviations(int(knot.max()) if knot.numel() else 0, size)
        index = knot.long()[..., None, None].expand(*self._batch, -1, 2, 3)
        z = z.expand(*self._batch, *z.shape[-3:]).gather(-3, index)
        h = s - knot * size
        linear = [self._linear(x) for x in (knot * size, s - h / 2, s)]
        return linear[2] + deviation(z, h, self._response.spring, linear)

    def _deviations(self, count: int, size: float) -> Float[Tensor, "*batch K 2 3"]:
        """Deviations at the knots 0 to `count`, which are `size` apart."""
        halves = size / 2 * torch.arange(2 * count + 1, dtype=torch.float64)
        linear = self._linear(halves.to(self.s.device)).unbind(-3)
        z = [torch.zeros_like(linear[0])]
        h = torch.tensor(size, dtype=torch.float64, device=self.s.device)
        for k in range(count):
            z.append(deviation(z[-1], h, self._response.spring, linear[2 * k : 2 * k + 3]))
        return torch.stack(z, dim=-3)

    def _linear(self, s: Tensor) -> Float[Tensor, "*#batch T 2 3"]:
        """State (e, v) without the deviation."""
        motion = self._rolled_out(s)
        return torch.stack([motion.position, motion.velocity], dim=-2)

    def _rolled_out(self, s: Tensor) -> Trajectory:
        unit = torch.ones_like(self.duration)
        return Trajectory(coordinates=self._given, s=s, duration=unit, response=self._response)


# The number of steps depends on the times, which a compiler cannot follow: to compilers the
# integration and its adjoint are one operator each.


@torch.library.custom_op("hrc_learn::ude_state", mutates_args=())
def _state_operator(x: Tensor, s: Tensor, response: str) -> Tensor:
    return _integrated(x, s, response)


@torch.library.custom_op("hrc_learn::ude_state_adjoint", mutates_args=())
def _state_adjoint(grad: Tensor, x: Tensor, s: Tensor, response: str) -> tuple[Tensor, Tensor]:
    by_x, by_s = torch.func.vjp(partial(_integrated, response=response), x, s)[1](grad)
    return by_x, by_s


def _integrated(x: Tensor, s: Tensor, response: str) -> Tensor:
    """State (e, v) of the motion with coordinates `x` at normalised times `s`."""
    unit = torch.ones_like(s[..., 0])
    motion = UdeMotion(coordinates=x, s=s, duration=unit, response=named_response(response))
    return motion.integrate().clone()


def _differentiate(ctx: Any, grad: Tensor) -> tuple[Tensor, Tensor, None]:
    return *_state_adjoint(grad, *ctx.saved_tensors, ctx.response), None


def _keep(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
    *saved, ctx.response = inputs
    ctx.save_for_backward(*saved)


_state_operator.register_autograd(_differentiate, setup_context=_keep)
_state_operator.register_fake(lambda x, s, response: x.new_empty(*s.shape, 2, 3))
_state_adjoint.register_fake(
    lambda grad, x, s, response: (torch.empty_like(x), torch.empty_like(s))
)


def deviation(
    z: Float[Tensor, "*#batch 2 3"],
    h: Float[Tensor, "*#batch"],
    spring: SpringDamper,
    linear: list[Tensor] | tuple[Tensor, ...],
) -> Float[Tensor, "*batch 2 3"]:
    """Deviation z = (e, v) - linear after a step of `h`, with z' = A z + (n, 0).

    Args:
        z: Deviation before the step.
        h: Step in normalised time.
        spring: Spring that determines A.
        linear: Linear part of (e, v) at the beginning, the middle and the end of the step.
    """
    begin, middle, end = linear
    E = spring.propagator(h.double() / 2).to(z)
    h = h.to(z)[..., None, None]
    # The spring propagates each slope by half a step.
    k1 = _slope(begin + z)
    free = E @ z
    k2 = _slope(middle + free + E @ k1 * (h / 2))
    k3 = _slope(middle + free + k2 * (h / 2))
    k4 = _slope(end + E @ (free + k3 * h))
    return E @ (E @ (z + k1 * (h / 6)) + (k2 + k3) * (h / 3)) + k4 * (h / 6)


def _settling(spring: SpringDamper) -> float:
    """Normalised time after which the unforced motion is lost in rounding."""
    # The product of the two modes of an overdamped spring is its stiffness.
    return ROUNDING / min(spring.alpha / 2, spring.stiffness * spring.smooth_interval)


def _slope(x: Float[Tensor, "*batch 2 3"]) -> Float[Tensor, "*batch 2 3"]:
    """Nonlinear part (n, 0) of the derivative."""
    drift = axis_drift(x[..., 0, :], x[..., 1, :])
    return torch.stack([drift, torch.zeros_like(drift)], dim=-2)
