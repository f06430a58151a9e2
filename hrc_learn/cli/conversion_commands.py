"""`hrc import` and `hrc extract`: datasets of plain arrays, and markers in videos."""

import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from rich.progress import track

from hrc_learn.cli._run import write_values
from hrc_learn.cli.arguments import Extract, Import
from hrc_learn.demos import DatasetWriter, Demonstration, Detector, extract_features
from hrc_learn.demos.array_import import ArrayOptions, demonstrations_from_arrays
from hrc_learn.demos.recorded_episode import rotation_vectors
from hrc_learn.vision import MarkerDetector, centre


def import_arrays(args: Import) -> None:
    """Convert the recordings."""
    if not args.files:
        raise ValueError("name at least one recording to import")
    read = [(path, demo) for path in args.files for demo in _read(args, path)]
    _refuse_mixture(read)
    demos = [demo for _, demo in read]
    fps, features = demos[0].fps, {}
    if args.actions:
        demos, features = with_actions(demos)
    writer = DatasetWriter(args.out, fps, args.robot_type, demos[0].joint_names, features)
    with writer:
        for demo in demos:
            writer.add_episode(demo)
    summary = {
        "episodes": len(demos),
        "frames": sum(map(len, demos)),
        "seconds": sum(demo.duration for demo in demos),
        "fps": fps,
    }
    print(
        f"{args.out}: {summary['episodes']} demonstrations, {summary['frames']} frames, "
        f"{summary['seconds']:.1f} s"
    )
    write_values(args.json, summary)


def _refuse_mixture(demos: Sequence[tuple[Path, Demonstration]]) -> None:
    """Refuse demonstrations, each with its file, that do not fit into one dataset."""
    first_path, first = demos[0]
    for path, demo in demos[1:]:
        for what, one, two, advice in (
            ("joints", len(first.joint_names), len(demo.joint_names), "import them separately"),
            ("joints", first.joint_names, demo.joint_names, "give --joint-names"),
            ("arrays", first.recorded, demo.recorded, "import them separately"),
            ("frame rate", first.fps, demo.fps, "give --fps; stamps are kept"),
        ):
            if one != two:
                raise ValueError(
                    f"{path} and {first_path} do not fit into one dataset: {what} "
                    f"{_in_words(two)} and {_in_words(one)} ({advice})"
                )


def _in_words(value: float | int | tuple[str, ...]) -> str:
    return ", ".join(value) if isinstance(value, tuple) else f"{value:g}"


_IMPORTED_UNITS = ("joint_position", "position", "time")
_POSE_ACTION = {
    "position": ("ee.x", "ee.y", "ee.z"),
    "orientation": ("ee.wx", "ee.wy", "ee.wz"),
}


def with_actions(
    demos: Sequence[Demonstration],
) -> tuple[list[Demonstration], dict[str, tuple[str, ...]]]:
    """Add actions: the joints, or else the pose, of the next frame. The last one repeats.

    Args:
        demos: Demonstrations with the same columns.

    Returns:
        Demonstrations with actions, and the additional features for a `DatasetWriter`.
    """
    if demos[0].joint_position is not None:
        return [replace(d, command_position=_next(d.joint_position)) for d in demos], {}
    parts = [name for name in _POSE_ACTION if getattr(demos[0], name) is not None]
    made = []
    for demo in demos:
        columns = [getattr(demo, name) for name in parts]
        columns = [rotation_vectors(c) if c.shape[1] == 4 else c for c in columns]
        action = _next(np.concatenate(columns, axis=1))
        made.append(replace(demo, extra={**demo.extra, "action": action}))
    return made, {"action": tuple(name for part in parts for name in _POSE_ACTION[part])}


def _next(values: np.ndarray | None) -> np.ndarray:
    assert values is not None
    return np.concatenate([values[1:], values[-1:]])


def _read(args: Import, path: Path) -> list[Demonstration]:
    """Read the demonstrations of one file."""
    if unknown := args.units.keys() - _IMPORTED_UNITS:
        raise ValueError(
            f"--units {min(unknown)}: no such quantity; there are {', '.join(_IMPORTED_UNITS)}"
        )
    options = ArrayOptions(
        arrays={
            "joints": _words(args.joints),
            "position": _words(args.position),
            "orientation": _words(args.orientation),
            "time": _words([args.time or ""]),
        },
        columns=_words(args.columns),
        units=args.units,
        quaternion_order=args.quaternion_order,
        joint_names=_words(args.joint_names),
        duration=args.duration,
        fps=args.fps,
        task=path.stem if args.task is None else args.task,
    )
    return demonstrations_from_arrays(path, options)


def _words(values: Sequence[str]) -> list[str]:
    """Words that are separated by spaces or commas."""
    return [word for value in values for word in value.split(",") if word]


def extract(args: Extract) -> int:
    """Search every new image for the marker; status 1 if some could not be read."""
    if not 0 <= args.marker < 50:
        raise ValueError(f"--marker must be from 0 to 49, got {args.marker}")
    start = time.perf_counter()
    done = extract_features(
        args.dataset,
        f"marker_{args.marker}",
        lambda: _detector(args.marker),
        camera=args.camera,
        progress=lambda episodes: track(episodes, description="Searching episodes"),
    )
    rate = done.frames / max(time.perf_counter() - start, 1e-9)
    seen = done.seen / done.frames if done.frames else 1.0
    print(
        f"{done.name}: {done.episodes} episodes searched, {done.known} known before; marker in "
        f"{100 * seen:.1f} % of {done.frames} frames, {done.without_image} without an image"
    )
    values = {
        "episodes": done.episodes,
        "episodes_known_before": done.known,
        "frames": done.frames,
        "seen_fraction": seen,
        "frames_without_image": done.without_image,
        "frames_per_s": rate,
        "episodes_left_out": len(done.left_out),
    }
    for reason in done.left_out.values():
        print(f"left out: {reason}")
    write_values(args.json, values)
    return int(bool(done.left_out))


def _detector(marker: int) -> Detector:
    """Detector of one marker's centre [px]."""
    markers = MarkerDetector([marker])

    def detect(image: np.ndarray) -> np.ndarray | None:
        corners = markers.detect(image).get(marker)
        return None if corners is None else centre(corners)

    return detect
