"""Evidence for the units of values: their size, their steps, and the type of the robot."""

import math
import re
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64
from numpy.lib.stride_tricks import sliding_window_view

from hrc_learn.demos.issues import DatasetError
from hrc_learn.demos.read.naming import WORDS, is_hand
from hrc_learn.demos.read.quantities import SIZES
from hrc_learn.store import read_json

STATED = 0.99
"""Confidence of a unit that names or one of our own robots state."""
CONFIDENT = 0.75
"""Smallest confidence at which a guessed unit is used without a question."""
ASSUMED = 0.95
"""Largest confidence of a guess from the size of values. The guess is assumed, not known."""

_BOUNDS = {role: {unit: most for most, unit, *_ in rows} for role, rows in SIZES.items()}
"""Quantity -> unit -> largest value, with an allowance for noise."""
# Largest joint angles in rad and in deg. Wrists may turn more than once, so that the bound in
# rad is two turns, 12.6 rad. No demonstration in degrees stays within 13 degrees.
_TWO_TURNS, _DEGREES = _BOUNDS["rotation_vector"]["rad"], 400.0
# Two turns of an encoder. Some arms report whole thousandths of a degree.
_TICKS = 8192.0
_FINGER_RATIO = 1.05
_PERCENT, _BYTE = _BOUNDS["gripper"]["%"], _BOUNDS["gripper"]["byte"]
# Unit, and one step of an encoder in this unit. LeRobot divides a turn by 4095.
STEP_IN_DEGREES = 360 / 4095
_ENCODERS = (("deg", STEP_IN_DEGREES), ("deg", 360 / 4096), ("rad", math.tau / 4096))
_FEWEST_STEPS, _FEWEST_ENCODERS = 10, 3
_RANGED = (0.045, 0.2)
"""Smallest and largest encoder step in values from -100 to 100, for an encoder of 4096 steps a
turn and joint ranges from a whole turn to a quarter turn."""
_DYNAMIXEL = re.compile("koch|omx|aloha|widowx|viperx", re.IGNORECASE)
"""Robot types with Dynamixel motors, which apply `drive_mode` themselves. For motors of other
makers, LeRobot changes the sign of the values."""
_SLIDE = 0.12
"""Longest stroke of a gripper's finger [m]."""
# Old datasets of LeRobot name the columns of joints and of poses alike.
_MOTOR = re.compile(r"motor_?\d+", re.IGNORECASE)
_REVOLUTIONS = 0.5
"""Largest value for which joints without names may be in revolutions instead of rad: few arms
stay within half a radian."""
FEWEST_JOINTS, _POSE_AND_FINGERS = 5, 8
"""`FEWEST_JOINTS`: number of joints of the smallest usual arms.
`_POSE_AND_FINGERS`: number of columns of a pose and two fingers."""
_CLIP, _CLIPPED = 100.0, 0.002
"""`_CLIP`: value at which LeRobot clips normalised positions. `_CLIPPED`: fraction of frames at
exactly this value above which a column counts as clipped."""
GUESSED_BY_SIZE = tuple(SIZES)
"""Quantities other than joints whose unit is guessed from the size of their values."""
_UNIT_LENGTH = 2e-3
"""Error of a quaternion's length due to float32 or few printed digits."""
_OURS = re.compile(r"mujoco_\w+|franka_panda|ros2")
"""Types of our own LeRobot robots, which record rad and m (`hrc_learn.lerobot.arm_values`)."""
# Arms of hobby servos, whose positions LeRobot stores in degrees or as -100..100.
_HOBBY, _HOBBY_JOINTS = re.compile(WORDS["hobby"], re.IGNORECASE), {*WORDS["hobby_joints"]}


class Sizes(NamedTuple):
    """Statistics of the values of each component, over the frames of one or more episodes."""

    peak: Float64[np.ndarray, " components"]
    """99.5 % quantile of the absolute values."""
    clipped: Float64[np.ndarray, " components"]
    """Fraction of the frames at exactly 100 or -100; at 1 or -1 if no component exceeds 1."""
    whole: Bool[np.ndarray, " components"]
    """True where all values are whole numbers."""
    unit_length: Bool[np.ndarray, " components"]
    """True where this component and the next three are a vector of unit length that changes."""
    opening: Bool[np.ndarray, " components"]
    """True where the values go from exactly 0 to exactly 1, as a gripper's opening does."""
    step: Float64[np.ndarray, " components"] = np.zeros(1)
    """Encoder step: all differences of values are multiples of it; 0 if no step fits."""


