"""A simulated worker: a body of capsules with human proportions, and its body tracker.

The worker's frame lies on the floor under the pelvis: x forward, y to the left, z up. Arms and
legs follow from hands and feet by the inverse kinematics of two links.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from hrc_learn.geometry.shapes import Colour
from hrc_learn.protocols import PersonObservation
from hrc_learn.sim.imperfections import Imperfections
from hrc_learn.store import read_toml

# Lengths as fractions of the stature: Drillis and Contini (1966), "Body segment parameters", as
# in Winter (2009), "Biomechanics and motor control of human movement", figure 4.1.
_UPPER_ARM, _FOREARM, _HAND = 0.186, 0.146, 0.108
_THIGH, _SHANK, _ANKLE_HEIGHT, _FOOT = 0.245, 0.246, 0.039, 0.152
_HIP_HEIGHT, _SHOULDER_HEIGHT, _CHIN_HEIGHT = 0.530, 0.818, 0.870
_TRUNK = _SHOULDER_HEIGHT - _HIP_HEIGHT

# Breadths and circumferences of men of 1.756 m, rounded, as fractions of this stature: Gordon
# et al. (2014), "2012 anthropometric survey of U.S. Army personnel", NATICK/TR-15/007.
_MEASURED = 1.756
_TABLES = read_toml(Path(__file__).with_name("worker_parts.toml"))
_RADII = {kind: radius / _MEASURED for kind, radius in _TABLES["radii"].items()}
_SHOULDER_HALF = (0.510 / 2) / _MEASURED - _RADII["upper_arm"]  # from the deltoids' breadth
_CHEST_HALF = 0.300 / 2 / _MEASURED - _RADII["chest"]
_PELVIS_HALF = 0.346 / 2 / _MEASURED - _RADII["pelvis"]  # from the hips' breadth

# Fifth to 95th percentile of the statures of women and men [m]: Huston (2009), "Principles of
# biomechanics".
STATURES = {"women": (1.518, 1.724), "men": (1.649, 1.869)}

WORKER_ITEM_HALF_SIZE = (0.035, 0.025, 0.025)
"""Half size of the object that a worker carries to the bench [m]."""

_PARTS: list[tuple[str, str, str]] = _TABLES["parts"]
PARTS = tuple(name for name, _, _ in _PARTS)
"""Names of the body's capsules, in the order of all arrays."""
REGIONS = tuple(_TABLES["regions"].get(kind, kind) for _, kind, _ in _PARTS)
"""Body regions of the capsules."""
COLOURS: tuple[Colour, ...] = tuple(tuple(_TABLES["colours"][c]) for _, _, c in _PARTS)
"""Colours of the capsules (RGBA)."""
# Numbers of the parts that come in pairs, left and right.
_PAIRS = {
    kind: [PARTS.index(f"{kind}_{side}") for side in ("left", "right")]
    for kind in ("upper_arm", "forearm", "hand", "thigh", "shank", "foot")
}
# Sign of y of the left and the right part of a pair.
_SIDES = np.array([[1.0], [-1.0]])

# Largest extension of an arm or leg, as a fraction of its length: for a straight limb, the
# direction of bending would be undefined.
_STRETCHED = 0.995
# Directions in which the left elbow and the left knee point, in the worker's frame. For the
# right ones, y has the opposite sign.
_ELBOW, _KNEE = (-0.8, 0.2, -0.7), (1.0, 0.1, 0.0)
# Directions of bending, and lengths of the first and the second link as fractions of the
# stature: rows for left arm, right arm, left leg and right leg.
_BENT_TO = np.array([(x, side * y, z) for x, y, z in (_ELBOW, _KNEE) for side in (1, -1)])
_FIRST = np.array([[_UPPER_ARM], [_UPPER_ARM], [_THIGH], [_THIGH]])
_SECOND = np.array([[_FOREARM], [_FOREARM], [_SHANK], [_SHANK]])
# Position of the grip, as a fraction of the hand's length.
_GRIP = 0.9
# Backward shift of the pelvis for balance, as a fraction of the stature times sin(lean).
_BALANCE = 0.06
# Lean of the head as a fraction of the trunk's lean: people look up while they lean.
_HEAD_LEANS = 0.7
_LIFT = 0.04  # height of a foot in its swing, as a fraction of the stature
# Time over which velocities are averaged [s]: three images, a compromise between noise and lag.
_SPAN = 0.1
IMAGE_RATE = 30.0
"""Images per second of an ordinary depth camera."""


