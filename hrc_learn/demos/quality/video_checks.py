"""Checks of a dataset's videos: existence, integrity, length, size and some images."""

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from hrc_learn.demos.format.dataset_files import is_inside, require_file
from hrc_learn.demos.format.dataset_folder import DatasetFolder
from hrc_learn.demos.format.videos import (
    Segments,
    VideoSegment,
    image_at,
    read_segments,
    video_keys,
)
from hrc_learn.demos.issues import DatasetError, Issue, ValidationReport, warning

_MOST_FILES = 2000
"""Files whose packets are counted; reading a terabyte of videos takes an hour."""
_MOST_DECODED = 60
"""Files of which images are decoded."""
_MOST_EPISODES = 8
"""Episodes of one file of which images are decoded."""


@dataclass(frozen=True, kw_only=True)
class _VideoFile:
    """One file of a camera and the episodes in it."""

    folder: DatasetFolder
    key: str
    path: Path
    shown: list[tuple[int, VideoSegment]]
    """Episode index and segment, in the order of their start."""

    @property
    def name(self) -> str:
        """Path relative to the dataset."""
        return str(self.path.relative_to(self.folder.root))

    @property
    def lengths(self) -> dict[int, int]:
        """Number of frames by episode index."""
        return {entry.index: entry.length for entry in self.folder.episodes}


@dataclass(frozen=True, kw_only=True)
class _Stream:
    """Properties of a video stream, without decoding it."""

    images: int
    rate: float
    """Frame rate [1/s], 0 if unknown."""
    height: int
    width: int

    @property
    def duration(self) -> float:
        """Duration of all images [s]."""
        return self.images / self.rate if self.rate else 0.0


def check_videos(folder: DatasetFolder, report: ValidationReport) -> None:
    """Check the videos of every camera."""
    keys = video_keys(folder)
    if not keys:
        return
    segments = read_segments(folder, missing=True)
    files = [s.file for segment in segments.values() for s in segment.values()]
    if not any(file.exists() for file in files):
        report.run("videos exist", _absent, keys)
        return
    for key in keys:
        report.run("videos listed", _unlisted, key, segments)
        _check_camera(folder, key, segments, report)


def _absent(keys: list[str]) -> Iterator[Issue]:
    for key in keys:
        yield warning(
            message="the video is declared, but no file of it is here; joints and poses can be "
            "read, LeRobot itself needs it",
            file=f"videos/**/{key}",
            key=key,
        )


def _unlisted(key: str, segments: dict[int, Segments]) -> Iterator[Issue]:
    for index, found in segments.items():
        if key not in found:
            text = "the list of episodes names no video"
            yield Issue(message=text, episode=index, key=key)


