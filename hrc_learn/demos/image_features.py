"""Image features found in a dataset's videos, kept in files beside it, and put into
demonstrations.
"""

import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from jaxtyping import Bool, Float64, UInt8

from hrc_learn.demos.demonstration import Demonstration, DemonstrationSet
from hrc_learn.demos.format.dataset_folder import (
    EpisodeEntry,
    open_folder,
    open_parquet,
    read_table,
)
from hrc_learn.demos.format.videos import (
    VideoSegment,
    decode,
    image_key,
    read_segments,
    video_keys,
)
from hrc_learn.demos.issue import DatasetError
from hrc_learn.demos.read.frames import to_numpy
from hrc_learn.store import new_file

# Image features of a dataset in a folder beside it: one file an episode.
#
#     NAME.features/CAMERA.FEATURE/episode_000000.parquet    u, v, visible: one row a frame
#
# The dataset itself is never touched. Each file is whole or not there, and says of which
# video it was made, so that an extraction goes on where it was broken off and notices new
# recordings.

_SOURCE = b"hrc_learn.video"


@dataclass(frozen=True, kw_only=True, eq=False)
class FeatureTrack:
    """An image feature along one episode."""

    pixels: Float64[np.ndarray, "_frames 2"]
    """(u right, v down) [px], 0 where it was not seen."""
    visible: Bool[np.ndarray, " _frames"]


def features_folder(root: Path) -> Path:
    """Where the features found in the videos of the dataset `root` are kept."""
    if root.name in ("", ".."):
        root = root.resolve()
    return root.with_name(root.name + ".features")


def feature_names(root: Path) -> list[str]:
    """Features that were extracted, whole or in part."""
    # Hidden ones hold what is not finished.
    return sorted(path.name for path in features_folder(root).glob("[!.]*") if path.is_dir())


class FeatureCache:
    """The files of one feature of one dataset."""

    def __init__(self, root: Path, name: str):
        self.name = name
        self._folder = features_folder(root) / name

    def path(self, episode: int) -> Path:
        return self._folder / f"episode_{episode:06d}.parquet"

    def is_current(self, episode: int, segment: VideoSegment) -> bool:
        """Whether the episode's file is there and was made of this very video."""
        path = self.path(episode)
        if not path.is_file():
            return False
        metadata = pq.read_schema(path).metadata or {}
        return metadata.get(_SOURCE) == _fingerprint(segment)

    def write(self, episode: int, segment: VideoSegment, track: FeatureTrack) -> None:
        """Keep what was found in an episode; its file is whole or not there."""
        path = self.path(episode)
        path.parent.mkdir(parents=True, exist_ok=True)
        table = pa.table(
            {
                "u": pa.array(track.pixels[:, 0]),
                "v": pa.array(track.pixels[:, 1]),
                "visible": pa.array(track.visible),
            }
        )
        with new_file(path) as part:
            pq.write_table(
                table.replace_schema_metadata({_SOURCE: _fingerprint(segment)}), part
            )

    def read(self, episode: int, frames: int) -> FeatureTrack:
        """What was found in an episode.

        Raises:
            DatasetError: It was not extracted, or is of another recording.
        """
        file = str(self.path(episode))
        if not self.path(episode).is_file():
            raise DatasetError(
                f"{self.name} was not extracted from this episode: hrc extract goes on where "
                f"it was broken off",
                file=file,
                episode=episode,
            )
        name = self.path(episode).name
        table = read_table(open_parquet(self._folder, name, episode), file)
        u, v, visible = (to_numpy(table.column(c))[:, 0] for c in ("u", "v", "visible"))
        if len(u) != frames:
            raise DatasetError(
                f"{self.name} has {len(u)} frames, the episode {frames}: run hrc extract again",
                file=file,
                episode=episode,
            )
        return FeatureTrack(pixels=np.stack([u, v], axis=1), visible=visible.astype(bool))


def _fingerprint(segment: VideoSegment) -> bytes:
    state = segment.file.stat()
    content = [segment.file.name, state.st_size, state.st_mtime_ns, segment.start, segment.stop]
    return json.dumps(content).encode()


