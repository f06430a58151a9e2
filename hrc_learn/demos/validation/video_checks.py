"""Whether the videos of a dataset are there, whole, and those of their episodes."""

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from hrc_learn.demos.format.dataset_folder import (
    DatasetFolder,
    generation,
    is_inside,
    require_file,
)
from hrc_learn.demos.format.videos import (
    Segments,
    VideoSegment,
    image_at,
    read_segments,
    video_keys,
)
from hrc_learn.demos.issue import DatasetError, ValidationReport

_MOST_FILES = 2000
"""Files whose packets are counted; a terabyte of videos takes an hour to read."""
_MOST_DECODED = 60
"""Files of which images are decoded."""
_MOST_EPISODES = 8
"""Episodes of one file of which images are decoded."""


@dataclass(frozen=True, kw_only=True)
class _Video:
    """What a file of images holds, without decoding them."""

    images: int
    duration: float
    """Of all images [s]."""
    rate: float
    height: int
    width: int
    digest: str
    """Of its beginning and end."""


def check_videos(folder: DatasetFolder, report: ValidationReport) -> None:
    """Files, lengths, sizes and some images of every camera."""
    keys = video_keys(folder)
    if not keys:
        return
    segments = read_segments(folder, missing=True)
    if not any(
        s.file.exists() for of_episode in segments.values() for s in of_episode.values()
    ):
        for key in keys:
            report.warning(
                "the video is declared, but no file of it is here; joints and poses can be "
                "read, LeRobot itself needs it",
                file=f"videos/**/{key}",
                key=key,
            )
        return
    for key in keys:
        _check_camera(folder, key, segments, report)


