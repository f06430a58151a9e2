"""Recordings on their way to datasets, and their recovery after an interruption.

A recording lives in `NAME.recording/`. Its `recording.json` holds an identifier and the number
of episodes of the dataset that it extends. The finished dataset keeps the identifier, so that
a recording interrupted between the last two steps is not mistaken for another one.
"""

import itertools
import os
import uuid
from dataclasses import dataclass, field
from pathlib import Path

from hrc_learn import store
from hrc_learn.demos.dataset_assembly import assemble
from hrc_learn.demos.issues import DatasetError
from hrc_learn.demos.read.dataset_folder import recovery_advice, staging_folder
from hrc_learn.demos.recorded_episode import staged_paths

_RECORDING = "recording.json"
_EPISODE = "episode_[0-9][0-9][0-9][0-9][0-9][0-9]."
_FILES = (f"{_EPISODE}parquet", f"{_EPISODE}*.mp4", "*.unfinished.mp4", ".*.writing/*")
"""Other files of a recording."""


@dataclass(frozen=True, kw_only=True)
class _Recording:
    """Header of a recording."""

    id: str = field(default_factory=lambda: uuid.uuid4().hex)
    episodes: store.Count | None = None
    """Number of episodes of the dataset that it extends; None for a new one."""


def begin(root: Path, earlier_episodes: int | None) -> None:
    """Make the folder of a recording, whose claim is held.

    Args:
        root: Dataset to be made or extended.
        earlier_episodes: Number of episodes of the dataset to extend; None for a new one.

    Raises:
        FileExistsError: `root` exists or may not be replaced by a longer dataset, an
            interrupted recording of it holds episodes, or a foreign folder has its name.
    """
    root, staging = store.resolved(root), staging_folder(root)
    if staging.is_dir() and not _is_recording(staging):
        raise FileExistsError(
            f"{staging} is no interrupted recording and is not touched: move it away, or "
            f"choose another name than {root.name}"
        )
    if staging.is_dir() and (_is_done(root, staging) or not _has_episodes(staging)):
        discard(staging)  # it holds nothing that the dataset lacks
    if earlier_episodes is None and os.path.lexists(root):
        raise FileExistsError(
            f"{root} already exists: choose another folder, remove it, or append to it "
            f"(append=True)"
        )
    try:
        staging.mkdir()
    except FileExistsError:
        raise FileExistsError(
            f"{staging} holds a recording that was interrupted: "
            f"{recovery_advice(root)} makes a dataset of its saved episodes; remove it to "
            f"start anew"
        ) from None
    store.write_json(staging / _RECORDING, _Recording(episodes=earlier_episodes))


def finish(root: Path, claim: store.Claim) -> None:
    """Make or extend a dataset from its recording, then remove the recording.

    Raises:
        DatasetError: No episode was saved for a new dataset.
        FileExistsError: Another dataset has the name.
    """
    root, staging = store.resolved(root), staging_folder(root)
    if not _is_done(root, staging):
        header = _read_header(staging)
        episodes = header.episodes
        if not _has_episodes(staging):
            discard(staging)
            if episodes is None:
                raise DatasetError("no episode was saved, so there is no dataset", file=root)
            return
        if episodes is None and os.path.lexists(root):
            raise FileExistsError(
                f"{root} already exists: remove {staging} if it is the same recording, or move "
                f"{root} away to make a dataset of it"
            )
        paths = staged_paths(staging, episodes or 0)
        with store.replacing(
            claim,
            store.DATASET,
            overwrite=episodes is not None,
            others="keep",
            source=header.id,
        ) as new:
            assemble(paths, new, earlier=None if episodes is None else root)
    discard(staging)


def recover_dataset(root: str | Path) -> Path:
    """Make the dataset of an interrupted recording from its saved episodes.

    Episodes recorded to extend a dataset are appended to it; if none was saved, the dataset
    stays as it was.

    Args:
        root: Folder of the dataset that was being recorded.

    Returns:
        The same folder, now a dataset.

    Raises:
        BusyError: The recording is still going on.
        FileNotFoundError: There is no recording of that name.
        FileExistsError: Another dataset has the name.
        DatasetError: The recording held no saved episode; it is removed.
    """
    root = Path(root)
    if not _is_recording(staging_folder(root)):
        raise FileNotFoundError(f"no interrupted recording at {staging_folder(root)}")
    with store.Claim(root) as claim:
        finish(root, claim)
    return root


def recover_all(path: str | Path) -> list[str]:
    """Repair everything that interrupted programs left at a path and below it.

    Interrupted recordings become datasets, interrupted replacements are finished, and
    unfinished files are removed. Files that are still being written below `path` are left
    alone.

    Args:
        path: A dataset, folder of results or model, or a folder of such things.

    Returns:
        Actions taken, in words.

    Raises:
        BusyError: `path` itself is being written.
    """
    path = store.resolved(path)
    done = store.recover(path)
    suffix = staging_folder(path).name.removeprefix(path.name)
    for staging in [staging_folder(path), *path.glob(f"**/*{suffix}")]:
        if not _is_recording(staging):
            continue
        root = staging.with_name(staging.name.removesuffix(suffix))
        try:
            recover_dataset(root)
        except (store.BusyError, DatasetError, FileExistsError) as error:
            done.append(str(error))
        else:
            done.append(f"{root}: made from the saved episodes of an interrupted recording")
    return done


def discard(staging: Path) -> None:
    """Remove the folder of a recording, but no foreign file in it."""
    # The header goes last: it tells that the rest is not needed, if this is interrupted too.
    store.delete_files(staging, _FILES)
    if not store.delete_files(staging, [_RECORDING]):
        kept = (staging.with_name(f"{staging.name}.kept{n or ''}") for n in itertools.count())
        staging.rename(next(path for path in kept if not os.path.lexists(path)))


def _read_header(staging: Path) -> _Recording:
    """Header of a recording; one without was interrupted before it was written."""
    path = staging / _RECORDING
    if not path.is_file():
        store.write_json(path, _Recording())
    return store.read_json(path, _Recording, "move the recording away")


def _is_recording(staging: Path) -> bool:
    """True for the folder of a recording: its header is written first and removed last."""
    if not staging.is_dir():
        return False
    if (staging / _RECORDING).is_file():
        return True
    unnamed = (".writing", ".unfinished.mp4")
    return all(path.name.endswith(unnamed) for path in staging.iterdir())


def _has_episodes(staging: Path) -> bool:
    return any(staging.glob("episode_*.parquet"))


def _is_done(root: Path, staging: Path) -> bool:
    """True if the dataset holds the recorded episodes and only the recording remains."""
    named = root.is_dir() and (staging / _RECORDING).is_file()
    return named and store.source_of(root) == _read_header(staging).id
