"""Find the columns of a dataset that hold each quantity.

A quantity is named by its role, such as `joint_position` (see `quantities.ROLES`). The caller's
mapping comes first, then the contract or the sidecar file kept with the dataset (see
`contract`), then the naming conventions of `naming`. No column is assigned to a quantity by its
position alone.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from hrc_learn.demos.demonstration import JOINT_FIELDS
from hrc_learn.demos.issues import DatasetError
from hrc_learn.demos.read import naming
from hrc_learn.demos.read.dataset_files import INFO_PATH
from hrc_learn.demos.read.metadata import Feature
from hrc_learn.demos.read.naming import ComponentMeaning
from hrc_learn.demos.read.quantities import INDEX_KEYS, ORIENTATION_ROLES, ROLES

MappingSpec = Mapping[str, str | Sequence[str] | None]
"""Role -> columns: a feature ("observation.qpos"), part of a feature ("observation.state[0:7]")
or component names (["j1.pos", "observation.state/j2.pos"]); None leaves the role out."""

_RANGE = re.compile(r"(.+)\[([^\[\]]*)\]")
_BOUNDS = re.compile(r"(?=.)(\d{0,9})(:?)(\d{0,9})")
_STATE_KEY = re.compile(r"(?:observation\.)?(?:joint[._])?states?")
_ACTION_KEYS = ("action", "actions")
_COMMANDS = {"joint_position": "command_position", "joint_velocity": "command_velocity"}
_POSES = ("position", *ORIENTATION_ROLES)
_ORIENTATIONS = (*ORIENTATION_ROLES, "quaternion", "rotation")
_ASSUMED = naming.WORDS["assumed"]
# Pose features without component names: number of components -> encoding of the orientation
# that follows x, y, z; and a description of the assumed content, which is reported in a note.
_CARTESIAN = {
    6: ("euler_xyz", "x, y, z, roll, pitch, yaw"),
    7: ("quaternion_xyzw", "x, y, z, qx, qy, qz, qw"),
    9: ("rotation_6d", "x, y, z and two columns of a matrix"),
}


@dataclass(frozen=True, kw_only=True)
class ColumnSelection:
    """Columns that hold one quantity."""

    role: str
    columns: tuple[tuple[str, int], ...]
    """Feature key and index of the component, for each column."""
    labels: tuple[str, ...]
    """Joint names, or component names for quantities without joints."""
    numbered: bool = False
    """True if the dataset gives no names, so that the labels only number the columns."""
    units: tuple[str, ...] = ()
    """Unit in the name of each column, "" for none; () if no name states one."""
    assumed: str = ""
    """Assumption about the encoding, in words; "" if names or the caller state the encoding."""

    def column_name(self, number: int) -> str:
        """Feature and label of a column, for messages."""
        return f"{self.columns[number][0]} ({self.labels[number]})"


@dataclass(frozen=True, kw_only=True)
class ColumnMapping:
    """Meaning of the columns of a dataset."""

    selections: dict[str, ColumnSelection]
    """Columns by role."""
    joint_names: tuple[str, ...]
    extra: tuple[str, ...]
    """Numeric features with components that no role uses."""
    notes: tuple[str, ...]
    """Guesses and omissions, one sentence each."""
    unmatched: dict[str, str]
    """Role -> note, for quantities whose joints differ from `joint_names`."""


def map_columns(
    features: Mapping[str, Feature],
    mapping: MappingSpec | None = None,
    declared: Mapping[str, ColumnSelection] | None = None,
) -> ColumnMapping:
    """Find the quantities among the features.

    Args:
        features: Features declared by the dataset.
        mapping: Role -> columns, as in `load_demos`; None as columns leaves a role out.
        declared: Columns of quantities that the dataset declares. They replace all guesses.

    Raises:
        DatasetError: The mapping names a role or column that does not exist.
    """
    usable = {k: f for k, f in features.items() if f.numeric and k not in INDEX_KEYS}
    notes: list[str] = []
    found = _Conventions(notes).find(usable) if declared is None else dict(declared)
    replaced = replaced_roles(mapping or {})
    found = {role: selection for role, selection in found.items() if role not in replaced}
    found |= parse_mapping(mapping or {}, usable)
    names, aligned, unmatched = _align_joints(found)
    found = {role: _with_units(selection, usable) for role, selection in aligned.items()}
    taken = {column for selection in found.values() for column in selection.columns}
    extra = (
        key
        for key, feature in usable.items()
        if any((key, index) not in taken for index in range(feature.width))
    )
    return ColumnMapping(
        selections=found,
        joint_names=names,
        extra=tuple(extra),
        notes=tuple(notes),
        unmatched={role: _mismatch(role, joints, names) for role, joints in unmatched.items()},
    )


def _with_units(selection: ColumnSelection, features: Mapping[str, Feature]) -> ColumnSelection:
    """The selection with the units that the names of features and components state."""
    units = []
    for key, index in selection.columns:
        names = features[key].names
        unit = "" if names is None else naming.without_unit(names[index])[1]
        units.append(unit or naming.without_unit(re.split(r"[./]", key)[-1])[1])
    return replace(selection, units=tuple(units) if any(units) else ())


def _mismatch(role: str, joints: tuple[str, ...], names: tuple[str, ...]) -> str:
    """Message that a quantity has other joints than the other quantities, with the remedy."""
    if set(joints) < set(names):
        advice = ""
    elif len(joints) == len(names):
        advice = f". Leader and follower? --mapping {role} KEY pairs them in their order"
    else:
        advice = f". Name them alike, or map one of them (--mapping {role} KEY[0:7])"
    return (
        f"has the joints {', '.join(joints)}, the rest has {', '.join(names)}: "
        f"left among the extra columns{advice}"
    )


def replaced_roles(mapping: MappingSpec) -> set[str]:
    """Roles that a caller's mapping replaces.

    A mapping with one encoding of the orientation replaces all encodings.
    """
    return {*mapping} | ({*ORIENTATION_ROLES} if {*mapping} & {*ORIENTATION_ROLES} else set())


def parse_mapping(
    mapping: MappingSpec, features: Mapping[str, Feature]
) -> dict[str, ColumnSelection]:
    """Columns that a mapping names.

    Raises:
        DatasetError: A role or column does not exist, or a role's number of columns is wrong.
    """
    selections = {}
    for role, columns in mapping.items():
        if role not in ROLES:
            raise DatasetError(
                f"mapping names the unknown quantity {role!r}; known are {', '.join(ROLES)}"
            )
        if columns is not None:
            selections[role] = _named_selection(role, columns, features)
    return selections


def _named_selection(
    role: str, columns: str | Sequence[str], features: Mapping[str, Feature]
) -> ColumnSelection:
    texts = [columns] if isinstance(columns, str) else columns
    places = [p for text in texts for p in column_places(role, text, features, INFO_PATH)]
    if not places:
        raise DatasetError(f"mapping gives {role} no columns; None leaves it out")
    width = ROLES[role].width
    if width is not None and len(places) != width:
        raise DatasetError(f"mapping gives {role} {len(places)} columns, but it needs {width}")
    named, labels = [features[key].names for key, _ in places], []
    for number, (names, (_, index)) in enumerate(zip(named, places, strict=True), start=1):
        name = f"joint_{number}" if names is None else names[index]
        labels.append(naming.joint_of(name) if role in JOINT_FIELDS else name)
    return ColumnSelection(
        role=role, columns=tuple(places), labels=tuple(labels), numbered=None in named
    )


Components = Mapping[str, Any]
"""Features of a dataset, or fields of a recording: objects with a `width` and `names`."""


def column_places(
    role: str, text: str, features: Components, file: str | Path
) -> list[tuple[str, int]]:
    """Feature and component of each column that the caller's text stands for.

    The text may be a feature ("key", or the end of its path), a part of a feature ("key[2:5]",
    "key[3]"), or a component ("NAME" or "key/NAME").

    Args:
        role: Quantity to which the columns are assigned, for messages.
        text: The text.
        features: Features by key.
        file: File that declares the features, for messages.

    Raises:
        DatasetError: There is no such column, or there are several.
    """
    match = None if text in features else _RANGE.fullmatch(text)
    key = match[1] if match else text
    if key not in features:
        named = [
            (name, index)
            for name, feature in features.items()
            for index, known in enumerate(feature.names or ())
            if text in (known, f"{name}/{known}")
        ]
        if len(named) == 1:
            return named
        key = feature_key(role, key, features, file, [f"{name}/{text}" for name, _ in named])
    width = features[key].width
    first, stop = 0, width
    if match:
        bounds = _BOUNDS.fullmatch(match[2])
        first = int(bounds[1] or 0) if bounds else width
        stop = int(bounds[3] or width) if bounds and bounds[2] else first + 1
    if not first < stop <= width:
        text = (
            f"{text!r} for {role} is no range of the {width} components: write "
            f"[first:stop] or [index], counted from 0"
        )
        raise DatasetError(text, file=file, key=key)
    return [(key, index) for index in range(first, stop)]


def feature_key(
    role: str, text: str, features: Components, file: str | Path, components: Sequence[str] = ()
) -> str:
    """Feature with this key, or the only feature with a path that ends in it.

    Raises:
        DatasetError: No feature matches, or several features or components match.
    """
    if text in features:
        return text
    found = components or [key for key in features if key.endswith(f"/{text}")]
    if len(found) == 1:
        return found[0]
    if found:
        text = f"{text!r} for {role} is ambiguous: write one of {', '.join(found)}"
    else:
        words = [name for feature in features.values() for name in feature.names or ()]
        known = f"features {', '.join(features)}; components {', '.join(words) or 'none'}"
        text = f"there is no column {text!r} for {role}; there are {known}"
    raise DatasetError(text, file=file, key=role)


class _Conventions:
    """Search for quantities by the naming conventions of published datasets."""

    def __init__(self, notes: list[str]):
        self._notes = notes
        """List to which each assumption is added."""

    def find(self, features: Mapping[str, Feature]) -> dict[str, ColumnSelection]:
        self._commanded = {
            naming.joint_of(name)
            for feature in features.values()
            if feature.key in _ACTION_KEYS
            for name in feature.names or ()
            if (meant := naming.meaning_of_component(name)) is None or "joint" in meant.role
        }
        """Joints that an action names, without the gripper and the pose of the tool."""
        whole: dict[str, ColumnSelection] = {}
        by_component: dict[str, ColumnSelection] = {}
        # Features named after joints take precedence over a state of mixed content.
        for feature in sorted(features.values(), key=lambda f: "joint" not in f.key):
            meanings, known = self._whole_feature(feature), whole
            if meanings is None:
                meanings, known = self._components(feature), by_component
            for selection in self._grouped(feature, meanings):
                before = known.setdefault(selection.role, selection)
                apart = all(features[key].width == 1 for key, _ in before.columns)
                new = {*selection.labels}.isdisjoint(before.labels)
                if selection.role in JOINT_FIELDS and feature.width == 1 and apart and new:
                    # One feature for each joint.
                    columns = before.columns + selection.columns
                    labels = before.labels + selection.labels
                    known[selection.role] = replace(before, columns=columns, labels=labels)
        return by_component | whole

    def _whole_feature(self, feature: Feature) -> list[ComponentMeaning | None] | None:
        """Meanings of the components if the key of the feature states them; else None."""
        role, width = naming.role_of_key(feature.key), feature.width
        if role is None or (_is_command(feature) and role not in _COMMANDS):
            return None
        named = [naming.meaning_of_component(name) for name in feature.names or ()]
        if any(meaning and meaning.role in _ORIENTATIONS for meaning in named):
            return named
        if role == "cartesian" and width in (16, *_CARTESIAN):
            role = "pose_matrix"
        elif role == "cartesian" and width == 3:
            role = "position"
        elif role == "quaternion_xyzw" and width == 4:
            role = "quaternion"
        elif role == "gripper" and width == 2:  # two fingers, as in robomimic
            self._notes.append(f"{feature.key}: its first finger is taken for the gripper")
            return [ComponentMeaning(role, 0), None]
        elif role == "feature":
            point = [ComponentMeaning(role, 0), ComponentMeaning(role, 1)]
            visible = ComponentMeaning("feature_visible", 0) if width == 3 else None
            return [*point, *[visible] * (width - 2)][:width]
        elif role not in ROLES or ROLES[role].width not in (None, width):
            return None
        names = feature.names or tuple(f"joint_{k + 1}" for k in range(width))
        slots = map(naming.joint_of, names) if role in JOINT_FIELDS else range(width)
        return [ComponentMeaning(role, slot) for slot in slots]

    def _components(self, feature: Feature) -> list[ComponentMeaning | None]:
        """Meanings of the components of a mixed feature, such as `observation.state`."""
        mixed = bool(_STATE_KEY.fullmatch(feature.key)) or feature.key in _ACTION_KEYS
        names = feature.names
        if names is None:
            if not mixed:
                return []
            names = tuple(f"joint_{i + 1}" for i in range(feature.width))
            self._notes.append(
                f"{feature.key} names no components: taken for {feature.width} joints"
            )
        meanings = [naming.meaning_of_component(name) for name in names]
        if not mixed:
            # In other features x, y, z may belong to an object: only explicit names count.
            return [
                meaning
                if (naming.names_joint_quantity(name) and not naming.names_no_joint(name))
                or name.lower().startswith("ee")
                else None
                for name, meaning in zip(names, meanings, strict=True)
            ]
        usual = None if any(map(naming.names_joint_quantity, names)) else "joint_position"
        unknown = [name for name, known in zip(names, meanings, strict=True) if known is None]
        if unknown and usual is None:
            text = (
                "left out, as the names are unknown; --mapping joint_position names all joints"
            )
            self._notes.append(f"{feature.key}: {', '.join(unknown)} {text}")
        return [
            self._joint(feature, name, meaning)
            if (meaning.role if meaning else usual) == "joint_position"
            else meaning
            for name, meaning in zip(names, meanings, strict=True)
        ]

    def _joint(
        self, feature: Feature, name: str, meaning: ComponentMeaning | None
    ) -> ComponentMeaning | None:
        """Meaning of a component as a joint; None if names show that it is no joint.

        The joints that move are named in an action. A component of the state that no action
        names is therefore no joint.
        """
        joint = naming.joint_of(name)
        named = {naming.joint_of(other) for other in feature.names or ()}
        compared = not _is_command(feature) and bool(named & self._commanded)
        if naming.names_no_joint(name):
            reason = "its name is not that of a joint"
        elif compared and joint not in self._commanded:
            reason = "no action has it"
        else:
            return meaning or ComponentMeaning("joint_position", joint)
        self._notes.append(f"{feature.key} ({name}): no joint of the arm, {reason}")
        return None

    def _grouped(
        self, feature: Feature, meanings: Sequence[ComponentMeaning | None]
    ) -> Iterator[ColumnSelection]:
        """One selection for each role among the components."""
        groups: dict[tuple[str, str], dict[str | int, int]] = {}
        for index, meaning in enumerate(meanings):
            if meaning is not None:
                # If two fingers have the same name, the first counts.
                slots = groups.setdefault((meaning.role, meaning.side), {})
                if slots.setdefault(meaning.slot, index) < index and "joint" in meaning.role:
                    self._notes.append(f"{feature.key}: the second {meaning.slot} is left out")
        for role, side in [*groups]:
            if role == "pose_matrix" and len(groups[role, side]) in _CARTESIAN:
                # The components of this pose are only numbered, so their count decides on the
                # encoding.
                slots = groups.pop((role, side))
                encoding, content = _CARTESIAN[len(slots)]
                self._notes.append(f"{feature.key}: assumed to be {content}")
                groups["position", side] = {k: slots[k] for k in range(3)}
                groups[encoding, side] = {k - 3: slots[k] for k in range(3, len(slots))}
        first: dict[str, str] = {}
        for (role, side), slots in groups.items():
            named, role = role, self._encoding(feature, role, slots)
            sure = named == role != "rotation_6d" or "w" in slots
            assumed = "" if sure else f"{role}, by its width"
            if first.setdefault(role, side) != side:
                self._notes.append(
                    f"{feature.key}: one pose is read, that of the {first[role]} arm; the "
                    f"{side} one stays among the extra columns"
                )
                continue
            if _is_command(feature):
                if role not in _COMMANDS:
                    continue
                role = _COMMANDS[role]
            width = ROLES[role].width
            if width is not None and len(slots) != width:
                self._notes.append(
                    f"{feature.key}: {len(slots)} components look like {role}, which needs "
                    f"{width}; left among the extra columns"
                )
                continue
            order = sorted(slots, key=_slot) if role in _POSES else list(slots)
            yield ColumnSelection(
                role=role,
                columns=tuple((feature.key, slots[slot]) for slot in order),
                assumed=assumed if role in ORIENTATION_ROLES else "",
                labels=tuple(map(str, order)),
                numbered=feature.names is None,
            )

    def _encoding(self, feature: Feature, role: str, slots: Mapping[str | int, int]) -> str:
        """Encoding of a rotation, from its components; an assumed encoding is noted."""
        if role not in ("quaternion", "rotation", "rotation_6d"):
            return role
        known = {3: "rotation_vector", 6: "rotation_6d", 9: "rotation_matrix"}
        if {*slots} == {*"wxyz"}:
            return "quaternion_wxyz"
        found = known.get(len(slots), "quaternion_xyzw")
        if found in _ASSUMED:
            self._notes.append(f"{feature.key}: assumed to be a {_ASSUMED[found]}")
        return found


def _slot(slot: str | int) -> int:
    """Index of a component in its role: its number, or its place in w, x, y, z."""
    return slot if isinstance(slot, int) else "wxyz".find(slot)


def _is_command(feature: Feature) -> bool:
    return feature.key.startswith(("action.", "action/")) or feature.key in _ACTION_KEYS


def _align_joints(
    found: dict[str, ColumnSelection],
) -> tuple[tuple[str, ...], dict[str, ColumnSelection], dict[str, tuple[str, ...]]]:
    """Bring all quantities with one column per joint into the order of the first such quantity.

    Returns:
        Joint names; selections in the order of these names; and, for quantities with other
        joints, role -> joints.
    """
    joints = [found[role] for role in JOINT_FIELDS if role in found]
    if not joints:
        return (), found, {}
    names, numbered = joints[0].labels, joints[0].numbered
    if numbered:  # prefer the names of another quantity
        named = (s.labels for s in joints if not s.numbered and len(s.labels) == len(names))
        names = next(named, names)
    aligned, unmatched = {}, {}
    for role, selection in found.items():
        if role not in JOINT_FIELDS or selection.labels == names:
            aligned[role] = selection
        elif set(selection.labels) >= set(names):
            place = dict(zip(selection.labels, selection.columns, strict=True))
            columns = tuple(place[label] for label in names)
            aligned[role] = replace(selection, columns=columns, labels=names)
        elif len(selection.labels) == len(names) and (selection.numbered or numbered):
            aligned[role] = replace(selection, labels=names)
        else:
            unmatched[role] = selection.labels
    return names, aligned, unmatched
