"""Datasets from recordings: a preview, SI units, commands as actions, images as videos."""

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int64

from hrc_learn.demos.dataset_writer import DatasetWriter
from hrc_learn.demos.demonstration import JOINT_FIELDS, Demonstration
from hrc_learn.demos.issues import DatasetError, aligned
from hrc_learn.demos.read.quantities import ORIENTATION_ROLES, to_quaternion, transforms
from hrc_learn.demos.recorded_episode import rotation_vectors
from hrc_learn.demos.recording_clock import Clock, clock_of_state
from hrc_learn.demos.recording_files import Field, Recording
from hrc_learn.demos.recording_formats import open_recordings
from hrc_learn.demos.recording_meaning import Meaning, read_columns, understand
from hrc_learn.demos.recording_names import ImportOptions, Place
from hrc_learn.demos.videos import Image, VideoSegment, decode, decode_image

_BATCH = 32
"""Images read at a time."""
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

    @property
    def has_actions(self) -> bool:
        """True if actions were recorded."""
        return "action" in self.meaning.kept or "command_position" in self.meaning.selections

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

    def lines(self, actions: bool = True) -> Iterator[str]:
        """The preview: fields and their meaning, notes, actions and episodes.

        Args:
            actions: True if next states are to be the actions where none were recorded.
        """
        meaning = self.meaning
        rows = [("fields", "understood as", "unit", "sure", "evidence")]
        for role, selection in meaning.selections.items():
            decision = meaning.decisions[role]
            units = ", ".join(dict.fromkeys(decision.units or (decision.unit,)))
            sure, why = f"{100 * decision.confidence:.0f} %", decision.evidence
            text = f"{role} of {len(selection.columns)}"
            given = "given" if role in self.options.units else "declared"
            rows.append(
                (", ".join(self._tokens(selection.columns)), text, units, sure, why or given)
            )
        for key, (places, _) in meaning.kept.items():
            fields = ", ".join(self._tokens(places))
            rows.append((fields, f"{key}, as recorded", "?", "", "no unit is known"))
        for camera, name in meaning.cameras.items():
            one = self.recordings[0].fields[name]
            shape = "x".join(map(str, one.shape[1:]))
            size = "image files" if one.kind == "encoded" else shape
            rows.append((name, f"camera {camera}", "", "", size))
        if meaning.time:
            rows.append((meaning.time, "time", "s", "", "by its name"))
        yield from aligned(rows)
        for reason in dict.fromkeys(meaning.left_out.values()):
            names = [name for name, why in meaning.left_out.items() if why == reason]
            yield f"left out: {', '.join(names)} ({reason})"
        yield from (f"note: {note}" for note in meaning.notes)
        yield from (f"note: {r.file.name}: {note}" for r in self.recordings for note in r.notes)
        if not self.has_actions:
            made = (
                "the next states are the actions" if actions else "the dataset has no actions"
            )
            yield f"no commands were recorded: {made}"
        yield "{episodes} episodes of {frames} frames in all".format(**self.counts())

    def template(self) -> str:
        """Content of a mapping file (JSON) that says what was understood."""
        meaning = self.meaning
        columns = {role: self._tokens(s.columns) for role, s in meaning.selections.items()}
        columns |= {key: self._tokens(places) for key, (places, _) in meaning.kept.items()}
        content = {
            "columns": columns,
            "units": {role: decision.unit for role, decision in meaning.decisions.items()},
            "images": meaning.cameras,
            "time": meaning.time,
            "joint_names": meaning.joint_names,
        }
        return json.dumps(content, indent=2) + "\n"

    def _tokens(self, places: Sequence[Place]) -> list[str]:
        """Fields and ranges of fields that name the columns."""
        runs: list[tuple[str, int, int]] = []
        for name, index in places:
            if runs and (runs[-1][0], runs[-1][2]) == (name, index):
                runs[-1] = (name, runs[-1][1], index + 1)
            else:
                runs.append((name, index, index + 1))
        fields = self.recordings[0].fields
        whole = [stop - start == fields[name].width for name, start, stop in runs]
        ranges = zip(runs, whole, strict=True)
        return [
            name if all_ else f"{name}[{start}:{stop}]" for (name, start, stop), all_ in ranges
        ]


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
    recordings = [one for path in paths for one in open_recordings(path, columns)]
    if not recordings:
        raise DatasetError("holds no episodes", file=paths[0])
    meaning = understand(recordings, replace(options, hinted=bool(columns)))
    return ImportPlan(recordings=tuple(recordings), meaning=meaning, options=options)


