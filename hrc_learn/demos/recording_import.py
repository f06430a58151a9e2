"""Datasets from recordings: a preview, SI units, commands as actions, images as videos."""

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import groupby
from pathlib import Path

import numpy as np
from jaxtyping import Int64

from hrc_learn.demos.dataset_writer import DatasetWriter
from hrc_learn.demos.demonstration import Demonstration
from hrc_learn.demos.issues import DatasetError, aligned
from hrc_learn.demos.read.quantities import demonstration_fields
from hrc_learn.demos.recorded_episode import columns_for, rotation_vectors
from hrc_learn.demos.recording_clock import clock_of_state
from hrc_learn.demos.recording_files import Field, Recording
from hrc_learn.demos.recording_formats import open_recordings
from hrc_learn.demos.recording_meaning import Meaning, read_columns, understand
from hrc_learn.demos.recording_names import ImportOptions, Place
from hrc_learn.demos.videos import Image, decode_image

_POSE = ("position", "orientation")
_BATCH = 32
"""Number of images read at a time."""


@dataclass(frozen=True, kw_only=True)
class Episode:
    """One recording, at the stamps of its state (see `recording_clock`)."""

    demonstration: Demonstration
    images: dict[str, tuple[Field, Int64[np.ndarray, " _frames"]]] = field(default_factory=dict)
    """Camera -> its images, and the index of the image at each frame."""
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class ImportPlan:
    """Recordings and the meaning found for their fields."""

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
        """Numbers of episodes and frames, and of fields understood, kept and left out."""
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
            actions: True if the next states serve as actions where none were recorded.
        """
        meaning = self.meaning
        rows = [("fields", "understood as", "unit", "sure", "evidence")]
        for role, selection in meaning.selections.items():
            decision = meaning.decisions[role]
            units = ", ".join(dict.fromkeys(decision.units or (decision.unit,)))
            sure, why = f"{100 * decision.confidence:.0f} %", decision.evidence
            text = f"{role} of {len(selection.columns)}"
            given = "given" if role in self.options.units else "declared"
            fields = ", ".join(self._tokens(selection.columns))
            rows.append((fields, text, units, sure, why or given))
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
        """Content of a mapping file (JSON) with the meaning that was found."""
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
        """Fields and ranges of fields, such as "qpos[0:6]", that stand for the columns."""
        fields, tokens = self.recordings[0].fields, []
        # A run is a range of one field. Within a run, the component index minus the place in
        # the list is constant.
        runs = groupby(enumerate(places), key=lambda one: (one[1][0], one[1][1] - one[0]))
        for (name, _), run in runs:
            indices = [index for _, (_, index) in run]
            whole = len(indices) == fields[name].width
            tokens.append(name if whole else f"{name}[{indices[0]}:{indices[-1] + 1}]")
        return tokens


def plan_import(
    paths: Sequence[Path], options: ImportOptions, columns: Sequence[str] = ()
) -> ImportPlan:
    """Open recordings and find out what their fields mean; nothing is written.

    Args:
        paths: Files and folders.
        options: The caller's options.
        columns: Names for the columns of .npy files, or of text files without a header.

    Raises:
        DatasetError: A file cannot be read, or its content is not understood.
    """
    recordings = [one for path in paths for one in open_recordings(path, columns)]
    read = {name.rpartition("/")[2] for one in recordings for name in one.fields}
    if columns and read.isdisjoint(columns):
        text = "the files already name their columns, and none of these names"
        raise ValueError(f"--columns {', '.join(columns)}: {text}: leave the option out")
    if not recordings:
        raise DatasetError("holds no episodes", file=paths[0])
    meaning = understand(recordings, options, hinted=bool(columns))
    return ImportPlan(recordings=tuple(recordings), meaning=meaning, options=options)


def write_plan(
    plan: ImportPlan, out: Path, robot_type: str, actions: bool
) -> dict[str, float | int]:
    """Write the episodes as a LeRobot dataset, once all of them have been read without a fault.

    Args:
        plan: The recordings.
        out: Folder of the dataset, which must not exist.
        robot_type: Robot type stored in the dataset.
        actions: Use the next state as action where no commands were recorded.

    Returns:
        Numbers of `episodes` and `frames`, total duration `seconds` [s] and `fps` [1/s].

    Raises:
        ValueError: Episodes do not fit into one dataset.
        DatasetError: As in `ImportPlan.episodes`.
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
    demo = first.demonstration
    features = {key: names for key, (_, names) in plan.meaning.kept.items()}
    made = actions and not plan.has_actions
    if made and demo.joint_position is None:
        columns = columns_for([p for p in _POSE if p in demo.recorded], (), {})
        names = tuple(name for column in columns for name in column.names)
        features["action"] = names or features["observation.state"]
    sizes = {camera: next(_images(*shown)).shape[:2] for camera, shown in first.images.items()}
    count, seconds, joints = 0, 0.0, demo.joint_names
    with DatasetWriter(out, demo.fps, robot_type, joints, features, cameras=sizes) as writer:
        for one in plan.episodes():
            shown = {camera: _images(*images) for camera, images in one.images.items()}
            shot = one.demonstration
            writer.add_episode(_with_next_states(shot) if made else shot, shown)
            count += len(shot)
            seconds += shot.duration
    counts = {"episodes": len(plan.recordings), "frames": count}
    return {**counts, "seconds": seconds, "fps": demo.fps}