def _check_camera(
    folder: DatasetFolder, key: str, segments: dict[int, Segments], report: ValidationReport
) -> None:
    lengths = {entry.index: entry.length for entry in folder.episodes}
    by_file: dict[Path, list[tuple[int, VideoSegment]]] = {}
    for index, of_episode in segments.items():
        if key in of_episode:
            by_file.setdefault(of_episode[key].file, []).append((index, of_episode[key]))
        else:
            report.error("the list of episodes names no video", episode=index, key=key)
    every = max(1, len(by_file) // _MOST_DECODED)
    seen: dict[str, int] = {}
    for number, (path, shown) in enumerate(by_file.items()):
        name = str(path.relative_to(folder.root))
        first = shown[0][0]
        if number == _MOST_FILES:
            report.warning(
                f"{len(by_file) - number} further videos were not examined", file=name, key=key
            )
            return
        try:
            require_file(path, name, first)
            if not is_inside(folder.root, name):
                raise DatasetError("leads out of the dataset: it is not followed", file=name)
            video = _examine(path, name)
            _check_file(folder, key, name, shown, video, lengths, report)
            if number % every == 0:
                _check_images(folder, key, name, shown, lengths, report)
        except DatasetError as error:
            report.error(error.finding.message, file=name, episode=first, key=key)
            continue
        if video.digest in seen:
            report.warning(
                f"is the same video as that of episode {seen[video.digest]}",
                file=name,
                episode=first,
                key=key,
            )
        seen.setdefault(video.digest, first)


def _examine(path: Path, name: str) -> _Video:
    """Count the packets of a file.

    Raises:
        DatasetError: It is no video, or breaks off.
    """
    import av

    promised, count, end, rate, height, width = 0, 0, 0.0, 0.0, 0, 0
    try:
        with av.open(str(path)) as container:
            stream = container.streams.video[0]
            promised = stream.frames
            for packet in container.demux(stream):
                if packet.size:
                    count += 1
                    if packet.is_corrupt:
                        raise DatasetError("holds damaged packets: copy it again", file=name)
            rate = float(stream.average_rate or stream.guessed_rate or 0)
            end = count / rate if rate else 0.0
            height, width = stream.height, stream.width
    except (av.FFmpegError, IndexError, ValueError, OSError) as error:
        if isinstance(error, DatasetError):
            raise
        raise DatasetError(
            f"is no video that can be read ({error}): the recording was broken off, or the "
            f"copy is incomplete",
            file=name,
        ) from error
    if count < promised:
        raise DatasetError(
            f"breaks off: holds {count} of {promised} images; copy it again", file=name
        )
    return _Video(
        images=count, duration=end, rate=rate, height=height, width=width, digest=_digest(path)
    )


def _digest(path: Path) -> str:
    """Of size, beginning and end: copies are told without reading the whole."""
    with path.open("rb") as stream:
        head = stream.read(2**16)
        size = stream.seek(0, 2)
        stream.seek(max(0, size - 2**16))
        return hashlib.sha256(head + stream.read() + str(size).encode()).hexdigest()


def _check_file(
    folder: DatasetFolder,
    key: str,
    name: str,
    shown: list[tuple[int, VideoSegment]],
    video: _Video,
    lengths: dict[int, int],
    report: ValidationReport,
) -> None:
    """Sizes and lengths of one file against what the metadata say of it."""
    place = {"file": name, "key": key}
    declared = folder.features[key].shape
    if len(declared) == 3 and (video.height, video.width) not in (declared[:2], declared[1:]):
        report.error(
            f"has images of {video.height} x {video.width}, declared are {list(declared)}",
            **place,
        )
    if video.rate and abs(video.rate / folder.fps - 1) > 0.02:
        report.error(
            f"runs at {video.rate:.4g} images a second, the dataset at {folder.fps:g}", **place
        )
    own = generation(folder.version) != 3
    for index, segment in sorted(shown, key=lambda item: item[1].start):
        length = lengths[index]
        frames = video.images if own else round((segment.stop - segment.start) * folder.fps)
        if abs(frames - length) > 1:
            report.error(
                f"shows {frames} images, but the episode has {length} frames: it is that of "
                f"another episode, or frames were lost",
                **place,
                episode=index,
                severity=abs(frames - length),
            )
    if not own:
        end = max(segment.stop for _, segment in shown)
        if video.duration and end > video.duration + 1.5 / folder.fps:
            report.error(
                f"ends after {video.duration:.3f} s, but episodes reach to {end:.3f} s", **place
            )
        _check_order(name, key, shown, folder.fps, report)


def _check_order(
    name: str,
    key: str,
    shown: list[tuple[int, VideoSegment]],
    fps: float,
    report: ValidationReport,
) -> None:
    """Episodes that share images."""
    ordered = sorted(shown, key=lambda item: item[1].start)
    for (before, first), (index, second) in pairwise(ordered):
        if second.start < first.stop - 0.5 / fps:
            report.error(
                f"begins at {second.start:.3f} s, before episode {before} ends "
                f"({first.stop:.3f} s)",
                file=name,
                episode=index,
                key=key,
            )
            return


def _check_images(
    folder: DatasetFolder,
    key: str,
    name: str,
    shown: list[tuple[int, VideoSegment]],
    lengths: dict[int, int],
    report: ValidationReport,
) -> None:
    """Some images of some episodes in a file: decodable, and not all one."""
    some = np.unique(np.linspace(0, len(shown) - 1, _MOST_EPISODES).round().astype(int))
    for index, segment in (shown[i] for i in some):
        images = list(_some_images(segment, lengths[index], folder.fps))
        if len(images) > 2 and all(np.array_equal(images[0], i) for i in images[1:]):
            blank = "all of one colour" if np.ptp(images[0]) == 0 else "the same image"
            report.warning(
                f"shows {blank} at the beginning, in the middle and at the end",
                file=name,
                episode=index,
                key=key,
            )


def _some_images(segment: VideoSegment, length: int, fps: float) -> Iterator[np.ndarray]:
    for frame in dict.fromkeys((0, length // 3, 2 * length // 3, length - 1)):
        yield image_at(segment, frame, fps)
