"""From saved episodes to a dataset, however often that is broken off.

A recording lives in `NAME.recording/` and says there which one it is, and to how many episodes
it is appended (`recording.json`). The dataset made of it keeps that name, so that a recording
which ended between the two last steps is not taken for another.
"""

import itertools
import json
import os
import uuid
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from hrc_learn.demos.format.dataset_folder import (
    how_to_recover,
    open_folder,
    open_parquet,
    read_table,
)
from hrc_learn.demos.format.metadata import (
    CHUNK_SIZE,
    DATA_PATH,
    EPISODES_PATH,
    FILE_SIZE_MB,
    SIDECAR_PATH,
    Statistics,
    combined_statistics,
    data_schema,
    info,
    place,
    read_sidecar,
    write_json,
    write_tasks,
)
from hrc_learn.demos.format.videos import (
    Segments,
    VideoPlacement,
    VideoSegment,
    link,
    video_path,
)
from hrc_learn.demos.issue import DatasetError
from hrc_learn.demos.write.episode import (
    RecordingHeader,
    StagedEpisode,
    read_episode,
    staged_paths,
    staging_folder,
)
from hrc_learn.store import (
    DATASET,
    BusyError,
    Claim,
    delete_files,
    new_file,
    recover,
    replacing,
    resolved,
    source_of,
)

_PACKED = 256
"""Rows of the list of episodes that are held as Python objects, fifty times their size."""


@dataclass
class _Index:
    """The list of episodes as it grows, one row of `meta/episodes` each."""

    tasks: dict[str, None] = field(default_factory=dict)
    """Task texts in the order of their indices."""
    data_files: int = 0
    episodes: int = 0
    frames: int = 0
    _tables: list[pa.Table] = field(default_factory=list)
    _rows: list[dict] = field(default_factory=list)

    def carry(self, table: pa.Table) -> None:
        """Begin with the list of an earlier dataset."""
        self._tables.append(table)
        self.episodes += len(table)
        self.frames = table.column("dataset_to_index")[-1].as_py()

    def add(self, staged: StagedEpisode, file: int, videos: Mapping[str, object]) -> None:
        length = len(staged.table)
        self.tasks |= dict.fromkeys(staged.tasks)
        self._rows.append(
            {
                "episode_index": self.episodes,
                "tasks": list(staged.tasks),
                "length": length,
                "data/chunk_index": file // CHUNK_SIZE,
                "data/file_index": file % CHUNK_SIZE,
                "dataset_from_index": self.frames,
                "dataset_to_index": self.frames + length,
                **videos,
                **{
                    f"stats/{key}/{name}": values
                    for key, statistics in staged.statistics.items()
                    for name, values in statistics.items()
                },
                "meta/episodes/chunk_index": 0,
                "meta/episodes/file_index": 0,
            }
        )
        self.episodes += 1
        self.frames += length
        if len(self._rows) == _PACKED:
            self._pack()

    def _pack(self) -> None:
        names = dict.fromkeys(name for row in self._rows for name in row)
        columns = {name: [row.get(name) for row in self._rows] for name in names}
        self._tables.append(pa.table(columns))
        self._rows = []

    def table(self) -> pa.Table:
        """All rows."""
        if self._rows:
            self._pack()
        self._tables = [_joined(self._tables)]
        return self._tables[0]

    def count_videos(self, key: str) -> int:
        """How many files of a video the episodes are in so far."""
        if not self.episodes:
            return 0
        return 1 + _last_file(self.table(), f"videos/{key}")

    def statistics(self) -> Statistics:
        """Of the whole, for those features that all episodes have them for."""
        table, stacked = self.table(), {}
        for name in table.column_names:
            column = table.column(name)
            if name.startswith("stats/") and not column.null_count:
                key, _, statistic = name.removeprefix("stats/").rpartition("/")
                stacked.setdefault(key, {})[statistic] = np.array(column.to_pylist())
        return combined_statistics(stacked)


