"""Recordings of any format, opened as fields whose frames are read when they are used.

A reader turns a file into named arrays; `split_episodes` finds the episodes among them. To add
a format, such as bags of ROS, write a reader and list its suffix in `READERS`.
"""

import contextlib
import json
import re
import warnings
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Shaped

from hrc_learn.demos.issues import DatasetError
from hrc_learn.demos.recording_tables import read_parquet_table, read_text_table

Kind = Literal["number", "image", "encoded", "text", "depth", "other"]
Read = Callable[[int, int], Shaped[np.ndarray, "_frames ..."]]

_SMALLEST_IMAGE = 16
"""Shorter side from which an array of whole numbers is an image [px]."""
_VIDEO_SUFFIXES = (".mp4", ".avi", ".mkv", ".mov", ".webm")
_RATES = ("fps", "control_freq", "control_frequency", "frequency", "rate", "hz")
"""Attributes that hold a frame rate [1/s]."""
_TASKS = ("task", "language_instruction", "instruction", "lang", "task_description")
_EPISODE = re.compile(r"(?:[a-z]+[_\- ]?)*\d+", re.IGNORECASE)
"""Names of groups that hold one episode each: demo_0, episode_12, traj_3, 7."""
_EPISODE_ENDS = ("episode_ends", "traj_ends", "trajectory_ends")
_ENDINGS = ("terminals", "timeouts", "dones", "truncations")
EPISODE_COLUMNS = re.compile(
    r"(?:episode|demo|demonstration|traj|trajectory|trial|run)(?:_?(?:id|index|idx|number|nr))?"
)
"""Columns of a table that number its episodes."""


@dataclass(frozen=True, kw_only=True)
class Field:
    """One recorded quantity of one episode."""

    shape: tuple[int, ...]
    """Frames, then the shape of one frame."""
    kind: Kind
    read: Read
    """Function that reads the frames from a first to a last one (exclusive)."""
    unit: str = ""
    """Unit that the file declares; "" if none."""
    names: tuple[str, ...] | None = None
    """Names of the components, if the file gives any."""
    video: Path | None = None
    """Video file that holds the images."""
    rate: float = 0.0
    """Frame rate of the video [1/s]."""

    @property
    def frames(self) -> int:
        """Number of frames."""
        return self.shape[0]

    @property
    def width(self) -> int:
        """Number of components of a frame."""
        return int(np.prod(self.shape[1:]))

    def part(self, start: int, stop: int) -> "Field":
        """The field during some of its frames."""

        def read(first: int, last: int) -> np.ndarray:
            return self.read(start + first, start + min(last, stop - start))

        return replace(self, shape=(stop - start, *self.shape[1:]), read=read)

    def numbers(self) -> Shaped[np.ndarray, "_frames _components"]:
        """All frames as rows of numbers."""
        return np.asarray(self.read(0, self.frames), np.float64).reshape(self.frames, -1)


@dataclass(frozen=True, kw_only=True)
class Recording:
    """One recorded episode."""

    file: Path
    label: str = ""
    """Group or number of the episode in its file; "" if the file holds one."""
    fields: dict[str, Field]
    fps: float | int | None = None
    """Frame rate that the file states [1/s]."""
    task: str = ""
    """Task in words, if the file gives it."""
    orient: bool = False
    """True if frames may be the columns of an array, as in MATLAB."""

    def error(self, message: str, key: str | None = None) -> DatasetError:
        """Reading error located in this episode."""
        place = f"{self.label}/{key}" if self.label and key else key or self.label or None
        return DatasetError(message, file=self.file, key=place)


