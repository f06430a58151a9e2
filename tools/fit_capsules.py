"""Fit capsules to the registered arms and write them where `arm()` finds them.

    python tools/fit_capsules.py [NAME ...]

This takes some seconds an arm. `hrc_learn/kinematics/capsule_fit.py` fits faster and more
coarsely, for files of users.

What is contained are the convex hulls of a link's collision shapes, which is what MuJoCo takes
for contacts as well. A link is cut into up to three parts by planes across one of its principal
axes where this saves volume, each part of the hulls lies in one capsule. Capsules of a link of
oblong section lie side by side; as they overlap, what counts is the volume of their union.
"""

from __future__ import annotations

import hashlib
import json
import math
import sys
from collections import defaultdict
from collections.abc import Mapping, Sequence
from itertools import combinations, pairwise

import numpy as np
import torch
from jaxtyping import Bool, Float

from hrc_learn.kinematics import MissingModelError, arm, registered_arms
from hrc_learn.kinematics.capsule_fit import (
    Hull,
    capsule_volume,
    hull_of,
    principal_axes,
)
from hrc_learn.kinematics.chain import SerialChain
from hrc_learn.kinematics.collision import CapsuleArm, LinkCapsule, link_capsules
from hrc_learn.kinematics.description import Shape
from hrc_learn.kinematics.registry import CAPSULES
from hrc_learn.store import write_text

# Ends are rounded to micrometres, so capsules are wider by this much [m].
_ROUNDING = 2e-6
# Capsules hold every point with this much to spare [m]: far above rounding.
_SLACK = 1e-6
# One more capsule for a link has to save this part of the volume. The wrists of a UR3 save 7 to
# 9 % by a second one, which takes 14 mm off their radius; 1 % is the error of the estimate.
_WORTH = 0.05
# Points by which the volume of a union is estimated.
_POINTS = 20_000
# Cuts of a link, as fractions of its extent along an axis.
_CUTS = ((), (0.25,), (0.35,), (0.5,), (0.65,), (0.75,), (0.2, 0.8), (0.3, 0.7))
# Rounds of the search for a capsule's axis, tries in each, and how far the tries go [rad].
_ROUNDS, _TRIES, _TILT = 8, 24, 0.5
# Steps towards the smallest circle around points (Badoiu and Clarkson 2003).
_CIRCLE_STEPS = 16
_SEED = 0
_POSTURES = 2000
# Pairs of links that come no nearer in any sampled posture are left out [m].
_FAR = 0.1
_ALWAYS = 0.99
# Capsules of two links that overlap in a larger fraction of the positions of the two joints in
# between carry no information about contacts.
_MOST = 0.5
# Positions of each of the two joints between two links: every 5 degrees of a whole turn.
_GRID = 73
# Steps of the search for a separating plane; hulls not separated by then count as touching.
_PARTING_STEPS = 200


def fit_body(chain: SerialChain, shapes: Sequence[tuple[int, Shape]]) -> CapsuleArm:
    """Fit capsules around the shapes on an arm's links.

    Like MoveIt's setup assistant, this ignores pairs of links that are neighbours, that overlap
    in all random postures, or that never come near each other in any. Capsules are rounder than
    links: around a short, wide link they overlap those of the link after the next. Such a pair
    is ignored if the convex hulls never meet, whatever the two joints in between; or if its
    capsules overlap in most positions of these joints and so carry no information (Universal
    Robots, whose links pass each other at a distance of a centimetre).

    Args:
        chain: The arm.
        shapes: Number of a link's frame, and a shape there.
    """
    hulls: dict[int, list[Hull]] = defaultdict(list)
    capsules: list[LinkCapsule] = []
    for link, shape in shapes:
        if shape.kind in ("sphere", "capsule"):
            capsules.append(_round(link, shape))
        else:
            hulls[link].append(hull_of(shape))
    for link, parts in hulls.items():
        capsules += link_capsules(
            (link, a.tolist(), b.tolist(), r) for a, b, r in fit_link(parts)
        )
    return CapsuleArm(chain, capsules, _left_out(chain, capsules, hulls))


type _Fit = tuple[np.ndarray, np.ndarray, float]
"""Both ends of the axis and the radius [m]."""


