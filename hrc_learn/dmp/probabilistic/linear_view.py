"""Every kind of primitive as a linear one, and back.

Orientations, poses and limited joints move linearly in coordinates of their own: what is true
of linear primitives is worked out once, on their `motion`.
"""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.dmp.joint_dmp import JointDMP
from hrc_learn.dmp.limited_dmp import LimitedDMP
from hrc_learn.dmp.orientation_dmp import OrientationDMP
from hrc_learn.dmp.orientation_error import (
    intrinsic_mean,
    nearest_turn,
    to_error,
    to_orientation,
)
from hrc_learn.dmp.pose_dmp import ERROR, PoseDMP, replaced

SAME = 1e-9
"""Orientations closer than this [rad] are one."""

type Primitive = JointDMP | OrientationDMP | PoseDMP | LimitedDMP


def motion_of(primitive: Primitive) -> JointDMP:
    """The linear primitive inside.

    Raises:
        ValueError: The formulation of Ude et al., which is not linear.
    """
    if isinstance(primitive, JointDMP):
        return primitive
    if isinstance(primitive, OrientationDMP) and primitive.formulation != "log":
        raise ValueError(
            f"formulation {primitive.formulation!r} is not linear: fit with 'log' instead"
        )
    return primitive.motion


def with_motion[P: Primitive](primitive: P, motion: JointDMP, reference: Any = None) -> P:
    """A primitive of the same kind around another linear one.

    Args:
        primitive: The kind, and what its coordinates mean.
        motion: Takes the place of its own.
        reference: What errors are now taken to; the primitive's own if None.
    """
    made: Any = motion
    if isinstance(primitive, OrientationDMP | PoseDMP):
        reference = primitive.reference if reference is None else reference
        error = motion.goal[..., error_columns(primitive)]
        made = type(primitive)(motion, to_orientation(error, reference))
    elif isinstance(primitive, LimitedDMP):
        made = LimitedDMP(motion, primitive.lower, primitive.upper, primitive.softness)
    return made


def error_columns(primitive: OrientationDMP | PoseDMP) -> slice:
    """Which coordinates of its motion are the orientation error."""
    return ERROR if isinstance(primitive, PoseDMP) else slice(0, 3)


def with_ends[P: Primitive](primitive: P, **ends: Any) -> P:
    """The primitive whose own motion has these ends.

    Args:
        primitive: Whose forcing does not follow start and goal.
        ends: Those of its `initial_state`: start, goal, duration, start_velocity and more.

    Raises:
        ValueError: A scaling that means other weights for other ends.
    """
    motion = motion_of(primitive)
    if motion.forcing_scale.follows_ends:
        raise ValueError(f"scaling {motion.scaling!r} changes with the ends: fit with 'none'")
    state: Any = primitive.initial_state(**ends)
    moved = state if isinstance(primitive, JointDMP) else state.motion
    rest = torch.stack([moved.rate, moved.position, moved.goal], dim=-1)
    weights = motion.weights.expand(*rest.shape[:-1], -1)
    x = torch.cat([weights, rest], dim=-1)
    motion = motion.with_coordinates(x, moved.duration)
    return with_motion(primitive, motion, getattr(state, "reference", None))


def alike[P: Primitive](primitives: P) -> P:
    """A batch of primitives in coordinates that mean the same for all of them.

    Orientations with goals of their own are taken as errors to the mean of those. That is
    not linear, so the errors are fitted anew.
    """
    if not isinstance(primitives, OrientationDMP | PoseDMP):
        return primitives
    own = primitives.reference
    reference = intrinsic_mean(own.reshape(-1, 4))
    motion = motion_of(primitives)
    if (to_error(own, reference).abs() < SAME).all():
        return primitives
    if motion.basis.periodic:
        raise ValueError("rhythms about different centres have no distribution")
    with torch.no_grad():
        shown = primitives.rollout()
        columns = motion.rollout().position
    part = error_columns(primitives)
    error = nearest_turn(to_error(shown.orientation, reference), columns[..., part])
    fitted = JointDMP.fit(
        shown.time,
        error,
        basis=motion.basis,
        spring=motion.spring,
        approach=motion.response.approach,
    )
    x = replaced(motion.coordinates().mT, part, fitted.coordinates().mT).mT
    motion = motion.with_coordinates(x.detach(), motion.duration)
    return with_motion(primitives, motion, reference.expand_as(own))


def mean_primitive[Primitive: (JointDMP, OrientationDMP, PoseDMP)](
    primitives: Primitive,
) -> Primitive:
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
    if isinstance(primitives, JointDMP):
        return _mean_of_joints(primitives)
    motion = _mean_of_joints(primitives.motion)
    if isinstance(primitives, OrientationDMP):
        return OrientationDMP(motion, _mean_goal(primitives.goal), primitives.formulation)
    return PoseDMP(motion, _mean_goal(primitives.goal_orientation))


def _mean_goal(goals: Float[Tensor, "*batch 4"]) -> Float[Tensor, "4"]:
    goals = goals.reshape(-1, 4)
    # Both signs are the same orientation: bring all to the side of the first.
    goals = goals * torch.where((goals @ goals[0])[:, None] < 0, -1.0, 1.0).to(goals)
    return torch.nn.functional.normalize(goals.mean(dim=0), dim=-1)


def _mean_of_joints(primitives: JointDMP) -> JointDMP:
    if primitives.forcing_scale.turns and primitives.weights.ndim > 2:
        raise ValueError(
            f"scaling {primitives.scaling!r} gives each primitive a frame of its own: fit with "
            "'none' to average them"
        )
    x, stamps = primitives.coordinates().detach(), primitives.stamps
    batch = x.ndim - 2

    def mean(tensor: torch.Tensor) -> torch.Tensor:
        return tensor.flatten(0, batch - 1).mean(dim=0) if batch else tensor

    return primitives.with_coordinates(
        mean(x),
        mean(primitives.duration),
        amplitude=mean(primitives.amplitude),
        stamps=torch.linspace(0, 1, stamps.shape[-1], dtype=stamps.dtype, device=stamps.device),
    )