def _with_next_states(demo: Demonstration) -> Demonstration:
    """Use joints, pose or state of the next frame as action; the last frame uses its own."""
    following = np.minimum(np.arange(len(demo)) + 1, len(demo) - 1)
    if demo.joint_position is not None:
        return replace(demo, command_position=demo.joint_position[following])
    columns = [getattr(demo, part) for part in _POSE if part in demo.recorded]
    columns = [rotation_vectors(c) if c.shape[1] == 4 else c for c in columns]
    states = np.concatenate(columns or [demo.extra["observation.state"]], axis=1)
    return replace(demo, extra={**demo.extra, "action": states[following]})


def _episode(recording: Recording, meaning: Meaning, options: ImportOptions) -> Episode:
    """One recording, at the stamps of its state, in SI units."""
    clock = clock_of_state(recording, meaning, options)
    time, step = clock.time, max(float(np.median(np.diff(clock.time))), 1e-9)

    def rows(places: Sequence[Place]) -> np.ndarray:
        values = read_columns(recording, places)[clock.frames[places[0][0]]]
        wrong = np.argwhere(~np.isfinite(values))
        for frame, column in wrong[:1]:
            text = f"is {values[frame, column]} at frame {frame}: cut or mend the recording"
            raise recording.error(text, places[column][0])
        return values

    quantities = {r: rows(s.columns) for r, s in meaning.selections.items() if r != "time"}
    factors = {role: decision.factor for role, decision in meaning.decisions.items()}
    extra = {key: rows(places) for key, (places, _) in meaning.kept.items()}
    if meaning.kept.get("action", ((), ()))[1] == ("gripper.pos",) and "gripper" in quantities:
        extra["action"] = extra["action"] * factors["gripper"]
    try:
        demo = Demonstration(
            time=time - time[0],
            start_time=float(time[0]),
            joint_names=meaning.joint_names,
            task=options.task or recording.task or recording.file.stem,
            # LeRobot uses whole frame rates; true stamps are kept in a column of their own.
            fps=options.fps or max(1, round(1 / step)),
            extra=extra,
            **demonstration_fields(quantities, factors),
        )
    except ValueError as error:
        raise recording.error(str(error)) from error
    cameras = meaning.cameras.items()
    images = {camera: (recording.fields[name], clock.frames[name]) for camera, name in cameras}
    return Episode(demonstration=demo, images=images, notes=clock.notes)


def _images(images: Field, index: Int64[np.ndarray, " frames"]) -> Iterator[Image]:
    """RGB image of each frame, read in batches and cropped to an even size for videos."""
    scale = 0.0
    for wanted in np.split(index, np.flatnonzero(np.diff(index // _BATCH)) + 1):
        batch = images.read(int(wanted[0]), int(wanted[-1]) + 1)
        for image in batch[wanted - wanted[0]]:
            if images.kind == "encoded":
                image = decode_image(bytes(image))
            elif image.dtype != np.uint8:
                # Images of real numbers range from 0 to 1 or from 0 to 255. Black images, which
                # may come first, do not show the range.
                if not scale and (largest := float(batch.max())) > 0:
                    scale = 255.0 if largest <= 1.0 else 1.0
                image = np.clip(np.rint(image * scale), 0, 255).astype(np.uint8)
            rgb = _rgb(image)
            yield rgb[: len(rgb) // 2 * 2, : rgb.shape[1] // 2 * 2]


def _rgb(image: np.ndarray) -> Image:
    """The image with its three colour channels last."""
    image = image[..., None] if image.ndim == 2 else image
    image = image if image.shape[-1] in (1, 3, 4) else np.moveaxis(image, 0, -1)
    image = np.repeat(image, 3, axis=-1) if image.shape[-1] == 1 else image
    return np.ascontiguousarray(image[..., :3])
