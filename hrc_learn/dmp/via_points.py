"""Changes of motions so that they pass exactly through via points.

In Zhou, Gao and Asfour 2019, "Learning via-movement primitives", a motion is an elementary
trajectory plus the shape that a demonstration adds, and via points change the elementary
trajectory piecewise. Here the change is a piecewise polynomial curve, and the weights are
changed to follow it, so that the result is an ordinary primitive. Its motion follows the curve
as closely as the basis allows, and passes exactly through the via points and the end.
`MotionPrimitive.condition` does this for values of any kind.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from hrc_learn.dmp._arguments import full_precision, readable
from hrc_learn.dmp.linear_primitive import Boundary, LinearPrimitive
from hrc_learn.dmp.response import Response
from hrc_learn.dmp.trajectory import Trajectory
from hrc_learn.geometry.numerics import cached_tensors

SAMPLES_PER_FUNCTION = 8
"""Times per basis function at which curve and motion are compared. More are not needed: basis
functions cannot follow changes within an eighth of their distance."""
OUTSIDE = 1e-9
"""Largest height, relative to its peak, that a basis function may have outside of a window (the
interval in which a motion may change). Among the Gaussians centred in the window, only the few
nearest to its ends exceed this height and are not used."""
RIDGE = 1e-7
"""Ridge on the weights, relative to the norm of a column of the design matrix: it keeps weights
small if their effects nearly cancel."""
QUINTIC = torch.tensor(
    [[0, 0, 0, 10, -15, 6], [0, 1, 0, -6, 8, -3], [0, 0, 0, -4, 7, -3]], dtype=torch.float64
)
"""Coefficients of Hermite's quintics with zero second derivatives at the ends of [0, 1]: for
the change of the value, and for the rates at the start and the end."""
DEPENDENT = 1e-12
"""Relative singular value below which a constraint counts as implied by the others."""
OVERSHOOT = 1.5
"""Largest allowed change of a motion, relative to the largest change that the via points
require (`_change_curve`)."""
CLOSEST, CLOSEST_TO_WINDOW = 2, 6
"""Smallest distances at which motions do not overshoot, in units of the distance between basis
functions. `CLOSEST`: from a via point to the next, and to start and end. `CLOSEST_TO_WINDOW`:
from a via point to the ends of a window. At the next smaller distances tried, 1.5 and 5,
motions overshoot."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ViaPoints:
    """Positions and rates that a linear primitive has to reach; NaN leaves a value free."""

    s: Float[Tensor, "*batch n"]
    """Normalised times (float64)."""
    position: Float[Tensor, "*batch n D"]
    rate: Float[Tensor, "*batch n D"]
    """Derivative with respect to s."""


@full_precision
def through_via_points(
    motion: LinearPrimitive,
    via: ViaPoints,
    within: tuple[float | int, float | int] | None = None,
) -> LinearPrimitive:
    """Linear primitive changed to pass exactly through via points.

    Args:
        motion: One primitive, or a batch in which all have the same number of via points.
        via: Via points in the columns of the primitive.
        within: Times [s] between which the motion may change; None: from start to end.

    Raises:
        ValueError: Two via points are at the same time, one is outside of `within`, or they
            are too many or too close together for the basis.
    """
    if motion.basis.periodic:
        raise ValueError("a rhythm has no via points: every time occurs in each period")
    window = _window(motion, within)
    follower = _curve_follower(motion.response, window)
    # One equation each for position and rate at every via point and at the end.
    if 2 + 2 * via.s.shape[-1] > len(follower.chosen):
        raise ValueError(
            f"{via.s.shape[-1]} via points are too many for the {len(follower.chosen)} basis "
            f"functions between {window[0]:.3f} and {window[1]:.3f} of the duration"
        )
    missing = _missing(motion, via)
    curve = _change_curve(follower.s, via.s, missing, window)
    z = follower.follow(curve)
    # The basis follows the curve only approximately: the smallest change of z that satisfies
    # the constraints corrects this.
    required = ~missing.flatten(-3, -2).mT.isnan()
    H = motion.response.evaluate(via.s)[..., :2, follower.chosen]
    rows = (H @ follower.to_weights).flatten(-3, -2)
    rows = rows[..., None, :, :] * required[..., None]
    end = follower.end.expand(*rows.shape[:-2], *follower.end.shape)
    A = torch.cat([rows, end], dim=-2)
    wanted = torch.where(required, missing.flatten(-3, -2).mT, 0.0)
    wanted = torch.nn.functional.pad(wanted, (0, len(follower.end)))
    size = A.norm(dim=-1)
    # Rows without a requirement are zero and stay so.
    size = torch.where(size > 0, size, 1.0)
    residual = (wanted - (A @ z[..., None])[..., 0]) / size
    inverse = torch.linalg.pinv(A / size[..., None], rtol=DEPENDENT)
    z = z + (inverse @ residual[..., None])[..., 0]
    _check_overshoot(motion, follower.change(z), curve[..., 0, :].mT, window)
    change = z.new_zeros(*z.shape[:-1], motion.basis.count)
    change = change.index_copy(-1, follower.chosen, z @ follower.to_weights.mT)
    change = motion.forcing_scale.unscale(change.mT, motion.demonstrated()).mT
    x = motion.coordinates().detach()
    return motion.with_coordinates(torch.cat([x[..., :-3] + change, x[..., -3:]], dim=-1))


