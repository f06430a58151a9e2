"""Contract of a dataset: the meaning of every column, inferred once and kept with the data.

LeRobot declares neither units, meanings nor reference frames, and drops unknown fields from its
own files. A sidecar, `meta/hrc_learn.json`, holds what the writer declared, and the contract:
role, unit, range, sign and delay of each component, with the evidence and a confidence. The
contract may be edited there, and every reader of the dataset uses it.
"""

import hashlib
import json
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import groupby
from pathlib import Path
from typing import Literal

import numpy as np

from hrc_learn.demos.issues import DatasetError, aligned, plain_text
from hrc_learn.demos.read.columns import ColumnMapping, ColumnSelection, parse_mapping
from hrc_learn.demos.read.dataset_folder import DatasetFolder
from hrc_learn.demos.read.metadata import SIDECAR_PATH, Feature, dump_json
from hrc_learn.demos.read.naming import is_hand, joint_of
from hrc_learn.demos.read.profiles import EpisodeProfile, FeatureProfiles
from hrc_learn.demos.read.quantities import CONTRACT_QUANTITIES as _QUANTITIES
from hrc_learn.demos.read.quantities import ROLES
from hrc_learn.demos.read.unit_evidence import CONFIDENT
from hrc_learn.demos.read.units import UnitDecision, units_of
from hrc_learn.store import Count, new_file, read_json

CONTRACT_ROLES = (*_QUANTITIES, *(role for role in ROLES if role not in _QUANTITIES.values()))
"""Roles of a component in a contract."""
_FOLLOWS = 0.6
"""R squared above which a state counts as following its command."""
_FOOTER = 8192
"""Size of the end of a data file that enters the fingerprint [bytes]. The end of a Parquet file
locates its pages and holds statistics."""


@dataclass(frozen=True, kw_only=True)
class ComponentContract:
    """Meaning of one component of one feature."""

    key: str
    index: Count
    name: str
    role: str
    """Role, one of `CONTRACT_ROLES`."""
    unit: str
    """Unit on disk; "" if unknown."""
    low: float
    """Lower end of the range: the 0.5 % quantile of each episode, then the 5 % quantile of
    these values over all episodes."""
    high: float
    """Upper end of the range: the 99.5 % quantile of each episode, then the 95 % quantile of
    these values over all episodes."""
    sign: Literal[-1, 0, 1] = 0
    """Direction in which the state follows an increasing command, +1 or -1; 0 if unknown."""
    delay: float | None = None
    """Delay of the state behind this command [s]; None if unknown."""
    confidence: float = 1.0
    """Confidence, 0 to 1."""
    evidence: str = ""
    """Evidence in words."""

    def __post_init__(self) -> None:
        if self.role not in CONTRACT_ROLES:
            raise ValueError(
                f"{self.name} has the unknown role {self.role!r}; known are "
                f"{', '.join(CONTRACT_ROLES)}"
            )

    @property
    def column(self) -> tuple[str, int]:
        """Feature and index of the component."""
        return self.key, self.index

    @property
    def quantity(self) -> str | None:
        """Quantity of a demonstration that holds the component; None for an extra column."""
        return _QUANTITIES.get(self.role, self.role) or None


