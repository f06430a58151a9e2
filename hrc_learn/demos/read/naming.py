"""Meaning of the names of features and components, as they occur in published datasets.

There is no single convention: `names.toml` lists the known names. The caller must map unknown
names explicitly.
"""

import re
from dataclasses import dataclass
from pathlib import Path

from hrc_learn.store import read_toml

WORDS = read_toml(Path(__file__).with_name("names.toml"))
"""Content of `names.toml`."""

JOINT_SUFFIXES: dict[str, list[str]] = WORDS["joint_suffixes"]
"""Role -> suffixes in `JOINT.SUFFIX`, as lerobot-record and the Franka plug-ins write them."""

_JOINT_PREFIXES = {"qpos": "joint_position", "qvel": "joint_velocity", "effort": "joint_effort"}

# An underscore separates the quantity, as in `joint_1_vel`, only after a name that is clearly a
# joint: `ee_pos` and `x_vel` are no joints.
_UNDERSCORED = re.compile(
    r"(.*(?:joint|motor|axis|shoulder|elbow|wrist|waist|gripper)_?\w*|\w*j\d+|\w*_\d+)_([a-z]+)",
    re.IGNORECASE,
)
_GRIPPER = re.compile(
    r"gripper|(?:^|[._/ ])(?:jaw|claw|grip(?:_?(?:l|r|left|right))?)(?:$|[._/ ])"
)
_HAND = re.compile("|".join(WORDS["hand"]))
_CAMEL = re.compile(r"(?<=[a-z\d])(?=[A-Z])")
"""Word boundaries of a name such as `kRightHandIndex`."""

_UNITS: dict[str, str] = WORDS["units"]
"""Unit -> its spellings in names (regular expression)."""
_SPELLED = "|".join(f"(?P<u{i}>{spelled})" for i, spelled in enumerate(_UNITS.values()))
# A unit follows a separator or is in brackets; a number may follow: `q_deg`, `q (deg)`.
_UNIT_AT_END = re.compile(
    rf"(?P<stem>.*[^\W_]\)?)(?:[._/ -]+|\s*(?=[(\[]))[(\[]?(?:{_SPELLED})"
    rf"(?P<rate>/s|_?per_s(?:ec)?|_s|ps)?[)\]]?(?P<number>[._]?\d+)?",
    re.IGNORECASE,
)
_METRES = re.compile(r"(?:^|[._/ ])(?:p?[xyz]|pos|position|width|height|lift|opening)$")
"""Stems after which a single `m` is a unit, not a part of the name."""

_NO_JOINT = re.compile("|".join(WORDS["no_joint"]))


def _part(found: re.Match[str]) -> str:
    """Pattern that stands for {NAME} in other patterns."""
    pattern = WORDS["parts"][found[1]]
    return f"(?:{re.sub(_PART, _part, pattern)})"


_PART = r"\{([a-z]+)\}"
_NAMES = [
    (role, re.compile(re.sub(_PART, _part, "{before}" + rest)), table == "numbered")
    for table in ("components", "numbered")
    for role, rest in WORDS[table]
]
"""Role, pattern of the whole name, and True if the pattern applies only to names that contain a
word for the tool."""
_SLOTS = {"x": 0, "y": 1, "z": 2, "roll": 0, "pitch": 1, "yaw": 2}
_QUATERNION_SLOTS = {"w": 0, "x": 1, "y": 2, "z": 3}

_OF_TOOL = r"(?:ee|eef|tcp|tool\d*|end_?effector|flange)_(?:pose_)?"
KEY_ROLES = {role: key.replace("TOOL_", _OF_TOOL) for role, key in WORDS["keys"].items()}
"""Role of a whole feature -> last part of its key (regular expression)."""
_KEY_PREFIX = re.compile(r"(?:(?:robot\d*|arm\d*|states?|observations?|obs|left|right)_)+")


@dataclass(frozen=True)
class ComponentMeaning:
    """Role of one component, and its place within the role."""

    role: str
    """Role. Two values are no keys of `quantities.ROLES`: "quaternion" is a quaternion in
    unknown order, "rotation" an orientation in unknown encoding."""
    slot: str | int
    """Joint name, or index of the component."""
    side: str = ""
    """Arm of a robot with two arms, "left" or "right"; "" if the name states none."""