def fit_link(hulls: Sequence[Hull]) -> list[_Fit]:
    """Up to three capsules that contain convex hulls."""
    points = np.concatenate([hull.points for hull in hulls])
    axes = principal_axes(points)
    rng = np.random.default_rng(_SEED)
    best: dict[int, tuple[float, list[np.ndarray]]] = {}
    for axis in axes:
        along = points @ axis
        low, high = along.min(), along.max()
        for cuts in _CUTS:
            levels = low + np.array([-0.1, *cuts, 1.1]) * (high - low)
            parts = [
                np.concatenate([hull.between(axis, a, b) for hull in hulls])
                for a, b in pairwise(levels.tolist())
            ]
            parts = [part for part in parts if len(part)]
            volume = union_volume([fit_capsule(part, rng, rounds=1) for part in parts])
            if len(parts) not in best or volume < best[len(parts)][0]:
                best[len(parts)] = volume, parts
    chosen = best[min(best)]
    for count in sorted(best):
        if best[count][0] < (1 - _WORTH) * chosen[0]:
            chosen = best[count]
    return [fit_capsule(part, rng, rounds=_ROUNDS) for part in chosen[1]]


def union_volume(capsules: Sequence[_Fit]) -> float:
    """Volume that capsules fill together, estimated by a fixed set of points [m^3]."""
    if len(capsules) == 1:
        return capsule_volume(capsules[0])
    starts, ends, radii = map(np.array, zip(*capsules, strict=True))
    reach = radii[:, None]
    low = np.minimum(starts, ends) - reach
    high = np.maximum(starts, ends) + reach
    low, edges = low.min(0), high.max(0) - low.min(0)
    points = low + edges * np.random.default_rng(_SEED).random((_POINTS, 3))
    inside = np.zeros(_POINTS, dtype=bool)
    for start, end, radius in capsules:
        way = end - start
        fraction = ((points - start) @ way / max(float(way @ way), 1e-30)).clip(0, 1)
        nearest = start + fraction[:, None] * way
        inside |= np.linalg.norm(points - nearest, axis=1) < radius
    return float(inside.mean() * edges.prod())


def fit_capsule(
    points: Float[np.ndarray, "points 3"], rng: np.random.Generator, *, rounds: int
) -> _Fit:
    """A small capsule around points.

    From the best of the principal axes the axis is turned at random, ever less, and a turn kept
    that makes the capsule smaller.
    """
    everything = points
    points = np.unique(points[(points @ _DIRECTIONS.T).argmax(0)], axis=0)
    axes = principal_axes(points)
    volume, best = min(_around(points, axes), key=lambda f: f[0])
    tilt = _TILT
    for _ in range(rounds):
        axis = best[0]
        tried = axis + tilt * rng.standard_normal((_TRIES, 3))
        tried /= np.linalg.norm(tried, axis=1, keepdims=True)
        found = min(_around(points, tried), key=lambda f: f[0])
        if found[0] < volume:
            volume, best = found
        else:
            tilt /= 2
    _, start, end, radius = best
    way = end - start
    fraction = (everything - start) @ way / max(float(way @ way), 1e-30)
    nearest = start + fraction.clip(0, 1)[:, None] * way
    furthest = float(np.linalg.norm(everything - nearest, axis=1).max())
    return start, end, max(radius, furthest) + _SLACK


def _sphere(count: int) -> np.ndarray:
    """Directions spread evenly, along a spiral (Fibonacci)."""
    k = np.arange(count) + 0.5
    z, turn = 1 - 2 * k / count, k * math.pi * (1 + math.sqrt(5))
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(turn), r * np.sin(turn), z], axis=1)


# A capsule is sought around the points furthest out in these, then widened for the rest.
_DIRECTIONS = _sphere(128)


