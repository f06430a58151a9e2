"""What every column of a dataset means: inferred once from all its episodes, kept beside it.

LeRobot declares neither units nor meanings. A contract states, component by component, the
role, unit, range, sign and delay, with the evidence for each and how sure it is. It is kept in
`meta/hrc_learn.json`, may be edited there, and whatever reads the dataset obeys it.
"""

import hashlib
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import MISSING, asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from hrc_learn.demos.format.dataset_folder import DatasetFolder, open_folder
from hrc_learn.demos.format.metadata import (
    SIDECAR_FORMAT,
    SIDECAR_PATH,
    Feature,
    Sidecar,
    read_sidecar,
    write_json,
)
from hrc_learn.demos.issue import DatasetError, plain_text
from hrc_learn.demos.read.column_mapping import ColumnMapping, ColumnSelection
from hrc_learn.demos.read.profiles import EpisodeProfile, Tracking, is_discrete
from hrc_learn.demos.read.roles import (
    INDEX_KEYS,
    ROLES,
    UnitDecision,
    comes_in,
    is_hand,
    joint_of,
)
from hrc_learn.store import new_file

_READ_AS = {
    "arm": "joint_position",
    "finger": "joint_position",
    "velocity": "joint_velocity",
    "effort": "joint_effort",
    "command": "command_position",
    "finger command": "command_position",
    "velocity command": "command_velocity",
    "gripper command": None,
    "flag": None,
    "constant": None,
    "other": None,
}
"""Role in a contract -> quantity of a demonstration; further roles are called alike in both."""

CONTRACT_ROLES = (*_READ_AS, *(role for role in ROLES if role not in _READ_AS.values()))
"""What a component can be."""


@dataclass(frozen=True, kw_only=True)
class ComponentContract:
    """What one component of one feature means."""

    key: str
    index: int
    name: str
    role: str
    """One of `CONTRACT_ROLES`."""
    unit: str
    """On disk; "" where none is known."""
    low: float
    """Half a percent of all values lie below."""
    high: float
    """Half a percent of all values lie above."""
    sign: int = 0
    """+1 or -1: which way the state goes when this command grows; 0 where unknown."""
    delay: float | None = None
    """Time until the state follows this command [s]; None where unknown."""
    confidence: float = 1.0
    """0 to 1."""
    evidence: str = ""
    """In words."""