def assemble(
    paths: Sequence[Path],
    target: Path,
    *,
    earlier: Path | None = None,
    videos: Sequence[Segments] | None = None,
    tasks: Sequence[str] = (),
    share: bool = True,
) -> None:
    """Write the dataset of these staged episodes.

    Args:
        paths: Files of `episode.write_episode`, in order.
        target: Folder of the new dataset.
        earlier: A dataset of our own that they are appended to; it stays as it is, and
            its files get a second name in the new one.
        videos: Images of each episode; None: those that were recorded beside it.
        tasks: Task texts that have an index already, in its order.
        share: Let the dataset share its videos with where they come from, under a second
            name, instead of copying them.
    """
    header = read_episode(paths[0]).header
    for folder in ("meta/episodes/chunk-000", "data"):
        (target / folder).mkdir(parents=True)
    cameras = [key for key, f in header.features.items() if f["dtype"] == "video"]
    index = _carry_over(earlier, target) if earlier is not None else _Index()
    index.tasks |= dict.fromkeys(tasks)
    taken = {key: index.count_videos(key) for key in cameras}
    shelf = VideoPlacement(target, taken, share=share)
    if videos is None:
        videos = [_recorded_videos(path, cameras, header.fps) for path in paths]
    segments = iter(videos)
    for file, group in enumerate(_by_size(paths), start=index.data_files):
        for staged in _write_frames(target / place(DATA_PATH, file), header, group):
            columns: dict[str, object] = {}
            for key, segment in next(segments).items():
                columns |= shelf.columns(key, segment)
            index.add(staged, file, columns)
    sidecar = header.sidecar
    if earlier is not None and sidecar:
        # What was kept, or edited by hand, holds for the longer dataset too.
        before = read_sidecar(earlier)
        sidecar = sidecar | {"details": before.details | sidecar["details"]}
        if before.contract:
            sidecar["contract"] = before.contract
    _write_metadata(target, header, index, sidecar)


def _write_frames(
    path: Path, header: RecordingHeader, group: Sequence[Path]
) -> Iterator[StagedEpisode]:
    """Write a data file, one row group an episode."""
    path.parent.mkdir(exist_ok=True)
    schema = data_schema(read_episode(group[0]).table.schema, header.features)
    with pq.ParquetWriter(path, schema) as writer:
        for staged in map(read_episode, group):
            writer.write_table(staged.table.cast(schema))
            yield staged


def _by_size(paths: Sequence[Path]) -> Iterator[list[Path]]:
    """Group episodes into files of at most `FILE_SIZE_MB`, at least one episode each."""
    group, size = [], 0
    for path in paths:
        size += path.stat().st_size
        if group and size > FILE_SIZE_MB * 2**20:
            yield group
            group, size = [], path.stat().st_size
        group.append(path)
    yield group


def _write_metadata(
    target: Path, header: RecordingHeader, index: _Index, sidecar: dict[str, Any]
) -> None:
    tasks = list(index.tasks)
    write_tasks(target / "meta/tasks.parquet", tasks)
    pq.write_table(index.table(), target / EPISODES_PATH)
    content = info(
        header.features,
        header.fps,
        header.robot_type,
        episodes=index.episodes,
        frames=index.frames,
        tasks=len(tasks),
    )
    write_json(target / "meta/info.json", content)
    write_json(target / "meta/stats.json", index.statistics())
    if sidecar:
        write_json(target / SIDECAR_PATH, sidecar)


def _recorded_videos(path: Path, cameras: Sequence[str], fps: float) -> Segments:
    number = int(path.stem.rpartition("_")[2])
    seconds = pq.read_metadata(path).num_rows / fps
    return {
        key: VideoSegment(file=video_path(path.parent, key, number), start=0.0, stop=seconds)
        for key in cameras
    }


