"""Recordings: fields whose frames are read on demand, and the split of files into episodes."""

import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float64, Shaped

from hrc_learn.demos.issues import DatasetError
from hrc_learn.demos.read.columns import column_places
from hrc_learn.demos.read.naming import without_unit
from hrc_learn.demos.read.units import unit_factor

Kind = Literal["number", "image", "encoded", "text", "depth", "pose", "other"]
"""Content of a field; "pose" is the pose of a coordinate frame that may not be the tool's."""
Read = Callable[[int, int], Shaped[np.ndarray, "_frames ..."]]

UNNAMED = "array"
"""Name given to an array without a name."""
_SMALLEST_IMAGE = 16
"""Smallest height and width of an array that counts as an image [px]."""
_SKIPPED = 100
"""Largest number of images that are skipped by reading them. To skip more, the stream is opened
again."""
_EPISODE = re.compile(r"(?:[a-z]+[_\- ]?)*\d+", re.IGNORECASE)
"""Names of groups that hold one episode each: demo_0, episode_12, traj_3, 7."""
_EPISODE_ENDS = ("episode_ends", "traj_ends", "trajectory_ends")
_ENDINGS = ("terminals", "timeouts", "dones", "truncations")
_EPISODE_COLUMN = re.compile(
    r"(?:episode|demo|demonstration|traj|trajectory|trial|run)(?:_?(?:id|index|idx|number|nr))?"
)
"""Columns of a table that number its episodes."""
_TIME = re.compile(
    r"%?(?:.*[_. ])?(?:t|time|time_?stamps?|stamps?|times|elapsed|elapsed_time|zeit|"
    r"rosbagtimestamp|secs?|seconds|ros_?time)"
    r"(?:[ _]?[\[(]?(?P<unit>s|secs?|seconds|ms|msec|us|usec|ns|nsec|nanos)[\])]?)?"
)
_NO_CLOCK = re.compile(r"execut|cycle|delay|latency|comput|process|duration|delta|response")
_UNITS = {"sec": "s", "secs": "s", "second": "s", "seconds": "s", "msec": "ms", "usec": "us"}
_UNITS |= {"nsec": "ns", "nanos": "ns", "nm": "N m", "n*m": "N m", "metre": "m", "meter": "m"}
_UNITS |= {"radian": "rad", "degree": "deg", "percent": "%"}
"""Spellings of units in files -> units of `read.units`."""


_EPOCH = (1e9, 3e9)
"""Range of stamps that count from 1970 [s]: the years 2001 to 2065."""
STEPS = (1 / 1500, 0.5)
"""Plausible steps between stamps [s]: 2 Hz to 1.5 kHz."""


@dataclass(frozen=True, kw_only=True)
class Field:
    """One recorded quantity of one episode."""

    shape: tuple[int, ...]
    """Number of frames, then the shape of one frame."""
    kind: Kind
    read: Read
    """Function that reads the frames from a first to a last one (exclusive)."""
    unit: str = ""
    """Unit that the file declares; "" if none."""
    names: tuple[str, ...] | None = None
    """Names of the components, if the file gives any."""
    rate: float = 0.0
    """Frame rate of a video [1/s]."""
    clock: str = ""
    """Field with the stamps of this field; "" if the file names none."""

    @property
    def frames(self) -> int:
        """Number of frames."""
        return self.shape[0]

    @property
    def width(self) -> int:
        """Number of components of a frame."""
        return int(np.prod(self.shape[1:]))

    def part(self, start: int, stop: int) -> "Field":
        """The field with its frames from `start` to `stop` (exclusive) only."""

        def read(first: int, last: int) -> np.ndarray:
            return self.read(start + first, start + min(last, stop - start))

        return replace(self, shape=(stop - start, *self.shape[1:]), read=read)

    def numbers(self) -> Shaped[np.ndarray, "_frames _components"]:
        """All frames as rows of numbers."""
        return np.asarray(self.read(0, self.frames), float).reshape(self.frames, self.width)


