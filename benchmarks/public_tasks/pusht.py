"""Push-T of gym-pusht: a disc pushes a T on a table onto a drawn T.

The package has no demonstrations, and those of people must be downloaded, so the expert is our
own. It predicts the effect of a push: without friction at the disc and without inertia on the
table, each contact shifts and rotates the T along one known direction. It evaluates thousands
of sequences of straight pushes at once, chooses the sequence with the shortest predicted time,
executes its first push, observes, and plans again. Between pushes, the disc moves round the T.
The same observation after a push always gives the same next push.
"""

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from public_tasks.protocol import AGENT_POS, ENVIRONMENT_STATE, Expert, Observation

type Point = Float[np.ndarray, "2"]
type Points = Float[np.ndarray, "*N 2"]
type Pose = Float[np.ndarray, "3"]
"""Pose of the T: x and y of its origin, the middle of its top (pixels), and angle (rad)."""
type Poses = Float[np.ndarray, "*N 3"]

GOAL = np.array([256.0, 256.0, np.pi / 4])
"""Goal pose of the T, from the package."""
CENTRES = np.array([[0.0, 15.0], [0.0, 75.0]])
"""Centres of bar and stem, in the frame of the T, pixels."""
HALVES = np.array([[60.0, 15.0], [15.0, 45.0]])
"""Half the sides of bar and stem, pixels."""
CORNERS = np.array(
    [[-60, 0], [60, 0], [60, 30], [15, 30], [15, 120], [-15, 120], [-15, 30], [-60, 30]]
)
"""Outline of the T, in its frame, pixels."""
KEYPOINTS = CORNERS[[0, 1, 2, 7, 6, 3, 4, 5]]
"""Corners in the order of the package: first those of the bar, then those of the stem."""
PASSED = CORNERS[[0, 1, 2, 4, 5, 7]]
"""Corners that a path round the T passes: all except those between bar and stem."""
ASIDE = np.array([[-1, -1], [1, -1], [1, 1], [1, 1], [-1, 1], [-1, 1]])
"""Direction of the path's distance from each of these corners."""
MASS_CENTRE = np.array([0.0, 45.0])
"""Point about which the T rotates: in the package, bar and stem have the same mass."""
GYRATION = 3000.0
"""Moment of inertia of the T over its mass, pixels²; the package uses that of the bar twice."""
RADIUS = 15.0
"""Radius of the disc, pixels."""
TABLE = (20.0, 492.0)
"""Allowed range of the corners of the T: outside, the disc does not fit between T and wall."""
REACH = (5.0, 507.0)
"""Allowed range of commands to the disc; the package accepts 0 to 512."""
BEGINS = (100.0, 400.0)
"""Range of the T's initial position, before its rotation about `MASS_CENTRE`."""

SPACING, EDGE = 9.0, 5.0
"""Distance between neighbouring contact points, and between the outermost and the corner of the
T, pixels."""
STRIDES = np.r_[np.full(12, 1.0), np.full(12, 2.0), np.full(52, 3.0)]
"""Distances between poses at which a push may end, pixels: small near its start, for the last
pushes."""
GAP = 10.0
"""Distance between disc and T at which a push begins, pixels, so that the disc is steady at
contact."""
CLEARANCE = 12.0
"""Distance between disc and T on the path round it, pixels: the disc cuts corners by less."""
WIDENING = 0.5
"""Smallest growth of that distance per pixel by which the disc departs from a push, pixels."""
ROUNDING = 0.5
"""Tolerance of a distance, pixels: the disc penetrates the T slightly."""
BEND = 90.0
"""Approximate distance from the middle of the T at which the disc moves round it, pixels."""
WALK, PUSH = 20.0, 10.0
"""Pixels per action on the path and during a push. People usually move by 8, one in ten by more
than 21."""
STEADY, SETTLED = 4.0, 1.0
"""Distance between the disc and its command below which a push begins, and below which it has
ended, pixels."""
PAUSE = 9.0
"""Number of actions in which the disc comes to rest before and after a push."""
DEPTH, BEAM = 3, 48
"""Number of pushes planned ahead, one for each degree of freedom of the T, and number of
sequences kept."""
KINDS = 4
"""Number of ranges of lengths, each of which may keep its own sequence: divides `STRIDES`."""
NEAR = 1.2
"""Mean distance of corners from their goals that is certainly a success, pixels."""
PER_PIXEL, PER_HALVING = 2.0, 30.0
"""Predicted number of remaining actions for each pixel of that distance, and for each halving
of it. The values are too large on purpose: with smaller ones, no real push would seem worth its
time."""
MOVED = 2.0
"""Displacement of corners of the T before a push above which the expert plans again, pixels."""