def make_field(
    name: str, shape: tuple[int, ...], dtype: np.dtype, read: Read, **details: Any
) -> Field:
    """A field of the kind that its name, shape and type tell.

    Args:
        name: Name in the file.
        shape: Frames, then the shape of one frame.
        dtype: Type of the numbers.
        read: Function that reads some of the frames.
        details: Further attributes of the field.
    """
    kind: Kind = "other"
    numeric = dtype.kind in "fiub"
    sides = shape[1:3] if shape[3:4] in ((1,), (3,), (4,)) else shape[-2:]
    large = len(sides) == 2 and min(sides) >= _SMALLEST_IMAGE
    if dtype.kind in "SUOT":
        kind = "text"
    elif numeric and len(shape) >= 3 and large and "depth" in name.lower():
        kind = "depth"
    elif numeric and large and (len(shape) == 4 or (len(shape) == 3 and dtype == np.uint8)):
        kind = "image"
    elif dtype == np.uint8 and len(shape) == 2 and shape[1] > 64 and _encoded(read(0, 1)[0]):
        kind = "encoded"
    elif numeric and (len(shape) <= 2 or shape[1:] in ((3, 3), (3, 4), (4, 4))):
        kind = "number"
    if kind == "number" and shape[1:] == (3, 4):
        read, shape = partial(_with_last_row, read), (shape[0], 4, 4)
    return Field(shape=shape, kind=kind, read=read, **details)


def _with_last_row(read: Read, start: int, stop: int) -> np.ndarray:
    """4x4 transforms from their upper three rows."""
    upper = np.asarray(read(start, stop), np.float64)
    last = np.broadcast_to([0.0, 0.0, 0.0, 1.0], (len(upper), 1, 4))
    return np.concatenate([upper, last], axis=1)


def _encoded(content: np.ndarray | bytes) -> bool:
    """True if the bytes begin as a JPEG or PNG file does."""
    data = (
        content if isinstance(content, bytes) else np.asarray(content[:4], np.uint8).tobytes()
    )
    return data.startswith((b"\xff\xd8\xff", b"\x89PNG"))


def array_field(name: str, array: np.ndarray, **details: Any) -> Field:
    """A field of an array in memory."""
    array = array[None] if array.ndim == 0 else array
    return make_field(name, array.shape, array.dtype, lambda a, b: array[a:b], **details)


def bytes_field(items: list[bytes]) -> Field:
    """A field of one string of bytes for each frame: image files, or text."""
    kind: Kind = "encoded" if items and _encoded(items[0]) else "text"
    return Field(
        shape=(len(items),), kind=kind, read=lambda a, b: np.array(items[a:b], dtype=object)
    )


def open_recordings(path: Path, columns: tuple[str, ...] = ()) -> list[Recording]:
    """Open the episodes of a file or folder; no frames are read before they are used.

    Args:
        path: File of one of the formats in `READERS`, a zarr store, or a folder of such files.
        columns: Names for the columns of a .npy file, or of a text file without a header.

    Raises:
        DatasetError: The path is missing, of another kind, damaged, or leads to other files.
    """
    if path.is_dir():
        if (path / "meta" / "info.json").is_file():
            text = "is a LeRobot dataset already: `hrc check`, `repair` and `merge` take it"
            raise DatasetError(text, file=path)
        if _is_zarr(path):
            return _guarded(read_zarr, path)
        return _read_folder(path, columns)
    if not path.is_file():
        raise DatasetError("not found", file=path)
    name = path.name.lower()
    if name.endswith((".npy", ".csv", ".tsv", ".txt", ".log", ".dat")):
        reader = read_npy if name.endswith(".npy") else _read_text
        return _guarded(partial(reader, columns=columns), path)
    for suffix, reader in READERS.items():
        if name.endswith(suffix) or (suffix == ".tfrecord" and ".tfrecord" in name):
            return _guarded(reader, path)
    if name.endswith(_VIDEO_SUFFIXES):
        raise DatasetError("is a video: name the folder that holds its states, too", file=path)
    if name.endswith((".pkl", ".pickle", ".pt", ".pth", ".joblib")):
        text = "is a pickle, which can run any program when it is opened: save it as .npz"
        raise DatasetError(text, file=path)
    known = ", ".join([".npy", ".csv", ".tsv", ".txt", *READERS])
    raise DatasetError(f"is of no kind that is read here ({known}, or a folder)", file=path)