def _around(points: np.ndarray, axes: np.ndarray) -> list[tuple[float, tuple]]:
    """Volume and shape of the capsule around points along each axis."""
    helper = np.eye(3)[np.abs(axes).argmin(1)]
    u = np.cross(axes, helper)
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    v = np.cross(axes, u)
    flat = np.stack([u @ points.T, v @ points.T], axis=-1)  # tries, points, 2
    along = axes @ points.T
    centre = (flat.max(1) + flat.min(1)) / 2
    rows = np.arange(len(axes))
    nearest, radius = centre, np.full(len(axes), np.inf)
    for k in range(_CIRCLE_STEPS):
        distance = np.linalg.norm(flat - centre[:, None], axis=-1)
        furthest = distance.argmax(1)
        r = distance[rows, furthest]
        better = r < radius
        nearest, radius = np.where(better[:, None], centre, nearest), np.minimum(radius, r)
        centre = centre + (flat[rows, furthest] - centre) / (k + 2)
    distance = np.linalg.norm(flat - nearest[:, None], axis=-1)
    results = []
    for i in rows:
        shapes = []
        for wider in (1.0, 1.05, 1.15):
            r = radius[i] * wider
            bulge = np.sqrt(np.maximum(r * r - distance[i] ** 2, 0.0))
            # Every point must be no further out than the round end there.
            low, high = (along[i] + bulge).min(), (along[i] - bulge).max()
            if low > high:
                low = high = (low + high) / 2
            shapes.append((math.pi * r**2 * (high - low + 4 / 3 * r), low, high, r))
        volume, low, high, r = min(shapes)
        origin = nearest[i, 0] * u[i] + nearest[i, 1] * v[i]
        ends = origin + low * axes[i], origin + high * axes[i]
        results.append((float(volume), (axes[i], *ends, float(r))))
    return results


def _round(link: int, shape: Shape) -> LinkCapsule:
    (radius, half), pose = shape.size, shape.pose
    start, end = (pose[:3, 3] + s * half * pose[:3, 2] for s in (-1, 1))
    return link_capsules([(link, start.tolist(), end.tolist(), radius)])[0]


def _left_out(
    chain: SerialChain,
    capsules: Sequence[LinkCapsule],
    hulls: Mapping[int, Sequence[Hull]],
) -> tuple[tuple[int, int], ...]:
    """Pairs of links that are no neighbours and yet need no watching."""
    last = len(chain.joint_names)
    links = sorted({capsule.link for capsule in capsules})
    # The last link, the flange and the tool are one body, and the link before its neighbour.
    rigid = {
        (i, k) for i, k in combinations(links, 2) if k > last and i >= last - 1 and k - i > 1
    }
    body = CapsuleArm(chain, capsules, tuple(rigid))
    if not body.pairs:
        return tuple(rigid)
    rng = torch.Generator().manual_seed(_SEED)
    lower, upper = chain.limits.lower, chain.limits.upper
    q = lower + (upper - lower) * torch.rand(_POSTURES, len(lower), generator=rng).double()
    # Round shapes are what their capsules are: nothing is gained by looking at hulls.
    round_ = {capsule.link for capsule in capsules} - set(hulls)
    for (i, k), distance in _by_links(body, q).items():
        always = float((distance < 0).double().mean()) > _ALWAYS
        if always or float(distance.min()) > _FAR:
            rigid.add((i, k))
        elif min(k, last) - i == 2:
            crossed = _grid(chain, i, min(k, last))
            met = _by_links(body, crossed)[i, k] < 0
            apart = i not in round_ and k not in round_ and bool(met.any())
            apart = apart and not _meet(chain, crossed[met], (i, k), hulls)
            if apart or float(met.double().mean()) > _MOST:
                rigid.add((i, k))
    return tuple(sorted(rigid))


def _by_links(
    body: CapsuleArm, q: Float[torch.Tensor, "postures joints"]
) -> dict[tuple[int, int], Float[torch.Tensor, " postures"]]:
    """Distance of the nearest capsules of each pair of links, lower number first [m]."""
    nearest: dict[tuple[int, int], torch.Tensor] = {}
    for (a, b), distance in zip(body.pairs, body.pair_distances(q).mT, strict=True):
        first, second = sorted((body.links[a], body.links[b]))
        before = nearest.get((first, second))
        nearest[first, second] = distance if before is None else torch.minimum(before, distance)
    return nearest


