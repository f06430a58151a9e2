"""Columns that the caller names, instead of having them found by convention."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from .demonstration import JOINT_FIELDS
from .features import INFO_PATH, Feature
from .finding import DatasetError
from .naming import says_joint_quantity
from .roles import ROLES

MappingSpec = Mapping[str, str | Sequence[str] | None]
"""Role -> columns: a feature ("observation.qpos"), a range of one ("observation.state[0:7]"),
or component names (["j1.pos", "observation.state/j2.pos"]); None leaves the role out."""

_RANGE = re.compile(r"(.+)\[(\d*):?(\d*)\]")


@dataclass(frozen=True, kw_only=True)
class Selection:
    """Columns that hold one quantity."""

    role: str
    columns: tuple[tuple[str, int], ...]
    """Feature key and index of the component within it."""
    labels: tuple[str, ...]
    """Joint names for quantities that go by joints, names of components for others."""
    numbered: bool = False
    """Whether the dataset gave no names, so that the labels only count."""

    def only(self, labels: Sequence[str]) -> "Selection":
        """The columns of these labels, in this order."""
        place = dict(zip(self.labels, self.columns, strict=True))
        return Selection(
            role=self.role,
            columns=tuple(place[label] for label in labels),
            labels=tuple(labels),
            numbered=self.numbered,
        )


def parse_mapping(
    mapping: MappingSpec, features: Mapping[str, Feature]
) -> dict[str, Selection]:
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
        if columns is None:
            continue
        selections[role] = _selection(role, columns, features)
    return selections


def _selection(
    role: str, columns: str | Sequence[str], features: Mapping[str, Feature]
) -> Selection:
    if isinstance(columns, str):
        places = _feature_range(role, columns, features)
    else:
        places = [_component(role, name, features) for name in columns]
    width = ROLES[role].width
    if width is not None and len(places) != width:
        raise DatasetError(f"mapping gives {role} {len(places)} columns, it takes {width}")
    names = [features[key].names for key, _ in places]
    labels = tuple(
        f"joint_{n + 1}" if known is None else _label(known[index], role)
        for n, (known, (_, index)) in enumerate(zip(names, places, strict=True))
    )
    return Selection(
        role=role, columns=tuple(places), labels=labels, numbered=any(n is None for n in names)
    )


def _label(name: str, role: str) -> str:
    stem = role in JOINT_FIELDS and says_joint_quantity(name)
    return name.rpartition(".")[0] if stem else name


def _feature_range(
    role: str, text: str, features: Mapping[str, Feature]
) -> list[tuple[str, int]]:
    match = _RANGE.fullmatch(text)
    key = match[1] if match else text
    if key not in features:
        raise DatasetError(
            f"mapping takes {role} from a feature that does not exist; numeric features are "
            f"{', '.join(features)}",
            file=INFO_PATH,
            key=key,
        )
    indices = range(features[key].width)
    if match and ":" in text:
        indices = indices[int(match[2] or 0) : int(match[3]) if match[3] else None]
    elif match:
        indices = indices[int(match[2]) : int(match[2]) + 1]
    return [(key, index) for index in indices]


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
