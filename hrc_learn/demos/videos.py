"""Videos of a dataset: located, decoded, and encoded during a recording.

A recording encodes one video per episode and camera as the images arrive, because raw images
would soon fill the memory. LeRobot writes many episodes into one video file; such a file would
be lost if the recording were interrupted.
"""

import contextlib
import io
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64, Shaped, UInt8

from hrc_learn.demos.issues import DatasetError
from hrc_learn.demos.read.dataset_files import path_in, read_rows
from hrc_learn.demos.read.dataset_folder import DatasetFolder, episode_lists, places_v2
from hrc_learn.demos.read.metadata import Statistics, image_statistics
from hrc_learn.store import sync_file

Image = UInt8[np.ndarray, "_height _width 3"]

_PLACE = ("chunk_index", "file_index", "from_timestamp", "to_timestamp")
"""Columns of the list of episodes for each video feature."""
_SAMPLE_PIXELS = 150
"""Smallest length to which the longer side of an image is reduced for statistics [px]. LeRobot
reduces images similarly."""
_SKIP_SECONDS = 2.0
"""Gap between wanted images above which the decoder jumps to a key frame [s]. Key frames are
rarely farther apart."""


@dataclass(frozen=True, kw_only=True)
class VideoSegment:
    """Images of one camera during one episode."""

    file: Path
    start: float
    """Time of the first image in the file [s]."""
    stop: float
    """End of the segment [s]."""


Segments = Mapping[str, VideoSegment]
"""Video feature -> segment of one episode."""


def image_key(camera: str) -> str:
    """Feature that holds a camera's images."""
    return f"observation.images.{camera}"


def video_keys(folder: DatasetFolder) -> list[str]:
    """Features stored as videos."""
    return [key for key, feature in folder.features.items() if feature.dtype == "video"]


def read_segments(folder: DatasetFolder, missing: bool = False) -> dict[int, Segments]:
    """Video segments by episode index.

    Args:
        folder: The dataset.
        missing: Include segments whose file does not exist.

    Raises:
        DatasetError: The metadata name no file, a file outside the dataset, or no times.
    """
    found: dict[int, dict[str, VideoSegment]] = {entry.index: {} for entry in folder.episodes}
    for episode, key, segment in (_segments_v3 if folder.is_v3 else _segments_v2)(folder):
        if episode in found and (missing or segment.file.is_file()):
            found[episode][key] = segment
    return {**found}


def _segments_v3(folder: DatasetFolder) -> Iterator[tuple[int, str, VideoSegment]]:
    """Episode index, video feature and segment, from the list of episodes."""
    keys = video_keys(folder)
    columns = [f"videos/{key}/{name}" for key in keys for name in _PLACE]
    for file in episode_lists(folder.root) if keys else ():
        for row in read_rows(folder.root, file, ("episode_index",), columns):
            for key in keys:
                values: dict[str, Any] = {n: row.get(f"videos/{key}/{n}") for n in _PLACE}
                if values["chunk_index"] is None:
                    continue
                for name, value in values.items():
                    if not isinstance(value, int | float):
                        text = f"must be a number, got {value!r}: copy the file again"
                        place = {"episode": row["episode_index"], "key": f"videos/{key}/{name}"}
                        raise DatasetError(text, file=file, **place)
                chunk, number, *times = values.values()
                segment = _segment(folder, key, times, chunk_index=chunk, file_index=number)
                yield row["episode_index"], key, segment


def _segments_v2(folder: DatasetFolder) -> Iterator[tuple[int, str, VideoSegment]]:
    """As `_segments_v3`, for versions 2.0 and 2.1 with one file per episode and camera."""
    size = int(folder.info.get("chunks_size", 1000))
    for entry in folder.episodes:
        places = places_v2(entry.index, size)
        for key in video_keys(folder):
            times = (0.0, entry.length / folder.fps)
            yield entry.index, key, _segment(folder, key, times, **places)


def _segment(
    folder: DatasetFolder, key: str, times: Sequence[float], **places: int
) -> VideoSegment:
    template = folder.info.get("video_path")
    file = path_in(folder.root, template, "video_path", video_key=key, **places)
    return VideoSegment(file=folder.root / file, start=float(times[0]), stop=float(times[1]))


