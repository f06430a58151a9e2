"""What is left of a motion that is under way, from wherever it is by now."""

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.dmp.system.response import Response


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
