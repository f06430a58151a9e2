"""Sound LeRobot datasets like those that are met, written without the code under test."""

import json
import shutil
import tempfile
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import torch
from lerobot_folders import write_folder

CAMERA = "observation.images.front"
FPS, SIZE = 30, (48, 64)
BEHIND = 3
"""Frames by which the arm follows its commands."""
HOME = np.array([-1.2, -0.7, 0.1, 0.6, 1.1, 1.6])
AWAY = np.array([0.9, 0.5, -0.6, 0.4, -0.5, -0.8])


def demonstration(seed: int) -> dict[str, np.ndarray]:
    """State and action of six joints [rad] and a gripper: reach, grasp, come half-way back."""
    rng = np.random.default_rng(seed)
    frames = int(rng.integers(150, 190))
    s = np.linspace(0, 1, frames + BEHIND)[:, None]
    there, rate = HOME + AWAY + 0.08 * rng.standard_normal(6), rng.uniform(0.9, 1.1, 6)
    reach = 0.5 - 0.5 * np.cos(1.4 * np.pi * s)
    arm = HOME + (there - HOME) * reach + 0.12 * np.sin(2.5 * np.pi * rate * s) * s * (1 - s)
    closed = (s > rng.uniform(0.6, 0.7)).astype(float)
    ahead = np.concatenate([arm, closed], axis=1)
    noise = 2e-4 * rng.standard_normal((frames, 6))
    state = ahead[:-BEHIND] + np.pad(noise, ((0, 0), (0, 1)))
    return {"observation.state": state, "action": ahead[BEHIND:]}


def write_video(
    path: Path, frames: int, fps: float = FPS, size: tuple[int, int] = SIZE, still: bool = False
) -> None:
    """A bar that wanders over a grey that brightens; black all along where `still`."""
    import av

    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=round(fps))
        stream.height, stream.width = size  # type: ignore[attr-defined]
        stream.pix_fmt = "yuv420p"  # type: ignore[attr-defined]
        for k in range(frames):
            image = np.full((*size, 3), 0 if still else 40 + k % 150, np.uint8)
            if not still:
                image[:, k % (size[1] - 6) :][:, :6] = (250, 40, 40)
            for packet in stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")):  # type: ignore[attr-defined]
                container.mux(packet)
        for packet in stream.encode():  # type: ignore[attr-defined]
            container.mux(packet)


def bar(image: torch.Tensor) -> int:
    """Column where the red bar of `write_video` begins."""
    red = image[0].int() - image[1].int()
    return int((red > 120).float().mean(0).gt(0.5).nonzero()[0])


_MADE = tempfile.TemporaryDirectory()
"""Sets made so far: encoding their videos takes far longer than a copy."""


def write_set(root: Path, version: str, *, degrees: bool = False, camera: bool = False) -> Path:
    """A dataset of five demonstrations, in the layout of its version."""
    made = Path(_MADE.name) / f"{version}-{degrees}-{camera}"
    if not made.exists():
        _make_set(made, version, degrees, camera)
    return shutil.copytree(made, root)


def _make_set(root: Path, version: str, degrees: bool, camera: bool) -> None:
    episodes = [demonstration(seed) for seed in range(5)]
    if degrees:
        for episode in episodes:
            for values in episode.values():
                values[:, :6] = np.rad2deg(values[:, :6])
    names = [*(f"joint{i}.pos" for i in range(1, 7)), "gripper.pos"]
    keys = {"observation.state": names, "action": names}
    cameras = [CAMERA] if camera else []
    write_folder(root, episodes, keys, version=version, fps=FPS, videos=cameras)
    if camera:
        _add_videos(root, [len(episode["action"]) for episode in episodes])


def _add_videos(root: Path, lengths: list[int]) -> None:
    info = json.loads((root / "meta/info.json").read_text())
    names = ["height", "width", "channels"]  # LeRobot's policies need them
    info["features"][CAMERA] |= {"shape": [*SIZE, 3], "names": names}
    if info["codebase_version"].startswith("v3"):
        info["video_path"] = (
            "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
        )
        write_video(root / f"videos/{CAMERA}/chunk-000/file-000.mp4", sum(lengths))
        file = root / "meta/episodes/chunk-000/file-000.parquet"
        table = pq.read_table(file)
        ends = np.cumsum(lengths) / FPS
        columns = {
            "chunk_index": [0] * len(lengths),
            "file_index": [0] * len(lengths),
            "from_timestamp": ends - np.array(lengths) / FPS,
            "to_timestamp": ends,
        }
        for name, values in columns.items():
            table = table.append_column(f"videos/{CAMERA}/{name}", pa.array(list(values)))
        pq.write_table(table, file)
    else:
        info["video_path"] = (
            "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4"
        )
        for index, length in enumerate(lengths):
            name = f"videos/chunk-000/{CAMERA}/episode_{index:06d}.mp4"
            write_video(root / name, length)
    (root / "meta/info.json").write_text(json.dumps(info))


SETS = {
    "v3.0 with a camera": {"version": "v3.0", "camera": True},
    "v2.1 with a camera, in degrees": {"version": "v2.1", "camera": True, "degrees": True},
    "v2.0": {"version": "v2.0"},
}
"""Arguments of `write_set` by the name of a set."""
