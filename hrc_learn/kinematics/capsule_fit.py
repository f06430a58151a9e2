"""Capsules around the links of an arm from a file, and pairs of links that need no check.

Capsules contain the convex hulls of a link's collision shapes, which MuJoCo uses for contacts
as well. Where it saves volume, planes across a principal axis cut a link into two or three
parts with one capsule each. For registered arms, tools/fit_capsules.py fits more closely.
"""

from __future__ import annotations

import math
import warnings
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise

import numpy as np
import torch
from jaxtyping import Float

from hrc_learn.geometry import mesh_points
from hrc_learn.kinematics.chain import SerialChain
from hrc_learn.kinematics.collision import CapsuleArm, LinkCapsule, link_capsules
from hrc_learn.kinematics.description import Shape

# Margin with which capsules contain every point [m], far above rounding errors.
_SLACK = 1e-6
# Fraction of the volume that one more capsule for a link must save.
_WORTH = 0.2
# Cuts of a link, as fractions of its extent along an axis.
_CUTS = ((), (0.35,), (0.5,), (0.65,), (0.2, 0.8), (0.3, 0.7))
# Number of corners of the prism around a cylinder; the corners are 2 % outside the cylinder.
_CORNERS = 16
# Steps towards the smallest circle around points (Badoiu and Clarkson 2003).
_CIRCLE_STEPS = 32
# Seed and number of the random postures in which pairs of links are compared.
_SEED, _POSTURES = 0, 2000
# `_BARE_RADIUS`: radius of links of unknown shape [m], about that of a large arm's forearm.
# `_BARE_FRACTION`: largest value of this radius, as a fraction of the arm's length.
_BARE_RADIUS, _BARE_FRACTION = 0.045, 0.06
# Pairs of links that stay farther apart than this in all sampled postures are ignored [m].
_FAR = 0.1
# Pairs of links that overlap in a larger fraction of postures than this are ignored, too:
# `_MOST` for links with one link between them, `_ALWAYS` for all others.
_ALWAYS, _MOST = 0.99, 0.5

type _Capsule = tuple[np.ndarray, np.ndarray, float]
"""Both ends of the axis and the radius [m]."""


def fit_body(chain: SerialChain, shapes: Sequence[tuple[int, Shape]]) -> CapsuleArm:
    """Fit capsules around the shapes on an arm's links.

    Like MoveIt's setup assistant, this function ignores pairs of links that are neighbours,
    that overlap in nearly all random postures, or that never come near each other. Capsules are
    rounder than links: capsules of a short, wide link overlap capsules of the next link but
    one. Such a pair of links is also ignored if it overlaps in most postures.

    Args:
        chain: The arm.
        shapes: Shapes, each with the number of its link's frame. A link without a shape gets a
            capsule from its own frame to the next.
    """
    hulls: dict[int, list[Hull]] = defaultdict(list)
    capsules: list[LinkCapsule] = []
    for link, shape in shapes:
        if shape.kind in ("sphere", "capsule"):
            (radius, half), pose = shape.size, shape.pose
            start, end = (pose[:3, 3] + s * half * pose[:3, 2] for s in (-1, 1))
            capsules += link_capsules([(link, start.tolist(), end.tolist(), radius)])
        else:
            try:
                hull = hull_of(shape)
            except ValueError as error:  # a broken mesh
                warnings.warn(f"no capsule for a shape of link {link}: {error}", stacklevel=2)
            else:
                hulls[link].append(hull)
    for link, parts in hulls.items():
        capsules += link_capsules(
            (link, a.tolist(), b.tolist(), r) for a, b, r in fit_link(parts)
        )
    steps = [step[:3, 3].numpy() for step in (*chain.mounts, chain.flange, chain.tcp)]
    lengths = [float(np.linalg.norm(step)) for step in steps]
    radius = min(_BARE_RADIUS, _BARE_FRACTION * sum(lengths))
    shown = {capsule.link for capsule in capsules}
    capsules += link_capsules(
        (link, (0.0, 0.0, 0.0), step.tolist(), radius)
        for link, (step, length) in enumerate(zip(steps, lengths, strict=True))
        # A link shorter than this radius lies inside its neighbours.
        if link not in shown and (length > radius or not shown)
    )
    return CapsuleArm(chain, capsules, _left_out(chain, capsules))


@dataclass(frozen=True)
class Hull:
    """A convex hull."""

    points: Float[np.ndarray, "points 3"]
    edges: Float[np.ndarray, "edges 2 3"]

    def between(self, axis: np.ndarray, low: float, high: float) -> np.ndarray:
        """Corners of the part of the hull between two planes perpendicular to an axis."""
        along = self.points @ axis
        found = [self.points[(along >= low) & (along <= high)]]
        start, end = self.edges[:, 0] @ axis, self.edges[:, 1] @ axis
        for level in (low, high):
            crosses = (start - level) * (end - level) < 0
            fraction = (level - start[crosses]) / (end[crosses] - start[crosses])
            first, second = self.edges[crosses, 0], self.edges[crosses, 1]
            found.append(first + fraction[:, None] * (second - first))
        return np.concatenate(found)


