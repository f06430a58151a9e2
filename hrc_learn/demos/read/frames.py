"""Frames of episodes as raw arrays, in the types and units they have on disk."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby, repeat

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from jaxtyping import Float64, Shaped

from hrc_learn.demos.issues import DatasetError
from hrc_learn.demos.read.columns import ColumnMapping, ColumnSelection
from hrc_learn.demos.read.dataset_files import open_parquet, read_table, row_group_starts
from hrc_learn.demos.read.dataset_folder import DatasetFolder, EpisodeEntry
from hrc_learn.demos.read.units import Quantities

RawFrames = dict[str, Shaped[np.ndarray, "_frames _components"]]
"""Column -> its values during one episode, in the type and unit on disk."""

_BATCH_ROWS = 2**16
"""Number of frames read at a time: enough for the full speed of a disk, and little memory."""


def read_frames(
    folder: DatasetFolder, entries: Sequence[EpisodeEntry], keys: Sequence[str]
) -> Iterator[tuple[EpisodeEntry, RawFrames]]:
    """Columns of episodes; arguments as in `read_each`.

    Raises:
        DatasetError: A file or column is missing or damaged, a column is not as wide as
            declared, or the rows contradict the metadata.
    """
    yield from zip(entries, raising(read_each(folder, entries, keys)), strict=True)


def raising[T](found: Iterable[T | DatasetError]) -> Iterator[T]:
    """Yield the items, and raise the first error among them."""
    for item in found:
        if isinstance(item, DatasetError):
            raise item
        yield item


def read_each(
    folder: DatasetFolder,
    entries: Sequence[EpisodeEntry],
    keys: Sequence[str],
    strict: bool = True,
) -> Iterator[RawFrames | DatasetError]:
    """Read columns of every episode; for an episode that cannot be read, give the error.

    At most about 65,000 frames are in memory at a time, or one row group if that is larger. No
    row group is read twice unless it is damaged.

    Args:
        folder: The dataset.
        entries: Episodes wanted, in any order; the order on disk is the fastest.
        keys: Columns wanted; LeRobot's own index columns are added where they exist.
        strict: Check the rows against the metadata. False reads only the wanted columns,
            without checks.
    """
    for file, group in groupby(entries, key=lambda entry: entry.file):
        listed = list(group)
        try:
            parquet = open_parquet(folder.root, file, listed[0].index)
            if strict:
                require_rows(folder, file, parquet.metadata.num_rows)
            existing = parquet.schema_arrow.names
            for key in (key for key in keys if key not in existing):
                text = "the column is declared in meta/info.json, but missing"
                raise DatasetError(text, file=file, key=key)
        except DatasetError as error:
            yield from repeat(error, len(listed))
            continue
        indices = ("timestamp", "episode_index", "task_index") if strict else ()
        wanted = [*dict.fromkeys([*keys, *(key for key in indices if key in existing)])]
        for batch in _batches(listed, row_group_starts(parquet.metadata)):
            yield from _read_batch(folder, parquet, batch, wanted, strict)


def _batches(
    entries: Sequence[EpisodeEntry], group_starts: Sequence[int]
) -> Iterator[list[EpisodeEntry]]:
    """Batches of a file's episodes.

    A batch ends at a gap, at a backward jump, or, with `_BATCH_ROWS` rows, at a row group.
    """
    batch: list[EpisodeEntry] = []
    rows, last_group = 0, -1
    for entry in entries:
        ends = [entry.start, entry.start + max(entry.length, 1) - 1]
        first, last = np.searchsorted(group_starts, ends, side="right") - 1
        skips = first > last_group + 1 or (batch and entry.start <= batch[-1].start)
        if batch and (skips or (rows >= _BATCH_ROWS and first > last_group)):
            yield batch
            batch, rows = [], 0
        batch.append(entry)
        rows += entry.length
        last_group = last
    if batch:
        yield batch


def _read_batch(
    folder: DatasetFolder,
    parquet: pq.ParquetFile,
    entries: list[EpisodeEntry],
    keys: Sequence[str],
    strict: bool,
) -> Iterator[RawFrames | DatasetError]:
    """Read episodes of one file together, or one by one if this fails."""
    first = min(entry.start for entry in entries)
    try:
        columns = _read_rows(folder, parquet, entries, keys)
    except DatasetError as error:
        if len(entries) == 1:
            yield error
            return
        for entry in entries:
            yield from _read_batch(folder, parquet, [entry], keys, strict)
        return
    for entry in entries:
        own = slice(entry.start - first, entry.start - first + entry.length)
        frames = {key: values[own] for key, values in columns.items()}
        yield (_misplaced(entry, frames) if strict else None) or frames


def _read_rows(
    folder: DatasetFolder,
    parquet: pq.ParquetFile,
    entries: list[EpisodeEntry],
    keys: Sequence[str],
) -> RawFrames:
    """Columns of a file from the first frame of the episodes to the last."""
    file, first = entries[0].file, min(entry.start for entry in entries)
    rows = slice(first, max(entry.start + entry.length for entry in entries))
    table = read_table(parquet, file, keys, rows)
    columns = {}
    for key in table.column_names:

        def fault(row: int, message: str, key: str = key) -> DatasetError:
            place = row + first
            entry = next(e for e in entries if e.start <= place < e.start + e.length)
            return entry.error(message, frame=place - entry.start, key=key)

        columns[key] = to_numpy(table.column(key), fault)
        feature, width = folder.features.get(key), columns[key].shape[1]
        if feature is not None and len(columns[key]) and width != feature.width:
            shape = list(feature.shape)
            text = f"has {width} components, but meta/info.json declares the shape {shape}"
            raise DatasetError(text, file=file, key=key)
    return columns


def require_rows(folder: DatasetFolder, file: str, rows: int) -> None:
    """Check the number of frames in a file against the list of episodes.

    Raises:
        DatasetError: The file holds more or fewer frames.
    """
    entries = folder.files[file]
    promised = max(entry.start + entry.length for entry in entries)
    if rows != promised:
        text = (
            f"holds {rows} frames, but the list of episodes promises {promised}: frames were "
            f"lost or repeated, the save of an episode failed (hrc repair recovers it), or the "
            f"metadata belong to another copy"
        )
        episode = entries[0].index if len(entries) == 1 else None
        raise DatasetError(text, file=file, episode=episode)


def _misplaced(entry: EpisodeEntry, frames: RawFrames) -> DatasetError | None:
    """Fault of an episode without frames, or with frames of another episode."""
    if not entry.length:
        return entry.error("has no frames")
    owners = frames.get("episode_index", np.full((1, 1), entry.index))[:, 0]
    wrong = np.flatnonzero(owners != entry.index)
    if not len(wrong):
        return None
    text = (
        f"the frame belongs to episode {int(owners[wrong[0]])} by its episode_index: the "
        f"offsets in the list of episodes are wrong"
    )
    return entry.error(text, frame=int(wrong[0]), key="episode_index")


@dataclass(frozen=True, kw_only=True)
class RawEpisode:
    """One episode in the units on disk."""

    entry: EpisodeEntry
    frames: RawFrames
    quantities: Quantities


def read_quantities(
    folder: DatasetFolder,
    columns: ColumnMapping,
    entries: Sequence[EpisodeEntry],
    roles: Iterable[str] | None = None,
) -> Iterator[RawEpisode | DatasetError]:
    """Read the quantities of every episode; for an episode that cannot be read, give the error.

    Args:
        folder: The dataset.
        columns: Meaning of its columns.
        entries: Episodes wanted, as in `read_each`.
        roles: Quantities wanted; None for all quantities and all extra columns.
    """
    selections, extra = columns.selections, columns.extra
    if roles is not None:
        selections, extra = {role: selections[role] for role in roles}, ()
    keys = {key for s in selections.values() for key, _ in s.columns} | {*extra}
    read = read_each(folder, entries, sorted(keys))
    for entry, frames in zip(entries, read, strict=True):
        if isinstance(frames, DatasetError):
            yield frames
            continue
        quantities = select_quantities(frames, selections)
        fault = _not_finite(entry, quantities, selections)
        yield fault or RawEpisode(entry=entry, frames=frames, quantities=quantities)


def _not_finite(
    entry: EpisodeEntry, quantities: Quantities, selections: Mapping[str, ColumnSelection]
) -> DatasetError | None:
    """Error for the first value that is not finite.

    While the image feature is not visible, its values that are not finite become 0 instead.
    """
    seen = quantities.get("feature_visible")
    for role, values in quantities.items():
        # If the sum is finite, all values are. The sum is far cheaper than a mask.
        if np.isfinite(values.sum()):
            continue
        bad = ~np.isfinite(values)
        if role == "feature" and seen is not None:
            values[bad & (seen == 0)] = 0.0
            bad &= seen != 0
        if bad.any():
            frame, component = (int(i) for i in np.argwhere(bad)[0])
            text = (
                f"{role} is {values[frame, component]} there; leave the episode out "
                f"(episodes=[...]) or repair the recording"
            )
            return entry.error(text, frame=frame, key=selections[role].column_name(component))
    return None


def select_quantities(
    frames: RawFrames, selections: Mapping[str, ColumnSelection]
) -> Quantities:
    """Values of every role in the units on disk."""
    return {role: _values(frames, selection.columns) for role, selection in selections.items()}


def _values(
    frames: RawFrames, columns: Sequence[tuple[str, int]]
) -> Float64[np.ndarray, "frames components"]:
    keys = {key for key, _ in columns}
    if len(keys) > 1:
        return np.stack([frames[key][:, index] for key, index in columns], axis=1).astype(float)
    values, indices = frames[keys.pop()], [index for _, index in columns]
    if indices == list(range(indices[0], indices[-1] + 1)):  # a view: no copy before astype
        return values[:, indices[0] : indices[-1] + 1].astype(float)
    return values[:, indices].astype(float)


def recorded_stamps(folder: DatasetFolder, frames: RawFrames) -> Float64[np.ndarray, " frames"]:
    """LeRobot's own stamps of one episode, or stamps 1/fps apart if there are none [s]."""
    if "timestamp" in frames:
        return frames["timestamp"][:, 0].astype(float)
    return np.arange(len(next(iter(frames.values())))) / folder.fps


