"""Receiving an object from a person's hand, recognised by the motion of the hand alone.

A tracker sees the person. Each movement of the hand from rest is compared with demonstrated
movements (`InteractionPrimitive`). As soon as the movement is most likely a hand-over, the end
effector goes to the predicted meeting point, as close to the person as the safety filter
allows. It moves more slowly if the prediction is less certain. At the meeting point, it waits
for the hand and closes the fingers.
"""

from collections import deque
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.dmp import InteractionEstimate, InteractionPrimitive
from hrc_learn.geometry import Pose
from hrc_learn.geometry.numerics import check_positive
from hrc_learn.protocols import PersonObservation, PersonTracker
from hrc_learn.skills.grasping import CLOSED, CLOSING_TIME, OPEN, as_load, holds, move_fingers
from hrc_learn.skills.placing import GraspObject
from hrc_learn.skills.work_cell import MissedGraspError, WorkCell

HAND_OVER = "hand over"
"""Name of the kind of movement to which the robot responds."""

# Parts of a tracked body that are observed, named as in `sim.worker.PARTS`.
_BODY, _HAND = "pelvis", "hand_right"


@dataclass(frozen=True, kw_only=True)
class ReceivingConfig:
    """Recognition of hand-overs, and the response to them."""

    window: float = 0.3
    """Time window over which motion of a hand is detected [s]: nine images."""
    motion_threshold: float = 0.06
    """The hand counts as moving if its displacement within the window is larger than this
    threshold, and the body counts as standing if its displacement is smaller [m]. With a
    tracker noise of 1 cm, a hand at rest seems to be displaced by a quarter of this
    threshold."""
    noise: float = 0.012
    """Standard deviation of each coordinate of the hand [m]: tracker noise and human
    variation."""
    certainty: float = 0.95
    """Probability of a hand-over above which the robot moves."""
    speed: float = 0.5
    """Speed of the end effector towards a meeting point predicted without uncertainty [m/s]."""
    acceleration: float = 1.0
    """Acceleration of the end effector [m/s^2]."""
    tolerance: float = 0.06
    """Standard deviation of the meeting point at which the speed is halved [m]."""
    near: float = 0.09
    """Largest deviation of the hand, relative to the end effector, from its demonstrated
    position [m]."""
    still: float = 0.5
    """Time for which the hand has to stay near the demonstrated position before the fingers
    close [s]."""
    attempts: int = 3
    """Largest number of times that the fingers close."""
    timeout: float = 30.0
    """Give up after this long [s]."""

    unbounded = ("timeout",)

    __post_init__ = check_positive


@dataclass(kw_only=True)
class Receipt:
    """Record of a hand-over; each time is NaN until its event."""

    set_off: float = np.nan
    """Time of the first image of the hand's movement [s]."""
    recognised: float = np.nan
    """Time of the recognition [s]."""
    seen: float = np.nan
    """Time of the image that led to the recognition [s]."""
    predicted: Float[np.ndarray, "3"] | None = None
    """Position of the end effector at the meeting, predicted at the recognition [m]."""
    taken: float = np.nan
    """Time at which the fingers held the object [s]."""
    attempts: int = 0
    """Number of times that the fingers closed."""
    passed_over: int = 0
    """Number of earlier movements that were not hand-overs."""


class MovementWatch:
    """Divides the tracked motion of a standing person's hand into movements."""

    def __init__(self, config: ReceivingConfig, body: int, hand: int):
        """Start without images.

        Args:
            config: Window and threshold of a movement.
            body: Index of the pelvis in a tracked body.
            hand: Index of the hand.
        """
        self._config, self._body, self._hand = config, body, hand
        self._latest: deque[PersonObservation] = deque()
        self.times: list[float] = []
        """Times of the images of the present movement [s]; empty: the hand rests."""
        self.hand: list[Float[np.ndarray, "3"]] = []
        """Positions of the hand in these images: middle of the capsule's axis [m]."""

    def see(self, seen: PersonObservation) -> bool:
        """Add an image; returns True if it belongs to a movement."""
        recent, config = self._latest, self._config
        recent.append(seen)
        while recent[-1].time - recent[0].time > config.window + 1e-6:
            recent.popleft()
        enough = len(recent) >= 4  # for two means
        stands = enough and self._moved(self._body) < config.motion_threshold
        if not stands or self._moved(self._hand) <= config.motion_threshold:
            # The hand rests again, the person walks, or images are missing: the next motion is
            # another movement.
            self.times, self.hand = [], []
            return False
        new = [seen] if self.times else recent
        self.times += [one.time for one in new]
        self.hand += [self.place(one) for one in new]
        return True

    def place(self, seen: PersonObservation) -> Float[np.ndarray, "3"]:
        """Position of the hand [m]."""
        return seen.ends[self._hand].mean(axis=0)

    def _moved(self, part: int) -> float:
        """Displacement of a body part within the window [m].

        This is twice the distance between the mean positions in both halves of the window.
        """
        places = np.stack([one.ends[part].mean(axis=0) for one in self._latest])
        half = len(places) // 2
        return 2 * float(np.linalg.norm(places[-half:].mean(0) - places[:half].mean(0)))


