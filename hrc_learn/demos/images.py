"""Images of a dataset, decoded into tensors: one image for each frame of an episode."""

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import UInt8
from torch import Tensor

from hrc_learn.demos import videos
from hrc_learn.demos.demonstration import Demonstration
from hrc_learn.demos.issues import DatasetError
from hrc_learn.demos.read.dataset_files import INFO_PATH, open_parquet, read_table
from hrc_learn.demos.read.dataset_folder import DatasetFolder, EpisodeEntry, open_folder
from hrc_learn.demos.videos import CameraImages, Image, Segments, VideoSegment

Images = Mapping[str, UInt8[Tensor, "frames 3 height width"]]
"""Camera -> RGB images, 0 to 255. In memory, the colours of a pixel are adjacent
(`torch.channels_last`)."""

_THUMBNAIL_RATE = 5.0
"""Thumbnails per second: between two of them, a hand-guided arm moves a few centimetres."""
_JPEG_QUANTISER = 4
"""Quality of JPEG files, 2 (best) to 31."""
_THUMBNAIL_HEIGHT = 240
"""Largest height of a thumbnail [px]."""


class ImageReader:
    """Reader of the images of any episode, from videos or from columns of images.

        reader = ImageReader(path)
        images = reader.read(3, size=(240, 320))["observation.images.front"]
        images.shape  # (frames of the episode, 3, 240, 320)

    No file stays open between calls.

    Attributes:
        cameras: Features that hold images.
    """

    def __init__(self, path: str | Path | DatasetFolder):
        """
        Args:
            path: Folder of the dataset, or the result of `open_folder`.

        Raises:
            DatasetError: The metadata cannot be read.
        """
        self._folder = path if isinstance(path, DatasetFolder) else open_folder(path)
        self._entries = {entry.index: entry for entry in self._folder.episodes}
        self.cameras = tuple(k for k, f in self._folder.features.items() if f.is_picture)
        self._segments: dict[int, Segments] = videos.read_segments(self._folder, missing=True)

    def available(self, episode: int) -> tuple[str, ...]:
        """Cameras that have images of an episode."""
        segments, features = self._segments.get(episode, {}), self._folder.features
        there = {key for key, segment in segments.items() if segment.file.is_file()}
        return tuple(k for k in self.cameras if k in there or features[k].dtype == "image")

    def segment(self, episode: int, camera: str) -> VideoSegment | None:
        """Part of a video that shows an episode; None for images in columns."""
        return self._segments.get(episode, {}).get(camera)

    def size(self, camera: str) -> tuple[int, int]:
        """Declared height and width of a camera's images [px].

        Raises:
            DatasetError: No height and width are declared.
        """
        feature = self._folder.features[camera]
        if len(feature.shape) != 3:
            text = f"declares images of the shape {list(feature.shape)}"
            raise DatasetError(text, file=INFO_PATH, key=camera)
        # The shape is (channels, height, width) or (height, width, channels).
        first = feature.shape[0] in (1, 3, 4) and feature.shape[2] not in (1, 3, 4)
        height, width = feature.shape[1:] if first else feature.shape[:2]
        return int(height), int(width)

    def read(
        self,
        episode: int,
        cameras: Sequence[str] | None = None,
        frames: Sequence[int] | None = None,
        size: tuple[int, int] | None = None,
    ) -> Images:
        """Images of one episode; several cameras are decoded in parallel.

        Args:
            episode: Episode index.
            cameras: Features wanted; None for all.
            frames: Frames of the episode wanted, in any order; None for all.
            size: Height and width to scale to [px]; None keeps the size.

        Raises:
            DatasetError: There is no such episode, camera or frame; a video is missing, is
                damaged, or lacks an image of one of these frames.
        """
        keys = self.cameras if cameras is None else tuple(cameras)
        entry = self.entry(episode)
        wanted = range(entry.length) if frames is None else frames
        if not keys or not len(wanted):
            return {}
        with ThreadPoolExecutor(len(keys)) as pool:  # PyAV releases the interpreter lock
            done = pool.map(lambda key: self._read_camera(episode, key, wanted, size), keys)
            return dict(zip(keys, done, strict=True))

    def _read_camera(
        self, episode: int, camera: str, wanted: Sequence[int], size: tuple[int, int] | None
    ) -> UInt8[Tensor, "frames 3 height width"]:
        ordered = sorted({*wanted})
        images = np.empty(0)
        for number, (_, image) in enumerate(self.stream(episode, camera, ordered, size)):
            if not number:  # now the size is known
                images = np.empty((len(ordered), *image.shape), np.uint8)
            images[number] = image
        if list(wanted) != ordered:
            images = images[np.searchsorted(ordered, wanted)]
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
        entry = self.entry(episode)
        wanted = range(entry.length) if frames is None else frames
        if camera not in self.cameras:
            text = f"there is no such camera; cameras: {', '.join(self.cameras) or 'none'}"
            raise DatasetError(text, file=self._folder.root, key=camera)
        if not len(wanted):
            return
        if not (wanted[0] >= 0 and wanted[-1] < entry.length):
            text = f"has no frames {wanted[0]} to {wanted[-1]}: it has {entry.length}"
            raise entry.error(text)
        if self._folder.features[camera].dtype == "image":
            yield from self._from_column(entry, camera, wanted, size)
            return
        segment, place = self.segment(episode, camera), {"episode": episode, "key": camera}
        if segment is None or not segment.file.is_file():
            file = None if segment is None else segment.file
            raise DatasetError("its video is missing", file=file, **place)
        missing = dict.fromkeys(wanted)
        for frame, image in videos.decode(segment, self._folder.fps, size, wanted):
            del missing[frame]
            yield frame, image
        for frame in missing:
            text = (
                f"holds no image of frame {frame}: the recording was interrupted, or the "
                f"video is that of another episode"
            )
            raise DatasetError(text, file=segment.file, frame=frame, **place)

    def entry(self, episode: int) -> EpisodeEntry:
        """An episode of the dataset.

        Raises:
            DatasetError: There is no such episode.
        """
        if episode not in self._entries:
            text = f"there is no such episode; the dataset has {len(self._entries)}"
            raise DatasetError(text, file=self._folder.root, episode=episode)
        return self._entries[episode]

    def _from_column(
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
                yield frame, videos.decode_image(content, size)
            except (DatasetError, KeyError, TypeError) as error:
                text = "holds an image that cannot be decoded"
                raise entry.error(text, frame=frame, key=camera) from error


def load_images(
    path: str | Path,
    episode: int,
    cameras: Sequence[str] | None = None,
    frames: Sequence[int] | None = None,
    size: tuple[int, int] | None = None,
) -> Images:
    """Images of one episode, by camera; arguments and errors as in `ImageReader.read`."""
    return ImageReader(path).read(episode, cameras, frames, size)


def camera_images(
    reader: ImageReader, demo: Demonstration
) -> Iterator[tuple[str, CameraImages | DatasetError]]:
    """Each camera of an episode with its images, or with the error of its video.

    Videos stay encoded if viewers can decode them on demand; other images become thumbnails.
    """
    for camera in reader.available(demo.episode):
        # Keep the whole rest of the key: left.rgb and right.rgb are two cameras.
        name = camera.removeprefix("observation.images.")
        segment = reader.segment(demo.episode, camera)
        try:
            encoded = None if segment is None else videos.encoded_samples(segment)
            if encoded is not None:  # images are 1/fps apart, frames have measured stamps
                nominal = (
                    np.linspace(0, reader.entry(demo.episode).length - 1, len(demo)) / demo.fps
                )
                late = np.interp(encoded.time, nominal, demo.time - nominal)
                encoded = replace(encoded, time=encoded.time + late)
            yield name, encoded or thumbnails(reader, demo, camera)
        except DatasetError as error:
            yield name, error


def thumbnails(
    reader: ImageReader, demo: Demonstration, camera: str, most: int = 200
) -> CameraImages:
    """Small images of an episode: enough to see the motion.

    Args:
        reader: Reader of the dataset.
        demo: Demonstration with all frames of its episode, or with an even selection of them.
        camera: Feature that holds the images.
        most: Largest number of images: 200 take about 2 MB.

    Raises:
        DatasetError: The images cannot be read.
    """
    last = reader.entry(demo.episode).length - 1
    # The images are evenly spaced; an episode has at most one per frame.
    count = min(last + 1, most, 1 + int(demo.duration * _THUMBNAIL_RATE))
    frames = sorted({*np.linspace(0, last, count).astype(int).tolist()})
    found = reader.stream(demo.episode, camera, frames, thumbnail_size(*reader.size(camera)))
    time = np.interp(frames, np.linspace(0, last, len(demo)), demo.time)
    return CameraImages("jpeg", time, tuple(jpeg(image) for _, image in found))


def thumbnail_size(
    height: int, width: int, tallest: int = _THUMBNAIL_HEIGHT
) -> tuple[int, int]:
    """Height and width of a thumbnail [px]; both are even, as JPEG halves the chroma planes."""
    scale = min(1.0, tallest / height) / 2
    return 2 * max(1, round(scale * height)), 2 * max(1, round(scale * width))


def jpeg(image: Image) -> bytes:
    """The RGB image as a JPEG file."""
    import av

    frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")
    encoder: Any = av.CodecContext.create("mjpeg", "w")
    encoder.height, encoder.width = image.shape[:2]
    encoder.pix_fmt, encoder.time_base = "yuvj420p", Fraction(1)
    encoder.qmin = encoder.qmax = _JPEG_QUANTISER
    packets = [*encoder.encode(frame.reformat(format="yuvj420p")), *encoder.encode(None)]
    return b"".join(map(bytes, packets))
