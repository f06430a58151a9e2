"""Folder of a LeRobot dataset: its metadata in one form for the versions 2.0, 2.1 and 3.0."""

import shlex
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, partialmethod
from itertools import accumulate
from pathlib import Path
from typing import Any

from hrc_learn.demos.issues import DatasetError, Issue
from hrc_learn.demos.read.dataset_files import (
    INFO_PATH,
    integer,
    path_in,
    read_json,
    read_json_lines,
    read_rows,
)
from hrc_learn.demos.read.metadata import QUANTILES, Feature, Statistics, read_features
from hrc_learn.demos.read.quantities import INDEX_KEYS
from hrc_learn.store import resolved, settle

FASTEST = 1e6
"""Upper bound of the frame rate [1/s]; no robot reports faster."""
_REQUIRED = {*QUANTILES, "min", "max", "mean", "std", "count"}


@dataclass(frozen=True, kw_only=True)
class EpisodeEntry:
    """One episode as listed in the metadata."""

    index: int
    length: int
    """Number of frames."""
    tasks: tuple[str, ...]
    file: str
    """Data file, relative to the dataset."""
    start: int
    """Row of the first frame in that file."""

    def error(
        self, message: str, frame: int | None = None, key: str | None = None
    ) -> DatasetError:
        """Reading error located in this episode."""
        return DatasetError(message, file=self.file, episode=self.index, frame=frame, key=key)

    def fault(self, message: str, **details: Any) -> Issue:
        """Issue located in this episode; further arguments as in `Issue`."""
        return Issue(message=message, file=self.file, episode=self.index, **details)

    warning = partialmethod(fault, level="warning")


@dataclass(frozen=True, kw_only=True)
class DatasetFolder:
    """Metadata of a dataset, in one form for every version."""

    root: Path
    info: dict
    """Content of `meta/info.json`."""
    features: dict[str, Feature]
    episodes: tuple[EpisodeEntry, ...]
    tasks: dict[int, str]
    """Task text by index."""

    @property
    def version(self) -> str:
        """Version of the format, such as "v3.0"."""
        return str(self.info["codebase_version"])

    @property
    def fps(self) -> float:
        """Nominal frame rate [1/s]."""
        return float(self.info["fps"])

    @property
    def robot_type(self) -> str | None:
        """Name of the robot."""
        return self.info.get("robot_type")

    @property
    def is_v3(self) -> bool:
        """True for version 3.0, False for 2.0 and 2.1."""
        return generation(self.version) == 3

    @property
    def numbers(self) -> list[str]:
        """Features that hold numbers, without LeRobot's own index columns."""
        features = self.features.items()
        return [key for key, f in features if f.numeric and key not in INDEX_KEYS]

    @cached_property
    def files(self) -> dict[str, list[EpisodeEntry]]:
        """Episodes in each data file."""
        files: dict[str, list[EpisodeEntry]] = {}
        for entry in self.episodes:
            files.setdefault(entry.file, []).append(entry)
        return files

    @cached_property
    def first_index(self) -> dict[int, int]:
        """Number of frames before each episode, by episode index."""
        ordered = sorted(self.episodes, key=lambda entry: entry.index)
        starts = accumulate((entry.length for entry in ordered), initial=0)
        return {e.index: start for e, start in zip(ordered, starts, strict=False)}


def open_folder(path: str | Path) -> DatasetFolder:
    """Read the metadata of a dataset.

    Raises:
        DatasetError: There is no dataset, its recording was not finalized, its version is
            unknown, or a part of its metadata is missing or damaged.
    """
    root = Path(path)
    info = read_info(root)
    return DatasetFolder(
        root=root,
        info=info,
        features=read_features(info),
        episodes=read_episodes(root, info),
        tasks=read_tasks(root, info),
    )


def read_info(root: Path) -> dict:
    """Content of `meta/info.json`, with a known version and a valid frame rate.

    Raises:
        DatasetError: The file is missing, damaged, or unusable.
    """
    settle(root)
    if not (root / INFO_PATH).exists():
        raise DatasetError(_reason_of_absence(root), file=root / INFO_PATH)
    info = read_json(root, INFO_PATH)
    missing = [key for key in ("codebase_version", "fps", "features") if key not in info]
    if missing:
        raise DatasetError(f"lacks {', '.join(missing)}", file=INFO_PATH)
    version, fps = info["codebase_version"], info["fps"]
    number = isinstance(fps, int | float) and not isinstance(fps, bool)
    for key, sound, text in (
        ("codebase_version", generation(version) is not None, "2.0, 2.1 or 3.0"),
        ("fps", number and 0 < fps < FASTEST, f"positive and below {FASTEST:g}"),
        ("features", isinstance(info["features"], dict), "an object"),
    ):
        if not sound:
            text = f"{key} must be {text}, got {str(info[key])[:80]!r}"
            raise DatasetError(text, file=INFO_PATH, key=key)
    return info


