"""Starts and goals of an orientation as a caller gives them, in terms of errors."""

import torch
from jaxtyping import Float
from torch import Tensor, broadcast_tensors

from hrc_learn.dmp.arrays import ArrayLike, to_tensor
from hrc_learn.dmp.rotation import error as error_space
from hrc_learn.geometry import quaternion


def unit_quaternion(value: ArrayLike, like: Tensor) -> Float[Tensor, "*batch 4"]:
    """A quaternion given by the caller, normalised; dtype and device of `like`."""
    q = to_tensor(value, dtype=like.dtype, device=like.device)
    shaped = q.ndim > 0 and q.shape[-1] == 4
    # A tracer cannot look at values.
    if not (shaped and (torch.compiler.is_compiling() or (q.norm(dim=-1) > 0.5).all())):
        raise ValueError(f"an orientation must be unit quaternions (w, x, y, z), got {value}")
    return quaternion.normalize(q)


def error_ends(
    error: Float[Tensor, "*#batch 3"],
    rate: Float[Tensor, "*#batch 3"],
    goal_error: Float[Tensor, "*#batch 3"],
    demonstrated_goal: Float[Tensor, "*#batch 4"],
    start: ArrayLike | None,
    goal: ArrayLike | None,
    velocity: ArrayLike | None,
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
        return error, rate, error_space.reference_of(goal_error, demonstrated_goal)
    if velocity is None:
        error_all, rate = broadcast_tensors(error, rate)
        omega = error_space.angular_velocity(error_all, rate)
    else:
        omega = to_tensor(velocity, dtype=error.dtype, device=error.device)
    if start is None:
        reference = error_space.reference_of(goal_error, demonstrated_goal)
        q = error_space.to_orientation(error, reference)
    else:
        q = unit_quaternion(start, error)
    goal = demonstrated_goal if goal is None else unit_quaternion(goal, error)
    reference = error_space.reference_of(goal_error, goal)
    error = error_space.nearest_turn(error_space.to_error(q, reference), error)
    return error, error_space.error_rate(error, omega), reference