def _carry_over(earlier: Path, target: Path) -> _Index:
    """Give the frames and images of a dataset a second name in the new one."""
    folder = open_folder(earlier)
    files = [*(earlier / "data").glob("*/*.parquet"), *(earlier / "videos").glob("**/*.mp4")]
    for file in files:
        link(file, target / file.relative_to(earlier))
    listed = sorted((earlier / "meta/episodes").glob("*/*.parquet"))
    names = [str(path.relative_to(earlier)) for path in listed]
    tables = [read_table(open_parquet(earlier, name), name, None) for name in names]
    table = _joined(tables).sort_by("episode_index")
    for name in ("meta/episodes/chunk_index", "meta/episodes/file_index"):
        zeros = pa.array(np.zeros(len(table), np.int64))  # they are put into one file
        if name in table.column_names:
            table = table.drop_columns([name])
        table = table.append_column(name, zeros)
    index = _Index(
        tasks=dict.fromkeys(folder.tasks[i] for i in sorted(folder.tasks)),
        data_files=1 + _last_file(table, "data"),
    )
    index.carry(table)
    return index


def _joined(tables: Sequence[pa.Table]) -> pa.Table:
    """One table of all rows, whichever columns each has."""
    try:
        return pa.concat_tables(tables, promote_options="permissive")
    except pa.ArrowException:  # the same values in lists of another type
        rows = [row for table in tables for row in table.to_pylist()]
        names = dict.fromkeys(name for row in rows for name in row)
        return pa.table({name: [row.get(name) for row in rows] for name in names})


def _last_file(table: pa.Table, kind: str) -> int:
    """Number of the last file of data, or of a video, that a list of episodes names."""
    chunks, files = (table.column(f"{kind}/{part}_index").to_pylist() for part in _PARTS)
    return max(c * CHUNK_SIZE + f for c, f in zip(chunks, files, strict=True))


_PARTS = ("chunk", "file")


_RECORDING = "recording.json"
_EPISODE = "episode_[0-9][0-9][0-9][0-9][0-9][0-9]."
_FILES = (f"{_EPISODE}parquet", f"{_EPISODE}*.mp4", "*.unfinished.mp4", ".*.writing/*")
"""What a recording holds besides."""


def begin(root: Path, earlier_episodes: int | None) -> None:
    """Make the folder of a recording, whose claim is held.

    Args:
        root: The dataset it is to become, or to be appended to.
        earlier_episodes: Episodes of the dataset it is appended to; None: a new one.

    Raises:
        FileExistsError: `root` is already there, or may not be replaced by a longer one, or an
            interrupted recording of it holds episodes, or somebody else's folder has its name.
    """
    root, staging = resolved(root), staging_folder(root)
    if staging.is_dir() and not _is_recording(staging):
        raise FileExistsError(
            f"{staging} is no interrupted recording, and is left alone: move it away, or "
            f"choose another name than {root.name}"
        )
    if staging.is_dir() and (_is_done(root, staging) or not _episodes(staging)):
        discard(staging)  # nothing in it that the dataset lacks
    if earlier_episodes is None and os.path.lexists(root):
        raise FileExistsError(
            f"{root} already exists: choose another folder, remove it, or append to it "
            f"(append=True)"
        )
    try:
        staging.mkdir()
    except FileExistsError:
        raise FileExistsError(
            f"{staging} holds a recording that was interrupted: "
            f"{how_to_recover(root)} makes a dataset of its saved episodes; remove it to "
            f"start anew"
        ) from None
    _write(staging, earlier_episodes)


def recover_dataset(root: str | Path) -> Path:
    """Make the dataset of a recording that was broken off, from the episodes it had saved.

    Episodes that were being appended to a dataset are added to it; until then, and if none
    was saved, it stays as it was.

    Args:
        root: Folder that the recording was to become, or to be appended to.

    Returns:
        The same folder, now a dataset.

    Raises:
        BusyError: The recording is still going on.
        FileNotFoundError: There is no recording of that name; somebody else's folder is none.
        FileExistsError: There is a dataset of that name, and the recording was none of it.
        DatasetError: The recording held no saved episode; it is removed.
    """
    root = Path(root)
    if not _is_recording(staging_folder(root)):
        raise FileNotFoundError(f"no interrupted recording at {staging_folder(root)}")
    with Claim(root) as claim:
        finish(root, claim)
    return root


