"""The images of a dataset, which are kept as videos: found, decoded, encoded, placed.

A recording encodes one video an episode and camera as frames come. Raw images of a few seconds
would not fit into memory, and a video that LeRobot keeps for many episodes together would be
lost with the recording; a file an episode is neither.
"""

import contextlib
import io
import shutil
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Shaped, UInt8

from hrc_learn.demos.format.dataset_folder import (
    DatasetFolder,
    EpisodeEntry,
    generation,
    path_in,
    read_rows,
)
from hrc_learn.demos.format.metadata import (
    CHUNK_SIZE,
    VIDEO_PATH,
    Statistics,
    image_statistics,
    place,
)
from hrc_learn.demos.issue import DatasetError
from hrc_learn.store import sync_file

Image = UInt8[np.ndarray, "_height _width 3"]


@dataclass(frozen=True, kw_only=True)
class VideoSegment:
    """The images of one camera during one episode."""

    file: Path
    start: float
    """Where they begin in the file [s]."""
    stop: float
    """Where they end [s]."""


Segments = Mapping[str, VideoSegment]
"""Video feature -> its images during one episode."""


def video_keys(folder: DatasetFolder) -> list[str]:
    """Features that are kept as videos."""
    return [key for key, feature in folder.features.items() if feature.dtype == "video"]


def read_segments(folder: DatasetFolder, missing: bool = False) -> dict[int, Segments]:
    """Where the images of each episode lie.

    Args:
        folder: The dataset.
        missing: Also those whose file is not there.

    Raises:
        DatasetError: The metadata lead to no file, or out of the dataset, or do not say where
            in a file the images lie.
    """
    keys = video_keys(folder)
    if not keys:
        return {}
    places = _places_v3(folder, keys) if generation(folder.version) == 3 else {}
    segments = {}
    for entry in folder.episodes:
        found = places.get(entry.index) or _of_own_file(folder, entry, keys)
        segments[entry.index] = {k: s for k, s in found.items() if missing or s.file.is_file()}
    return segments


_PLACE = ("chunk_index", "file_index", "from_timestamp", "to_timestamp")
"""What the list of episodes says of an episode's images in each video feature."""


def _places_v3(folder: DatasetFolder, keys: list[str]) -> dict[int, Segments]:
    columns = [f"videos/{key}/{name}" for key in keys for name in _PLACE]
    places: dict[int, Segments] = {}
    for path in sorted((folder.root / "meta/episodes").glob("*/*.parquet")):
        file = str(path.relative_to(folder.root))
        for row in read_rows(folder.root, file, ("episode_index",), columns):
            places[row["episode_index"]] = {
                key: _segment(folder, file, key, row)
                for key in keys
                if row.get(f"videos/{key}/chunk_index") is not None
            }
    return places


def _segment(
    folder: DatasetFolder, file: str, key: str, row: Mapping[str, Any]
) -> VideoSegment:
    values: dict[str, Any] = {name: row.get(f"videos/{key}/{name}") for name in _PLACE}
    for name, value in values.items():
        if not isinstance(value, int | float):
            raise DatasetError(
                f"must be a number, got {value!r}: copy the list of episodes again",
                file=file,
                episode=row["episode_index"],
                key=f"videos/{key}/{name}",
            )
    video = path_in(
        folder.root,
        folder.info.get("video_path"),
        "video_path",
        video_key=key,
        chunk_index=values["chunk_index"],
        file_index=values["file_index"],
    )
    return VideoSegment(
        file=folder.root / video,
        start=float(values["from_timestamp"]),
        stop=float(values["to_timestamp"]),
    )


def _of_own_file(folder: DatasetFolder, entry: EpisodeEntry, keys: list[str]) -> Segments:
    if generation(folder.version) == 3:
        return {}
    template = folder.info.get("video_path")
    chunk = entry.index // int(folder.info.get("chunks_size", 1000))
    return {
        key: VideoSegment(
            file=folder.root
            / path_in(
                folder.root,
                template,
                "video_path",
                video_key=key,
                episode_chunk=chunk,
                episode_index=entry.index,
            ),
            start=0.0,
            stop=entry.length / folder.fps,
        )
        for key in keys
    }


