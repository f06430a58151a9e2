"""What a person decided about each episode, kept beside the dataset, and a cleaned copy."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal, get_args

from hrc_learn.demos.format.dataset_folder import open_folder
from hrc_learn.demos.issue import DatasetError
from hrc_learn.demos.read.column_mapping import MappingSpec
from hrc_learn.demos.repair import RepairOptions, RepairReport, repair_dataset
from hrc_learn.demos.repair.repair import Progress
from hrc_learn.store import new_file

Verdict = Literal["accept", "cut", "reject"]


@dataclass(frozen=True, kw_only=True)
class Decision:
    """What becomes of one episode."""

    verdict: Verdict
    start: int = 0
    """First frame that stays, of a cut."""
    stop: int = 0
    """Where those that stay end (not included), of a cut."""


Decisions = dict[int, Decision]
"""By episode; those that are not named are accepted."""


def decision(verdict: str, length: int, start: int = 0, stop: int = 0) -> Decision:
    """A decision that makes sense for an episode of so many frames.

    Raises:
        ValueError: There is no such verdict, or the cut leaves fewer than two frames.
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
    """Where the decisions about a dataset are kept: beside it."""
    root = root.resolve()
    return root.with_name(f"{root.name}.curation.json")


_DECISIONS_FORMAT = 1


def read_decisions(root: Path) -> Decisions:
    """What was decided before about the episodes of a dataset; empty where nothing was.

    Raises:
        DatasetError: The file is damaged, or of another dataset.
    """
    path, entries = decisions_path(root), {e.index: e for e in open_folder(root).episodes}
    if not path.is_file():
        return {}
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        decided: Decisions = {}
        for name, said in content["decisions"].items():
            entry = entries[int(name)]
            if said["length"] != entry.length:
                raise DatasetError(
                    f"decides on {said['length']} frames of the episode, which has "
                    f"{entry.length}: it is of another dataset; delete it to begin anew",
                    file=path,
                    episode=entry.index,
                )
            decided[entry.index] = decision(
                said["verdict"], entry.length, said["start"], said["stop"]
            )
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        if isinstance(error, DatasetError):
            raise
        raise DatasetError(
            f"holds no decisions on this dataset ({error!r}); delete it to begin anew",
            file=path,
        ) from error
    return decided


def keep_decisions(root: Path, decisions: Mapping[int, Decision]) -> None:
    """Write the decisions beside the dataset, which is not touched."""
    lengths = {entry.index: entry.length for entry in open_folder(root).episodes}
    content = {
        "format": _DECISIONS_FORMAT,
        "decisions": {
            str(index): asdict(decided) | {"length": lengths[index]}
            for index, decided in sorted(decisions.items())
        },
    }
    with new_file(decisions_path(root)) as part:
        part.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def write_curated(
    path: str | Path,
    out: str | Path,
    decisions: Mapping[int, Decision],
    *,
    mapping: MappingSpec | None = None,
    units: Mapping[str, str] | None = None,
    progress: Progress | None = None,
) -> RepairReport:
    """Write what is left of a dataset into a new one of version 3.0.

    Values stay as they are; videos are copied and cut by saying where each episode begins and
    ends in them. The old dataset is not touched.

    Args:
        path: The dataset.
        out: Folder of the new one, which must not exist.
        decisions: By episode; those that are not named are accepted.
        mapping: As in `load_demos`.
        units: As in `load_demos`.
        progress: As in `repair_dataset`.

    Raises:
        DatasetError: No episode is left, or one that is cannot be read.
        FileExistsError: There is something at `out`.
    """
    entries = {entry.index: entry for entry in open_folder(path).episodes}
    unknown = sorted({*decisions} - {*entries})
    if unknown:
        raise DatasetError(
            "there is no such episode to decide on", file=path, episode=unknown[0]
        )
    kept = {
        index: slice(0, entry.length) if decided is None else slice(decided.start, decided.stop)
        for index, entry in entries.items()
        for decided in (_cut(decisions.get(index)),)
        if not (index in decisions and decisions[index].verdict == "reject")
    }
    if not kept:
        raise DatasetError("every episode is rejected: nothing is left to write", file=path)
    options = RepairOptions(trim=False, drop_late=False, unwrap=False, fix_signs=False)
    return repair_dataset(
        path, out, options, mapping=mapping, units=units, progress=progress, kept=kept
    )


def _cut(decided: Decision | None) -> Decision | None:
    return decided if decided is not None and decided.verdict == "cut" else None
