"""Image features found in a dataset's videos, kept next to the dataset.

    NAME.features/CAMERA.FEATURE/episode_000000.parquet    u, v, visible: one row per frame

The dataset itself is never changed. Each file is complete or absent and records which video it
was made from. An extraction can therefore continue after an interruption and find new videos.
"""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from jaxtyping import Bool, Float64, UInt8

from hrc_learn.demos.demonstration import Demonstration, DemonstrationSet
from hrc_learn.demos.issues import DatasetError
from hrc_learn.demos.read.dataset_files import open_parquet, read_table, write_parquet
from hrc_learn.demos.read.dataset_folder import Progress, open_folder
from hrc_learn.demos.read.frames import to_numpy
from hrc_learn.demos.videos import VideoSegment, decode, image_key, read_segments, video_keys
from hrc_learn.store import new_file

_SOURCE = b"hrc_learn.video"
_ADVICE = "hrc fit image-jacobian --marker N searches the remaining videos"

Detector = Callable[[UInt8[np.ndarray, "_height _width 3"]], Float64[np.ndarray, "2"] | None]
"""Function that finds a feature in an RGB image: its pixel (u right, v down), or None if the
feature is not visible."""


Track = tuple[Float64[np.ndarray, "_frames 2"], Bool[np.ndarray, " _frames"]]
"""Track of a feature: its pixel in each frame (u right, v down) [px], and a mask of the frames
in which it is visible. The pixel is 0 in all other frames."""


class FeatureCache:
    """Files of one feature of one dataset."""

    def __init__(self, root: Path, name: str):
        """
        Args:
            root: Folder of the dataset.
            name: Name of the feature, such as "front.marker_3".
        """
        self.name = name
        self._folder = _features_folder(root) / name

    def path(self, episode: int) -> Path:
        """File of an episode."""
        return self._folder / f"episode_{episode:06d}.parquet"

    def is_current(self, episode: int, segment: VideoSegment) -> bool:
        """True if the file of an episode was made from this video in its present state."""
        path = self.path(episode)
        metadata = (pq.read_schema(path).metadata or {}) if path.is_file() else {}
        return metadata.get(_SOURCE) == _fingerprint(segment)

    def write(self, episode: int, segment: VideoSegment, track: Track) -> None:
        """Write the file of an episode."""
        path = self.path(episode)
        path.parent.mkdir(parents=True, exist_ok=True)
        pixels, visible = track
        table = pa.table({"u": pixels[:, 0], "v": pixels[:, 1], "visible": visible})
        with new_file(path) as part:
            write_parquet(table.replace_schema_metadata({_SOURCE: _fingerprint(segment)}), part)

    def attach(self, demo: Demonstration, *, if_known: bool = False) -> Demonstration:
        """The demonstration with this feature, as extracted from its episode.

        Args:
            demo: Demonstration from the dataset.
            if_known: Count the feature as not visible if it was not extracted from the episode.

        Raises:
            DatasetError: The feature was not extracted, or has another number of frames than
                the demonstration.
        """
        path, frames = self.path(demo.episode), len(demo)

        def fault(row: int | None, message: str) -> DatasetError:
            return DatasetError(message, file=path, episode=demo.episode, frame=row)

        if not path.is_file():
            if not if_known:
                raise fault(None, f"{self.name} was not extracted from this episode: {_ADVICE}")
            hidden = np.zeros(frames, dtype=bool)
            return replace(demo, feature=np.zeros((frames, 2)), feature_visible=hidden)
        table = read_table(open_parquet(self._folder, path.name, demo.episode), str(path))
        u, v, visible = (to_numpy(table[c], fault)[:, 0] for c in ("u", "v", "visible"))
        if len(u) != frames:
            text = f"{self.name} has {len(u)} frames, the episode {frames}: {_ADVICE}"
            raise fault(None, text)
        pixels = np.stack([u, v], axis=1)
        return replace(demo, feature=pixels, feature_visible=visible.astype(bool))

    def note(self, episodes: Sequence[int]) -> tuple[str, ...]:
        """Note that lists the episodes without this feature; empty if there are none."""
        without = [episode for episode in episodes if not self.path(episode).is_file()]
        first = ", ".join(map(str, without[:5])) + ", ..." * (len(without) > 5)
        text = (
            f"{self.name} was not extracted from {len(without)} episodes ({first}) and counts "
            f"as not visible there: {_ADVICE}"
        )
        return (text,) if without else ()


def _features_folder(root: Path) -> Path:
    if root.name in ("", ".."):
        root = root.resolve()
    return root.with_name(root.name + ".features")


def extracted_features(root: str | Path) -> list[FeatureCache]:
    """Features that were extracted from all or some episodes of a dataset, sorted by name."""
    folder = _features_folder(Path(root))
    names = {file.parent.name for file in folder.glob("[!.]*/episode_*.parquet")}
    return [FeatureCache(Path(root), name) for name in sorted(names)]


