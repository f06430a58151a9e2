"""Demonstrations from plain arrays: in memory, or in .npz, .npy and .csv files."""

import csv
import math
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
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
                text = f"cannot be read as an array of numbers ({error}): save it again"
                raise DatasetError(text, file=path, key=name) from error
            # numpy returns bytes for a member that is no array.
            if isinstance(array, np.ndarray) and _is_numeric(array):
                table[name] = _three_axes(array, path, name)
    return table


def _is_numeric(array: np.ndarray) -> bool:
    return array.dtype.kind in "fiu" and 1 <= array.ndim <= 3


def _three_axes(array: np.ndarray, path: Path, name: str) -> np.ndarray:
    if not _is_numeric(array) or 0 in array.shape:
        text = (
            f"an array of shape {array.shape} and type {array.dtype} holds no frames of numbers"
        )
        raise DatasetError(text, file=path, key=name)
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
    reader, rows = csv.reader(lines, delimiter=delimiter, skipinitialspace=True), []
    try:
        for row in reader:
            if fields := [field.strip() for field in row if field.strip()]:
                rows.append((reader.line_num, fields))
    except csv.Error as error:
        raise DatasetError(f"line {reader.line_num}: {error}", file=path) from error
    if not rows:
        raise DatasetError("is empty", file=path)
    width, header = len(rows[0][1]), []
    if not _are_numbers(rows[0][1]):
        header = rows.pop(0)[1]
    for line, row in rows:
        if len(row) != width or not _are_numbers(row):
            text = f"line {line} does not hold {width} numbers separated by {delimiter!r}"
            raise DatasetError(text, file=path)
    if not rows:
        raise DatasetError("holds a header and no numbers", file=path)
    return header, np.array([row for _, row in rows], dtype=float)


def _are_numbers(fields: Sequence[str]) -> bool:
    try:
        [float(field) for field in fields]
    except ValueError:
        return False
    return True


@dataclass(frozen=True, kw_only=True)
class ArrayOptions:
    """Interpretation of the arrays of a file as demonstrations."""

    arrays: Mapping[str, Sequence[str]] = field(default_factory=dict)
    """Names of the arrays of "joints", "position", "orientation" (a quaternion or a rotation
    vector) and "time", joined in this order; quantities not given are found by name."""
    columns: Sequence[str] = ()
    """Names for the columns of a .npy file, or of a .csv file without a header."""
    units: Mapping[str, str] = field(default_factory=dict)
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


def demonstrations_from_arrays(path: Path, options: ArrayOptions) -> list[Demonstration]:
    """Make demonstrations from the arrays of a .npz, .npy or .csv file.

    Raises:
        DatasetError: The file cannot be read; an array is missing, has a wrong shape, or holds
            values that no demonstration can have.
    """
    found = _find(read_arrays(path, options.columns), options, path)
    factors = {
        role.replace("joint_position", "joints"): unit_factor(role, unit)
        for role, unit in options.units.items()
    }
    scaled = {name: values * factors.get(name, 1.0) for name, values in found.items()}
    demos = []
    for index in range(len(next(iter(scaled.values())))):
        episode = {name: values[index] for name, values in scaled.items()}
        try:
            demos.append(_demonstration(episode, options))
        except ValueError as error:
            raise DatasetError(str(error), file=path, episode=index) from error
    return demos


def _find(table: ArrayTable, options: ArrayOptions, path: Path) -> ArrayTable:
    """Joints, position, orientation and time, of equally many demonstrations and frames."""
    chosen = {name: list(arrays) for name, arrays in options.arrays.items() if arrays}
    by_name = _by_name(table)
    if chosen.keys() - {"time"}:
        by_name = {name: arrays for name, arrays in by_name.items() if name == "time"}
    names, there = by_name | chosen, ", ".join(table)
    for name, arrays in names.items():
        for array in arrays:
            if array not in table:
                text = f"there is no array {array!r} for {name}; it holds {there}"
                raise DatasetError(text, file=path, key=name)
    if not {"joints", "position"} & names.keys():
        text = f"name the arrays of joints or poses (joints, position); it holds {there}"
        raise DatasetError(text, file=path)
    shapes = {array: table[array].shape[:2] for arrays in names.values() for array in arrays}
    counts = {demos for demos, _ in shapes.values()} - {1}
    if len(counts) > 1 or len({frames for _, frames in shapes.values()}) > 1:
        text = f"arrays differ in their numbers of demonstrations and frames: {shapes}"
        raise DatasetError(text, file=path)
    count = max(counts, default=1)

    def repeated(array: str) -> np.ndarray:
        return np.broadcast_to(table[array], (count, *table[array].shape[1:]))

    return {
        name: np.concatenate([repeated(array) for array in arrays], axis=-1)
        for name, arrays in names.items()
    }


def _by_name(table: ArrayTable) -> dict[str, list[str]]:
    """Quantity -> arrays by their names alone; unknown columns are joints."""
    found: dict[str, list[str]] = {}
    for name, values in table.items():
        meaning = meaning_of_component(name)
        role = "" if meaning is None else meaning.role
        if name.lower() in _TIME_NAMES:
            found["time"] = [name]
        elif role == "position":
            found.setdefault("position", []).append(name)
        elif role in ("quaternion_wxyz", "rotation_vector"):
            found.setdefault("orientation", []).append(name)
        elif values.shape[-1] == 1 or name == UNNAMED:
            found.setdefault("joints", []).append(name)
    return found


def _demonstration(episode: Mapping[str, np.ndarray], options: ArrayOptions) -> Demonstration:
    for name, values in episode.items():
        bad = np.argwhere(~np.isfinite(values))
        if len(bad):
            raise ValueError(f"{name} is {values[*bad[0]]} at frame {bad[0][0]}")
    time, joints = _stamps(episode, options), episode.get("joints")
    width = 0 if joints is None else joints.shape[1]
    names = tuple(options.joint_names) or tuple(f"joint{i + 1}" for i in range(width))
    if joints is not None and len(names) != width:
        raise ValueError(f"{len(names)} joint names for {width} columns of joints")
    turn = episode.get("orientation")
    if turn is not None:
        if turn.shape[1] not in (3, 4):
            raise ValueError(f"orientation takes 3 or 4 columns, not {turn.shape[1]}")
        order = f"quaternion_{options.quaternion_order}"
        turn = to_quaternion("rotation_vector" if turn.shape[1] == 3 else order, turn)
    # LeRobot counts frames at a whole rate; true stamps are kept in their own column.
    # `Demonstration` refuses stamps that do not increase.
    step = float(np.median(np.diff(time)))
    return Demonstration(
        time=time - time[0],
        start_time=float(time[0]),
        joint_position=joints,
        joint_names=names if joints is not None else (),
        position=episode.get("position"),
        orientation=turn,
        task=options.task,
        fps=options.fps or max(1, round(1 / max(step, 1e-9))),
    )


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