def decode(
    segment: VideoSegment,
    fps: float,
    size: tuple[int, int] | None = None,
    skip: Callable[[int], bool] | None = None,
) -> Iterator[tuple[int, Image]]:
    """Images (RGB) with the frames of the episode they belong to, in order.

    Args:
        segment: Where they lie.
        fps: Frame rate of the dataset [1/s].
        size: Height and width to scale to [px]; None: as they are.
        skip: Of which frames no image is wanted; None: of none.

    Raises:
        DatasetError: The file is no video that can be decoded.
    """
    import av

    half_period = 0.5 / fps
    scaled: dict[str, Any] = {} if size is None else {"height": size[0], "width": size[1]}
    try:
        with av.open(str(segment.file)) as container:
            stream = container.streams.video[0]
            stream.thread_type = "AUTO"
            if segment.start > 0 and stream.time_base is not None:
                # To the key frame before; what lies between is decoded and left out.
                container.seek(int(segment.start / stream.time_base), stream=stream)
            for image in container.decode(stream):
                time = float(image.time or 0.0)
                if time > segment.stop - half_period:
                    return
                if time <= segment.start - half_period:
                    continue
                frame = round((time - segment.start) * fps)
                if skip is None or not skip(frame):
                    yield frame, image.to_ndarray(format="rgb24", **scaled)
    except (av.FFmpegError, IndexError) as error:
        raise DatasetError(
            f"cannot be decoded ({error}): the recording was broken off, or the copy is "
            f"incomplete",
            file=segment.file,
        ) from error


def image_at(segment: VideoSegment, frame: int, fps: float) -> Image:
    """One image (RGB) of an episode, without decoding those long before it.

    Raises:
        DatasetError: The file is no video that can be decoded, or ends before.
    """
    at = segment.start + frame / fps
    found = next(decode(replace(segment, start=at, stop=at + 1 / fps), fps), None)
    if found is None:
        raise DatasetError(f"ends before frame {frame} of the episode", file=segment.file)
    return found[1]


def decode_image(content: bytes, size: tuple[int, int] | None = None) -> Image:
    """An image (RGB) from the bytes of its file.

    Args:
        content: Of the file.
        size: Height and width to scale to [px]; None: as it is.

    Raises:
        DatasetError: They are no image.
    """
    import av

    scaled: dict[str, Any] = {} if size is None else {"height": size[0], "width": size[1]}
    try:
        container = av.open(io.BytesIO(content or b""), "r")
        with container:
            image = next(container.decode(video=0)).to_ndarray(format="rgb24", **scaled)
    except (av.FFmpegError, IndexError, StopIteration) as error:
        raise DatasetError(f"holds an image that cannot be decoded ({error})") from error
    return image


def sampled_pixels(image: Image) -> Image:
    """Some of its pixels, about 150 along its longer side."""
    stride = max(1, max(image.shape[:2]) // _SAMPLE_PIXELS)
    return image[::stride, ::stride]


# Videos of a recording.

_CODEC = {"preset": "ultrafast", "crf": "20", "g": "2"}
"""Encoded in the recording's own process: 9 ms a 1440x1080 frame instead of 25, for twice the
size. A key frame at every second one, as LeRobot has it: policies read single frames."""
# Statistics are those of some images, brought down to about 150 pixels, as LeRobot takes them.
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
            ValueError: A camera is missing or unknown, or its image is of the wrong size or
                type.
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
            if (dtype := np.asarray(image).dtype) != np.uint8:
                raise ValueError(f"images of {camera} must be uint8 (0 to 255), got {dtype}")

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
        self._count = 0
        self._samples: list[Shaped[np.ndarray, "..."]] = []

    def add(self, image: Image) -> None:
        import av

        if self._count % _SAMPLE_EVERY == 0:
            self._samples.append(sampled_pixels(image).copy())
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


# Places of videos in a new dataset.


class VideoPlacement:
    """Files of videos as they are placed in a new dataset: each once, whoever shares it."""

    def __init__(
        self, root: Path, taken: Mapping[str, int] | None = None, *, share: bool = True
    ):
        """
        Args:
            root: The new dataset.
            taken: Files that each camera already has there.
            share: Give files a second name; otherwise they are copied.
        """
        self._root = root
        self._put = link if share else _copy
        self._count = dict(taken or {})
        self._placed: dict[tuple[str, Path], int] = {}

    def columns(self, key: str, segment: VideoSegment) -> dict[str, int | float]:
        """Place the file if it is not yet, and say where, in the terms of the episode list."""
        number = self._place(key, segment.file)
        return {
            f"videos/{key}/chunk_index": number // CHUNK_SIZE,
            f"videos/{key}/file_index": number % CHUNK_SIZE,
            f"videos/{key}/from_timestamp": segment.start,
            f"videos/{key}/to_timestamp": segment.stop,
        }

    def _place(self, key: str, file: Path) -> int:
        if (key, file) not in self._placed:
            number = self._count.get(key, 0)
            self._put(file, self._root / place(VIDEO_PATH, number, video_key=key))
            self._count[key], self._placed[key, file] = number + 1, number
        return self._placed[key, file]


def _copy(source: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(source, target)


def link(source: Path, target: Path) -> None:
    """A second name for a file, not another: until the dataset stands, both must."""
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        target.hardlink_to(source)
    except OSError:  # a file system without links
        shutil.copyfile(source, target)
