"""Via-point movement primitives: the same motion, but through given points, exactly.

After Zhou, Gao and Asfour 2019, "Learning via-movement primitives": a motion is an elementary
trajectory plus the shape a demonstration adds to it, and via points change the elementary
trajectory, piece by piece. Here the weights make that change, so that the result is a
primitive like any other: they follow its curve as closely as the basis can, and pass the via
points and the end exactly. All of it is worked out once, for linear columns;
`AdaptedPrimitive.condition` does it for values of any kind.
"""

from dataclasses import dataclass
from functools import lru_cache

import torch
from jaxtyping import Float, Int
from torch import Tensor

from hrc_learn.dmp._system.closed_forms import piecewise_quintic
from hrc_learn.dmp._system.response import Response
from hrc_learn.dmp.forcing_scale import Demonstrated
from hrc_learn.dmp.linear_primitive import Ends, LinearPrimitive

PER_FUNCTION = 8
"""Times per basis function at which curve and motion are compared: what moves within an eighth
of their distance no basis function can follow."""
LOCAL = 1e-9
"""Share of its height that a basis function may reach outside of a window: of Gaussians, it
leaves out the few that stand nearest to its ends."""
RIDGE = 1e-7
"""Keeps weights that cause the same motion small, relative to the largest."""
SAME = 1e-12
"""Constraints whose singular values are below this ask for what others do."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ViaPoints:
    """Where a linear primitive shall be, and how fast; NaN where it is free."""

    s: Float[Tensor, "*batch n"]
    """Normalised times (float64)."""
    position: Float[Tensor, "*batch n D"]
    rate: Float[Tensor, "*batch n D"]
    """By s."""


def through_via_points(
    motion: LinearPrimitive,
    via: ViaPoints,
    within: tuple[float | int, float | int] | None = None,
) -> LinearPrimitive:
    """The linear primitive, changed so that it passes through via points exactly.

    Args:
        motion: A batch of them takes the same number of via points each.
        via: In its columns.
        within: Times [s] between which the motion may change; None: from start to end.

    Raises:
        ValueError: Via points at one time or outside of the window, or too many for the basis.
    """
    x = motion.coordinates().detach()
    weights = x[..., :-3] + _change(motion, via, within)
    return motion.with_coordinates(torch.cat([weights, x[..., -3:]], dim=-1))


def _change(
    motion: LinearPrimitive, via: ViaPoints, within: tuple[float, float] | None
) -> Float[Tensor, "*batch D N"]:
    """Of the weights."""
    if motion.basis.periodic:
        raise ValueError("a rhythm has no via points: its motion has no first time")
    window = _window(motion, within)
    part = _follower(motion.response, window)
    # Position and rate at each via point, and at the end: an equation each.
    if 2 + 2 * via.s.shape[-1] > len(part.chosen):
        raise ValueError(
            f"{via.s.shape[-1]} via points are too many for the {len(part.chosen)} basis "
            f"functions between {window[0]:.3f} and {window[1]:.3f} of the duration"
        )
    missing = _missing(motion, via)
    knots, order = _knots(via.s, window)
    # At the ends of the window nothing changes.
    ends = torch.nn.functional.pad(missing, (0, 0, 0, 0, 1, 1))
    ends = torch.take_along_dim(ends, order[..., None, None], dim=-3)
    active = ~ends[..., 0, :].isnan()
    value, rate = torch.where(active[..., None, :], ends, 0.0).unbind(-2)
    curve = piecewise_quintic(part.s, knots, value, rate.nan_to_num(), active)
    z = part.follow(curve)
    # What the basis cannot follow it makes up for where it counts, and as little as it can.
    asked = ~missing.flatten(-3, -2).mT.isnan()
    rows = (motion.response.evaluate(via.s)[..., :2, part.chosen] @ part.to_weights).flatten(
        -3, -2
    )
    rows = rows[..., None, :, :] * asked[..., None]
    A = torch.cat([rows, part.end.expand(*rows.shape[:-2], *part.end.shape)], dim=-2)
    wanted = torch.where(asked, missing.flatten(-3, -2).mT, 0.0)
    wanted = torch.nn.functional.pad(wanted, (0, len(part.end)))
    size = A.norm(dim=-1)
    # Rows for what is not asked for are zero and stay so.
    size = torch.where(size > 0, size, 1.0)
    residual = (wanted - (A @ z[..., None])[..., 0]) / size
    z = z + (torch.linalg.pinv(A / size[..., None], rtol=SAME) @ residual[..., None])[..., 0]
    change = z.new_zeros(*z.shape[:-1], motion.basis.count)
    change = change.index_copy(-1, part.chosen, z @ part.to_weights.mT)
    shown = Demonstrated(start=motion.start, goal=motion.goal, amplitude=motion.amplitude)
    return motion.forcing_scale.unscale(change.mT, shown).mT


def _missing(motion: LinearPrimitive, via: ViaPoints) -> Float[Tensor, "*batch n 2 D"]:
    """What position and rate by s lack at the via points; NaN where they are free."""
    still = motion.with_coordinates(motion.coordinates().detach()).requires_grad_(False)
    now = still.roll(Ends(), still.duration, via.s * motion.duration.double()[..., None])
    position = via.position - now.position
    rate = via.rate - now.velocity * motion.duration[..., None, None]
    # Where a position is asked for and no rate, the rate there is stays.
    rate = torch.where(rate.isnan() & ~position.isnan(), 0.0, rate)
    return torch.stack(torch.broadcast_tensors(position, rate), dim=-2)


def _window(
    motion: LinearPrimitive, within: tuple[float | int, float | int] | None
) -> tuple[float, float]:
    """In normalised time."""
    if within is None:
        return 0.0, 1.0
    duration = motion.duration.double().reshape(-1)
    if not (duration == duration[0]).all():
        raise ValueError("a window in seconds needs primitives of one duration")
    return max(within[0] / duration[0].item(), 0.0), min(within[1] / duration[0].item(), 1.0)


def _knots(
    s: Float[Tensor, "*batch n"], window: tuple[float, float]
) -> tuple[Float[Tensor, "*batch n_and_2"], Int[Tensor, "*batch n_and_2"]]:
    """Ends of the window and via points in order, and where each comes from."""
    first, last = (torch.full_like(s[..., :1], end) for end in window)
    knots, order = torch.cat([first, s, last], dim=-1).sort(dim=-1, stable=True)
    ends_first = (order[..., 0] == 0) & (order[..., -1] == s.shape[-1] + 1)
    if not (knots.diff() > 0).all() or not ends_first.all():
        raise ValueError(
            f"via points must lie between {window[0]:.3f} and {window[1]:.3f} of the duration, "
            f"at different times, got {s.tolist()}"
        )
    return knots, order


@dataclass(frozen=True, eq=False)
class _Follower:
    """Follows curves that start at rest, with the weights of some basis functions.

    Coordinates z of the weights, in which the distance to a curve is |z - follow(curve)|.
    """

    chosen: Int[Tensor, "K"]
    """The basis functions."""
    s: Float[Tensor, "G"]
    """Times at which a curve is compared."""
    units: Float[Tensor, "3"]
    """Of the curve and its derivatives."""
    Q: Float[Tensor, "G3 K"]
    to_weights: Float[Tensor, "K K"]
    end: Float[Tensor, "2 K"]
    """Position and rate at the end of the window, per z."""

    def follow(self, curve: Float[Tensor, "*batch G 3 D"]) -> Float[Tensor, "*batch D K"]:
        """The z that come closest."""
        return (curve * self.units[:, None]).flatten(-3, -2).mT @ self.Q


# A decomposition of 8 N x 3 rows each; a task has few windows.
@lru_cache(maxsize=16)
def _follower(response: Response, window: tuple[float, float]) -> _Follower:
    N, (first, last) = response.basis.count, window
    every = torch.linspace(0, 1, PER_FUNCTION * N + 1, dtype=torch.float64)
    forcing = response.basis.forcing(every)
    outside = ((every < first) & (first > 0)) | ((every > last) & (last < 1))
    reach = torch.where(outside[:, None], forcing, 0.0).amax(0)
    chosen = (reach <= LOCAL * forcing.amax(0)).nonzero()[:, 0]
    s = torch.linspace(first, last, PER_FUNCTION * N + 1, dtype=torch.float64)
    H = response.evaluate(s)[..., chosen]
    # Derivatives count by what they change over the distance between basis functions, which
    # is as fine as these can follow.
    units = torch.tensor([1.0, 1 / N, 1 / N**2], dtype=torch.float64)
    A = (H * units[:, None]).flatten(0, 1)
    unit = 1 / A.norm(dim=0)
    A = torch.cat([A * unit, RIDGE * torch.eye(len(chosen), dtype=torch.float64)])
    Q, R = torch.linalg.qr(A)
    to_weights = unit[:, None] * torch.linalg.inv(R)
    return _Follower(chosen, s, units, Q[: 3 * len(s)], to_weights, H[-1, :2] @ to_weights)
