"""What the columns of a dataset can mean: by their names, and in which units."""

import math
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from hrc_learn.demos.format.metadata import SIDECAR_PATH
from hrc_learn.demos.issue import DatasetError

# What a column of a dataset can mean to us, and in which unit we keep it.


@dataclass(frozen=True, kw_only=True)
class Role:
    """One meaning a group of columns can have."""

    width: int | None
    """Columns it takes; None: one a joint."""
    unit: str
    """Unit of the arrays in a `Demonstration`."""


ROLES: dict[str, Role] = {
    "time": Role(width=1, unit="s"),
    "joint_position": Role(width=None, unit="rad"),
    "joint_velocity": Role(width=None, unit="rad/s"),
    "joint_effort": Role(width=None, unit="N m"),
    "position": Role(width=3, unit="m"),
    "quaternion_wxyz": Role(width=4, unit="1"),
    "quaternion_xyzw": Role(width=4, unit="1"),
    "rotation_vector": Role(width=3, unit="rad"),
    "euler_xyz": Role(width=3, unit="rad"),
    "euler_intrinsic_xyz": Role(width=3, unit="rad"),
    "rotation_6d": Role(width=6, unit="1"),
    "pose_matrix": Role(width=16, unit="m"),
    "gripper": Role(width=1, unit="m"),
    "feature": Role(width=2, unit="px"),
    "feature_visible": Role(width=1, unit="1"),
    "human_effort": Role(width=None, unit="N m"),
    "command_position": Role(width=None, unit="rad"),
    "command_velocity": Role(width=None, unit="rad/s"),
}
"""Every role. `euler_xyz` is roll, pitch, yaw about the fixed axes x, y, z,
`euler_intrinsic_xyz` angles about the axes x, y, z as they turn along; `rotation_6d` the first
two columns of the rotation matrix, one after the other; `pose_matrix` a flattened 4x4
homogeneous transform."""

ORIENTATION_ROLES = (
    "quaternion_wxyz",
    "quaternion_xyzw",
    "rotation_vector",
    "euler_xyz",
    "euler_intrinsic_xyz",
    "rotation_6d",
    "pose_matrix",
)
"""The encodings of an orientation, preferred first."""

INDEX_KEYS = ("timestamp", "frame_index", "episode_index", "index", "task_index")
"""Columns that LeRobot keeps for itself."""


# What the name of a component says about its meaning.
#
# There is no single convention; these are the ones met in published datasets. Anything not
# recognised is left to the caller's explicit mapping.

JOINT_SUFFIXES = {
    "joint_position": ("pos", "position", "obs_pos", "cmd_pos", "qpos"),
    "joint_velocity": ("vel", "velocity", "obs_vel", "cmd_vel", "qvel"),
    "joint_effort": (
        "torque",
        "effort",
        "obs_torque",
        "obs_effort",
        "external_torque",
        "obs_external_torque",
    ),
    "human_effort": ("human_effort", "human_torque"),
}
"""`JOINT.SUFFIX`, as lerobot-record and the Franka plug-ins write them."""

_JOINT_PREFIXES = {"qpos": "joint_position", "qvel": "joint_velocity", "effort": "joint_effort"}

# `joint_1_vel`: only behind what is plainly a joint, since `ee_pos` or `x_vel` are none.
_UNDERSCORED = re.compile(
    r"(.*(?:joint|motor|axis)_?\w*|\w*j\d+|\w*_\d+)_([a-z]+)", re.IGNORECASE
)
_GRIPPER = re.compile(r"gripper|(?:^|[._/ ])(?:jaw|claw)(?:$|[._/ ])")
_HAND = re.compile(
    r"finger|thumb|pinky|knuckle|"
    r"(?:^|[._/ ])(?:hand|palm|index|middle|ring|little|claw|jaw|gripper)(?:$|[._/ \d])"
)
_CAMEL = re.compile(r"(?<=[a-z\d])(?=[A-Z])")
"""Between the words of a name like `kRightHandIndex`."""

