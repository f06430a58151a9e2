"""Where the images of a dataset lie, for its versions 2.0, 2.1 and 3.0."""

from .finding import DatasetError
from .layout import DatasetFolder, EpisodeEntry
from .parquet import read_rows
from .video_segment import Segments, VideoSegment


def video_keys(folder: DatasetFolder) -> list[str]:
    """Features that are kept as videos."""
    return [key for key, feature in folder.features.items() if feature.dtype == "video"]


def read_segments(folder: DatasetFolder) -> dict[int, Segments]:
    """Where the images of each episode lie; without those whose file is not there."""
    keys = video_keys(folder)
    if not keys:
        return {}
    places = _places_v3(folder, keys) if folder.version.startswith("v3") else {}
    segments = {}
    for entry in folder.episodes:
        found = places.get(entry.index) or _of_own_file(folder, entry, keys)
        segments[entry.index] = {k: s for k, s in found.items() if s.file.is_file()}
    return segments


def _places_v3(folder: DatasetFolder, keys: list[str]) -> dict[int, Segments]:
    template = folder.info.get("video_path")
    places = {}
    for path in sorted((folder.root / "meta/episodes").glob("*/*.parquet")):
        for row in read_rows(folder.root, str(path.relative_to(folder.root)), ()):
            places[row["episode_index"]] = {
                key: VideoSegment(
                    file=folder.root
                    / str(template).format(
                        video_key=key,
                        chunk_index=row[f"videos/{key}/chunk_index"],
                        file_index=row[f"videos/{key}/file_index"],
                    ),
                    start=row[f"videos/{key}/from_timestamp"],
                    stop=row[f"videos/{key}/to_timestamp"],
                )
                for key in keys
                if f"videos/{key}/chunk_index" in row
            }
    return places


def _of_own_file(folder: DatasetFolder, entry: EpisodeEntry, keys: list[str]) -> Segments:
    template = str(folder.info.get("video_path"))
    chunk = entry.index // int(folder.info.get("chunks_size", 1000))
    try:
        files = {
            key: template.format(video_key=key, episode_chunk=chunk, episode_index=entry.index)
            for key in keys
        }
    except (KeyError, IndexError, ValueError) as error:
        if folder.version.startswith("v3"):
            return {}
        raise DatasetError(
            f"video_path {template!r} does not fit the dataset's version", file="meta/info.json"
        ) from error
    return {
        key: VideoSegment(file=folder.root / file, start=0.0, stop=entry.length / folder.fps)
        for key, file in files.items()
    }
