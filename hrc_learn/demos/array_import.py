"""Demonstrations from plain arrays: in memory, or in .npz, .npy and .csv files."""

import csv
import math
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from hrc_learn.demos.demonstration import Demonstration
from hrc_learn.demos.issues import DatasetError
from hrc_learn.demos.read.quantities import meaning_of_component, to_quaternion
from hrc_learn.demos.read.units import unit_factor

ArrayTable = dict[str, Float64[np.ndarray, "_demos _frames _components"]]
"""Array or column name -> its values, demonstration by demonstration."""

UNNAMED = "array"
"""Name of an array whose columns have none."""
_TIME_NAMES = ("t", "time", "timestamp", "stamp")
_UNREADABLE = (ValueError, OSError, EOFError, zipfile.BadZipFile, zlib.error)
"""Exceptions of numpy for files that are truncated, damaged or of another kind."""


def read_arrays(path: Path, columns: Sequence[str] = ()) -> ArrayTable:
    """Read the arrays of a file.

    Arrays of one axis are columns, of two axes (frames, components), of three (demonstrations,
    frames, components).

    Args:
        path: A .npz, .npy or .csv file.
        columns: Names for the columns of a .npy file, or of a .csv file without a header.

    Raises:
        DatasetError: The file is missing, of another kind, or holds no such arrays.
    """
    if not path.is_file():
        raise DatasetError("not found", file=path)
    match path.suffix.lower():
        case ".npz":
            return _read_npz(path)
        case ".npy":
            array = _load(path)
            if not isinstance(array, np.ndarray):
                raise DatasetError(
                    "holds several arrays: its name should end in .npz", file=path
                )
            return _split(_three_axes(array, path, UNNAMED), columns, path)
        case ".csv" | ".txt":
            names, values = _read_csv(path)
            return _split(values[None], columns or names, path)
    raise DatasetError("is neither .npz, .npy nor .csv", file=path)


def _load(path: Path):
    try:
        return np.load(path, allow_pickle=False)
    except _UNREADABLE as error:
        raise DatasetError(f"cannot be read as numpy arrays: {error}", file=path) from error


def _read_npz(path: Path) -> ArrayTable:
    """Arrays of a file that can be tables of numbers."""
    file = _load(path)
    if isinstance(file, np.ndarray):
        raise DatasetError("holds a single array: its name should end in .npy", file=path)
    table: ArrayTable = {}
    with file:
        for name in file.files:
            try:
                array = file[name]
            except _UNREADABLE as error:
                raise DatasetError(
                    f"cannot be read as an array of numbers ({error}): save it again",
                    file=path,
                    key=name,
                ) from error
            # numpy returns bytes for a member that is no array.
            if isinstance(array, np.ndarray) and _is_numeric(array):
                table[name] = _three_axes(array, path, name)
    return table


def _is_numeric(array: np.ndarray) -> bool:
    return array.dtype.kind in "fiu" and 1 <= array.ndim <= 3


def _three_axes(array: np.ndarray, path: Path, name: str) -> np.ndarray:
    if not _is_numeric(array) or 0 in array.shape:
        raise DatasetError(
            f"an array of shape {array.shape} and type {array.dtype} holds no frames of "
            f"numbers",
            file=path,
            key=name,
        )
    array = array.astype(np.float64)
    if array.ndim == 1:
        array = array[:, None]
    return array if array.ndim == 3 else array[None]


def _split(array: np.ndarray, columns: Sequence[str], path: Path) -> ArrayTable:
    if not columns:
        return {UNNAMED: array}
    if len(columns) != array.shape[-1]:
        raise DatasetError(
            f"{len(columns)} column names for {array.shape[-1]} columns", file=path
        )
    return {name: array[..., i : i + 1] for i, name in enumerate(columns)}


