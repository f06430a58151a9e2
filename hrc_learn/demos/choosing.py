"""Which episodes of which dataset are meant."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Protocol, runtime_checkable

from .finding import DatasetError
from .layout import DatasetFolder, EpisodeEntry

EpisodeFilter = Callable[[EpisodeEntry], bool]
"""Says of an episode, by its `index`, `length` and `tasks`, whether it is wanted."""


@runtime_checkable
class OpenDataset(Protocol):
    """An open `LeRobotDataset`, as far as it is needed: its folder and its chosen episodes."""

    root: Path
    episodes: list[int] | None


def locate(
    dataset: str | Path | OpenDataset, episodes: Sequence[int] | None
) -> tuple[Path, Sequence[int] | None]:
    """Folder of a dataset, and the episodes wanted of it.

    Args:
        dataset: A folder, or an open `LeRobotDataset`.
        episodes: Episodes wanted; None: all, or all that the open dataset was opened with.
    """
    if isinstance(dataset, str | Path):
        return Path(dataset), episodes
    return Path(dataset.root), dataset.episodes if episodes is None else episodes


def choose_episodes(
    folder: DatasetFolder,
    episodes: Sequence[int] | None = None,
    tasks: str | Sequence[str] | None = None,
    where: EpisodeFilter | None = None,
) -> tuple[EpisodeEntry, ...]:
    """The episodes wanted, in the order wanted.

    Args:
        folder: The dataset.
        episodes: Their indices; None: all, as they come.
        tasks: Only those that show one of these tasks.
        where: Only those of which this is true.

    Raises:
        DatasetError: One does not exist, or none is left.
    """
    chosen = _by_index(folder, episodes)
    if tasks is not None:
        wanted = {tasks} if isinstance(tasks, str) else set(tasks)
        _refuse_unknown_tasks(folder, wanted)
        chosen = [entry for entry in chosen if wanted & set(entry.tasks)]
    if where is not None:
        chosen = [entry for entry in chosen if where(entry)]
    if not chosen:
        raise DatasetError("no episode is left by the filters given", file=folder.root)
    return tuple(chosen)


def _by_index(folder: DatasetFolder, wanted: Sequence[int] | None) -> list[EpisodeEntry]:
    by_index = {entry.index: entry for entry in folder.episodes}
    if not by_index:
        raise DatasetError("the dataset holds no episodes", file=folder.root)
    if wanted is not None and not len(wanted):
        raise DatasetError("no episode was asked for; None reads all", file=folder.root)
    missing = [index for index in wanted or () if index not in by_index]
    if missing:
        raise DatasetError(
            f"there is no such episode; the dataset has {min(by_index)} to {max(by_index)}",
            file=folder.root,
            episode=missing[0],
        )
    return list(by_index.values() if wanted is None else (by_index[i] for i in wanted))


def _refuse_unknown_tasks(folder: DatasetFolder, wanted: set[str]) -> None:
    known = {task for entry in folder.episodes for task in entry.tasks}
    unknown = sorted(wanted - known)
    if unknown:
        raise DatasetError(
            f"no episode shows the task {unknown[0]!r}; the list of episodes has "
            f"{', '.join(map(repr, sorted(known))) or 'none'}",
            file=folder.root,
        )
