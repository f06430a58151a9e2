"""Episodes and frames counted in several places, which must agree."""

from collections import Counter
from collections.abc import Iterator

from .features import INFO_PATH
from .finding import DatasetError
from .layout import DatasetFolder


def count_faults(folder: DatasetFolder) -> Iterator[DatasetError]:
    """What the metadata contradict each other in."""
    entries, info = folder.episodes, folder.info
    if not entries:
        yield DatasetError("the dataset holds no episodes", file=folder.root)
    for name, counted in (
        ("total_episodes", len(entries)),
        ("total_frames", sum(entry.length for entry in entries)),
    ):
        if info.get(name, counted) != counted:
            yield DatasetError(
                f"says {info[name]}, but the list of episodes counts {counted}: episodes were "
                f"lost, or the file belongs to another copy; repair_dataset.py counts anew",
                file=INFO_PATH,
                key=name,
            )
    repeated = [index for index, n in Counter(e.index for e in entries).items() if n > 1]
    for index in repeated:
        yield DatasetError("is listed more than once", file="meta/episodes", episode=index)
    missing = sorted(set(range(len(entries))) - {entry.index for entry in entries})
    if missing and not repeated:
        yield DatasetError(
            "is missing from the list of episodes: indices must count from 0 without a gap",
            file="meta/episodes",
            episode=missing[0],
        )
    for entry in entries:
        if entry.length <= 0:
            yield DatasetError("has no frames", file=entry.file, episode=entry.index)
