"""A primitive in closed loop: its state, one exact step, and a motion from under way on.

What moves a primitive is linear: each coupling term has a motion of its own that solves the
equation alone, known at both ends of the step. What the state differs from the sum of those
dies out as the unforced spring has it. So no step is too long, whatever its length.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.dmp._arguments import fits_numpy, readable
from hrc_learn.dmp._system.closed_forms import SpringDamper, approach_state
from hrc_learn.dmp._system.response import Response, broadcast_shapes


@dataclass(frozen=True, kw_only=True, eq=False)
class DMPState:
    """Where a primitive is while it is stepped; every step makes a new one.

    A pytree: goes through `torch.func` and `torch.export` as it is.

    To follow a robot that was pushed, replace the position by the measured one.
    """

    position: Float[Tensor, "*batch D"]
    rate: Float[Tensor, "*batch D"]
    """dy/ds, the velocity times the duration."""
    start: Float[Tensor, "*batch D"]
    goal: Float[Tensor, "*batch D"]
    """What attracts the motion now."""
    way: Float[Tensor, "*batch D"]
    """Goal minus start, as the motion began."""
    target: Float[Tensor, "*batch D"]
    """Where the goal was last told to be; a filtered goal takes a while to get there."""
    duration: Float[Tensor, "*batch"]
    """[s] that the motion takes when nothing slows it."""
    pace: Float[Tensor, "*batch"]
    """Speed of the last step: 1 undisturbed, towards 0 the more it was slowed."""
    s: Float[Tensor, "*batch"]
    """Normalised time, 1 at the end of the motion. Float64: a thousand additions show."""
    forced: Float[Tensor, "*batch 2 D"]
    """(y, dy/ds) that the unscaled forcing term alone has caused by `s`."""

    @property
    def velocity(self) -> Float[Tensor, "*batch D"]:
        """Per second."""
        return self.rate * (self.pace / self.duration)[..., None]


torch.export.register_dataclass(DMPState, serialized_type_name="hrc_learn.dmp.DMPState")


RESONANCE = 1e-3
"""How close to a mode of the spring a goal filter may come, relative to the stiffness: the
particular motion grows as its inverse, and digits are lost by as much."""


def begin(
    response: Response,
    weights: Float[Tensor, "*#batch D N"],
    start: Float[Tensor, "*#batch D"],
    goal: Float[Tensor, "*#batch D"],
    rate: Float[Tensor, "*#batch D"],
    duration: Float[Tensor, "*#batch"],
) -> DMPState:
    """Where a motion starts.

    Args:
        response: Of the primitive.
        weights: Of the unscaled forcing term.
        start: y_0.
        goal: g.
        rate: dy/ds.
        duration: [s].
    """
    batch = broadcast_shapes(
        weights.shape[:-2], *(x.shape[:-1] for x in (start, goal, rate)), duration.shape
    )
    start, goal, rate = (x.expand(*batch, -1) for x in (start, goal, rate))
    duration = duration.expand(batch)
    s = torch.zeros_like(duration, dtype=torch.float64)
    # Copies: an export takes one tensor in two places for one input.
    return DMPState(
        position=start.clone(),
        rate=rate,
        start=start,
        goal=goal,
        way=goal - start,
        target=goal.clone(),
        duration=duration,
        pace=torch.ones_like(duration),
        s=s,
        forced=response.forced.to(s.device)(s).to(start) @ weights.mT,
    )


def advance(
    state: DMPState,
    ds: Float[Tensor, "*#batch"] | float,
    *,
    response: Response,
    weights: Float[Tensor, "*#batch D N"],
    scale: Callable[[Tensor], Tensor],
    target: Float[Tensor, "*batch D"],
    goal_filter: float | None,
    push: Float[Tensor, "*#batch D"] | None,
    pace: Float[Tensor, "*batch"],
) -> DMPState:
    """Advance by `ds`, all coupling terms as given for the whole step.

    Args:
        state: Where the primitive is.
        ds: Step in normalised time (float64); a number where nothing traces or derives it.
        response: Of the primitive.
        weights: Of the unscaled forcing term.
        scale: What the ends make of (*batch, K, D) that the forcing term causes.
        target: Where the goal shall be.
        goal_filter: Rate dg/ds = -rate (g - target); None: the goal is there at once.
        push: Constant second derivative added to the motion, by s.
        pace: Kept in the state for its velocity.
    """
    spring, s = response.spring, state.s + ds
    (now,) = host_values(s)
    if isinstance(ds, float) and isinstance(now, Tensor):
        ds = torch.full_like(s, ds)
    E, coast = _transitions(spring, ds, response.coasting(now))
    forced = response.forced.to(s.device)(now).to(target) @ weights.mT
    if coast is not None:
        forced = coast.to(target) @ forced
    # What the forcing causes is known at both ends of the step; the difference dies out.
    before, after = scale(state.forced), scale(forced)
    if response.approach:
        # Along the curve of an approach start and goal act beside the weights, unscaled.
        share, way = response.approach, state.way[..., None, :]
        before = before + approach_state(state.s, share).to(way)[..., None] * way
        after = after + approach_state(s, share).to(way)[..., None] * way
    goal = target
    if goal_filter is not None:
        goal, behind, ahead = _lagging(state.goal, target, ds, goal_filter, spring)
        before, after = before + behind, after + ahead
    # Seen from where it would rest: there the spring balances a push.
    rest = target if push is None else target + push / spring.stiffness
    y = torch.stack([state.position - rest, state.rate], dim=-2)
    offset, velocity = _product_plus(E.to(target), y - before, after).unbind(dim=-2)
    return DMPState(
        position=offset + rest,
        rate=velocity,
        start=state.start,
        goal=goal,
        way=state.way,
        target=target,
        duration=state.duration,
        pace=pace,
        s=s,
        forced=forced,
    )


def advance_alone(
    state: DMPState, dt: float, response: Response, weights: Float[Tensor, "*batch D N"]
) -> DMPState | None:
    """`advance` of one motion that nothing couples to, in NumPy: a third of the time.

    Of so few numbers PyTorch takes far longer to find out what to do than to do it.

    Returns:
        None where it does not apply: something derives, maps or traces the motion, or it is a
        batch, on another device or not in float64.
    """
    tensors = (
        *(weights, state.position, state.rate, state.target, state.forced),
        *(state.s, state.duration, state.pace),
    )
    if response.approach or weights.ndim != 2 or weights.dtype is not torch.float64:
        return None
    if state.s.ndim or state.duration.ndim or state.pace.ndim or not fits_numpy(*tensors):
        return None
    ds = dt / state.duration.item()
    now = state.s.item() + ds
    E = response.spring.propagator(ds).numpy()
    rest, before = state.target.numpy(), state.forced.numpy()
    w = weights.detach().numpy()
    after = response.forced.at(now).dot(w.T)
    if coast := response.coasting(now):
        after = response.spring.propagator(coast).numpy().dot(after)
    y = np.empty_like(before)
    np.subtract(state.position.numpy(), rest, out=y[0])
    y[1] = state.rate.numpy()
    y = E.dot(y - before)
    y += after
    y[0] += rest
    return DMPState(
        position=torch.from_numpy(y[0]),
        rate=torch.from_numpy(y[1]),
        start=state.start,
        goal=state.target,
        way=state.way,
        target=state.target,
        duration=state.duration,
        pace=_UNDISTURBED,
        s=torch.from_numpy(np.array(now)),
        forced=torch.from_numpy(after),
    )


_UNDISTURBED = torch.ones((), dtype=torch.float64)
"""The pace of every motion that nothing slows: to make another one takes longer than to add."""


def second_derivative(
    state: DMPState,
    response: Response,
    weights: Float[Tensor, "*#batch D N"],
    scale: Callable[[Tensor], Tensor],
) -> Float[Tensor, "*batch D"]:
    """Y'' by s at a state, without coupling."""
    force = response.basis.forcing(state.s)[..., None, :].to(weights) @ weights.mT
    force = scale(force)[..., 0, :]
    if response.approach:
        force = force + state.way * response.approach_force(state.s).to(force)[..., None]
    return response.spring.acceleration(state.position - state.goal, state.rate) + force


def _transitions(
    spring: SpringDamper, ds: Tensor | float, coast: Tensor | float
) -> tuple[Tensor, Tensor | None]:
    """Over a step, and since the forcing has ended; None: it is known not to have."""
    if isinstance(ds, Tensor) and isinstance(coast, Tensor):
        step, rest = spring.propagator(torch.stack([ds, coast]))  # both at once
        return step, rest
    return spring.propagator(ds), spring.propagator(coast) if coast else None


def _product_plus(A: Tensor, x: Tensor, b: Tensor) -> Tensor:
    """A x + b, in one call where there is one."""
    return torch.addmm(b, A, x) if A.ndim == x.ndim == b.ndim == 2 else A @ x + b


def _lagging(
    goal: Tensor, target: Tensor, ds: Tensor | float, rate: float, spring: SpringDamper
) -> tuple[Tensor, Tensor, Tensor]:
    """The goal after the step, and the (y - target, y') it leads to, before and after.

    y_p = target + k (g - target), k = alpha beta / (rate^2 - alpha rate + alpha beta), solves
    the equation for a goal that decays to its target.
    """
    denominator = rate**2 - spring.alpha * rate + spring.stiffness
    if not rate > 0 or abs(denominator) < RESONANCE * spring.stiffness:
        raise ValueError(
            f"a goal filter needs a positive rate off the modes of the spring, got {rate}"
        )
    gain = spring.stiffness / denominator
    # A goal behind its target decays to it, and the motion it leads to with it.
    lag_before = goal - target
    if isinstance(ds, Tensor):
        lag_after = lag_before * torch.exp(-rate * ds).to(goal)[..., None]
    else:
        lag_after = lag_before * math.exp(-rate * ds)
    before, after = (
        torch.stack([gain * lag, -rate * gain * lag], dim=-2) for lag in (lag_before, lag_after)
    )
    return target + lag_after, before, after


def host_values(*times: Tensor) -> tuple[Tensor, ...] | tuple[float, ...]:
    """The times as floats if each is a single one that nothing derives or traces."""
    if not readable(*times) or not all(map(_plain, times)):
        return times
    return tuple(time.item() for time in times)


def _plain(time: Tensor) -> bool:
    return (
        time.ndim == 0
        and time.is_cpu  # of another device, reading would wait for all that was asked of it
        and type(time) is Tensor
        and not time.requires_grad
    )


def continue_motion(
    response: Response,
    weights: Float[Tensor, "*batch D N"],
    goal: Float[Tensor, "*batch D"],
    position: Float[Tensor, "*batch D"],
    velocity: Float[Tensor, "*batch D"],
    *,
    duration: Float[Tensor, "*batch"],
    elapsed: Float[Tensor, "*batch"],
    time: Float[Tensor, "*batch T"],
) -> tuple[Float[Tensor, "*batch T D"], Float[Tensor, "*batch T D"]]:
    """Carry on from a position and a velocity, under whatever weights and goal hold from now.

    x(s) = F(s) w + (g, 0) + E(s - s_0) [x(s_0) - F(s_0) w - (g, 0)],   x = (y, y')

    F is the response to the weights from rest at the goal and E the transition matrix of the
    unforced spring, so that this is exact, one linear map of (w, g, x(s_0)), and starts with
    the position and the velocity given. From s_0 = 0 it is `JointDMP.rollout`, from any later
    state of a motion what follows of it; gradients flow to all arguments.

    Args:
        response: Of the primitive; its start and goal must act through the spring alone.
        weights: Of the unscaled forcing term.
        goal: g.
        position: Where the motion is.
        velocity: Per second.
        duration: tau [s], of the whole motion.
        elapsed: Since its start [s].
        time: From now on [s], not negative.

    Returns:
        Position, and velocity per second, at those times.

    Raises:
        ValueError: A response with an approach of its own.
    """
    if response.approach:
        raise ValueError("a motion can be continued only with approach 0: start is forgotten")
    tau = duration.double()[..., None]
    now, ahead = elapsed.double()[..., None] / tau, time.double() / tau
    count = response.basis.count
    forced = response.evaluate(torch.cat([now, now + ahead], dim=-1))[..., :2, :count]
    free = response.spring.propagator(ahead)
    w, tau = weights.double().mT, tau[..., None]
    x = torch.stack([position.double(), velocity.double() * tau[..., 0]], dim=-2)
    # (*batch, 1 + T, 2, D), seen from the goal, and for each row of the state.
    caused = (forced.flatten(-3, -2) @ w).unflatten(-2, (-1, 2))
    g = goal.double()[..., None, :]
    rest = torch.cat([g, torch.zeros_like(g)], dim=-2)
    offset = x - rest - caused[..., 0, :, :]
    state = caused[..., 1:, :, :] + free @ offset[..., None, :, :]
    y, rate = state.unbind(dim=-2)
    return (y + g).to(weights), (rate / tau).to(weights)