def without_unit(name: str) -> tuple[str, str]:
    """Name without its unit, and the unit; "" if the name states none."""
    match = _UNIT_AT_END.fullmatch(name.strip())
    if match is None:
        return name, ""
    unit = next(unit for i, unit in enumerate(_UNITS) if match[f"u{i}"])
    stem, number = match["stem"], (match["number"] or "").lstrip("._")
    bare = unit == "m" and "(" not in name and "[" not in name
    if bare and (number or not _METRES.search(stem.lower())):
        return name, ""
    return (f"{stem}_{number}" if number else stem), unit + ("/s" if match["rate"] else "")


def meaning_of_component(name: str) -> ComponentMeaning | None:
    """Meaning of a component by its name; None if the name alone does not show it."""
    name = without_unit(name)[0]
    plain = name.strip().lower()
    pose = _meaning_in_pose(plain)
    if pose is not None:
        return pose
    joint, role = joint_and_role(name.strip())
    of_tool = re.match(r"(?:ee|eef|tcp|end_effector)[._/](.+)", plain)
    if (of_tool and "gripper" in of_tool[1]) or (
        _GRIPPER.search(plain) and (not joint or role)
    ):
        # The velocity or force of a gripper must not be mistaken for its opening.
        if re.search(r"_(?:vel|velocity|torque|effort|force|current)$", plain):
            return None
        return ComponentMeaning("gripper", name) if role in ("", "joint_position") else None
    if joint and role:
        return ComponentMeaning(role, joint)
    prefix, _, number = plain.rpartition("_")
    if number.isdigit() and prefix in _JOINT_PREFIXES:
        return ComponentMeaning(_JOINT_PREFIXES[prefix], f"joint_{number}")
    return None


def _meaning_in_pose(plain: str) -> ComponentMeaning | None:
    """Meaning of a name in lower case as a component of a pose, or None."""
    words = re.sub(r"[^a-z\d]+", "_", plain).strip("_")
    for role, pattern, needs_tool in _NAMES:
        match = pattern.fullmatch(words)
        if match is None or (needs_tool and not match["tool"]):
            continue
        slots = _QUATERNION_SLOTS if role == "quaternion_wxyz" else _SLOTS
        slot = match["slot"]
        if role == "rotation" and not slot.isdigit():
            place: str | int = slot
        else:
            place = int(slot) if slot.isdigit() else slots[slot]
        return ComponentMeaning(role, place, match["side"] or match["side2"] or "")
    return None


def joint_and_role(name: str) -> tuple[str, str]:
    """Joint and role in a name such as `joint_1.pos` or `joint_1_vel`; "" if there is none."""
    stem, dot, suffix = without_unit(name)[0].rpartition(".")
    if not dot and (match := _UNDERSCORED.fullmatch(suffix)):
        stem, suffix = match.groups()
    suffix = suffix.lower()
    role = next((role for role, names in JOINT_SUFFIXES.items() if suffix in names), "")
    return (stem, role) if dot or role else ("", "")


def names_joint_quantity(name: str) -> bool:
    """True if the name is a joint with a suffix of `JOINT_SUFFIXES`."""
    return all(joint_and_role(name))


def joint_of(name: str) -> str:
    """Joint of a component: its name without its unit and the suffix of the quantity."""
    joint, role = joint_and_role(name)
    return joint if joint and role else without_unit(name)[0]


def is_hand(name: str) -> bool:
    """True if the name is that of a finger, hand or gripper joint."""
    words = _CAMEL.sub("_", name.strip())
    return bool(_HAND.search(words.lower()))


def names_no_joint(name: str) -> bool:
    """True if the name is that of an object, an image point, a mobile base or a sensor."""
    return bool(_NO_JOINT.search(_CAMEL.sub("_", name.strip()).lower()))


def role_of_key(key: str) -> str | None:
    """Role of a whole feature by its key; None for a state or action of mixed content."""
    last = without_unit(re.split(r"[./]", key)[-1])[0].lower()
    known = (last, _KEY_PREFIX.sub("", last, count=1))
    for role, pattern in KEY_ROLES.items():
        if any(re.fullmatch(pattern, name) for name in known):
            return role
    return None