def _read_csv(path: Path) -> tuple[list[str], np.ndarray]:
    """Header ([] if there is none) and numbers of a file with any usual delimiter."""
    try:
        # Spreadsheets mark UTF-8 by a byte order mark.
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise DatasetError(
            f"is not encoded in UTF-8 ({error.reason} at byte {error.start}): save it as UTF-8",
            file=path,
        ) from error
    first = next((line for line in lines if line.strip()), "")
    delimiter = max(",;\t", key=first.count)
    if delimiter not in first:
        delimiter = " "
    reader = csv.reader(lines, delimiter=delimiter, skipinitialspace=True)
    try:
        rows = [
            (reader.line_num, fields)
            for row in reader
            if (fields := [field.strip() for field in row if field.strip()])
        ]
    except csv.Error as error:
        raise DatasetError(f"line {reader.line_num}: {error}", file=path) from error
    if not rows:
        raise DatasetError("is empty", file=path)
    first_fields = rows[0][1]
    header = [] if _are_numbers(first_fields) else first_fields
    numbers, width = rows[1:] if header else rows, len(first_fields)
    for line, row in numbers:
        if len(row) != width or not _are_numbers(row):
            raise DatasetError(
                f"line {line} does not hold {width} numbers separated by {delimiter!r}",
                file=path,
            )
    if not numbers:
        raise DatasetError("holds a header and no numbers", file=path)
    return header, np.array([[float(field) for field in row] for _, row in numbers])


def _are_numbers(fields: Sequence[str]) -> bool:
    try:
        [float(field) for field in fields]
    except ValueError:
        return False
    return True


@dataclass(frozen=True, kw_only=True)
class ArraySources:
    """Arrays that hold each quantity: one name, or several joined by commas.

    None finds the arrays by their names.
    """

    joints: str | None = None
    """Joint positions."""
    position: str | None = None
    """Position of the end effector."""
    orientation: str | None = None
    """Orientation of the end effector: a quaternion (4 columns) or a rotation vector (3)."""
    time: str | None = None
    """Time stamps."""


@dataclass(frozen=True, kw_only=True)
class ArrayOptions:
    """Interpretation of arrays as demonstrations."""

    units: Mapping[str, str] | None = None
    """Units by role ("joint_position", "position", "time"); SI units if not given."""
    quaternion_order: str = "wxyz"
    """Order of quaternion components, "wxyz" or "xyzw"."""
    joint_names: Sequence[str] = ()
    """Joint names; joint1, joint2, ... if not given."""
    duration: float | int | None = None
    """Duration of each demonstration [s] if there are no stamps."""
    fps: float | int | None = None
    """Frame rate [1/s] if there are no stamps; with stamps, it is only recorded."""
    task: str = ""
    """Task shown."""

    def __post_init__(self) -> None:
        for name, value in (("duration", self.duration), ("fps", self.fps)):
            if value is not None and not 0 < value < math.inf:
                raise ValueError(f"{name} must be positive, got {value}")


def demonstrations_from_arrays(
    table: ArrayTable, sources: ArraySources, options: ArrayOptions, *, path: Path
) -> list[Demonstration]:
    """Make demonstrations from arrays.

    Args:
        table: Arrays by name.
        sources: Arrays that hold each quantity.
        options: Units, names and time base.
        path: Origin of the arrays, for errors.

    Raises:
        DatasetError: An array is missing, has a wrong shape, or holds values that no
            demonstration can have; names the array and the frame.
    """
    found = _find(table, sources, path)
    if not {"joints", "position"} & found.keys():
        raise DatasetError(
            f"name the arrays of joints or poses (joints, position, orientation); it holds "
            f"{', '.join(table)}",
            file=path,
        )
    factors = {
        role.replace("joint_position", "joints"): unit_factor(role, unit)
        for role, unit in (options.units or {}).items()
    }
    count = max(len(values) for values in found.values())
    demos = []
    for index in range(count):
        episode = {
            name: values[index if len(values) > 1 else 0] * factors.get(name, 1.0)
            for name, values in found.items()
        }
        try:
            demos.append(_demonstration(episode, options))
        except ValueError as error:
            raise DatasetError(str(error), file=path, episode=index) from error
    return demos