_XYZ = {"x": 0, "y": 1, "z": 2}
_POSE_COMPONENTS = {
    **{name: ("position", slot) for name, slot in _XYZ.items()},
    **{f"p{name}": ("position", slot) for name, slot in _XYZ.items()},
    **{f"pos_{name}": ("position", slot) for name, slot in _XYZ.items()},
    **{f"w{name}": ("rotation_vector", slot) for name, slot in _XYZ.items()},
    **{f"r{name}": ("rotation_vector", slot) for name, slot in _XYZ.items()},
    **{f"q{name}": ("quaternion_wxyz", slot) for slot, name in enumerate("wxyz")},
    **{f"quat_{name}": ("quaternion_wxyz", slot) for slot, name in enumerate("wxyz")},
    **{f"euler_{name}": ("euler_xyz", slot) for name, slot in _XYZ.items()},
    **{f"rot6d_{slot}": ("rotation_6d", slot) for slot in range(6)},
    **{f"r6d_{slot}": ("rotation_6d", slot) for slot in range(6)},
    "roll": ("euler_xyz", 0),
    "pitch": ("euler_xyz", 1),
    "yaw": ("euler_xyz", 2),
}
_EE = re.compile(r"(?:ee|eef|tcp|end_effector)[._/](.+)")
_MATRIX = re.compile(r"(?:ee|eef|tcp)_(?:pose|matrix)[._](\d+)")

KEY_ROLES = {
    "joint_position": "joint_position|joint_positions|joint_pos|joints|qpos",
    "joint_velocity": "joint_velocity|joint_velocities|joint_vel|qvel|velocity",
    "joint_effort": "joint_effort|joint_efforts|joint_torque|joint_torques|torque|effort",
    "position": "(?:ee|eef|tcp)_(?:pos|position)",
    "rotation_vector": "(?:ee|eef|tcp)_(?:rotvec|axis_angle|rot_axis_angle)",
    "euler_xyz": "(?:ee|eef|tcp)_(?:euler|rpy)",
    "rotation_6d": "(?:ee|eef|tcp)_(?:rot6d|rotation_6d)",
    "quaternion_xyzw": "(?:ee|eef|tcp)_(?:quat|quaternion|orientation)",
    "cartesian": "cartesian_position|cartesian_pose|(?:ee|eef|tcp)_pose|(?:ee|eef|tcp)",
    "gripper": "gripper|gripper_position|gripper_width|gripper_pos",
    "feature": "image_feature",
    "human_effort": "human_effort",
    "time": "time|time_stamp|timestamp|stamp",
}
"""What the last part of a feature's key says of the whole feature."""


@dataclass(frozen=True)
class ComponentMeaning:
    """What one component stands for."""

    role: str
    slot: str | int
    """Joint name, or index of the component within its role."""


def meaning_of_component(name: str) -> ComponentMeaning | None:
    """What a name says on its own; None where it says nothing (a bare joint name, say)."""
    plain = name.strip().lower()
    matrix = _MATRIX.fullmatch(plain)
    if matrix:
        return ComponentMeaning("pose_matrix", int(matrix[1]))
    ee = _EE.fullmatch(plain)
    component = _POSE_COMPONENTS.get(ee[1] if ee else plain)
    if component:
        return ComponentMeaning(*component)
    stem, suffix = split_name(name.strip())
    roles = [role for role, names in JOINT_SUFFIXES.items() if suffix in names]
    if (ee and "gripper" in ee[1]) or (_GRIPPER.search(plain) and (not stem or roles)):
        # A gripper's velocity or force is of no use here and must not pass for its opening.
        if re.search(r"_(?:vel|velocity|torque|effort|force|current)$", plain):
            return None
        return ComponentMeaning("gripper", name) if roles in ([], ["joint_position"]) else None
    if stem and roles:
        return ComponentMeaning(roles[0], stem)
    prefix, _, number = plain.rpartition("_")
    if number.isdigit() and prefix in _JOINT_PREFIXES:
        return ComponentMeaning(_JOINT_PREFIXES[prefix], f"joint_{number}")
    return None