def turned(points: Points, angles: Float[np.ndarray, "*N"]) -> Points:
    """Points (..., 2) rotated about the origin by angles (...), rad."""
    cos, sin = np.cos(angles), np.sin(angles)
    x, y = points[..., 0], points[..., 1]
    return np.stack([cos * x - sin * y, sin * x + cos * y], -1)


def corners(poses: Poses) -> Float[np.ndarray, "*N 8 2"]:
    """Outline of the T at poses (..., 3), pixels."""
    return turned(CORNERS, poses[..., None, 2]) + poses[..., None, :2]


WANTED = corners(GOAL)


def outward(local: Points, part: int) -> tuple[Float[np.ndarray, "*N"], Points]:
    """Distance of points (..., 2) from bar (0) or stem (1), and its gradient, in its frame."""
    from_centre = local - CENTRES[part]
    beyond = np.abs(from_centre) - HALVES[part]
    outside = np.maximum(beyond, 0)
    distance = np.linalg.norm(outside, axis=-1)
    within = beyond.max(-1)
    nearest = np.eye(2)[beyond.argmax(-1)]
    gradient = np.where(
        (distance > 0)[..., None], outside / np.maximum(distance, 1e-9)[..., None], nearest
    )
    return np.where(distance > 0, distance, within), gradient * np.where(from_centre < 0, -1, 1)


def clearance(points: Points, pose: Pose) -> Float[np.ndarray, "*N"]:
    """Distance between the T and points (..., 2), pixels; negative inside."""
    local = turned(points - pose[:2], np.asarray(-pose[2]))
    return np.minimum(outward(local, 0)[0], outward(local, 1)[0])


def yielded(poses: Poses, disc: Points) -> Poses:
    """Poses of the T after a disc at (..., 2) has displaced it from poses (..., 3)."""
    for part in (0, 1):
        local = turned(disc - poses[..., :2], -poses[..., 2])
        distance, normal = outward(local, part)
        arm = local - distance[..., None] * normal - MASS_CENTRE
        lever = arm[..., 0] * normal[..., 1] - arm[..., 1] * normal[..., 0]
        depth = np.maximum(RADIUS - distance, 0) / (1 + lever**2 / GYRATION)
        angle = poses[..., 2] - depth * lever / GYRATION
        centre = poses[..., :2] + turned(MASS_CENTRE, poses[..., 2])
        centre = centre - turned(depth[..., None] * normal, poses[..., 2])
        poses = np.concatenate([centre - turned(MASS_CENTRE, angle), angle[..., None]], -1)
    return poses


def _contacts() -> tuple[Float[np.ndarray, "K 2"], Float[np.ndarray, "K 2"]]:
    """Possible centres of a disc in contact with the T, and the normals there, in the T's
    frame.
    """
    discs, normals = [], []
    for a, b in pairwise([*CORNERS, CORNERS[0]]):
        length = float(np.linalg.norm(b - a))
        normal = np.array([b[1] - a[1], a[0] - b[0]]) / length
        count = max(int((length - 2 * EDGE) / SPACING) + 1, 2)
        for along in np.linspace(EDGE, length - EDGE, count):
            discs.append(a + (b - a) * along / length + RADIUS * normal)
            normals.append(normal)
    places, directions = np.array(discs), np.array(normals)
    gaps = np.array([outward(places, part)[0] for part in (0, 1)])
    free = gaps.max(0) > RADIUS + 2 * STEADY
    return places[free], directions[free]