def _find(table: ArrayTable, sources: ArraySources, path: Path) -> ArrayTable:
    """Arrays of joints, position, orientation and time."""
    chosen = {name: text.split(",") for name, text in vars(sources).items() if text}
    by_name = {name: ns for name, ns in _by_name(table).items() if name not in chosen}
    if chosen.keys() & {"joints", "position", "orientation"}:
        by_name = {name: ns for name, ns in by_name.items() if name == "time"}
    found = {}
    for name, arrays in (by_name | chosen).items():
        missing = [array for array in arrays if array not in table]
        if missing:
            raise DatasetError(
                f"there is no array {missing[0]!r} for {name}; it holds {', '.join(table)}",
                file=path,
                key=name,
            )
        found[name] = _joined(name, arrays, table, path)
    shapes = {name: values.shape[:2] for name, values in found.items()}
    frames = {shape[1] for shape in shapes.values()}
    counts = {shape[0] for shape in shapes.values()} - {1}
    if len(frames) > 1 or len(counts) > 1:
        raise DatasetError(
            f"arrays differ in their numbers of demonstrations and frames: {shapes}", file=path
        )
    return found


def _joined(
    name: str, arrays: Sequence[str], table: ArrayTable, path: Path
) -> Float64[np.ndarray, "demos frames components"]:
    """Arrays concatenated along their components."""
    first, *others = arrays
    for other in others:
        for axis, counted in enumerate(("demonstrations", "frames")):
            one, two = table[first].shape[axis], table[other].shape[axis]
            if one != two:
                raise DatasetError(
                    f"{first!r} has {one} {counted}, {other!r} has {two}: bring them to the "
                    f"same number, or name other arrays",
                    file=path,
                    key=name,
                )
    return np.concatenate([table[array] for array in arrays], axis=-1)


def _by_name(table: ArrayTable) -> dict[str, list[str]]:
    """Quantity -> arrays by their names alone; unknown columns are joints."""
    found: dict[str, list[str]] = {}
    for name, values in table.items():
        meaning = meaning_of_component(name)
        if name.lower() in _TIME_NAMES:
            found["time"] = [name]
        elif meaning is not None and meaning.role == "position":
            found.setdefault("position", []).append(name)
        elif meaning is not None and meaning.role in ("quaternion_wxyz", "rotation_vector"):
            found.setdefault("orientation", []).append(name)
        elif values.shape[-1] == 1 or name == UNNAMED:
            found.setdefault("joints", []).append(name)
    return found


def _demonstration(episode: Mapping[str, np.ndarray], options: ArrayOptions) -> Demonstration:
    for name, values in episode.items():
        bad = np.argwhere(~np.isfinite(values))
        if len(bad):
            raise ValueError(f"{name} is {values[*bad[0]]} at frame {bad[0][0]}")
    time = _stamps(episode, options)
    joints = episode.get("joints")
    width = 0 if joints is None else joints.shape[1]
    names = tuple(options.joint_names) or tuple(f"joint{i + 1}" for i in range(width))
    if joints is not None and len(names) != width:
        raise ValueError(f"{len(names)} joint names for {width} columns of joints")
    return Demonstration(
        time=time - time[0],
        start_time=float(time[0]),
        joint_position=joints,
        joint_names=names if joints is not None else (),
        position=episode.get("position"),
        orientation=_orientation(episode.get("orientation"), options.quaternion_order),
        task=options.task,
        fps=options.fps or _nominal_rate(time),
    )


def _orientation(values: np.ndarray | None, quaternion_order: str) -> np.ndarray | None:
    if values is None:
        return None
    if values.shape[1] not in (3, 4):
        raise ValueError(f"orientation takes 3 or 4 columns, not {values.shape[1]}")
    role = "rotation_vector" if values.shape[1] == 3 else f"quaternion_{quaternion_order}"
    return to_quaternion(role, np.ascontiguousarray(values))


def _stamps(episode: Mapping[str, np.ndarray], options: ArrayOptions) -> np.ndarray:
    frames = len(next(iter(episode.values())))
    if frames < 2:
        raise ValueError(f"a demonstration needs at least two frames, got {frames}")
    if "time" in episode:
        return episode["time"][:, 0]
    if options.duration is not None:
        return np.linspace(0.0, options.duration, frames)
    if options.fps is not None:
        return np.arange(frames) / options.fps
    raise ValueError(
        "there are no stamps: name the array that holds them (time), or give duration or fps"
    )


def _nominal_rate(time: np.ndarray) -> float:
    """Whole frame rate, as LeRobot counts frames; true stamps are kept in their own column."""
    step = float(np.median(np.diff(time)))
    # `Demonstration` rejects stamps that do not increase.
    return float(max(1, round(1 / step))) if step > 0 else 1.0