class Guess(NamedTuple):
    """Unit that the evidence suggests."""

    unit: str
    confidence: float
    evidence: str
    other: str = ""
    """Second candidate; "" if there is none."""


def measure(values: Float64[np.ndarray, "frames components"]) -> Sizes:
    """Sizes of the values of one episode, robust against single outliers."""
    known = np.where(np.isfinite(values), values, 0.0)
    sizes = np.abs(known)
    place = int(0.995 * (len(sizes) - 1))
    length = np.zeros(values.shape[1], bool)
    if values.shape[1] >= 4:
        four = sliding_window_view(known * known, 4, axis=1).sum(-1)
        length[:-3] = (np.abs(four - 1) < 2 * _UNIT_LENGTH).all(0)
    for first in np.flatnonzero(length):
        length[first] = np.ptp(known[:, first : first + 4], axis=0).max() > 1e-3
    return Sizes(
        peak=np.partition(sizes, place, axis=0)[place],
        clipped=(sizes == (_CLIP if sizes.max() > 1 else 1.0)).mean(0),
        whole=(known == np.rint(known)).all(0),
        unit_length=length,
        opening=(known.min(0) == 0) & (known.max(0) == 1),
        step=np.array([_encoder_step(column) for column in known.T]),
    )


def _encoder_step(values: Float64[np.ndarray, " frames"]) -> float:
    """Step of the encoder that measured the values; 0 if their differences fit no step."""
    apart = np.diff(np.unique(values))
    # In float32, a step has a relative error of about 1e-4.
    if len(apart) < _FEWEST_STEPS or apart.min() < 1e-5 * np.abs(values).max():
        return 0.0
    step = float(np.median(apart[apart < 1.5 * apart.min()]))
    counts = np.rint(apart / step)
    if (np.abs(apart / step - counts) > 0.1 + 1e-3 * counts).any():
        return 0.0
    return float(apart.sum() / counts.sum())


def typical(sizes: Sequence[Sizes]) -> Sizes:
    """Typical sizes over episodes, so that no single episode decides."""
    step = partial(np.quantile, q=0.5, method="higher")
    means = (np.median, np.mean, np.all, np.all, np.all, step)
    return Sizes(*(f(x, axis=0) for f, x in zip(means, zip(*sizes, strict=True), strict=True)))


def is_hobby_arm(robot_type: str, labels: Sequence[str]) -> bool:
    """True for arms of hobby servos, by robot type or names of joints."""
    named = {label.lower().removeprefix("main_") for label in labels}
    return bool(_HOBBY.search(robot_type)) or len(named & _HOBBY_JOINTS) >= 3


def read_calibration(file: Path) -> dict[str, tuple[float, bool]]:
    """Range of each motor [encoder steps] and its `drive_mode`, from a calibration of LeRobot.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: The file is no calibration.
    """
    found = {}
    for name, motor in read_json(file).items():
        try:
            span = float(motor["range_max"]) - float(motor["range_min"])
        except (TypeError, KeyError, ValueError):
            span = 0.0
        if not 0 < span < math.inf:
            text = f"is no calibration of LeRobot: {name} has no range_min below a range_max"
            raise DatasetError(text, file=file)
        found[name] = span, bool(motor.get("drive_mode"))
    if not found:
        raise DatasetError("is no calibration of LeRobot: it has no motors", file=file)
    return found


def calibrated_units(
    file: Path, labels: Sequence[str], sizes: Sizes, robot_type: str
) -> tuple[str, ...]:
    """Unit of each joint that LeRobot stored as -100..100 of its calibrated range.

    Both these values and LeRobot's degrees are zero in the middle of the range.

    Args:
        file: The calibration of the arm that was recorded.
        labels: Joint names.
        sizes: Sizes of the joints.
        robot_type: Robot type of the dataset, "" if unknown.

    Raises:
        DatasetError: The file is no calibration, lacks a joint, or does not fit the values.
    """
    known = read_calibration(file)
    names = [name if name in known else name.removeprefix("main_") for name in labels]
    if missing := [name for name in names if name not in known]:
        text = f"has no {', '.join(missing)}; there are {', '.join(known)}"
        raise DatasetError(f"{text}: give the calibration of the robot recorded", file=file)
    spans, hands = (np.array(x) for x in ([known[n][0] for n in names], [*map(is_hand, names)]))
    # Number of encoder steps in one step of the recorded values, which span 200 units, or 100
    # for grippers: LeRobot stores grippers as 0..100.
    steps = np.broadcast_to(sizes.step, len(names)) * spans / np.where(hands, 100, 200)
    other = (steps > 0) & (np.abs(steps - np.maximum(np.rint(steps), 1)) > 5e-3 * steps)
    if (beyond := sizes.peak > _CLIP + 0.05).any():
        text = f"{labels[int(beyond.argmax())]} reaches {sizes.peak.max():.4g}: in deg, not %?"
        raise DatasetError(f"does not fit: {text}", file=file)
    if other.sum() > 1:
        text = f"the steps of {', '.join(np.array(labels)[other])} contradict its ranges"
        raise DatasetError(f"does not fit: {text}: another arm, or values in deg?", file=file)
    turned = [known[n][1] and not _DYNAMIXEL.search(robot_type) for n in names]
    degrees = np.where(turned, -1, 1) * spans / 200 * STEP_IN_DEGREES
    parts = zip(hands, degrees, strict=True)
    return tuple("%" if hand else f"{factor:.9g} deg" for hand, factor in parts)


