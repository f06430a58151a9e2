"""A worker: a body of capsules with the sizes of people, put into postures.

His own frame lies on the floor under the pelvis: x forward, y to his left, z up. Arms and legs
follow from hands and feet by the inverse kinematics of two links.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from hrc_learn.geometry.shapes import Colour

# Lengths as fractions of the stature: Drillis and Contini (1966), "Body segment parameters", as
# in Winter (2009), "Biomechanics and motor control of human movement", figure 4.1.
_UPPER_ARM, _FOREARM, _HAND = 0.186, 0.146, 0.108
_THIGH, _SHANK, _ANKLE_HEIGHT, _FOOT = 0.245, 0.246, 0.039, 0.152
_HIP_HEIGHT, _SHOULDER_HEIGHT, _CHIN_HEIGHT = 0.530, 0.818, 0.870
_TRUNK = _SHOULDER_HEIGHT - _HIP_HEIGHT

# Breadths and circumferences of men of 1.756 m, rounded, as fractions of it: Gordon et al.
# (2014), "2012 anthropometric survey of U.S. Army personnel", NATICK/TR-15/007.
_MEASURED = 1.756
_RADII = {
    "head": (0.154 + 0.199) / 4 / _MEASURED,  # of breadth and length, the mean
    "neck": 0.398 / (2 * np.pi) / _MEASURED,
    "chest": 0.255 / 2 / _MEASURED,  # of its depth
    "shoulders": 0.358 / (2 * np.pi) / _MEASURED,
    "pelvis": 0.250 / 2 / _MEASURED,  # of the depth of the abdomen and the buttocks
    "upper_arm": 0.358 / (2 * np.pi) / _MEASURED,
    "forearm": 0.310 / (2 * np.pi) / _MEASURED,
    "hand": 0.088 / 2 / _MEASURED,  # of its breadth
    # Thigh and calf are thickest at one end: of half way to the knee and the ankle.
    "thigh": (0.625 + 0.39) / (4 * np.pi) / _MEASURED,
    "shank": (0.392 + 0.229) / (4 * np.pi) / _MEASURED,
    "foot": 0.090 / 2 / _MEASURED,
}
_SHOULDER_HALF = (0.510 / 2) / _MEASURED - _RADII["upper_arm"]  # of the deltoids' breadth
_CHEST_HALF = 0.300 / 2 / _MEASURED - _RADII["chest"]
_PELVIS_HALF = 0.346 / 2 / _MEASURED - _RADII["pelvis"]  # of the hips' breadth

# Fifth to 95th percentile of the statures of women and men [m]: Huston (2009), "Principles of
# biomechanics".
STATURES = {"women": (1.518, 1.724), "men": (1.649, 1.869)}

WORKER_ITEM_HALF_SIZE = (0.035, 0.025, 0.025)
"""Of what a worker carries to the bench [m]."""

_SKIN: Colour = (0.85, 0.66, 0.53, 1.0)
_SHIRT: Colour = (0.20, 0.42, 0.62, 1.0)
_TROUSERS: Colour = (0.23, 0.25, 0.30, 1.0)
_SHOES: Colour = (0.12, 0.12, 0.13, 1.0)

_PARTS = (
    ("head", "head", _SKIN),
    ("neck", "neck", _SKIN),
    ("chest_left", "chest", _SHIRT),
    ("chest_right", "chest", _SHIRT),
    ("shoulders", "shoulders", _SHIRT),
    ("pelvis", "pelvis", _TROUSERS),
    *(
        (f"{part}_{side}", part, colour)
        for side in ("left", "right")
        for part, colour in (
            ("upper_arm", _SHIRT),
            ("forearm", _SKIN),
            ("hand", _SKIN),
            ("thigh", _TROUSERS),
            ("shank", _TROUSERS),
            ("foot", _SHOES),
        )
    ),
)
PARTS = tuple(name for name, _, _ in _PARTS)
"""Names of the body's capsules, in the order of all arrays."""
COLOURS = tuple(colour for _, _, colour in _PARTS)
"""Of the capsules."""
_HANDS = (PARTS.index("hand_left"), PARTS.index("hand_right"))