def _guarded(reader: Callable[[Path], list[Recording]], path: Path) -> list[Recording]:
    try:
        return reader(path)
    except (DatasetError, ModuleNotFoundError):
        raise
    except Exception as error:  # of any library, about a file from anywhere
        raise DatasetError(f"cannot be read ({error}): copy it again", file=path) from error


def split_episodes(
    file: Path, fields: Mapping[str, Field], label: str = "", **details: Any
) -> list[Recording]:
    """Episodes among the arrays of a file.

    They are groups that count (`demo_0`, `demo_1`), slices up to `episode_ends` or to the
    frames marked as the last ones, or the first axis of arrays of three axes.

    Args:
        file: The file.
        fields: Its arrays by their paths.
        label: Name of the part of the file that holds them.
        details: Further attributes of the recordings.

    Raises:
        DatasetError: The ends do not increase, or exceed the arrays.
    """
    numbered = _numbered_groups(_by_number(fields))
    if numbered:
        return [
            episode
            for name, group in numbered.items()
            for episode in split_episodes(file, group, f"{label}/{name}".lstrip("/"), **details)
        ]
    whole = Recording(file=file, label=label, fields=dict(fields), **details)
    if whole.orient:
        whole = replace(whole, fields=_frames_first(whole.fields), orient=False)
    ends = _ends(whole)
    if ends is not None:
        starts = [0, *ends[:-1]]
        return [
            replace(
                whole,
                label=f"{label}/episode {number}".lstrip("/"),
                fields={
                    name: field.part(start, stop)
                    for name, field in fields.items()
                    if field.frames >= ends[-1]
                },
            )
            for number, (start, stop) in enumerate(zip(starts, ends, strict=True))
        ]
    stacked = {n: f for n, f in fields.items() if f.kind == "other" and len(f.shape) == 3}
    if not stacked:
        return [whole]
    count = max(field.frames for field in stacked.values())
    return [
        replace(whole, label=f"{label}/{k}".lstrip("/") if count > 1 else label, fields=one)
        for k in range(count)
        for one in [{n: _layer(whole, n, f, k, count) for n, f in fields.items()}]
    ]


def _frames_first(fields: Mapping[str, Field]) -> dict[str, Field]:
    """Arrays of a MATLAB file with their frames along the first axis.

    The number of frames is the length that most arrays have.
    """
    lengths = [
        max(f.shape) for f in fields.values() if len(f.shape) <= 2 and f.kind == "number"
    ]
    frames = max(dict.fromkeys(lengths), key=lengths.count, default=0)

    def turned(one: Field) -> Field:
        whole = one.numbers()
        return array_field("", whole.T, unit=one.unit) if one.shape[1:] == (frames,) else one

    return {name: turned(f) if f.kind == "number" else f for name, f in fields.items()}


def _layer(whole: Recording, name: str, field: Field, number: int, count: int) -> Field:
    """One demonstration of an array of three axes; other arrays hold for all of them."""
    if field.kind != "other" or len(field.shape) != 3:
        return field
    if field.frames not in (1, count):
        text = f"holds {field.frames} demonstrations, other arrays hold {count}"
        raise whole.error(text, name)
    at = number if field.frames > 1 else 0
    return Field(
        shape=field.shape[1:],
        kind="number",
        read=lambda a, b: field.read(at, at + 1)[0][a:b],
        unit=field.unit,
        names=field.names,
    )


def _by_number(fields: Mapping[str, Field]) -> Mapping[str, Field]:
    """The arrays in one group for each number, if all of them count: states_0, actions_0."""
    found: dict[str, Field] = {}
    stems: dict[str, set[str]] = {}
    for name, field in fields.items():
        match = re.fullmatch(r"(.+)[/_](\d+)", name)
        if match is None or (field.width < 2 and len(field.shape) > 1):
            return fields
        stems.setdefault(match[1], set()).add(match[2])
        found[f"{match[2]}/{match[1]}"] = field
    same = len({frozenset(numbers) for numbers in stems.values()}) == 1
    return found if same and len(stems) > 1 else fields


