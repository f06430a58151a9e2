"""Capsules of an arm: self-collision, and distances from boxes and from people.

Each pair of an arm's capsule and a person's capsule has a signed distance, a direction and a
gradient in closed form, so that a controller can keep all distances above zero:

    d_dot = gradient @ q_dot + direction . v

with v the velocity of the person's nearest point.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from typing import Any, final

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from hrc_learn.geometry import Capsule
from hrc_learn.geometry.numerics import Constant, cached_tensors, safe_norm
from hrc_learn.kinematics.chain import SerialChain

# Search for the point of a segment nearest to a box. In each round, 31 points select one of 32
# parts of the interval. The last interval is 1e-6 of the segment's length.
_PARTS, _ROUNDS = 32, 4
_TRIED = [
    Constant(torch.arange(1, _PARTS, dtype=torch.float64) / _PARTS ** (k + 1))
    for k in range(_ROUNDS)
]
# Rounding error of a bound on a distance [m], for float32 and distances within reach.
_ROUNDING = 1e-6


@dataclass(frozen=True, kw_only=True)
class LinkCapsule(Capsule):
    """A capsule in the frame of a link."""

    link: int
    """Number of the link that carries the capsule; 0 is the base."""


def link_capsules(rows: Iterable[Sequence[Any]]) -> tuple[LinkCapsule, ...]:
    """Capsules from rows: link, both ends of the axis and radius [m]."""
    return tuple(
        LinkCapsule(link=link, start=tuple(start), end=tuple(end), radius=radius)
        for link, start, end, radius in rows
    )


@final
class CapsuleArm:
    """Distances of an arm's capsules from each other and from obstacles.

    A negative distance is the depth to which two capsules overlap. Links are numbered as
    `SerialChain.link_poses` lists their frames, from 1; 0 is the base.

    Attributes:
        chain: The arm.
        capsules: Capsules of the links.
        links: Number of the link of each capsule.
        radius: Radius of each capsule [m].
        overlapping: Pairs of links that overlap by design, besides neighbours.
    """

    def __init__(
        self,
        chain: SerialChain,
        capsules: Sequence[LinkCapsule],
        overlapping: Sequence[tuple[int, int]] = (),
    ):
        """Put the capsules on the links.

        Args:
            chain: The arm.
            capsules: Capsules of the links.
            overlapping: Pairs of links that overlap by design, besides neighbours.
        """
        self.chain = chain
        self.capsules = tuple(capsules)
        self.overlapping = tuple(overlapping)
        self.links = tuple(capsule.link for capsule in capsules)
        ends = [[capsule.start, capsule.end] for capsule in capsules]
        self._ends = Constant(torch.tensor(ends, dtype=torch.float64))
        self._links = Constant(torch.tensor(self.links))
        self._base = Constant(torch.eye(3, 4, dtype=torch.float64))
        self.radius = torch.tensor([c.radius for c in capsules], dtype=torch.float64)
        apart = {frozenset(pair) for pair in overlapping}
        pairs = [
            (i, k)
            for i, k in combinations(range(len(capsules)), 2)
            if abs(self.links[i] - self.links[k]) > 1
            and frozenset((self.links[i], self.links[k])) not in apart
        ]
        self._pairs = torch.tensor(pairs, dtype=torch.long).reshape(-1, 2).mT
        first, second = self._pairs
        self._first, self._second = Constant(first), Constant(second)
        self._reach = Constant(self.radius[first] + self.radius[second])
        moving = torch.tensor([i for i, link in enumerate(self.links) if link > 0])
        self._moving, self._moving_radius = Constant(moving), Constant(self.radius[moving])

    def with_capsules(self, more: Sequence[LinkCapsule]) -> CapsuleArm:
        """The same arm with additional capsules, for example of an object in its gripper."""
        return CapsuleArm(self.chain, (*self.capsules, *more), self.overlapping)

    def segments(
        self,
        q: Float[Tensor, "*batch joints"],
        frames: Float[Tensor, "*batch links 3 4"] | None = None,
    ) -> Float[Tensor, "*batch C 2 3"]:
        """Ends of all capsules in the base frame [m].

        Args:
            q: Joint positions [rad].
            frames: `SerialChain.link_frames` at q, if already computed.
        """
        if frames is None:
            frames = self.chain.link_frames(q)
        base = self._base.like(q).expand_as(frames[..., :1, :, :])
        frames = torch.cat([base, frames], dim=-3).index_select(-3, self._links.like(q))
        R, p = frames[..., :3], frames[..., None, :, 3]
        return self._ends.like(q) @ R.mT + p

    def pair_distances(
        self,
        q: Float[Tensor, "*batch joints"],
        frames: Float[Tensor, "*batch links 3 4"] | None = None,
    ) -> Float[Tensor, "*batch P"]:
        """Distance of each pair of capsules that should not touch [m], see `pairs`.

        Args:
            q: Joint positions [rad].
            frames: `SerialChain.link_frames` at q, if already computed.
        """
        ends = self.segments(q, frames)
        first, second = (ends.index_select(-3, i.like(q)) for i in (self._first, self._second))
        return segment_distance(first, second) - self._reach.like(q)

    @property
    def pairs(self) -> list[tuple[int, int]]:
        """Numbers of the two capsules of each pair that should not touch."""
        return [(int(i), int(k)) for i, k in self._pairs.mT]

    def self_distance(
        self,
        q: Float[Tensor, "*batch joints"],
        frames: Float[Tensor, "*batch links 3 4"] | None = None,
    ) -> Float[Tensor, "*batch"]:
        """Smallest of `pair_distances` [m]; infinite if there are no pairs.

        Args:
            q: Joint positions [rad].
            frames: `SerialChain.link_frames` at q, if already computed.
        """
        if self._pairs.numel() == 0:
            return torch.full_like(q[..., 0], torch.inf)
        return self.pair_distances(q, frames).amin(-1)

    def box_distance(
        self,
        q: Float[Tensor, "*batch joints"],
        centre: Float[Tensor, "*boxes 3"],
        half_size: Float[Tensor, "*boxes 3"],
        frames: Float[Tensor, "*batch links 3 4"] | None = None,
    ) -> Float[Tensor, "*batch"]:
        """Distance of the nearest moving link from boxes aligned with the base axes [m].

        Where the axis of a capsule enters a box, the distance is minus the capsule's radius
        instead of minus the depth. A branch on the data skips pairs of a link and a box that
        are too far apart to be the nearest. Therefore, this method neither compiles nor works
        under `vmap`.

        Args:
            q: Joint positions [rad].
            centre: Centre of the box, or of each of several boxes [m].
            half_size: Half edges of the box, or of each box [m].
            frames: `SerialChain.link_frames` at q, if already computed.
        """
        ends = self.segments(q, frames).index_select(-3, self._moving.like(q))
        batch, ends = ends.shape[:-3], ends.reshape(-1, *ends.shape[-3:])
        radius = self._moving_radius.like(q)
        centre, half_size = (side.to(q).reshape(-1, 3) for side in (centre, half_size))
        start, end = ends.unbind(-2)
        offset = ((start + end) / 2).unsqueeze(-2) - centre
        outside = offset - offset.clamp(-half_size, half_size)
        # No point of a capsule is further from its middle than half its axis plus its radius.
        middle = torch.linalg.vector_norm(outside, dim=-1) - radius.unsqueeze(-1)
        half_axis = torch.linalg.vector_norm(end - start, dim=-1, keepdim=True) / 2
        least = middle.amin((-2, -1), keepdim=True) + _ROUNDING
        # Written so that NaN counts as near, and the result becomes NaN.
        near = ~(middle - half_axis > least)
        posture, link, box = near.nonzero(as_tuple=True)
        distance = segment_box_distance(ends[posture, link], centre[box], half_size[box])
        far = torch.full_like(start[:, 0, 0], torch.inf)
        nearest = far.scatter_reduce(0, posture, distance - radius[link], "amin")
        return nearest.reshape(batch)


def segment_distance(
    first: Float[Tensor, "*#batch 2 3"], second: Float[Tensor, "*#batch 2 3"]
) -> Float[Tensor, "*batch"]:
    """Smallest distance between points of two segments."""
    s, t = (fraction.unsqueeze(-1) for fraction in nearest_on_segments(first, second))
    along, across = first[..., 1, :] - first[..., 0, :], second[..., 1, :] - second[..., 0, :]
    gap = first[..., 0, :] - second[..., 0, :] + s * along - t * across
    return torch.linalg.vector_norm(gap, dim=-1)


def nearest_on_segments(
    first: Float[Tensor, "*#batch 2 3"], second: Float[Tensor, "*#batch 2 3"]
) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"]]:
    """Nearest points of two segments (Ericson 2005, section 5.1.9).

    Returns:
        Points on the first and the second segment, as fractions of their length from the first
        end.
    """
    start, along = first[..., 0, :], first[..., 1, :] - first[..., 0, :]
    other, across = second[..., 0, :], second[..., 1, :] - second[..., 0, :]
    offset = start - other
    # Segments of length zero are points. The derivative divides by the squares of a and e, so
    # the bound `tiny` is the smallest value whose square does not underflow.
    tiny = math.sqrt(torch.finfo(first.dtype).tiny)
    a, e = ((v * v).sum(-1).clamp(min=tiny) for v in (along, across))
    b, c, f = (along * across).sum(-1), (along * offset).sum(-1), (across * offset).sum(-1)
    determinant = (a * e - b * b).clamp(min=0)
    # For parallel segments, any point of the first segment may be the nearest. Determinants
    # below this threshold are rounding errors.
    parallel = determinant <= 1e-12 * a * e
    s = torch.where(parallel, 0.0, (b * f - c * e) / torch.where(parallel, 1.0, determinant))
    t = ((b * s.clamp(0, 1) + f) / e).clamp(0, 1)
    return ((b * t - c) / a).clamp(0, 1), t


def segment_box_distance(
    segment: Float[Tensor, "*#batch 2 3"],
    centre: Float[Tensor, "*#batch 3"],
    half_size: Float[Tensor, "*#batch 3"],
) -> Float[Tensor, "*batch"]:
    """Smallest distance between points of a segment and a box; zero where they meet."""
    point, fraction = nearest_on_segment_and_box(segment, centre, half_size)
    start, along = segment[..., 0, :], segment[..., 1, :] - segment[..., 0, :]
    return torch.linalg.vector_norm(start + fraction.unsqueeze(-1) * along - point, dim=-1)


def nearest_on_segment_and_box(
    segment: Float[Tensor, "*#batch 2 3"],
    centre: Float[Tensor, "*#batch 3"],
    half_size: Float[Tensor, "*#batch 3"],
) -> tuple[Float[Tensor, "*batch 3"], Float[Tensor, "*batch"]]:
    """Nearest points of a segment and an axis-aligned box.

    The distance from a convex set is convex along a line; the root of its slope gives the
    minimum.

    Returns:
        The point of the box, and the point of the segment as a fraction of its length.
    """
    start, along = segment[..., 0, :], segment[..., 1, :] - segment[..., 0, :]
    shift, way = (start - centre).unsqueeze(-2), along.unsqueeze(-2)
    lowest, highest = -half_size.unsqueeze(-2), half_size.unsqueeze(-2)
    low, width = torch.zeros_like(shift[..., 0]), 1.0
    for tried in _TRIED:
        offset = torch.addcmul(shift, (low + tried.like(low)).unsqueeze(-1), way)
        outside = offset - offset.clamp(lowest, highest)
        falling = torch.linalg.vecdot(outside, way) <= 0
        width = width / _PARTS
        low = torch.add(low, falling.sum(-1, keepdim=True, dtype=low.dtype), alpha=width)
    fraction = low.squeeze(-1) + width / 2
    offset = start + fraction.unsqueeze(-1) * along - centre
    return offset.clamp(-half_size, half_size) + centre, fraction


@dataclass(frozen=True, kw_only=True)
class GraspedBox:
    """A box between the fingers, with edges along the axes of the tool's frame."""

    half_size: tuple[float, float, float]
    """Half of the edges along x, y (the closing direction) and z of the tool [m]."""
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Centre of the box in the frame of the tool centre point [m]."""

    @property
    def end(self) -> tuple[float, float, float]:
        """Middle of the face that is furthest along z of the tool [m]."""
        x, y, z = self.centre
        return (x, y, z + self.half_size[2])


@dataclass(frozen=True, kw_only=True, eq=False)
class Separation:
    """Distances of an arm's C capsules from a person's H capsules.

    If the arm holds an object, this object counts as the last of the C capsules.
    """

    distance: Float[Tensor, "*batch C H"]
    """Distance between the surfaces [m]; if negative, the depth to which capsules overlap."""
    direction: Float[Tensor, "*batch C H 3"]
    """Unit vector from the arm to the person. It is undefined, and set to zero, where the axes
    of two capsules meet or the axis of the person's capsule enters the held box."""
    fraction: Float[Tensor, "*batch C H"]
    """Nearest point on the axis of the person's capsule, 0 to 1 from its first end."""
    arm_point: Float[Tensor, "*batch C H 3"]
    """Nearest point on the axis of the arm's capsule, or on the held box, in the base frame
    [m]."""
    arm_radius: Float[Tensor, " C"]
    """Radii of the arm's capsules; zero for the held box [m]."""
    joint_axes: Float[Tensor, "*#batch joints 3"]
    """Axes of the joints in the base frame."""
    joint_origins: Float[Tensor, "*#batch joints 3"]
    """Points on the axes of the joints, in the base frame [m]."""
    moved: Bool[Tensor, "C joints"]
    """Mask of the joints that move each of the arm's capsules."""

    @property
    def on_arm(self) -> Float[Tensor, "*batch C H 3"]:
        """Nearest point on the arm's surface, in the base frame [m]."""
        return self.arm_point + self.arm_radius[:, None, None] * self.direction

    @cached_property
    def gradient(self) -> Float[Tensor, "*batch C H joints"]:
        """Gradient of the distance with respect to the joint positions [m/rad]."""
        shape = self.distance.shape[-2:]
        every = torch.arange(shape.numel(), device=self.distance.device)
        return self.gradient_of(every).unflatten(-2, shape)

    def gradient_of(
        self, pairs: Int[Tensor, "*#batch pairs"]
    ) -> Float[Tensor, "*batch pairs joints"]:
        """Rows of the gradient for some pairs of capsules [m/rad].

        Args:
            pairs: Numbers c H + h of pairs of capsules (c of the arm, h of the person). They
                are the same for the whole batch, or given separately for each element.
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
    """Distances of all capsules of an arm from all capsules of a person.

    Nearest points of two segments follow Ericson (2005), section 5.1.9. Nearest points of a
    segment and a box are found by interval search. Distances from a held box are exact unless
    the axis of a person's capsule enters the box. Where several points are equally near, the
    gradient belongs to one of them.

    Args:
        arm: The arm's capsules.
        q: Joint positions [rad].
        ends: Ends of the axes of the person's capsules, in the base frame [m].
        radius: Radii of these capsules [m].
        grasped: Object held by the arm; None: no object.

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
        box = box[..., None, :, :].expand(*arm_point.shape[:-3], 1, -1, -1)
        arm_point = torch.cat([arm_point, box], dim=-3)
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
        arm_radius=arm_radius,
        joint_axes=frames[..., :joints, :, 2],
        joint_origins=frames[..., :joints, :, 3],
        moved=_moved(links, joints).to(q.device),
    )


@cached_tensors(maxsize=64)
def _moved(links: tuple[int, ...], joints: int) -> Bool[Tensor, "links joints"]:
    """Mask of the joints that move a link: all joints up to the link's own number."""
    return torch.arange(joints) < torch.tensor(links)[:, None]


def _between(segment: Tensor, fraction: Tensor) -> Tensor:
    """Point at a fraction of a segment."""
    first, second = segment.unbind(-2)
    return first + fraction.unsqueeze(-1) * (second - first)


def _nearest_on_box(tool: Tensor, ends: Tensor, box: GraspedBox) -> tuple[Tensor, Tensor]:
    """Points of a held box nearest to segments, in the base frame [m], and nearest points of
    the segments as fractions of their length.
    """
    R, p = tool[..., :3], tool[..., None, :, 3]
    local = (ends - p[..., None, :]) @ R[..., None, :, :]
    centre, half_size = local.new_tensor(box.centre), local.new_tensor(box.half_size)
    point, fraction = nearest_on_segment_and_box(local, centre, half_size)
    return point @ R.mT + p, fraction
