"""How far an arm is from a person beside it, and how every joint changes that.

Each pair of a capsule of the arm and one of the person has a signed distance, a direction and a
gradient in closed form, so that a controller can keep all of them above zero:

    d_dot = gradient @ q_dot + direction . v

with v the velocity of the person's nearest point.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.geometry.numerics import safe_norm
from hrc_learn.kinematics.collision import (
    CapsuleArm,
    nearest_on_segment_and_box,
    nearest_on_segments,
)


@dataclass(frozen=True, kw_only=True)
class GraspedBox:
    """A box between the fingers, its edges along the axes of the tool's frame."""

    half_size: tuple[float, float, float]
    """Half of its edges along x, y (the line of closing) and z of the tool [m]."""
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """In the frame of the tool centre point [m]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Separation:
    """Distances of an arm's C capsules from a person's H capsules.

    What the arm holds is one more row, the last, so C counts it.
    """

    distance: Float[Tensor, "*batch C H"]
    """Between the surfaces; negative is the depth to which two capsules overlap [m]."""
    on_arm: Float[Tensor, "*batch C H 3"]
    """Nearest point on the arm's surface, in the base frame [m]."""
    on_person: Float[Tensor, "*batch C H 3"]
    """Nearest point on the person's surface [m]."""
    direction: Float[Tensor, "*batch C H 3"]
    """Unit vector from the arm to the person; zero where the axes of two capsules meet, or the
    axis of one a box: there no direction leads out."""
    fraction: Float[Tensor, "*batch C H"]
    """Where on the axis of the person's capsule its nearest point lies, 0 to 1 from its first
    end."""
    gradient: Float[Tensor, "*batch C H joints"]
    """Of the distance with respect to the joint positions [m/rad]."""

    def rate(
        self,
        joint_velocity: Float[Tensor, "*#batch joints"],
        person_velocity: Float[Tensor, "*#batch H 2 3"],
    ) -> Float[Tensor, "*batch C H"]:
        """How fast the distances change [m/s]; negative where arm and person come closer.

        Args:
            joint_velocity: Of the arm [rad/s].
            person_velocity: Of both ends of the person's capsules [m/s].
        """
        first, second = person_velocity[..., None, :, :, :].unbind(-2)
        velocity = first + self.fraction[..., None] * (second - first)
        along = (self.direction * velocity).sum(-1)
        return (self.gradient @ joint_velocity[..., None, :, None]).squeeze(-1) + along


def separation(
    arm: CapsuleArm,
    q: Float[Tensor, "*#batch joints"],
    ends: Float[Tensor, "*#batch H 2 3"],
    radius: Float[Tensor, "*#batch H"],
    grasped: GraspedBox | None = None,
) -> Separation:
    """Distances of all of an arm from all of a person.

    Nearest points of two segments after Ericson (2005), section 5.1.9; those of a segment and a
    box by bisection. A box is exact as long as no axis of the person's capsules enters it.
    Where several points are equally near, the gradient is that of one of them.

    Args:
        arm: The arm's capsules.
        q: Joint positions [rad].
        ends: Of the axes of the person's capsules, in the base frame [m].
        radius: Of these capsules [m].
        grasped: What the arm holds; None: nothing.

    Raises:
        ValueError: A radius is negative or not finite.
    """
    if not bool((radius >= 0).all() & torch.isfinite(radius).all()):
        raise ValueError(f"radius must be finite and not negative, but is {radius.tolist()}.")
    joints = len(arm.chain.joint_names)
    frames = arm.chain.link_poses(q).matrix()
    axis, other = arm.segments(q)[..., :, None, :, :], ends[..., None, :, :, :]
    s, t = nearest_on_segments(axis, other)
    on_arm, on_person = _between(axis, s), _between(other, t)
    arm_radius = arm.radius.to(q)[:, None]
    links = arm.links
    if grasped is not None:
        box, fraction = _nearest_on_box(frames[..., -1, :, :], ends, grasped)
        on_arm = _stacked(on_arm, box)
        t = torch.cat([t, fraction[..., None, :].expand(*t.shape[:-2], 1, -1)], dim=-2)
        on_person = _between(other.expand(*t.shape, 2, 3), t)
        arm_radius = torch.nn.functional.pad(arm_radius, (0, 0, 0, 1))
        links = (*links, frames.shape[-3])
    gap = on_person - on_arm
    length = safe_norm(gap)
    apart = length > 0
    direction = gap / torch.where(apart, length, 1.0).unsqueeze(-1)
    person_radius = radius[..., None, :]
    # The joints that carry a link are those up to its own number.
    moved = torch.tensor([[i < link for i in range(joints)] for link in links], device=q.device)
    z, origin = frames[..., :joints, :3, 2], frames[..., :joints, :3, 3]
    # - direction . (z x (p - o)) for the axis z through o of every joint.
    turning = torch.linalg.cross(direction, on_arm) @ z[..., None, :, :].mT
    shift = direction @ torch.linalg.cross(z, origin)[..., None, :, :].mT
    return Separation(
        distance=length - arm_radius - person_radius,
        on_arm=on_arm + arm_radius.unsqueeze(-1) * direction,
        on_person=on_person - person_radius.unsqueeze(-1) * direction,
        direction=direction,
        fraction=t,
        gradient=torch.where(moved[:, None, :], turning + shift, 0.0),
    )


def _between(segment: Tensor, fraction: Tensor) -> Tensor:
    """Point of a segment."""
    first, second = segment.unbind(-2)
    return first + fraction.unsqueeze(-1) * (second - first)


def _stacked(points: Tensor, last: Tensor) -> Tensor:
    """(*batch, C, H, 3) and one more row (*batch, H, 3)."""
    return torch.cat([points, last[..., None, :, :].expand(*points.shape[:-3], 1, -1, -1)], -3)


def _nearest_on_box(tool: Tensor, ends: Tensor, box: GraspedBox) -> tuple[Tensor, Tensor]:
    """Points of a held box nearest to segments, and where on these the nearest points lie."""
    R, p = tool[..., :3, :3], tool[..., None, :3, 3]
    local = (ends - p[..., None, :]) @ R[..., None, :, :]
    centre, half_size = local.new_tensor(box.centre), local.new_tensor(box.half_size)
    point, fraction = nearest_on_segment_and_box(local, centre, half_size)
    return point @ R.mT + p, fraction