@dataclass(frozen=True, kw_only=True)
class Contract:
    """Meaning of the components of a dataset."""

    components: tuple[ComponentContract, ...] = ()
    fingerprint: str = ""
    """Fingerprint of the data from which the contract was inferred."""

    def __post_init__(self) -> None:
        places = Counter(part.column for part in self.components)
        for (key, index), count in places.items():
            if count > 1:
                raise ValueError(f"component {index} of {key} is listed {count} times")

    def rows(self) -> list[tuple[str, ...]]:
        """The contract as a table with a header; similar adjacent components form one row."""
        rows = [("column", "role", "unit", "range", "sign", "delay", "sure", "evidence")]
        alike = groupby(self.components, lambda p: (p.key, p.role, p.unit, p.sign, p.delay))
        for (key, role, unit, sign, delay), group in alike:
            parts = [*group]
            names = dict.fromkeys((parts[0].name, parts[-1].name))
            low, high = min(p.low for p in parts), max(p.high for p in parts)
            weakest = min(parts, key=lambda part: part.confidence)
            name, span = plain_text(f"{key}/{' .. '.join(names)}"), f"{low:.3g} .. {high:.3g}"
            late = "" if delay is None else f"{1e3 * delay:.0f} ms"
            way, sure = {1: "+", -1: "-", 0: ""}[sign], f"{100 * weakest.confidence:.0f} %"
            rows.append((name, role, unit or "-", span, way, late, sure, weakest.evidence))
        return rows

    def lines(self) -> Iterator[str]:
        """The table as aligned text."""
        yield from aligned(self.rows())

    def units(self, selections: Mapping[str, ColumnSelection]) -> dict[str, tuple[str, ...]]:
        """Unit of each component of the selected quantities, by role.

        Quantities with a column of unknown unit are left out.
        """
        known, units = {part.column: part for part in self.components}, {}
        for role, selection in selections.items():
            parts = [known.get(column) for column in selection.columns]
            fits = units_of(role)
            if all(p and p.unit and (p.quantity == role or p.unit in fits) for p in parts):
                units[role] = tuple(part.unit for part in parts if part)
        return units

    def selections(self, features: Mapping[str, Feature]) -> dict[str, ColumnSelection]:
        """Columns of each quantity.

        Raises:
            DatasetError: A component does not exist, or a quantity has a wrong number of them.
        """
        found: dict[str, list[ComponentContract]] = {}
        for part in self.components:
            feature = features.get(part.key)
            if feature is None or part.index >= feature.width:
                raise _faulty(f"{part.key}/{part.name} is no component of the dataset")
            if part.quantity is not None:
                found.setdefault(part.quantity, []).append(part)
        for role, parts in found.items():
            width = ROLES[role].width
            if width is not None and len(parts) != width:
                raise _faulty(f"{role} has {len(parts)} components, but needs {width}")
        return {
            role: ColumnSelection(
                role=role,
                columns=tuple(part.column for part in parts),
                labels=tuple(joint_of(part.name) for part in parts),
                numbered=features[parts[0].key].names is None,
            )
            for role, parts in found.items()
        }

    def keeping(self, kept: "Contract") -> "Contract":
        """This contract with the names and roles of an older contract.

        The older contract may have been edited.

        A component that is now read as another quantity keeps its new role. A component of a
        quantity keeps its unit, which was already decided with the older contract. Every other
        component gets its unit from the older contract.
        """
        known, parts = {part.column: part for part in kept.components}, []
        for part in self.components:
            old = known.get(part.column, part)
            if part.quantity == old.quantity:
                unit = part.unit if part.quantity else old.unit
                part = replace(part, role=old.role, unit=unit)
            parts.append(replace(part, name=old.name))
        return replace(self, components=tuple(parts))

    def without_doubt(self) -> tuple["Contract", list[str]]:
        """The contract without doubtful units, and the names of the components concerned."""
        doubtful = [p for p in self.components if p.unit and p.confidence < CONFIDENT]
        parts = [replace(p, unit="") if p in doubtful else p for p in self.components]
        return replace(self, components=tuple(parts)), [f"{p.key}/{p.name}" for p in doubtful]


def _faulty(message: str) -> DatasetError:
    return DatasetError(f"{message}; edit it", file=SIDECAR_PATH, key="contract")


@dataclass(frozen=True, kw_only=True)
class SidecarColumn:
    """Columns that hold one quantity."""

    key: str
    """Key of the feature."""
    names: tuple[str, ...]
    """Names of the components of the feature that hold the quantity."""


@dataclass(frozen=True, kw_only=True)
class Sidecar:
    """Units and meaning of columns, declared by the writer or kept after a check."""

    format: Literal[1] = 1
    units: dict[str, str] = field(default_factory=dict)
    """Unit on disk of each role."""
    columns: dict[str, SidecarColumn] = field(default_factory=dict)
    """Columns of each role."""
    joint_names: tuple[str, ...] = ()
    frames: dict[str, str] = field(default_factory=dict)
    """Reference frames of the poses: "base" and "ee"."""
    details: dict = field(default_factory=dict)
    """Further values given to the writer."""
    contract: Contract = Contract()
    """Meaning of each component; takes precedence over `units` and `columns`."""

    def selections(self, features: Mapping[str, Feature]) -> dict[str, ColumnSelection] | None:
        """Columns of each quantity; None if nothing is declared.

        Raises:
            DatasetError: A declared column does not exist, or a quantity has too many or too
                few columns.
        """
        if self.contract.components:
            return self.contract.selections(features)
        declared = {
            role: [f"{column.key}/{name}" for name in column.names]
            for role, column in self.columns.items()
        }
        return parse_mapping(declared, features) if declared else None


def read_sidecar(root: Path) -> Sidecar:
    """The dataset's sidecar, empty if there is no file.

    Raises:
        DatasetError: The file is damaged, was edited wrongly, or names a role that does not
            exist; the message names the field.
    """
    path = root / SIDECAR_PATH
    if not path.exists():
        return Sidecar()
    try:
        return read_json(path, Sidecar, "edit it, or delete it to have units guessed")
    except ValueError as error:
        message = str(error).removeprefix(f"{path}: ")
        raise DatasetError(message, file=SIDECAR_PATH) from error