PLACES, NORMALS = _contacts()


def pushed(poses: Float[np.ndarray, "B 3"]) -> tuple[Poses, Points, Points]:
    """Effects of all pushes at each of B poses of the T.

    Returns:
        Poses (B, K, L, 3) after each of L lengths of a push at each of K places, and the disc's
        initial centre (B, K, 2) and its direction (B, K, 2).
    """
    angles = poses[:, None, 2]
    first = turned(PLACES, angles) + poses[:, None, :2]
    direction = -turned(NORMALS, angles)
    now = np.broadcast_to(poses[:, None], (*first.shape[:2], 3))
    after = []
    for gone in STRIDES.cumsum():
        now = yielded(now, first + gone * direction)
        after.append(now)
    return np.stack(after, 2), first, direction


def way(start: Points, to: Points, pose: Poses) -> Float[np.ndarray, "*N"]:
    """Approximate length of the path between two points round the T, pixels."""
    middle = pose[..., :2] + turned(MASS_CENTRE, pose[..., 2])
    a, b = start - middle, to - middle
    far_a, far_b = (np.maximum(np.linalg.norm(x, axis=-1), 1.0) for x in (a, b))
    between = np.arccos(np.clip((a * b).sum(-1) / (far_a * far_b), -1.0, 1.0))
    arc = between * np.maximum(np.minimum(far_a, far_b), BEND)
    return np.maximum(np.linalg.norm(a - b, axis=-1), arc)


def to_go(poses: Poses) -> Float[np.ndarray, "*N"]:
    """Approximate number of remaining actions for poses (..., 3) of the T."""
    at = corners(poses)
    far = np.linalg.norm(at - WANTED, axis=-1).mean(-1)
    outside = np.maximum(np.maximum(TABLE[0] - at, at - TABLE[1]), 0).sum((-1, -2))
    halvings = np.log2(np.maximum(far / NEAR, 1.0))
    return PER_PIXEL * far + PER_HALVING * halvings + outside


@dataclass(frozen=True)
class Push:
    """A straight push: centres of the disc at first contact and at the end, pixels."""

    first: Point
    last: Point


def _allowed(points: Points) -> Bool[np.ndarray, "*N"]:
    """True where the disc may be commanded to points (..., 2)."""
    return np.all((points >= REACH[0]) & (points <= REACH[1]), axis=-1, keepdims=True)[..., 0]


def _various(total: Float[np.ndarray, "B K L"]) -> Int[np.ndarray, "W"]:
    """Indices of the cheapest pushes, best first; no two differ in length alone."""
    blocks = total.reshape(*total.shape[:2], KINDS, -1)
    length = blocks.argmin(-1)
    cheapest = np.take_along_axis(blocks, length[..., None], -1)[..., 0]
    order = cheapest.argsort(axis=None, kind="stable")[:BEAM]
    return order * blocks.shape[-1] + length.reshape(-1)[order]