@dataclass(frozen=True, kw_only=True)
class WorkerConfig:
    """Stature of a worker and height of the floor."""

    stature: float = 1.75
    """Height of the standing body [m]."""
    floor: float = -0.72
    """Height of the floor [m]; the robot's base is at zero."""

    @classmethod
    def draw(cls, rng: np.random.Generator) -> WorkerConfig:
        """A random woman or man between the 5th and the 95th percentile of the stature."""
        low, high = STATURES["women" if rng.uniform() < 0.5 else "men"]
        # 5 and 95 % lie 1.645 deviations from the mean of a normal distribution.
        while True:
            deviations = rng.standard_normal()
            if abs(deviations) <= 1.645:
                return cls(stature=(low + high) / 2 + (high - low) / 2 * deviations / 1.645)


@dataclass(frozen=True, kw_only=True, eq=False)
class Posture:
    """Postures and places of a body, at any number of times."""

    place: Float[np.ndarray, "*time 2"]
    """Point of the floor under the pelvis, in the base frame [m]."""
    heading: Float[np.ndarray, "*time"]
    """Angle from the base's x axis to the worker's x axis [rad]."""
    lean: Float[np.ndarray, "*time"]
    """Forward lean of the trunk [rad]."""
    stride: Float[np.ndarray, "*time"]
    """Distance of the left foot in front of the pelvis, and of the right foot behind it [m]."""
    swing: Float[np.ndarray, "*time"]
    """Relative height of the lifted foot: up to 1 for the left foot, down to -1 for the right
    foot; 0: no foot is lifted."""
    hands: Float[np.ndarray, "*time 2 3"]
    """Grip of the left and the right hand, in the worker's frame [m]; both sink with the pelvis
    during a stride.
    """


