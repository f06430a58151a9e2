"""Make or extend datasets of version 3.0 from recordings, even from interrupted recordings.

A recording is a folder `NAME.recording/`. Its file `recording.json` holds an identifier. If the
recording extends a dataset, the file also holds the number of episodes that the dataset had
before. The finished dataset keeps the identifier of its recording. If a program finishes the
dataset but stops before it removes the recording, the equal identifiers show that the dataset
already holds the recorded episodes.
"""

import itertools
import os
import shutil
import uuid
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from hrc_learn import store
from hrc_learn.demos import recorded_episode as recorded
from hrc_learn.demos.issues import DatasetError
from hrc_learn.demos.read import metadata
from hrc_learn.demos.read.contract import Sidecar, read_sidecar
from hrc_learn.demos.read.dataset_files import open_parquet, read_table, write_parquet
from hrc_learn.demos.read.dataset_folder import (
    episode_lists,
    open_folder,
    recovery_advice,
    staging_folder,
)
from hrc_learn.demos.videos import Segments, VideoSegment, video_path

_PACKED = 256
"""Largest number of episode rows that are kept as Python objects, which take fifty
times the memory of a table."""


def assemble(
    paths: Sequence[Path],
    target: Path,
    *,
    earlier: Path | None = None,
    videos: Sequence[Segments] | None = None,
    tasks: Sequence[str] = (),
) -> None:
    """Write a dataset from files that hold one episode each.

    Args:
        paths: Files written by `write_episode`, in order.
        target: Folder of the new dataset.
        earlier: Dataset to which the episodes are appended, written by this package. Its files
            are linked into the new dataset, or copied if links are impossible. The earlier
            dataset is not changed.
        videos: Video segments of each episode; their files are copied. None for the videos that
            were recorded with the episodes; these are linked where possible.
        tasks: Task texts that already have an index, in order of the index.
    """
    header = recorded.read_episode(paths[0])[0].header
    for folder in ("meta/episodes/chunk-000", "data"):
        (target / folder).mkdir(parents=True)
    cameras = [key for key, f in header.features.items() if f["dtype"] == "video"]
    listed = _EpisodeList(target, link_videos=videos is None)
    sidecar = header.sidecar
    tables: list[pa.Table] = []
    if earlier is not None:
        tables.append(_carry_over(earlier, listed, cameras))
        # The new dataset keeps the contract and the reference frames of the earlier dataset. It
        # also keeps the earlier details; a detail of the recording replaces one of equal name.
        before = read_sidecar(earlier)
        details = before.details | sidecar.details
        kept = {"contract": before.contract, "frames": before.frames}
        sidecar = replace(sidecar, details=details, **kept)
    listed.tasks |= dict.fromkeys(tasks)
    if videos is None:
        videos = [_recorded_videos(path, cameras, header.fps) for path in paths]
    segments = iter(videos)

    def rows() -> Iterator[dict]:
        for file, group in enumerate(_by_size(paths), start=listed.data_files):
            path = target / metadata.place(metadata.DATA_PATH, file)
            for staged, frames in _write_frames(path, header, group):
                yield listed.row(staged, frames, file, next(segments))

    tables += map(_table_of, itertools.batched(rows(), _PACKED))
    _write_metadata(target, header, listed, _concatenated(tables), sidecar)


class _EpisodeList:
    """Counters of a dataset under construction; makes the rows of `meta/episodes`.

    Attributes:
        target: Folder of the new dataset.
        tasks: Task texts in the order of their indices.
        data_files: Number of data files of the earlier dataset.
        episodes: Number of episodes so far.
        frames: Number of frames so far.
        videos: Camera -> number of its video files in the earlier dataset.
    """

    def __init__(self, target: Path, link_videos: bool):
        self.target = target
        self.tasks: dict[str, None] = {}
        self.data_files = self.episodes = self.frames = 0
        self.videos: dict[str, int] = {}
        self._link = link_videos
        self._placed: dict[str, dict[Path, int]] = {}

    def row(
        self, staged: recorded.EpisodeDescription, length: int, file: int, videos: Segments
    ) -> dict:
        """Put the videos of the next episode into the dataset; return the row of this episode.

        `file` is the number of the data file that holds the episode.
        """
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
        if staged.provenance:
            row["provenance"] = staged.provenance
        self.episodes += 1
        self.frames += length
        return row

    def _place_video(self, key: str, segment: VideoSegment) -> dict[str, int | float]:
        """Put the video file of a segment into the dataset, and return the segment's columns.

        A file with the videos of several episodes is put into the dataset only once.
        """
        placed = self._placed.setdefault(key, {})
        if segment.file not in placed:
            number = placed[segment.file] = self.videos.get(key, 0) + len(placed)
            path = metadata.place(metadata.VIDEO_PATH, number, video_key=key)
            put(segment.file, self.target / path, link=self._link)
        number = placed[segment.file]
        return {
            f"videos/{key}/chunk_index": number // metadata.CHUNK_SIZE,
            f"videos/{key}/file_index": number % metadata.CHUNK_SIZE,
            f"videos/{key}/from_timestamp": segment.start,
            f"videos/{key}/to_timestamp": segment.stop,
        }


