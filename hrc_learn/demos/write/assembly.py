"""A LeRobot dataset of version 3.0 put together from staged episodes."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from hrc_learn.demos.format.dataset_folder import open_folder
from hrc_learn.demos.format.features import SIDECAR_PATH
from hrc_learn.demos.format.lerobot_v3 import (
    CHUNK_SIZE,
    DATA_PATH,
    EPISODES_PATH,
    FILE_SIZE_MB,
    Statistics,
    combined_statistics,
    data_schema,
    info,
    place,
    write_json,
    write_tasks,
)
from hrc_learn.demos.format.parquet import read_rows
from hrc_learn.demos.format.video_segments import Segments, VideoSegment, VideoShelf, link
from hrc_learn.demos.write.staging import RecordingHeader, StagedEpisode, read_episode
from hrc_learn.demos.write.video_encoder import video_path


@dataclass
class _Index:
    """The list of episodes as it grows, one row of `meta/episodes` each."""

    rows: list[dict] = field(default_factory=list)
    tasks: dict[str, None] = field(default_factory=dict)
    """Task texts in the order of their indices."""
    data_files: int = 0

    @property
    def frames(self) -> int:
        return self.rows[-1]["dataset_to_index"] if self.rows else 0

    def add(self, staged: StagedEpisode, file: int, videos: Mapping[str, object]) -> None:
        length = len(staged.table)
        self.tasks |= dict.fromkeys(staged.tasks)
        self.rows.append(
            {
                "episode_index": len(self.rows),
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

    def statistics(self) -> list[Statistics]:
        """Of each episode, for those features that all have them for."""
        keys = [name for name in self.rows[0] if name.startswith("stats/")]
        shared = [name for name in keys if all(name in row for row in self.rows)]
        episodes: list[Statistics] = []
        for row in self.rows:
            statistics: Statistics = {}
            for name in shared:
                key, _, statistic = name.removeprefix("stats/").rpartition("/")
                statistics.setdefault(key, {})[statistic] = row[name]
            episodes.append(statistics)
        return episodes


def assemble(
    paths: Sequence[Path],
    target: Path,
    *,
    earlier: Path | None = None,
    videos: Sequence[Segments] | None = None,
    tasks: Sequence[str] = (),
) -> None:
    """Write the dataset of these staged episodes.

    Args:
        paths: Files of `staging.write_episode`, in order.
        target: Folder of the new dataset.
        earlier: A dataset of our own that they are appended to; it stays as it is, and
            its files get a second name in the new one.
        videos: Images of each episode; None: those that were recorded beside it.
        tasks: Task texts that have an index already, in its order.
    """
    header = read_episode(paths[0]).header
    for folder in ("meta/episodes/chunk-000", "data"):
        (target / folder).mkdir(parents=True)
    cameras = [key for key, f in header.features.items() if f["dtype"] == "video"]
    index = _carry_over(earlier, target) if earlier is not None else _Index()
    index.tasks |= dict.fromkeys(tasks)
    taken = {key: _count_videos(index, key) for key in cameras}
    shelf = VideoShelf(target, taken)
    if videos is None:
        videos = [_recorded_videos(path, cameras, header.fps) for path in paths]
    segments = iter(videos)
    for file, group in enumerate(_by_size(paths), start=index.data_files):
        for staged in _write_frames(target / place(DATA_PATH, file), header, group):
            columns: dict[str, object] = {}
            for key, segment in next(segments).items():
                columns |= shelf.columns(key, segment)
            index.add(staged, file, columns)
    _write_metadata(target, header, index)


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


def _write_metadata(target: Path, header: RecordingHeader, index: _Index) -> None:
    tasks = list(index.tasks)
    write_tasks(target / "meta/tasks.parquet", tasks)
    names = dict.fromkeys(name for row in index.rows for name in row)
    columns = {name: [row.get(name) for row in index.rows] for name in names}
    pq.write_table(pa.table(columns), target / EPISODES_PATH)
    content = info(
        header.features,
        header.fps,
        header.robot_type,
        episodes=len(index.rows),
        frames=index.frames,
        tasks=len(tasks),
    )
    write_json(target / "meta/info.json", content)
    write_json(target / "meta/stats.json", combined_statistics(index.statistics()))
    if header.sidecar:
        write_json(target / SIDECAR_PATH, header.sidecar)


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
    rows = [
        row
        for path in sorted((earlier / "meta/episodes").glob("*/*.parquet"))
        for row in read_rows(earlier, str(path.relative_to(earlier)), ())
    ]
    rows.sort(key=lambda row: row["episode_index"])
    for row in rows:  # they are put into one file
        row |= {"meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0}
    last = max(row["data/chunk_index"] * CHUNK_SIZE + row["data/file_index"] for row in rows)
    tasks = dict.fromkeys(folder.tasks[i] for i in sorted(folder.tasks))
    return _Index(rows=rows, tasks=tasks, data_files=last + 1)


def _count_videos(index: _Index, key: str) -> int:
    numbers = [
        row[f"videos/{key}/chunk_index"] * CHUNK_SIZE + row[f"videos/{key}/file_index"]
        for row in index.rows
    ]
    return 1 + max(numbers, default=-1)