def guess_joints(
    sizes: Sizes, arm: Bool[np.ndarray, " components"], labels: Sequence[str], robot_type: str
) -> Guess:
    """Unit of an arm's joints.

    Args:
        sizes: Sizes of all components.
        arm: True for each joint of the arm, False for fingers.
        labels: Joint names.
        robot_type: Robot type of the dataset, "" if unknown.
    """
    peaks = np.where(arm, sizes.peak, 0.0)
    # Columns that do not move say nothing about the unit.
    moving = peaks > 1e-6
    if not moving.any():
        return Guess("rad", 0.9, "the joints do not move")
    quaternion = np.flatnonzero(sizes.unit_length & arm)
    if len(quaternion):
        first, last = (labels[quaternion[0] + i] for i in (0, 3))
        text = f"{first} .. {last} always have unit length, as a quaternion has"
        return Guess("rad", 0.3, text)
    # Joints at rest show no step.
    steps = np.broadcast_to(sizes.step, len(arm))[moving & (sizes.step > 0)]
    for unit, step in _ENCODERS if len(steps) >= _FEWEST_ENCODERS else ():
        if (np.abs(steps / step - 1) < 2e-3).all():
            text = (
                f"all values step by {steps[0]:.4g}, as an encoder of 4096 steps does in {unit}"
            )
            return Guess(unit, 0.97, text)
    inside = (steps > _RANGED[0]) & (steps < _RANGED[1])
    ranged = len(steps) >= _FEWEST_ENCODERS and inside.all()
    if ranged and is_hobby_arm(robot_type, labels) and np.ptp(steps) > 1e-2 * steps[0]:
        text = f"joints of different ranges step by {steps.min():.3g} to {steps.max():.3g}"
        return Guess("%", 0.95, text, "deg")
    most = np.median(peaks[moving])
    limit = next((x for x in (_TWO_TURNS, _DEGREES) if most <= x), math.inf)
    fitting = moving & (peaks <= limit)
    outliers = np.flatnonzero(moving & ~fitting).tolist()
    largest = float(peaks[fitting].max())
    reach = f"values usually reach {largest:.3g}"
    if limit == _TWO_TURNS:
        # Radians beyond a turn are rare; small values in degrees are not.
        guess = Guess("rad", 0.95 if largest <= math.tau + 0.1 else 0.7, reach, "deg")
        if largest == 1 and (sizes.clipped[fitting] > _CLIPPED).sum() > 1:
            guess = Guess("1", 0.5, "joints reach exactly 1, but never exceed it", "rad")
    elif limit == _DEGREES:
        guess = _degrees_or_range(sizes, fitting, largest, labels, robot_type)
    else:
        whole = bool(sizes.whole[fitting].all())
        sure = 0.8 if whole and largest < _TICKS else 0.4
        guess = Guess("tick", sure, reach, "mdeg" if whole else "deg")
    if not outliers:
        return guess
    beyond = ", ".join(f"{labels[i]} {peaks[i]:.3g}" for i in outliers)
    return guess._replace(
        confidence=0.3,
        evidence=f"{reach}, but not those of all joints ({beyond})",
        other="" if guess.unit == "deg" else "deg",
    )