def _table_of(rows: Sequence[dict]) -> pa.Table:
    """Table with the columns of all rows."""
    names = dict.fromkeys(name for row in rows for name in row)
    return pa.table({name: [row.get(name) for row in rows] for name in names})


def _concatenated(tables: Sequence[pa.Table]) -> pa.Table:
    """One list of all episodes; tables may differ in their columns."""
    try:
        table = pa.concat_tables(tables, promote_options="permissive")
    except pa.ArrowException:  # Arrow cannot unify the types of a column
        table = _table_of([row for table in tables for row in table.to_pylist()])
    places = ["meta/episodes/chunk_index", "meta/episodes/file_index"]
    table = table.drop_columns([name for name in places if name in table.column_names])
    for name in places:  # the list is a single file
        table = table.append_column(name, pa.array(np.zeros(len(table), np.int64)))
    return table


def _count_files(table: pa.Table, kind: str) -> int:
    """Number of files that a list of episodes uses; `kind` is "data" or "videos/CAMERA"."""
    chunks, files = (np.array(table[f"{kind}/{part}_index"]) for part in ("chunk", "file"))
    return 1 + int((chunks * metadata.CHUNK_SIZE + files).max())


def _write_frames(
    path: Path, header: recorded.RecordingHeader, group: Sequence[Path]
) -> Iterator[tuple[recorded.EpisodeDescription, int]]:
    """Write a data file, one row group per episode; yield each episode and its length."""
    path.parent.mkdir(exist_ok=True)
    schema = metadata.data_schema(recorded.read_episode(group[0])[1].schema, header.features)
    with pq.ParquetWriter(path, schema, write_page_checksum=True) as writer:
        for staged, table in map(recorded.read_episode, group):
            writer.write_table(table.cast(schema))
            yield staged, len(table)


def _by_size(paths: Sequence[Path]) -> Iterator[list[Path]]:
    """Group episodes into files of at most `FILE_SIZE_MB`, with at least one episode each."""
    group, size = [], 0
    for path in paths:
        size += path.stat().st_size
        if group and size > metadata.FILE_SIZE_MB * 2**20:
            yield group
            group, size = [], path.stat().st_size
        group.append(path)
    yield group


def _write_metadata(
    target: Path,
    header: recorded.RecordingHeader,
    listed: _EpisodeList,
    table: pa.Table,
    sidecar: Sidecar,
) -> None:
    tasks = list(listed.tasks)
    metadata.write_tasks(target / "meta/tasks.parquet", tasks)
    write_parquet(table, target / metadata.EPISODES_PATH)
    counts = {"episodes": listed.episodes, "frames": listed.frames, "tasks": len(tasks)}
    content = metadata.info_content(header.features, header.fps, header.robot_type, counts)
    metadata.dump_json(target / "meta/info.json", content)
    stacked: dict[str, dict[str, np.ndarray]] = {}
    for name in table.column_names:
        column = table.column(name)
        # The dataset gets statistics of a feature only if all episodes have them.
        if name.startswith("stats/") and not column.null_count:
            key, _, statistic = name.removeprefix("stats/").rpartition("/")
            stacked.setdefault(key, {})[statistic] = np.array(column.to_pylist())
    metadata.dump_json(target / "meta/stats.json", metadata.combined_statistics(stacked))
    if sidecar != Sidecar():
        metadata.dump_json(target / metadata.SIDECAR_PATH, sidecar)


