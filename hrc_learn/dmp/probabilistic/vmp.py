"""Via points of any kind of primitive, in the coordinates that move linearly."""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from hrc_learn.dmp import orientation_error as error_space
from hrc_learn.dmp._system.minimum_jerk import piecewise_quintic
from hrc_learn.dmp._system.response import Response
from hrc_learn.dmp._types import ArrayLike, to_tensor
from hrc_learn.dmp.forcing_scale import Demonstrated
from hrc_learn.dmp.joint_dmp import JointDMP
from hrc_learn.dmp.limited_dmp import LimitedDMP, SoftLimits
from hrc_learn.dmp.orientation_dmp import OrientationDMP
from hrc_learn.dmp.pose_dmp import BODY, ERROR, POSITION, PoseDMP
from hrc_learn.dmp.probabilistic.linear_view import Primitive, motion_of, with_motion
from hrc_learn.geometry import Pose, quaternion


@dataclass(frozen=True, kw_only=True, eq=False)
class ViaPoints:
    """Where a linear primitive shall be, and how fast; NaN where it is free."""

    s: Float[Tensor, "*batch n"]
    """Normalised times (float64)."""
    position: Float[Tensor, "*batch n D"]
    rate: Float[Tensor, "*batch n D"]
    """By s."""


def via_points(
    primitive: Primitive,
    time: ArrayLike,
    value: ArrayLike | Pose | None = None,
    velocity: ArrayLike | None = None,
    *,
    body: ArrayLike | None = None,
    body_velocity: ArrayLike | None = None,
) -> ViaPoints:
    """Via points as a caller gives them, as coordinates (float64).

    An orientation becomes the error on the branch nearest to the primitive's motion there, so
    that both signs mean the same. An angular velocity becomes the rate of the error at that
    orientation, or, where none is given, at the primitive's.

    Args:
        primitive: Says the kind, and how it moves when nothing else is asked for.
        time: [s], (*batch, n).
        value: Joints (*batch, n, D); unit quaternions (*batch, n, 4); or a `Pose` of
            (*batch, n). NaN leaves a coordinate free, in a quaternion all of the orientation.
        velocity: Of joints (*batch, n, D); angular [rad/s], (*batch, n, 3); or a twist
            (*batch, n, 6). NaN as above.
        body: Of a pose, (*batch, n, K).
        body_velocity: Of a pose, (*batch, n, K).

    Raises:
        ValueError: Negative times, or shapes that do not fit.
    """
    motion = motion_of(primitive)
    time = to_tensor(time, torch.float64, motion.start.device)
    if time.ndim == 0 or not (time >= 0).all():
        raise ValueError(f"time must be (..., n) seconds, none negative, got {time.tolist()}")
    now = motion.rollout(time.detach())
    q, v = (x.detach().double() for x in (now.position, now.velocity))
    if not isinstance(primitive, PoseDMP) and (body is not None or body_velocity is not None):
        raise ValueError("only a pose has a body")
    if isinstance(primitive, PoseDMP):
        position, rate = _of_pose(primitive, q, v, value, velocity, body, body_velocity)
    elif isinstance(value, Pose):
        raise ValueError("a Pose is no value for joints or an orientation")
    elif isinstance(primitive, OrientationDMP):
        position, rate = _of_orientation(primitive.reference, q, value, velocity)
    elif isinstance(primitive, LimitedDMP):
        limits = primitive.limits
        position, rate = _of_limited(limits, q, value, velocity)
    else:
        position, rate = _given(value, q), _given(velocity, v, "velocity")
    duration = motion.duration.double()[..., None]
    return ViaPoints(s=time / duration, position=position, rate=rate * duration[..., None])


def _given(
    value: ArrayLike | None, like: Tensor, name: str = "value", columns: int | None = None
) -> Float[Tensor, "*batch n D"]:
    """What was given, NaN if nothing was, in float64."""
    shape = (*like.shape[:-1], like.shape[-1] if columns is None else columns)
    if value is None:
        return torch.full(shape, torch.nan).to(like)
    tensor = to_tensor(value, torch.float64, like.device)
    if tensor.ndim < 2 or tensor.shape[-2:] != shape[-2:]:
        raise ValueError(f"{name} must have shape {shape}, got {tuple(tensor.shape)}")
    return tensor.expand(torch.broadcast_shapes(tensor.shape, shape))


def _of_orientation(
    reference: Tensor, error: Tensor, value: ArrayLike | None, velocity: ArrayLike | None
) -> tuple[Tensor, Tensor]:
    q = _given(value, error, columns=4)
    free = q.isnan().any(-1, keepdim=True)
    reference = reference.detach().double()[..., None, :].expand_as(q)
    # Nothing that is not a number goes through a function, or no gradient comes back.
    q = quaternion.normalize(torch.where(free, reference, q))
    via = error_space.nearest_turn(error_space.to_error(q, reference), error)
    omega = _given(velocity, error, "velocity")
    still = omega.isnan().any(-1, keepdim=True)
    rate = error_space.error_rate(torch.where(free, error, via), omega.nan_to_num())
    return via.masked_fill(free, torch.nan), rate.masked_fill(still, torch.nan)


