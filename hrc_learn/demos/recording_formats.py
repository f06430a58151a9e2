"""Readers of recordings: numpy, text, Parquet, HDF5, zarr, MATLAB, RLDS, bags and folders.

To add a format, write a reader and list its suffix in `READERS`.
"""

import contextlib
import json
import re
import warnings
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from itertools import repeat
from pathlib import Path
from typing import Any

import numpy as np

from hrc_learn.demos.issues import DatasetError
from hrc_learn.demos.recording_bags import read_bag
from hrc_learn.demos.recording_files import (
    UNNAMED,
    Field,
    Recording,
    StreamRead,
    array_field,
    make_field,
    natural,
    split_episodes,
    unit_in_words,
)
from hrc_learn.demos.recording_tables import read_parquet_table, read_text_table
from hrc_learn.demos.videos import Image, VideoSegment, decode

_VIDEOS = (".mp4", ".avi", ".mkv", ".mov", ".webm")
_PICKLES = (".pkl", ".pickle", ".pt", ".pth", ".joblib")
_RATES = ("fps", "control_freq", "control_frequency", "frequency", "rate", "hz")
"""Attributes that hold a frame rate [1/s]."""
_TASKS = ("task", "language_instruction", "instruction", "lang", "task_description")
_PICKLED = "holds pickled Python objects: save it again as numbers"
_LINK = "is a link, which is not followed"


def open_recordings(path: Path, columns: Sequence[str] = ()) -> list[Recording]:
    """Open the episodes of a file or folder; no frames are read before they are used.

    Args:
        path: File of one of the formats in `READERS`, a zarr store, or a folder of such files.
        columns: Names for the columns of a .npy file, or of a text file without a header.

    Raises:
        DatasetError: The path is missing, of an unknown format, damaged, or has links.
    """
    reader = _reader_of(path)
    try:
        if reader in (_read_text, read_numpy, _read_folder):
            return reader(path, columns)
        return reader(path)
    except (DatasetError, ModuleNotFoundError):
        raise
    except Exception as error:  # foreign files may raise any error
        raise DatasetError(f"cannot be read ({error}): copy it again", file=path) from error


def _reader_of(path: Path) -> Callable[..., list[Recording]]:
    if path.is_dir() and (path / "meta" / "info.json").is_file():
        text = "is a LeRobot dataset already: use `hrc check`, `hrc repair` or `hrc merge`"
        raise DatasetError(text, file=path)
    if not path.is_dir() and not path.is_file():
        raise DatasetError("not found", file=path)
    if (reader := _known_reader(path)) or path.is_dir():
        return reader or _read_folder
    name = path.name.lower()
    if name.endswith(_VIDEOS):
        raise DatasetError("is a video: give the folder of the video and its states", file=path)
    if name.endswith(_PICKLES):
        text = "is a pickle, which can run any program when it is opened: save it as .npz"
        raise DatasetError(text, file=path)
    raise DatasetError(f"has none of the known formats: {', '.join(READERS)}", file=path)


def _known_reader(path: Path) -> Callable[..., list[Recording]] | None:
    """Reader of a file, a bag or a zarr store; None for other files and folders."""
    if path.is_dir():
        stores = (".zgroup", "zarr.json", ".zarray")
        is_zarr = any((path / name).is_file() for name in stores)
        is_bag = (path / "metadata.yaml").is_file()
        return read_bag if is_bag else read_zarr if is_zarr else None
    name = path.name.lower()
    for suffix, reader in READERS.items():
        # The files of an RLDS dataset have a number after the suffix.
        if name.endswith(suffix) or (suffix == ".tfrecord" and suffix in name):
            return reader
    return None


def _of_arrays(path: Path, arrays: Mapping[str, np.ndarray], **details: Any) -> list[Recording]:
    fields = {name: array_field(name, array) for name, array in arrays.items()}
    return split_episodes(path, fields, **details)


def _read_text(path: Path, columns: Sequence[str] = ()) -> list[Recording]:
    return _of_arrays(path, read_text_table(path, columns))


def read_parquet(path: Path) -> list[Recording]:
    """Episodes of a Parquet file."""
    return _of_arrays(path, read_parquet_table(path))


