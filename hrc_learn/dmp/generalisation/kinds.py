"""Every kind of primitive as a linear one, and back.

Orientations, poses and limited joints move linearly in coordinates of their own: what is true
of linear primitives is worked out once, on their `motion`.
"""

from typing import Any

import torch

from hrc_learn.dmp.joint import JointDMP
from hrc_learn.dmp.limited import LimitedDMP
from hrc_learn.dmp.orientation import OrientationDMP
from hrc_learn.dmp.pose import PoseDMP
from hrc_learn.dmp.pose_columns import ERROR, replaced
from hrc_learn.dmp.rotation.error import nearest_turn, to_error, to_orientation
from hrc_learn.dmp.rotation.mean import intrinsic_mean

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