# Looking for a feature in all videos of a camera.

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
    left_out: dict[int, str] = field(default_factory=dict)
    """Episodes whose video is missing or damaged, and what is wrong with it."""


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
    it was broken off, or after more was recorded. Those whose video is missing or damaged are
    left out, and listed in the result.

    Args:
        path: The dataset.
        name: What is looked for, such as "marker_3".
        detector: Makes the detector for one episode, so that one which follows the feature
            from image to image starts anew.
        camera: Name of the camera ("front") or of its feature; None: the only one.
        progress: Called with the episodes to look at, and gives them back: a hook for a
            progress bar.

    Raises:
        DatasetError: There is no such camera, or the metadata are damaged.
    """
    folder = open_folder(path)
    key = _camera_key(video_keys(folder), camera)
    cache = FeatureCache(folder.root, f"{key.rpartition('.')[2]}.{name}")
    segments = {index: found.get(key) for index, found in read_segments(folder).items()}
    waiting = [
        entry
        for entry in folder.episodes
        if (segment := segments[entry.index]) is None
        or not cache.is_current(entry.index, segment)
    ]
    done = Extraction(name=cache.name, known=len(folder.episodes) - len(waiting))
    for entry in progress(waiting) if progress else waiting:
        try:
            segment = _require(segments[entry.index], entry, key)
            track, images = _look(segment, entry.length, folder.fps, detector())
        except DatasetError as error:
            done.left_out[entry.index] = str(error)
            continue
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


# Features that were extracted from videos, put into demonstrations.


def attach_features(demos: DemonstrationSet, name: str | None = None) -> DemonstrationSet:
    """Demonstrations with a feature that `extract_features` found in their videos.

    `load_demos` and `open_demos` do so by themselves where a dataset has no image feature of
    its own and exactly one was extracted.

    Args:
        demos: Read from a dataset.
        name: Name of the feature, such as "front.marker_3"; None: the only one.

    Raises:
        DatasetError: There is no such feature, or it was not extracted from all episodes.
    """
    root = Path(demos.source)
    known = feature_names(root) if demos.source else []
    chosen = [feature for feature in known if name in (None, feature)]
    if len(chosen) != 1:
        raise DatasetError(
            f"{'say which feature' if name is None else f'there is no feature {name!r}'}; "
            f"extracted are {', '.join(known) or 'none'}",
            file=demos.source,
        )
    cache = FeatureCache(root, chosen[0])
    return demos.map(lambda demo: with_feature(demo, cache))


def only_feature(root: Path) -> FeatureCache | None:
    """The feature that was extracted from a dataset; None where that is not exactly one."""
    names = feature_names(root)
    return FeatureCache(root, names[0]) if len(names) == 1 else None


def missing_note(cache: FeatureCache, episodes: Sequence[int]) -> list[str]:
    """Says in which episodes a feature was not looked for; empty if in none."""
    without = [episode for episode in episodes if not cache.path(episode).is_file()]
    if not without:
        return []
    first = ", ".join(map(str, without[:5])) + ", ..." * (len(without) > 5)
    return [
        f"{cache.name} was not extracted from {len(without)} episodes ({first}) and counts as "
        f"not seen there; hrc extract goes on where it was broken off"
    ]


def with_feature(
    demo: Demonstration, cache: FeatureCache, *, if_known: bool = False
) -> Demonstration:
    """The demonstration with the feature of its episode.

    Args:
        demo: Of the dataset.
        cache: Of the feature.
        if_known: Seen nowhere, where it was not extracted from the episode.

    Raises:
        DatasetError: It was not extracted from this episode.
    """
    if if_known and not cache.path(demo.episode).is_file():
        unseen = np.zeros((len(demo), 2)), np.zeros(len(demo), dtype=bool)
        return replace(demo, feature=unseen[0], feature_visible=unseen[1])
    track = cache.read(demo.episode, len(demo))
    return replace(demo, feature=track.pixels, feature_visible=track.visible)
