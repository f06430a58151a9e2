"""An arm as capsules: distances to itself and to boxes, batched."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import final

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.kinematics.chain import SerialChain

# Halvings of a segment in the search for its point nearest to a box: 1e-6 of its length.
_HALVINGS = 20


@dataclass(frozen=True, kw_only=True)
class LinkCapsule:
    """All points within a radius of a segment."""

    link: int
    """Number of the link it belongs to; 0 is the base."""
    start: tuple[float, float, float]
    """One end of the segment, in the frame of the link [m]."""
    end: tuple[float, float, float]
    """The other end [m]."""
    radius: float
    """[m]"""


@final
class CapsuleArm:
    """Distances of an arm's capsules from each other and from obstacles.

    Signed: negative is the depth to which two capsules overlap. Links are numbered as
    `SerialChain.link_poses` lists their frames, from 1; 0 is the base.

    Attributes:
        chain: The arm.
        capsules: Of its links.
        links: Number of the link of each capsule.
        radius: Of each capsule [m].
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
            capsules: Of its links.
            overlapping: Pairs of links that overlap by design, besides neighbours.
        """
        self.chain = chain
        self.capsules = tuple(capsules)
        self._overlapping = tuple(overlapping)
        self.links = tuple(capsule.link for capsule in capsules)
        ends = [[capsule.start, capsule.end] for capsule in capsules]
        self._ends = torch.tensor(ends, dtype=torch.float64)
        self.radius = torch.tensor([c.radius for c in capsules], dtype=torch.float64)
        apart = {frozenset(pair) for pair in overlapping}
        pairs = [
            (i, k)
            for i, k in combinations(range(len(capsules)), 2)
            if abs(self.links[i] - self.links[k]) > 1
            and frozenset((self.links[i], self.links[k])) not in apart
        ]
        self._pairs = torch.tensor(pairs).mT
        self._moving = [i for i, link in enumerate(self.links) if link > 0]

    def with_capsules(self, more: Sequence[LinkCapsule]) -> CapsuleArm:
        """The same arm with further capsules, such as of what is mounted on its hand."""
        return CapsuleArm(self.chain, (*self.capsules, *more), self._overlapping)

    def segments(self, q: Float[Tensor, "*batch joints"]) -> Float[Tensor, "*batch C 2 3"]:
        """Ends of all capsules in the base frame [m]."""
        frames = self.chain.link_poses(q).matrix()
        base = torch.eye(4, dtype=q.dtype, device=q.device).expand_as(frames[..., :1, :, :])
        frames = torch.cat([base, frames], dim=-3)[..., self.links, :, :]
        return self._ends.to(q) @ frames[..., :3, :3].mT + frames[..., None, :3, 3]

    def pair_distances(self, q: Float[Tensor, "*batch joints"]) -> Float[Tensor, "*batch P"]:
        """Distance of each pair of capsules that should not touch [m], see `pairs`."""
        first, second = self._pairs
        ends, radius = self.segments(q), self.radius.to(q)
        distance = segment_distance(ends[..., first, :, :], ends[..., second, :, :])
        return distance - radius[first] - radius[second]

    @property
    def pairs(self) -> list[tuple[int, int]]:
        """Numbers of the two capsules of each pair."""
        return [(int(i), int(k)) for i, k in self._pairs.mT]

    def self_distance(self, q: Float[Tensor, "*batch joints"]) -> Float[Tensor, "*batch"]:
        """Distance of the two nearest capsules that should not touch [m]."""
        return self.pair_distances(q).amin(-1)

    def box_distance(
        self,
        q: Float[Tensor, "*batch joints"],
        centre: Float[Tensor, "*boxes 3"],
        half_size: Float[Tensor, "*boxes 3"],
    ) -> Float[Tensor, "*batch"]:
        """Distance of the nearest moving link from boxes along the base axes [m].

        Inside a box it counts from the segment, not from the nearest wall.

        Args:
            q: Joint position [rad].
            centre: Of the box, or of each of several [m].
            half_size: Half of its edges [m].
        """
        ends = self.segments(q)[..., self._moving, None, :, :]
        boxes = (side.to(q).reshape(-1, 3) for side in (centre, half_size))
        distance = segment_box_distance(ends, *boxes).amin(-1)
        return (distance - self.radius.to(q)[self._moving]).amin(-1)


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
    """Where two segments are nearest to each other (Ericson 2005, section 5.1.9).

    Returns:
        On the first and on the second, each as a fraction of its length from its first end.
    """
    start, along = first[..., 0, :], first[..., 1, :] - first[..., 0, :]
    other, across = second[..., 0, :], second[..., 1, :] - second[..., 0, :]
    offset = start - other
    tiny = torch.finfo(first.dtype).tiny  # segments of length zero are points
    a, e = ((v * v).sum(-1).clamp(min=tiny) for v in (along, across))
    b, c, f = (along * across).sum(-1), (along * offset).sum(-1), (across * offset).sum(-1)
    determinant = (a * e - b * b).clamp(min=0)
    # Of nearly parallel segments any point of the first may be the nearest; a smaller
    # determinant is rounding.
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
    """Where a segment and a box with edges along the axes are nearest to each other.

    The distance from a convex set is convex along a line: its slope is bisected.

    Returns:
        The point of the box, and the point of the segment as a fraction of its length.
    """
    start, along = segment[..., 0, :], segment[..., 1, :] - segment[..., 0, :]

    def nearest(t: Tensor) -> tuple[Tensor, Tensor]:
        """The point at t, and that of the box nearest to it, both from the box's centre."""
        offset = start + t.unsqueeze(-1) * along - centre
        return offset, offset.clamp(-half_size, half_size)

    low = torch.zeros_like((start - centre)[..., 0])
    high = torch.ones_like(low)
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        point, inside = nearest(middle)
        rising = ((point - inside) * along).sum(-1) > 0
        low, high = torch.where(rising, low, middle), torch.where(rising, middle, high)
    fraction = (low + high) / 2
    return nearest(fraction)[1] + centre, fraction
