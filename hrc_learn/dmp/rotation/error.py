"""Orientations as errors to a goal, the coordinates in which an orientation moves linearly.

e = log(g * conj(q)), a rotation vector [rad] in the base frame, so that q = exp(-e) * g
(Koutras and Doulgeri 2019, "A correct formulation for the orientation dynamic movement
primitives for robot control in the Cartesian space"; their logarithm is half of ours). The
goal is e = 0. Moving start and goal alike by a rotation of the tool frame leaves e as it is.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from hrc_learn.geometry import quaternion
from hrc_learn.geometry.rotation_rates import axis_drift, drift_free_rate, drift_free_slope

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
