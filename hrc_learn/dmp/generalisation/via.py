"""Via points of any kind of primitive, in the coordinates that move linearly."""

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.dmp.arrays import ArrayLike, to_tensor
from hrc_learn.dmp.generalisation.kinds import Primitive, motion_of
from hrc_learn.dmp.limited import LimitedDMP
from hrc_learn.dmp.orientation import OrientationDMP
from hrc_learn.dmp.pose import PoseDMP
from hrc_learn.dmp.pose_columns import BODY, ERROR, POSITION
from hrc_learn.dmp.rotation import error as error_space
from hrc_learn.dmp.soft_limits import SoftLimits
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