class Worker:
    """Body of a worker.

    Attributes:
        config: Stature of the worker and height of the floor.
        radius: Radius of each capsule [m], in the order of `PARTS`.
    """

    def __init__(self, config: WorkerConfig | None = None):
        self.config = config or WorkerConfig()
        self._size = self.config.stature
        self.radius = self._size * np.array([_RADII[kind] for _, kind, _ in _PARTS])

    @property
    def lengths(self) -> Float[np.ndarray, " parts"]:
        """Length of the axis of each capsule [m], constant."""
        ends = self.ends(self.standing())
        return np.linalg.norm(ends[:, 1] - ends[:, 0], axis=-1)

    @property
    def arm_length(self) -> float:
        """Distance from the shoulder to the grip of a stretched arm [m]."""
        return self._size * (_UPPER_ARM + _FOREARM + _GRIP * _HAND) * _STRETCHED

    def hanging_hands(self) -> Float[np.ndarray, "2 3"]:
        """Hand positions of a standing person, in the worker's frame [m]."""
        x, y = 0.03 * self._size, _SHOULDER_HALF * self._size + 0.02
        z = _SHOULDER_HEIGHT * self._size - 0.98 * self.arm_length
        return np.array([[x, y, z], [x, -y, z]])

    def standing(self) -> Posture:
        """Posture of a person at the origin, standing upright with hanging arms."""
        zero = np.zeros(())
        return Posture(
            place=np.zeros(2),
            heading=zero,
            lean=zero,
            stride=zero,
            swing=zero,
            hands=self.hanging_hands(),
        )

    def ends(self, posture: Posture) -> Float[np.ndarray, "*time parts 2 3"]:
        """Ends of the axes of all capsules in the base frame [m]."""
        h, lean, stride = self._size, posture.lean, posture.stride
        own = np.empty((*lean.shape, len(PARTS), 2, 3))
        pelvis, up = self._trunk(lean, stride)
        left = np.array([0.0, 1.0, 0.0])
        forward = _vector(np.cos(lean), 0.0, -np.sin(lean))
        neck = pelvis + _TRUNK * h * up
        _put(own, "pelvis", pelvis + _PELVIS_HALF * h * left, pelvis - _PELVIS_HALF * h * left)
        shoulders = neck + _SHOULDER_HALF * h * left, neck - _SHOULDER_HALF * h * left
        _put(own, "shoulders", *shoulders)
        # The round top of the chest ends a little above the shoulder joints.
        low, top = pelvis + 0.05 * h * up, neck + (0.015 - _RADII["chest"]) * h * up
        aside = _CHEST_HALF * h * left
        _put(own, "chest_left", low + aside, top + aside)
        _put(own, "chest_right", low - aside, top - aside)
        head = _HEAD_LEANS * lean
        head_up = _vector(np.sin(head), 0.0, np.cos(head))
        chin = neck + (_CHIN_HEIGHT - _SHOULDER_HEIGHT) * h * head_up
        _put(own, "neck", neck, chin)
        # The face is in front of the spine.
        low = chin + 0.02 * h * forward + _RADII["head"] * h * head_up
        high = low + (1 - _CHIN_HEIGHT - 2 * _RADII["head"]) * h * head_up
        _put(own, "head", low, high)
        self._add_limbs(own, posture, pelvis, neck)
        return self._placed(own, posture)

    def lean_to(self, hand: Float[np.ndarray, "3"], side: int) -> float | None:
        """Smallest lean of the trunk that brings a hand to a point.

        Args:
            hand: The point, in the worker's frame [m].
            side: 0 for the left hand, 1 for the right one.

        Returns:
            Angle of the trunk [rad]; None if the point is out of reach.
        """
        lean = np.linspace(0.0, 1.2, 61)
        pelvis, up = self._trunk(lean, np.zeros_like(lean))
        aside = (1.0, -1.0)[side] * _SHOULDER_HALF * self._size
        shoulder = pelvis + _TRUNK * self._size * up + np.array([0.0, aside, 0.0])
        far = np.linalg.norm(hand - shoulder, axis=-1)
        near_enough = np.flatnonzero(far <= 0.97 * self.arm_length)
        return float(lean[near_enough[0]]) if len(near_enough) else None

    def grip(self, ends: Float[np.ndarray, "*time parts 2 3"], side: int) -> np.ndarray:
        """Grip of the left (0) or right (1) hand, (*time, 3) in the base frame [m].

        Args:
            ends: Ends of the axes of the capsules [m].
            side: 0 for the left hand, 1 for the right one.
        """
        wrist, tip = np.moveaxis(ends[..., _PAIRS["hand"][side], :, :], -2, 0)
        return wrist + _GRIP * _HAND / (_HAND - _RADII["hand"]) * (tip - wrist)

    def _trunk(self, lean: np.ndarray, stride: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Middle of the pelvis and direction of the spine, in the worker's frame."""
        back = _BALANCE * self._size * np.sin(lean)
        pelvis = _vector(-back, 0.0, self._hip_height(np.abs(stride) + np.abs(back)))
        return pelvis, _vector(np.sin(lean), 0.0, np.cos(lean))

    def _hip_height(self, stride: float | np.ndarray) -> float | np.ndarray:
        """Height of the pelvis [m] on straight legs with the feet a stride in front of or
        behind the pelvis.
        """
        leg = _STRETCHED * (_THIGH + _SHANK) * self._size
        reach = np.minimum(np.abs(stride), 0.8 * leg)
        return _ANKLE_HEIGHT * self._size + np.sqrt(leg**2 - reach**2)

    def _add_limbs(
        self, own: np.ndarray, posture: Posture, pelvis: np.ndarray, neck: np.ndarray
    ) -> None:
        """Add the arms and legs of both sides."""
        h, sides = self._size, _SIDES * np.array([0.0, 1.0, 0.0])
        shoulder = neck[..., None, :] + _SHOULDER_HALF * h * sides
        hip = pelvis[..., None, :] + _PELVIS_HALF * h * sides
        hand = posture.hands.copy()
        sinks = self._hip_height(posture.stride) - self._hip_height(0.0)
        hand[..., 2] += np.asarray(sinks)[..., None]
        # The hand points along the line from the shoulder to its grip, and the wrist lies on
        # this line, too.
        towards = _unit(hand - shoulder)
        wrist = hand - _GRIP * _HAND * h * towards
        ankle = np.empty_like(hip)
        ankle[..., 0] = _SIDES[:, 0] * posture.stride[..., None]
        ankle[..., 1] = hip[..., 1]
        lifted = np.maximum(_SIDES[:, 0] * posture.swing[..., None], 0.0)
        ankle[..., 2] = _ANKLE_HEIGHT * h + _LIFT * h * lifted
        start = np.concatenate([shoulder, hip], axis=-2)
        joint, end = _two_links(
            start, np.concatenate([wrist, ankle], axis=-2), h * _FIRST, h * _SECOND, _BENT_TO
        )
        wrist, ankle = end[..., :2, :], end[..., 2:, :]
        tips = (_HAND - _RADII["hand"]) * h
        # A quarter of the foot is behind the ankle.
        heel, toe = -_FOOT / 4 + _RADII["foot"], 3 * _FOOT / 4 - _RADII["foot"]
        down = _RADII["foot"] - _ANKLE_HEIGHT
        back, front = h * np.array([[heel, 0.0, down], [toe, 0.0, down]])
        for kind, first, second in (
            ("upper_arm", shoulder, joint[..., :2, :]),
            ("forearm", joint[..., :2, :], wrist),
            ("hand", wrist, wrist + tips * towards),
            ("thigh", hip, joint[..., 2:, :]),
            ("shank", joint[..., 2:, :], ankle),
            ("foot", ankle + back, ankle + front),
        ):
            parts = _PAIRS[kind]
            own[..., parts, 0, :], own[..., parts, 1, :] = first, second

    def _placed(self, own: np.ndarray, posture: Posture) -> np.ndarray:
        """Transform from the worker's frame to the base frame."""
        angle, place = posture.heading[..., None, None], posture.place[..., None, None, :]
        c, s = np.cos(angle), np.sin(angle)
        x, y = own[..., 0], own[..., 1]
        turned = np.empty_like(own)
        turned[..., 0] = c * x - s * y + place[..., 0]
        turned[..., 1] = s * x + c * y + place[..., 1]
        turned[..., 2] = own[..., 2] + self.config.floor
        return turned


def _two_links(
    start: np.ndarray,
    end: np.ndarray,
    first: np.ndarray,
    second: np.ndarray,
    bent_to: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Joint and tip of two links that begin at `start` and reach as near to `end` as they
    can.
    """
    way = end - start
    distance = np.linalg.norm(way, axis=-1, keepdims=True)
    towards = way / distance
    most = _STRETCHED * (first + second)
    distance = np.minimum(np.maximum(distance, abs(first - second) + 0.05 * most), most)
    along = (first**2 - second**2 + distance**2) / (2 * distance)
    bent_to = bent_to - (bent_to * towards).sum(-1, keepdims=True) * towards
    out = np.sqrt(np.maximum(first**2 - along**2, 0.0))
    return start + along * towards + out * _unit(bent_to), start + distance * towards


def _vector(x, y, z) -> np.ndarray:
    vector = np.empty((*x.shape, 3))
    vector[..., 0], vector[..., 1], vector[..., 2] = x, y, z
    return vector


def _put(own: np.ndarray, part: str, first: np.ndarray, second: np.ndarray) -> None:
    k = PARTS.index(part)
    own[..., k, 0, :], own[..., k, 1, :] = first, second


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector, axis=-1, keepdims=True)


class WorkerSensor:
    """Implements the `PersonTracker` protocol: a body tracker on an RGB-D camera.

    Each end of a capsule has independent noise in each image. Velocities come from these
    positions alone, so they are noisy as well, and lag by about 0.05 s.
    """

    def __init__(
        self,
        ends_at: Callable[[float], Float[np.ndarray, "parts 2 3"]],
        radius: Float[np.ndarray, " parts"],
        clock: Callable[[], float],
        sizes: Imperfections,
        rng: np.random.Generator,
    ):
        """Begin to track at the current time.

        Args:
            ends_at: True ends of the axes of all capsules at a time [s], in the base frame [m].
            radius: Radii of the capsules [m].
            clock: Current time [s].
            sizes: Sizes of noise, delay and loss.
            rng: Source of noise and loss.
        """
        self._ends_at, self._radius, self._clock = ends_at, radius, clock
        self._sizes, self._rng = sizes, rng
        self._first, self._taken = clock(), 0
        self._pending: deque[PersonObservation] = deque()
        self._before: deque[PersonObservation] = deque()
        self._newest: PersonObservation | None = None

    def read(self) -> PersonObservation | None:
        """The newest observation that has arrived by now."""
        # Clocks sum rounded steps, so an image that is a nanosecond early counts as in time.
        now = self._clock() + 1e-9
        while (time := self._first + self._taken / IMAGE_RATE) <= now:
            self._take(time)
        while self._pending and self._pending[0].time + self._sizes.person_delay <= now:
            self._newest = self._pending.popleft()
        return self._newest

    def _take(self, time: float) -> None:
        """Take one image and, unless it is lost, queue the observation of the body."""
        self._taken += 1
        ends = self._ends_at(time)
        noise = self._sizes.person_noise * self._rng.standard_normal(ends.shape)
        if self._rng.uniform() < self._sizes.person_loss:
            return
        ends, velocity = ends + noise, np.zeros_like(noise)
        while len(self._before) > 1 and self._before[1].time <= time - _SPAN + 1e-9:
            self._before.popleft()
        if self._before:
            old = self._before[0]
            velocity = (ends - old.ends) / (time - old.time)
        seen = PersonObservation(
            time=time, ends=ends, radius=self._radius, velocity=velocity, regions=REGIONS
        )
        self._before.append(seen)
        self._pending.append(seen)