def read_numpy(path: Path, columns: Sequence[str] = ()) -> list[Recording]:
    """Episodes of a .npz or .npy file; `columns` names the columns of a .npy file."""
    arrays, details = dict(_numpy_arrays(path)), {}
    _attributes({n: a[()] for n, a in arrays.items() if not a.shape}, details)
    if UNNAMED in arrays:
        arrays = _columns_of(path, arrays[UNNAMED], columns)
    return _of_arrays(path, {n: array for n, array in arrays.items() if array.shape}, **details)


def _numpy_arrays(path: Path) -> Iterator[tuple[str, np.ndarray]]:
    """Names and arrays of a .npz or .npy file; its content decides on the format."""
    name = None
    with path.open("rb") as stream:
        single = stream.read(6) == b"\x93NUMPY"
    try:
        if zipfile.is_zipfile(path):
            with np.load(path, allow_pickle=False) as file:
                for name in file.files:
                    yield name, np.asarray(file[name])
        elif single:
            yield UNNAMED, np.load(path, mmap_mode="r", allow_pickle=False)
        else:
            raise DatasetError("cannot be read: it is damaged", file=path)
    except ValueError as error:
        if "allow_pickle" in str(error) or "Python objects" in str(error):
            raise DatasetError(_PICKLED, file=path, key=name) from error
        raise


def _columns_of(path: Path, array: np.ndarray, names: Sequence[str]) -> dict[str, np.ndarray]:
    """Columns of an array without a name, or the whole array if no names are known."""
    if array.dtype.names:  # a table of named columns
        return {name: array[name][:, None] for name in array.dtype.names}
    if array.dtype.kind not in "fiub" or 0 in array.shape or array.ndim == 0:
        text = f"an array of shape {array.shape} and type {array.dtype} holds no frames"
        raise DatasetError(f"{text} of numbers", file=path)
    if names and len(names) != array.shape[-1]:
        text = f"{len(names)} column names for {array.shape[-1]} columns"
        raise DatasetError(text, file=path)
    return {n: array[..., k : k + 1] for k, n in enumerate(names)} or {UNNAMED: array}


def read_hdf5(path: Path) -> list[Recording]:
    """Episodes of an HDF5 file; links and data in other files are refused."""
    import h5py

    fields: dict[str, Field] = {}
    details: dict[str, Any] = {}
    links: dict[str, Any] = {}
    with h5py.File(path, "r") as file:
        _attributes(file.attrs, details)
        file.visititems_links(links.__setitem__)
        for place, link in links.items():
            if not isinstance(link, h5py.HardLink):
                raise DatasetError(_LINK, file=path, key=place)
            node = file[place]
            if isinstance(node, h5py.Group):
                _attributes(node.attrs, details)
            elif not isinstance(node, h5py.Dataset):
                continue  # a named type holds no numbers
            elif node.external or node.is_virtual:
                raise DatasetError("is in another file, and not read", file=path, key=place)
            elif node.shape == ():
                _attributes({place.rpartition("/")[2]: node[()]}, details)
            elif node.shape and 0 not in node.shape and not node.dtype.names:
                unit = unit_in_words(_text(node.attrs.get("units", "")))
                read = partial(_read_hdf5, path, place)
                fields[place] = make_field(place, node.shape, node.dtype, read, unit=unit)
    return split_episodes(path, fields, **details)


def _read_hdf5(path: Path, place: str, start: int, stop: int) -> np.ndarray:
    import h5py

    with h5py.File(path, "r") as file:
        return file[place][start:stop]  # type: ignore[index]


def _text(value: Any) -> str:
    return value.decode() if isinstance(value, bytes) else str(value)


def _attributes(attributes: Mapping[str, Any], details: dict[str, Any]) -> None:
    """Find a frame rate and a task among attributes; add them to `details` if it lacks them."""
    for name, value in attributes.items():
        key = name.lower()
        with contextlib.suppress(TypeError, ValueError, AttributeError, ZeroDivisionError):
            if name == "env_args":  # robomimic: settings of the simulator
                _attributes(json.loads(value).get("env_kwargs", {}), details)
            elif key in _TASKS and isinstance(value, str | bytes) and len(value) < 500:
                details.setdefault("task", _text(value))
            elif key in (*_RATES, "dt"):
                number = float(np.asarray(value).item())
                rate = 1 / number if key == "dt" else number
                if 0 < rate < np.inf:
                    details.setdefault("fps", rate)


