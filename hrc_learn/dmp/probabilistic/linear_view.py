"""What is done alike with primitives of every kind: ends, via points, means, common references.

Orientations, poses and limited joints move linearly in columns of their own: what is true of
linear primitives is worked out once, on their `motion`.
"""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.dmp._types import Points, Times
from hrc_learn.dmp.joint_dmp import JointDMP
from hrc_learn.dmp.linear_primitive import ColumnEnds, LinearPrimitive
from hrc_learn.dmp.motion_primitive import AdaptedPrimitive
from hrc_learn.dmp.orientation_error import intrinsic_mean, nearest_turn, reference_of, to_error

SAME = 1e-9
"""Orientations closer than this [rad] are one: well above rounding, well below any sensor."""


def via_point_primitive[P: AdaptedPrimitive](
    primitive: P,
    time: Times,
    value: Any = None,
    velocity: Points | None = None,
    *,
    body: Points | None = None,
    body_velocity: Points | None = None,
    within: tuple[float | int, float | int] | None = None,
) -> P:
    """The primitive, changed so that it passes through via points exactly.

    As `AdaptedPrimitive.condition`, whose arguments it takes.
    """
    return primitive.condition(
        time, value, velocity, body=body, body_velocity=body_velocity, within=within
    )


def with_ends[P: AdaptedPrimitive](primitive: P, **ends: Any) -> P:
    """The primitive whose own motion has these ends.

    As `AdaptedPrimitive.with_ends`, whose arguments it takes.
    """
    return primitive.with_ends(**ends)


def mean_primitive[P: AdaptedPrimitive](primitives: P) -> P:
    """The mean over all batch dimensions of a primitive.

    A rollout is linear in weights, start, goal and start velocity. So for one duration, and
    forcing that does not scale with start and goal, its mean is the rollout of the means.

    Args:
        primitives: Fitted to several demonstrations of one motion.

    Returns:
        A primitive without batch dimensions, and without a fit report.

    Raises:
        ValueError: Primitives whose scaling turns them, each with the way of its own.
    """
    motion, columns = _mean_motion(primitives.motion), primitives.adapter.error_columns
    if columns is None:
        return primitives.with_motion(motion)
    goal = _mean_goal(_goal_orientation(primitives))
    return primitives.with_motion(motion, reference_of(motion.goal[..., columns], goal))


def alike[P: AdaptedPrimitive](primitives: P) -> P:
    """A batch of primitives in columns that mean the same for all of them.

    Orientations with goals of their own are taken as errors to the mean of those. That is
    not linear, so the errors are fitted anew.
    """
    columns = primitives.adapter.error_columns
    if columns is None:
        return primitives
    own = reference(primitives)
    middle = intrinsic_mean(own.reshape(-1, 4))
    motion = primitives.linear_motion()
    if (to_error(own, middle).abs() < SAME).all():
        return primitives
    if motion.basis.periodic:
        raise ValueError("rhythms about different centres have no distribution")
    with torch.no_grad():
        shown: Any = primitives.rollout()
        errors = shown_columns(motion)[..., columns]
    fitted = JointDMP.fit(
        shown.time,
        nearest_turn(to_error(shown.orientation, middle), errors),
        basis=motion.basis,
        spring=motion.spring,
        approach=motion.response.approach,
    )
    x = motion.coordinates().detach().clone()
    x[..., columns, :] = fitted.coordinates().detach()
    motion = motion.with_coordinates(x, motion.duration)
    return primitives.with_motion(motion, middle.expand_as(own))


def reference(primitive: Any) -> Float[Tensor, "*batch 4"]:
    """What orientation errors of a primitive that has them are taken to."""
    return primitive.reference


def shown_columns(motion: LinearPrimitive) -> Float[Tensor, "*batch T D"]:
    """Columns along the demonstration."""
    return motion.roll(ColumnEnds(), motion.duration).position


def _goal_orientation(primitives: Any) -> Float[Tensor, "*batch 4"]:
    goal = primitives.goal
    return goal if isinstance(goal, Tensor) else goal.orientation


def _mean_goal(goals: Float[Tensor, "*batch 4"]) -> Float[Tensor, "4"]:
    goals = goals.reshape(-1, 4)
    # Both signs are the same orientation: bring all to the side of the first.
    goals = goals * torch.where((goals @ goals[0])[:, None] < 0, -1.0, 1.0).to(goals)
    return torch.nn.functional.normalize(goals.mean(dim=0), dim=-1)


def _mean_motion(motions: LinearPrimitive) -> LinearPrimitive:
    if motions.forcing_scale.turns and motions.weights.ndim > 2:
        raise ValueError(
            f"scaling {motions.scaling!r} gives each primitive a frame of its own: fit with "
            "'none' to average them"
        )
    x, count = motions.coordinates().detach(), motions.timestamps.shape[-1]
    batch = x.ndim - 2

    def mean(tensor: Tensor) -> Tensor:
        return tensor.flatten(0, batch - 1).mean(dim=0) if batch else tensor

    return motions.with_coordinates(
        mean(x),
        mean(motions.duration),
        amplitude=mean(motions.amplitude),
        timestamps=torch.linspace(0, 1, count, dtype=torch.float64).to(motions.timestamps),
    )