def hull_of(shape: Shape) -> Hull:
    """Convex hull of a shape, or of a prism around a round shape.

    Raises:
        ModuleNotFoundError: SciPy is not installed.
    """
    try:  # only here: the rest of the package's core works without it
        from scipy.spatial import ConvexHull, QhullError
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            "fitting capsules to the shapes of an arm needs SciPy: pip install "
            "'hrc-learn[meshes]'",
            name="scipy",
        ) from error

    points = shape_points(shape) @ shape.pose[:3, :3].T + shape.pose[:3, 3]
    try:
        hull = ConvexHull(points)
    except QhullError:  # flat: any two of the few points may be an edge
        points = np.unique(points, axis=0)
        return Hull(points, points[list(combinations(range(min(len(points), 200)), 2))])
    faces = hull.simplices
    pairs = np.unique(np.sort(np.concatenate([faces[:, [i, i - 1]] for i in range(3)])), axis=0)
    return Hull(points[hull.vertices], points[pairs])


def shape_points(shape: Shape) -> Float[np.ndarray, "points 3"]:
    """Points with a convex hull that contains a shape, in the frame of the shape [m]."""
    if shape.kind == "mesh":
        assert shape.path is not None
        return mesh_points(shape.path) * shape.scale
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    if shape.kind == "box":
        return signs * shape.size
    radius, half = shape.size
    if shape.kind != "cylinder":  # each end is a ball, and a cube contains it
        return signs * radius + np.sign(signs[:, 2:]) * [0, 0, half]
    angle = np.arange(_CORNERS) * 2 * math.pi / _CORNERS
    round_ = radius / math.cos(math.pi / _CORNERS) * np.stack([np.cos(angle), np.sin(angle)], 1)
    return np.concatenate(
        [np.column_stack([round_, np.full(_CORNERS, z)]) for z in (-half, half)]
    )


def fit_link(hulls: Sequence[Hull]) -> list[_Capsule]:
    """Up to three capsules that contain convex hulls."""
    points = np.concatenate([hull.points for hull in hulls])
    best: dict[int, tuple[float, list[_Capsule]]] = {}
    for axis in principal_axes(points):
        along = points @ axis
        low, high = along.min(), along.max()
        for cuts in _CUTS:
            levels = low + np.array([-0.1, *cuts, 1.1]) * (high - low)
            parts = [
                np.concatenate([hull.between(axis, a, b) for hull in hulls])
                for a, b in pairwise(levels.tolist())
            ]
            fits = [_smallest_capsule(part) for part in parts if len(part)]
            volume = sum(map(capsule_volume, fits))
            if len(fits) not in best or volume < best[len(fits)][0]:
                best[len(fits)] = volume, fits
    chosen = best[min(best)]
    for count in sorted(best):
        if best[count][0] < (1 - _WORTH) * chosen[0]:
            chosen = best[count]
    return chosen[1]


def _smallest_capsule(points: Float[np.ndarray, "points 3"]) -> _Capsule:
    """The smallest of three capsules around points, one along each principal axis."""
    fits = []
    for axis in principal_axes(points):
        along = points @ axis
        flat = points - along[:, None] * axis
        centre, squared = flat.mean(0), (flat**2).sum(1)
        for k in range(_CIRCLE_STEPS):
            furthest = flat[(squared - 2 * (flat @ centre)).argmax()]
            centre = centre + (furthest - centre) / (k + 2)
        distance = np.linalg.norm(flat - centre, axis=1)
        radius = float(distance.max()) + _SLACK
        # No point may protrude from the round ends.
        bulge = np.sqrt(radius**2 - distance**2)
        low, high = (along + bulge).min(), (along - bulge).max()
        if low > high:
            low = high = (low + high) / 2
        fits.append((centre + low * axis, centre + high * axis, radius))
    return min(fits, key=capsule_volume)


def capsule_volume(capsule: _Capsule) -> float:
    """Volume of a capsule (start, end, radius) [m^3]."""
    start, end, radius = capsule
    return math.pi * radius**2 * (float(np.linalg.norm(end - start)) + 4 / 3 * radius)


def principal_axes(points: np.ndarray) -> np.ndarray:
    """Principal axes of points (n, 3) as rows, the shortest first."""
    return np.linalg.eigh(np.cov(points.T, bias=True))[1].T


def _left_out(
    chain: SerialChain, capsules: Sequence[LinkCapsule]
) -> tuple[tuple[int, int], ...]:
    """Pairs of links, other than neighbours, that need no check."""
    last = len(chain.joint_names)
    links = sorted({capsule.link for capsule in capsules})
    # The last link, the flange and the tool are one body, a neighbour of the link before it.
    pairs = {
        (i, k) for i, k in combinations(links, 2) if k > last and i >= last - 1 and k - i > 1
    }
    body = CapsuleArm(chain, capsules, tuple(pairs))
    if not body.pairs:
        return tuple(pairs)
    rng = torch.Generator().manual_seed(_SEED)
    lower, upper = chain.limits.lower, chain.limits.upper
    q = lower + (upper - lower) * torch.rand(_POSTURES, len(lower), generator=rng).double()
    nearest: dict[tuple[int, int], torch.Tensor] = {}
    for (a, b), distance in zip(body.pairs, body.pair_distances(q).mT, strict=True):
        first, second = sorted((body.links[a], body.links[b]))
        before = nearest.get((first, second), distance)
        nearest[first, second] = torch.minimum(before, distance)
    for (i, k), distance in nearest.items():
        most = _MOST if min(k, last) - i == 2 else _ALWAYS
        if float((distance < 0).double().mean()) > most or float(distance.min()) > _FAR:
            pairs.add((i, k))
    return tuple(sorted(pairs))