@dataclass(frozen=True, kw_only=True)
class Contract:
    """What the components of a dataset mean."""

    components: tuple[ComponentContract, ...]
    fingerprint: str
    """Of the data that it was inferred from."""

    def rows(self) -> list[tuple[str, ...]]:
        """The contract as a table, its head first; components alike in role and unit that
        follow each other in one feature share a row.
        """
        rows = [("column", "role", "unit", "range", "sign", "delay", "sure", "evidence")]
        groups: list[list[ComponentContract]] = []
        for part in self.components:
            last = groups[-1][-1] if groups else None
            alike = last and all(
                getattr(part, name) == getattr(last, name)
                for name in ("key", "role", "unit", "sign", "delay")
            )
            if alike:
                groups[-1].append(part)
            else:
                groups.append([part])
        for group in groups:
            first, last = group[0], group[-1]
            name = first.name if len(group) == 1 else f"{first.name} .. {last.name}"
            low, high = min(p.low for p in group), max(p.high for p in group)
            weakest = min(group, key=lambda part: part.confidence)
            rows.append(
                (
                    plain_text(f"{first.key}/{name}"),
                    first.role,
                    first.unit or "-",
                    f"{low:.3g} .. {high:.3g}",
                    {1: "+", -1: "-", 0: ""}[first.sign],
                    "" if first.delay is None else f"{1e3 * first.delay:.0f} ms",
                    f"{100 * weakest.confidence:.0f} %",
                    weakest.evidence,
                )
            )
        return rows

    def lines(self) -> Iterator[str]:
        """The table as text."""
        rows = self.rows()
        widths = [max(len(row[i]) for row in rows) for i in range(7)]
        for row in rows:
            cells = (f"{cell:{w}}" for cell, w in zip(row, widths, strict=False))
            yield f"{'  '.join(cells)}  {row[-1]}".rstrip()

    def units(self, selections: Mapping[str, ColumnSelection]) -> dict[str, tuple[str, ...]]:
        """Quantity -> unit of each of its components.

        Args:
            selections: The columns of each quantity; one with a column of unknown unit is left
                out.
        """
        known = {(part.key, part.index): part for part in self.components}
        units = {
            role: tuple(_unit_as(role, known.get(place)) for place in selection.columns)
            for role, selection in selections.items()
        }
        return {role: of_role for role, of_role in units.items() if all(of_role)}

    def selections(self, features: Mapping[str, Feature]) -> dict[str, ColumnSelection]:
        """The columns of each quantity.

        Raises:
            DatasetError: A component does not exist, or a quantity has too many or too few.
        """
        found: dict[str, list[ComponentContract]] = {}
        for part in self.components:
            role = _quantity(part)
            feature = features.get(part.key)
            if feature is None or part.index >= feature.width:
                raise _faulty(f"{part.key}/{part.name} is no component of the dataset")
            if role is not None:
                found.setdefault(role, []).append(part)
        for role, parts in found.items():
            width = ROLES[role].width
            if width is not None and len(parts) != width:
                raise _faulty(f"{role} has {len(parts)} components, it takes {width}")
        return {
            role: ColumnSelection(
                role=role,
                columns=tuple((part.key, part.index) for part in parts),
                labels=tuple(joint_of(part.name) for part in parts),
                numbered=features[parts[0].key].names is None,
            )
            for role, parts in found.items()
        }


def _quantity(part: ComponentContract) -> str | None:
    """The quantity of a demonstration that a component is read as."""
    return _READ_AS.get(part.role, part.role)


def _unit_as(role: str, part: ComponentContract | None) -> str:
    """Unit of a component that is read as this quantity; "" where none is known."""
    if part is None:
        return ""
    if _quantity(part) == role:
        return part.unit or ROLES[role].unit
    return part.unit if comes_in(role, part.unit) else ""


def _faulty(message: str, place: str = "contract") -> DatasetError:
    return DatasetError(f"{message}; edit it", file=SIDECAR_PATH, key=place)


def contract_of(sidecar: Sidecar) -> Contract | None:
    """The contract that is kept with a dataset; None where there is none.

    Raises:
        DatasetError: It is damaged, or names a role that does not exist.
    """
    if not sidecar.contract:
        return None
    content: object = sidecar.contract
    if not isinstance(content, dict):
        raise _faulty(f"must be an object, got {content!r}")
    components, of_data = content.get("components"), content.get("fingerprint")
    if not isinstance(components, list):
        raise _faulty(f"must be a list, got {components!r}", "contract.components")
    if not isinstance(of_data, str):
        raise _faulty(f"must be text, got {of_data!r}", "contract.fingerprint")
    parts: dict[tuple[str, int], ComponentContract] = {}
    for number, entry in enumerate(components):
        place = f"contract.components[{number}]"
        part = _component(entry, place)
        if (part.key, part.index) in parts:
            raise _faulty(f"is of component {part.index} of {part.key}, as one before", place)
        parts[part.key, part.index] = part
    return Contract(components=tuple(parts.values()), fingerprint=of_data)


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


_TEXT = ("text", lambda value: isinstance(value, str))
_NUMBER = ("a number", _is_number)
_FIELDS: dict[str, tuple[str, Callable[[Any], bool]]] = {
    "key": _TEXT,
    "index": ("a whole number of at least 0", lambda value: type(value) is int and value >= 0),
    "name": _TEXT,
    "role": _TEXT,
    "unit": _TEXT,
    "low": _NUMBER,
    "high": _NUMBER,
    "sign": ("-1, 0 or 1", lambda value: _is_number(value) and value in (-1, 0, 1)),
    "delay": ("a number or null", lambda value: value is None or _is_number(value)),
    "confidence": _NUMBER,
    "evidence": _TEXT,
}
"""Field of a `ComponentContract` -> what it must be, in words and as a test."""