def finish(root: Path, claim: Claim) -> None:
    """Make or lengthen a dataset from its recording, and remove that; as `recover_dataset`."""
    root, staging = resolved(root), staging_folder(root)
    if not _is_done(root, staging):
        recording = _read(staging)
        episodes = recording["episodes"]
        if not _episodes(staging):
            discard(staging)
            if episodes is None:
                raise DatasetError("no episode was saved, so there is no dataset", file=root)
            return
        if episodes is None and os.path.lexists(root):
            raise FileExistsError(
                f"{root} already exists: remove {staging} if it is the same recording, or move "
                f"{root} away to make a dataset of it"
            )
        paths = staged_paths(staging, episodes or 0)
        with replacing(
            claim,
            DATASET,
            overwrite=episodes is not None,
            others="keep",
            source=recording["id"],
        ) as new:
            assemble(paths, new, earlier=None if episodes is None else root)
    discard(staging)


def discard(staging: Path) -> None:
    """Remove the folder of a recording, but nothing that somebody else put there."""
    # Last what tells that the rest is not needed any more: this may be broken off too.
    delete_files(staging, _FILES)
    if not delete_files(staging, [_RECORDING]):
        kept = (staging.with_name(f"{staging.name}.kept{n or ''}") for n in itertools.count())
        staging.rename(next(path for path in kept if not os.path.lexists(path)))


def recover_all(path: str | Path) -> list[str]:
    """Mend whatever interrupted programs left, of a path and of anything below it.

    Interrupted recordings become datasets, interrupted replacements are finished, and what was
    left unfinished is removed. What is still being written below `path` is left alone.

    Args:
        path: A dataset, folder of results or model, or a folder of such things.

    Returns:
        What was done, in words.

    Raises:
        BusyError: `path` itself is being written.
    """
    path = resolved(path)
    done = recover(path)
    suffix = staging_folder(path).name.removeprefix(path.name)
    for staging in [staging_folder(path), *path.glob(f"**/*{suffix}")]:
        if not _is_recording(staging):
            continue
        root = staging.with_name(staging.name.removesuffix(suffix))
        try:
            recover_dataset(root)
        except (BusyError, DatasetError, FileExistsError) as error:
            done.append(str(error))
        else:
            done.append(f"{root}: made of what an interrupted recording had saved")
    return done


def _read(staging: Path) -> dict[str, Any]:
    """Name of a recording, and of how many episodes the dataset is that it is appended to."""
    path = staging / _RECORDING
    if not path.is_file():  # broken off before it was named
        _write(staging, None)
    return json.loads(path.read_text(encoding="utf-8"))


def _write(staging: Path, earlier_episodes: int | None) -> None:
    with new_file(staging / _RECORDING) as part:
        content = {"id": uuid.uuid4().hex, "episodes": earlier_episodes}
        part.write_text(json.dumps(content), encoding="utf-8")


def _is_recording(staging: Path) -> bool:
    """Whether a folder is of a recording: it has its name first, and loses it last."""
    if not staging.is_dir():
        return False
    if (staging / _RECORDING).is_file():
        return True
    unnamed = (".writing", ".unfinished.mp4")
    return all(path.name.endswith(unnamed) for path in staging.iterdir())


def _episodes(staging: Path) -> bool:
    return any(staging.glob("episode_*.parquet"))


def _is_done(root: Path, staging: Path) -> bool:
    """Whether the dataset holds what was recorded: only the recording was not yet removed."""
    named = root.is_dir() and (staging / _RECORDING).is_file()
    return named and source_of(root) == _read(staging)["id"]