def _check_overshoot(
    motion: LinearPrimitive,
    change: Float[Tensor, "*batch D G"],
    curve: Float[Tensor, "*batch D G"],
    window: tuple[float, float],
) -> None:
    """Raise ValueError if the motion changes far more than the curve through the via points."""
    if not readable(change, curve):
        return
    largest, asked = (x.detach().abs().amax(-1) for x in (change, curve))
    rounding = 1e-6 * motion.amplitude.double()
    if (largest <= OVERSHOOT * asked + rounding).all():
        return
    ratio = (largest / (asked + rounding)).max().item()
    spacing = motion.duration.max().item() / (motion.basis.count - 1)
    inside = f" ({CLOSEST_TO_WINDOW * spacing:.3g} s from the ends of `within`)"
    inside = "" if window == (0.0, 1.0) else inside
    raise ValueError(
        f"the motion would change {ratio:.2g} times as far as its via points require: they are "
        f"too close for {motion.basis.count} basis functions. Keep {CLOSEST * spacing:.3g} s "
        f"between them and from start and end{inside}, or fit with more functions (n_basis)"
    )


def _missing(motion: LinearPrimitive, via: ViaPoints) -> Float[Tensor, "*batch n 2 D"]:
    """Via points minus the motion, in position and dy/ds; NaN where a via point is free."""
    x = motion._motion_coordinates(Boundary(), motion.duration, None).detach()
    now = Trajectory(coordinates=x, s=via.s, duration=motion.duration, response=motion.response)
    position = via.position - now.position
    rate = via.rate - now.velocity * motion.duration[..., None, None]
    # Where only a position is given, the rate of the motion stays.
    rate = torch.where(rate.isnan() & ~position.isnan(), 0.0, rate)
    return torch.stack(torch.broadcast_tensors(position, rate), dim=-2)


def _change_curve(
    s: Float[Tensor, "G"],
    via: Float[Tensor, "*batch n"],
    missing: Float[Tensor, "*batch n 2 D"],
    window: tuple[float, float],
) -> Float[Tensor, "*batch G 3 D"]:
    """Piecewise quintic through the differences at via points, zero at the window's ends."""
    knots, order = _knots(via, window)
    values = torch.nn.functional.pad(missing, (0, 0, 0, 0, 1, 1))
    values = torch.take_along_dim(values, order[..., None, None], dim=-3)
    # Where only a rate is given, the curve leaves the position unchanged. The fitted motion may
    # change it slightly.
    active = ~values.isnan().all(-2)
    value, rate = values.nan_to_num().unbind(-2)
    return piecewise_quintic(s, knots, value, rate, active)


def _window(
    motion: LinearPrimitive, within: tuple[float | int, float | int] | None
) -> tuple[float, float]:
    """Start and end of the interval in which the motion may change, in normalised time."""
    if within is None:
        return 0.0, 1.0
    duration = motion.duration.double().reshape(-1)
    if not (duration == duration[0]).all():
        raise ValueError("a window in seconds needs primitives of one duration")
    first, last = (min(max(time / duration[0].item(), 0.0), 1.0) for time in within)
    if not first < last:
        raise ValueError(f"within must be two increasing times of the motion [s], got {within}")
    return first, last


