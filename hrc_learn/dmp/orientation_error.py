"""Orientation errors to a goal: coordinates in which an orientation primitive is linear.

The error of an orientation q to the goal g is e = log(g * conj(q)), a rotation vector [rad] in
the base frame. Hence q = exp(-e) * g. This definition follows Koutras and Doulgeri 2019, "A
correct formulation for the orientation dynamic movement primitives for robot control in the
Cartesian space", whose logarithm is half of ours. At the goal, e = 0. If the same rotation
of the tool frame is applied to all orientations, including the goal (q * r and g * r), e stays
the same.
"""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from hrc_learn.dmp._arguments import Mask, Quaternions, Times, readable, to_tensor
from hrc_learn.dmp.samples import check_samples, demo_label
from hrc_learn.geometry import quaternion
from hrc_learn.geometry.quaternion import axis_drift, drift_free_rate, drift_free_slope

type Numbers = list[float]
_NO_AXIS = 1e-9
"""Length [rad] below which a rotation vector has no direction."""
MEAN_ITERATIONS = 10
"""Number of iterations that compute a mean. Each multiplies the distance to the mean by a small
factor. If all orientations are close together, the new distance is proportional to the cube of
the previous one."""
NORM_TOLERANCE = 1e-2
"""A recorded quaternion is normalised if its norm differs from 1 by at most this value."""


def to_error(
    q: Float[Tensor, "*#batch 4"], goal: Float[Tensor, "*#batch 4"]
) -> Float[Tensor, "*batch 3"]:
    """Shortest error [rad] of an orientation to the goal."""
    return quaternion.log(quaternion.multiply(goal, quaternion.conjugate(q)))


def to_orientation(
    error: Float[Tensor, "*#batch 3"], goal: Float[Tensor, "*#batch 4"]
) -> Float[Tensor, "*batch 4"]:
    """Orientation with this error to the goal, exp(-e) * g."""
    return quaternion.multiply(quaternion.exp(-error), goal)


def reference_of(
    error: Float[Tensor, "*#batch 3"], q: Float[Tensor, "*#batch 4"]
) -> Float[Tensor, "*batch 4"]:
    """Reference to which an orientation has this error, exp(e) * q."""
    return quaternion.multiply(quaternion.exp(error), q)


def to_orientations(
    error: Float[Tensor, "*#batch T 3"], goal: Float[Tensor, "*#batch 4"]
) -> Float[Tensor, "*batch T 4"]:
    """Orientations over time with these errors to one goal."""
    # Each orientation is one product with a 4x4 matrix. Row i of this matrix is the i-th basis
    # quaternion times the goal.
    unit = torch.eye(4, dtype=goal.dtype, device=goal.device)
    return quaternion.exp(-error) @ quaternion.multiply(unit, goal[..., None, :])


def angular_velocity(
    error: Float[Tensor, "*batch 3"], rate: Float[Tensor, "*batch 3"]
) -> Float[Tensor, "*batch 3"]:
    """Angular velocity of q = exp(-e) * g in the base frame [rad/s], from e and de/dt."""
    return -drift_free_rate(error, rate)


def angular_acceleration(
    error: Float[Tensor, "*batch 3"],
    rate: Float[Tensor, "*batch 3"],
    second: Float[Tensor, "*batch 3"],
) -> Float[Tensor, "*batch 3"]:
    """Angular acceleration [rad/s^2], from e and its first and second time derivative."""
    return -drift_free_slope(error, rate, second)


def error_rate(
    error: Float[Tensor, "*#batch 3"], velocity: Float[Tensor, "*#batch 3"]
) -> Float[Tensor, "*batch 3"]:
    """Rate de/dt for an angular velocity [rad/s]; the inverse of `angular_velocity`.

    If the error is a whole number of turns, it can only change along its axis. The component
    of the velocity perpendicular to this axis is then ignored.
    """
    error, velocity = torch.broadcast_tensors(error, velocity)
    return -velocity - axis_drift(error, velocity)


def nearest_turn(
    error: Float[Tensor, "*#batch 3"], reference: Float[Tensor, "*#batch 3"]
) -> Float[Tensor, "*batch 3"]:
    """The same rotation as `error`, with the whole turns that bring it closest to `reference`.

    With these turns, a motion with a new start or goal rotates in the same direction as the
    demonstration.
    """
    error, reference = torch.broadcast_tensors(error, reference)
    own = error.norm(dim=-1, keepdim=True) > _NO_AXIS
    axis = torch.where(own, error, reference).detach()
    axis = axis / axis.norm(dim=-1, keepdim=True).clamp_min(_NO_AXIS)
    # The number of turns is an integer, which has no derivative.
    along = ((reference - error) * axis).sum(-1, keepdim=True).detach()
    return error + 2 * torch.pi * torch.round(along / (2 * torch.pi)) * axis