@dataclass(frozen=True, kw_only=True)
class Recording:
    """One recorded episode."""

    file: Path
    label: str = ""
    """Group or number of the episode in its file; "" if the file holds only one episode."""
    fields: dict[str, Field]
    fps: float | int | None = None
    """Frame rate that the file states [1/s]."""
    task: str = ""
    """Task in words, if the file gives it."""
    streams: bool = False
    """True if each field has its own rate and stamps, as topics have."""
    notes: tuple[str, ...] = ()
    """Remarks of the reader, for the preview."""

    def error(self, message: str, key: str | None = None) -> DatasetError:
        """Reading error located in this episode."""
        place = "/".join(part for part in (self.label, key) if part) or None
        return DatasetError(message, file=self.file, key=place)

    def places(self, text: str, role: str) -> list[tuple[str, int]]:
        """Columns that a text stands for, as in `column_places`."""
        return column_places(role, text, self.fields, self.file)

    def clock_of(self, name: str, preferred: str = "") -> str:
        """Field of stamps for the field `name`; "" if no field of stamps has as many frames.

        If there are several, stamps with a similar name are chosen first, then stamps in the
        same group, then stamps in an enclosing group, then the field `preferred`.
        """
        if self.fields[name].clock:
            return self.fields[name].clock
        group, _, last = name.rpartition("/")
        word = re.split(r"[_\d]", last)[0]

        def rank(other: str) -> tuple:
            parent, _, leaf = other.rpartition("/")
            named = leaf.startswith(word) and word not in ("actual", "target", "")
            around = group.startswith(parent)
            return (not named, parent != group, not around, other != preferred, len(other))

        frames, fields = self.fields[name].frames, self.fields.items()
        stamps = [n for n, f in fields if f.frames == frames and n != name and is_time(n, f)]
        return min(stamps, key=rank, default="")


def longest_hold(stamps: Float64[np.ndarray, " frames"]) -> float:
    """Longest time for which a value is held [s]: the longer of 0.2 s and three periods."""
    return max(0.2, 3 * float(np.median(np.diff(stamps)))) if len(stamps) > 1 else 0.2


def unit_in_words(unit: str) -> str:
    """Unit as `read.units` spells it, from a unit that a file declares."""
    plain = unit.strip()
    spelled = "" if " " in plain else without_unit(f"value [{plain}]")[1]
    return _UNITS.get(plain.lower()) or spelled or plain


def is_time(name: str, one: Field) -> bool:
    """True if the name of the field says that it holds stamps."""
    last = name.split("/")[-1].lower()
    named = _TIME.fullmatch(last) and not _NO_CLOCK.search(last)
    return one.kind == "number" and one.width == 1 and bool(named)


def time_unit_in(name: str) -> str:
    """Unit in the name of a field of stamps; "" if the name states none."""
    match = _TIME.fullmatch(name.split("/")[-1].lower())
    return unit_in_words((match and match["unit"]) or "")


def read_stamps(
    recording: Recording,
    name: str,
    unit: str = "",
    rate: float | int | None = None,
    likely: str = "",
) -> Float64[np.ndarray, " _frames"]:
    """Stamps of a field [s]. Their unit is given, declared, or inferred from name or size.

    Args:
        recording: The episode.
        name: The field.
        unit: Unit from the caller; "" if none is given.
        rate: Frame rate that converts counted frames to times [1/s].
        likely: Unit to assume if the unit would otherwise be in doubt.

    Raises:
        DatasetError: Stamps do not increase, or their unit is in doubt.
    """
    time = recording.fields[name].numbers()[:, 0]
    bad = np.flatnonzero(~np.isfinite(time))
    if len(bad):
        raise recording.error(f"is {time[bad[0]]} at frame {bad[0]}", name)
    steps = np.diff(time)
    for k in np.flatnonzero(steps <= 0)[:1]:
        way = f"{time[k]:.9g} to {time[k + 1]:.9g} at frame {k}"
        text = f"time must increase, but goes from {way}: remove repeated rows, or"
        raise recording.error(f"{text} give --duration, which ignores the stamps", name)
    unit = unit or recording.fields[name].unit or time_unit_in(name)
    if unit:
        return time * unit_factor("time", unit)
    step = float(np.median(steps)) if len(steps) else 1.0
    sizes = {unit: unit_factor("time", unit) for unit in ("s", "ms", "us", "ns")}
    found = [u for u, size in sizes.items() if _EPOCH[0] < time[0] * size < _EPOCH[1]]
    counts = not found and step == 1 and not (steps % 1).any()  # frames may be missing
    if counts and rate:
        return time / rate
    found = found or [u for u, size in sizes.items() if STEPS[0] <= step * size <= STEPS[1]]
    if counts or len(found) != 1:
        if likely:
            return time * unit_factor("time", likely)
        kinds = "a count of frames (give --fps), ms or s" if counts else "s, ms, us or ns"
        text = f"steps by {step:.4g}: {kinds}? Give the unit: --units time s"
        raise recording.error(text, name)
    return time * sizes[found[0]]