def split_name(name: str) -> tuple[str, str]:
    """Joint and quantity of a name such as `joint_1.pos` or `joint_1_vel`; "" for no joint."""
    stem, dot, suffix = name.rpartition(".")
    if not dot and (match := _UNDERSCORED.fullmatch(name)):
        known = any(match[2].lower() in names for names in JOINT_SUFFIXES.values())
        stem, suffix = (match[1], match[2]) if known else ("", name)
    return stem, suffix.lower()


def says_joint_quantity(name: str) -> bool:
    """Whether the name ends in a suffix of `JOINT_SUFFIXES`."""
    stem, suffix = split_name(name)
    return bool(stem) and any(suffix in names for names in JOINT_SUFFIXES.values())


def joint_of(name: str) -> str:
    """The joint that a component is of: its name without what is measured of it."""
    return split_name(name)[0] if says_joint_quantity(name) else name


def is_hand(name: str) -> bool:
    """Whether a joint is one of a hand or gripper by its name, not of the arm."""
    words = _CAMEL.sub("_", name.strip())
    return bool(_HAND.search(words.lower()))


def role_of_key(key: str) -> str | None:
    """What the key says of the whole feature; None for a state or action of mixed content."""
    last = re.split(r"[./]", key.lower())[-1]
    for role, pattern in KEY_ROLES.items():
        if re.fullmatch(pattern, last):
            return role
    return None


# Units of a dataset's values: declared, given, or guessed from their size.
#
# LeRobot declares none, and radians, degrees, encoder ticks and -100..100 all occur.

_DIMENSIONS: dict[str, dict[str, float]] = {
    "angle": {"rad": 1.0, "deg": math.pi / 180, "tick": 2 * math.pi / 4096},
    "angular velocity": {
        "rad/s": 1.0,
        "deg/s": math.pi / 180,
        "tick/s": 2 * math.pi / 4096,
    },
    "length": {"m": 1.0, "cm": 1e-2, "mm": 1e-3},
    "time": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9},
    "torque": {"N m": 1.0, "N mm": 1e-3},
    "pixels": {"px": 1.0},
    "ratio": {"1": 1.0, "%": 1e-2},
}
"""Dimension -> unit -> its size in the unit we keep. A tick is 1/4096 of a turn, as the
encoders of hobby servos count; where their zero lies is not known."""

# Two turns: wrists go past one, and no demonstration stays within 13 degrees.
_JOINT_LIMITS = {"rad": 4 * math.pi, "deg": 400.0}
# Further than an arm reaches that stands in one place.
_REACH = {"m": 5.0, "cm": 500.0}
# A turn and some noise; two of a vector that was unwrapped.
_ROTATION_LIMIT = {
    "euler_xyz": 2 * math.pi + 0.1,
    "euler_intrinsic_xyz": 2 * math.pi + 0.1,
    "rotation_vector": 4 * math.pi,
}

_FOLLOWERS = {
    "joint_velocity": "joint_position",
    "command_position": "joint_position",
    "command_velocity": "joint_position",
}
"""Quantities taken to be in the unit of another where nothing is said of them."""

_GUESSABLE = ("joint_position", "command_position", "position", "gripper", *_ROTATION_LIMIT)


@dataclass(frozen=True, kw_only=True)
class UnitDecision:
    """The unit of one quantity on disk, and how it is known."""

    role: str
    unit: str
    """That of its components, or of most of them."""
    units: tuple[str, ...] = ()
    """Unit of each component where they differ: an arm in degrees, its fingers from 0 to 1."""
    note: str | None = None
    """What was guessed and how to overrule it; None where nothing had to be."""
    converts: bool = False
    """Whether a guess changes the values."""
    confidence: float = 1.0
    """0 to 1."""
    evidence: str = ""
    """What speaks for a guess, in words."""

    @property
    def factor(self) -> float | Float64[np.ndarray, " components"]:
        """What values on disk are multiplied by: one number, or one for each component."""
        if not self.units:
            return unit_factor(self.role, self.unit)
        return np.array([unit_factor(self.role, unit) for unit in self.units])

    def unit_of(self, component: int) -> str:
        """Unit of one of its components."""
        return self.units[component] if self.units else self.unit