@dataclass(frozen=True)
class CameraImages:
    """Images of a camera during an episode."""

    codec: str
    """Codec: jpeg, av1, h264, hevc or vp9."""
    time: Float64[np.ndarray, " images"]
    """Times since the first image [s]."""
    samples: tuple[bytes, ...]
    """JPEG files, or samples of a video in decoding order."""


_CODECS = {"av1": "av1", "h264": "h264_mp4toannexb", "hevc": "hevc_mp4toannexb", "vp9": "vp9"}
"""Codec -> filter that converts its samples to Annex B; the codec itself if none is needed."""


def encoded_samples(segment: VideoSegment) -> CameraImages | None:
    """The images of a segment as they are encoded, for players that decode on demand.

    Returns:
        The samples; None if players cannot decode them: the codec is not in `_CODECS`, or the
        display order of the images differs from their decoding order.

    Raises:
        DatasetError: The video cannot be read.
    """
    import av

    times: list[float] = []
    samples: list[bytes] = []
    try:
        with av.open(str(segment.file)) as container:
            stream = container.streams.video[0]
            codec = stream.codec_context.name.replace("libdav1d", "av1")
            if codec not in _CODECS or stream.time_base is None:
                return None
            whole = None
            if _CODECS[codec] != codec:
                whole = av.BitStreamFilterContext(_CODECS[codec], stream)
            # Seek the key frame that begins the episode; 1 ms is added as times are rounded.
            container.seek(int((segment.start + 1e-3) / stream.time_base), stream=stream)
            for packet in container.demux(stream):
                if packet.pts is None:
                    continue
                time = float(packet.pts * stream.time_base)
                if time > segment.stop - 1e-3:
                    break
                if times and time - segment.start < times[-1]:
                    return None
                times.append(time - segment.start)
                samples += map(bytes, whole.filter(packet) if whole else (packet,))
    except (av.FFmpegError, OSError, IndexError) as error:
        raise DatasetError(f"cannot be read as a video: {error}", file=segment.file) from error
    if len(times) != len(samples):
        return None
    return CameraImages(codec, np.array(times), tuple(samples))


def decode(
    segment: VideoSegment,
    fps: float,
    size: tuple[int, int] | None = None,
    frames: Sequence[int] | None = None,
) -> Iterator[tuple[int, Image]]:
    """Frame numbers of the episode with their RGB images, in order.

    Args:
        segment: Part of a video.
        fps: Frame rate of the dataset [1/s].
        size: Height and width to scale to [px]; None keeps the size.
        frames: Frames wanted, ascending; None for all. Frames without an image are left out.

    Raises:
        DatasetError: The file is no video that can be decoded.
    """
    import av

    if frames is None:
        frames = range(round((segment.stop - segment.start) * fps))
    numbers = np.asarray(frames, dtype=int)
    gaps = np.flatnonzero(np.diff(numbers) > max(1, round(_SKIP_SECONDS * fps)))
    try:
        with av.open(str(segment.file)) as container:
            # By default, all threads of PyAV decode the same image. A thread that decodes ahead
            # may log while the container closes. The thread and the closing would then wait for
            # each other, because of Python's lock.
            stream = container.streams.video[0]
            for number, run in enumerate(np.split(numbers, gaps + 1)):
                wanted, start = {*run.tolist()}, segment.start + run[0] / fps
                if (start > 0 or number) and stream.time_base is not None:
                    # Seeks the last key frame before the start; decoding begins there.
                    container.seek(int(start / stream.time_base), stream=stream)
                for image in container.decode(stream):
                    frame = round((float(image.time or 0.0) - segment.start) * fps)
                    if frame in wanted:  # a second image of a frame is skipped
                        wanted.remove(frame)
                        yield frame, rgb_image(image, size)
                    if not wanted or frame > run[-1]:
                        break
    except (av.FFmpegError, IndexError) as error:
        text = f"cannot be decoded ({error}): the recording or the copy is incomplete"
        raise DatasetError(text, file=segment.file) from error


def image_at(segment: VideoSegment, frame: int, fps: float) -> Image:
    """RGB image of one frame of an episode, decoded from the last key frame before it.

    Raises:
        DatasetError: The file is no video that can be decoded, or ends before the frame.
    """
    found = next(decode(segment, fps, frames=[frame]), None)
    if found is None:
        raise DatasetError(f"ends before frame {frame} of the episode", file=segment.file)
    return found[1]


