"""Reading any LeRobot dataset into demonstrations, on pyarrow alone."""

import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path

from .choosing import EpisodeFilter, OpenDataset
from .conversion import to_demonstration
from .demonstration import joint_columns
from .demonstration_set import DemonstrationSet
from .demonstration_source import DemonstrationSource
from .episode_reader import open_reader
from .explicit_mapping import MappingSpec
from .finding import UnitsWarning
from .image_features.attaching import with_feature
from .units import UnitDecision


def load_demos(
    path: str | Path | OpenDataset,
    episodes: Sequence[int] | None = None,
    mapping: MappingSpec | None = None,
    units: Mapping[str, str] | None = None,
    joint_names: Sequence[str] | None = None,
    *,
    tasks: str | Sequence[str] | None = None,
    where: EpisodeFilter | None = None,
) -> DemonstrationSet:
    """Read the demonstrations of a LeRobot dataset (version 2.0, 2.1 or 3.0) into memory.

    Columns are found by name; videos are not needed. What had to be guessed stands in the
    result's `notes`, and a guessed unit that changes values raises a `UnitsWarning`.

    Args:
        path: The dataset's folder, or an open `LeRobotDataset`, of which the episodes are
            taken that it was opened with.
        episodes: Indices of the episodes wanted, in that order; None reads all.
        mapping: Where to find quantities that are not found by name, or are found wrongly:
            role -> feature ("observation.qpos"), range of a feature ("observation.state[0:7]")
            or list of components. Roles are the keys of `demos.ROLES`.
        units: Units on disk by role, such as {"joint_position": "deg", "position": "mm"};
            they win over the dataset's sidecar and over guesses.
        joint_names: Joints wanted, in the order wanted; None takes all as they come.
        tasks: Only episodes that show one of these tasks.
        where: Only episodes for which this is true; it sees their `index`, `length` and
            `tasks`. By what they hold, choose with `DemonstrationSet.filter`.

    Raises:
        DatasetError: The dataset cannot be read as a whole; says file, episode, frame and
            key where known, and what to do.
    """
    reader = open_reader(path, episodes, mapping, tasks, where)
    matching = reader.matching
    raw = {e.entry.index: e for e in reader.read(tuple(dict.fromkeys(reader.entries)))}
    decisions = reader.decide_units(raw.values(), units or {})
    demos = [
        to_demonstration(reader.folder, raw[entry.index], matching, decisions)
        for entry in reader.entries
    ]
    if reader.extracted is not None:
        demos = [with_feature(demo, reader.extracted) for demo in demos]
    if joint_names is not None:
        joint_columns(matching.joint_names, joint_names)
        demos = [demo.select_joints(joint_names) for demo in demos]
    _warn_of_conversions(reader.folder.root, decisions)
    notes = [*reader.notes, *_guesses(decisions)]
    return DemonstrationSet(demos, notes=notes, source=str(reader.folder.root))


def open_demos(
    path: str | Path | OpenDataset,
    episodes: Sequence[int] | None = None,
    mapping: MappingSpec | None = None,
    units: Mapping[str, str] | None = None,
    joint_names: Sequence[str] | None = None,
    *,
    tasks: str | Sequence[str] | None = None,
    where: EpisodeFilter | None = None,
) -> DemonstrationSource:
    """The same demonstrations as of `load_demos`, read from disk only as they are asked for.

    Arguments, errors and warnings are those of `load_demos`, but faults of an episode show
    when it is read. Where units must be guessed from the size of the values, the columns in
    question are read once through here; a declared or given unit spares that.
    """
    reader = open_reader(path, episodes, mapping, tasks, where)
    if joint_names is not None:
        joint_columns(reader.matching.joint_names, joint_names)
    decisions = reader.survey(units or {})
    _warn_of_conversions(reader.folder.root, decisions)
    notes = (*reader.notes, *_guesses(decisions))
    return DemonstrationSource(reader, decisions, joint_names, notes)


def _warn_of_conversions(root: Path, decisions: Mapping[str, UnitDecision]) -> None:
    for decision in decisions.values():
        if decision.converts:
            warnings.warn(f"{root}: {decision.note}", UnitsWarning, stacklevel=3)


def _guesses(decisions: Mapping[str, UnitDecision]) -> list[str]:
    return [decision.note for decision in decisions.values() if decision.note]