def frame_timestamps(
    folder: DatasetFolder,
    entry: EpisodeEntry,
    frames: RawFrames,
    true_stamps: Float64[np.ndarray, "frames 1"] | None,
) -> Float64[np.ndarray, " frames"]:
    """Stamps of one episode [s].

    The column of measured times, `true_stamps`, is preferred. LeRobot's own `timestamp` is
    frame / fps by definition. If its values agree with frame / fps to the resolution of
    float32, the stamps are computed anew in float64.

    Raises:
        DatasetError: The stamps do not increase.
    """
    time, key = recorded_stamps(folder, frames), "timestamp"
    if true_stamps is not None:
        time, key = true_stamps[:, 0], "time"
    stalled = np.flatnonzero(~(np.diff(time) > 0))
    if len(stalled):
        k = int(stalled[0])
        text = (
            f"stamps must increase, but go from {time[k]:.6f} s to {time[k + 1]:.6f} s: "
            f"drop the repeated frames (hrc repair), or ignore the column of recorded times by "
            f"mapping={{'time': None}}: frames are then 1/fps apart"
        )
        raise entry.error(text, frame=k + 1, key=key)
    resolution = 2 * np.finfo(np.float32).eps * max(1.0, float(np.abs(time).max()))
    regular = time[0] + np.arange(entry.length) / folder.fps
    if key == "timestamp" and (np.abs(time - regular) <= resolution).all():
        return regular
    return time