def read_zarr(path: Path) -> list[Recording]:
    """Episodes of a zarr store (folder or .zip file); links and pickles are refused."""
    import zarr
    from zarr.storage import ZipStore

    if path.is_dir():
        for entry in path.rglob("*"):
            if entry.is_symlink():
                raise DatasetError(_LINK, file=entry)
    store: Any = str(path) if path.is_dir() else ZipStore(path, mode="r")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # foreign files in the store
        group = zarr.open_group(store, mode="r")
        members = dict(group.members(max_depth=None))
    fields: dict[str, Field] = {}
    details: dict[str, Any] = {}
    _attributes(dict(group.attrs), details)
    for name, node in members.items():
        if not isinstance(node, zarr.Array) or not node.shape or 0 in node.shape:
            continue
        if any("pickle" in str(c).lower() for c in (*node.filters, *node.compressors)):
            raise DatasetError(_PICKLED, file=path, key=name)
        dtype = np.dtype(object) if node.dtype.kind == "O" else np.dtype(node.dtype)
        fields[name] = make_field(name, node.shape, dtype, partial(_rows, node))
    return split_episodes(path, fields, **details)


def _rows(node: Any, start: int, stop: int) -> np.ndarray:
    return np.asarray(node[start:stop])


def read_mat(path: Path) -> list[Recording]:
    """Episodes of a MATLAB file of version 5 or 7.3."""
    from scipy.io import loadmat

    try:
        content: dict = loadmat(path, simplify_cells=True)
    except NotImplementedError:  # version 7.3 is HDF5, which keeps arrays transposed
        return [_frames_first(one) for one in read_hdf5(path)]
    details: dict[str, Any] = {}
    content = {k: v for k, v in content.items() if not k.startswith("__")}
    _attributes({k: v for k, v in content.items() if np.ndim(v) == 0}, details)
    return [_frames_first(one) for one in _of_arrays(path, dict(_within(content)), **details)]


def _within(value: Any, place: str = "") -> Iterator[tuple[str, np.ndarray]]:
    """Arrays of nested structures and cells, by their paths."""
    if isinstance(value, np.ndarray) and value.dtype.hasobject:
        value = list(value.ravel())
    if isinstance(value, list):
        value = dict(enumerate(value))
    if isinstance(value, Mapping):
        for name, item in value.items():
            yield from _within(item, f"{place}/{name}".lstrip("/"))
    elif isinstance(value, np.ndarray) and value.size and value.dtype.kind in "fiub":
        yield place, value


def _frames_first(one: Recording) -> Recording:
    """The recording with the frames of all arrays along the first axis.

    The number of frames is the most frequent length of an array's longest axis.
    """
    fields = one.fields
    lengths = [max(f.shape) for f in fields.values() if len(f.shape) <= 2]
    frames = max(dict.fromkeys(lengths), key=lengths.count, default=0)
    turned = {n: f for n, f in fields.items() if f.shape[1:] == (frames,)}
    turned = {n: array_field(n, f.numbers().T) for n, f in turned.items()}
    return replace(one, fields={**fields, **turned})


def read_tfrecord(path: Path) -> list[Recording]:
    """Episodes of an RLDS dataset, one per record; arrays are flattened to rows."""
    episodes: list[Recording] = []
    size, offset = path.stat().st_size, 0
    with path.open("rb") as stream:
        while offset < size:  # length, checksum, record, checksum
            stream.seek(offset)
            length = int.from_bytes(stream.read(8), "little")
            if offset + 16 + length > size:
                text = f"ends within record {len(episodes)}: copy it again"
                raise DatasetError(text, file=path)
            episodes.append(_rlds_episode(path, len(episodes), (offset + 12, length)))
            offset += 16 + length
    return episodes


def _rlds_episode(path: Path, number: int, place: tuple[int, int]) -> Recording:
    found, task, label = {}, "", f"record {number}"
    record = _rlds_record(path, *place)
    steps = {n: v for n, v in record.items() if n.startswith("steps/") and len(v)}
    frames = min((len(values) for values in steps.values()), default=1)
    for name, values in steps.items():
        short = name.removeprefix("steps/")
        if isinstance(values, list):

            def read(start: int, stop: int, name: str = name) -> np.ndarray:
                return np.array(_rlds_record(path, *place)[name][start:stop], dtype=object)

            found[short] = make_field(short, (len(values),), np.dtype(object), read)
            if short.split("/")[-1] in _TASKS:
                task = task or values[0].decode(errors="replace")
        elif len(values) % frames:
            text = f"holds {len(values)} numbers for {frames} steps"
            raise DatasetError(text, file=path, key=f"{label}/{name}")
        else:
            found[short] = array_field(name, values.reshape(frames, -1))
    return Recording(file=path, label=label, fields=found, task=task)


