"""How a motion takes up a goal that is not the demonstrated one.

Left to the spring, it sets off for the goal at once: a moved goal makes the acceleration jump
at the start and the motion up to several times as fast. Along a minimum-jerk approach the
forcing term holds a part proportional to goal - start under which, with all weights zero, the
motion is y_0 + (g - y_0) m(s). The weights then shape what is left (the elementary trajectory
of Zhou et al. 2019, "Learning via-movement primitives", as part of a second-order system).
"""

from typing import Any

import torch
from jaxtyping import Float
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