def retarget(
    error: Float[Tensor, "*batch 3"],
    rate: Float[Tensor, "*batch 3"],
    old: Float[Tensor, "*batch 4"],
    goal: Float[Tensor, "*#batch 4"],
) -> tuple[Tensor, Tensor]:
    """Error to a new goal, and its rate, at the same orientation and angular velocity."""
    new = nearest_turn(to_error(to_orientation(error, old), goal), error)
    return new, error_rate(new, angular_velocity(error, rate))


def retarget_numbers(
    error: Numbers, rate: Numbers, old: Numbers, goal: Numbers
) -> tuple[Numbers, Numbers]:
    """`retarget` for one motion with plain Python numbers, in a fiftieth of the time."""
    angle, axis = _polar(error)
    w, x, y, z = old
    between = quaternion.product_of_components(goal, [w, -x, -y, -z])
    turned = quaternion.product_of_components(between, exp_numbers(error))
    if turned < [0.0] * 4:  # the first component that is not zero becomes positive
        turned = [-part for part in turned]
    sine, own = _polar(turned[1:])
    short = 2 * math.atan2(sine, turned[0])
    own = own if short > _NO_AXIS else axis
    along = own[0] * error[0] + own[1] * error[1] + own[2] * error[2] - short
    half = short / 2 + math.pi * round(along / (2 * math.pi))
    # v is minus the angular velocity; see `drift_free_rate` and `axis_drift`.
    slant = (math.cos(angle) - 1) / angle if angle else 0.0
    v = _stretched(rate, axis, math.sin(angle) / angle if angle else 1.0, slant)
    sinc = math.sin(half) / half if half else 1.0
    lost = abs(sinc) < quaternion.SINGULAR
    across, turn = (0.0, 0.0) if lost else (math.cos(half) / sinc, half)
    return [2 * half * n for n in own], _stretched(v, own, across, turn)


def exp_numbers(v: Numbers) -> Numbers:
    """Unit quaternion of a rotation vector [rad]."""
    angle, (x, y, z) = _polar(v)
    sine = math.sin(angle / 2)
    return [math.cos(angle / 2), sine * x, sine * y, sine * z]


def _polar(v: Numbers) -> tuple[float, Numbers]:
    """Length and direction of a vector; a zero vector has the direction zero."""
    x, y, z = v
    length = math.hypot(x, y, z)
    return length, [x / length, y / length, z / length] if length else v


def _stretched(v: Numbers, axis: Numbers, across: float, turn: float) -> Numbers:
    """Scale the part of v perpendicular to a unit axis by `across`, and add turn (axis x v)."""
    (x, y, z), (a, b, c) = v, axis
    along = (1 - across) * (a * x + b * y + c * z)
    return [
        across * x + along * a + turn * (b * z - c * y),
        across * y + along * b + turn * (c * x - a * z),
        across * z + along * c + turn * (a * y - b * x),
    ]


def unit_quaternion(value: Quaternions, like: Tensor) -> Float[Tensor, "*batch 4"]:
    """Normalised quaternion in the dtype and on the device of `like`.

    Raises:
        ValueError: The value is not a quaternion (w, x, y, z).
    """
    q = to_tensor(value, dtype=like.dtype, device=like.device)
    shaped = q.ndim > 0 and q.shape[-1] == 4
    # A loose bound: it only has to exclude zeros and Euler angles. A tracer cannot look at
    # values.
    norm = q.norm(dim=-1) if shaped else q
    if not (shaped and (not readable(q) or ((norm > 0.5) & (norm < torch.inf)).all())):
        raise ValueError(f"an orientation must be unit quaternions (w, x, y, z), got {value}")
    return quaternion.normalize(q)


def intrinsic_mean(q: Float[Tensor, "n 4"]) -> Float[Tensor, "4"]:
    """Orientation from which the rotation vectors to all others sum to zero.

    (Moakher 2002, "Means and averaging in the group of rotations".) The fixed-point iteration
    starts from the extrinsic mean, which does not depend on signs.
    """
    return _refined(quaternion.mean(q), q, torch.full_like(q[:, :1], 1 / len(q)))