# How much of an arm or leg is stretched at most: a straight one has no bend to speak of.
_STRETCHED = 0.995
# To which side elbows and knees point, in the worker's frame; the sign of y is the side's.
_ELBOW, _KNEE = np.array([-0.8, 0.2, -0.7]), np.array([1.0, 0.1, 0.0])
# Fraction of the hand's length at which things are held.
_GRIP = 0.9
# The pelvis goes back as the trunk leans forward, or he would fall over: fraction of stature.
_BALANCE = 0.06
# How much less the head leans than the trunk: people look up from what they lean over.
_HEAD_LEANS = 0.7
_LIFT = 0.04  # of a foot in its swing, fraction of stature


@dataclass(frozen=True, kw_only=True)
class WorkerConfig:
    """Whose body it is."""

    stature: float = 1.75
    """Height of the standing body [m]."""
    floor: float = -0.72
    """Height of the floor, below the robot's base [m]."""

    def __post_init__(self) -> None:
        if not 1.2 <= self.stature <= 2.3:
            raise ValueError(
                f"stature must be that of an adult, 1.2 to 2.3 m, but is {self.stature}."
            )

    @classmethod
    def draw(cls, rng: np.random.Generator) -> WorkerConfig:
        """A woman or a man, of the 5th to the 95th percentile of the stature."""
        low, high = STATURES["women" if rng.uniform() < 0.5 else "men"]
        # 5 and 95 % lie 1.645 deviations from the mean of a normal distribution.
        while True:
            deviations = rng.standard_normal()
            if abs(deviations) <= 1.645:
                return cls(stature=(low + high) / 2 + (high - low) / 2 * deviations / 1.645)


@dataclass(frozen=True, kw_only=True, eq=False)
class Posture:
    """How and where a body stands, at any number of times."""

    place: Float[np.ndarray, "*time 2"]
    """Point of the floor under the pelvis, in the base frame [m]."""
    heading: Float[np.ndarray, "*time"]
    """Where he faces: angle of x from the base's [rad]."""
    lean: Float[np.ndarray, "*time"]
    """Of the trunk, forward [rad]."""
    stride: Float[np.ndarray, "*time"]
    """How far the left foot is before the pelvis, and the right one behind it [m]."""
    swing: Float[np.ndarray, "*time"]
    """Which foot is lifted and how high: 1 the left one, -1 the right one, 0 none."""
    hands: Float[np.ndarray, "*time 2 3"]
    """Where the left and the right hand hold things, in the worker's own frame [m]; both sink
    with the body by what a stride takes of its height."""


