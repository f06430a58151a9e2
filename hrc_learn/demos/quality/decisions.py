"""Decisions on the episodes of a dataset, kept next to it, and the curated copy."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

from hrc_learn.demos.format.dataset_folder import open_folder
from hrc_learn.demos.issues import DatasetError
from hrc_learn.demos.quality.repair import Progress, RepairOptions, RepairReport, repair_dataset
from hrc_learn.demos.read.columns import MappingSpec
from hrc_learn.store import Count, read_json, write_json

Verdict = Literal["accept", "cut", "reject"]


@dataclass(frozen=True, kw_only=True)
class Decision:
    """Decision on one episode."""

    verdict: Verdict
    start: Count = 0
    """First frame kept by a cut."""
    stop: Count = 0
    """End of the frames kept by a cut (exclusive)."""


@dataclass(frozen=True, kw_only=True)
class _KeptDecision(Decision):
    length: Count
    """Number of frames of the episode."""


@dataclass(frozen=True, kw_only=True)
class _DecisionFile:
    decisions: dict[Count, _KeptDecision]
    format: Literal[1] = 1


Decisions = dict[int, Decision]
"""Episode index -> decision; episodes without one are accepted."""


def decide(verdict: str, length: int, start: int = 0, stop: int = 0) -> Decision:
    """A valid decision on an episode of this length [frames].

    Raises:
        ValueError: The verdict is unknown, or the cut keeps fewer than two frames.
    """
    if verdict not in get_args(Verdict):
        raise ValueError(f"{verdict!r} is none of {', '.join(get_args(Verdict))}")
    if verdict != "cut":
        return Decision(verdict=verdict)  # type: ignore[arg-type]
    if not 0 <= start < stop - 1 < length:
        raise ValueError(
            f"frames {start} to {stop} are no part of two frames or more of an episode of "
            f"{length} frames"
        )
    return Decision(verdict="cut", start=start, stop=stop)


def decisions_path(root: Path) -> Path:
    """File of the decisions on a dataset, next to it."""
    root = root.resolve()
    return root.with_name(f"{root.name}.curation.json")


def read_decisions(root: Path) -> Decisions:
    """Decisions kept for the episodes of a dataset.

    Raises:
        DatasetError: The file is damaged, or belongs to another dataset.
    """
    path = decisions_path(root)
    if not path.is_file():
        return {}
    lengths = {entry.index: entry.length for entry in open_folder(root).episodes}
    advice = "delete it to begin anew"
    try:
        kept = read_json(path, _DecisionFile, advice).decisions
    except ValueError as error:
        raise DatasetError(str(error).removeprefix(f"{path}: "), file=path) from error
    decisions: Decisions = {}
    for index, known in kept.items():
        if known.length != lengths.get(index):
            raise DatasetError(
                f"decides on an episode of {known.length} frames, the dataset has "
                f"{lengths.get(index, 'no such episode')}: it belongs to another dataset; "
                f"{advice}",
                file=path,
                episode=index,
            )
        try:
            decisions[index] = decide(known.verdict, known.length, known.start, known.stop)
        except ValueError as error:
            raise DatasetError(f"{error}; {advice}", file=path, episode=index) from error
    return decisions


def keep_decisions(root: Path, decisions: Mapping[int, Decision]) -> None:
    """Write the decisions next to the dataset, which is not changed."""
    kept = {
        # The index of the dataset: True is equal to 1, but no name of an episode.
        entry.index: _KeptDecision(**vars(decisions[entry.index]), length=entry.length)
        for entry in open_folder(root).episodes
        if entry.index in decisions
    }
    write_json(decisions_path(root), _DecisionFile(decisions=kept))


def write_curated(
    path: str | Path,
    out: str | Path,
    decisions: Mapping[int, Decision],
    *,
    mapping: MappingSpec | None = None,
    units: Mapping[str, str] | None = None,
    progress: Progress | None = None,
) -> RepairReport:
    """Write the accepted and cut episodes into a new dataset of version 3.0.

    Values stay as they are. Videos are copied, and cut by their times in the list of episodes.
    The old dataset is not changed.

    Args:
        path: The dataset.
        out: Folder of the new dataset, which must not exist.
        decisions: Decisions by episode; episodes without one are accepted.
        mapping: Columns by role, as in `load_demos`.
        units: Units on disk by role, as in `load_demos`.
        progress: Wraps the episodes, as in `repair_dataset`.

    Raises:
        DatasetError: No episode is left, or an accepted one cannot be read.
        FileExistsError: `out` exists.
    """
    entries = {entry.index: entry for entry in open_folder(path).episodes}
    unknown = sorted({*decisions} - {*entries})
    if unknown:
        raise DatasetError(
            "there is no such episode to decide on", file=path, episode=unknown[0]
        )
    kept = {}
    for index, entry in entries.items():
        decision = decisions.get(index, Decision(verdict="accept"))
        if decision.verdict == "cut":
            kept[index] = slice(decision.start, decision.stop)
        elif decision.verdict == "accept":
            kept[index] = slice(0, entry.length)
    if not kept:
        raise DatasetError("every episode is rejected: nothing is left to write", file=path)
    options = RepairOptions(trim=False, drop_late=False, unwrap=False, fix_signs=False)
    return repair_dataset(
        path, out, options, mapping=mapping, units=units, progress=progress, kept=kept
    )
