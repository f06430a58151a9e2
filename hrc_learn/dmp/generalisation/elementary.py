"""The elementary trajectory of a via-point movement primitive.

From one knot to the next it is the quintic with the positions and velocities of those and no
acceleration in either; between knots at rest, the minimum-jerk curve.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from hrc_learn.dmp.system.approach import quintic


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