class Worker:
    """A body.

    Attributes:
        config: Whose it is.
        radius: Of each capsule [m], in the order of `PARTS`.
    """

    def __init__(self, config: WorkerConfig | None = None):
        self.config = config or WorkerConfig()
        self._size = self.config.stature
        self.radius = self._size * np.array([_RADII[kind] for _, kind, _ in _PARTS])

    @property
    def lengths(self) -> Float[np.ndarray, " parts"]:
        """Of the axis of each capsule, the same in any posture [m]."""
        ends = self.ends(self.standing())
        return np.linalg.norm(ends[:, 1] - ends[:, 0], axis=-1)

    @property
    def arm_length(self) -> float:
        """From the shoulder to what a stretched arm holds [m]."""
        return self._size * (_UPPER_ARM + _FOREARM + _GRIP * _HAND) * _STRETCHED

    def hanging_hands(self) -> Float[np.ndarray, "2 3"]:
        """Where the hands of a standing person are, in his own frame [m]."""
        x, y = 0.03 * self._size, _SHOULDER_HALF * self._size + 0.02
        z = _SHOULDER_HEIGHT * self._size - 0.98 * self.arm_length
        return np.array([[x, y, z], [x, -y, z]])

    def standing(self) -> Posture:
        """Upright at the origin, the arms hanging."""
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
        h, own = self._size, {}
        pelvis, up = self._trunk(posture.lean, posture.stride)
        left = np.array([0.0, 1.0, 0.0])
        forward = np.cross(left, up)
        neck = pelvis + _TRUNK * h * up
        own["pelvis"] = _pair(
            pelvis + _PELVIS_HALF * h * left, pelvis - _PELVIS_HALF * h * left
        )
        own["shoulders"] = _pair(
            neck + _SHOULDER_HALF * h * left, neck - _SHOULDER_HALF * h * left
        )
        for side, sign in (("left", 1.0), ("right", -1.0)):
            aside = sign * _CHEST_HALF * h * left
            # The round top of the chest ends a little above the shoulders' joints.
            top = neck + (0.015 - _RADII["chest"]) * h * up + aside
            own[f"chest_{side}"] = _pair(pelvis + 0.05 * h * up + aside, top)
        lean = _HEAD_LEANS * posture.lean
        head_up = _vector(np.sin(lean), 0.0, np.cos(lean))
        chin = neck + (_CHIN_HEIGHT - _SHOULDER_HEIGHT) * h * head_up
        own["neck"] = _pair(neck, chin)
        # The face is before the spine.
        low = chin + 0.02 * h * forward + _RADII["head"] * h * head_up
        own["head"] = _pair(low, low + (1 - _CHIN_HEIGHT - 2 * _RADII["head"]) * h * head_up)
        sinks = _vector(0.0, 0.0, self._hip_height(posture.stride) - self._hip_height(0.0))
        for k, (side, sign) in enumerate((("left", 1.0), ("right", -1.0))):
            mirror = np.array([1.0, sign, 1.0])
            shoulder = neck + sign * _SHOULDER_HALF * h * left
            hand = posture.hands[..., k, :] + sinks
            self._add_arm(own, side, shoulder, hand, _ELBOW * mirror)
            hip = pelvis + sign * _PELVIS_HALF * h * left
            lifted = _LIFT * h * np.maximum(sign * posture.swing, 0.0)
            ankle = _vector(sign * posture.stride, hip[..., 1], _ANKLE_HEIGHT * h + lifted)
            self._add_leg(own, side, hip, ankle, _KNEE * mirror)
        return self._placed(np.stack([own[name] for name in PARTS], axis=-3), posture)

    def lean_to(self, hand: Float[np.ndarray, "3"], side: int) -> float | None:
        """How far he has to lean for a hand to be somewhere.

        Args:
            hand: Where, in his own frame [m].
            side: 0 for the left hand, 1 for the right one.

        Returns:
            The least angle of the trunk [rad]; None if he cannot reach it.
        """
        lean = np.linspace(0.0, 1.2, 61)
        pelvis, up = self._trunk(lean, np.zeros_like(lean))
        aside = (1.0, -1.0)[side] * _SHOULDER_HALF * self._size
        shoulder = pelvis + _TRUNK * self._size * up + np.array([0.0, aside, 0.0])
        far = np.linalg.norm(hand - shoulder, axis=-1)
        near_enough = np.flatnonzero(far <= 0.97 * self.arm_length)
        return float(lean[near_enough[0]]) if len(near_enough) else None

    def grip(self, ends: Float[np.ndarray, "*time parts 2 3"], side: int) -> np.ndarray:
        """Where the left (0) or right (1) hand holds things, (*time, 3) in the base frame [m].

        Args:
            ends: Of the axes of the capsules [m].
            side: Of the hand.
        """
        wrist, tip = np.moveaxis(ends[..., _HANDS[side], :, :], -2, 0)
        return wrist + _GRIP * _HAND / (_HAND - _RADII["hand"]) * (tip - wrist)

    def _trunk(self, lean: np.ndarray, stride: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Middle of the pelvis and direction of the spine, in the worker's frame."""
        back = _BALANCE * self._size * np.sin(lean)
        pelvis = _vector(-back, 0.0, self._hip_height(np.abs(stride) + np.abs(back)))
        return pelvis, _vector(np.sin(lean), 0.0, np.cos(lean))

    def _hip_height(self, stride: float | np.ndarray) -> float | np.ndarray:
        """As high as straight legs let it be whose feet are so far before or behind it [m]."""
        leg = _STRETCHED * (_THIGH + _SHANK) * self._size
        reach = np.minimum(np.abs(stride), 0.8 * leg)
        return _ANKLE_HEIGHT * self._size + np.sqrt(leg**2 - reach**2)

    def _add_arm(
        self,
        own: dict[str, np.ndarray],
        side: str,
        shoulder: np.ndarray,
        hand: np.ndarray,
        elbow_to: np.ndarray,
    ) -> None:
        h = self._size
        # The hand continues the line from the shoulder, so the wrist lies on it, too.
        towards = _unit(hand - shoulder)
        wrist = hand - _GRIP * _HAND * h * towards
        elbow, wrist = _two_links(shoulder, wrist, _UPPER_ARM * h, _FOREARM * h, elbow_to)
        own[f"upper_arm_{side}"] = _pair(shoulder, elbow)
        own[f"forearm_{side}"] = _pair(elbow, wrist)
        tips = (_HAND - _RADII["hand"]) * h
        own[f"hand_{side}"] = _pair(wrist, wrist + tips * towards)

    def _add_leg(
        self,
        own: dict[str, np.ndarray],
        side: str,
        hip: np.ndarray,
        ankle: np.ndarray,
        knee_to: np.ndarray,
    ) -> None:
        h = self._size
        knee, ankle = _two_links(hip, ankle, _THIGH * h, _SHANK * h, knee_to)
        own[f"thigh_{side}"] = _pair(hip, knee)
        own[f"shank_{side}"] = _pair(knee, ankle)
        # A quarter of the foot is behind the ankle.
        heel, toe = -_FOOT / 4 + _RADII["foot"], 3 * _FOOT / 4 - _RADII["foot"]
        down = _RADII["foot"] - _ANKLE_HEIGHT
        offsets = h * np.array([[heel, 0.0, down], [toe, 0.0, down]])
        own[f"foot_{side}"] = ankle[..., None, :] + offsets

    def _placed(self, own: np.ndarray, posture: Posture) -> np.ndarray:
        """From the worker's frame into the base frame."""
        angle = posture.heading[..., None, None]
        c, s = np.cos(angle), np.sin(angle)
        x, y, z = own[..., 0], own[..., 1], own[..., 2]
        turned = _vector(c * x - s * y, s * x + c * y, z + self.config.floor)
        turned[..., :2] += posture.place[..., None, None, :]
        return turned


def _two_links(
    start: np.ndarray, end: np.ndarray, first: float, second: float, bent_to: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Joint and end of two links that lead from a start to an end, or as near as they can."""
    distance = np.linalg.norm(end - start, axis=-1, keepdims=True)
    towards = (end - start) / distance
    most = _STRETCHED * (first + second)
    distance = np.clip(distance, abs(first - second) + 0.05 * most, most)
    along = (first**2 - second**2 + distance**2) / (2 * distance)
    bent_to = bent_to - (bent_to * towards).sum(-1, keepdims=True) * towards
    out = np.sqrt(np.maximum(first**2 - along**2, 0.0))
    return start + along * towards + out * _unit(bent_to), start + distance * towards


def _vector(x, y, z) -> np.ndarray:
    return np.stack(np.broadcast_arrays(x, y, z), axis=-1)


def _pair(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    return np.stack(np.broadcast_arrays(first, second), axis=-2)


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector, axis=-1, keepdims=True)
