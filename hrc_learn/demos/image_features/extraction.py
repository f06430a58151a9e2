"""Looking for a feature in all videos of a camera."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64, UInt8

from ..finding import DatasetError
from ..layout import EpisodeEntry, open_folder
from ..video import image_key
from ..video_places import read_segments, video_keys
from ..video_segment import VideoSegment
from .cache import FeatureCache, FeatureTrack
from .decoding import decode

Detector = Callable[[UInt8[np.ndarray, "_height _width 3"]], Float64[np.ndarray, "2"] | None]
"""Pixel (u right, v down) of the feature in an RGB image, or None where it is not seen."""

Progress = Callable[[Sequence[EpisodeEntry]], Iterable[EpisodeEntry]]


@dataclass(kw_only=True)
class Extraction:
    """What was done."""

    name: str
    """Name of the feature beside the dataset."""
    episodes: int = 0
    """Episodes looked at now."""
    known: int = 0
    """Episodes that had been looked at before."""
    frames: int = 0
    """Frames looked at now."""
    seen: int = 0
    """Those of them in which the feature was seen."""
    without_image: int = 0
    """Frames for which the video holds no image."""


def extract_features(
    path: str | Path,
    name: str,
    detector: Callable[[], Detector],
    *,
    camera: str | None = None,
    progress: Progress | None = None,
) -> Extraction:
    """Find a feature in every image of a camera and keep it beside the dataset.

    Episodes that were looked at before, in the same videos, are skipped: run it again after
    it was broken off, or after more was recorded.

    Args:
        path: The dataset.
        name: What is looked for, such as "marker_3".
        detector: Makes the detector for one episode, so that one which follows the feature
            from image to image starts anew.
        camera: Name of the camera ("front") or of its feature; None: the only one.
        progress: Called with the episodes to look at, and gives them back: a hook for a
            progress bar.

    Raises:
        DatasetError: There is no such camera, or a video is missing or damaged.
    """
    folder = open_folder(path)
    key = _camera_key(video_keys(folder), camera)
    cache = FeatureCache(folder.root, f"{key.rpartition('.')[2]}.{name}")
    segments = {
        entry.index: _require(found.get(key), entry, key)
        for entry, found in zip(folder.episodes, read_segments(folder).values(), strict=True)
    }
    waiting = [e for e in folder.episodes if not cache.is_current(e.index, segments[e.index])]
    done = Extraction(name=cache.name, known=len(folder.episodes) - len(waiting))
    for entry in progress(waiting) if progress else waiting:
        segment = segments[entry.index]
        track, images = _look(segment, entry.length, folder.fps, detector())
        cache.write(entry.index, segment, track)
        done.episodes += 1
        done.frames += entry.length
        done.seen += int(track.visible.sum())
        done.without_image += entry.length - images
    return done


def _look(
    segment: VideoSegment, frames: int, fps: float, detect: Detector
) -> tuple[FeatureTrack, int]:
    """The feature along one episode, and how many of its frames have an image."""
    pixels, visible = np.zeros((frames, 2)), np.zeros(frames, dtype=bool)
    seen = set()
    for frame, image in decode(segment, fps):
        if frame >= frames:
            break
        seen.add(frame)
        pixel = detect(image)
        if pixel is not None:
            pixels[frame], visible[frame] = pixel, True
    return FeatureTrack(pixels=pixels, visible=visible), len(seen)


def _camera_key(keys: Sequence[str], camera: str | None) -> str:
    wanted = [key for key in keys if camera is None or key in (camera, image_key(camera))]
    if len(wanted) == 1:
        return wanted[0]
    what = "say which camera" if camera is None and keys else f"there is no camera {camera!r}"
    raise DatasetError(f"{what}; the videos are of {', '.join(keys) or 'none'}")


def _require(segment: VideoSegment | None, entry: EpisodeEntry, key: str) -> VideoSegment:
    if segment is None:
        raise DatasetError(
            "its video is not here; copy it, or load the dataset without image features",
            episode=entry.index,
            key=key,
        )
    return segment