def make_field(
    name: str, shape: tuple[int, ...], dtype: np.dtype, read: Read, **details: Any
) -> Field:
    """Make a field; its kind follows from name, shape and type.

    Args:
        name: Name in the file.
        shape: Number of frames, then the shape of one frame.
        dtype: Type of the numbers.
        read: Function that reads some of the frames.
        details: Further attributes of the field.
    """
    kind: Kind = "other"
    numeric, axes = dtype.kind in "fiub", len(shape)
    sides = shape[1:3] if shape[3:4] in ((1,), (3,), (4,)) else shape[-2:]
    large = axes >= 3 and min(sides) >= _SMALLEST_IMAGE
    if dtype.kind in "SUOT":
        shape = shape[:1]
        kind = "encoded" if dtype.kind == "O" and is_encoded(read(0, 1)[0]) else "text"
    elif numeric and large and ("depth" in name.lower() or dtype == np.uint16):
        kind = "depth"
    elif numeric and large and (axes == 4 or (axes == 3 and dtype == np.uint8)):
        kind = "image"
    elif dtype == np.uint8 and axes == 2 and shape[1] > 64 and is_encoded(read(0, 1)[0]):
        kind = "encoded"
    elif numeric and (axes <= 2 or shape[1:] in ((3, 3), (3, 4), (4, 4))):
        kind = "number"
    if kind == "number" and shape[1:] == (3, 4):
        read, shape = partial(_with_last_row, read), (shape[0], 4, 4)
    return Field(shape=shape, kind=kind, read=read, **details)


def _with_last_row(read: Read, start: int, stop: int) -> np.ndarray:
    """4x4 transforms from their upper three rows."""
    upper = np.asarray(read(start, stop), np.float64)
    last = np.broadcast_to([0.0, 0.0, 0.0, 1.0], (len(upper), 1, 4))
    return np.concatenate([upper, last], axis=1)


class StreamRead:
    """Read function of images that come one after another, such as those of a video."""

    def __init__(self, images: Callable[[int], Iterator[Any]]):
        """
        Args:
            images: Function that yields the images, beginning at a given frame.
        """
        self._images, self._next = images, 0
        self._stream: Iterator[Any] | None = None

    def __call__(self, start: int, stop: int) -> Shaped[np.ndarray, " _frames"]:
        """Images from a first to a last one (exclusive)."""
        if self._stream is None or not self._next <= start <= self._next + _SKIPPED:
            self._stream, self._next = self._images(start), start
        found = [*islice(self._stream, stop - self._next)][start - self._next :]
        self._next = stop
        whole = np.empty(len(found), object)
        whole[:] = found
        return whole


def is_encoded(content: Any) -> bool:
    """True if the bytes begin as a JPEG or PNG file does."""
    data = content if isinstance(content, bytes) else np.ravel(content)[:4].tobytes()
    return data.startswith((b"\xff\xd8\xff", b"\x89PNG"))


def array_field(name: str, array: np.ndarray, **details: Any) -> Field:
    """A field of an array in memory."""
    return make_field(name, array.shape, array.dtype, lambda a, b: array[a:b], **details)


