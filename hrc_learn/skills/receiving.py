"""Taking a thing from a person's hand, who is not asked for it: the motion of the hand tells.

A tracker sees the person. Each movement of the hand from rest is compared with those that were
shown (`InteractionPrimitive`): as soon as it is most likely a hand-over, the end effector goes
to where the robot's hand was then, the slower the less sure that place is, and as near to the
person as the safety filter lets it. There it waits for the thing, and closes.
"""

from collections import deque
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.dmp import InteractionEstimate, InteractionPrimitive
from hrc_learn.geometry import Pose
from hrc_learn.protocols import PersonObservation, PersonTracker
from hrc_learn.skills.failures import MissedGraspError
from hrc_learn.skills.grasping import (
    CLOSED,
    CLOSING_TIME,
    OPEN,
    as_load,
    holds,
    move_fingers,
)
from hrc_learn.skills.work_cell import WorkCell
from hrc_learn.skills.workplace import GraspObject

HAND_OVER = "hand over"
"""Name of the kind of movement to answer."""

# Parts of a tracked body that are looked at, as `sim.worker.PARTS` names them.
_BODY, _HAND = "pelvis", "hand_right"


@dataclass(frozen=True, kw_only=True)
class ReceivingConfig:
    """How hand-overs are recognised and answered."""

    window: float = 0.3
    """Over which a hand is compared with itself [s]: nine images."""
    set_off: float = 0.06
    """Way of a hand within it that is a movement, and of a body that stands [m]: four times
    what a tracker with 1 cm of noise sees of one at rest."""
    noise: float = 0.012
    """Of each coordinate of the hand [m]: that of the tracker, and what people vary."""
    sure: float = 0.95
    """Probability from which on the robot goes."""
    speed: float = 0.5
    """Of the end effector towards a place that is sure [m/s]."""
    acceleration: float = 1.0
    """[m/s^2]"""
    tolerance: float = 0.06
    """Standard deviation of the predicted place at which it goes at half of that [m]."""
    near: float = 0.09
    """How far the hand may be from where it was shown beside the robot's to be there [m]."""
    still: float = 0.5
    """For which it has to be there before the fingers close [s]."""
    attempts: int = 3
    """How often they close on nothing."""
    patience: float = 30.0
    """For which the robot waits altogether [s]."""


@dataclass(kw_only=True)
class Receipt:
    """What came of a hand-over; times are NaN until then."""

    set_off: float = np.nan
    """When the hand set off to hand over, as it was seen [s]."""
    recognised: float = np.nan
    """When the robot was sure [s]."""
    seen: float = np.nan
    """Time of the newest image then [s]."""
    phase: float = np.nan
    """How much of the movement had passed in that image, as estimated, 0 to 1."""
    duration: float = np.nan
    """Of the movement, as estimated then [s]."""
    probability: float = np.nan
    """Of a hand-over then."""
    predicted: Float[np.ndarray, "3"] | None = None
    """Where the robot's hand was to be, as predicted then [m]."""
    refined: Float[np.ndarray, "3"] | None = None
    """The same when the movement was over [m]."""
    taken: float = np.nan
    """When the fingers held the thing [s]."""
    place: Float[np.ndarray, "3"] | None = None
    """Of the end effector then [m]."""
    attempts: int = 0
    """How often the fingers closed."""
    passed_over: int = 0
    """Other movements that were seen before."""


class MovementWatch:
    """Cuts what a tracker sees of a hand into movements of a person who stands."""

    def __init__(self, config: ReceivingConfig, body: int, hand: int):
        """Begin.

        Args:
            config: What a movement is.
            body: Number of the pelvis in a tracked body.
            hand: Of the hand.
        """
        self._config, self._body, self._hand = config, body, hand
        self._latest: deque[PersonObservation] = deque()
        self.times: list[float] = []
        """Of the images of the present movement [s]; empty: the hand rests."""
        self.hand: list[Float[np.ndarray, "3"]] = []
        """Where it was in them, middle of the capsule's axis [m]."""

    def see(self, seen: PersonObservation) -> bool:
        """Take an image in; whether it belongs to a movement."""
        recent, config = self._latest, self._config
        recent.append(seen)
        while recent[-1].time - recent[0].time > config.window + 1e-6:
            recent.popleft()
        if len(recent) < 4:  # too few for two means
            return bool(self.times)
        stands = self._moved(self._body) < config.set_off
        moves = self._moved(self._hand) > config.set_off
        if not stands or not moves:
            # At rest again, or walking: whatever comes next is another movement.
            self.times, self.hand = [], []
            return False
        if not self.times:
            self.times = [one.time for one in recent]
            self.hand = [self.place(one) for one in recent]
        else:
            self.times.append(seen.time)
            self.hand.append(self.place(seen))
        return True

    def place(self, seen: PersonObservation) -> Float[np.ndarray, "3"]:
        """Of the hand [m]."""
        return seen.ends[self._hand].mean(axis=0)

    def _moved(self, part: int) -> float:
        """Between the older and the newer half of the window, twice the way of their means."""
        places = np.stack([one.ends[part].mean(axis=0) for one in self._latest])
        half = len(places) // 2
        return 2 * float(np.linalg.norm(places[-half:].mean(0) - places[:half].mean(0)))


