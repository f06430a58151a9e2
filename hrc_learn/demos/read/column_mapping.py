"""Which columns of a dataset hold which quantity: found by convention, or named by the
caller.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from hrc_learn.demos.demonstration import JOINT_FIELDS
from hrc_learn.demos.format.metadata import INFO_PATH, SIDECAR_PATH, Feature, Sidecar
from hrc_learn.demos.issue import DatasetError
from hrc_learn.demos.read.roles import (
    INDEX_KEYS,
    ORIENTATION_ROLES,
    ROLES,
    ComponentMeaning,
    joint_of,
    meaning_of_component,
    role_of_key,
    says_joint_quantity,
)

# Columns that the caller names, instead of having them found by convention.

MappingSpec = Mapping[str, str | Sequence[str] | None]
"""Role -> columns: a feature ("observation.qpos"), a range of one ("observation.state[0:7]"),
or component names (["j1.pos", "observation.state/j2.pos"]); None leaves the role out."""

_RANGE = re.compile(r"(.+)\[([^\[\]]*)\]")
_BOUNDS = re.compile(r"(\d{1,9})|(\d{0,9}):(\d{0,9})")


@dataclass(frozen=True, kw_only=True)
class ColumnSelection:
    """Columns that hold one quantity."""

    role: str
    columns: tuple[tuple[str, int], ...]
    """Feature key and index of the component within it."""
    labels: tuple[str, ...]
    """Joint names for quantities that go by joints, names of components for others."""
    numbered: bool = False
    """Whether the dataset gave no names, so that the labels only count."""

    def only(self, labels: Sequence[str]) -> "ColumnSelection":
        """The columns of these labels, in this order."""
        place = dict(zip(self.labels, self.columns, strict=True))
        return ColumnSelection(
            role=self.role,
            columns=tuple(place[label] for label in labels),
            labels=tuple(labels),
            numbered=self.numbered,
        )


def parse_mapping(
    mapping: MappingSpec, features: Mapping[str, Feature]
) -> dict[str, ColumnSelection]:
    """The columns a mapping asks for.

    Raises:
        DatasetError: A role or a column does not exist, or a role gets too many or too few.
    """
    selections = {}
    for role, columns in mapping.items():
        if role not in ROLES:
            raise DatasetError(
                f"mapping names the unknown quantity {role!r}; known are {', '.join(ROLES)}"
            )
        if columns is not None:
            selections[role] = _selection(role, columns, features)
    return selections


def _selection(
    role: str, columns: str | Sequence[str], features: Mapping[str, Feature]
) -> ColumnSelection:
    if isinstance(columns, str):
        places = _feature_range(role, columns, features)
    else:
        places = [_component(role, name, features) for name in columns]
    if not places:
        raise DatasetError(f"mapping gives {role} no columns; None leaves it out")
    width = ROLES[role].width
    if width is not None and len(places) != width:
        raise DatasetError(f"mapping gives {role} {len(places)} columns, it takes {width}")
    names = [features[key].names for key, _ in places]
    labels = tuple(
        f"joint_{n + 1}" if known is None else _label(known[index], role)
        for n, (known, (_, index)) in enumerate(zip(names, places, strict=True))
    )
    return ColumnSelection(
        role=role, columns=tuple(places), labels=labels, numbered=any(n is None for n in names)
    )


def _label(name: str, role: str) -> str:
    return joint_of(name) if role in JOINT_FIELDS else name


def _feature_range(
    role: str, text: str, features: Mapping[str, Feature]
) -> list[tuple[str, int]]:
    match = None if text in features else _RANGE.fullmatch(text)
    key = match[1] if match else text
    if key not in features:
        raise DatasetError(
            f"mapping takes {role} from a feature that does not exist; numeric features are "
            f"{', '.join(features)}",
            file=INFO_PATH,
            key=key,
        )
    width = features[key].width
    first, stop = _bounds(match[2], width) if match else (0, width)
    if not first < stop <= width:
        raise DatasetError(
            f"mapping takes {role} from {text!r}, which is no range of its {width} components: "
            f"write [first:stop] or [index], counted from 0",
            file=INFO_PATH,
            key=key,
        )
    return [(key, index) for index in range(first, stop)]


def _bounds(text: str, width: int) -> tuple[int, int]:
    """First component of a range and the one behind its last; an empty one of other texts."""
    match = _BOUNDS.fullmatch(text)
    if match is None:
        return 0, 0
    if match[1]:
        return int(match[1]), int(match[1]) + 1
    return int(match[2] or 0), int(match[3] or width)


def _component(role: str, name: str, features: Mapping[str, Feature]) -> tuple[str, int]:
    key, slash, component = name.partition("/")
    places = [
        (feature.key, index)
        for feature in features.values()
        for index, known in enumerate(feature.names or ())
        if (feature.key, known) == (key, component) or (not slash and known == name)
    ]
    if not places:
        known = ", ".join(n for feature in features.values() for n in feature.names or ())
        raise DatasetError(
            f"mapping takes {role} from a component that does not exist; named components "
            f"are {known or 'none'}",
            file=INFO_PATH,
            key=name,
        )
    if len(places) > 1:
        options = ", ".join(f"{key}/{name}" for key, _ in places)
        raise DatasetError(f"mapping for {role} is ambiguous: write one of {options}", key=name)
    return places[0]


# Which columns of a dataset hold which quantity.
#
# Columns are found by name, in this order: the caller's mapping, the sidecar that our writer
# leaves, the conventions of `naming`. Nothing is taken for a quantity by position alone.

_STATE_KEYS = ("observation.state", "observation.states", "state", "states")
_ACTION_KEYS = ("action", "actions")
_COMMANDS = {"joint_position": "command_position", "joint_velocity": "command_velocity"}


@dataclass(frozen=True, kw_only=True)
class ColumnMapping:
    """What the columns of a dataset mean."""

    selections: dict[str, ColumnSelection]
    """By role."""
    joint_names: tuple[str, ...]
    extra: tuple[str, ...]
    """Numeric features with components that no role took."""
    notes: tuple[str, ...]
    """What had to be guessed or left out."""
    unmatched: dict[str, tuple[str, ...]]
    """Quantities of other joints than `joint_names`: role -> their joints."""


def map_columns(
    features: Mapping[str, Feature],
    sidecar: Sidecar,
    mapping: MappingSpec | None = None,
    kept: Mapping[str, ColumnSelection] | None = None,
) -> ColumnMapping:
    """Find the quantities among the features.

    Args:
        features: As declared by the dataset.
        sidecar: What our own writer declared; its columns spare all guessing.
        mapping: Role -> columns, as in `load_demos`; a role given None is left out.
        kept: Columns by a contract that is kept with the dataset; spares all guessing.

    Raises:
        DatasetError: The mapping names a role or column that does not exist, or what the
            sidecar says of units and columns is malformed.
    """
    _refuse_malformed(sidecar)
    usable = {
        key: feature
        for key, feature in features.items()
        if feature.numeric and key not in INDEX_KEYS
    }
    notes: list[str] = []
    if kept is not None:
        found = dict(kept)
    elif sidecar.columns:
        declared = {
            role: [f"{column['key']}/{name}" for name in column["names"]]
            for role, column in sidecar.columns.items()
        }
        found = parse_mapping(declared, usable)
    else:
        found = _by_convention(usable, notes)
    dropped = {*(mapping or {})}
    if dropped & {*ORIENTATION_ROLES}:  # one encoding takes the place of all
        dropped |= {*ORIENTATION_ROLES}
    found = {role: selection for role, selection in found.items() if role not in dropped}
    found |= parse_mapping(mapping or {}, usable)
    names, found, unmatched = _align_joints(found)
    notes.extend(
        f"{role} is of other joints ({', '.join(others)}) than the rest ({', '.join(names)}); "
        f"left among the extra columns"
        for role, others in unmatched.items()
    )
    taken = {column for selection in found.values() for column in selection.columns}
    extra = [
        key
        for key, feature in usable.items()
        if any((key, index) not in taken for index in range(feature.width))
    ]
    return ColumnMapping(
        selections=found,
        joint_names=names,
        extra=tuple(extra),
        notes=tuple(notes),
        unmatched=unmatched,
    )


def _refuse_malformed(sidecar: Sidecar) -> None:
    """Refuse units and columns that are not of the form that our writer gives them."""
    for name in ("units", "columns"):
        if not isinstance(content := getattr(sidecar, name), dict):
            raise DatasetError(
                f"must be an object, got {content!r}; edit it", file=SIDECAR_PATH, key=name
            )
    for role, unit in sidecar.units.items():
        if not isinstance(unit, str):
            raise DatasetError(
                f"must be text, got {unit!r}; edit it", file=SIDECAR_PATH, key=f"units.{role}"
            )
    for role, column in sidecar.columns.items():
        told = column if isinstance(column, dict) else {}
        if not isinstance(told.get("key"), str) or not _are_texts(told.get("names")):
            raise DatasetError(
                'must hold a "key", a feature, and "names", a list of its components; edit it',
                file=SIDECAR_PATH,
                key=f"columns.{role}",
            )


def _are_texts(names: object) -> bool:
    return isinstance(names, list) and all(isinstance(name, str) for name in names)


def _by_convention(
    features: Mapping[str, Feature], notes: list[str]
) -> dict[str, ColumnSelection]:
    whole: dict[str, ColumnSelection] = {}
    by_component: dict[str, ColumnSelection] = {}
    for feature in features.values():
        selections = _of_whole_feature(feature, notes)
        known = whole if selections else by_component
        for selection in selections or _of_components(feature, notes):
            known.setdefault(selection.role, selection)
    return by_component | whole


def _of_whole_feature(feature: Feature, notes: list[str]) -> list[ColumnSelection]:
    """Selections of a feature whose key says what it is, [] for all others."""
    role = role_of_key(feature.key)
    if role is None or (_is_command(feature) and role not in _COMMANDS):
        return []
    named = [meaning_of_component(name) for name in feature.names or ()]
    if any(meaning and meaning.role in ORIENTATION_ROLES for meaning in named):
        return _grouped(feature, named, notes)
    indices = range(feature.width)
    if role == "cartesian":
        return _cartesian(feature, notes)
    if role == "feature":
        visible = [_select("feature_visible", feature, [2])] if feature.width == 3 else []
        return [_select("feature", feature, indices[:2]), *visible]
    if role == "quaternion_xyzw" and feature.width == 4:
        notes.append(f"{feature.key}: assumed to be a quaternion in the order x, y, z, w")
    width = ROLES[role].width
    if width is not None and width != feature.width:
        return []
    if _is_command(feature):
        role = _COMMANDS[role]
    return [_select(role, feature, indices)]


def _cartesian(feature: Feature, notes: list[str]) -> list[ColumnSelection]:
    """A pose in one feature without telling names: told apart by its width."""
    indices = range(feature.width)
    position = _select("position", feature, indices[:3])
    match feature.width:
        case 3:
            return [position]
        case 6:
            notes.append(f"{feature.key}: assumed to be x, y, z, roll, pitch, yaw")
            return [position, _select("euler_xyz", feature, indices[3:])]
        case 7:
            notes.append(f"{feature.key}: assumed to be x, y, z, qx, qy, qz, qw")
            return [position, _select("quaternion_xyzw", feature, indices[3:])]
        case 9:
            notes.append(f"{feature.key}: assumed to be x, y, z and two columns of a matrix")
            return [position, _select("rotation_6d", feature, indices[3:])]
        case 16:
            return [_select("pose_matrix", feature, indices)]
    return []


def _of_components(feature: Feature, notes: list[str]) -> list[ColumnSelection]:
    """Selections of a feature of mixed content, such as `observation.state`."""
    mixed = feature.key in (*_STATE_KEYS, *_ACTION_KEYS)
    names = feature.names
    if names is None:
        if not mixed:
            return []
        names = tuple(f"joint_{i + 1}" for i in range(feature.width))
        notes.append(f"{feature.key} names no components: taken for {feature.width} joints")
    meanings = [meaning_of_component(name) for name in names]
    if not mixed:
        # Elsewhere x, y, z may be of an object: only names that say more count.
        meanings = [
            meaning if says_joint_quantity(name) or name.lower().startswith("ee") else None
            for name, meaning in zip(names, meanings, strict=True)
        ]
    elif not any(map(says_joint_quantity, names)):
        meanings = [
            meaning or ComponentMeaning("joint_position", name)
            for name, meaning in zip(names, meanings, strict=True)
        ]
    return _grouped(feature, meanings, notes)


def _grouped(
    feature: Feature, meanings: Sequence[ComponentMeaning | None], notes: list[str]
) -> list[ColumnSelection]:
    groups: dict[str, dict[str | int, int]] = {}
    for index, meaning in enumerate(meanings):
        if meaning is not None:
            groups.setdefault(meaning.role, {})[meaning.slot] = index
    selections = []
    for role, slots in groups.items():
        if _is_command(feature):
            if role not in _COMMANDS:
                continue
            role = _COMMANDS[role]
        width = ROLES[role].width
        if width is not None and len(slots) != width:
            notes.append(
                f"{feature.key}: {len(slots)} components look like {role}, which takes "
                f"{width}; left among the extra columns"
            )
            continue
        order = sorted(slots) if role in _POSES else list(slots)
        labels = tuple(map(str, order))
        columns = tuple((feature.key, slots[slot]) for slot in order)
        selections.append(
            ColumnSelection(
                role=role, columns=columns, labels=labels, numbered=feature.names is None
            )
        )
    return selections


_POSES = ("position", *ORIENTATION_ROLES)


def _select(role: str, feature: Feature, indices: Sequence[int]) -> ColumnSelection:
    names = feature.names or tuple(f"joint_{i + 1}" for i in range(feature.width))
    labels = tuple(joint_of(names[i]) for i in indices)
    columns = tuple((feature.key, index) for index in indices)
    return ColumnSelection(
        role=role, columns=columns, labels=labels, numbered=feature.names is None
    )


def _is_command(feature: Feature) -> bool:
    return feature.key.startswith(("action.", "action/")) or feature.key in _ACTION_KEYS


def _align_joints(
    found: dict[str, ColumnSelection],
) -> tuple[tuple[str, ...], dict[str, ColumnSelection], dict[str, tuple[str, ...]]]:
    """Bring every quantity that goes by joints into the order of the first such one.

    Returns:
        The joints, the quantities in their order, and the joints of those that have others.
    """
    first = next((found[role] for role in JOINT_FIELDS if role in found), None)
    if first is None:
        return (), found, {}
    aligned, unmatched = {}, {}
    for role, selection in found.items():
        if role not in JOINT_FIELDS or selection.labels == first.labels:
            aligned[role] = selection
        elif set(selection.labels) >= set(first.labels):
            aligned[role] = selection.only(first.labels)
        elif len(selection.labels) == len(first.labels) and (
            selection.numbered or first.numbered
        ):
            aligned[role] = replace(selection, labels=first.labels)
        else:
            unmatched[role] = selection.labels
    return _joint_names(first, aligned), aligned, unmatched


def _joint_names(
    first: ColumnSelection, aligned: Mapping[str, ColumnSelection]
) -> tuple[str, ...]:
    if not first.numbered:
        return first.labels
    named = [s for role, s in aligned.items() if role in JOINT_FIELDS and not s.numbered]
    return named[0].labels if named else first.labels