def unit_factor(role: str, unit: str) -> float:
    """Size of a unit in the one we keep for a quantity.

    Raises:
        DatasetError: The quantity is unknown, or does not come in this unit.
    """
    if role not in ROLES:
        raise DatasetError(
            f"units are given for the unknown quantity {role!r}; known are {', '.join(ROLES)}"
        )
    options = _options(role)
    if unit not in options:
        raise DatasetError(
            f"{role} does not come in {unit!r}; known units are {', '.join(options)}"
        )
    return options[unit]


def comes_in(role: str, unit: str) -> bool:
    """Whether a known quantity comes in a unit."""
    return unit in _options(role)


def _options(role: str) -> dict[str, float]:
    """The units of a quantity and their sizes."""
    own = ROLES[role].unit
    options = next(units for units in _DIMENSIONS.values() if own in units)
    if role in ("gripper", "joint_position", "command_position"):
        # Grippers and hands come as a share of their opening, hobby arms of their range.
        options = options | _DIMENSIONS["ratio"]
    return options


def decide_units(
    largest: Mapping[str, float | Sequence[float]],
    declared: Mapping[str, str | Sequence[str]],
    given: Mapping[str, str],
    frame_step: float = 1.0,
    hands: Mapping[str, Sequence[bool]] | None = None,
) -> dict[str, UnitDecision]:
    """Decide on a unit for every quantity.

    Args:
        largest: Usual largest absolute value of each quantity on disk, by role: of all, or of
            each component.
        declared: Units by role, or of each component, from the dataset's sidecar.
        given: Units by role from the caller; they win.
        frame_step: Step of the true stamps on disk, as a multiple of the nominal period [s].
        hands: Which components are fingers or grippers, by role; none where not given.

    Raises:
        DatasetError: A unit is unknown, or does not fit its quantity.
    """
    for role, unit in given.items():
        unit_factor(role, unit)
    for role, unit in declared.items():
        for one in (unit,) if isinstance(unit, str) else unit:
            try:
                unit_factor(role, one)
            except DatasetError as error:
                raise DatasetError(
                    str(error), file=SIDECAR_PATH, key=f"units.{role}"
                ) from error
    stated = {**declared, **given}
    decisions: dict[str, UnitDecision] = {}
    for role in sorted(largest, key=lambda role: role in _FOLLOWERS):
        if role in stated:
            decisions[role] = _stated(role, stated[role])
        elif (leader := decisions.get(_FOLLOWERS.get(role, ""))) is not None:
            decisions[role] = _following(role, leader)
        elif role == "time":
            decisions[role] = _guess_time(frame_step)
        elif role in _GUESSABLE:
            peaks = np.atleast_1d(np.asarray(largest[role], float))
            decisions[role] = _guess(role, peaks, (hands or {}).get(role, ()))
        else:
            decisions[role] = UnitDecision(role=role, unit=ROLES[role].unit)
    return decisions


def _following(role: str, leader: UnitDecision) -> UnitDecision:
    """In the unit of the leader, where it has one that the quantity comes in."""
    velocity = role.endswith("velocity")
    unit = leader.unit + "/s" if velocity else leader.unit
    # Of a share of the range, nothing is known of the speed.
    followed = leader.unit != "1" and comes_in(role, unit)
    return UnitDecision(
        role=role,
        unit=unit if followed else ROLES[role].unit,
        units=() if velocity else leader.units,
        confidence=leader.confidence,
        evidence=f"that of {leader.role}" if followed or not velocity else "",
    )


def _stated(role: str, unit: str | Sequence[str]) -> UnitDecision:
    if isinstance(unit, str):
        return UnitDecision(role=role, unit=unit)
    most = max(dict.fromkeys(unit), key=list(unit).count)
    return UnitDecision(role=role, unit=most, units=tuple(unit) if len({*unit}) > 1 else ())


def guessed_from_values(roles: Iterable[str], stated: Collection[str]) -> list[str]:
    """Quantities whose unit can only be told from the size of their values."""
    return [role for role in roles if role in _GUESSABLE and role not in stated]