def _grid(chain: SerialChain, first: int, second: int) -> Float[torch.Tensor, "grid joints"]:
    """All positions of the two joints between links, the others in the middle."""
    q = chain.limits.middle.repeat(_GRID, _GRID, 1)
    for axis, joint in enumerate(range(first, second)):
        middle = chain.limits.middle[joint]
        half = (chain.limits.upper[joint] - chain.limits.lower[joint]) / 2
        if chain.kinds[joint] != "prismatic":
            half = half.clamp(max=math.pi)
        at = middle + half * torch.linspace(-1, 1, _GRID, dtype=torch.float64)
        q[..., joint] = at[:, None] if axis == 0 else at
    return q.flatten(0, 1)


def _meet(
    chain: SerialChain,
    q: Float[torch.Tensor, "postures joints"],
    pair: tuple[int, int],
    hulls: Mapping[int, Sequence[Hull]],
) -> bool:
    """True if the convex hulls of two links meet, or may meet, in any of several postures."""
    frames = chain.link_frames(q)
    base = torch.eye(4, dtype=torch.float64)[:3].expand(len(q), 3, 4)
    R, p = zip(
        *((T[..., :3], T[..., 3]) for T in (frames[:, i - 1] if i else base for i in pair)),
        strict=True,
    )
    turn, shift = R[0].mT @ R[1], (R[0].mT @ (p[1] - p[0])[..., None])[..., 0]
    return any(
        not bool(_parted(first.points, second.points, turn, shift).all())
        for first in hulls[pair[0]]
        for second in hulls[pair[1]]
    )


def _parted(
    first: Float[np.ndarray, "points 3"],
    second: Float[np.ndarray, "corners 3"],
    turn: Float[torch.Tensor, "poses 3 3"],
    shift: Float[torch.Tensor, "poses 3"],
) -> Bool[torch.Tensor, " poses"]:
    """True where a plane separates two convex hulls, so that they certainly do not meet.

    Gilbert's method (1966) walks, among differences of their points, towards the shortest one:
    its normal plane separates the hulls as soon as all differences lie beyond the plane.

    Args:
        first: Corners of one hull.
        second: Corners of the other hull, in its own frame.
        turn: Rotation of that frame in the first one's.
        shift: Origin of that frame in the first one's [m].
    """
    a, b = torch.from_numpy(first), torch.from_numpy(second)
    parted = torch.zeros(len(shift), dtype=torch.bool)
    rows = torch.arange(len(shift))
    v = a.mean(0) - (turn @ b.mean(0) + shift)
    for _ in range(_PARTING_STEPS):
        R, p = turn[rows], shift[rows]
        nearest = a[(v @ a.mT).argmin(-1)]
        other = b[((v[:, None] @ R)[:, 0] @ b.mT).argmax(-1)]
        w = nearest - ((R @ other[..., None])[..., 0] + p)
        beyond = (v * w).sum(-1) > 0
        parted[rows[beyond]] = True
        rows, v, w = rows[~beyond], v[~beyond], w[~beyond]
        if len(rows) == 0:
            break
        # The point of the segment from v to w that is nearest to the origin.
        way = v - w
        fraction = (v * way).sum(-1) / (way * way).sum(-1).clamp(min=1e-30)
        v = v - fraction.clamp(0, 1)[:, None] * way
    return parted


def main() -> None:
    torch.set_num_threads(1)
    known = json.loads(CAPSULES.read_text(encoding="utf-8")) if CAPSULES.is_file() else {}
    for name in sys.argv[1:] or registered_arms():
        try:
            found = arm(name)
        except MissingModelError as error:
            print(f"{name}: {error}")
            continue
        if found.description is None:
            continue
        body = fit_body(found, found.shape.shapes)
        print(f"{name}: {len(body.capsules)} capsules, {len(body.pairs)} pairs")
        known[name] = {
            "description_sha256": hashlib.sha256(found.description.read_bytes()).hexdigest(),
            "capsules": [
                [c.link, _rounded(c.start), _rounded(c.end), round(c.radius + _ROUNDING, 6)]
                for c in body.capsules
            ],
            "overlapping": [list(pair) for pair in body.overlapping],
        }
    rows = (f"{json.dumps(name)}: {json.dumps(known[name])}" for name in sorted(known))
    write_text(CAPSULES, "{\n" + ",\n".join(rows) + "\n}\n")


def _rounded(point: tuple[float, float, float]) -> list[float]:
    return [round(x, 6) for x in point]


if __name__ == "__main__":
    main()
