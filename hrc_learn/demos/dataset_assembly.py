"""Assembly of a dataset of version 3.0 from saved episodes, new or as an extension."""

import shutil
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from hrc_learn.demos.read import metadata
from hrc_learn.demos.read.dataset_files import open_parquet, read_table, write_parquet
from hrc_learn.demos.read.dataset_folder import episode_lists, open_folder
from hrc_learn.demos.recorded_episode import (
    RecordingHeader,
    StagedEpisode,
    episode_number,
    read_episode,
)
from hrc_learn.demos.videos import Segments, VideoSegment, video_path

_PACKED = 256
"""Rows of the list of episodes held as Python objects, which take fifty times their size."""


def assemble(
    paths: Sequence[Path],
    target: Path,
    *,
    earlier: Path | None = None,
    videos: Sequence[Segments] | None = None,
    tasks: Sequence[str] = (),
    link_videos: bool = True,
) -> None:
    """Write the dataset of staged episodes.

    Args:
        paths: Files written by `episode.write_episode`, in order.
        target: Folder of the new dataset.
        earlier: Dataset written by this package that the episodes are appended to. It is not
            changed; its files get a second name in the new dataset.
        videos: Video segments of each episode; None for those recorded with the episodes.
        tasks: Task texts that have an index already, in its order.
        link_videos: Give videos a second name in the dataset instead of copying them.
    """
    header = read_episode(paths[0]).header
    for folder in ("meta/episodes/chunk-000", "data"):
        (target / folder).mkdir(parents=True)
    cameras = [key for key, f in header.features.items() if f["dtype"] == "video"]
    listed = _EpisodeList(target, link_videos)
    sidecar = header.sidecar
    if earlier is not None:
        _carry_over(earlier, listed, cameras)
        # Details and contract kept with the earlier dataset also hold for the longer one.
        before = metadata.read_sidecar(earlier)
        details = before.details | sidecar.details
        sidecar = replace(sidecar, details=details, contract=before.contract)
    listed.tasks |= dict.fromkeys(tasks)
    if videos is None:
        videos = [_recorded_videos(path, cameras, header.fps) for path in paths]
    segments = iter(videos)
    for file, group in enumerate(_by_size(paths), start=listed.data_files):
        for staged in _write_frames(
            target / metadata.place(metadata.DATA_PATH, file), header, group
        ):
            listed.add(staged, file, next(segments))
    _write_metadata(target, header, listed, sidecar)