def _of_limited(
    limits: SoftLimits, x: Tensor, value: ArrayLike | None, velocity: ArrayLike | None
) -> tuple[Tensor, Tensor]:
    q = _given(value, x)
    if (q.isfinite() & ~limits.contain(q)).any():
        raise ValueError(f"via point {q.tolist()} is not between the limits")
    now = limits.constrain(x)
    there = limits.clamp(torch.where(q.isnan(), now, q))
    rate = _given(velocity, x, "velocity")
    released = torch.func.jvp(limits.release, (there,), (rate.nan_to_num(),))
    return (
        released[0].masked_fill(q.isnan(), torch.nan),
        released[1].masked_fill(rate.isnan(), torch.nan),
    )


def _of_pose(
    primitive: PoseDMP,
    q: Tensor,
    v: Tensor,
    value: Any,
    velocity: ArrayLike | None,
    body: ArrayLike | None,
    body_velocity: ArrayLike | None,
) -> tuple[Tensor, Tensor]:
    if value is not None and not isinstance(value, Pose):
        raise ValueError("the value of a pose's via points is a Pose; NaN leaves parts free")
    position = None if value is None else value.position
    rotation = None if value is None else value.orientation
    twist = _given(velocity, v, "velocity", columns=6)
    error, rate = _of_orientation(primitive.reference, q[..., ERROR], rotation, twist[..., 3:])
    return (
        torch.cat(
            [_given(position, q[..., POSITION]), error, _given(body, q[..., BODY], "body")],
            dim=-1,
        ),
        torch.cat(
            [twist[..., :3], rate, _given(body_velocity, v[..., BODY], "body_velocity")],
            dim=-1,
        ),
    )


PER_FUNCTION = 8
"""Times per basis function at which curve and motion are compared."""
LOCAL = 1e-9
"""Share of its height that a basis function may reach outside of a window."""
RIDGE = 1e-7
"""Keeps weights that cause the same motion small, relative to the largest."""
SAME = 1e-12
"""Constraints whose singular values are below this ask for what others do."""


def through[P: Primitive](
    primitive: P,
    time: ArrayLike,
    value: ArrayLike | Pose | None = None,
    velocity: ArrayLike | None = None,
    *,
    body: ArrayLike | None = None,
    body_velocity: ArrayLike | None = None,
    within: tuple[float | int, float | int] | None = None,
) -> P:
    """The primitive, changed so that it passes through via points exactly.

    Start and goal stay, with the velocities there; so does any coordinate that no via point
    asks for, and with `within` all of the motion outside of that time. It holds for the
    primitive's own start, goal and duration: put others in beforehand, with `with_ends`.
    Gradients flow to times, values and velocities.

    Args:
        primitive: Of any kind; a batch of them takes the same number of via points each.
        time: Of the via points [s], (*batch, n).
        value: As for `via_points`, like all that follow; NaN is free.
        velocity: There. None or NaN keeps the primitive's own where a value is given.
        body: Of a pose.
        body_velocity: Of a pose.
        within: Times [s] between which the motion may change; None: from start to end.

    Raises:
        ValueError: Via points at one time or outside of the window, or too many for the basis.
    """
    via = via_points(primitive, time, value, velocity, body=body, body_velocity=body_velocity)
    motion = motion_of(primitive)
    x = motion.coordinates().detach()
    weights = x[..., :-3] + _change(motion, via, within)
    bent = motion.with_coordinates(torch.cat([weights, x[..., -3:]], dim=-1))
    return with_motion(primitive, bent)


def _change(
    motion: JointDMP, via: ViaPoints, within: tuple[float, float] | None
) -> Float[Tensor, "*batch D N"]:
    """Of the weights."""
    if motion.basis.periodic:
        raise ValueError("a rhythm has no via points: its motion has no first time")
    window = _window(motion, within)
    part = _follower(motion.response, window)
    if 2 + 2 * via.s.shape[-1] > len(part.chosen):
        raise ValueError(
            f"{via.s.shape[-1]} via points are too many for the {len(part.chosen)} basis "
            f"functions between {window[0]:.3f} and {window[1]:.3f} of the duration"
        )
    missing = _missing(motion, via)
    knots, order = _knots(via.s, window)
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
    size = torch.where(size > 0, size, 1.0)
    residual = (wanted - (A @ z[..., None])[..., 0]) / size
    z = z + (torch.linalg.pinv(A / size[..., None], rtol=SAME) @ residual[..., None])[..., 0]
    change = z.new_zeros(*z.shape[:-1], motion.basis.count)
    change = change.index_copy(-1, part.chosen, z @ part.to_weights.mT)
    shown = Demonstrated(start=motion.start, goal=motion.goal, amplitude=motion.amplitude)
    return motion.forcing_scale.unscale(change.mT, shown).mT


def _missing(motion: JointDMP, via: ViaPoints) -> Float[Tensor, "*batch n 2 D"]:
    """What position and rate by s lack at the via points; NaN where they are free."""
    still = motion.with_coordinates(motion.coordinates().detach()).requires_grad_(False)
    now = still.rollout(via.s * motion.duration.double()[..., None])
    position = via.position - now.position
    rate = via.rate - now.velocity * motion.duration[..., None, None]
    # Where a position is asked for and no rate, the rate there is stays.
    rate = torch.where(rate.isnan() & ~position.isnan(), 0.0, rate)
    return torch.stack(torch.broadcast_tensors(position, rate), dim=-2)


def _window(
    motion: JointDMP, within: tuple[float | int, float | int] | None
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
