"""Speed of recording and reading demonstrations, compared with a bare pyarrow read.

The dataset is that of an arm with an image feature: 20 episodes of 30 s at 50 Hz, 41 numbers
per frame. Reported are medians over repeats in one run on one thread. Reading is measured in
CPU time, on files in the disk cache, so other programs on a shared machine have little effect.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("HF_HUB_OFFLINE", "1")

import json
import statistics
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import torch

from hrc_learn import cli
from hrc_learn.demos import (
    DatasetWriter,
    ImageReader,
    check_dataset,
    load_demos,
    open_demos,
)
from hrc_learn.geometry import quaternion

JOINTS = tuple(f"panda_joint{i}" for i in range(1, 8))


@dataclass(frozen=True, kw_only=True)
class Args:
    episodes: int = 20
    """Episodes of the dataset."""
    frames: int = 1500
    """Number of frames in each episode."""
    repeats: int = 9
    """Number of repeats of each reading; the median is reported."""
    peer: bool = False
    """Also record and read one episode, and images of two cameras, with LeRobot."""
    json: Path | None = None
    """File for the measured values, one flat JSON object of numbers."""


def main(args: Args) -> None:
    """Measure, print a table, and write the measured values."""
    pa.set_cpu_count(1)
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder) / "set"
        figures = measure_writing(root, args)
        figures |= measure_reading(root, args)
        if args.peer:
            figures |= measure_lerobot(Path(folder) / "peer", args)
            figures |= measure_images(Path(folder) / "images")
    for name, value in figures.items():
        print(f"{name:36s} {value:12,.4g}")
    if args.json:
        cli.write_json(args.json, figures)


def measure_writing(root: Path, args: Args) -> dict[str, float]:
    """Record the dataset frame by frame."""
    adding, saving = [], []
    with DatasetWriter(root, 50, "panda", JOINTS) as writer:
        for seed in range(args.episodes):
            frames = make_episode(args.frames, seed)
            writer.start_episode("place the bottle")
            start = time.perf_counter()
            for frame in frames:
                writer.add_frame(**frame)
            middle = time.perf_counter()
            writer.save_episode()
            adding.append(middle - start)
            saving.append(time.perf_counter() - middle)
        start = time.perf_counter()
    finalizing = time.perf_counter() - start
    return {
        "add_frame_us": 1e6 * statistics.median(adding) / args.frames,
        "save_episode_ms_per_frame": 1e3 * statistics.median(saving) / args.frames,
        "finalize_ms_per_frame": 1e3 * finalizing / (args.frames * args.episodes),
    }


def measure_reading(root: Path, args: Args) -> dict[str, float]:
    """Read the dataset: bare columns, demonstrations, one demonstration, tensors."""
    frames = args.frames * args.episodes
    floor = median_seconds(lambda: read_bare(root), args.repeats)
    # In turn: on a shared machine, both are slowed down by the same programs.
    turns = [
        (seconds(lambda: read_converted(root)), seconds(lambda: load_demos(root)))
        for _ in range(args.repeats)
    ]
    loop, loading = (statistics.median(column) for column in zip(*turns, strict=True))
    share = statistics.median(bare / ours for bare, ours in turns)
    one = median_seconds(lambda: load_demos(root, episodes=[args.episodes // 2]), args.repeats)
    source = open_demos(root)
    streaming = median_seconds(lambda: sum(map(len, source)), args.repeats)
    taking = median_seconds(lambda: source[args.episodes // 2], args.repeats)
    demos = load_demos(root)
    padding = median_seconds(demos.padded, args.repeats)
    checking = median_seconds(lambda: check_dataset(root), 3)
    return {
        "bare_read_samples_per_s": frames / floor,
        "load_demos_samples_per_s": frames / loading,
        "converted_read_samples_per_s": frames / loop,
        "load_demos_over_bare_read": loading / floor,
        "load_demos_speed_of_converted_read": share,
        "load_one_episode_ms": 1e3 * one,
        "open_demos_samples_per_s": frames / streaming,
        "open_demos_take_one_ms": 1e3 * taking,
        "padded_samples_per_s": frames / padding,
        "check_samples_per_s": frames / checking,
    }


def measure_lerobot(root: Path, args: Args) -> dict[str, float]:
    """Times of LeRobot's own classes for one episode of the same columns."""
    start = time.perf_counter()
    from lerobot.datasets import LeRobotDataset

    importing = time.perf_counter() - start
    features = {
        "observation.state": {"dtype": "float32", "shape": (28,), "names": None},
        "action": {"dtype": "float32", "shape": (7,), "names": None},
    }
    dataset = LeRobotDataset.create("local/peer", 50, features, root=root, use_videos=False)
    start = time.perf_counter()
    for _ in range(args.frames):
        state, action = np.zeros(28, np.float32), np.zeros(7, np.float32)
        dataset.add_frame({"observation.state": state, "action": action, "task": "place"})
    adding = time.perf_counter() - start
    start = time.perf_counter()
    dataset.save_episode()
    saving = time.perf_counter() - start
    dataset.finalize()
    opened = LeRobotDataset("local/peer", root=root, video_backend="pyav")
    start = time.perf_counter()
    for index in range(args.frames):
        opened[index]
    reading = time.perf_counter() - start
    return {
        "lerobot_import_s": importing,
        "lerobot_add_frame_us": 1e6 * adding / args.frames,
        "lerobot_save_episode_ms_per_frame": 1e3 * saving / args.frames,
        "lerobot_samples_per_s": args.frames / reading,
    }