def mean_along(
    q: Float[Tensor, "*batch T 4"], mask: Bool[Tensor, "*batch T"]
) -> Float[Tensor, "*batch 4"]:
    """Intrinsic mean of the orientations of a motion, near the centre of its swing.

    A motion that swings by 170 degrees to either side spends most of its time near the
    orientation opposite to this centre. The iteration therefore starts from the mean of the
    unwrapped rotation vectors.

    Args:
        q: Unit quaternions over time, neighbours less than half a turn apart.
        mask: False at samples to ignore.
    """
    weight = (mask.to(q) / mask.sum(-1, keepdim=True))[..., None]
    first = q[..., :1, :]
    vector = quaternion.log(quaternion.multiply(q, quaternion.conjugate(first)))
    vector = (weight * quaternion.unwrap_log(vector)).sum(-2)
    return _refined(quaternion.multiply(quaternion.exp(vector), first[..., 0, :]), q, weight)


def _refined(
    mean: Float[Tensor, "*batch 4"],
    q: Float[Tensor, "*batch n 4"],
    weight: Float[Tensor, "*batch n 1"],
) -> Float[Tensor, "*batch 4"]:
    for _ in range(MEAN_ITERATIONS):
        offset = quaternion.log(
            quaternion.multiply(q, quaternion.conjugate(mean)[..., None, :])
        )
        mean = quaternion.multiply(quaternion.exp((weight * offset).sum(-2)), mean)
    return quaternion.normalize(mean)


def fitted_error(
    time: Times, orientation: Quaternions, mask: Mask | None
) -> tuple[Float[Tensor, "*B T 3"], Float[Tensor, "*B 4"]]:
    """Errors [rad] to the last valid orientation, and that orientation.

    The error is followed backwards from the end, continuously past any number of turns, so that
    720 degrees are learned as two turns. Masked orientations may have any value.
    """
    q = _without_gaps(*_checked(time, orientation, mask))
    goal = q[..., -1, :]
    backwards = to_error(q, goal[..., None, :]).flip(-2)
    return quaternion.unwrap_log(backwards).flip(-2), goal


def centred_error(
    time: Times, orientation: Quaternions, mask: Mask | None
) -> tuple[Float[Tensor, "*B T 3"], Float[Tensor, "*B 4"]]:
    """Errors [rad] of demonstrations to their mean orientation, and the mean.

    Raises:
        ValueError: Bad samples, or samples half a turn or more from the mean.
    """
    q, mask = _checked(time, orientation, mask)
    q = _without_gaps(q, mask)
    centre = mean_along(q, mask)
    error = to_error(q, centre[..., None, :])
    # Past half a turn the logarithm jumps to the other side, which unwrapping would undo.
    # The jump has length 2 pi: any threshold well between rounding and 2 pi detects it.
    far = (quaternion.unwrap_log(error) - error).norm(dim=-1) > 1
    if far.any():
        i, k = far.reshape(-1, far.shape[-1]).nonzero()[0].tolist()
        raise ValueError(
            f"{demo_label(i, far.shape[:-1])}orientation passes half a turn from its mean at "
            f"sample {k}: a rhythm must stay within 180 degrees of its centre"
        )
    return error, centre


def _without_gaps(
    orientation: Float[Tensor, "*batch T 4"], mask: Bool[Tensor, "*batch T"]
) -> Float[Tensor, "*batch T 4"]:
    """Orientations with masked samples replaced by the last valid one before them."""
    # Samples before the first valid one take its value.
    index = torch.arange(mask.shape[-1], device=mask.device).expand(mask.shape)
    first = mask.long().argmax(-1, keepdim=True)
    latest = torch.where(mask, index, first).cummax(-1).values
    return torch.take_along_dim(orientation, latest[..., None], dim=-2)


def _checked(
    time: Times, orientation: Quaternions, mask: Mask | None
) -> tuple[Float[Tensor, "*B T 4"], Bool[Tensor, "*B T"]]:
    """Unit quaternions, and a mask of the valid samples."""
    samples = check_samples(time, orientation, mask=mask, name="orientation")
    if samples.position.shape[-2] != 4:
        raise ValueError(
            f"orientation must be quaternions (w, x, y, z), shape (..., T, 4), "
            f"got {tuple(to_tensor(orientation).shape)}"
        )
    norm = samples.position.norm(dim=-2)
    broken = samples.mask & ((norm - 1).abs() > NORM_TOLERANCE)
    if broken.any():
        i, k = broken.nonzero()[0].tolist()
        raise ValueError(
            f"{demo_label(i, samples.batch)}orientation has norm {norm[i, k].item():.4f} at "
            f"sample {k}: not a unit quaternion. Interpolation across a sign flip may cause it."
        )
    unit = samples.columns / norm.masked_fill(~samples.mask, 1).reshape(*samples.batch, -1, 1)
    return unit, samples.mask.reshape(unit.shape[:-1])
