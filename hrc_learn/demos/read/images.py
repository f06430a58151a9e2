"""Images of a dataset as data: decoded into tensors beside the frames they belong to."""

import io
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import numpy as np
import torch
from jaxtyping import UInt8
from torch import Tensor

from hrc_learn.demos.format.dataset_folder import (
    EpisodeEntry,
    open_folder,
    open_parquet,
    read_table,
)
from hrc_learn.demos.format.metadata import INFO_PATH
from hrc_learn.demos.format.videos import Image, Segments, decode, decode_image, read_segments
from hrc_learn.demos.issue import DatasetError

Images = Mapping[str, UInt8[Tensor, "frames 3 height width"]]
"""By camera: RGB from 0 to 255. In memory the colours of a pixel lie together
(`torch.channels_last`)."""

_SKIP_SECONDS = 2.0
"""Longer gaps between images wanted are sought over: key frames are rarely further apart."""


class ImageReader:
    """Reads the images of any episode, from videos and from columns of images.

        reader = ImageReader(path)
        images = reader.read(3, size=(240, 320))["observation.images.front"]
        images.shape  # (frames of the episode, 3, 240, 320)

    Holds no file open between calls.

    Attributes:
        cameras: Features that hold images.
    """

    def __init__(self, path: str | Path):
        """
        Raises:
            DatasetError: The metadata cannot be read.
        """
        self._folder = open_folder(path)
        self._entries = {entry.index: entry for entry in self._folder.episodes}
        features = self._folder.features.items()
        self.cameras = tuple(key for key, f in features if f.dtype in ("video", "image"))
        self._segments: dict[int, Segments] = read_segments(self._folder, missing=True)

    def available(self, episode: int) -> tuple[str, ...]:
        """Cameras of which an episode has images here."""
        return tuple(key for key in self.cameras if self._is_here(episode, key))

    def length(self, episode: int) -> int:
        """Frames of an episode.

        Raises:
            DatasetError: There is no such episode.
        """
        return self._entry(episode).length

    def size(self, camera: str) -> tuple[int, int]:
        """Height and width of a camera's images as declared [px].

        Raises:
            DatasetError: None are.
        """
        feature = self._folder.features[camera]
        if len(feature.shape) != 3:
            raise DatasetError(
                f"declares images of the shape {list(feature.shape)}",
                file=INFO_PATH,
                key=camera,
            )
        # Channels come first or last.
        first = feature.shape[0] in (1, 3, 4) and feature.shape[2] not in (1, 3, 4)
        height, width = feature.shape[1:] if first else feature.shape[:2]
        return int(height), int(width)

    def _is_here(self, episode: int, key: str) -> bool:
        if self._folder.features[key].dtype == "image":
            return True
        segment = self._segments.get(episode, {}).get(key)
        return segment is not None and segment.file.is_file()

    def read(
        self,
        episode: int,
        cameras: Sequence[str] | None = None,
        frames: Sequence[int] | None = None,
        size: tuple[int, int] | None = None,
    ) -> Images:
        """Images of one episode, those of several cameras decoded at once.

        Args:
            episode: Its index.
            cameras: Features wanted; None: all.
            frames: Frames of the episode wanted, in any order; None: all.
            size: Height and width to scale to [px]; None: as they are.

        Raises:
            DatasetError: There is no such episode, camera or frame; a video is missing, is
                damaged, or lacks an image of one of these frames.
        """
        keys = self.cameras if cameras is None else tuple(cameras)
        entry = self._entry(episode)
        wanted = range(entry.length) if frames is None else frames
        if not keys or not len(wanted):
            return {}
        with ThreadPoolExecutor(len(keys)) as pool:  # PyAV decodes without the interpreter
            done = pool.map(lambda key: self._read_camera(entry, key, wanted, size), keys)
            return dict(zip(keys, done, strict=True))

    def _read_camera(
        self,
        entry: EpisodeEntry,
        camera: str,
        wanted: Sequence[int],
        size: tuple[int, int] | None,
    ) -> UInt8[Tensor, "frames 3 height width"]:
        ordered = sorted({*wanted})
        place = {frame: number for number, frame in enumerate(ordered)}
        images: np.ndarray | None = None
        for frame, image in self.stream(entry.index, camera, ordered, size):
            if images is None:
                images = np.empty((len(ordered), *image.shape), np.uint8)
            images[place[frame]] = image
        assert images is not None
        if list(wanted) != ordered:
            images = images[[place[frame] for frame in wanted]]
        return torch.from_numpy(images).permute(0, 3, 1, 2)

    def stream(
        self,
        episode: int,
        camera: str,
        frames: Sequence[int] | None = None,
        size: tuple[int, int] | None = None,
    ) -> Iterator[tuple[int, Image]]:
        """Frames with their images (height, width, 3), one after another.

        Arguments as in `read`; the frames must ascend.

        Raises:
            DatasetError: As in `read`.
        """
        entry = self._entry(episode)
        wanted = range(entry.length) if frames is None else frames
        if camera not in self.cameras:
            raise DatasetError(
                f"there is no camera {camera!r}; there are {', '.join(self.cameras) or 'none'}",
                file=self._folder.root,
                key=camera,
            )
        if len(wanted) and not (wanted[0] >= 0 and wanted[-1] < entry.length):
            raise DatasetError(
                f"has no frames {wanted[0]} to {wanted[-1]}: it has {entry.length}",
                **entry.location,
            )
        if self._folder.features[camera].dtype == "image":
            yield from self._of_column(entry, camera, wanted, size)
        else:
            yield from self._of_video(entry, camera, wanted, size)

    def _entry(self, episode: int) -> EpisodeEntry:
        if episode not in self._entries:
            raise DatasetError(
                f"there is no such episode; the dataset has {len(self._entries)}",
                file=self._folder.root,
                episode=episode,
            )
        return self._entries[episode]

    def _of_video(
        self,
        entry: EpisodeEntry,
        camera: str,
        wanted: Sequence[int],
        size: tuple[int, int] | None,
    ) -> Iterator[tuple[int, Image]]:
        segment, fps = self._segments.get(entry.index, {}).get(camera), self._folder.fps
        place = {"episode": entry.index, "key": camera}
        if segment is None or not segment.file.is_file():
            file = None if segment is None else segment.file
            raise DatasetError("its video is not here", file=file, **place)
        for run in _runs(wanted, max(1, round(_SKIP_SECONDS * fps))):
            first, last = run[0], run[-1]
            part = replace(
                segment,
                start=segment.start + first / fps,
                stop=segment.start + (last + 1) / fps,
            )
            missing, last_seen = iter(run), -1
            expected = next(missing)
            for offset, image in decode(part, fps, size, skip=_unwanted(run)):
                frame = first + offset
                if frame <= last_seen:
                    continue  # a second image for the same frame
                last_seen = frame
                if frame != expected:
                    break
                yield frame, image
                expected = next(missing, None)
                if expected is None:
                    break
            if expected is not None:
                raise DatasetError(
                    f"holds no image of frame {expected}: the recording was broken off, or "
                    f"the video is that of another episode",
                    file=segment.file,
                    frame=expected,
                    **place,
                )

    def _of_column(
        self,
        entry: EpisodeEntry,
        camera: str,
        wanted: Sequence[int],
        size: tuple[int, int] | None,
    ) -> Iterator[tuple[int, Image]]:
        parquet = open_parquet(self._folder.root, entry.file, entry.index)
        rows = slice(entry.start + wanted[0], entry.start + wanted[-1] + 1)
        column = read_table(parquet, entry.file, [camera], rows).column(camera)
        for frame in wanted:
            try:
                content = column[frame - wanted[0]].as_py()["bytes"]
                yield frame, decode_image(content, size)
            except (DatasetError, KeyError, TypeError) as error:
                raise DatasetError(
                    "holds an image that cannot be decoded",
                    **entry.location,
                    frame=frame,
                    key=camera,
                ) from error