def generation(version: object) -> int | None:
    """Main number, 2 or 3, of a version such as "v2.1"; None for unknown versions."""
    numbers = str(version).removeprefix("v").split(".")
    if numbers[0] == "3" or numbers[:2] in (["2", "0"], ["2", "1"]):
        return int(numbers[0])
    return None


def _reason_of_absence(root: Path) -> str:
    if staging_folder(root).is_dir():
        return (
            f"not found: the recording was interrupted before it became a dataset. "
            f"{recovery_advice(root)} makes one from its saved episodes"
        )
    if not root.exists():
        return "there is no dataset: the folder does not exist"
    return "not found: this folder is no LeRobot dataset, or its recording was not finalized"


def staging_folder(root: Path) -> Path:
    """Folder that holds the recording of the dataset `root` until it is finalized."""
    root = resolved(root)
    return root.with_name(root.name + ".recording")


def recovery_advice(root: Path) -> str:
    """Command and call that turn an interrupted recording into a dataset."""
    command = shlex.join(["hrc", "repair", "--dataset", str(root)])
    return f"`{command}`, or hrc_learn.demos.recover_dataset({str(root)!r}),"


def read_episodes(root: Path, info: dict) -> tuple[EpisodeEntry, ...]:
    """Episodes in the order of their indices.

    Raises:
        DatasetError: The list of episodes is missing or damaged.
    """
    read = _episodes_v3 if generation(info["codebase_version"]) == 3 else _episodes_v2
    return tuple(sorted(read(root, info), key=lambda entry: entry.index))


def episode_lists(root: Path) -> list[str]:
    """Files of the list of episodes (version 3.0), relative to the dataset."""
    return [
        str(path.relative_to(root)) for path in sorted(root.glob("meta/episodes/*/*.parquet"))
    ]


def _episodes_v3(root: Path, info: dict) -> Iterator[EpisodeEntry]:
    files = episode_lists(root)
    if not files:
        text = (
            "no list of episodes: the recording was not finalized, or the copy is incomplete; "
            "hrc repair recovers its saved episodes"
        )
        raise DatasetError(text, file="meta/episodes")
    places = ("chunk_index", "file_index")
    counts = ("episode_index", "length", "dataset_from_index")
    columns = (*counts, *(f"data/{place}" for place in places))
    by_file: dict[tuple[int, int], list[dict]] = {}
    for file in files:
        for row in read_rows(root, file, columns, optional=("tasks",)):
            row |= {name: integer(row[name], name, "meta/episodes") for name in columns}
            by_file.setdefault((row[columns[3]], row[columns[4]]), []).append(row)
    for numbers, rows in by_file.items():
        # The path is found once per file, not once per episode: `path_in` follows links, which
        # takes longer than all other work on an episode.
        there = dict(zip(places, numbers, strict=True))
        path = path_in(root, info.get("data_path"), "data_path", **there)
        first = min(row["dataset_from_index"] for row in rows)
        for row in rows:
            yield EpisodeEntry(
                index=row["episode_index"],
                length=row["length"],
                tasks=_task_texts(row.get("tasks")),
                file=path,
                start=row["dataset_from_index"] - first,
            )


def _episodes_v2(root: Path, info: dict) -> Iterator[EpisodeEntry]:
    name = "meta/episodes.jsonl"
    rows = read_json_lines(root, name, ("episode_index", "length"))
    size = integer(info.get("chunks_size", 1000), "chunks_size", INFO_PATH, lowest=1)
    for row in rows:
        index, length = (integer(row[n], n, name) for n in ("episode_index", "length"))
        file = path_in(root, info.get("data_path"), "data_path", **places_v2(index, size))
        tasks = _task_texts(row.get("tasks"))
        yield EpisodeEntry(index=index, length=length, tasks=tasks, file=file, start=0)


def places_v2(episode: int, chunks_size: int) -> dict[str, int]:
    """Fields of a path template in version 2, which keeps one file per episode.

    A chunk is a folder of `chunks_size` files. Some converters call the number of the chunk
    `chunk_index`, as version 3 does.
    """
    chunk = episode // chunks_size
    return {"episode_chunk": chunk, "chunk_index": chunk, "episode_index": episode}


def _task_texts(tasks: object) -> tuple[str, ...]:
    tasks = tasks or ()
    return tuple(map(str, tasks)) if isinstance(tasks, list | tuple) else (str(tasks),)