def _numbered_groups(fields: Mapping[str, Field]) -> dict[str, dict[str, Field]]:
    """Groups of one episode each, by their names in counting order; {} if there are none."""
    found: dict[str, dict[str, Field]] = {}
    for level in range(4):
        for name, field in fields.items():
            parts = name.split("/")
            if len(parts) > level + 1 and _EPISODE.fullmatch(parts[level]):
                group = "/".join(parts[: level + 1])
                found.setdefault(group, {})["/".join(parts[level + 1 :])] = field
        # cam0 and cam1 hold images at the same time; episodes hold the same names.
        if found and all(any(f.kind == "number" for f in g.values()) for g in found.values()):
            break
        found = {}
    stems = {re.sub(r"\d+$", "", name) for name in found}
    names = {frozenset(group) for group in found.values()}
    common = frozenset.intersection(*names) if names else frozenset()
    alone = len(found) == 1 and not re.match(r"demo|ep|traj|\d", min(found).split("/")[-1])
    if len(stems) != 1 or not common or alone:
        return {}
    return {name: found[name] for name in sorted(found, key=natural)}


def natural(name: str) -> list[tuple[int, str]]:
    """Sorting key by which demo_2 comes before demo_10."""
    return [
        (int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", name)
    ]


def _ends(whole: Recording) -> list[int] | None:
    """Frame after the last one of each episode."""
    for name, field in whole.fields.items():
        last = name.split("/")[-1].lower()
        if last in _EPISODE_ENDS:
            ends = field.numbers()[:, 0].astype(int)
            longest = max(f.frames for f in whole.fields.values())
            if not len(ends) or (np.diff(ends, prepend=0) <= 0).any() or ends[-1] > longest:
                text = (
                    f"must increase up to the {longest} frames there are, got {ends.tolist()}"
                )
                raise whole.error(text[:200], name)
            return ends.tolist()
        if EPISODE_COLUMNS.fullmatch(last) and field.kind == "number" and field.width == 1:
            numbers = field.numbers()[:, 0]
            changes = np.flatnonzero(np.diff(numbers)) + 1
            if len(changes) + 1 != len(np.unique(numbers)):
                raise whole.error("numbers the episodes, but comes back to earlier ones", name)
            return [int(k) for k in (*changes, len(numbers))]
    flags = [
        field.numbers()[:, 0] > 0
        for name, field in whole.fields.items()
        if name.split("/")[-1].lower() in _ENDINGS and field.kind == "number"
    ]
    if not flags or len({len(flag) for flag in flags}) > 1:
        return None
    ends = (np.flatnonzero(np.logical_or.reduce(flags)) + 1).tolist()
    # A single mark at the end ends a single episode.
    return [*ends, len(flags[0])][: len(ends) + (ends[-1] < len(flags[0]))] if ends else None


def _read_text(path: Path, columns: tuple[str, ...] = ()) -> list[Recording]:
    table = read_text_table(path, columns)
    fields = {name: array_field(name, values) for name, values in table.items()}
    return split_episodes(path, fields)


def read_parquet(path: Path) -> list[Recording]:
    """Episodes of a Parquet file."""
    fields = {
        name: bytes_field(values) if isinstance(values, list) else array_field(name, values)
        for name, values in read_parquet_table(path).items()
    }
    return split_episodes(path, fields)


def read_npy(path: Path, columns: tuple[str, ...] = ()) -> list[Recording]:
    """Episodes of a .npy file, whose columns may be given names."""
    try:
        array = np.load(path, mmap_mode="r", allow_pickle=False)
    except ValueError as error:
        if "Python objects" in str(error):
            text = "holds pickled Python objects: save it again as numbers"
            raise DatasetError(text, file=path) from error
        raise
    if not isinstance(array, np.ndarray):
        raise DatasetError("holds several arrays: its name should end in .npz", file=path)
    if array.dtype.names:  # a table of named columns
        columns, array = array.dtype.names, np.stack([array[n] for n in array.dtype.names], -1)
    if array.dtype.kind not in "fiub" or 0 in array.shape or array.ndim == 0:
        text = f"an array of shape {array.shape} and type {array.dtype} holds no frames"
        raise DatasetError(f"{text} of numbers", file=path)
    if not columns:
        return split_episodes(path, {UNNAMED: array_field(UNNAMED, array)})
    if len(columns) != array.shape[-1]:
        text = f"{len(columns)} column names for {array.shape[-1]} columns"
        raise DatasetError(text, file=path)
    return split_episodes(
        path, {name: _layers(name, array[..., i : i + 1]) for i, name in enumerate(columns)}
    )


UNNAMED = "array"
"""Name of an array that has none."""


def _layers(name: str, column: np.ndarray) -> Field:
    """A column of one demonstration, or of several if it has three axes."""
    if column.ndim < 3:
        return array_field(name, column)
    return Field(shape=column.shape, kind="other", read=lambda a, b: column[a:b])


def read_npz(path: Path) -> list[Recording]:
    """Episodes of a .npz file."""
    fields, details = {}, {}
    if not zipfile.is_zipfile(path):
        single = isinstance(np.load(path, allow_pickle=False), np.ndarray)
        text = "holds a single array: its name should end in .npy" if single else "is damaged"
        raise DatasetError(text, file=path)
    with zipfile.ZipFile(path) as archive:
        members = [name for name in archive.namelist() if name.endswith(".npy")]
        for member in members:
            with archive.open(member) as stream:
                version = np.lib.format.read_magic(stream)
                header: Any = np.lib.format.read_array_header_1_0
                if version != (1, 0):
                    header = np.lib.format.read_array_header_2_0
                shape, _, dtype = header(stream)
            name = member.removesuffix(".npy")
            if dtype.hasobject:
                text = "cannot be read as an array of numbers (it holds pickled Python objects"
                raise DatasetError(f"{text}): save it again as numbers", file=path, key=name)
            if not shape and dtype.kind in "fiu" and name.lower() in _RATES:
                details["fps"] = float(_npz_member(path, name))
            if not shape and dtype.kind == "U" and name.lower() in _TASKS:
                details["task"] = str(_npz_member(path, name))
            if shape:

                def read(a: int, b: int, name: str = name) -> np.ndarray:
                    return _npz_member(path, name)[a:b]

                fields[name] = make_field(name, shape, dtype, read)
    return split_episodes(path, fields, **details)


@lru_cache(maxsize=8)
def _npz_member(path: Path, name: str) -> np.ndarray:
    with np.load(path, allow_pickle=False) as file:
        try:
            return file[name]
        except (ValueError, OSError, EOFError, zipfile.BadZipFile, zlib.error) as error:
            text = f"cannot be read as an array of numbers ({error}): save it again"
            raise DatasetError(text, file=path, key=name) from error


def read_hdf5(path: Path) -> list[Recording]:
    """Episodes of an HDF5 file; links out of the file are refused."""
    import h5py

    fields: dict[str, Field] = {}
    details: dict[str, Any] = {}

    def visit(group: Any, prefix: str) -> None:
        _attributes(group.attrs, details)
        for name in group:
            place = f"{prefix}{name}"
            _require_no_link(path, group, name)
            node = group[name]
            if isinstance(node, h5py.Group):
                visit(node, f"{place}/")
            elif isinstance(node, h5py.Dataset):
                if node.external or node.is_virtual:
                    text = "is kept in another file, which is not opened"
                    raise DatasetError(text, file=path, key=place)
                _hdf5_field(path, place, node, fields, details)

    with h5py.File(path, "r") as file:
        visit(file, "")
    return split_episodes(path, fields, **details)


def _require_no_link(path: Path, group: Any, name: str) -> None:
    import h5py

    if not isinstance(group.get(name, getlink=True), h5py.HardLink):
        place = f"{group.name}/{name}".lstrip("/")
        raise DatasetError("is a link, which is not followed", file=path, key=place)


def _hdf5_field(
    path: Path, place: str, node: Any, fields: dict[str, Field], details: dict[str, Any]
) -> None:
    import h5py

    def read(a: int, b: int) -> np.ndarray:
        with h5py.File(path, "r") as file:
            return file[place][a:b]  # type: ignore[index]

    if not node.shape:
        if node.shape == () and place.split("/")[-1].lower() in (*_RATES, *_TASKS):
            _attributes({place.split("/")[-1]: node[()]}, details)
        return
    unit = node.attrs.get("units", node.attrs.get("unit", ""))
    unit = unit.decode() if isinstance(unit, bytes) else str(unit)
    names = node.attrs.get("names", node.attrs.get("columns"))
    known = None
    if names is not None and len(node.shape) == 2 and np.size(names) == node.shape[1]:
        known = tuple(n.decode() if isinstance(n, bytes) else str(n) for n in names)
    if 0 in node.shape or node.dtype.names:
        return
    if node.dtype.kind == "O" and h5py.check_vlen_dtype(node.dtype) is not None:
        if _encoded(np.asarray(node[0])):
            fields[place] = Field(shape=node.shape[:1], kind="encoded", read=read)
        return
    fields[place] = make_field(place, node.shape, node.dtype, read, unit=unit, names=known)
    if fields[place].kind == "text" and _encoded(node[0]):
        fields[place] = replace(fields[place], kind="encoded")


def _attributes(attributes: Mapping[str, Any], details: dict[str, Any]) -> None:
    """Frame rate and task among the attributes of a group."""
    for name, value in attributes.items():
        text = value.decode(errors="replace") if isinstance(value, bytes) else value
        if name == "env_args" and isinstance(text, str):  # robomimic: settings of the simulator
            with contextlib.suppress(ValueError, AttributeError):
                _attributes(json.loads(text).get("env_kwargs", {}), details)
        elif name.lower() in _TASKS and isinstance(text, str) and len(text) < 500:
            details.setdefault("task", text)
        elif name.lower() in (*_RATES, "dt") and np.size(text) == 1:
            with contextlib.suppress(TypeError, ValueError, ZeroDivisionError):
                number = float(np.asarray(text).item())
                details.setdefault("fps", 1 / number if name.lower() == "dt" else number)


def _is_zarr(path: Path) -> bool:
    return any((path / name).is_file() for name in (".zgroup", "zarr.json", ".zarray"))


def read_zarr(path: Path) -> list[Recording]:
    """Episodes of a zarr store, a folder or a .zip file; links and pickles are refused."""
    import zarr
    from zarr.storage import ZipStore

    if path.is_dir():
        link = next((p for p in path.rglob("*") if p.is_symlink()), None)
        if link is not None:
            raise DatasetError("is a link, which is not followed", file=link)
        store: Any = str(path)
    else:
        store = ZipStore(path, mode="r")
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
        codecs = [str(codec).lower() for codec in (*node.filters, *node.compressors)]
        if any("pickle" in codec for codec in codecs):
            text = "holds pickled Python objects: save it again as numbers"
            raise DatasetError(text, file=path, key=name)

        def read(a: int, b: int, node: Any = node) -> np.ndarray:
            return np.asarray(node[a:b])

        dtype = np.dtype(object) if node.dtype.kind == "O" else np.dtype(node.dtype)
        fields[name] = make_field(name, node.shape, dtype, read)
    return split_episodes(path, fields, **details)


def read_mat(path: Path) -> list[Recording]:
    """Episodes of a MATLAB file of version 5 or 7.3."""
    from scipy.io import loadmat

    try:
        content: dict = loadmat(path, simplify_cells=True)
    except NotImplementedError:  # version 7.3 is HDF5
        content = _mat_of_hdf5(path)
    fields: dict[str, Field] = {}
    details: dict[str, Any] = {}
    _flatten({k: v for k, v in content.items() if not k.startswith("__")}, "", fields)
    _attributes({k: v for k, v in content.items() if np.ndim(v) == 0}, details)
    return split_episodes(path, fields, orient=True, **details)


def _flatten(value: Any, place: str, fields: dict[str, Field]) -> None:
    """Collect the arrays of nested structures and cells."""
    if isinstance(value, np.ndarray) and value.dtype.hasobject:
        value = list(value.ravel())
    if isinstance(value, list):
        value = {str(number): item for number, item in enumerate(value)}
    if isinstance(value, Mapping):
        for name, item in value.items():
            _flatten(item, f"{place}/{name}".lstrip("/"), fields)
    elif isinstance(value, np.ndarray) and value.size > 1 and value.dtype.kind in "fiub":
        fields[place] = array_field(place, value)


def _mat_of_hdf5(path: Path) -> dict[str, Any]:
    """Content of a MATLAB file of version 7.3, whose arrays are kept transposed."""
    import h5py

    def value(node: Any) -> Any:
        if isinstance(node, h5py.Group):
            names = [str(name) for name in node]
            for name in names:
                _require_no_link(path, node, name)
            return {name: value(node[name]) for name in names if not name.startswith("#")}
        if h5py.check_ref_dtype(node.dtype) is not None:
            return [value(node.file[ref]) for ref in np.ravel(node[()])]
        array = np.asarray(node[()])
        return array.T.squeeze() if array.dtype.kind in "fiub" else None

    with h5py.File(path, "r") as file:
        return value(file)


def read_tfrecord(path: Path) -> list[Recording]:
    """Episodes of an RLDS dataset, one record each, with the shapes in its `features.json`."""
    shapes: dict[str, tuple[int, ...]] = {}
    description = path.parent / "features.json"
    if description.is_file():
        shapes = dict(_rlds_shapes(json.loads(description.read_text(encoding="utf-8")), ""))
    places, size, offset = [], path.stat().st_size, 0
    with path.open("rb") as stream:
        while offset < size:  # length, checksum, record, checksum
            stream.seek(offset)
            length = int.from_bytes(stream.read(8), "little")
            if offset + 16 + length > size:
                raise DatasetError(
                    f"ends within record {len(places)}: copy it again", file=path
                )
            places.append((offset + 12, length))
            offset += 16 + length
    return [_rlds_episode(path, k, place, shapes) for k, place in enumerate(places)]


def _rlds_episode(
    path: Path, number: int, place: tuple[int, int], shapes: Mapping[str, tuple[int, ...]]
) -> Recording:
    found: dict[str, Field] = {}
    task = ""
    steps = {n: v for n, v in _rlds_record(path, *place).items() if n.startswith("steps/")}
    frames = min((len(values) for values in steps.values()), default=0)
    for name, values in steps.items():
        last = name.split("/")[-1]
        if isinstance(values, list):
            if last in _TASKS and not task:
                task = values[0].decode(errors="replace")
            found[name.removeprefix("steps/")] = replace(
                bytes_field(values),
                read=lambda a, b, n=name: np.array(_rlds_record(path, *place)[n][a:b], object),
            )
            continue
        shape = shapes.get(name, (len(values) // max(frames, 1),))
        if len(values) != frames * int(np.prod(shape)):
            text = f"holds {len(values)} numbers for {frames} steps of shape {shape}"
            raise DatasetError(text, file=path, key=f"record {number}/{name}")
        array = values.reshape(frames, *shape)
        found[name.removeprefix("steps/")] = array_field(name, array)
    return Recording(file=path, label=f"record {number}", fields=found, task=task)


@lru_cache(maxsize=2)
def _rlds_record(path: Path, offset: int, length: int) -> dict[str, Any]:
    """Values of one record: an array of numbers, or a list of bytes, for each feature."""
    from tfrecord import example_pb2

    with path.open("rb") as stream:
        stream.seek(offset)
        content = stream.read(length)
    example: Any = example_pb2.Example()  # type: ignore[attr-defined]
    try:
        example.ParseFromString(content)
    except Exception as error:  # of protobuf, which is not imported for its class alone
        raise DatasetError(f"holds a damaged record ({error})", file=path) from error
    values: dict[str, Any] = {}
    for name, feature in example.features.feature.items():
        kind = feature.WhichOneof("kind")
        content = getattr(feature, kind).value if kind else []
        values[name] = [*content] if kind == "bytes_list" else np.array(content)
    return values


def _rlds_shapes(node: Any, place: str) -> Iterator[tuple[str, tuple[int, ...]]]:
    """Shape of each feature in the description of a TensorFlow dataset."""
    if "featuresDict" in node:
        for name, inner in node["featuresDict"]["features"].items():
            yield from _rlds_shapes(inner, f"{place}/{name}".lstrip("/"))
    elif "sequence" in node:
        yield from _rlds_shapes(node["sequence"]["feature"], place)
    elif "tensor" in node:
        dimensions = node["tensor"].get("shape", {}).get("dimensions", [])
        yield place, tuple(int(length) for length in dimensions)


READERS: dict[str, Callable[[Path], list[Recording]]] = {
    ".npz": read_npz,
    ".parquet": read_parquet,
    ".hdf5": read_hdf5,
    ".h5": read_hdf5,
    ".mat": read_mat,
    ".zarr.zip": read_zarr,
    ".tfrecord": read_tfrecord,
}
"""Reader of each suffix; .npy and text files are opened by `open_recordings` itself."""


def _read_folder(path: Path, columns: tuple[str, ...]) -> list[Recording]:
    """Episodes of a folder: files that count are episodes, others belong together.

    A video belongs to the episode whose name it begins with.
    """
    entries = sorted(
        (p for p in path.iterdir() if p.name[0] != "."), key=lambda p: natural(p.name)
    )
    for entry in entries:
        if entry.is_symlink():
            raise DatasetError("is a link, which is not followed", file=entry)
    known = (".npy", ".csv", ".tsv", ".txt", ".log", ".dat", *READERS)
    tables = [p for p in entries if p.name.lower().endswith(known) or ".tfrecord" in p.name]
    tables += [p for p in entries if p.is_dir() and _is_zarr(p)]
    videos = [p for p in entries if p.suffix.lower() in _VIDEO_SUFFIXES]
    folders = [p for p in entries if p.is_dir() and not _is_zarr(p)]
    if not tables:
        if not folders:
            raise DatasetError("holds no recording that is read here", file=path)
        return [episode for folder in folders for episode in _read_folder(folder, columns)]
    opened = [(table, open_recordings(table, columns)) for table in tables]
    stems = {re.sub(r"\d+", "", table.name) for table in tables}
    if len(tables) > 1 and len(stems) > 1 and all(len(found) == 1 for _, found in opened):
        joined = {
            f"{table.stem}/{name}" if name != UNNAMED else table.stem: field
            for table, (one,) in opened
            for name, field in one.fields.items()
        }
        opened = [(path, [replace(opened[0][1][0], file=path, fields=joined)])]
    episodes = []
    for table, found in opened:
        own = {
            v.stem.removeprefix(table.stem).strip("_-. ") or v.stem: _video_field(v)
            for v in videos
            if len(opened) == 1 or re.match(rf"{re.escape(table.stem)}(?!\d)", v.stem)
        }
        if own and len(found) > 1:
            raise DatasetError("holds several episodes beside videos of one", file=table)
        episodes += [replace(one, fields=one.fields | own) for one in found]
    return episodes


def _video_field(path: Path) -> Field:
    import av

    try:
        with av.open(str(path)) as container:
            stream = container.streams.video[0]
            rate = float(stream.average_rate or 0)
            length = (container.duration or 0) / av.time_base
            frames = stream.frames or round(length * rate)
            shape = (frames, stream.height, stream.width, 3)
    except (av.FFmpegError, IndexError) as error:
        raise DatasetError(f"cannot be decoded ({error})", file=path) from error

    def read(first: int, last: int) -> np.ndarray:
        raise AssertionError(f"images of {path} are decoded one by one")

    return Field(shape=shape, kind="image", read=read, video=path, rate=rate)