def _check_camera(
    folder: DatasetFolder, key: str, segments: dict[int, Segments], report: ValidationReport
) -> None:
    by_file: dict[Path, list[tuple[int, VideoSegment]]] = {}
    for index, found in segments.items():
        if key in found:
            by_file.setdefault(found[key].file, []).append((index, found[key]))
    every = max(1, len(by_file) // _MOST_DECODED)
    seen: dict[str, int] = {}
    for number, (path, shown) in enumerate(by_file.items()):
        ordered = sorted(shown, key=lambda item: item[1].start)
        file, first = _VideoFile(folder=folder, key=key, path=path, shown=ordered), shown[0][0]
        place: dict[str, Any] = {"file": file.name, "episode": first, "key": key}
        if number == _MOST_FILES:
            text = f"{len(by_file) - number} further videos were not examined"
            report.add(warning(message=text, file=file.name, key=key))
            return
        try:
            require_file(path, file.name, first)
            if not is_inside(folder.root, file.name):
                raise DatasetError("leads out of the dataset: it is not followed")
            stream = _read_stream(path)
            report.run("video size and rate", _size_and_rate, file, stream)
            report.run("video length", _length, file, stream)
            if number % every == 0:
                for issue in _images(file, shown):
                    report.add(issue)
        except DatasetError as error:
            report.add(Issue(message=error.issue.message, **place))
            continue
        digest = _digest(path)
        if digest in seen:
            text = f"is the same video as that of episode {seen[digest]}"
            report.add(warning(message=text, **place))
        seen.setdefault(digest, first)


def _read_stream(path: Path) -> _Stream:
    """Count the packets of a file.

    Raises:
        DatasetError: The file is no video, damaged or truncated.
    """
    import av

    count = 0
    try:
        with av.open(str(path)) as container:
            stream = container.streams.video[0]
            promised = stream.frames
            for packet in container.demux(stream):
                if packet.size:
                    count += 1
                    if packet.is_corrupt:
                        raise DatasetError("holds damaged packets: copy it again")
            rate = float(stream.average_rate or stream.guessed_rate or 0)
            found = _Stream(images=count, rate=rate, height=stream.height, width=stream.width)
    except DatasetError:
        raise
    except (av.FFmpegError, IndexError, ValueError, OSError) as error:
        raise DatasetError(
            f"is no video that can be read ({error}): the recording was broken off, or the "
            f"copy is incomplete"
        ) from error
    if count < promised:
        raise DatasetError(f"breaks off: holds {count} of {promised} images; copy it again")
    return found


def _digest(path: Path) -> str:
    """Digest of size, beginning and end: it identifies copies without reading whole files."""
    with path.open("rb") as stream:
        head = stream.read(2**16)
        size = stream.seek(0, 2)
        stream.seek(max(0, size - 2**16))
        return hashlib.sha256(head + stream.read() + str(size).encode()).hexdigest()


def _size_and_rate(file: _VideoFile, stream: _Stream) -> Iterator[Issue]:
    declared = file.folder.features[file.key].shape
    size, fps = (stream.height, stream.width), file.folder.fps
    if len(declared) == 3 and size not in (declared[:2], declared[1:]):
        yield Issue(
            message=f"has images of {size[0]} x {size[1]}, declared are {list(declared)}",
            file=file.name,
            key=file.key,
        )
    if stream.rate and abs(stream.rate / fps - 1) > 0.02:
        yield Issue(
            message=f"runs at {stream.rate:.4g} images a second, the dataset at {fps:g}",
            file=file.name,
            key=file.key,
        )


def _length(file: _VideoFile, stream: _Stream) -> Iterator[Issue]:
    """Number of images per episode, end of the file, and overlaps of episodes."""
    fps, is_v3, lengths = file.folder.fps, file.folder.is_v3, file.lengths
    place: dict[str, Any] = {"file": file.name, "key": file.key}
    for index, segment in file.shown:
        length = lengths[index]
        images = round((segment.stop - segment.start) * fps) if is_v3 else stream.images
        if abs(images - length) > 1:
            yield Issue(
                message=f"shows {images} images, but the episode has {length} frames: it is "
                f"that of another episode, or frames were lost",
                episode=index,
                severity=abs(images - length),
                **place,
            )
    if not is_v3:
        return
    end = max(segment.stop for _, segment in file.shown)
    if stream.duration and end > stream.duration + 1.5 / fps:
        yield Issue(
            message=f"ends after {stream.duration:.3f} s, but episodes reach to {end:.3f} s",
            **place,
        )
    for (before, first), (index, second) in pairwise(file.shown):
        if second.start < first.stop - 0.5 / fps:
            yield Issue(
                message=f"begins at {second.start:.3f} s, before episode {before} ends "
                f"({first.stop:.3f} s)",
                episode=index,
                **place,
            )
            return


def _images(file: _VideoFile, shown: list[tuple[int, VideoSegment]]) -> Iterator[Issue]:
    """Some images of some episodes: decodable, and not all the same.

    Raises:
        DatasetError: An image cannot be decoded.
    """
    some = np.unique(np.linspace(0, len(shown) - 1, _MOST_EPISODES).round().astype(int))
    for index, segment in (shown[i] for i in some):
        length = file.lengths[index]
        frames = dict.fromkeys((0, length // 3, 2 * length // 3, length - 1))
        images = [image_at(segment, frame, file.folder.fps) for frame in frames]
        if len(images) > 2 and all(np.array_equal(images[0], i) for i in images[1:]):
            blank = "all of one colour" if np.ptp(images[0]) == 0 else "the same image"
            yield warning(
                message=f"shows {blank} at the beginning, in the middle and at the end",
                file=file.name,
                episode=index,
                key=file.key,
                check="video images",
            )