def measure_images(root: Path, frames: int = 150, size: tuple[int, int] = (480, 640)) -> dict:
    """Read images of two cameras frame by frame: `ImageReader` and LeRobot's `dataset[i]`."""
    from lerobot.datasets import LeRobotDataset

    cameras = {"front": size, "wrist": size}
    rng = np.random.default_rng(0)
    scene = rng.integers(0, 255, (60, 80, 3), dtype=np.uint8).repeat(8, 0).repeat(8, 1)
    with DatasetWriter(root, 30, "panda", JOINTS, cameras=cameras) as writer:
        writer.start_episode("place the bottle")
        for k in range(frames):
            image = np.roll(scene, 3 * k, axis=1)  # the camera pans
            images = {"front": image, "wrist": image[::-1]}
            writer.add_frame(time=k / 30, joint_position=np.full(7, 0.01 * k), images=images)
        writer.save_episode()
    reader = ImageReader(root)
    opened = LeRobotDataset("local/images", root=root)
    ours = median_seconds(lambda: reader.read(0), 3)
    theirs = median_seconds(lambda: [opened[k] for k in range(frames)], 3)
    return {
        "images_of_two_cameras_frames_per_s": frames / ours,
        "lerobot_images_of_two_cameras_frames_per_s": frames / theirs,
    }


def make_episode(frames: int, seed: int) -> list[dict]:
    """Frames of one episode, made in advance so that only recording is measured."""
    rng = np.random.default_rng(seed)
    joints = np.cumsum(rng.normal(scale=0.01, size=(frames, 7)), axis=0)
    angle = np.linspace(0, 2, frames)
    return [
        {
            "time": 0.02 * k,
            "joint_position": joints[k],
            "joint_velocity": joints[k] - joints[k - 1],
            "position": joints[k, :3],
            "orientation": np.array([np.cos(angle[k]), np.sin(angle[k]), 0.0, 0.0]),
            "gripper": 0.04,
            "feature": joints[k, 3:5],
            "feature_visible": True,
            "human_effort": joints[k],
            "command_velocity": joints[k],
        }
        for k in range(frames)
    ]


def read_bare(root: Path) -> list[np.ndarray]:
    """The same columns as flat arrays without any conversion: no reader can be faster."""
    return [
        np.concatenate(
            [
                chunk.flatten().to_numpy()
                if pa.types.is_nested(chunk.type)
                else chunk.to_numpy()
                for chunk in table.column(name).chunks
            ]
        )
        for table in map(pq.read_table, data_files(root))
        for name in table.column_names
    ]


def read_converted(root: Path) -> list[dict[str, np.ndarray]]:
    """A bare loop that returns the same arrays as `load_demos`: float64 for each quantity and
    episode, orientations as continuous unit quaternions, time from 0.
    """
    rows = pa.concat_tables(map(pq.read_table, sorted((root / "meta/episodes").glob("*/*"))))
    lengths = rows.column("length").to_pylist()
    names = json.loads((root / "meta/info.json").read_text(encoding="utf-8"))["features"]
    layout = json.loads((root / "meta/hrc_learn.json").read_text(encoding="utf-8"))["columns"]
    places = {
        role: (entry["key"], [names[entry["key"]]["names"].index(n) for n in entry["names"]])
        for role, entry in layout.items()
    }
    demonstrations = []
    for file in data_files(root):
        table = pq.read_table(file)
        columns = {}
        for key in {key for key, _ in places.values()}:
            array = table.column(key).combine_chunks()
            flat = array.flatten() if pa.types.is_nested(array.type) else array
            columns[key] = flat.to_numpy().reshape(len(table), -1)
        start = 0
        while start < len(table):
            stop = start + lengths[len(demonstrations)]
            demo = {
                role: columns[key][start:stop, first[0] : first[-1] + 1].astype(float)
                for role, (key, first) in places.items()
            }
            vectors = torch.from_numpy(demo.pop("rotation_vector"))
            demo["orientation"] = quaternion.continuous(quaternion.exp(vectors)).numpy()
            demo["time"] -= demo["time"][0]
            if not all(np.isfinite(values.sum()) for values in demo.values()):
                raise ValueError("not finite")
            demonstrations.append(demo)
            start = stop
    return demonstrations


def data_files(root: Path) -> list[Path]:
    """Parquet files of frames, in the order of the episodes."""
    return sorted((root / "data").glob("*/*.parquet"))


def seconds(call: Callable[[], object]) -> float:
    """CPU time of a call."""
    start = time.process_time()
    call()
    return time.process_time() - start


def median_seconds(call: Callable[[], object], repeats: int) -> float:
    """Median CPU time of a call."""
    return statistics.median(seconds(call) for _ in range(repeats))


if __name__ == "__main__":
    cli.run(main, Args)
