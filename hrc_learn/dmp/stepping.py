"""A primitive in closed loop: its first state, and one exact step.

What moves a primitive is linear: each influence has a motion of its own that solves the
equation alone, known at both ends of the step. What the state differs from the sum of those
dies out as the unforced spring has it. So no step is too long, whatever its length.
"""

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.dmp.state import DMPState
from hrc_learn.dmp.system.approach import approach_state
from hrc_learn.dmp.system.known import as_numbers
from hrc_learn.dmp.system.response import Response
from hrc_learn.dmp.system.spring import SpringDamper
from hrc_learn.dmp.trajectory import broadcast_shapes

RESONANCE = 1e-3
"""How close to a mode of the spring a goal filter may come, relative to the stiffness."""


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
    ds: Float[Tensor, "*#batch"],
    *,
    response: Response,
    weights: Float[Tensor, "*#batch D N"],
    scale: Callable[[Tensor], Tensor],
    target: Float[Tensor, "*batch D"],
    goal_filter: float | None,
    push: Float[Tensor, "*#batch D"] | None,
    pace: Float[Tensor, "*batch"],
) -> DMPState:
    """Advance by `ds`, all influences as given for the whole step.

    Args:
        state: Where the primitive is.
        ds: Step in normalised time (float64).
        response: Of the primitive.
        weights: Of the unscaled forcing term.
        scale: What the ends make of (*batch, K, D) that the forcing term causes.
        target: Where the goal shall be.
        goal_filter: Rate dg/ds = -rate (g - target); None: the goal is there at once.
        push: Constant second derivative added to the motion, by s.
        pace: Kept in the state for its velocity.
    """
    spring, s = response.spring, state.s + ds
    now, span = as_numbers(s, ds)
    E, coast = _transitions(spring, span, response.coasting(now))
    forced = response.forced.to(s.device)(now).to(target) @ weights.mT
    if coast is not None:
        forced = coast.to(target) @ forced
    before, after = scale(state.forced), scale(forced)
    if response.approach:
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
    goal: Tensor, target: Tensor, ds: Tensor, rate: float, spring: SpringDamper
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
    lag_before = goal - target
    lag_after = lag_before * torch.exp(-rate * ds).to(goal)[..., None]
    before, after = (
        torch.stack([gain * lag, -rate * gain * lag], dim=-2) for lag in (lag_before, lag_after)
    )
    return target + lag_after, before, after
