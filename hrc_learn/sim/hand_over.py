"""Handover: a worker lays an object on the bench, picks it up, and holds it out to the robot.

A controller that tracks the hand has to distinguish these movements: only the third one is an
offer. Once the gripper has reached the offered object, the worker moves it into the gripper.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from hrc_learn.geometry import Box
from hrc_learn.sim.worker import Worker
from hrc_learn.sim.worker_visit import (
    BenchScript,
    HumanSpeeds,
    PoseWriter,
    WorkerPose,
    WorkerVisit,
    direction,
    in_worker_frame,
    nearest_turn,
)

RIGHT = 1
"""Number of the hand that holds the object (0 left, 1 right)."""
HELD_OUT = np.array([0.0, -0.09, -0.03])
"""Offset from the grip of the hand to the middle of an object held by its near end, in the base
frame [m]; the worker faces -y. The offset is large because the hand's capsule is thicker than
fingers.
"""
BENCH, BACK, HAND_OVER = "to the bench", "back", "hand over"
"""Kinds of hand movements."""

UNHURRIED = HumanSpeeds(reaching=0.9)
"""Speeds during handovers: hands move at about half their largest speed, so that a handover
takes about a second.
"""

# Distance from the bench's edge (`_OVER_BENCH`) and height above the bench at which the object
# is held out [m]: a forearm's length over the bench, at the height of the elbow.
_OVER_BENCH, _HEIGHT = (0.26, 0.42), (0.24, 0.36)
# `_ASIDE`: range of the object's x relative to the worker, with -x to the worker's right [m].
# `_WITHIN`: range of the object's x that the robot reaches well [m].
_ASIDE, _WITHIN = (-0.22, 0.04), (0.08, 0.42)
# `_LEANS`: largest lean of the trunk while the worker holds an object out [rad].
# `_TRIED`: number of places tried until one is within the worker's reach.
_LEANS, _TRIED = 0.45, 200
# Speed of the final approach to the gripper, as a fraction of the speed of other movements.
_CAREFUL = 0.3


class Reach(NamedTuple):
    """A movement of the hand from rest to rest."""

    kind: str
    begin: float
    """Start of the movement [s]."""
    end: float
    """End of the movement [s]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class HandOver:
    """The planned part of a handover; the rest depends on the robot."""

    visit: WorkerVisit
    """Postures up to the one in which the worker holds the object out."""
    reaches: tuple[Reach, ...]
    carried: tuple[tuple[float, float], ...]
    """Intervals in which the hand holds the object [s]; between them it lies on the bench."""
    place: Float[np.ndarray, "3"]
    """Middle of the object where it is held out [m]."""
    leaving: Float[np.ndarray, "2"]
    """Final position of the worker [m]."""
    speeds: HumanSpeeds
    """Speeds of the worker."""

    def starting(self, time: float) -> HandOver:
        """The same handover, delayed by a time [s]."""
        visit = replace(self.visit, time=self.visit.time + time)
        return replace(
            self,
            visit=visit,
            reaches=tuple(Reach(r.kind, r.begin + time, r.end + time) for r in self.reaches),
            carried=tuple((begin + time, end + time) for begin, end in self.carried),
        )

    def object_position(self, time: float) -> Float[np.ndarray, "3"]:
        """Middle of the object, in the hand or laid down [m]."""
        latest = [span for span in self.carried if span[0] <= time]
        first, last = latest[-1] if latest else self.carried[0]
        ends = self.visit.ends_at(min(max(time, first), last))
        return self.visit.worker.grip(ends, RIGHT) + HELD_OUT

    def brought_to(self, place: Float[np.ndarray, "3"], now: float) -> HandOver:
        """Handover continued at time `now` [s]: the worker moves the object to a place [m], or
        as near to this place as the worker reaches.
        """
        visit, last = self.visit, self._last()
        target = in_worker_frame(visit.worker, last.place, last.heading, place - HELD_OUT)
        lean = visit.worker.lean_to(target, RIGHT)
        slow = replace(self.speeds, reaching=_CAREFUL * self.speeds.reaching)
        script = PoseWriter(last, now, slow, visit.worker.config.stature)
        hands = last.hands.copy()
        hands[RIGHT] = target
        script.go(hands=hands, lean=_LEANS if lean is None else lean)
        return self._continued(script)

    def left(self, now: float) -> HandOver:
        """Handover ended at time `now` [s]: the worker releases the object and walks away."""
        visit, last = self.visit, self._last()
        worker = visit.worker
        script = PoseWriter(last, now, self.speeds, worker.config.stature)
        script.go(hands=worker.hanging_hands(), lean=0.0)
        outwards = direction(self.leaving - last.place)
        script.go(heading=nearest_turn(outwards, last.heading))
        script.go(place=self.leaving)
        carried = (*self.carried[:-1], (self.carried[-1][0], now))
        return replace(self._continued(script), carried=carried)

    def _last(self) -> WorkerPose:
        row = self.visit.poses[-1]
        return WorkerPose(row[:2], float(row[2]), float(row[3]), row[4:].reshape(2, 3))

    def _continued(self, script: PoseWriter) -> HandOver:
        """The same handover, continued by the poses of a script."""
        visit = self.visit
        longer = replace(
            visit,
            time=np.concatenate([visit.time, script.times]),
            poses=np.concatenate([visit.poses, script.rows]),
        )
        return replace(self, visit=longer)