def keep_contract(root: Path, contract: Contract) -> None:
    """Write the contract into the sidecar, whose other content is kept."""
    sidecar = replace(read_sidecar(root), contract=contract)
    with new_file(root / SIDECAR_PATH) as part:
        dump_json(part, sidecar)


def fingerprint(folder: DatasetFolder) -> str:
    """Fingerprint of columns, episodes and data; reads only the end of each data file."""
    said = [folder.version, folder.fps, [(e.index, e.length) for e in folder.episodes]]
    said.append([(f.key, f.dtype, f.shape, f.names) for f in folder.features.values()])
    digest = hashlib.sha256(json.dumps(said).encode())
    for file in sorted(folder.files):
        path = folder.root / file
        if path.is_file():
            with path.open("rb") as stream:
                size = stream.seek(0, 2)
                stream.seek(max(0, size - _FOOTER))
                digest.update(f"{file} {size}".encode() + stream.read())
    return digest.hexdigest()[:16]


def infer_contract(
    folder: DatasetFolder,
    mapping: ColumnMapping,
    decisions: Mapping[str, UnitDecision],
    features: Sequence[FeatureProfiles],
    profiles: Sequence[EpisodeProfile],
) -> Contract:
    """Infer a contract from the profiles of episodes.

    Args:
        folder: The dataset.
        mapping: Meaning of its columns by their names.
        decisions: Unit of each quantity.
        features: Profiles of its features.
        profiles: Profiles of its episodes.
    """
    smooth = {(f.key, i): bool(moves) for f in features for i, moves in enumerate(f.varied)}
    unnamed: dict[tuple[str, int], ComponentContract] = {}
    for feature in features:
        # Quantiles over episodes, so that a single episode does not set the range.
        levels, names = feature.stack("levels"), folder.features[feature.key].names
        low = np.quantile(levels[:, 0], 0.05, axis=0).tolist()
        high = np.quantile(levels[:, -1], 0.95, axis=0).tolist()
        labels = names or [f"joint_{index + 1}" for index in range(len(low))]
        for index, (name, least, most) in enumerate(zip(labels, low, high, strict=True)):
            place = {"key": feature.key, "index": index, "name": name}
            part = ComponentContract(role="other", unit="", low=least, high=most, **place)
            unnamed[part.column] = part
    # The contract lists components in the order in which they are read: a quaternion stored as
    # x, y, z, w is listed as w, x, y, z.
    parts = [
        _describe(unnamed.pop(column), number, decisions[role], profiles, folder.fps)
        for role, selection in mapping.selections.items()
        for number, column in enumerate(selection.columns)
        if column in unnamed
    ]
    parts += [_describe_extra(p, smooth[p.column]) for p in unnamed.values()]
    return Contract(components=tuple(parts), fingerprint=fingerprint(folder))


def _describe_extra(part: ComponentContract, smooth: bool) -> ComponentContract:
    """Complete the contract of a component that no quantity uses."""
    if part.low == part.high:
        return replace(part, role="constant", evidence="never changes")
    is_command = part.key.startswith("action") and is_hand(part.name)
    if not smooth:
        role = "gripper command" if is_command else "flag"
        return replace(part, role=role, evidence="switches between few levels")
    if is_command:
        return replace(part, role="gripper command", evidence="named as a gripper")
    return replace(part, confidence=0.5, evidence="the name is unknown")


def _describe(
    part: ComponentContract,
    number: int,
    decision: UnitDecision,
    profiles: Sequence[EpisodeProfile],
    fps: float,
) -> ComponentContract:
    """Complete the contract of a component that a quantity uses."""
    role = decision.role
    # If a quantity has two roles in contracts, the second role is for fingers.
    roles = [known for known, quantity in _QUANTITIES.items() if quantity == role] or [role]
    part = replace(
        part,
        role=roles[-1 if is_hand(part.name) else 0],
        unit=decision.unit_of(number),
        confidence=decision.confidence,
        evidence=decision.evidence or "declared",
    )
    changes = part.unit.endswith("/step")
    name = "rates" if changes else role
    tracked = [p.tracking[name] for p in profiles if name in p.tracking]
    fits = [fit for t in tracked if np.isfinite(fit := t.fit[number])]
    fit = float(np.median(fits)) if fits else 0.0
    if not fit > _FOLLOWS:
        return part
    slope = float(np.nanmedian([t.slope[number] for t in tracked]))
    delays = np.array([t.delay for t in tracked])
    delay = float(np.median(delays))
    # Estimated delays scatter by two frames.
    agreeing = int((np.abs(delays - delay) <= 2).sum())
    evidence = (
        f"the state follows this command with slope {slope:.2f}, R2 {fit:.2f}, "
        f"same delay in {agreeing} of {len(tracked)} episodes"
    )
    part = replace(part, sign=int(np.sign(slope)), delay=delay / fps)
    return part if changes else replace(part, evidence=evidence)
