"""Distance of an arm from a person, and its derivative with respect to every joint.

Each pair of a capsule of the arm and one of the person has a signed distance, a direction and a
gradient in closed form, so that a controller can keep all distances above zero:

    d_dot = gradient @ q_dot + direction . v

with v the velocity of the person's nearest point.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, cached_property

import torch
from jaxtyping import Bool, Float, Int
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
    direction: Float[Tensor, "*batch C H 3"]
    """Unit vector from the arm to the person; zero where the axes of two capsules meet, or the
    axis of one a box: there no direction leads out."""
    fraction: Float[Tensor, "*batch C H"]
    """Nearest point on the axis of the person's capsule, 0 to 1 from its first end."""
    arm_point: Float[Tensor, "*batch C H 3"]
    """Nearest point on the axis of the arm's capsule, or on the held box, in the base frame
    [m]."""
    person_point: Float[Tensor, "*batch C H 3"]
    """Nearest point on the axis of the person's capsule [m]."""
    arm_radius: Float[Tensor, " C"]
    """Radii of the arm's capsules; zero for the held box [m]."""
    person_radius: Float[Tensor, "*#batch H"]
    """[m]"""
    joint_axes: Float[Tensor, "*#batch joints 3"]
    """Nearest points of the arm, in the base frame."""
    joint_origins: Float[Tensor, "*#batch joints 3"]
    """[m]"""
    moved: Bool[Tensor, "C joints"]
    """Mask of the joints that move each of the arm's capsules."""

    @property
    def on_arm(self) -> Float[Tensor, "*batch C H 3"]:
        """Nearest point on the arm's surface, in the base frame [m]."""
        return self.arm_point + self.arm_radius[:, None, None] * self.direction

    @property
    def on_person(self) -> Float[Tensor, "*batch C H 3"]:
        """Nearest point on the person's surface [m]."""
        return self.person_point - self.person_radius[..., None, :, None] * self.direction

    @cached_property
    def gradient(self) -> Float[Tensor, "*batch C H joints"]:
        """Gradient of the distance with respect to the joint positions [m/rad]."""
        shape = self.distance.shape[-2:]
        every = torch.arange(shape.numel(), device=self.distance.device)
        return self.gradient_of(every).unflatten(-2, shape)

    def gradient_of(
        self, pairs: Int[Tensor, "*#batch pairs"]
    ) -> Float[Tensor, "*batch pairs joints"]:
        """Some rows of the gradient [m/rad].

        Args:
            pairs: Numbers c H + h of the pairs of a capsule c of the arm and h of the person,
                the same for all of a batch or of each element its own.
        """
        index = pairs.unsqueeze(-1).expand(*self.direction.shape[:-3], -1, 3)
        direction, point = (
            x.flatten(-3, -2).gather(-2, index) for x in (self.direction, self.arm_point)
        )
        z, origin = self.joint_axes, self.joint_origins
        # - direction . (z x (p - o)) for the axis z through o of every joint.
        turning = torch.linalg.cross(direction, point) @ z.mT
        shift = direction @ torch.linalg.cross(z, origin).mT
        moved = self.moved[pairs // self.distance.shape[-1]]
        return torch.where(moved, turning + shift, 0.0)

    def person_rate(
        self, person_velocity: Float[Tensor, "*#batch H 2 3"]
    ) -> Float[Tensor, "*batch C H"]:
        """Rate of change of the distances while the arm rests [m/s].

        Args:
            person_velocity: Velocities of both ends of the person's capsules [m/s].
        """
        first, second = person_velocity[..., None, :, :, :].unbind(-2)
        velocity = first + self.fraction[..., None] * (second - first)
        return (self.direction * velocity).sum(-1)

    def rate(
        self,
        joint_velocity: Float[Tensor, "*#batch joints"],
        person_velocity: Float[Tensor, "*#batch H 2 3"],
    ) -> Float[Tensor, "*batch C H"]:
        """Rate of change of the distances [m/s]; negative where arm and person approach each
        other.

        Args:
            joint_velocity: Joint velocities of the arm [rad/s].
            person_velocity: Velocities of both ends of the person's capsules [m/s].
        """
        by_arm = (self.gradient @ joint_velocity[..., None, :, None]).squeeze(-1)
        return by_arm + self.person_rate(person_velocity)


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
    frames = arm.chain.link_frames(q)
    axis, other = arm.segments(q, frames)[..., :, None, :, :], ends[..., None, :, :, :]
    s, t = nearest_on_segments(axis, other)
    arm_point, person_point = _between(axis, s), _between(other, t)
    arm_radius, links = arm.radius.to(q), arm.links
    if grasped is not None:
        box, fraction = _nearest_on_box(frames[..., -1, :, :], ends, grasped)
        arm_point = _stacked(arm_point, box)
        t = torch.cat([t, fraction[..., None, :].expand(*t.shape[:-2], 1, -1)], dim=-2)
        person_point = _between(other.expand(*t.shape, 2, 3), t)
        arm_radius = torch.nn.functional.pad(arm_radius, (0, 1))
        links = (*links, frames.shape[-3])
    gap = person_point - arm_point
    length = safe_norm(gap)
    apart = length > 0
    return Separation(
        distance=length - arm_radius[:, None] - radius[..., None, :],
        direction=gap / torch.where(apart, length, 1.0).unsqueeze(-1),
        fraction=t,
        arm_point=arm_point,
        person_point=person_point,
        arm_radius=arm_radius,
        person_radius=radius,
        joint_axes=frames[..., :joints, :, 2],
        joint_origins=frames[..., :joints, :, 3],
        moved=_moved(links, joints).to(q.device),
    )


@cache
def _moved(links: tuple[int, ...], joints: int) -> Bool[Tensor, "links joints"]:
    """Mask of the joints that move a link: those up to its own number."""
    with torch.inference_mode(False):
        return torch.arange(joints) < torch.tensor(links)[:, None]


def _between(segment: Tensor, fraction: Tensor) -> Tensor:
    """Point of a segment."""
    first, second = segment.unbind(-2)
    return first + fraction.unsqueeze(-1) * (second - first)


def _stacked(points: Tensor, last: Tensor) -> Tensor:
    """(*batch, C, H, 3) and one more row (*batch, H, 3)."""
    return torch.cat([points, last[..., None, :, :].expand(*points.shape[:-3], 1, -1, -1)], -3)


def _nearest_on_box(tool: Tensor, ends: Tensor, box: GraspedBox) -> tuple[Tensor, Tensor]:
    """Points of a held box nearest to segments, and where on these the nearest points lie."""
    R, p = tool[..., :3], tool[..., None, :, 3]
    local = (ends - p[..., None, :]) @ R[..., None, :, :]
    centre, half_size = local.new_tensor(box.centre), local.new_tensor(box.half_size)
    point, fraction = nearest_on_segment_and_box(local, centre, half_size)
    return point @ R.mT + p, fraction
