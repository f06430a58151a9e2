"""A worker's visit to the table (the paper's Experiment 3), as a function of time.

The worker walks in, puts an object on the bench, reaches for markers that lie under the arm,
and walks away, without regard for the robot.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from hrc_learn.geometry import Box
from hrc_learn.sim.worker import WORKER_ITEM_HALF_SIZE, Posture, Worker

# Half the step of central differences for velocities [s]; the velocities err by 0.1 mm/s at
# most.
_HALF_STEP = 1e-4
# Length of a walking step, as a fraction of the stature; two steps make a stride.
STEP = 0.40
HAND_OVER_BENCH = 2 * WORKER_ITEM_HALF_SIZE[2]
"""Height above the bench of a hand that puts down or picks up an object [m]."""
# Range of the distance of markers from the arm's working point, to either side [m].
_BESIDE_GRIPPER = (0.11, 0.22)
# Number of places tried for a marker: near an arm, only one in ten may be within reach.
_MARKERS_TRIED = 200
# Peak speed of a minimum-jerk motion relative to its mean speed.
_PEAK = 1.875
# Distance of the head of a leaning person from the hip, as a fraction of the stature.
_HEAD_FROM_HIP = 0.47


@dataclass(frozen=True, kw_only=True)
class HumanSpeeds:
    """Largest speeds of a worker; walking and reaching are the approach speeds of ISO 13855."""

    walking: float = 1.6
    """Walking speed [m/s]."""
    reaching: float = 2.0
    """Speed of a hand [m/s]."""
    turning: float = 2.5
    """Turning speed about the vertical [rad/s]."""

    def drawn(self, rng: np.random.Generator) -> HumanSpeeds:
        """Speeds of one visit: 50 to 95 % of these largest speeds."""
        # The margin is for the body, which sways up and down, and for elbows, which may be
        # faster than hands.
        return HumanSpeeds(
            walking=rng.uniform(0.6, 0.9) * self.walking,
            reaching=rng.uniform(0.5, 0.85) * self.reaching,
            turning=rng.uniform(0.6, 0.95) * self.turning,
        )


class WorkerPose(NamedTuple):
    """Posture at one end of a movement."""

    place: np.ndarray
    heading: float
    lean: float
    hands: np.ndarray

    def row(self) -> np.ndarray:
        return np.concatenate([self.place, [self.heading, self.lean], self.hands.ravel()])


class WorkerCapsules(NamedTuple):
    """A worker's body at any number of times."""

    ends: Float[np.ndarray, "*time parts 2 3"]
    """Ends of the axes of the capsules, in the base frame [m]."""
    radius: Float[np.ndarray, " parts"]
    """Radii of the capsules [m]."""
    velocity: Float[np.ndarray, "*time parts 2 3"]
    """Velocities of the ends [m/s]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class WorkerVisit:
    """A worker's visit: key postures, joined by minimum-jerk motions."""

    worker: Worker
    """Body of the worker."""
    time: Float[np.ndarray, " poses"]
    """Times of the key postures [s]; the worker rests before the first and after the last."""
    poses: Float[np.ndarray, "poses 10"]
    """Place [m], heading and lean [rad], and both hands in the worker's frame [m]."""
    step: float
    """Step length [m]."""
    side: int
    """Hand that carries the object for the bench: 0 left, 1 right."""
    released: float
    """Time at which the object is put down [s]."""
    markers: Float[np.ndarray, "markers 3"]
    """Points that the worker reaches for [m]."""
    reaches: Float[np.ndarray, "markers 2"]
    """Interval in which a hand is at each marker [s]."""

    @property
    def begin(self) -> float:
        """Time at which the worker enters [s]."""
        return float(self.time[0])

    @property
    def end(self) -> float:
        """Time at which the worker has left [s]."""
        return float(self.time[-1])

    @cached_property
    def _movements(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Change from each pose to the next, distance walked [m], and number of steps."""
        change = np.diff(self.poses, axis=0)
        length = np.linalg.norm(change[:, :2], axis=-1)
        return change, length, np.maximum(np.round(length / self.step), 1.0)

    def turned(self, angle: float) -> WorkerVisit:
        """The same visit, turned by an angle about the vertical through the base [rad]."""
        poses = turned_about_base(self.poses, angle)
        poses[:, 2] += angle
        return replace(self, poses=poses, markers=turned_about_base(self.markers, angle))

    def posture(self, time: Float[np.ndarray, "*time"]) -> Posture:
        """Postures and places at given times [s]."""
        change, length, steps = self._movements
        k = np.searchsorted(self.time, time, side="right") - 1
        k = np.minimum(np.maximum(k, 0), len(change) - 1)
        u = (time - self.time[k]) / (self.time[k + 1] - self.time[k])
        u = np.minimum(np.maximum(u, 0.0), 1.0)
        progress = u**3 * (10 - 15 * u + 6 * u**2)
        change, length, steps = change[k], length[k], steps[k]
        row = self.poses[k] + progress[..., None] * change
        # Steps grow and shrink with the speed.
        vigour = 16 * u**2 * (1 - u) ** 2
        phase = np.pi * steps * progress
        walks = vigour * np.minimum(length / self.step, 1.0)
        turns = vigour * np.minimum(np.abs(change[..., 2]), 1.0)
        stride = walks * self.step / 2 * np.sin(phase)
        hands = row[..., 4:].reshape(*row.shape[:-1], 2, 3).copy()
        # Arms swing opposite to the legs, but only a little: a hand may carry an object.
        hands[..., 0, 0] -= 0.15 * stride
        hands[..., 1, 0] += 0.15 * stride
        return Posture(
            place=row[..., :2],
            heading=np.asarray(row[..., 2]),
            lean=np.asarray(row[..., 3]),
            stride=np.asarray(stride),
            # Squared, so that a knee does not jump when it begins to bend.
            swing=np.asarray(np.maximum(walks, turns) * np.cos(phase) * np.abs(np.cos(phase))),
            hands=hands,
        )

    def ends_at(
        self, time: float | Float[np.ndarray, "*time"]
    ) -> Float[np.ndarray, "*time parts 2 3"]:
        """Ends of the axes of the capsules in the base frame [m].

        Args:
            time: One or several times [s].
        """
        return self.worker.ends(self.posture(np.asarray(time, dtype=float)))

    def capsules_at(self, time: float | Float[np.ndarray, "*time"]) -> WorkerCapsules:
        """Positions and velocities of the whole body.

        Args:
            time: One or several times [s].
        """
        at = np.asarray(time, dtype=float)
        around = at[..., None] + np.array([-_HALF_STEP, 0.0, _HALF_STEP])
        ends = self.ends_at(around)
        before, now, after = np.moveaxis(ends, at.ndim, 0)
        velocity = (after - before) / (2 * _HALF_STEP)
        return WorkerCapsules(now, self.worker.radius, velocity)

    def item_at(
        self, time: float, ends: Float[np.ndarray, "parts 2 3"] | None = None
    ) -> Float[np.ndarray, "3"]:
        """Position of the object for the bench: in the hand, then where it was put down [m].

        Args:
            time: Time [s].
            ends: `ends_at` that time, if known.
        """
        if time >= self.released:
            return self._left_there
        return self._in_hand(self.ends_at(time) if ends is None else ends)

    @cached_property
    def _left_there(self) -> np.ndarray:
        """Position where the object is put down [m]."""
        return self._in_hand(self.ends_at(self.released))

    def _in_hand(self, ends: np.ndarray) -> np.ndarray:
        """Position of the object in the hand [m]."""
        return self.worker.grip(ends, self.side) - np.array([0, 0, WORKER_ITEM_HALF_SIZE[2]])


def turned_about_base(
    points: Float[np.ndarray, "*points columns"], angle: float
) -> Float[np.ndarray, "*points columns"]:
    """Points, with x and y in the first two columns [m], turned by an angle about the base's
    vertical axis [rad].
    """
    c, s = np.cos(angle), np.sin(angle)
    turned = points.copy()
    turned[..., :2] = points[..., :2] @ np.array([[c, s], [-s, c]])
    return turned


class PoseWriter:
    """Appends postures, each as early as the worker's speeds allow."""

    def __init__(self, start: WorkerPose, begin: float, speeds: HumanSpeeds, stature: float):
        self.now, self._speeds, self._stature = start, speeds, stature
        self.times, self.rows = [begin], [start.row()]

    def wait(self, duration: float) -> None:
        self._add(self.now, duration)

    def go(self, **changes) -> None:
        """Change parts of the pose as fast as all speed limits allow."""
        following = self.now._replace(**changes)
        limits = self._speeds
        walked = np.linalg.norm(following.place - self.now.place) / limits.walking
        leaned = abs(following.lean - self.now.lean) * _HEAD_FROM_HIP * self._stature
        turned = abs(following.heading - self.now.heading) / limits.turning
        moved = np.linalg.norm(following.hands - self.now.hands, axis=-1).max()
        fastest = max(walked, leaned / limits.walking, turned, moved / limits.reaching)
        self._add(following, max(_PEAK * float(fastest), 0.3))

    def _add(self, following: WorkerPose, duration: float) -> None:
        self.times.append(self.times[-1] + duration)
        self.rows.append(following.row())
        self.now = following


class BenchScript(PoseWriter):
    """Script of a visit to the far side of a bench, from the entrance on.

    Attributes:
        top: Height of the bench [m].
        edge: y of the bench's far edge [m].
        ready: Hands over the edge of the bench, in the worker's frame [m].
        leaving: Final position of the worker [m].
    """

    def __init__(
        self,
        worker: Worker,
        rng: np.random.Generator,
        bench: Box,
        across: tuple[float, float],
        sway: float,
    ):
        """Draw the places to stand, to enter and to leave; `enter` begins the script.

        Args:
            worker: Body of the worker.
            rng: Random generator.
            bench: The table, whose far side (+y) is free.
            across: Least and greatest x of the place to stand [m].
            sway: Largest angle between the worker's heading at the bench and the normal of the
                bench's edge [rad].
        """
        self._worker, h = worker, worker.config.stature
        self.top = bench.centre[2] + bench.half_size[2]
        self.edge = bench.centre[1] + bench.half_size[1]
        # Distance at which the body is clear of the bench.
        y = self.edge + 0.1 * h
        self.stand = np.array([rng.uniform(*across), y + rng.uniform(0, 0.05)])
        self.facing = -np.pi / 2 + rng.uniform(-sway, sway)
        self._entrance, self.leaving = (
            np.array([rng.uniform(-1.0, 1.4), self.edge + rng.uniform(1.2, 1.5)])
            for _ in range(2)
        )
        above = self.top + 0.12 - worker.config.floor
        self.ready = np.array([[0.16 * h, s * 0.13 * h, above] for s in (1, -1)])

    def enter(self, begin: float, speeds: HumanSpeeds, side: int) -> None:
        """Begin the script: walk to the bench with an object in one hand.

        Args:
            begin: Time at which the worker begins to walk [s].
            speeds: Speeds of the worker.
            side: Hand with the object: 0 left, 1 right.
        """
        h, hands = self._worker.config.stature, self._worker.hanging_hands()
        hands[side] = [0.20 * h, (0.05, -0.05)[side] * h, 0.63 * h]
        heading = nearest_turn(direction(self.stand - self._entrance), self.facing)
        super().__init__(WorkerPose(self._entrance, heading, 0.0, hands), begin, speeds, h)
        self.go(place=self.stand)

    def own(self, point: np.ndarray) -> np.ndarray:
        """Convert a point from the base frame to the frame of the worker at the bench [m]."""
        return in_worker_frame(self._worker, self.stand, self.facing, point)

    def hands(self, target: np.ndarray, side: int) -> np.ndarray:
        """Positions of both hands, one of them at a point, in the worker's frame [m]."""
        hands = self.ready.copy()
        hands[side] = target
        return hands

    def reach(self, target: np.ndarray, side: int) -> None:
        """Move a hand to a point within reach, in the worker's frame [m]."""
        lean = self._worker.lean_to(target, side)
        assert lean is not None  # places are drawn within reach
        self.go(hands=self.hands(target, side), lean=lean)

    def reaching(self, target: np.ndarray, side: int, lean: float) -> np.ndarray:
        """Ends of the capsules in four postures on the way of a hand to a point [m]."""
        way = np.linspace(0.4, 1.0, 4)[:, None, None]
        posture = Posture(
            place=np.repeat(self.stand[None], len(way), axis=0),
            heading=np.full(len(way), self.facing),
            lean=way[:, 0, 0] * lean,
            stride=np.zeros(len(way)),
            swing=np.zeros(len(way)),
            hands=self.ready + way * (self.hands(target, side) - self.ready),
        )
        return self._worker.ends(posture)

    def leave(self) -> None:
        """Let the arms hang and walk away."""
        self.go(hands=self._worker.hanging_hands(), lean=0.0)
        self.go(heading=nearest_turn(direction(self.leaving - self.stand), self.facing))
        self.go(place=self.leaving)

    def visit(
        self,
        side: int,
        released: float = np.inf,
        markers: list[np.ndarray] | None = None,
        reaches: list[list[float]] | None = None,
    ) -> WorkerVisit:
        """Visit with the postures written so far."""
        return WorkerVisit(
            worker=self._worker,
            time=np.array(self.times),
            poses=np.array(self.rows),
            step=STEP * self._worker.config.stature,
            side=side,
            released=released,
            markers=np.array(markers or np.empty((0, 3))),
            reaches=np.array(reaches or np.empty((0, 2))),
        )


def random_visit(
    worker: Worker,
    rng: np.random.Generator,
    *,
    bench: Box,
    under: tuple[float, float],
    begin: tuple[float, float] = (1.0, 8.0),
    reaches: tuple[int, int] = (2, 4),
    is_clear: Callable[[Float[np.ndarray, "*time parts 2 3"]], bool] = lambda ends: True,
) -> WorkerVisit:
    """Draw a visit to the side of the bench opposite the robot.

    Args:
        worker: Body of the worker.
        rng: Random generator.
        bench: The table, whose far side (+y) is free.
        under: Point below the arm's task, x and y [m]: markers lie around it.
        begin: Earliest and latest time of entering [s].
        reaches: Smallest and largest number of markers to reach for.
        is_clear: Returns True if the body touches nothing at the bench in any of the given
            postures. The worker reaches only for points for which this is so.

    Raises:
        ValueError: No marker under the arm is within reach.
    """
    pace = HumanSpeeds().drawn(rng)
    side = int(rng.uniform() < 0.8)  # most people are right-handed
    # The worker stands near the point under the arm, to either side of it.
    script = BenchScript(worker, rng, bench, (under[0] - 0.18, under[0] + 0.18), sway=0.15)
    script.enter(rng.uniform(*begin), pace, side)
    script.go(heading=script.facing)
    # The object is put down near the edge of the bench, away from the point under the arm.
    x, y = script.stand[0] + rng.uniform(-0.2, 0.2), script.edge - rng.uniform(0.10, 0.16)
    spot = np.array([x, y, script.top + HAND_OVER_BENCH])
    script.reach(script.own(spot + np.array([0.0, 0.0, 0.12])), side)
    script.reach(script.own(spot), side)
    script.wait(rng.uniform(0.2, 0.5))
    released = script.times[-1]
    script.go(hands=script.ready, lean=0.05)
    markers, spans = [], []
    for _ in range(rng.integers(reaches[0], reaches[1] + 1)):
        markers.append(_marker(worker, rng, script, under, is_clear))
        target = script.own(markers[-1])
        script.reach(target, _hand_for(target))
        script.wait(rng.uniform(0.3, 1.2))
        spans.append(script.times[-2:])
        script.go(hands=script.ready, lean=rng.uniform(0.0, 0.15))
    script.leave()
    return script.visit(side, released, markers, spans)


def _hand_for(target: np.ndarray) -> int:
    """Hand on the same side as the point to reach: 0 left, 1 right."""
    return int(target[1] < 0)


def _marker(
    worker: Worker,
    rng: np.random.Generator,
    script: BenchScript,
    under: tuple[float, float],
    is_clear: Callable[[np.ndarray], bool],
) -> np.ndarray:
    """A reachable point around the arm's working point, low over the bench [m]."""
    middle = np.array([*under, script.top])
    for _ in range(_MARKERS_TRIED):
        # A hand cannot reach through the gripper that hovers there, but to either side of it.
        x = rng.choice([-1, 1]) * rng.uniform(*_BESIDE_GRIPPER)
        point = middle + np.array([x, rng.uniform(-0.10, 0.12), HAND_OVER_BENCH])
        target = script.own(point)
        which = _hand_for(target)
        lean = worker.lean_to(target, which)
        if lean is not None and is_clear(script.reaching(target, which, lean)):
            return point
    raise ValueError(
        f"a worker of {worker.config.stature:.2f} m cannot reach under the arm at "
        f"({under[0]:g}, {under[1]:g}) m over the bench: choose a nearer point."
    )


def in_worker_frame(
    worker: Worker, stand: Float[np.ndarray, "2"], facing: float, point: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "3"]:
    """Convert a point from the base frame to the frame of a standing worker [m]."""
    c, s = np.cos(facing), np.sin(facing)
    x, y = point[:2] - stand
    return np.array([c * x + s * y, c * y - s * x, point[2] - worker.config.floor])


def direction(vector: np.ndarray) -> float:
    return float(np.arctan2(vector[1], vector[0]))


def nearest_turn(angle: float, other: float) -> float:
    """The same direction as an angle within half a turn of another angle [rad]."""
    return other + (angle - other + np.pi) % (2 * np.pi) - np.pi