@lru_cache(maxsize=2)
def _rlds_record(path: Path, offset: int, length: int) -> dict[str, Any]:
    """Values of one record: an array of numbers, or a list of bytes, for each feature."""
    from tfrecord import example_pb2

    with path.open("rb") as stream:
        stream.seek(offset)
        content = stream.read(length)
    example: Any = example_pb2.Example()  # type: ignore[attr-defined]
    example.ParseFromString(content)
    values: dict[str, Any] = {}
    for name, feature in example.features.feature.items():
        kind = feature.WhichOneof("kind")
        items = getattr(feature, kind).value if kind else []
        values[name] = [*items] if kind == "bytes_list" else np.array(items)
    return values


READERS: dict[str, Callable[..., list[Recording]]] = {
    **dict.fromkeys((".csv", ".tsv", ".txt", ".log", ".dat"), _read_text),
    **dict.fromkeys((".npz", ".npy"), read_numpy),
    ".parquet": read_parquet,
    **dict.fromkeys((".hdf5", ".h5"), read_hdf5),
    ".mat": read_mat,
    ".zarr.zip": read_zarr,
    ".tfrecord": read_tfrecord,
    **dict.fromkeys((".bag", ".db3", ".mcap"), read_bag),
}
"""Suffix -> reader."""


def _read_folder(path: Path, columns: Sequence[str]) -> list[Recording]:
    """Episodes of a folder: numbered files are one episode each, other files together form one.

    If there are several files of arrays, the name of a video must begin with the name of the
    file to which it belongs.
    """
    entries = [entry for entry in path.iterdir() if not entry.name.startswith(".")]
    entries.sort(key=lambda entry: natural(entry.name))
    for entry in entries:
        if entry.is_symlink():
            raise DatasetError(_LINK, file=entry)
    tables = [p for p in entries if _known_reader(p)]
    videos = [p for p in entries if p.suffix.lower() in _VIDEOS]
    if not tables:
        folders = [p for p in entries if p.is_dir()]
        if not folders:
            raise DatasetError("holds no recording that is read here", file=path)
        return [one for folder in folders for one in open_recordings(folder, columns)]
    opened = [(table, open_recordings(table, columns)) for table in tables]
    count = len({re.sub(r"\d+", "", table.name) for table in tables})
    if count > 1 and all(len(found) == 1 for _, found in opened):
        joined = {
            table.stem if name == UNNAMED else f"{table.stem}/{name}": field
            for table, (one,) in opened
            for name, field in one.fields.items()
        }
        opened = [(path, [replace(opened[0][1][0], file=path, fields=joined)])]
    episodes, unused = [], dict.fromkeys(videos)
    for table, found in opened:
        name = re.compile(rf"{re.escape(table.stem)}(?!\d)")
        shown = [v for v in videos if len(opened) == 1 or name.match(v.stem)]
        unused = {v: None for v in unused if v not in shown}
        own = {
            v.stem.removeprefix(table.stem).strip("_-. ") or v.stem: _video_field(v)
            for v in shown
        }
        if own and len(found) > 1:
            raise DatasetError("holds several episodes, but its videos show one", file=table)
        episodes += [replace(one, fields=one.fields | own) for one in found]
    if unused and episodes:
        names = ", ".join(video.name for video in unused)
        text = f"videos left out, as their names do not begin with a file's name: {names}"
        episodes[0] = replace(episodes[0], notes=(*episodes[0].notes, text))
    return episodes


def _video_field(path: Path) -> Field:
    import av

    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        rate = float(stream.average_rate or 0)
        frames = stream.frames or round((container.duration or 0) / av.time_base * rate)
        shape = (frames, stream.height, stream.width, 3)
        segment = VideoSegment(file=path, start=0.0, stop=frames / rate)

    def images(start: int) -> Iterator[Image]:
        image, number = None, start
        for frame, image in decode(segment, rate, frames=range(start, frames)):
            yield from repeat(image, frame + 1 - number)
            number = frame + 1
        if image is None:
            raise DatasetError("holds no images", file=path)
        # The container may promise more images than it holds.
        yield from repeat(image)

    return Field(shape=shape, kind="image", read=StreamRead(images), rate=rate)