def _carry_over(earlier: Path, listed: _EpisodeList, cameras: Sequence[str]) -> pa.Table:
    """Link the files of the earlier dataset into the new one, and set the counts of `listed`.

    Returns:
        List of episodes of the earlier dataset.
    """
    folder = open_folder(earlier)
    for file in (*earlier.glob("data/*/*.parquet"), *earlier.glob("videos/**/*.mp4")):
        put(file, listed.target / file.relative_to(earlier), link=True)
    tables = [read_table(open_parquet(earlier, n), n) for n in episode_lists(earlier)]
    table = _concatenated(tables).sort_by("episode_index")
    listed.episodes = len(table)
    listed.frames = table.column("dataset_to_index")[-1].as_py()
    listed.tasks |= dict.fromkeys(folder.tasks[i] for i in sorted(folder.tasks))
    listed.data_files = _count_files(table, "data")
    listed.videos = {key: _count_files(table, f"videos/{key}") for key in cameras}
    return table


def _recorded_videos(path: Path, cameras: Sequence[str], fps: float) -> Segments:
    number = recorded.episode_number(path)
    seconds = pq.read_metadata(path).num_rows / fps
    return {
        key: VideoSegment(file=video_path(path.parent, key, number), start=0.0, stop=seconds)
        for key in cameras
    }


def put(source: str | Path, target: str | Path, *, link: bool = True) -> None:
    """Hard-link a file to `target`, or copy it if `link` is False or the link fails."""
    target = Path(target)
    target.parent.mkdir(parents=True, exist_ok=True)
    if link:
        try:
            target.hardlink_to(source)
            return
        except OSError:  # a file system without links
            pass
    shutil.copyfile(source, target)


_RECORDING = "recording.json"
_EPISODE = "episode_[0-9][0-9][0-9][0-9][0-9][0-9]."
_FILES = (f"{_EPISODE}parquet", f"{_EPISODE}*.mp4", "*.unfinished.mp4", ".*.writing/*")
"""`_RECORDING`: file with the header of a recording. `_FILES`: patterns of its other files."""


@dataclass(frozen=True, kw_only=True)
class _Recording:
    """Header of a recording."""

    id: str = field(default_factory=lambda: uuid.uuid4().hex)
    episodes: store.Count | None = None
    """Number of episodes of the dataset that the recording extends; None for a new dataset."""


def begin(root: Path, earlier_episodes: int | None) -> None:
    """Make the folder of a recording. The caller must hold the `store.Claim` of `root`.

    Args:
        root: Dataset to be made or extended.
        earlier_episodes: Number of episodes of the dataset to extend; None for a new dataset.

    Raises:
        FileExistsError: `root` exists and is not to be extended, an interrupted recording of
            it holds episodes, or a foreign folder has the name of the recording.
    """
    root, staging = store.resolved(root), staging_folder(root)
    if staging.is_dir():
        if not _is_recording(staging):
            text = f"{staging} is no interrupted recording and is not touched: move it away"
            raise FileExistsError(f"{text}, or choose another name than {root.name}")
        if _is_done(root, staging) or not _has_episodes(staging):
            discard(staging)  # no episode is lost
    if earlier_episodes is None and os.path.lexists(root):
        text = f"{root} already exists: choose another folder, remove it, or append to it"
        raise FileExistsError(f"{text} (append=True)")
    try:
        staging.mkdir()
    except FileExistsError:
        text = (
            f"{staging} holds an interrupted recording: {recovery_advice(root)} makes a "
            "dataset of its saved episodes; remove the folder to start anew"
        )
        raise FileExistsError(text) from None
    try:
        store.write_json(staging / _RECORDING, _Recording(episodes=earlier_episodes))
    except OSError:
        staging.rmdir()  # an empty folder would look like an interrupted recording
        raise