def _runs(frames: Sequence[int], gap: int) -> Iterator[Sequence[int]]:
    """Ascending frames, parted where more than `gap` lie between two."""
    numbers = np.asarray(frames)
    for run in np.split(numbers, np.flatnonzero(np.diff(numbers) > gap) + 1):
        if len(run):
            yield run.tolist()


def _unwanted(run: Sequence[int]) -> Callable[[int], bool] | None:
    """Says of images of a run, counted from its first, which need not be converted."""
    if len(run) == run[-1] - run[0] + 1:
        return None
    wanted = {frame - run[0] for frame in run}
    return lambda frame: frame not in wanted


def load_images(
    path: str | Path,
    episode: int,
    cameras: Sequence[str] | None = None,
    frames: Sequence[int] | None = None,
    size: tuple[int, int] | None = None,
) -> Images:
    """Images of one episode, by camera; arguments and errors as in `ImageReader.read`."""
    return ImageReader(path).read(episode, cameras, frames, size)


def jpeg(image: Image, quality: int = 4) -> bytes:
    """An image as a JPEG file.

    Args:
        image: RGB.
        quality: Quantiser of FFmpeg's encoder, 2 (best) to 31.
    """
    import av

    height, width = image.shape[:2]
    frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")
    frame = frame.reformat(format="yuvj420p")
    frame.pts = 0
    stream = io.BytesIO()
    with av.open(stream, "w", format="mjpeg") as container:
        encoder = container.add_stream("mjpeg", rate=Fraction(1))
        encoder.width, encoder.height, encoder.pix_fmt = width, height, "yuvj420p"  # type: ignore[attr-defined]
        encoder.codec_context.qmin = encoder.codec_context.qmax = quality  # type: ignore[attr-defined]
        container.mux(encoder.encode(frame))  # type: ignore[attr-defined]
        container.mux(encoder.encode(None))  # type: ignore[attr-defined]
    return stream.getvalue()