def _component(entry: object, place: str) -> ComponentContract:
    """One component from its JSON object, which somebody may have edited."""
    if not isinstance(entry, dict):
        raise _faulty(f"must be an object, got {entry!r}", place)
    required = [f.name for f in fields(ComponentContract) if f.default is MISSING]
    missing = [name for name in required if name not in entry]
    unknown = [name for name in entry if name not in _FIELDS]
    if missing or unknown:
        fault = f"lacks {missing[0]}" if missing else f"has the unknown field {unknown[0]!r}"
        raise _faulty(fault, place)
    for name, value in entry.items():
        wanted, fits = _FIELDS[name]
        if not fits(value):
            raise _faulty(f"{name} must be {wanted}, got {value!r}", place)
    part = ComponentContract(**entry)
    if part.role not in CONTRACT_ROLES:
        known = ", ".join(CONTRACT_ROLES)
        raise _faulty(
            f"{part.name} has the unknown role {part.role!r}; known are {known}", place
        )
    return part


def keep_contract(root: Path, contract: Contract) -> None:
    """Write the contract beside the data; what else the file says stays."""
    sidecar = replace(read_sidecar(root), contract=contract_content(contract))
    with new_file(root / SIDECAR_PATH) as part:
        write_json(part, {"format": SIDECAR_FORMAT, **vars(sidecar)})


def contract_content(contract: Contract) -> dict[str, Any]:
    """The contract as JSON values."""
    return {
        "fingerprint": contract.fingerprint,
        "components": [asdict(part) for part in contract.components],
    }


_FOOTER = 8192
"""Bytes at the end of a Parquet file that say where its pages lie, and what is in them."""


def fingerprint(folder: DatasetFolder) -> str:
    """Changes when columns, episodes or data do; reads the end of each data file."""
    said = [folder.version, folder.fps, [(e.index, e.length) for e in folder.episodes]]
    said.append([(f.key, f.dtype, f.shape, f.names) for f in folder.features.values()])
    digest = hashlib.sha256(json.dumps(said).encode())
    for file in sorted(folder.files()):
        path = folder.root / file
        if path.is_file():
            with path.open("rb") as stream:
                size = stream.seek(0, 2)
                stream.seek(max(0, size - _FOOTER))
                digest.update(f"{file} {size}".encode() + stream.read())
    return digest.hexdigest()[:16]


def changed_since(folder: DatasetFolder, contract: Contract | None) -> str | None:
    """What is to be said where a dataset is no longer the one of its contract."""
    if contract is None or contract.fingerprint == fingerprint(folder):
        return None
    return (
        f"the data changed since the contract in {SIDECAR_PATH} was kept: "
        f"hrc check --keep-contract makes it anew"
    )


def contract_notes(root: Path) -> list[str]:
    """What is to be said of the contract by whoever reads a dataset in another way.

    Raises:
        DatasetError: The contract or the metadata are damaged.
    """
    contract = contract_of(read_sidecar(root))
    if contract is None:
        return []
    folder = open_folder(root)
    contract.selections(folder.features)  # names what does not exist
    changed = changed_since(folder, contract)
    return [] if changed is None else [changed]


# What the episodes say.

# R squared from which a state is said to follow a command.
_FOLLOWS = 0.6