def best_push(pose: Pose, disc: Point) -> Push:
    """First push of the sequence with the shortest predicted time, for this position of the
    disc.
    """
    poses, discs, spent = pose[None], disc[None], np.zeros(1)
    lengths = STRIDES.cumsum()
    begun: list[Push] = []
    options: list[tuple[float, Push]] = []
    for depth in range(DEPTH):
        after, first, direction = pushed(poses)
        last = first[:, :, None] + lengths[:, None] * direction[:, :, None]
        begin = first - GAP * direction
        walk = way(discs[:, None], begin, poses[:, None]) / WALK + GAP / PUSH + PAUSE
        cost = (spent[:, None] + walk)[..., None] + lengths / PUSH
        allowed = _allowed(begin)[..., None] & _allowed(last)
        total = np.where(allowed, cost + to_go(after), np.inf)
        order = _various(total)
        parents, places, _ = chosen = np.unravel_index(order, total.shape)
        poses, discs, spent = after[chosen], last[chosen], cost[chosen]
        if depth == 0:
            starts = first[parents, places]
            begun = [Push(*ends_of) for ends_of in zip(starts, discs, strict=True)]
        else:
            begun = [begun[parent] for parent in parents]
        options.append((float(total.flat[order[0]]), begun[0]))
    return min(options, key=lambda option: option[0])[1]


def _free(a: Point, b: Point, pose: Pose) -> bool:
    """True if the disc can move straight from a to b; at both ends it may be close to the T."""
    length = float(np.linalg.norm(b - a))
    along = np.linspace(0.0, 1.0, int(length / 3.0) + 2)
    gaps = clearance(a + along[:, None] * (b - a), pose) - RADIUS
    from_a = gaps[0] + WIDENING * along * length
    from_b = gaps[-1] + WIDENING * (1 - along) * length
    needed = np.minimum(CLEARANCE, np.minimum(from_a, from_b))
    return bool((gaps >= needed - ROUNDING).all())


def _aside(point: Point, pose: Pose) -> Point:
    """Approximately nearest place to a point at which the disc is clear of the T."""
    local = turned(point - pose[:2], -pose[2])
    for part in (0, 1):
        distance, gradient = outward(local, part)
        local = local + max(RADIUS + CLEARANCE + 1.0 - float(distance), 0.0) * gradient
    return turned(local, pose[2]) + pose[:2]


def route(a: Point, b: Point, pose: Pose) -> Float[np.ndarray, "N 2"]:
    """Turning points of the disc on its shortest path from a round the T to b, the last one.

    If there is no path, the result is b alone.
    """
    round_it = turned(PASSED + (RADIUS + CLEARANCE + 1.0) * ASIDE, pose[2]) + pose[:2]
    asides = [_aside(a, pose), _aside(b, pose)]
    points = np.array([a, b, *asides, *round_it[_allowed(round_it)]])
    far = np.linalg.norm(points[:, None] - points, axis=-1)
    free = np.array([[_free(p, q, pose) for q in points] for p in points])
    left = np.where(np.arange(len(points)) == 1, 0.0, np.inf)
    following = np.ones(len(points), dtype=int)
    for _ in points:
        total = np.where(free, far, np.inf) + left
        shorter = total.min(1) < left - 1e-6
        following[shorter] = total.argmin(1)[shorter]
        left = np.minimum(left, total.min(1))
    turns = [following[0]]
    while turns[-1] != 1:
        turns.append(following[turns[-1]])
    return points[turns]


def _stepped(start: Point, turns: Float[np.ndarray, "N 2"], stride: float) -> list[Point]:
    """Points from start (excluded) along the turning points to the last, at equal distances of
    at most `stride`.
    """
    line = np.vstack([start, turns])
    gone = np.r_[0.0, np.linalg.norm(np.diff(line, axis=0), axis=1).cumsum()]
    count = max(int(np.ceil(gone[-1] / stride - 1e-9)), 1)
    at = np.linspace(0.0, gone[-1], count + 1)[1:]
    return list(np.stack([np.interp(at, gone, line[:, k]) for k in (0, 1)], -1))


def pose_of(keypoints: Float[np.ndarray, "16"]) -> Pose:
    """Pose of the T with these corners."""
    seen, own = keypoints.reshape(8, 2) @ [1, 1j], KEYPOINTS @ [1, 1j]
    angle = np.angle(((seen - seen.mean()) * (own - own.mean()).conj()).sum())
    origin = seen.mean() - own.mean() * np.exp(1j * angle)
    return np.array([origin.real, origin.imag, angle])