def _fingerprint(segment: VideoSegment) -> bytes:
    state = segment.file.stat()
    content = [segment.file.name, state.st_size, state.st_mtime_ns, segment.start, segment.stop]
    return json.dumps(content).encode()


@dataclass(kw_only=True)
class Extraction:
    """Result of `extract_features`."""

    name: str
    """Name of the feature with its camera, such as "front.marker_3"."""
    episodes: int = 0
    """Number of episodes searched by this call."""
    known: int = 0
    """Number of episodes searched by earlier calls."""
    frames: int = 0
    """Number of frames searched by this call."""
    seen: int = 0
    """Number of frames in which this call found the feature."""
    without_image: int = 0
    """Number of frames for which this call found no image in the video."""
    left_out: dict[int, str] = field(default_factory=dict)
    """Episode index -> fault of its video."""


def extract_features(
    path: str | Path,
    name: str,
    detector: Callable[[], Detector],
    *,
    camera: str | None = None,
    progress: Progress | None = None,
) -> Extraction:
    """Find a feature in every image of a camera, and keep the result next to the dataset.

    Episodes are skipped if their present videos were searched before, so this function can be
    called again after an interruption, or after more episodes were recorded. Episodes without
    an intact video are left out and listed in the result.

    Args:
        path: The dataset.
        name: Name of the feature, such as "marker_3".
        detector: Function that makes a new detector for each episode. A detector may
            therefore track the feature from image to image.
        camera: Name of the camera ("front") or key of its feature; None for the only camera.
        progress: Function that iterates over the episodes to search and shows the progress.

    Raises:
        DatasetError: There is no such camera, or the metadata are damaged.
    """
    folder = open_folder(path)
    key = camera_key(video_keys(folder), camera)
    cache = FeatureCache(folder.root, f"{key.rpartition('.')[2]}.{name}")
    segments = {i: shown[key] for i, shown in read_segments(folder).items() if key in shown}
    current = {i for i, segment in segments.items() if cache.is_current(i, segment)}
    done = Extraction(name=cache.name, known=len(current))
    waiting = [entry for entry in folder.episodes if entry.index not in current]
    for entry in progress(waiting) if progress else waiting:
        segment = segments.get(entry.index)
        try:
            if segment is None:
                text = (
                    "its video is missing; copy it, or load the dataset without image features"
                )
                raise DatasetError(text, episode=entry.index, key=key)
            track, images = _track(segment, entry.length, folder.fps, detector())
        except DatasetError as error:
            done.left_out[entry.index] = str(error)
            continue
        cache.write(entry.index, segment, track)
        done.episodes += 1
        done.frames += entry.length
        done.seen += int(track[1].sum())
        done.without_image += entry.length - images
    return done


def _track(
    segment: VideoSegment, frames: int, fps: float, detect: Detector
) -> tuple[Track, int]:
    """Track of the feature along one episode, and the number of frames with an image."""
    pixels, visible, images = np.zeros((frames, 2)), np.zeros(frames, dtype=bool), 0
    for frame, image in decode(segment, fps, frames=range(frames)):
        images += 1
        pixel = detect(image)
        if pixel is not None:
            pixels[frame], visible[frame] = pixel, True
    return (pixels, visible), images


def camera_key(keys: Sequence[str], camera: str | None) -> str:
    """Key of the named camera, or the only key if no camera is named.

    Raises:
        DatasetError: There is no such camera, or none is named although there are several.
    """
    wanted = [key for key in keys if camera is None or key in (camera, image_key(camera))]
    if len(wanted) == 1:
        return wanted[0]
    what = "name the camera" if camera is None and keys else f"there is no camera {camera!r}"
    raise DatasetError(f"{what}; the dataset has videos of {', '.join(keys) or 'none'}")


def attach_features(demos: DemonstrationSet, name: str | None = None) -> DemonstrationSet:
    """Demonstrations with a feature that `extract_features` found in their videos.

    `load_demos` and `open_demos` attach the feature automatically if no column of the dataset
    holds an image feature and exactly one feature was extracted.

    Args:
        demos: Demonstrations read from a dataset.
        name: Name of the feature, such as "front.marker_3"; None for the only one.

    Raises:
        DatasetError: There is no such feature, or it was not extracted from all episodes.
    """
    known = extracted_features(demos.source) if demos.source else []
    chosen = [cache for cache in known if name in (None, cache.name)]
    if len(chosen) != 1:
        what = "name the feature" if name is None else f"there is no feature {name!r}"
        names = ", ".join(cache.name for cache in known) or "none"
        raise DatasetError(f"{what}; extracted features: {names}", file=demos.source)
    return demos.map(chosen[0].attach)