class _EpisodeList:
    """List of episodes as it grows, one row of `meta/episodes` each.

    Attributes:
        target: Folder of the new dataset.
        tasks: Task texts in the order of their indices.
        data_files: Number of data files of an earlier dataset.
        episodes: Number of episodes.
        frames: Number of frames.
        videos: Number of video files of each camera.
    """

    def __init__(self, target: Path, link_videos: bool):
        self.target = target
        self.tasks: dict[str, None] = {}
        self.data_files = self.episodes = self.frames = 0
        self.videos: dict[str, int] = {}
        self._link = link_videos
        self._placed: dict[tuple[str, Path], int] = {}
        self._tables: list[pa.Table] = []
        self._rows: list[dict] = []

    def carry(self, table: pa.Table) -> None:
        """Begin with the list of an earlier dataset."""
        self._tables.append(table)
        self.episodes += len(table)
        self.frames = table.column("dataset_to_index")[-1].as_py()

    def add(self, staged: StagedEpisode, file: int, videos: Segments) -> None:
        """Append an episode of a data file, and place its videos."""
        length = len(staged.table)
        self.tasks |= dict.fromkeys(staged.tasks)
        row = {
            "episode_index": self.episodes,
            "tasks": list(staged.tasks),
            "length": length,
            "data/chunk_index": file // metadata.CHUNK_SIZE,
            "data/file_index": file % metadata.CHUNK_SIZE,
            "dataset_from_index": self.frames,
            "dataset_to_index": self.frames + length,
        }
        for key, segment in videos.items():
            row |= self._place_video(key, segment)
        for key, statistics in staged.statistics.items():
            row |= {f"stats/{key}/{name}": values for name, values in statistics.items()}
        row |= {"meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0}
        self._rows.append(row)
        self.episodes += 1
        self.frames += length
        if len(self._rows) == _PACKED:
            self._pack()

    def _place_video(self, key: str, segment: VideoSegment) -> dict[str, int | float]:
        """Place the file of a segment, once for all episodes in it."""
        if (key, segment.file) not in self._placed:
            number = self.videos.get(key, 0)
            path = self.target / metadata.place(metadata.VIDEO_PATH, number, video_key=key)
            _put(segment.file, path, link=self._link)
            self.videos[key], self._placed[key, segment.file] = number + 1, number
        number = self._placed[key, segment.file]
        return {
            f"videos/{key}/chunk_index": number // metadata.CHUNK_SIZE,
            f"videos/{key}/file_index": number % metadata.CHUNK_SIZE,
            f"videos/{key}/from_timestamp": segment.start,
            f"videos/{key}/to_timestamp": segment.stop,
        }

    def _pack(self) -> None:
        self._tables.append(_table_of(self._rows))
        self._rows = []

    def table(self) -> pa.Table:
        """All rows."""
        if self._rows:
            self._pack()
        return _concatenated(self._tables)


def _table_of(rows: Sequence[dict]) -> pa.Table:
    names = dict.fromkeys(name for row in rows for name in row)
    return pa.table({name: [row.get(name) for row in rows] for name in names})


def _concatenated(tables: Sequence[pa.Table]) -> pa.Table:
    """One table of all rows; tables may differ in their columns."""
    try:
        return pa.concat_tables(tables, promote_options="permissive")
    except pa.ArrowException:  # the same values in lists of another type
        return _table_of([row for table in tables for row in table.to_pylist()])


def _count_files(table: pa.Table, kind: str) -> int:
    """Number of files of data, or of a video, in a list of episodes."""
    chunks, files = (
        table.column(f"{kind}/{part}_index").to_pylist() for part in ("chunk", "file")
    )
    return 1 + max(c * metadata.CHUNK_SIZE + f for c, f in zip(chunks, files, strict=True))


def _write_frames(
    path: Path, header: RecordingHeader, group: Sequence[Path]
) -> Iterator[StagedEpisode]:
    """Write a data file, one row group per episode."""
    path.parent.mkdir(exist_ok=True)
    schema = metadata.data_schema(read_episode(group[0]).table.schema, header.features)
    with pq.ParquetWriter(path, schema, write_page_checksum=True) as writer:
        for staged in map(read_episode, group):
            writer.write_table(staged.table.cast(schema))
            yield staged


def _by_size(paths: Sequence[Path]) -> Iterator[list[Path]]:
    """Group episodes into files of at most `FILE_SIZE_MB`, at least one episode each."""
    group, size = [], 0
    for path in paths:
        size += path.stat().st_size
        if group and size > metadata.FILE_SIZE_MB * 2**20:
            yield group
            group, size = [], path.stat().st_size
        group.append(path)
    yield group


def _write_metadata(
    target: Path, header: RecordingHeader, listed: _EpisodeList, sidecar: metadata.Sidecar
) -> None:
    table, tasks = listed.table(), list(listed.tasks)
    metadata.write_tasks(target / "meta/tasks.parquet", tasks)
    write_parquet(table, target / metadata.EPISODES_PATH)
    content = metadata.info_content(
        header.features,
        header.fps,
        header.robot_type,
        episodes=listed.episodes,
        frames=listed.frames,
        tasks=len(tasks),
    )
    metadata.dump_json(target / "meta/info.json", content)
    stacked: dict[str, dict[str, np.ndarray]] = {}
    for name in table.column_names:
        column = table.column(name)
        # Features with statistics in all episodes have some for the dataset.
        if name.startswith("stats/") and not column.null_count:
            key, _, statistic = name.removeprefix("stats/").rpartition("/")
            stacked.setdefault(key, {})[statistic] = np.array(column.to_pylist())
    metadata.dump_json(target / "meta/stats.json", metadata.combined_statistics(stacked))
    if sidecar != metadata.Sidecar():
        metadata.dump_json(target / metadata.SIDECAR_PATH, sidecar)


def _carry_over(earlier: Path, listed: _EpisodeList, cameras: Sequence[str]) -> None:
    """Give the data and videos of a dataset a second name in the new one."""
    folder = open_folder(earlier)
    for file in (*earlier.glob("data/*/*.parquet"), *earlier.glob("videos/**/*.mp4")):
        _put(file, listed.target / file.relative_to(earlier), link=True)
    tables = [read_table(open_parquet(earlier, n), n) for n in episode_lists(earlier)]
    table = _concatenated(tables).sort_by("episode_index")
    for name in ("meta/episodes/chunk_index", "meta/episodes/file_index"):
        zeros = pa.array(np.zeros(len(table), np.int64))  # the new list is one file
        if name in table.column_names:
            table = table.drop_columns([name])
        table = table.append_column(name, zeros)
    listed.carry(table)
    listed.tasks |= dict.fromkeys(folder.tasks[i] for i in sorted(folder.tasks))
    listed.data_files = _count_files(table, "data")
    listed.videos = {key: _count_files(table, f"videos/{key}") for key in cameras}


def _recorded_videos(path: Path, cameras: Sequence[str], fps: float) -> Segments:
    number = episode_number(path)
    seconds = pq.read_metadata(path).num_rows / fps
    return {
        key: VideoSegment(file=video_path(path.parent, key, number), start=0.0, stop=seconds)
        for key in cameras
    }


def _put(source: Path, target: Path, *, link: bool) -> None:
    """Copy a file, or give it a second name: both exist until the dataset is complete."""
    target.parent.mkdir(parents=True, exist_ok=True)
    if link:
        try:
            target.hardlink_to(source)
            return
        except OSError:  # a file system without links
            pass
    shutil.copyfile(source, target)