def random_hand_over(
    worker: Worker, rng: np.random.Generator, *, bench: Box, thickness: float
) -> HandOver:
    """Draw a handover: a worker walks to the bench's far side with an object for the robot.

    Args:
        worker: Body of the worker.
        rng: Random generator.
        bench: The table, whose far side (+y) is free.
        thickness: Half the height of the object [m].

    Raises:
        ValueError: The worker is too small to hold an object out over the bench.
    """
    pace = UNHURRIED.drawn(rng)
    script = BenchScript(worker, rng, bench, (0.15, 0.45), sway=0.1)
    place, target, lean = _held_out(worker, rng, script)
    script.enter(rng.uniform(1.0, 3.0), pace, RIGHT)
    # The object is laid down near the edge of the bench, to the worker's right.
    x, y = script.stand[0] + rng.uniform(-0.25, 0.0), script.edge - rng.uniform(0.10, 0.16)
    laid_at = script.own(np.array([x, y, script.top + thickness]) - HELD_OUT)
    reaches: list[Reach] = []

    def note(kind: str) -> None:
        """Record the last movement of the script."""
        reaches.append(Reach(kind, script.times[-2], script.times[-1]))

    script.go(heading=script.facing, hands=script.ready)
    note(BACK)
    handled: list[float] = []
    for _ in range(2):  # lay the object down, then pick it up
        script.wait(rng.uniform(0.6, 1.5))
        script.reach(laid_at, RIGHT)
        note(BENCH)
        script.wait(rng.uniform(0.2, 0.5))
        handled.append(script.times[-1])
        script.go(hands=script.ready, lean=0.05)
        note(BACK)
    script.wait(rng.uniform(0.6, 1.5))
    script.go(hands=script.hands(target, RIGHT), lean=lean)
    note(HAND_OVER)
    return HandOver(
        visit=script.visit(RIGHT),
        reaches=tuple(reaches),
        carried=((-np.inf, handled[0]), (handled[1], np.inf)),
        place=place,
        leaving=script.leaving,
        speeds=pace,
    )


def _held_out(
    worker: Worker, rng: np.random.Generator, script: BenchScript
) -> tuple[np.ndarray, np.ndarray, float]:
    """Position of the offered object, hand position in the worker's frame, and lean of the
    trunk.
    """
    for _ in range(_TRIED):
        place = np.array(
            [
                np.clip(script.stand[0] + rng.uniform(*_ASIDE), *_WITHIN),
                script.edge - rng.uniform(*_OVER_BENCH),
                script.top + rng.uniform(*_HEIGHT),
            ]
        )
        target = script.own(place - HELD_OUT)
        lean = worker.lean_to(target, RIGHT)
        if lean is not None and lean <= _LEANS:
            return place, target, lean
    raise ValueError(
        f"a worker of {worker.config.stature:.2f} m cannot hold anything out over the bench"
    )