def _knots(
    s: Float[Tensor, "*batch n"], window: tuple[float, float]
) -> tuple[Float[Tensor, "*batch n_and_2"], Int[Tensor, "*batch n_and_2"]]:
    """Ends of the window and via points in order, and the permutation that sorts them."""
    first, last = (s.new_full((*s.shape[:-1], 1), end) for end in window)
    knots, order = torch.cat([first, s, last], dim=-1).sort(dim=-1, stable=True)
    ends_first = (order[..., 0] == 0) & (order[..., -1] == s.shape[-1] + 1)
    if not (knots.diff() > 0).all() or not ends_first.all():
        raise ValueError(
            f"via points must lie between {window[0]:.3f} and {window[1]:.3f} of the duration, "
            f"at different times, got {s.tolist()}"
        )
    return knots, order


@dataclass(frozen=True, eq=False)
class _CurveFollower:
    """Least-squares fit of curves that start at rest, by the basis functions inside a window.

    In the coordinates z of the weights, the distance to a curve is |z - follow(curve)|.
    """

    chosen: Int[Tensor, "K"]
    """Indices of the basis functions inside the window."""
    s: Float[Tensor, "G"]
    """Times at which a curve is compared."""
    units: Float[Tensor, "3"]
    """Factors on the curve and its derivatives."""
    Q: Float[Tensor, "G3 K"]
    to_weights: Float[Tensor, "K K"]
    end: Float[Tensor, "2 K"]
    """Position and rate at the end of the window, per unit of z."""

    def follow(self, curve: Float[Tensor, "*batch G 3 D"]) -> Float[Tensor, "*batch D K"]:
        """Coordinates z of the closest motion."""
        return (curve * self.units[:, None]).flatten(-3, -2).mT @ self.Q

    def change(self, z: Float[Tensor, "*batch D K"]) -> Float[Tensor, "*batch D G"]:
        """Change of the motion at `s`."""
        return z @ self.Q[:: len(self.units)].mT


# Each entry takes a decomposition of 8 N x 3 rows; a task has few windows.
@cached_tensors(maxsize=16)
def _curve_follower(response: Response, window: tuple[float, float]) -> _CurveFollower:
    N, (first, last) = response.basis.count, window
    grid = torch.linspace(0, 1, SAMPLES_PER_FUNCTION * N + 1, dtype=torch.float64)
    forcing = response.basis.forcing(grid)
    outside = ((grid < first) & (first > 0)) | ((grid > last) & (last < 1))
    height = torch.where(outside[:, None], forcing, 0.0).amax(0)
    chosen = (height <= OUTSIDE * forcing.amax(0)).nonzero()[:, 0]
    s = torch.linspace(first, last, SAMPLES_PER_FUNCTION * N + 1, dtype=torch.float64)
    H = response.evaluate(s)[..., chosen]
    # Derivatives are weighted by their effect over the distance between basis functions, which
    # is the finest detail that a motion can follow.
    units = torch.tensor([1.0, 1 / N, 1 / N**2], dtype=torch.float64)
    A = (H * units[:, None]).flatten(0, 1)
    unit = 1 / A.norm(dim=0)
    A = torch.cat([A * unit, RIDGE * torch.eye(len(chosen), dtype=torch.float64)])
    Q, R = torch.linalg.qr(A)
    to_weights = unit[:, None] * torch.linalg.inv(R)
    return _CurveFollower(chosen, s, units, Q[: 3 * len(s)], to_weights, H[-1, :2] @ to_weights)


def piecewise_quintic(
    s: Float[Tensor, "G"],
    knots: Float[Tensor, "*batch K"],
    value: Float[Tensor, "*batch K D"],
    rate: Float[Tensor, "*batch K D"],
    active: Bool[Tensor, "*batch K D"],
) -> Float[Tensor, "*batch G 3 D"]:
    """Value and two derivatives of a curve through knots, with zero acceleration at the knots.

    Args:
        s: Times from the first to the last knot.
        knots: Increasing times.
        value: Values at the knots.
        rate: Derivatives at the knots.
        active: Knots that count for each coordinate; the first and the last always do.
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
    change, w0, w1 = y1 - y0, v0 * L, v1 * L
    curves, coefficients = [], QUINTIC.to(u)
    for order in range(3):
        powers = u[..., None] ** torch.arange(coefficients.shape[-1], device=u.device)
        shapes = powers @ coefficients.mT
        value = change * shapes[..., 0] + w0 * shapes[..., 1] + w1 * shapes[..., 2]
        curves.append((y0 + value if order == 0 else value) / L**order)
        exponents = torch.arange(1, coefficients.shape[-1]).to(u)
        coefficients = coefficients[:, 1:] * exponents
    return torch.stack(curves, dim=-2)
