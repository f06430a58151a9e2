"""Checks of a dataset's videos: existence, integrity, length, size and some images."""

import hashlib
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hrc_learn.demos.issues import DatasetError, Issue, ValidationReport, warning
from hrc_learn.demos.read.dataset_files import require_file
from hrc_learn.demos.read.dataset_folder import DatasetFolder, EpisodeEntry
from hrc_learn.demos.videos import VideoSegment, image_at, read_segments, video_keys

_MOST_FILES = 2000
"""Largest number of files whose packets are counted: reading a terabyte takes an hour."""
_MOST_DECODED = 60
"""Approximate number of files from which images are decoded; at most twice as many."""
_MOST_EPISODES = 8
"""Largest number of episodes of a file from which images are decoded."""


Shown = list[tuple[EpisodeEntry, VideoSegment]]
"""Episodes shown in one file, with their segments."""


class _Stream(NamedTuple):
    """Properties of a video stream, found without decoding it."""

    images: int
    rate: float
    """Frame rate [1/s], 0 if unknown."""
    size: tuple[int, int]
    """Height and width [px]."""


def check_videos(folder: DatasetFolder, report: ValidationReport) -> None:
    """Check the videos of every camera."""
    keys = video_keys(folder)
    segments = read_segments(folder, missing=True)
    files = [s.file for found in segments.values() for s in found.values()]
    for key in keys:
        if not any(file.exists() for file in files):
            text = (
                "the video is declared, but no file of it is here; joints and poses can be "
                "read, but LeRobot needs the video"
            )
            report.add(warning(message=text, file=f"videos/**/{key}", key=key))
            continue
        by_file: dict[Path, Shown] = {}
        for entry in folder.episodes:
            segment = segments[entry.index].get(key)
            if segment is None:
                text = "the list of episodes names no video"
                report.add(Issue(message=text, episode=entry.index, key=key))
            else:
                by_file.setdefault(segment.file, []).append((entry, segment))
        _check_camera(folder, key, by_file, report)


def _check_camera(
    folder: DatasetFolder, key: str, by_file: dict[Path, Shown], report: ValidationReport
) -> None:
    every = max(1, min(len(by_file), _MOST_FILES) // _MOST_DECODED)
    seen: dict[str, int] = {}
    for number, (path, shown) in enumerate(by_file.items()):
        name, first = str(path.relative_to(folder.root)), shown[0][0].index
        place: dict[str, Any] = {"file": name, "key": key}
        if number == _MOST_FILES:
            text = f"{len(by_file) - number} further videos were not examined"
            report.add(warning(message=text, **place))
            return
        try:
            require_file(folder.root, name, first)
            stream = read_stream(path)
            report.run(_size_and_rate, folder, stream, place)
            report.run(_length, folder, shown, stream, place)
            if number % every == 0:
                report.run(_images, folder, shown, place)
        except DatasetError as error:
            report.add(Issue(message=error.issue.message, episode=first, **place))
            continue
        digest = _digest(path)
        if digest in seen:
            text = f"is the same video as that of episode {seen[digest]}"
            report.add(warning(message=text, episode=first, **place))
        seen.setdefault(digest, first)


def read_stream(path: Path) -> _Stream:
    """Count the images of a video, and read its frame rate and size, without decoding.

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
            found = _Stream(count, rate, (stream.height, stream.width))
    except DatasetError:
        raise
    except (av.FFmpegError, IndexError, ValueError, OSError) as error:
        text = f"is no video that can be read ({error})"
        raise DatasetError(f"{text}: the recording or the copy is incomplete") from error
    if count < promised:
        raise DatasetError(f"breaks off: holds {count} of {promised} images; copy it again")
    return found


def _digest(path: Path) -> str:
    """Digest of a file's size, beginning and end, by which copies are found quickly."""
    with path.open("rb") as stream:
        head = stream.read(2**16)
        size = stream.seek(0, 2)
        stream.seek(max(0, size - 2**16))
        return hashlib.sha256(head + stream.read() + str(size).encode()).hexdigest()


def _size_and_rate(
    folder: DatasetFolder, stream: _Stream, place: dict[str, Any]
) -> Iterator[Issue]:
    declared, fps = folder.features[place["key"]].shape, folder.fps
    if len(declared) == 3 and stream.size not in (declared[:2], declared[1:]):
        height, width = stream.size
        text = f"has images of {height} x {width}, but {list(declared)} is declared"
        yield Issue(message=text, **place)
    if stream.rate and abs(stream.rate / fps - 1) > 0.02:
        text = f"runs at {stream.rate:.4g} images a second, the dataset at {fps:g}"
        yield Issue(message=text, **place)


def _length(
    folder: DatasetFolder, shown: Shown, stream: _Stream, place: dict[str, Any]
) -> Iterator[Issue]:
    """Check the number of images per episode, the end of the file, and overlaps of episodes."""
    fps = folder.fps
    for entry, segment in shown:
        images = stream.images
        if folder.is_v3:
            images = round((segment.stop - segment.start) * fps)
        off = abs(images - entry.length)
        if off > 1:
            text = (
                f"shows {images} images, but the episode has {entry.length} frames: it "
                f"shows another episode, or frames were lost"
            )
            yield Issue(message=text, episode=entry.index, severity=off, **place)
    if not folder.is_v3:
        return
    end = max(segment.stop for _, segment in shown)
    lasts = stream.images / stream.rate if stream.rate else 0.0
    if lasts and end > lasts + 1.5 / fps:
        text = f"ends after {lasts:.3f} s, but episodes reach to {end:.3f} s"
        yield Issue(message=text, **place)
    ordered = sorted(shown, key=lambda item: item[1].start)
    for (before, first), (entry, second) in pairwise(ordered):
        if second.start < first.stop - 0.5 / fps:
            end = f"episode {before.index} ends ({first.stop:.3f} s)"
            text = f"begins at {second.start:.3f} s, before {end}"
            yield Issue(message=text, episode=entry.index, **place)
            return


def _images(folder: DatasetFolder, shown: Shown, place: dict[str, Any]) -> Iterator[Issue]:
    """Check that some images of some episodes can be decoded and are not all the same.

    Raises:
        DatasetError: An image cannot be decoded.
    """
    some = np.unique(np.linspace(0, len(shown) - 1, _MOST_EPISODES).round().astype(int))
    for entry, segment in (shown[i] for i in some):
        last = entry.length - 1
        frames = dict.fromkeys((0, entry.length // 3, 2 * entry.length // 3, last))
        images = [image_at(segment, frame, folder.fps) for frame in frames]
        if len(images) > 2 and all(np.array_equal(images[0], i) for i in images[1:]):
            varied = (images[0] != images[0][:1, :1]).any()
            blank = "the same image" if varied else "one colour"
            text = f"shows {blank} at the beginning, in the middle and at the end"
            yield warning(message=text, episode=entry.index, **place)