def _degrees_or_range(
    sizes: Sizes,
    fitting: Bool[np.ndarray, " components"],
    largest: float,
    labels: Sequence[str],
    robot_type: str,
) -> Guess:
    """Guess whether values are degrees or LeRobot's -100..100 of a joint's range."""
    reach = f"values usually reach {largest:.3g}"
    hobby = is_hobby_arm(robot_type, labels)
    if largest > _CLIP + 0.05:
        return Guess("deg", 0.9 if hobby else 0.8, reach, "%")
    if (sizes.clipped[fitting] > _CLIPPED).any():
        share = 100 * float(sizes.clipped[fitting].max())
        return Guess(
            "%", 0.9, f"a joint is at exactly 100 in {share:.0f} % of the frames", "deg"
        )
    if hobby and any(label.lower().startswith("main_") for label in labels):
        # These names disappeared when LeRobot introduced -100..100 (lerobot 0.2, June 2025).
        return Guess("deg", 0.85, f"{reach}, the names are older than -100..100", "%")
    if hobby:
        return Guess("deg", 0.5, f"{reach}; this arm is recorded in both units", "%")
    return Guess("deg", 0.75, reach, "%")


def guess_fingers(
    sizes: Sizes,
    hand: Bool[np.ndarray, " components"],
    labels: Sequence[str],
    arm_unit: str,
    hobby: bool,
) -> list[str]:
    """Unit that each component has if it is a finger, from its size and the arm's unit."""
    # All fingers of a hand have the same unit, even those that move little.
    counted = hand & sizes.whole & (sizes.peak > _FINGER_RATIO) & (sizes.peak <= _BYTE)
    counted &= (sizes.peak[counted] > _PERCENT).any()
    slides = np.array(["finger" in label.lower() for label in labels])
    metres = slides & (sizes.peak > 0) & (sizes.peak <= _SLIDE)
    degrees = arm_unit == "deg"
    # LeRobot stores grippers as 0 to 100 even if the arm is in degrees.
    rules = (
        ("byte", counted),
        ("m", metres),
        ("1", sizes.peak <= _FINGER_RATIO),
        ("rad", (sizes.peak <= _TWO_TURNS) & (not hobby)),
        ("%", (sizes.peak <= _PERCENT) & (hobby or not degrees)),
        ("byte", (sizes.peak <= _BYTE) & (sizes.whole | (not degrees))),
    )
    return [next((u for u, holds in rules if holds[i]), arm_unit) for i in range(len(hand))]


def doubt_meaning(guess: Guess, sizes: Sizes, labels: Sequence[str], numbered: bool) -> Guess:
    """The guess, less certain if columns without clear names may not be joints at all.

    Args:
        guess: Guess of the unit, provided that the columns are joints.
        sizes: Sizes of all components.
        labels: Names of the columns.
        numbered: True if the dataset gives no names.
    """
    count, largest = len(sizes.peak), float(sizes.peak.max())
    named_alike = all(map(_MOTOR.fullmatch, labels))
    if numbered and guess.unit == "rad" and 1e-6 < largest < _REVOLUTIONS:
        guess = guess._replace(confidence=0.6, other="rev")
    if not (named_alike or numbered) or count > _POSE_AND_FINGERS:
        return guess
    last = float(sizes.peak[-1])
    if count > FEWEST_JOINTS and 1e-3 < last <= _SLIDE and largest > 10 * last:
        reason = f"the last column stays within {last:.2g}, as a gripper in m does"
    elif named_alike and count < FEWEST_JOINTS:
        reason = f"{count} columns are few for an arm"
    else:
        return guess
    text = (
        f"{guess.evidence}; names do not tell joints from a pose, and {reason}: a pose is "
        f"read with --mapping position KEY[0:3]"
    )
    return guess._replace(confidence=min(guess.confidence, 0.5), evidence=text)


def confirm(guess: Guess, si_unit: str, robot_type: str) -> Guess:
    """The guess, certain if one of our own robots recorded the values and they fit its unit."""
    if guess.unit != si_unit or not _OURS.fullmatch(robot_type):
        return guess
    return Guess(si_unit, STATED, f"{robot_type} records {si_unit}, {guess.evidence}")


def guess_by_size(role: str, sizes: Sizes) -> Guess:
    """Unit of an opening, a position or the angles of an orientation."""
    largest = float(sizes.peak.max())
    # Values of a gripper from 0 to 255 may be interpolated, but they end at 255.
    counts = bool(sizes.whole.all()) or abs(largest - 255) < 0.5
    _, unit, confidence, other = next(
        row for row in SIZES[role] if largest <= row[0] and (counts or row[1] != "byte")
    )
    return Guess(unit, confidence, f"values usually reach {largest:.3g}", other)
