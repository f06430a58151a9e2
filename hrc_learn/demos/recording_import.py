"""Demonstrations from recordings: one clock for each episode, SI units, commands as actions."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64, Int64

from hrc_learn.demos.dataset_writer import DatasetWriter
from hrc_learn.demos.demonstration import JOINT_FIELDS, Demonstration
from hrc_learn.demos.issues import DatasetError
from hrc_learn.demos.read.quantities import ORIENTATION_ROLES, to_quaternion, transforms
from hrc_learn.demos.read.units import unit_factor
from hrc_learn.demos.recorded_episode import rotation_vectors
from hrc_learn.demos.recording_files import Field, Recording, open_recordings
from hrc_learn.demos.recording_meaning import (
    ImportOptions,
    Meaning,
    Place,
    clock_of,
    is_time,
    read_columns,
    time_unit_in,
    understand,
)
from hrc_learn.demos.videos import Image, VideoSegment, decode, decode_image

_BATCH = 32
"""Images read at a time."""
_EPOCH = 1e8
"""Stamps above count from 1970 in some unit; a recording lasts less than three years [s]."""
# Plausible steps between stamps [s]: 2 Hz to 1.5 kHz.
_SHORTEST_STEP, _LONGEST_STEP = 1 / 1500, 0.5
_STALE = 0.2
"""Age above which a held value no longer counts as measured [s], or three of its periods."""
_JUMP = 10.0
"""Gap between stamps that is reported, as a multiple of the usual one."""
_POSE_ACTION = {
    "position": ("ee.x", "ee.y", "ee.z"),
    "orientation": ("ee.wx", "ee.wy", "ee.wz"),
}


@dataclass(frozen=True, kw_only=True)
class Episode:
    """One recording on the clock of its state."""

    demonstration: Demonstration
    images: dict[str, tuple[Field, Int64[np.ndarray, " _frames"]]] = field(default_factory=dict)
    """Camera -> its images, and the index of the image at each frame."""
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class ImportPlan:
    """Recordings and what they were understood as."""

    recordings: tuple[Recording, ...]
    meaning: Meaning
    options: ImportOptions

    def episodes(self) -> Iterator[Episode]:
        """The episodes, one after another.

        Raises:
            DatasetError: An episode holds values that no demonstration can have.
        """
        for recording in self.recordings:
            yield _episode(recording, self.meaning, self.options)

    def lines(self, actions: bool = True) -> Iterator[str]:
        """The preview: fields and their meaning, episodes, actions.

        Args:
            actions: True if next states are to be the actions where none were recorded.
        """
        first = self.recordings[0]
        yield from self.meaning.lines(first)
        if not self.has_actions:
            made = (
                "the next states are the actions" if actions else "the dataset has no actions"
            )
            yield f"no commands were recorded: {made}"
        counts = self.counts()
        yield f"{counts['episodes']} episodes of {counts['frames']} frames in all"

    def counts(self) -> dict[str, int]:
        """Numbers of episodes, frames, and of fields understood, kept and left out."""
        meaning = self.meaning
        return {
            "episodes": len(self.recordings),
            "frames": sum(one.fields[meaning.main].frames for one in self.recordings),
            "understood": len(meaning.selections) + len(meaning.cameras),
            "kept": len(meaning.kept),
            "left_out": len(meaning.left_out),
        }

    @property
    def has_actions(self) -> bool:
        """True if actions were recorded."""
        return "action" in self.meaning.kept or "command_position" in self.meaning.selections


def plan_import(
    paths: Sequence[Path], options: ImportOptions, columns: Sequence[str] = ()
) -> ImportPlan:
    """Open recordings and find out what their fields mean; nothing is written.

    Args:
        paths: Files and folders.
        options: The caller's word about them.
        columns: Names for the columns of .npy files, or of text files without a header.

    Raises:
        DatasetError: A file cannot be read, or its content is not understood.
    """
    recordings = [one for path in paths for one in open_recordings(path, tuple(columns))]
    if not recordings:
        raise DatasetError("holds no episodes", file=paths[0])
    hinted = replace(options, hinted=bool(columns))
    return ImportPlan(
        recordings=tuple(recordings),
        meaning=understand(recordings, hinted),
        options=options,
    )


def write_plan(
    plan: ImportPlan, out: Path, robot_type: str, actions: bool
) -> dict[str, float | int]:
    """Write the episodes as a LeRobot dataset.

    Args:
        plan: The recordings.
        out: Folder of the dataset, which must not exist.
        robot_type: Robot type stored in the dataset.
        actions: Take the next state as action where no commands were recorded.

    Returns:
        Numbers of episodes and frames, seconds and the frame rate.

    Raises:
        ValueError: Episodes do not fit into one dataset, or as in `ImportPlan.episodes`.
    """
    episodes = plan.episodes()
    first = next(episodes)
    demo = first.demonstration
    features = {key: names for key, (_, names) in plan.meaning.kept.items()}
    made = actions and not plan.has_actions
    if made and demo.joint_position is None:
        parts = [part for part in _POSE_ACTION if getattr(demo, part) is not None]
        features["action"] = tuple(n for part in parts for n in _POSE_ACTION[part])
        if not parts:
            features["action"] = features["observation.state"]
    sizes = {camera: _size(*images) for camera, images in first.images.items()}
    frames, seconds = 0, 0.0
    writer = DatasetWriter(out, demo.fps, robot_type, demo.joint_names, features, cameras=sizes)
    with writer:
        for one in _chained(first, episodes):
            if made:
                one = _with_next_states(one)
            _require_fit(demo, one.demonstration)
            _add(writer, one, sizes)
            frames += len(one.demonstration)
            seconds += one.demonstration.duration
            for note in one.notes:
                print(f"note: {note}")
    return {
        "episodes": len(plan.recordings),
        "frames": frames,
        "seconds": seconds,
        "fps": demo.fps,
    }


def _chained(first: Episode, others: Iterator[Episode]) -> Iterator[Episode]:
    yield first
    yield from others


def _require_fit(first: Demonstration, other: Demonstration) -> None:
    if first.fps != other.fps:
        text = f"frame rates of {first.fps:g} and {other.fps:g} (give --fps; stamps are kept)"
        raise ValueError(f"episodes do not fit into one dataset: {text}")


def _add(writer: DatasetWriter, one: Episode, sizes: Mapping[str, tuple[int, int]]) -> None:
    demo = one.demonstration
    if not one.images:
        writer.add_episode(demo)
        return
    rows = {name: getattr(demo, name) for name in demo.recorded}
    rows["time"] = demo.time + demo.start_time
    rows |= demo.extra
    streams = {camera: _images(*images) for camera, images in one.images.items()}
    writer.start_episode(demo.task)
    for k in range(len(demo)):
        shown = {}
        for camera, stream in streams.items():
            image, size = next(stream), sizes[camera]
            if image.shape[0] < size[0] or image.shape[1] < size[1]:
                raise ValueError(f"images of {camera} change their size at frame {k}")
            shown[camera] = image[: size[0], : size[1]]
        writer.add_frame(images=shown, **{name: row[k] for name, row in rows.items()})
    writer.save_episode()


def _with_next_states(one: Episode) -> Episode:
    """Take the joints, the pose or the state of the next frame as action; the last repeats."""
    demo = one.demonstration
    if demo.joint_position is not None:
        return replace(
            one, demonstration=replace(demo, command_position=_next(demo.joint_position))
        )
    columns = [getattr(demo, p) for p in _POSE_ACTION if getattr(demo, p) is not None]
    columns = [rotation_vectors(c) if c.shape[1] == 4 else c for c in columns]
    columns = columns or [demo.extra["observation.state"]]
    action = _next(np.concatenate(columns, axis=1))
    return replace(one, demonstration=replace(demo, extra={**demo.extra, "action": action}))


def _next(values: np.ndarray) -> np.ndarray:
    return np.concatenate([values[1:], values[-1:]])


def _episode(recording: Recording, meaning: Meaning, options: ImportOptions) -> Episode:
    """One recording on the clock of its state, in SI units."""
    main = meaning.main
    frames = recording.fields[main].frames
    if frames < 2:
        raise recording.error(f"a demonstration needs at least two frames, got {frames}", main)
    notes: list[str] = []
    time = _stamps(recording, meaning, options, frames, notes)
    clocks: dict[str, np.ndarray | None] = {}

    def rows(places: Sequence[Place]) -> np.ndarray:
        name = places[0][0]
        values = read_columns(recording, places)
        index = _index(recording, name, len(values), time, meaning, clocks)
        return np.where((index < 0)[:, None], np.nan, values[np.maximum(index, 0)])

    quantities = {r: rows(s.columns) for r, s in meaning.selections.items() if r != "time"}
    kept = {key: rows(places) for key, (places, _) in meaning.kept.items()}
    images = {
        camera: (
            recording.fields[name],
            _index(recording, name, recording.fields[name].frames, time, meaning, clocks),
        )
        for camera, name in meaning.cameras.items()
    }
    known = _known_frames(recording, clocks, time, notes)
    cut = slice(*known)
    bad = {**quantities, **kept}
    for name, values in bad.items():
        wrong = np.argwhere(~np.isfinite(values[cut]))
        if len(wrong):
            frame, column = int(wrong[0, 0]) + known[0], int(wrong[0, 1])
            places = (
                meaning.selections[name].columns
                if name in quantities
                else (meaning.kept[name][0])
            )
            text = f"is {values[frame, column]} at frame {frame}: cut or mend the recording"
            raise recording.error(text, places[column][0])
    try:
        demo = _demonstration(
            {name: values[cut] for name, values in quantities.items()},
            {name: values[cut] for name, values in kept.items()},
            time[cut],
            recording,
            meaning,
            options,
        )
    except DatasetError:
        raise
    except ValueError as error:
        raise recording.error(str(error)) from error
    shown = {camera: (one, index[cut]) for camera, (one, index) in images.items()}
    return Episode(demonstration=demo, images=shown, notes=tuple(notes))


def _demonstration(
    quantities: Mapping[str, np.ndarray],
    kept: Mapping[str, np.ndarray],
    time: Float64[np.ndarray, " _frames"],
    recording: Recording,
    meaning: Meaning,
    options: ImportOptions,
) -> Demonstration:
    values = {r: v * meaning.decisions[r].factor for r, v in quantities.items()}
    known = (*JOINT_FIELDS, "position", "feature")
    fields: dict[str, Any] = {r: values[r] for r in known if r in values}
    if "gripper" in values:
        opening = values["gripper"]
        # Two fingers of opposite signs, as robomimic keeps them, open by their distance.
        fields["gripper"] = (
            opening[:, 0] - opening[:, 1] if opening.shape[1] == 2 else opening[:, 0]
        )
    role = next((role for role in ORIENTATION_ROLES if role in values), None)
    if role is not None:
        is_matrix = role == "pose_matrix"
        numbers = quantities[role] if is_matrix else values[role]
        fields["orientation"] = to_quaternion(role, numbers)
        if is_matrix and "position" not in fields:
            moved = transforms(numbers)[:, :3, 3].numpy()
            fields["position"] = moved * meaning.decisions[role].factor
    extra = dict(kept)
    if meaning.kept.get("action", ((), ()))[1] == ("gripper.pos",) and "gripper" in values:
        extra["action"] = kept["action"] * meaning.decisions["gripper"].factor
    step = float(np.median(np.diff(time)))
    return Demonstration(
        time=time - time[0],
        start_time=float(time[0]),
        joint_names=meaning.joint_names,
        task=options.task or recording.task or recording.file.stem,
        # LeRobot counts frames at a whole rate; true stamps are kept in their own column.
        fps=options.fps or max(1, round(1 / max(step, 1e-9))),
        extra=extra,
        **fields,
    )


def _stamps(
    recording: Recording,
    meaning: Meaning,
    options: ImportOptions,
    frames: int,
    notes: list[str],
) -> Float64[np.ndarray, " frames"]:
    """Stamps of the state [s], or even ones at the rate that is known."""
    if meaning.time:
        time = read_stamps(recording, meaning.time, options.units.get("time"))
        if len(time) != frames:
            text = f"holds {len(time)} stamps for {frames} frames of the state"
            raise recording.error(f"{text}: name its own stamps (--time)", meaning.time)
        steps = np.diff(time)
        usual = float(np.median(steps))
        for k in np.flatnonzero(steps > max(_JUMP * usual, _LONGEST_STEP))[:1]:
            place = f"{recording.file.name} {recording.label}".strip()
            text = f"{meaning.time} jumps by {steps[k]:.3g} s after frame {k}"
            notes.append(f"{place}: {text}")
        return time
    if options.duration is not None:
        return np.linspace(0.0, options.duration, frames)
    rate = options.fps or recording.fps
    if rate is None:
        videos = {recording.fields[n].rate for n in meaning.cameras.values()} - {0.0}
        same = all(recording.fields[n].frames == frames for n in meaning.cameras.values())
        rate = videos.pop() if len(videos) == 1 and same else None
    if rate is None:
        stamps = [n for n, one in recording.fields.items() if is_time(n, one)]
        if stamps:
            count = recording.fields[stamps[0]].frames
            text = f"holds {count} stamps for {frames} frames of the state"
            raise recording.error(f"{text}: give --fps, or mend the recording", stamps[0])
        raise recording.error(
            "there are no stamps: name the field of stamps (time), or give duration or fps"
        )
    return np.arange(frames) / rate


def read_stamps(
    recording: Recording, name: str, unit: str | None = None
) -> Float64[np.ndarray, " _frames"]:
    """Stamps of a field [s], in the given unit or the one that its name or size tells.

    Raises:
        DatasetError: Stamps do not increase, or their unit is in doubt.
    """
    time = recording.fields[name].numbers()[:, 0]
    bad = np.flatnonzero(~np.isfinite(time))
    if len(bad):
        raise recording.error(f"is {time[bad[0]]} at frame {bad[0]}", name)
    steps = np.diff(time)
    stalled = np.flatnonzero(steps <= 0)
    if len(stalled):
        k = int(stalled[0])
        text = (
            f"time must increase, but goes from {time[k]:.9g} to {time[k + 1]:.9g} at frame {k}"
        )
        raise recording.error(
            f"{text}: remove repeated rows, or give --fps without stamps", name
        )
    unit = unit or recording.fields[name].unit or time_unit_in(name)
    if unit:
        return time * unit_factor("time", unit)
    step = float(np.median(steps)) if len(steps) else 1.0
    sizes = {unit: unit_factor("time", unit) for unit in ("s", "ms", "us", "ns")}
    if time[0] > _EPOCH and (
        found := [u for u, size in sizes.items() if 1e9 < time[0] * size < 3e9]
    ):
        return time * sizes[found[0]]
    fits = [u for u, size in sizes.items() if _SHORTEST_STEP <= step * size <= _LONGEST_STEP]
    counts = bool((steps == 1).all())
    if counts or len(fits) != 1:
        kinds = "a count of frames (give --fps), ms or s" if counts else "s, ms, us or ns"
        text = f"steps by {step:.4g}: {kinds}? Give the unit: --units time s"
        raise recording.error(text, name)
    return time * sizes[fits[0]]


def _index(
    recording: Recording,
    name: str,
    length: int,
    time: Float64[np.ndarray, " frames"],
    meaning: Meaning,
    clocks: dict[str, np.ndarray | None],
) -> Int64[np.ndarray, " frames"]:
    """Frame of a field that is the latest at each time of the state; -1 before its first one.

    Nothing is interpolated: a robot does not know what its slower sensors will measure.
    """
    own = clock_of(recording, name, meaning.time)
    video = recording.fields[name]
    if own not in ("", meaning.time):
        stamps = read_stamps(recording, own)
    elif length == len(time):
        return np.arange(length)
    elif video.rate:
        stamps = time[0] + np.arange(length) / video.rate
        if abs(length / video.rate - (time[-1] - time[0])) > 0.5 + 0.05 * (time[-1] - time[0]):
            text = f"lasts {length / video.rate:.1f} s, the states {time[-1] - time[0]:.1f} s"
            raise recording.error(f"{text}: they do not belong together", name)
    elif length in (len(time) - 1, len(time) + 1):
        return np.minimum(np.arange(len(time)), length - 1)
    else:
        shapes = f"{length} frames, the state {len(time)}"
        text = f"arrays differ in their numbers of frames: it has {shapes}, and no stamps are"
        raise recording.error(f"{text} its own", name)
    # The tolerance is for stamps that were rounded.
    index = np.searchsorted(stamps, time + 1e-6, side="right") - 1
    usual = float(np.median(np.diff(stamps))) if len(stamps) > 1 else 0.0
    age = time - stamps[np.maximum(index, 0)]
    index[age > max(_STALE, 3 * usual)] = -1
    clocks[name] = index
    return index


def _known_frames(
    recording: Recording,
    clocks: Mapping[str, np.ndarray | None],
    time: Float64[np.ndarray, " frames"],
    notes: list[str],
) -> tuple[int, int]:
    """First frame and exclusive end of the part in which all fields are known."""
    known = np.ones(len(time), bool)
    for index in clocks.values():
        if index is not None:
            known &= index >= 0
    inside = np.flatnonzero(known)
    place = f"{recording.file.name} {recording.label}".strip()
    if not len(inside):
        late = ", ".join(clocks)
        raise recording.error(f"the clocks of {late} and of the state do not overlap")
    start, stop = int(inside[0]), int(inside[-1]) + 1
    if not known[start:stop].all():
        frame = start + int(np.argmin(known[start:stop]))
        silent = [n for n, i in clocks.items() if i is not None and i[frame] < 0]
        text = f"is silent for more than {_STALE} s at {time[frame] - time[0]:.2f} s"
        raise recording.error(f"{text}: split the recording there", silent[0])
    if (start, stop) != (0, len(time)):
        cut = len(time) - (stop - start)
        notes.append(f"{place}: {cut} frames without {', '.join(clocks)} are cut at the ends")
    return start, stop


def _size(images: Field, index: np.ndarray) -> tuple[int, int]:
    """Even height and width of a camera's images [px]; a last odd row or column is cut."""
    first = next(_images(images, index[:1]))
    height, width = first.shape[:2]
    return height - height % 2, width - width % 2


