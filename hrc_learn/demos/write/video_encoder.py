"""Camera images of a recording: one video an episode and camera, encoded as frames come.

Raw images of a few seconds would not fit into memory, and a video that LeRobot keeps for
many episodes together would be lost with the recording; a file an episode is neither.
"""

import contextlib
from collections.abc import Mapping
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Shaped, UInt8

from hrc_learn.demos.format.lerobot_v3 import Statistics, image_statistics
from hrc_learn.store import sync_file

Image = UInt8[np.ndarray, "_height _width 3"]

_CODEC = {"preset": "ultrafast", "crf": "20", "g": "2"}
"""Encoded in the recording's own process: 9 ms a 1440x1080 frame instead of 25, for twice the
size. A key frame at every second one, as LeRobot has it: policies read single frames."""
_SAMPLE_EVERY = 5
_SAMPLE_PIXELS = 150


def image_key(camera: str) -> str:
    """Feature that holds a camera's images."""
    return f"observation.images.{camera}"


def video_path(folder: Path, key: str, episode: int) -> Path:
    """Where a staged video lies."""
    return folder / f"episode_{episode:06d}.{key}.mp4"


def video_features(cameras: Mapping[str, tuple[int, int]], fps: float) -> dict[str, dict]:
    """Features of cameras (name -> height, width) as `meta/info.json` declares them."""
    return {
        image_key(camera): {
            "dtype": "video",
            "shape": [height, width, 3],
            "names": ["height", "width", "channels"],
            "info": {
                "video.height": height,
                "video.width": width,
                "video.codec": "h264",
                "video.pix_fmt": "yuv420p",
                "video.fps": fps,
                "video.channels": 3,
                "has_audio": False,
                "is_depth_map": False,
            },
        }
        for camera, (height, width) in cameras.items()
    }


class CameraRecorder:
    """Encodes the images of the open episode of a recording."""

    def __init__(self, cameras: Mapping[str, tuple[int, int]], fps: float, folder: Path):
        """
        Args:
            cameras: Camera -> height and width of its images [px].
            fps: Frame rate [1/s].
            folder: Where finished videos go.

        Raises:
            ValueError: A size is odd, which the video format cannot store.
        """
        for camera, size in cameras.items():
            if any(length <= 0 or length % 2 for length in size):
                raise ValueError(f"images of {camera} are {size}: videos need even sizes")
        self._cameras = dict(cameras)
        self._fps = fps
        self._folder = folder
        self._videos: dict[str, _Video] = {}

    def examine(self, images: Mapping[str, Image]) -> None:
        """Refuse what cannot be encoded.

        Raises:
            ValueError: A camera is missing or unknown, or its image is of the wrong size.
        """
        if images.keys() != self._cameras.keys():
            raise ValueError(
                f"a frame gives images of {', '.join(images) or 'no camera'}, expected "
                f"{', '.join(self._cameras) or 'none: name cameras when opening the dataset'}"
            )
        for camera, image in images.items():
            if np.shape(image) != (*self._cameras[camera], 3):
                raise ValueError(
                    f"images of {camera} are {(*self._cameras[camera], 3)}, got "
                    f"{np.shape(image)}"
                )

    def append(self, images: Mapping[str, Image]) -> None:
        """Encode one frame's images, which `examine` has passed."""
        for camera, image in images.items():
            self._open(camera).add(np.ascontiguousarray(image))

    def finish(self, episode: int) -> Statistics:
        """Close the videos of the episode and give them their names.

        Returns:
            Statistics of the images, by feature.
        """
        statistics: Statistics = {}
        for camera, video in self._videos.items():
            key = image_key(camera)
            statistics[key] = video.finish(video_path(self._folder, key, episode))
        self._videos = {}
        return statistics

    def discard(self) -> None:
        """Forget the images of the open episode."""
        for video in self._videos.values():
            video.discard()
        self._videos = {}

    def _open(self, camera: str) -> "_Video":
        if camera not in self._videos:
            height, width = self._cameras[camera]
            path = self._folder / f"{camera}.unfinished.mp4"
            self._videos[camera] = _Video(path, height, width, self._fps)
        return self._videos[camera]


class _Video:
    """One video being written."""

    def __init__(self, path: Path, height: int, width: int, fps: float):
        import av

        self._path = path
        self._container = av.open(str(path), "w")
        self._rate = Fraction(fps).limit_denominator(1001)
        stream: Any = self._container.add_stream("libx264", rate=self._rate, options=_CODEC)
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        self._stream = stream
        self._stride = max(1, max(height, width) // _SAMPLE_PIXELS)
        self._count = 0
        self._samples: list[Shaped[np.ndarray, "..."]] = []

    def add(self, image: Image) -> None:
        import av

        if self._count % _SAMPLE_EVERY == 0:
            self._samples.append(image[:: self._stride, :: self._stride].copy())
        frame = av.VideoFrame.from_ndarray(image, format="rgb24")
        frame.pts = self._count
        frame.time_base = 1 / self._rate
        self._container.mux(self._stream.encode(frame))
        self._count += 1

    def finish(self, path: Path) -> dict[str, list]:
        self._container.mux(self._stream.encode())
        self._container.close()
        sync_file(self._path)
        self._path.replace(path)
        return image_statistics(np.stack(self._samples))

    def discard(self) -> None:
        with contextlib.suppress(Exception):  # what it says of an unfinished file is no news
            self._container.close()
        self._path.unlink(missing_ok=True)