class Receiving:
    """Waits for a hand-over and takes the object."""

    def __init__(
        self,
        cell: WorkCell,
        tracker: PersonTracker,
        model: InteractionPrimitive,
        parts: tuple[str, ...],
        wait: Pose,
        config: ReceivingConfig | None = None,
    ):
        """Prepare receiving.

        Args:
            cell: Arm and gripper.
            tracker: Tracker of the person.
            model: Model of the motions of hand and end effector together, with positions in the
                base frame [m].
            parts: Names of the capsules of a tracked body.
            wait: Pose of the end effector while it waits.
            config: Recognition and response.
        """
        self._cell, self._tracker, self._model = cell, tracker, model
        self._config = config or ReceivingConfig()
        self._watch = MovementWatch(self._config, parts.index(_BODY), parts.index(_HAND))
        self._newest: PersonObservation | None = None
        self.wait = wait
        self.receipt = Receipt()

    def receive(self, item: GraspObject) -> Receipt:
        """Wait for a hand-over, meet the person's hand, and take the object.

        Raises:
            MissedGraspError: There was no hand-over, or the fingers closed on nothing.
        """
        deadline = self._cell.time + self._config.timeout
        self.receipt = Receipt()
        self._cell.gripper.move(OPEN)
        estimate = self._recognise(deadline)
        hand_offset = self._meet(estimate, deadline)
        while self.receipt.attempts < self._config.attempts:
            self._await_hand(hand_offset, deadline)
            self.receipt.attempts += 1
            move_fingers(self._cell, CLOSED, CLOSING_TIME)
            if holds(self._cell, item):
                self.receipt.taken = self._cell.time
                self._cell.load = as_load(item)
                return self.receipt
            move_fingers(self._cell, OPEN, CLOSING_TIME)
        raise MissedGraspError("receive: the fingers closed on nothing in the person's hand.")

    def _recognise(self, deadline: float) -> InteractionEstimate:
        """Hold still until a movement is most likely a hand-over."""
        # `certain`: number of consecutive images with a probability above the certainty.
        # `other`: True if the last image of the present movement was below the certainty.
        certain, other = 0, False
        wait, still = self._cell.pose, torch.zeros(6, dtype=torch.float64)
        while self._cell.time < deadline:
            self._cell.track_pose(wait, still)
            if not self._look():
                continue
            if not self._watch.times:
                self.receipt.passed_over += other
                certain, other = 0, False
                continue
            estimate = self._estimate()
            k = self._model.kinds.index(HAND_OVER)
            # Require two images in a row: a single image may be far off.
            certain = certain + 1 if estimate.probability[k] > self._config.certainty else 0
            other = certain == 0
            if certain == 2:
                receipt, times = self.receipt, self._watch.times
                receipt.recognised, receipt.set_off = self._cell.time, times[0]
                receipt.seen, receipt.predicted = times[-1], _end(estimate)[0].numpy().copy()
                return estimate
        raise MissedGraspError("receive: no hand-over was recognised.")

    def _meet(self, estimate: InteractionEstimate, deadline: float) -> Float[np.ndarray, "3"]:
        """Go to the predicted meeting point.

        Returns:
            Demonstrated position of the hand minus demonstrated position of the end effector,
            both at the end of the movement [m].
        """
        cell, config, receipt = self._cell, self._config, self.receipt
        start, dt = cell.pose, cell.config.dt
        at, velocity = start.position.clone(), torch.zeros(3, dtype=torch.float64)
        moving, recent = True, deque([(cell.time, start.position)])
        while cell.time < deadline:
            moving = moving and cell.time - receipt.seen < 2 * estimate.duration
            if self._look() and moving:
                if self._watch.times and self._watch.times[0] == receipt.set_off:
                    estimate = self._estimate()
                else:
                    moving = False  # the hand has come to rest
            goal, deviation = _end(estimate)
            scale = config.tolerance**2 / (config.tolerance**2 + deviation.square().max())
            velocity = _eased(at, velocity, goal, float(scale) * config.speed, config, dt)
            # Wait for the arm if a person slows it down.
            lag = float((at - cell.pose.position).norm())
            if lag > _LARGEST_LAG:
                velocity = velocity * 0.0
            at = at + dt * velocity
            twist = torch.cat([velocity, torch.zeros(3, dtype=torch.float64)])
            cell.track_pose(Pose(at, start.orientation), twist)
            recent.append((cell.time, cell.pose.position))
            while recent[-1][0] - recent[0][0] > config.still + 1e-9:
                recent.popleft()
            # Encoders are too noisy to detect rest within a single step.
            whole = recent[-1][0] - recent[0][0] > 0.9 * config.still
            moved = float((recent[-1][1] - recent[0][1]).norm())
            if whole and not moving and moved < _REST_SPEED * config.still:
                break
        end = estimate.duration * torch.ones(1, dtype=torch.float64)
        return (estimate.person(end)[0] - estimate.robot(end)[0])[0].numpy()

    def _await_hand(self, hand_offset: Float[np.ndarray, "3"], deadline: float) -> None:
        """Hold still until the person's hand rests at its demonstrated offset [m].

        The offset is the position of the hand minus the position of the end effector.
        """
        cell, config, wait = self._cell, self._config, self._cell.pose
        still, there = torch.zeros(6, dtype=torch.float64), deque()
        expected = wait.position.numpy() + hand_offset
        while cell.time < deadline:
            cell.track_pose(wait, still)
            if not self._look() or self._newest is None:
                continue
            there.append((self._newest.time, self._watch.place(self._newest)))
            while there[-1][0] - there[0][0] > config.still:
                there.popleft()
            whole = there[-1][0] - there[0][0] > 0.8 * config.still
            places = np.stack([place for _, place in there])
            error = np.linalg.norm(places.mean(0) - expected)
            sway = np.linalg.norm(places - places.mean(0), axis=1).max()
            if whole and error < config.near and sway < config.near / 2:
                return
        raise MissedGraspError("receive: the person's hand did not reach the gripper.")

    def wait_until_away(self, distance: float = 0.25, longest: float = 5.0) -> None:
        """Hold still until the hand is `distance` [m] away, at most for `longest` [s]."""
        end = self._cell.time + longest
        while self._cell.time < end:
            self._cell.hold_pose(self._cell.config.dt)
            self._look()
            if self._newest is not None:
                here = self._cell.pose.position.numpy()
                if np.linalg.norm(self._watch.place(self._newest) - here) > distance:
                    return

    def _estimate(self) -> InteractionEstimate:
        """Estimate of the interaction from the present movement of the hand."""
        times = np.array(self._watch.times)
        return self._model.observe(
            times - times[0], np.stack(self._watch.hand), self._config.noise
        )

    def _look(self) -> bool:
        """Read the tracker; returns True if it has a new image."""
        seen = self._tracker.read()
        if seen is None or (self._newest is not None and seen.time <= self._newest.time):
            return False
        self._newest = seen
        self._watch.see(seen)
        return True


# `_LARGEST_LAG`: distance of the arm behind its command above which the command waits [m].
# `_REST_SPEED`: speed below which the end effector counts as at rest [m/s].
_LARGEST_LAG, _REST_SPEED = 0.04, 0.01


def _end(estimate: InteractionEstimate) -> tuple[Float[Tensor, "3"], Float[Tensor, "3"]]:
    """Predicted final position of the end effector, and its standard deviation [m]."""
    mean, deviation = estimate.robot(torch.tensor([estimate.duration], dtype=torch.float64))
    return mean[0], deviation[0]


def _eased(
    at: Tensor, velocity: Tensor, goal: Tensor, speed: float, config: ReceivingConfig, dt: float
) -> Float[Tensor, "3"]:
    """Velocity towards the goal, limited in speed and acceleration so as to stop there."""
    offset = goal - at
    distance = float(offset.norm())
    fastest = min(speed, (config.acceleration * distance) ** 0.5, distance / (5 * dt))
    wanted = offset * (fastest / max(distance, 1e-9))
    change = wanted - velocity
    most = config.acceleration * dt
    return velocity + change * min(1.0, most / max(float(change.norm()), 1e-12))