def read_tasks(root: Path, info: dict) -> dict[int, str]:
    """Task text by index.

    Raises:
        DatasetError: The list of tasks is missing or damaged.
    """
    if generation(info["codebase_version"]) == 3:
        file = "meta/tasks.parquet"
        rows = read_rows(root, file, ("task_index",))
    else:
        file = "meta/tasks.jsonl"
        rows = read_json_lines(root, file, ("task_index", "task"))
    # pandas leaves the column of texts unnamed if its index had no name.
    names = ("task", "__index_level_0__", "index")
    return {
        integer(row["task_index"], "task_index", file): str(
            next((row[name] for name in names if name in row), None)
        )
        for row in rows
    }


def recorded_statistics(folder: DatasetFolder) -> dict[int, Statistics]:
    """Statistics of the features, by episode index; incomplete statistics are left out.

    Raises:
        DatasetError: A file of statistics is damaged.
    """
    found: dict[int, Statistics] = {}
    lines = "meta/episodes_stats.jsonl"
    if folder.is_v3:
        for file in episode_lists(folder.root):
            for row in read_rows(folder.root, file, ()):
                statistics = found.setdefault(row["episode_index"], {})
                for name, value in row.items():
                    if name.startswith("stats/") and value is not None:
                        key, _, statistic = name.removeprefix("stats/").rpartition("/")
                        statistics.setdefault(key, {})[statistic] = value
    elif (folder.root / lines).is_file():
        for row in read_json_lines(folder.root, lines, ("episode_index", "stats")):
            found[int(row["episode_index"])] = row["stats"]
    return {
        index: {key: s for key, s in statistics.items() if s.keys() >= _REQUIRED}
        for index, statistics in found.items()
    }


Progress = Callable[[Sequence[EpisodeEntry]], Iterable[EpisodeEntry]]
"""Function that wraps a sequence of episodes, such as in a progress bar."""
EpisodeFilter = Callable[[EpisodeEntry], bool]
"""Condition on an episode's `index`, `length` and `tasks`, true if the episode is wanted."""


def count_faults(folder: DatasetFolder) -> Iterator[DatasetError]:
    """Contradictions between the counts of episodes and frames in the metadata."""
    entries, info, listed = folder.episodes, folder.info, "meta/episodes"
    if not entries:
        yield DatasetError("the dataset holds no episodes", file=folder.root)
    frames = sum(entry.length for entry in entries)
    for name, counted in (("total_episodes", len(entries)), ("total_frames", frames)):
        if info.get(name, counted) != counted:
            text = (
                f"says {info[name]}, but the list of episodes counts {counted}: episodes were "
                f"lost, or the file belongs to another copy; hrc repair counts anew"
            )
            yield DatasetError(text, file=INFO_PATH, key=name)
    repeated = [index for index, n in Counter(e.index for e in entries).items() if n > 1]
    for index in repeated:
        yield DatasetError("is listed more than once", file=listed, episode=index)
    missing = sorted(set(range(len(entries))) - {entry.index for entry in entries})
    if missing and not repeated:
        text = "is missing from the list of episodes: indices must count from 0 without a gap"
        yield DatasetError(text, file=listed, episode=missing[0])
    for entry in entries:
        if entry.length <= 0:
            yield entry.error("has no frames")


def select_episodes(
    folder: DatasetFolder,
    episodes: Sequence[int] | None = None,
    tasks: str | Sequence[str] | None = None,
    where: EpisodeFilter | None = None,
) -> tuple[EpisodeEntry, ...]:
    """The episodes wanted, in the order of `episodes`.

    Args:
        folder: The dataset.
        episodes: Indices of the episodes; None for all, in their order.
        tasks: Select episodes of one of these tasks.
        where: Select episodes for which this condition is true.

    Raises:
        DatasetError: An episode or task does not exist, or no episode is left.
    """
    by_index, root = {entry.index: entry for entry in folder.episodes}, folder.root
    if not by_index:
        raise DatasetError("the dataset holds no episodes", file=root)
    indices = [*by_index] if episodes is None else episodes
    if not len(indices):
        raise DatasetError("no episode was asked for; None reads all", file=root)
    for index in indices:
        if index not in by_index:
            text = f"there is no such episode: choose from {min(by_index)} to {max(by_index)}"
            raise DatasetError(text, file=root, episode=index)
    chosen = [by_index[index] for index in indices]
    if tasks is not None:
        wanted = {tasks} if isinstance(tasks, str) else {*tasks}
        known = {task for entry in folder.episodes for task in entry.tasks}
        if unknown := sorted(wanted - known):
            listed = ", ".join(map(repr, sorted(known))) or "none"
            text = f"no episode shows the task {unknown[0]!r}; tasks shown: {listed}"
            raise DatasetError(text, file=root)
        chosen = [entry for entry in chosen if wanted & {*entry.tasks}]
    chosen = [entry for entry in chosen if where is None or where(entry)]
    if not chosen:
        raise DatasetError("no episode of two frames is left by the filters given", file=root)
    return tuple(chosen)