class _Expert:
    """Commands the disc, one action after another."""

    def __init__(self) -> None:
        self.begin()

    def begin(self) -> None:
        """Begin an episode."""
        self._ahead: list[Point] = []
        self._push = 0  # The last observations, in this number.
        self._expected = np.full((8, 2), np.inf)
        self._sent = np.full(2, np.inf)

    def act(self, seen: Observation) -> Point:
        """Target of the disc, pixels, given all observations since the last call."""
        pose, disc = pose_of(seen[ENVIRONMENT_STATE]), seen[AGENT_POS]
        behind = np.linalg.norm(disc - self._sent)
        if len(self._ahead) >= self._push:
            shifted = np.linalg.norm(corners(pose) - self._expected, axis=-1).max() > MOVED
        else:
            shifted = not self._ahead and behind < SETTLED
        if shifted:
            self._think(pose, disc)
        waits = len(self._ahead) == self._push and behind >= STEADY
        if self._ahead and not waits:
            self._sent = self._ahead.pop(0)
        return self._sent

    def _think(self, pose: Pose, disc: Point) -> None:
        push = best_push(pose, disc)
        along = (push.last - push.first) / np.linalg.norm(push.last - push.first)
        begin = push.first - GAP * along
        pushing = _stepped(begin, push.last[None], PUSH)
        self._ahead = _stepped(disc, route(disc, begin, pose), WALK) + pushing
        self._push, self._expected = len(pushing), corners(pose)


class PushT:
    """The package's task, observed as the disc and, as the environment, corners of the T."""

    fps: float = 10.0
    n_actions: int = 2
    longest: int = 300
    """Number of actions after which the package and LeRobot end an episode; demonstrations take
    about 100."""
    moved_at: int | None = 10
    moved: float = 40.0
    """Distance by which the T is moved, pixels."""
    reward: float = 0.0
    """Reward of the package for the last action: covered fraction of the goal relative to 95 %,
    at most 1."""

    def __init__(self) -> None:
        import gym_pusht  # noqa: F401  # pyright: ignore[reportMissingImports]
        import gymnasium as gym

        kind = "environment_state_agent_pos"
        self._environment: Any = gym.make("gym_pusht/PushT-v0", obs_type=kind).unwrapped
        self.expert: Expert = _Expert()

    def begin(self, seed: int) -> Observation:
        """Begin with disc and T at the package's places for this seed."""
        return self._environment.reset(seed=seed)[0]

    def step(self, action: Point) -> tuple[Observation, bool]:
        """Observation after an action, and True if 95 % of the goal is covered."""
        act = np.asarray(action, dtype=float)
        seen, self.reward, _, _, info = self._environment.step(act)
        return seen, bool(info["is_success"])

    def move_object(self, rng: np.random.Generator) -> Observation:
        """Move the T to an allowed initial place, clear of the disc.

        Raises:
            RuntimeError: There is no such place.
        """
        environment, block = self._environment, self._environment.block
        disc, now = np.array(environment.agent.position), np.array(block.position)
        for angle in rng.permutation(np.linspace(-np.pi, np.pi, 72, endpoint=False)):
            place = now + self.moved * np.array([np.cos(angle), np.sin(angle)])
            pose = np.array([*place, block.angle])
            drawn = place + turned(MASS_CENTRE, block.angle) - MASS_CENTRE
            allowed = ((drawn >= BEGINS[0]) & (drawn <= BEGINS[1])).all()
            if allowed and clearance(disc, pose) > RADIUS:
                block.position = tuple(place)
                environment.space.reindex_shapes_for_body(block)
                return environment.get_obs()
        raise RuntimeError(f"No place for the T {self.moved:g} pixels away.")

    def render(self) -> Any:
        """Image of disc, T and goal, (H, W, 3), 8 bits."""
        return self._environment.render()
