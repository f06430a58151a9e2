"""Minimum-jerk curves: how a motion takes up a new goal, and passes from one point to the next.

Left to the spring, a motion sets off for a new goal at once: a moved goal makes the
acceleration jump at the start and the motion up to several times as fast. Along a minimum-jerk
approach the forcing term holds a part proportional to goal - start under which, with all
weights zero, the motion is y_0 + (g - y_0) m(s). The weights then shape what is left (the
elementary trajectory of Zhou et al. 2019, "Learning via-movement primitives", as part of a
second-order system).
"""

from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor


def minimum_jerk(
    s: Float[Tensor, "*batch"], share: float
) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"], Float[Tensor, "*batch"]]:
    """m(s) from 0 to 1 over the first `share` of the motion, and its derivatives by s."""
    u = (s / share).clamp(0, 1)
    m, slope = quintic(u)
    curvature = 60 * u * (1 - u) * (1 - 2 * u)
    return m, slope / share, curvature / share**2


def quintic(u: Any) -> tuple[Any, Any]:
    """Minimum-jerk curve from 0 to 1 on [0, 1], and its slope; of tensors or numbers."""
    return u**3 * (10 - 15 * u + 6 * u**2), 30 * (u * (1 - u)) ** 2


def approach_state(s: Float[Tensor, "*batch"], share: float) -> Float[Tensor, "*batch 2"]:
    """(m - 1, m'): the motion to the goal per unit of goal - start, seen from the goal."""
    m, slope, _ = minimum_jerk(s, share)
    return torch.stack([m - 1, slope], dim=-1)


def piecewise_quintic(
    s: Float[Tensor, "G"],
    knots: Float[Tensor, "*batch K"],
    value: Float[Tensor, "*batch K D"],
    rate: Float[Tensor, "*batch K D"],
    active: Bool[Tensor, "*batch K D"],
) -> Float[Tensor, "*batch G 3 D"]:
    """Value and two derivatives at times `s`, from the first knot to the last.

    Args:
        s: Between the first and the last knot.
        knots: Increasing times.
        value: At the knots.
        rate: At the knots.
        active: Which knots there are for a coordinate; the first and the last always.
    """
    K = knots.shape[-1]
    index = torch.arange(K, device=s.device)[:, None]
    passed = (knots[..., None, :] <= s[:, None])[..., None]
    active = active[..., None, :, :]
    before = torch.where(active & passed, index, 0).amax(-2).clamp(max=K - 2)
    after = torch.where(active & ~passed, index, K - 1).amin(-2)
    times = knots[..., None].expand_as(value)
    (t0, y0, v0), (t1, y1, v1) = (
        [torch.take_along_dim(x, at, dim=-2) for x in (times, value, rate)]
        for at in (before, after)
    )
    L = t1 - t0
    u = (s[:, None] - t0) / L
    m, slope = quintic(u)
    curvature = 60 * u * (1 - u) * (1 - 2 * u)
    way, w0, w1 = y1 - y0, v0 * L, v1 * L
    position = y0 + way * m
    position = position + w0 * (u - u**3 * (6 - 8 * u + 3 * u**2))
    position = position - w1 * u**3 * (4 - 7 * u + 3 * u**2)
    velocity = way * slope + w0 * (1 - u**2 * (18 - 32 * u + 15 * u**2))
    velocity = velocity - w1 * u**2 * (12 - 28 * u + 15 * u**2)
    acceleration = way * curvature - w0 * u * (36 - 96 * u + 60 * u**2)
    acceleration = acceleration - w1 * u * (24 - 84 * u + 60 * u**2)
    return torch.stack([position, velocity / L, acceleration / L**2], dim=-2)