def split_episodes(
    file: Path, fields: Mapping[str, Field], label: str = "", **details: Any
) -> list[Recording]:
    """Episodes among the arrays of a file.

    Episodes are numbered groups (`demo_0`, `demo_1`), slices that end at `episode_ends` or at
    frames marked as the last of an episode, or entries along the first axis of
    three-dimensional arrays.

    Args:
        file: The file.
        fields: Path in the file -> array.
        label: Name of the part of the file that holds the arrays.
        details: Further attributes of the recordings.

    Raises:
        DatasetError: The ends do not increase, or exceed the arrays.
    """
    groups = _numbered_groups(_by_number(fields))
    if groups:
        return [
            episode
            for name, group in groups.items()
            for episode in split_episodes(file, group, f"{label}/{name}".lstrip("/"), **details)
        ]
    whole = Recording(file=file, label=label, fields=dict(fields), **details)
    parts = []
    if (ends := _ends(whole)) is not None:
        for start, stop in zip([0, *ends[:-1]], ends, strict=True):
            long = {n: f for n, f in fields.items() if f.frames >= ends[-1]}
            parts.append({n: f.part(start, stop) for n, f in long.items()})
    else:
        stacked = [f for f in fields.values() if f.kind == "other" and len(f.shape) == 3]
        count = max((f.frames for f in stacked), default=1)
        for k in range(count):
            parts.append({n: _layer(whole, n, f, k, count) for n, f in fields.items()})
    named = [f"{label}/episode {k}".lstrip("/") for k in range(len(parts))]
    labels = named if len(parts) > 1 else [label]
    return [replace(whole, label=n, fields=f) for n, f in zip(labels, parts, strict=True)]


def _layer(whole: Recording, name: str, field: Field, number: int, count: int) -> Field:
    """One demonstration from a three-dimensional array. Other arrays, which all demonstrations
    have in common, are returned as they are.
    """
    if field.kind != "other" or len(field.shape) != 3:
        return field
    if field.frames not in (1, count):
        text = f"holds {field.frames} demonstrations, other arrays hold {count}"
        raise whole.error(text, name)
    at = number if field.frames > 1 else 0
    read = lambda a, b: field.read(at, at + 1)[0][a:b]  # noqa: E731
    return replace(field, shape=field.shape[1:], kind="number", read=read)


def _by_number(fields: Mapping[str, Field]) -> Mapping[str, Field]:
    """The arrays grouped by their numbers, if all are numbered: states_0, actions_0."""
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
    """Groups that hold one episode each, by name in numerical order; {} if there are none."""
    for level in range(4):
        found: dict[str, dict[str, Field]] = {}
        for name, field in fields.items():
            parts = name.split("/")
            if len(parts) > level + 1 and _EPISODE.fullmatch(parts[level]):
                group = found.setdefault("/".join(parts[: level + 1]), {})
                group["/".join(parts[level + 1 :])] = field
        stems = {re.sub(r"\d+$", "", name) for name in found}
        common = set.intersection(*(set(group) for group in found.values())) if found else set()
        # Episodes have numeric fields in common; groups such as cam0 and cam1 do not.
        same = any(fields_[n].kind == "number" for fields_ in found.values() for n in common)
        alone = len(found) == 1 and not re.match(r"demo|ep|traj|\d", min(found).split("/")[-1])
        if len(stems) == 1 and same and not alone:
            return {name: found[name] for name in sorted(found, key=natural)}
    return {}


def natural(name: str) -> list[tuple[int, str]]:
    """Sorting key by which demo_2 comes before demo_10."""
    parts = re.split(r"(\d+)", name)
    return [(int(part), "") if part.isdigit() else (-1, part) for part in parts]


def _ends(whole: Recording) -> list[int] | None:
    """End of each episode (exclusive frame number); None for a single episode."""
    flags = []
    for name, field in whole.fields.items():
        last = re.split(r"[/.]", name)[-1].lower()
        if field.kind != "number" or field.width != 1:
            continue
        if last in _EPISODE_ENDS:
            ends = field.numbers()[:, 0].astype(int)
            longest = max(f.frames for f in whole.fields.values())
            if not len(ends) or (np.diff(ends, prepend=0) <= 0).any() or ends[-1] > longest:
                text = f"must increase, and not exceed the {longest} frames of the arrays"
                raise whole.error(f"{text}, got {ends[:5].tolist()} ...", name)
            return ends.tolist()
        if _EPISODE_COLUMN.fullmatch(last):
            numbers = field.numbers()[:, 0]
            changes = np.flatnonzero(np.diff(numbers)) + 1
            if len(changes) + 1 != len(np.unique(numbers)):
                raise whole.error("numbers the episodes, but repeats an earlier number", name)
            return [*changes.tolist(), len(numbers)]
        if last in _ENDINGS:
            flags.append(field.numbers()[:, 0] > 0)
    if not flags or len({len(flag) for flag in flags}) > 1:
        return None
    # A flag of success may stay set until the end of the episode.
    ends = np.flatnonzero(np.diff(np.logical_or.reduce(flags).astype(int)) < 0) + 1
    return [*ends.tolist(), len(flags[0])]