def _images(images: Field, index: Int64[np.ndarray, " frames"]) -> Iterator[Image]:
    """RGB image of each frame, read in batches."""
    if images.video is not None:
        yield from _video_images(images, index)
        return
    scale = None
    for start in range(0, len(index), _BATCH):
        wanted = index[start : start + _BATCH]
        first = int(wanted[0])
        batch = images.read(first, int(wanted[-1]) + 1)
        for k in wanted - first:
            if images.kind == "encoded":
                content = batch[k]
                data = content if isinstance(content, bytes) else np.asarray(content).tobytes()
                yield decode_image(data)
                continue
            image = np.asarray(batch[k])
            if image.dtype != np.uint8:
                # Of real numbers, 0 to 1 or 0 to 255.
                scale = scale or (255.0 if float(image.max()) <= 1.0 else 1.0)
                image = np.clip(np.rint(image * scale), 0, 255).astype(np.uint8)
            yield _rgb(image)


def _rgb(image: np.ndarray) -> Image:
    """An image with its three colours last."""
    if image.ndim == 2:
        image = image[..., None]
    if image.shape[-1] not in (1, 3, 4):
        image = np.moveaxis(image, 0, -1)
    if image.shape[-1] == 1:
        image = np.repeat(image, 3, axis=-1)
    return np.ascontiguousarray(image[..., :3])


def _video_images(images: Field, index: Int64[np.ndarray, " frames"]) -> Iterator[Image]:
    assert images.video is not None
    length = images.frames / images.rate
    segment = VideoSegment(file=images.video, start=0.0, stop=length)
    decoded = decode(segment, images.rate, frames=sorted({*index.tolist()}))
    number, image = -1, None
    for wanted in index.tolist():
        while number < wanted:
            found = next(decoded, None)
            if found is None:
                if image is None:
                    raise DatasetError("holds no images", file=images.video)
                break  # the container promised more images than it holds
            number, image = found
        assert image is not None
        yield image