def decode_image(content: bytes, size: tuple[int, int] | None = None) -> Image:
    """RGB image from the bytes of an image file.

    Args:
        content: The file.
        size: Height and width to scale to [px]; None keeps the size.

    Raises:
        DatasetError: The bytes are no image.
    """
    import av

    try:
        with contextlib.closing(av.open(io.BytesIO(content or b""), "r")) as container:
            return rgb_image(next(container.decode(video=0)), size)
    except (av.FFmpegError, IndexError, StopIteration) as error:
        raise DatasetError(f"holds an image that cannot be decoded ({error})") from error


def rgb_image(image: Any, size: tuple[int, int] | None = None) -> Image:
    """RGB image of a frame of PyAV.

    Args:
        image: The frame, an `av.VideoFrame`.
        size: Height and width to scale to [px]; None keeps the size.
    """
    from av.video.reformatter import VideoReformatter

    height, width = size or (image.height, image.width)
    # PyAV caches a reformatter with threads. A process that is forked later, such as a data
    # loader, lacks these threads and would wait for them forever. So make a new reformatter.
    return VideoReformatter().reformat(image, width, height, "rgb24").to_ndarray()


def subsampled(image: Image) -> Image:
    """The image reduced by a whole factor, to no less than 150 pixels along its longer side."""
    stride = max(1, max(image.shape[:2]) // _SAMPLE_PIXELS)
    return image[::stride, ::stride]


_CODEC = {"preset": "ultrafast", "crf": "20", "g": "2"}
"""Encoder options. They favour speed, because the recording process itself encodes: 9 ms per
1440x1080 frame instead of 25 ms, for twice the size. Every second frame is a key frame, as in
LeRobot, because policies read single frames."""
_SAMPLE_EVERY = 5
"""Interval between images that enter the statistics [frames], as in LeRobot."""


def video_path(folder: Path, key: str, episode: int) -> Path:
    """Path of a video in the folder of a recording."""
    return folder / f"episode_{episode:06d}.{key}.mp4"


def video_features(cameras: Mapping[str, tuple[int, int]]) -> dict[str, dict]:
    """Features of cameras (name -> height, width) as declared in `meta/info.json`.

    LeRobot reads codec and rate from the files.
    """
    common = {"dtype": "video", "names": ["height", "width", "channels"]}
    return {image_key(name): common | {"shape": [*size, 3]} for name, size in cameras.items()}


class CameraRecorder:
    """Encoder of the images of the open episode."""

    def __init__(self, cameras: Mapping[str, tuple[int, int]], fps: float, folder: Path):
        """
        Args:
            cameras: Camera -> height and width of its images [px].
            fps: Frame rate [1/s].
            folder: Folder of the recording.

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

    def append(self, images: Mapping[str, Image]) -> None:
        """Encode one frame's images.

        Raises:
            ValueError: A camera is missing or unknown, or its image is of the wrong size or
                type; no image of the frame is then encoded.
        """
        if images.keys() != self._cameras.keys():
            given = ", ".join(images) or "no camera"
            known = ", ".join(self._cameras) or "none: name cameras when opening the dataset"
            raise ValueError(f"a frame gives images of {given}, expected {known}")
        for camera, image in images.items():
            expected = (*self._cameras[camera], 3)
            if np.shape(image) != expected:
                raise ValueError(f"images of {camera} are {expected}, got {np.shape(image)}")
            if (dtype := np.asarray(image).dtype) != np.uint8:
                raise ValueError(f"images of {camera} must be uint8 (0 to 255), got {dtype}")
        for camera, image in images.items():
            if camera not in self._videos:
                path = self._folder / f"{camera}.unfinished.mp4"
                self._videos[camera] = _Video(path, *self._cameras[camera], self._fps)
            self._videos[camera].add(np.ascontiguousarray(image))

    def finish(self, episode: int) -> Statistics:
        """Close the videos of the episode and rename them to their final names.

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
        """Delete the videos of the open episode."""
        for video in self._videos.values():
            video.discard()
        self._videos = {}


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
            self._samples.append(subsampled(image).copy())
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
        with contextlib.suppress(Exception):  # closing an unfinished file may fail
            self._container.close()
        self._path.unlink(missing_ok=True)