class Receiving:
    """Waits for a hand-over and takes the thing."""

    def __init__(
        self,
        cell: WorkCell,
        tracker: PersonTracker,
        model: InteractionPrimitive,
        parts: tuple[str, ...],
        wait: Pose,
        config: ReceivingConfig | None = None,
    ):
        """Prepare.

        Args:
            cell: Arm and gripper.
            tracker: Sees the person.
            model: Of the hand and the end effector, positions in the base frame [m].
            parts: Names of the capsules of a tracked body.
            wait: Of the end effector, where it waits.
            config: How hand-overs are recognised.
        """
        self._cell, self._tracker, self._model = cell, tracker, model
        self._config = config or ReceivingConfig()
        self._watch = MovementWatch(self._config, parts.index(_BODY), parts.index(_HAND))
        self._newest: PersonObservation | None = None
        self.wait = wait
        self.receipt = Receipt()

    def receive(self, item: GraspObject) -> Receipt:
        """Wait where the arm is, go and meet the person's hand, and take what is in it.

        Raises:
            MissedGraspError: Nobody handed anything over, or the fingers closed on nothing.
        """
        deadline = self._cell.time + self._config.patience
        self._cell.gripper.move(OPEN)
        estimate = self._recognise(deadline)
        beside = self._meet(estimate, deadline)
        while self.receipt.attempts < self._config.attempts:
            self._await_hand(beside, deadline)
            self.receipt.attempts += 1
            move_fingers(self._cell, CLOSED, CLOSING_TIME)
            if holds(self._cell, item):
                self.receipt.taken = self._cell.time
                self.receipt.place = self._cell.pose.position.numpy().copy()
                self._cell.load = as_load(item)
                return self.receipt
            move_fingers(self._cell, OPEN, CLOSING_TIME)
        raise MissedGraspError("receive: the fingers closed on nothing in the person's hand.")

    def _recognise(self, deadline: float) -> InteractionEstimate:
        """Hold still until a movement is most likely a hand-over."""
        sure, wait = 0, self._cell.pose
        still = torch.zeros(6, dtype=torch.float64)
        other = False
        while self._cell.time < deadline:
            self._cell.track_pose(wait, still)
            if not self._look():
                continue
            if not self._watch.times:
                self.receipt.passed_over += other
                sure, other = 0, False
                continue
            estimate = self._estimate()
            k = self._model.kinds.index(HAND_OVER)
            # Twice in a row: one image may be far off.
            sure = sure + 1 if estimate.probability[k] > self._config.sure else 0
            other = sure == 0
            if sure == 2:
                self._note(estimate, float(estimate.probability[k]))
                return estimate
        raise MissedGraspError("receive: nobody handed anything over.")

    def _note(self, estimate: InteractionEstimate, probability: float) -> None:
        receipt, seen = self.receipt, self._watch.times[-1]
        receipt.recognised, receipt.set_off = self._cell.time, self._watch.times[0]
        receipt.seen, receipt.probability = seen, probability
        receipt.phase, receipt.duration = estimate.phase, estimate.duration
        receipt.predicted = receipt.refined = _end(estimate)[0].numpy().copy()

    def _meet(self, estimate: InteractionEstimate, deadline: float) -> Float[np.ndarray, "3"]:
        """Go to where the hands met when it was shown; where the person's was beside."""
        cell, config, receipt = self._cell, self._config, self.receipt
        start, dt = cell.pose, cell.config.dt
        at, velocity = start.position.clone(), torch.zeros(3, dtype=torch.float64)
        moving, recent = True, deque([(cell.time, start.position)])
        while cell.time < deadline:
            moving = moving and cell.time - receipt.seen < 2 * estimate.duration
            if self._look() and moving:
                if self._watch.times and self._watch.times[0] == receipt.set_off:
                    estimate = self._estimate()
                    receipt.refined = _end(estimate)[0].numpy().copy()
                else:
                    moving = False  # the hand has come to rest
            goal, deviation = _end(estimate)
            share = config.tolerance**2 / (config.tolerance**2 + deviation.square().max())
            velocity = _eased(at, velocity, goal, float(share) * config.speed, config, dt)
            # Not ahead of an arm that people slow down.
            ahead = float((at - cell.pose.position).norm())
            if ahead > _AHEAD:
                velocity = velocity * 0.0
            at = at + dt * velocity
            twist = torch.cat([velocity, torch.zeros(3, dtype=torch.float64)])
            cell.track_pose(Pose(at, start.orientation), twist)
            recent.append((cell.time, cell.pose.position))
            while recent[-1][0] - recent[0][0] > config.still + 1e-9:
                recent.popleft()
            # Encoders are too noisy to tell from one step whether an arm rests.
            whole = recent[-1][0] - recent[0][0] > 0.9 * config.still
            gone = float((recent[-1][1] - recent[0][1]).norm())
            if whole and not moving and gone < _RESTS * config.still:
                break
        end = estimate.duration * torch.ones(1, dtype=torch.float64)
        return (estimate.person(end)[0] - estimate.robot(end)[0])[0].numpy()

    def _await_hand(self, beside: Float[np.ndarray, "3"], deadline: float) -> None:
        """Hold still until the person's hand is where a hand is that holds a thing out."""
        cell, config, wait = self._cell, self._config, self._cell.pose
        still, there = torch.zeros(6, dtype=torch.float64), deque()
        expected = wait.position.numpy() + beside
        while cell.time < deadline:
            cell.track_pose(wait, still)
            if not self._look() or self._newest is None:
                continue
            there.append((self._newest.time, self._watch.place(self._newest)))
            while there[-1][0] - there[0][0] > config.still:
                there.popleft()
            whole = there[-1][0] - there[0][0] > 0.8 * config.still
            places = np.stack([place for _, place in there])
            off = np.linalg.norm(places.mean(0) - expected)
            sway = np.linalg.norm(places - places.mean(0), axis=1).max()
            if whole and off < config.near and sway < config.near / 2:
                return
        raise MissedGraspError("receive: the person's hand did not come to the robot's.")

    def wait_until_away(self, distance: float = 0.25, longest: float = 5.0) -> None:
        """Hold still until the hand is further away [m], or for so long [s]."""
        end = self._cell.time + longest
        while self._cell.time < end:
            self._cell.hold_pose(self._cell.config.dt)
            self._look()
            if self._newest is not None:
                here = self._cell.pose.position.numpy()
                if np.linalg.norm(self._watch.place(self._newest) - here) > distance:
                    return

    def _estimate(self) -> InteractionEstimate:
        times = np.array(self._watch.times)
        return self._model.observe(
            times - times[0], np.stack(self._watch.hand), self._config.noise
        )

    def _look(self) -> bool:
        """Whether the tracker has another image, which is taken in."""
        seen = self._tracker.read()
        if seen is None or (self._newest is not None and seen.time <= self._newest.time):
            return False
        self._newest = seen
        self._watch.see(seen)
        return True


# Of the commanded place before the arm, from which it waits for it [m]; speed at which the end
# effector rests [m/s].
_AHEAD, _RESTS = 0.04, 0.01


def _end(estimate: InteractionEstimate) -> tuple[Float[Tensor, "3"], Float[Tensor, "3"]]:
    """Where the robot's hand is at the end, and how sure that is [m]."""
    mean, deviation = estimate.robot(torch.tensor([estimate.duration], dtype=torch.float64))
    return mean[0], deviation[0]


def _eased(
    at: Tensor,
    velocity: Tensor,
    goal: Tensor,
    speed: float,
    config: ReceivingConfig,
    dt: float,
) -> Float[Tensor, "3"]:
    """Towards the goal, within a speed from which it can stop there, and an acceleration."""
    way = goal - at
    distance = float(way.norm())
    fastest = min(speed, (config.acceleration * distance) ** 0.5, distance / (5 * dt))
    wanted = way * (fastest / max(distance, 1e-9))
    change = wanted - velocity
    most = config.acceleration * dt
    return velocity + change * min(1.0, most / max(float(change.norm()), 1e-12))