def infer_contract(
    folder: DatasetFolder,
    mapping: ColumnMapping,
    decisions: Mapping[str, UnitDecision],
    profiles: Sequence[EpisodeProfile],
) -> Contract:
    """A contract from what all episodes show.

    Args:
        folder: The dataset.
        mapping: What its columns mean by their names.
        decisions: Unit of each quantity.
        profiles: Of its episodes.
    """
    taken = {
        column: (role, number)
        for role, selection in mapping.selections.items()
        for number, column in enumerate(selection.columns)
    }
    parts: list[ComponentContract] = []
    places: dict[str, dict[int, int]] = {}
    """Role -> number of its component -> place among the parts."""
    for feature in folder.features.values():
        known = [p for p in profiles if feature.key in p.columns]
        if not feature.numeric or feature.key in INDEX_KEYS or not known:
            continue
        low = np.quantile([p.columns[feature.key].levels[0] for p in known], 0.05, axis=0)
        high = np.quantile([p.columns[feature.key].levels[-1] for p in known], 0.95, axis=0)
        discrete = np.mean(
            [is_discrete(p.columns[feature.key], p.length) for p in known], axis=0
        )
        for index in range(min(feature.width, len(low))):
            role, number = taken.get((feature.key, index), (None, 0))
            part = ComponentContract(
                key=feature.key,
                index=index,
                name=feature.names[index] if feature.names else f"joint_{index + 1}",
                role=role or "other",
                unit="",
                low=float(low[index]),
                high=float(high[index]),
            )
            if role is None:
                parts.append(_unnamed(part, float(discrete[index]), feature.key))
            else:
                places.setdefault(role, {})[number] = len(parts)
                parts.append(_of_role(part, number, decisions[role], profiles, folder.fps))
    # A quantity is read in the order of the contract: of x, y, z, w on disk the w comes first.
    ordered = list(parts)
    for of_role in places.values():
        for there, number in zip(sorted(of_role.values()), sorted(of_role), strict=True):
            ordered[there] = parts[of_role[number]]
    return Contract(components=tuple(ordered), fingerprint=fingerprint(folder))


def _unnamed(part: ComponentContract, discrete: float, key: str) -> ComponentContract:
    if part.low == part.high:
        return replace(part, role="constant", evidence="never changes")
    if discrete > 0.5:
        is_command = key.startswith("action") and is_hand(part.name)
        role = "gripper command" if is_command else "flag"
        return replace(part, role=role, evidence="switches between few levels")
    return replace(part, confidence=0.5, evidence="the name says nothing")


def _of_role(
    part: ComponentContract,
    number: int,
    decision: UnitDecision,
    profiles: Sequence[EpisodeProfile],
    fps: float,
) -> ComponentContract:
    role, hand = decision.role, is_hand(part.name)
    names = {
        "joint_position": "finger" if hand else "arm",
        "command_position": "finger command" if hand else "command",
        "joint_velocity": "velocity",
        "joint_effort": "effort",
        "command_velocity": "velocity command",
    }
    part = replace(
        part,
        role=names.get(role, role),
        unit=decision.unit_of(number),
        confidence=decision.confidence,
        evidence=decision.evidence or "declared",
    )
    tracked = [p.tracking[role] for p in profiles if role in p.tracking]
    if not tracked:
        return part
    fit, slope, delay, agreeing = _agreement(tracked, number)
    if not fit > _FOLLOWS:
        return part
    sign = int(np.sign(slope))
    shown = (
        f"state follows it with slope {slope:.2f}, R2 {fit:.2f}, "
        f"delay of {agreeing} in {len(tracked)} episodes"
    )
    if role == "joint_velocity":
        shown = f"slope {slope:.2f} against differences of the position, R2 {fit:.2f}"
        return replace(part, sign=sign, evidence=shown)
    return replace(part, sign=sign, delay=delay / fps, evidence=shown)


def _agreement(tracked: Sequence[Tracking], number: int) -> tuple[float, float, float, int]:
    """Median fit, slope and delay [frames] over episodes, and how many share the delay."""
    fits = np.array([t.fit[number] for t in tracked])
    slopes = np.array([t.slope[number] for t in tracked])
    delays = np.array([t.delay for t in tracked])
    if not np.isfinite(fits).any():
        return np.nan, np.nan, np.nan, 0
    delay = float(np.median(delays))
    return (
        float(np.nanmedian(fits)),
        float(np.nanmedian(slopes)),
        delay,
        int((np.abs(delays - delay) <= 2).sum()),
    )