def finish(root: Path, claim: store.Claim) -> None:
    """Make or extend a dataset from its recording, then remove the recording.

    Raises:
        DatasetError: The dataset would be new, but no episode was saved, or the dataset to be
            extended holds another number of episodes than before.
        FileExistsError: The dataset would be new, but `root` exists already.
    """
    root, staging = store.resolved(root), staging_folder(root)
    if not _is_done(root, staging):
        header = _read_header(staging)
        episodes = header.episodes
        if not _has_episodes(staging):
            discard(staging)
            if episodes is None:
                raise DatasetError("no episode was saved, so there is no dataset", file=root)
            return
        if episodes is not None and (now := len(open_folder(root).episodes)) != episodes:
            text = f"holds {now} episodes, but {episodes} when the recording began: restore it"
            raise DatasetError(f"{text}, or move {staging} away", file=root)
        if episodes is None and os.path.lexists(root):
            text = f"{root} already exists: remove {staging} if both hold the same recording"
            raise FileExistsError(f"{text}, or move {root} away to finish the recording")
        paths = recorded.staged_paths(staging, episodes or 0)
        with store.replacing(
            claim, store.DATASET, overwrite=episodes is not None, source=header.id
        ) as new:
            assemble(paths, new, earlier=None if episodes is None else root)
    discard(staging)


def recover_dataset(root: str | Path) -> Path:
    """Make the dataset of an interrupted recording from its saved episodes.

    If the recording was to extend a dataset, its episodes are appended to that dataset. Without
    saved episodes, that dataset stays as it was.

    Args:
        root: Folder of the dataset that was being recorded.

    Returns:
        The same folder, now a dataset.

    Raises:
        BusyError: The recording is still in progress.
        FileNotFoundError: There is no interrupted recording of this dataset.
        FileExistsError: The dataset would be new, but `root` exists already.
        DatasetError: The dataset would be new, but no episode was saved. The recording is then
            removed.
    """
    root = Path(root)
    if not _is_recording(staging_folder(root)):
        raise FileNotFoundError(f"no interrupted recording at {staging_folder(root)}")
    with store.Claim(root) as claim:
        finish(root, claim)
    return root


def recover_all(path: str | Path) -> list[str]:
    """Repair everything that interrupted programs left at a path and below it.

    Interrupted recordings become datasets, interrupted replacements are finished, and
    unfinished files are removed. Files that are still being written below `path` are left
    alone.

    Args:
        path: A dataset, a results folder, a model, or a folder that contains any of these.

    Returns:
        Descriptions of the actions taken.

    Raises:
        BusyError: `path` itself is being written.
    """
    path = store.resolved(path)
    done = store.recover(path)
    suffix = staging_folder(path).name.removeprefix(path.name)
    for staging in [staging_folder(path), *path.glob(f"**/*{suffix}")]:
        if not _is_recording(staging):
            continue
        root = staging.with_name(staging.name.removesuffix(suffix))
        try:
            recover_dataset(root)
        except (store.BusyError, DatasetError, FileExistsError) as error:
            done.append(str(error))
        else:
            done.append(f"{root}: made from the saved episodes of an interrupted recording")
    return done


def discard(staging: Path) -> None:
    """Remove the folder of a recording; if foreign files remain in the folder, rename it."""
    # The header is removed last: after an interruption, it still identifies the folder.
    store.delete_files(staging, _FILES)
    if not store.delete_files(staging, [_RECORDING]):
        kept = (staging.with_name(f"{staging.name}.kept{n or ''}") for n in itertools.count())
        staging.rename(next(path for path in kept if not os.path.lexists(path)))


def _read_header(staging: Path) -> _Recording:
    """Read the header of a recording; create the header if it was not written yet."""
    path = staging / _RECORDING
    if not path.is_file():
        store.write_json(path, _Recording())
    return store.read_json(path, _Recording, "move the recording away")


def _is_recording(staging: Path) -> bool:
    """True for a folder with a recording's header, for an empty folder, and for a folder with
    unfinished files only.
    """
    if not staging.is_dir():
        return False
    if (staging / _RECORDING).is_file():
        return True
    unnamed = (".writing", ".unfinished.mp4")
    return all(path.name.endswith(unnamed) for path in staging.iterdir())


def _has_episodes(staging: Path) -> bool:
    return any(staging.glob("episode_*.parquet"))


def _is_done(root: Path, staging: Path) -> bool:
    """True if the dataset already holds the episodes of its recording (equal identifiers)."""
    named = root.is_dir() and (staging / _RECORDING).is_file()
    return named and store.source_of(root) == _read_header(staging).id
