"""Orientations as errors to a goal, the coordinates in which an orientation moves linearly.

e = log(g * conj(q)), a rotation vector [rad] in the base frame, so that q = exp(-e) * g
(Koutras and Doulgeri 2019, "A correct formulation for the orientation dynamic movement
primitives for robot control in the Cartesian space"; their logarithm is half of ours). The
goal is e = 0. Moving start and goal alike by a rotation of the tool frame leaves e as it is.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor, broadcast_tensors

from hrc_learn.dmp._arguments import (
    Mask,
    Quaternions,
    Times,
    Vectors,
    check_samples,
    demo_label,
    readable,
    to_tensor,
)
from hrc_learn.geometry import quaternion
from hrc_learn.geometry.quaternion import axis_drift, drift_free_rate, drift_free_slope

_NO_AXIS = 1e-9
"""Rotation vectors shorter than this [rad] have no direction of their own."""


def demonstrated_error(
    orientation: Float[Tensor, "*batch T 4"], mask: Bool[Tensor, "*batch T"]
) -> tuple[Float[Tensor, "*batch T 3"], Float[Tensor, "*batch 4"]]:
    """Errors to the last sample that counts, continuous past any number of turns.

    Where `mask` is false an orientation may be anything. The error of a demonstration is
    followed backwards from its end, so that 720 degrees are learned as two turns.

    Returns:
        Errors [rad], and the goal.
    """
    q = held(orientation, mask)
    goal = q[..., -1, :]
    backwards = to_error(q, goal[..., None, :]).flip(-2)
    return quaternion.unwrap_log(backwards).flip(-2), goal


def held(
    orientation: Float[Tensor, "*batch T 4"], mask: Bool[Tensor, "*batch T"]
) -> Float[Tensor, "*batch T 4"]:
    """Orientations along time, where `mask` is false the last before that counts."""
    # Each sample points to the last one that counts; those before the first, to that.
    index = torch.arange(mask.shape[-1], device=mask.device).expand(mask.shape)
    first = mask.long().argmax(-1, keepdim=True)
    seen = torch.where(mask, index, first).cummax(-1).values
    return torch.take_along_dim(orientation, seen[..., None], dim=-2)


def to_error(
    q: Float[Tensor, "*#batch 4"], goal: Float[Tensor, "*#batch 4"]
) -> Float[Tensor, "*batch 3"]:
    """Shortest error of an orientation to the goal."""
    return quaternion.log(quaternion.multiply(goal, quaternion.conjugate(q)))


def to_orientation(
    error: Float[Tensor, "*#batch 3"], goal: Float[Tensor, "*#batch 4"]
) -> Float[Tensor, "*batch 4"]:
    """Orientation that differs from the goal by this error."""
    return quaternion.multiply(quaternion.exp(-error), goal)


def reference_of(
    error: Float[Tensor, "*#batch 3"], q: Float[Tensor, "*#batch 4"]
) -> Float[Tensor, "*batch 4"]:
    """What orientation has this error: exp(e) * q."""
    return quaternion.multiply(quaternion.exp(error), q)


def to_orientations(
    error: Float[Tensor, "*#batch T 3"], goal: Float[Tensor, "*#batch 4"]
) -> Float[Tensor, "*batch T 4"]:
    """Orientations along time that differ from one goal by these errors."""
    # One 4x4 product each: row i of the matrix is the unit quaternion i times the goal.
    unit = torch.eye(4, dtype=goal.dtype, device=goal.device)
    return quaternion.exp(-error) @ quaternion.multiply(unit, goal[..., None, :])


def angular_velocity(
    error: Float[Tensor, "*batch 3"], rate: Float[Tensor, "*batch 3"]
) -> Float[Tensor, "*batch 3"]:
    """Angular velocity of q = exp(-e) * g in the base frame [rad/s], from de/dt."""
    return -drift_free_rate(error, rate)


def angular_acceleration(
    error: Float[Tensor, "*batch 3"],
    rate: Float[Tensor, "*batch 3"],
    curvature: Float[Tensor, "*batch 3"],
) -> Float[Tensor, "*batch 3"]:
    """Angular acceleration [rad/s^2], from e and its first two derivatives by time."""
    return -drift_free_slope(error, rate, curvature)


def error_rate(
    error: Float[Tensor, "*#batch 3"], velocity: Float[Tensor, "*#batch 3"]
) -> Float[Tensor, "*batch 3"]:
    """de/dt of an angular velocity [rad/s]; the inverse of `angular_velocity`.

    Whole turns away from the goal the error has a rate about its own axis only: what the
    velocity holds across it is lost there.
    """
    error, velocity = torch.broadcast_tensors(error, velocity)
    return -velocity - axis_drift(error, velocity)


def nearest_turn(
    error: Float[Tensor, "*#batch 3"], reference: Float[Tensor, "*#batch 3"]
) -> Float[Tensor, "*batch 3"]:
    """The same rotation as `error`, with the whole turns that bring it closest to `reference`.

    A start or goal that is new takes its way round from the demonstration.
    """
    error, reference = torch.broadcast_tensors(error, reference)
    own = error.norm(dim=-1, keepdim=True) > _NO_AXIS
    axis = torch.where(own, error, reference).detach()
    axis = axis / axis.norm(dim=-1, keepdim=True).clamp_min(_NO_AXIS)
    # How many turns is a choice, which has no derivative.
    along = ((reference - error) * axis).sum(-1, keepdim=True).detach()
    return error + 2 * torch.pi * torch.round(along / (2 * torch.pi)) * axis


def retarget(
    error: Float[Tensor, "*batch 3"],
    rate: Float[Tensor, "*batch 3"],
    curvature: Float[Tensor, "*batch 3"],
    old_goal: Float[Tensor, "*batch 4"],
    goal: Float[Tensor, "*#batch 4"],
) -> tuple[Tensor, Tensor, Tensor]:
    """Error to a new goal and its derivatives, for the same motion of the orientation."""
    q = to_orientation(error, old_goal)
    new = nearest_turn(to_error(q, goal), error)
    omega = angular_velocity(error, rate)
    omega_rate = angular_acceleration(error, rate, curvature)
    new_rate = error_rate(new, omega)
    # The angular acceleration is linear in the curvature; the rest stems from turning itself.
    bias = angular_acceleration(new, new_rate, torch.zeros_like(new))
    return new, new_rate, error_rate(new, omega_rate - bias)


def unit_quaternion(value: Quaternions, like: Tensor) -> Float[Tensor, "*batch 4"]:
    """A quaternion given by the caller, normalised; dtype and device of `like`."""
    q = to_tensor(value, dtype=like.dtype, device=like.device)
    shaped = q.ndim > 0 and q.shape[-1] == 4
    # A tracer cannot look at values.
    # Not a tolerance on units: it tells a quaternion from zeros and from three Euler angles.
    if not (shaped and (not readable(q) or (q.norm(dim=-1) > 0.5).all())):
        raise ValueError(f"an orientation must be unit quaternions (w, x, y, z), got {value}")
    return quaternion.normalize(q)


def error_ends(
    error: Float[Tensor, "*#batch 3"],
    rate: Float[Tensor, "*#batch 3"],
    goal_error: Float[Tensor, "*#batch 3"],
    demonstrated_goal: Float[Tensor, "*#batch 4"],
    start: Quaternions | None,
    goal: Quaternions | None,
    velocity: Vectors | None,
) -> tuple[Tensor, Tensor, Tensor]:
    """Error at the start of a motion, its rate [rad/s], and the reference it is taken to.

    Args:
        error: At the start of the demonstration.
        rate: Of that, when the motion takes as long as it shall.
        goal_error: Error of the goal: zero where that is the reference.
        demonstrated_goal: Where the demonstration ends.
        start: New start; the demonstrated one is kept if None, as with all that follow.
        goal: New goal.
        velocity: New angular velocity [rad/s].
    """
    if start is None and goal is None and velocity is None:
        return error, rate, reference_of(goal_error, demonstrated_goal)
    if velocity is None:
        error_all, rate = broadcast_tensors(error, rate)
        omega = angular_velocity(error_all, rate)
    else:
        omega = to_tensor(velocity, dtype=error.dtype, device=error.device)
    if start is None:
        reference = reference_of(goal_error, demonstrated_goal)
        q = to_orientation(error, reference)
    else:
        q = unit_quaternion(start, error)
    goal = demonstrated_goal if goal is None else unit_quaternion(goal, error)
    reference = reference_of(goal_error, goal)
    error = nearest_turn(to_error(q, reference), error)
    return error, error_rate(error, omega), reference


ITERATIONS = 10
"""Each leaves a small share of the distance, or of its cube where all are close."""


def intrinsic_mean(
    q: Float[Tensor, "*batch n 4"], mask: Bool[Tensor, "*batch n"] | None = None
) -> Float[Tensor, "*batch 4"]:
    """The orientation from which the rotation vectors to all others sum up to zero.

    (Moakher 2002, "Means and averaging in the group of rotations".) Fixed-point iteration
    from the extrinsic mean, the first eigenvector of sum q q^T, which knows no signs.

    Args:
        q: Unit quaternions, of either sign.
        mask: False where one does not count.
    """
    weight = _shares(q, mask)
    return _settled(torch.linalg.eigh((weight * q).mT @ q).eigenvectors[..., -1], q, weight)


def mean_along(
    q: Float[Tensor, "*batch T 4"], mask: Bool[Tensor, "*batch T"]
) -> Float[Tensor, "*batch 4"]:
    """Intrinsic mean of a motion, on the side that the motion keeps to.

    One that swings by 170 degrees either way spends most of its time about the orientation
    opposite to its centre: the iteration starts from the mean of the way it took instead.

    Args:
        q: Unit quaternions along time, neighbours less than half a turn apart.
        mask: False where one does not count.
    """
    weight = _shares(q, mask)
    first = q[..., :1, :]
    way = quaternion.log(quaternion.multiply(q, quaternion.conjugate(first)))
    way = (weight * quaternion.unwrap_log(way)).sum(-2)
    return _settled(quaternion.multiply(quaternion.exp(way), first[..., 0, :]), q, weight)


def _shares(q: Tensor, mask: Tensor | None) -> Float[Tensor, "*batch n 1"]:
    weight = torch.ones_like(q[..., 0]) if mask is None else mask.to(q)
    return (weight / weight.sum(-1, keepdim=True))[..., None]


def _settled(
    mean: Float[Tensor, "*batch 4"],
    q: Float[Tensor, "*batch n 4"],
    weight: Float[Tensor, "*batch n 1"],
) -> Float[Tensor, "*batch 4"]:
    for _ in range(ITERATIONS):
        away = quaternion.log(quaternion.multiply(q, quaternion.conjugate(mean)[..., None, :]))
        mean = quaternion.multiply(quaternion.exp((weight * away).sum(-2)), mean)
    return quaternion.normalize(mean)


NORM_TOLERANCE = 1e-2
"""How far from one the norm of a recorded quaternion may be before it is called broken."""


def fitted_error(
    time: Times, orientation: Quaternions, mask: Mask | None
) -> tuple[Float[Tensor, "*B T 3"], Float[Tensor, "*B 4"]]:
    """Errors and goals of demonstrations that end."""
    return demonstrated_error(*_checked(time, orientation, mask))


def centred_error(
    time: Times, orientation: Quaternions, mask: Mask | None
) -> tuple[Float[Tensor, "*B T 3"], Float[Tensor, "*B 4"]]:
    """Errors of demonstrations to their mean orientation, and that.

    Raises:
        ValueError: Bad samples, or some half a turn or more from the mean.
    """
    q, mask = _checked(time, orientation, mask)
    q = held(q, mask)
    centre = mean_along(q, mask)
    error = to_error(q, centre[..., None, :])
    # Past half a turn the logarithm jumps to the other side, which unwrapping undoes.
    # A jump is 2 pi long: any threshold well between rounding and that will do.
    far = (quaternion.unwrap_log(error) - error).norm(dim=-1) > 1
    if far.any():
        i, k = far.reshape(-1, far.shape[-1]).nonzero()[0].tolist()
        raise ValueError(
            f"{demo_label(i, far.shape[:-1])}orientation passes half a turn from its mean at "
            f"sample {k}: a rhythm must stay within 180 degrees of its centre"
        )
    return error, centre


def _checked(
    time: Times, orientation: Quaternions, mask: Mask | None
) -> tuple[Float[Tensor, "*B T 4"], Bool[Tensor, "*B T"]]:
    """Unit quaternions and which of them count."""
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
            f"sample {k}: not a unit quaternion. Interpolating across a sign flip does this."
        )
    unit = samples.columns / norm.masked_fill(~samples.mask, 1).reshape(*samples.batch, -1, 1)
    return unit, samples.mask.reshape(unit.shape[:-1])