# A share of a range, with noise about it; a gripper opens no wider than 0.2 m.
_RATIO, _WIDEST_RATIO, _PERCENT, _WIDEST_GRIPPER = 1.05, 2.0, 105.0, 0.2


def _guess(role: str, peaks: np.ndarray, hands: Sequence[bool]) -> UnitDecision:
    if role == "gripper":
        return _guess_gripper(float(peaks.max()))
    of_arm = ~np.asarray(hands, bool) if len(hands) == len(peaks) else np.ones(len(peaks), bool)
    largest = float(peaks[of_arm].max() if of_arm.any() else peaks.max())
    unit, certain = guess_unit(role, largest), 0.95
    units: tuple[str, ...] = ()
    if role in ("joint_position", "command_position"):
        units = tuple(
            unit if arm else _unit_of_finger(float(peak), unit)
            for peak, arm in zip(peaks, of_arm, strict=True)
        )
        # A joint within two turns of a degree says nothing; in radians all of them do.
        certain = 0.95 if largest <= 2 * math.pi else 0.8
    caution = {
        "deg": " (LeRobot's -100..100 look alike)" if role not in _ROTATION_LIMIT else "",
        "tick": " (1/4096 of a turn, zero unknown)",
    }.get(unit, "")
    if caution:
        certain = 0.5 if 95 <= largest <= 101 else 0.8
    others = sorted({*units} - {unit})
    besides = f", fingers for {', '.join(others)}" if others else ""
    return UnitDecision(
        role=role,
        unit=unit,
        units=units if others else (),
        note=(
            f"{role}: no unit declared, values usually reach {largest:.4g}: taken for "
            f"{unit}{caution}{besides}; overrule with units={{{role!r}: ...}}"
        ),
        converts=unit != ROLES[role].unit,
        confidence=certain,
        evidence=f"values usually reach {largest:.3g}",
    )


def guess_unit(role: str, largest: float) -> str:
    """The unit that values of this size are usually in."""
    if role == "position":
        return next((unit for unit, limit in _REACH.items() if largest <= limit), "mm")
    if role in _ROTATION_LIMIT:
        return "rad" if largest <= _ROTATION_LIMIT[role] else "deg"
    return next((unit for unit, limit in _JOINT_LIMITS.items() if largest <= limit), "tick")


def _unit_of_finger(peak: float, arm: str) -> str:
    """In radians beside an arm in them, unless its range is a share; degrees likewise."""
    if peak <= _RATIO:
        return "1"
    if peak <= _JOINT_LIMITS["rad"]:
        return "rad"
    return "%" if peak <= _PERCENT and arm != "deg" else arm


def _guess_gripper(largest: float) -> UnitDecision:
    limits = {"m": _WIDEST_GRIPPER, "1": _WIDEST_RATIO, "%": _PERCENT, "mm": math.inf}
    unit = next(unit for unit, limit in limits.items() if largest <= limit)
    factor = unit_factor("gripper", unit)
    note = (
        f"gripper: no unit declared, values usually reach {largest:.4g}: taken for {unit}; "
        f"overrule with units={{'gripper': ...}}"
    )
    return UnitDecision(
        role="gripper",
        unit=unit,
        note=note if factor != 1 else None,
        converts=factor != 1,
        confidence=0.8,
        evidence=f"values usually reach {largest:.3g}",
    )


def _guess_time(frame_step: float) -> UnitDecision:
    """The unit of stamps, from how far their step is off the frame rate."""
    sizes = _DIMENSIONS["time"]
    # Of a step of zero there is no logarithm.
    off = {unit: abs(math.log10(max(frame_step, 1e-3) * size)) for unit, size in sizes.items()}
    unit = min(off, key=off.__getitem__)
    if unit == "s":
        return UnitDecision(role="time", unit=unit)
    note = (
        f"time: no unit declared, steps are {frame_step:.3g} times 1/fps: taken for {unit}; "
        f"overrule with units={{'time': ...}}"
    )
    return UnitDecision(role="time", unit=unit, note=note, converts=True)
