"""State of a primitive that runs in closed loop, and the exact step to the next state.

The equation of motion is linear, so each term (forcing, goal filter, coupling) has a particular
solution, which is known before and after a step. The difference between the state and the sum
of these solutions decays like the unforced spring. Steps of any length are therefore exact.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from hrc_learn.dmp._arguments import fits_numpy, readable
from hrc_learn.dmp.dynamics import SpringDamper, approach_state
from hrc_learn.dmp.response import Response
from hrc_learn.geometry import minimum_jerk

RESONANCE = 1e-3
"""Smallest allowed |rate^2 - alpha rate + alpha beta| / (alpha beta) of a goal filter. If this
ratio is near zero, the rate is near a mode of the spring: the particular solution gets so large
that digits are lost."""
_FULL_PACE = torch.ones((), dtype=torch.float64)
"""Pace of an undisturbed motion; one tensor, because making a tensor is slower than a sum."""


@dataclass(frozen=True, kw_only=True, eq=False)
class DMPState:
    """State of a primitive in closed loop; every step returns a new one.

    It is a pytree that passes through `torch.func` and `torch.export`. To follow a robot that
    was pushed, replace the position by the measured position.
    """

    position: Float[Tensor, "*batch D"]
    rate: Float[Tensor, "*batch D"]
    """dy/ds, the velocity times the duration."""
    start: Float[Tensor, "*batch D"]
    goal: Float[Tensor, "*batch D"]
    """Current attractor of the motion."""
    displacement: Float[Tensor, "*batch D"]
    """Goal minus start at the beginning of the motion."""
    target: Float[Tensor, "*batch D"]
    """Commanded goal, which a filtered goal approaches gradually."""
    duration: Float[Tensor, "*batch"]
    """Duration of the motion if nothing slows it [s]."""
    pace: Float[Tensor, "*batch"]
    """Relative speed of the clock in the last step: 1 if undisturbed, less if slowed."""
    s: Float[Tensor, "*batch"]
    """Normalised time, 1 at the end of the motion; float64, as rounding adds up over steps."""
    forced: Float[Tensor, "*batch 2 D"]
    """State (y, dy/ds) caused so far by the unscaled forcing term alone."""

    @property
    def velocity(self) -> Float[Tensor, "*batch D"]:
        """Velocity, position units per second."""
        return self.rate * (self.pace / self.duration)[..., None]


torch.export.register_dataclass(DMPState, serialized_type_name="hrc_learn.dmp.DMPState")


def step(
    state: DMPState,
    ds: Float[Tensor, "*#batch"] | float,
    *,
    response: Response,
    weights: Float[Tensor, "*#batch D N"],
    scale: Callable[[Tensor], Tensor],
    gain: Float[Tensor, "*#batch 1 1"] | None,
    goal_filter: float | None,
    push: Float[Tensor, "*#batch D"] | None,
    pace: Float[Tensor, "*batch"],
) -> DMPState:
    """Advance by `ds`, with all coupling terms constant over the step.

    Args:
        state: Current state.
        ds: Step in normalised time (float64); a number if nothing traces or differentiates it.
        response: Response of the primitive.
        weights: Weights of the unscaled forcing term.
        scale: Function that scales states (*batch, 2, D) caused by the forcing term.
        gain: Factor on the scaled states.
        goal_filter: Rate in dg/ds = -rate (g - target); None: the goal jumps to its target.
        push: Term added to the second derivative of the position with respect to s.
        pace: Speed of the clock, stored for the velocity.
    """
    spring, s, target = response.spring, state.s + ds, state.target
    now = host_value(s)
    if isinstance(now, float):
        forced = torch.from_numpy(response.forced.at(now))
    else:
        ds = ds if isinstance(ds, Tensor) else torch.full_like(s, ds)
        forced = response.forced.to(s.device)(s)
    E, coast = spring.propagator(ds), response.coasting(now)
    forced = forced.to(target) @ weights.mT
    if isinstance(coast, Tensor) or coast > 0:  # after the forcing, the spring acts alone
        forced = spring.propagator(coast).to(target) @ forced
    # States caused by the forcing before and after the step. The offset from them decays.
    before, after = scale(state.forced), scale(forced)
    if gain is not None:
        before, after = gain * before, gain * after
    if response.approach:
        # The approach from start to goal adds to the effect of the weights, without scaling.
        fraction, displacement = response.approach, state.displacement[..., None, :]
        curve = approach_state(torch.stack([state.s, s]), fraction).to(displacement)
        before = before + curve[0][..., None] * displacement
        after = after + curve[1][..., None] * displacement
    goal = target
    if goal_filter is not None:
        goal, lag_before, lag_after = _filtered(state.goal, target, ds, goal_filter, spring)
        before, after = before + lag_before, after + lag_after
    # Positions are relative to the equilibrium, at which the spring balances a push.
    rest = target if push is None else target + push / spring.stiffness
    y = torch.stack([state.position - rest, state.rate], dim=-2)
    E, y = E.to(target), y - before
    # One fused operation for shapes that allow it.
    y = torch.addmm(after, E, y) if E.ndim == y.ndim == after.ndim == 2 else E @ y + after
    offset, rate = y.unbind(dim=-2)
    return replace(
        state, position=offset + rest, rate=rate, goal=goal, pace=pace, s=s, forced=forced
    )


def numpy_step(
    E: Float64[np.ndarray, "2 2"],
    y: Float64[np.ndarray, "2 D"],
    before: Float64[np.ndarray, "2 D"],
    after: Float64[np.ndarray, "2 D"],
    rest: Float64[np.ndarray, "D"],
) -> Float64[np.ndarray, "2 D"]:
    """State (y, dy/ds) after a step of one motion, as in `step`.

    Args:
        E: Transition matrix of the spring over the step.
        y: State before the step.
        before: State caused by the forcing, at the beginning of the step.
        after: State caused by the forcing, at the end of the step.
        rest: Equilibrium of the spring.
    """
    offset = y - before
    offset[0] -= rest
    y = E.dot(offset)
    y += after
    y[0] += rest
    return y


def uncoupled_step(
    state: DMPState, dt: float, response: Response, weights: Float[Tensor, "*#batch D N"]
) -> DMPState | None:
    """`step` for one motion without coupling, computed with NumPy in a third of the time.

    For so few numbers, dispatch in PyTorch takes far longer than the arithmetic.

    Returns:
        State after the step. None where NumPy cannot compute it: with gradients, `vmap` or
        tracing, for a batch, or for tensors that are not float64 on the CPU.
    """
    if weights.ndim != 2 or weights.dtype is not torch.float64:
        return None
    if state.s.ndim or state.duration.ndim or state.pace.ndim:
        return None
    if not fits_numpy(weights, *vars(state).values()):
        return None
    begin, ds = state.s.item(), dt / state.duration.item()
    now = begin + ds
    after = response.forced.at(now).dot(weights.detach().numpy().T)
    if coast := response.coasting(now):
        after = response.spring.propagator(coast).numpy().dot(after)
    before, forced = state.forced.numpy(), after
    if response.approach:
        displacement = state.displacement.numpy()
        before = before + numpy_approach(begin, response.approach, displacement)
        after = after + numpy_approach(now, response.approach, displacement)
    y = np.empty_like(before)
    y[0], y[1] = state.position.numpy(), state.rate.numpy()
    E = response.spring.propagator(ds).numpy()
    y = numpy_step(E, y, before, after, state.target.numpy())
    return DMPState(
        position=torch.from_numpy(y[0]),
        rate=torch.from_numpy(y[1]),
        start=state.start,
        goal=state.target,
        displacement=state.displacement,
        target=state.target,
        duration=state.duration,
        pace=_FULL_PACE,
        s=torch.from_numpy(np.array(now)),
        forced=torch.from_numpy(forced),
    )


def numpy_approach(
    s: float, fraction: float, displacement: Float64[np.ndarray, "D"]
) -> Float64[np.ndarray, "2 D"]:
    """`approach_state` of one motion at `s`, times the displacement from start to goal."""
    m, slope = minimum_jerk(s / fraction)
    return np.multiply.outer([m - 1.0, slope / fraction], displacement)


def _filtered(
    goal: Tensor, target: Tensor, ds: Tensor | float, rate: float, spring: SpringDamper
) -> tuple[Tensor, Tensor, Tensor]:
    """Filtered goal g after a step, and the states (y - target, y') that g causes.

    The first of these states holds before the step, the second after it.
    For a goal that decays to its target, the particular solution is y_p = target +
    k (g - target) with k = alpha beta / (rate^2 - alpha rate + alpha beta).
    """
    denominator = rate**2 - spring.alpha * rate + spring.stiffness
    if not 0 < rate < math.inf or abs(denominator) < RESONANCE * spring.stiffness:
        raise ValueError(
            f"goal_filter must be positive and not near a mode of the spring, got {rate}"
        )
    gain = spring.stiffness / denominator
    lag_before = goal - target
    if isinstance(ds, Tensor):
        lag_after = lag_before * torch.exp(-rate * ds).to(goal)[..., None]
    else:
        lag_after = lag_before * math.exp(-rate * ds)
    before, after = (
        torch.stack([gain * lag, -rate * gain * lag], dim=-2) for lag in (lag_before, lag_after)
    )
    return target + lag_after, before, after


def host_value(time: Tensor) -> Tensor | float:
    """Time as a number if the tensor is a scalar that is neither differentiated nor traced."""
    if not readable(time) or time.ndim or type(time) is not Tensor or time.requires_grad:
        return time
    # Reading from another device would wait for all work queued there.
    return time.item() if time.is_cpu else time
