"""`hrc import`, `hrc extract`: datasets from arrays, and image features from videos."""

import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from rich.progress import track

from hrc_learn.cli._run import write_values
from hrc_learn.cli.arguments.dataset import Extract, ImportArrays
from hrc_learn.demos import DatasetWriter, Demonstration, Detector, extract_features
from hrc_learn.demos.arrays import (
    ArrayOptions,
    ArraySources,
    demonstrations_from_arrays,
    read_arrays,
)
from hrc_learn.demos.write.episode import rotation_vectors
from hrc_learn.vision import MarkerDetector, centre


def import_arrays(args: ImportArrays) -> None:
    """Import the recordings."""
    if not args.files:
        raise ValueError("name at least one recording to import")
    read = [(path, demo) for path in args.files for demo in _read(args, path)]
    _refuse_unlike(read)
    demos = [demo for _, demo in read]
    fps, features = demos[0].fps, {}
    if args.actions:
        demos, features = with_actions(demos)
    with DatasetWriter(
        args.out, fps, args.robot_type, demos[0].joint_names, features, dtype=args.dtype
    ) as writer:
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


def _refuse_unlike(demos: Sequence[tuple[Path, Demonstration]]) -> None:
    """Refuse demonstrations, each with its file, that cannot share a dataset."""
    first_path, first = demos[0]
    for path, demo in demos[1:]:
        for what, one, two, advice in (
            ("joints", len(first.joint_names), len(demo.joint_names), "import them apart"),
            ("joints", first.joint_names, demo.joint_names, "give --joint-names"),
            ("arrays", first.recorded, demo.recorded, "import them apart"),
            ("frame rate", first.fps, demo.fps, "give --fps; stamps are kept"),
        ):
            if one != two:
                raise ValueError(
                    f"{path} and {first_path} do not fit into one dataset: {what} "
                    f"{_in_words(two)} and {_in_words(one)} ({advice})"
                )


def _in_words(value: float | int | tuple[str, ...]) -> str:
    return ", ".join(value) if isinstance(value, tuple) else f"{value:g}"


_POSE_ACTION = {
    "position": ("ee.x", "ee.y", "ee.z"),
    "orientation": ("ee.wx", "ee.wy", "ee.wz"),
}


def with_actions(
    demos: Sequence[Demonstration],
) -> tuple[list[Demonstration], dict[str, tuple[str, ...]]]:
    """Demonstrations whose action is where the next frame is; the last one's is to stay.

    Args:
        demos: All of the same columns.

    Returns:
        Those, and the features of their own that a `DatasetWriter` is to be told of.
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


def _read(args: ImportArrays, path: Path) -> list[Demonstration]:
    """Demonstrations of one file."""
    sources = ArraySources(
        joints=args.joints,
        position=args.position,
        orientation=args.orientation,
        time=args.time,
    )
    options = ArrayOptions(
        units={
            "joint_position": args.joint_unit,
            "position": args.position_unit,
            "time": args.time_unit,
        },
        quaternion_order=args.quaternion_order,
        joint_names=args.joint_names,
        duration=args.duration,
        fps=args.fps,
        task=path.stem if args.task is None else args.task,
    )
    table = read_arrays(path, [name for name in args.columns.split(",") if name])
    return demonstrations_from_arrays(table, sources, options, path=path)


def extract(args: Extract) -> int:
    """Look at every image that was not looked at before; status 1 where some could not be."""
    if not 0 <= args.marker < 50:
        raise ValueError(f"--marker must be from 0 to 49, got {args.marker}")
    start = time.perf_counter()
    done = extract_features(
        args.dataset,
        f"marker_{args.marker}",
        lambda: _follow(args.marker),
        camera=args.camera,
        progress=lambda episodes: track(episodes, description="Looking at episodes"),
    )
    rate = done.frames / max(time.perf_counter() - start, 1e-9)
    share = done.seen / done.frames if done.frames else 1.0
    print(
        f"{done.name}: {done.episodes} episodes looked at, {done.known} known before; seen in "
        f"{100 * share:.1f} % of {done.frames} frames, {done.without_image} without an image"
    )
    values = {
        "episodes": done.episodes,
        "episodes_known_before": done.known,
        "frames": done.frames,
        "seen_share": share,
        "frames_without_image": done.without_image,
        "frames_per_s": rate,
        "episodes_left_out": len(done.left_out),
    }
    for said in done.left_out.values():
        print(f"left out: {said}")
    write_values(args.json, values)
    return int(bool(done.left_out))


def _follow(marker: int) -> Detector:
    """A detector that follows one marker."""
    markers = MarkerDetector([marker])

    def detect(image: np.ndarray) -> np.ndarray | None:
        corners = markers.detect(image).get(marker)
        return None if corners is None else centre(corners)

    return detect