def write_plan(
    plan: ImportPlan, out: Path, robot_type: str, actions: bool
) -> dict[str, float | int]:
    """Write the episodes as a LeRobot dataset, once all of them have been read without a fault.

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
    rates: dict[float, str] = {}
    for one, recording in zip(plan.episodes(), plan.recordings, strict=True):
        rates.setdefault(one.demonstration.fps, f"{recording.file.name} {recording.label}")
        for note in one.notes:
            print(f"note: {note}")
    if len(rates) > 1:
        text = ", ".join(f"{rate:g} ({name.strip()})" for rate, name in [*rates.items()][:3])
        raise ValueError(f"frame rates differ: {text}; give --fps (stamps are kept)")
    first = next(plan.episodes())
    demo, sizes = first.demonstration, {}
    features = {key: names for key, (_, names) in plan.meaning.kept.items()}
    made = actions and not plan.has_actions
    if made and demo.joint_position is None:
        parts = [part for part in _POSE_ACTION if getattr(demo, part) is not None]
        names = [name for part in parts for name in _POSE_ACTION[part]]
        features["action"] = tuple(names) or features["observation.state"]
    for camera, images in first.images.items():
        height, width = next(_images(*images)).shape[:2]
        sizes[camera] = (height - height % 2, width - width % 2)  # videos need even sizes
    count, seconds = 0, 0.0
    names = demo.joint_names
    with DatasetWriter(out, demo.fps, robot_type, names, features, cameras=sizes) as writer:
        for one in plan.episodes():
            one = _with_next_states(one) if made else one
            writer.add_episode(
                one.demonstration,
                {c: _cropped(_images(*one.images[c]), *size) for c, size in sizes.items()},
            )
            count += len(one.demonstration)
            seconds += one.demonstration.duration
    counts = {"episodes": len(plan.recordings), "frames": count}
    return {**counts, "seconds": seconds, "fps": demo.fps}


def _cropped(images: Iterator[Image], height: int, width: int) -> Iterator[Image]:
    return (image[:height, :width] for image in images)


def _with_next_states(one: Episode) -> Episode:
    """Take the joints, the pose or the state of the next frame as action; the last repeats."""
    demo, joints = one.demonstration, one.demonstration.joint_position
    if joints is not None:
        return replace(one, demonstration=replace(demo, command_position=_next(joints)))
    columns = [getattr(demo, p) for p in _POSE_ACTION if getattr(demo, p) is not None]
    columns = [rotation_vectors(c) if c.shape[1] == 4 else c for c in columns]
    action = _next(np.concatenate(columns or [demo.extra["observation.state"]], axis=1))
    return replace(one, demonstration=replace(demo, extra={**demo.extra, "action": action}))


def _next(values: np.ndarray) -> np.ndarray:
    return np.concatenate([values[1:], values[-1:]])


def _episode(recording: Recording, meaning: Meaning, options: ImportOptions) -> Episode:
    """One recording on the clock of its state, in SI units."""
    clock = clock_of_state(recording, meaning, options)

    def rows(places: Sequence[Place]) -> np.ndarray:
        values = read_columns(recording, places)[clock.frames[places[0][0]]]
        wrong = np.argwhere(~np.isfinite(values))
        for frame, column in wrong[:1]:
            text = f"is {values[frame, column]} at frame {frame}: cut or mend the recording"
            raise recording.error(text, places[column][0])
        return values

    quantities = {r: rows(s.columns) for r, s in meaning.selections.items() if r != "time"}
    kept = {key: rows(places) for key, (places, _) in meaning.kept.items()}
    try:
        demo = _demonstration(quantities, kept, clock, recording, meaning, options)
    except ValueError as error:
        raise recording.error(str(error)) from error
    cameras = meaning.cameras.items()
    images = {camera: (recording.fields[name], clock.frames[name]) for camera, name in cameras}
    return Episode(demonstration=demo, images=images, notes=clock.notes)


def _demonstration(
    quantities: dict[str, np.ndarray],
    kept: dict[str, np.ndarray],
    clock: Clock,
    recording: Recording,
    meaning: Meaning,
    options: ImportOptions,
) -> Demonstration:
    units, time, extra = meaning.decisions, clock.time, dict(kept)
    values = {r: v * units[r].factor for r, v in quantities.items() if r != "pose_matrix"}
    known = (*JOINT_FIELDS, "position", "feature")
    fields: dict[str, Any] = {r: values[r] for r in known if r in values}
    if "gripper" in values:
        opening = values["gripper"]
        # Two fingers of opposite signs, as robomimic keeps them, open by their distance.
        two = opening.shape[1] == 2
        fields["gripper"] = opening[:, 0] - opening[:, 1] if two else opening[:, 0]
        if meaning.kept.get("action", ((), ()))[1] == ("gripper.pos",):
            extra["action"] = kept["action"] * units["gripper"].factor
    if "pose_matrix" in quantities:  # in a transform, the translation alone has a unit
        moved = transforms(quantities["pose_matrix"])[:, :3, 3].numpy()
        fields.setdefault("position", moved * units["pose_matrix"].factor)
    values |= {r: v for r, v in quantities.items() if r == "pose_matrix"}
    for role in [role for role in ORIENTATION_ROLES if role in values][:1]:
        fields["orientation"] = to_quaternion(role, values[role])
    step = max(float(np.median(np.diff(time))), 1e-9)
    return Demonstration(
        time=time - time[0],
        start_time=float(time[0]),
        joint_names=meaning.joint_names,
        task=options.task or recording.task or recording.file.stem,
        # LeRobot counts frames at a whole rate; true stamps are kept in their own column.
        fps=options.fps or max(1, round(1 / step)),
        extra=extra,
        **fields,
    )


def _images(images: Field, index: Int64[np.ndarray, " frames"]) -> Iterator[Image]:
    """RGB image of each frame, read in batches."""
    if images.video is not None:
        yield from _video_images(images, images.video, index)
        return
    scale = 0.0
    for start in range(0, len(index), _BATCH):
        wanted = index[start : start + _BATCH]
        batch = images.read(int(wanted[0]), int(wanted[-1]) + 1)
        for k in wanted - wanted[0]:
            image = batch[k]
            if images.kind == "encoded":
                yield decode_image(bytes(image))
                continue
            if image.dtype != np.uint8:
                # Of real numbers, 0 to 1 or 0 to 255.
                scale = scale or (255.0 if float(batch.max()) <= 1.0 else 1.0)
                image = np.clip(np.rint(image * scale), 0, 255).astype(np.uint8)
            yield _rgb(image)


def _rgb(image: np.ndarray) -> Image:
    """An image with its three colours last."""
    image = image[..., None] if image.ndim == 2 else image
    image = image if image.shape[-1] in (1, 3, 4) else np.moveaxis(image, 0, -1)
    image = np.repeat(image, 3, axis=-1) if image.shape[-1] == 1 else image
    return np.ascontiguousarray(image[..., :3])


def _video_images(
    images: Field, file: Path, index: Int64[np.ndarray, " frames"]
) -> Iterator[Image]:
    segment = VideoSegment(file=file, start=0.0, stop=images.frames / images.rate)
    decoded = decode(segment, images.rate, frames=sorted({*index.tolist()}))
    number, image = next(decoded, (-1, None))
    if image is None:
        raise DatasetError("holds no images", file=file)
    for wanted in index.tolist():
        while number < wanted:
            # The container may promise more images than it holds.
            number, image = next(decoded, (wanted, image))
        yield image