def to_numpy(
    column: pa.ChunkedArray, fault: Callable[[int, str], DatasetError]
) -> Shaped[np.ndarray, "rows components"]:
    """Values of a Parquet column in their own type, nested lists flattened.

    Args:
        column: Numbers, or lists of equal length.
        fault: Function that makes the error for a row, from the row's number and a message.

    Raises:
        DatasetError: A value is missing, or rows differ in their number of components.
    """
    try:
        array = pa.concat_arrays(column.chunks or [pa.array([], column.type)])
    except (pa.ArrowException, TypeError) as error:
        raise fault(0, f"cannot be read: {error}") from error
    rows = len(array)
    while True:
        if array.null_count:
            at = int(np.flatnonzero(_without_pandas(array.is_null()))[0])
            raise fault(at * rows // len(array), "holds no value (null)")
        if isinstance(array, pa.ExtensionArray):
            array = array.storage
        elif isinstance(array, pa.ListArray | pa.LargeListArray | pa.FixedSizeListArray):
            widths = _without_pandas(array.value_lengths())
            differing = np.flatnonzero(widths != widths[0]) if len(widths) else []
            if len(differing):
                row = int(differing[0]) * rows // len(array)
                found, expected = int(widths[differing[0]]), int(widths[0])
                raise fault(row, f"holds {found} components, the first row {expected}")
            array = array.flatten()
        else:
            break
    kinds = (pa.types.is_integer, pa.types.is_floating, pa.types.is_boolean)
    if not any(is_kind(array.type) for is_kind in kinds):
        raise fault(0, f"holds {array.type}, not numbers")
    values = _without_pandas(array)
    return values.reshape(rows, len(values) // rows if rows else 0)


def _without_pandas(array: pa.Array) -> Shaped[np.ndarray, " values"]:
    """Values of an array of numbers; pyarrow's own `to_numpy` imports pandas, which is slow."""
    if pa.types.is_boolean(array.type):  # packed to bits, which numpy cannot view
        return np.from_dlpack(array.cast(pa.uint8())).astype(bool)
    return np.from_dlpack(array)
