"""From saved episodes to a dataset, however often that is broken off.

A recording lives in `NAME.recording/` and says there which one it is, and to how many episodes
it is appended (`recording.json`). The dataset made of it keeps that name, so that a recording
which ended between the two last steps is not taken for another.
"""

import itertools
import json
import os
import uuid
from pathlib import Path
from typing import Any

from hrc_learn.demos.format.dataset_folder import open_folder
from hrc_learn.demos.issue import DatasetError
from hrc_learn.demos.write.assembly import assemble
from hrc_learn.demos.write.staging import staged_paths, staging_folder
from hrc_learn.store import (
    DATASET,
    BusyError,
    Claim,
    delete_files,
    new_file,
    recover,
    replacing,
    resolved,
    source_of,
)

_RECORDING = "recording.json"
_FILES = (
    "episode_*",
    "*.unfinished.mp4",
    ".*.writing/*",
    # Of versions that assembled the dataset in there.
    "appended_to.json",
    "*.unfinished",
    "dataset/*",
    *(f"earlier/{file}" for file in DATASET.files),
)
"""What a recording holds besides."""


def claim_recording(root: Path) -> Claim:
    """The sole right to record a dataset.

    Raises:
        BusyError: Another process is recording it.
    """
    staging_folder(root).parent.mkdir(parents=True, exist_ok=True)
    return Claim(root)


def begin(root: Path, earlier_episodes: int | None) -> Path:
    """Make the folder of a recording, whose claim is held.

    Args:
        root: The dataset it is to become, or to be appended to.
        earlier_episodes: Episodes of the dataset it is appended to; None: a new one.

    Raises:
        FileExistsError: `root` is already there, or may not be replaced by a longer one, or an
            interrupted recording of it holds episodes.
    """
    root, staging = resolved(root), staging_folder(root)
    if staging.is_dir() and (_is_done(root, staging) or not _episodes(staging)):
        discard(staging)  # nothing in it that the dataset lacks
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
            f"hrc_learn.demos.recover_dataset({str(root)!r}) makes a dataset of its saved "
            f"episodes; remove it to start anew"
        ) from None
    _write(staging, earlier_episodes)
    return staging


def recover_dataset(root: str | Path) -> Path:
    """Make the dataset of a recording that was broken off, from the episodes it had saved.

    Episodes that were being appended to a dataset are added to it; until then, and if none
    was saved, it stays as it was.

    Args:
        root: Folder that the recording was to become, or to be appended to.

    Returns:
        The same folder, now a dataset.

    Raises:
        BusyError: The recording is still going on.
        FileNotFoundError: There is no recording of that name.
        FileExistsError: There is a dataset of that name, and the recording was none of it.
        DatasetError: The recording held no saved episode; it is removed.
    """
    root = Path(root)
    if not staging_folder(root).is_dir():
        raise FileNotFoundError(f"no interrupted recording at {staging_folder(root)}")
    with Claim(root) as claim:
        finish(root, claim)
    return root


def finish(root: Path, claim: Claim) -> None:
    """Make or lengthen a dataset from its recording, and remove that; as `recover_dataset`."""
    root, staging = resolved(root), staging_folder(root)
    _bring_back_earlier(root, staging)
    if not _is_done(root, staging):
        recording = _read(staging)
        episodes = recording["episodes"]
        if not _episodes(staging):
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
        with replacing(
            claim,
            DATASET,
            overwrite=episodes is not None,
            others="keep",
            source=recording["id"],
        ) as new:
            assemble(paths, new, earlier=None if episodes is None else root)
    discard(staging)


def discard(staging: Path) -> None:
    """Remove the folder of a recording, but nothing that somebody else put there."""
    # Last what tells that the rest is not needed any more: this may be broken off too.
    delete_files(staging, _FILES)
    if not delete_files(staging, [_RECORDING]):
        kept = (staging.with_name(f"{staging.name}.kept{n or ''}") for n in itertools.count())
        staging.rename(next(path for path in kept if not os.path.lexists(path)))


def recover_all(path: str | Path) -> list[str]:
    """Mend whatever interrupted programs left, of a path and of anything below it.

    Interrupted recordings become datasets, interrupted replacements are finished, and what was
    left unfinished is removed. What is still being written below `path` is left alone.

    Args:
        path: A dataset, folder of results or model, or a folder of such things.

    Returns:
        What was done, in words.

    Raises:
        BusyError: `path` itself is being written.
    """
    path = resolved(path)
    done = recover(path)
    suffix = staging_folder(path).name.removeprefix(path.name)
    for staging in [staging_folder(path), *path.glob(f"**/*{suffix}")]:
        if not staging.is_dir():
            continue
        root = staging.with_name(staging.name.removesuffix(suffix))
        try:
            recover_dataset(root)
        except (BusyError, DatasetError, FileExistsError) as error:
            done.append(str(error))
        else:
            done.append(f"{root}: made of what an interrupted recording had saved")
    # Earlier versions gave what they were deleting such a name.
    for folder in (path.parent, path):
        for rest in folder.glob(f".{path.name if folder != path else '*'}{suffix}.done"):
            delete_files(rest, _FILES)
            done.append(f"{rest}: removed")
    return done


def _read(staging: Path) -> dict[str, Any]:
    """Name of a recording, and of how many episodes the dataset is that it is appended to."""
    path = staging / _RECORDING
    if not path.is_file():  # of a version that did not name them
        mark, episodes = staging / "appended_to.json", None
        if mark.is_file():
            episodes = _read_count(mark)
        _write(staging, episodes)
    return json.loads(path.read_text(encoding="utf-8"))


def _write(staging: Path, earlier_episodes: int | None) -> None:
    with new_file(staging / _RECORDING) as part:
        content = {"id": uuid.uuid4().hex, "episodes": earlier_episodes}
        part.write_text(json.dumps(content), encoding="utf-8")


def _episodes(staging: Path) -> bool:
    return any(staging.glob("episode_*.parquet"))


def _is_done(root: Path, staging: Path) -> bool:
    """Whether the dataset holds what was recorded: only the recording was not yet removed."""
    if not root.is_dir():
        return False
    if (staging / _RECORDING).is_file():
        return source_of(root) == _read(staging)["id"]
    mark = staging / "appended_to.json"  # of a version that did not name recordings
    return mark.is_file() and len(open_folder(root).episodes) > _read_count(mark)


def _read_count(mark: Path) -> int:
    return json.loads(mark.read_text(encoding="utf-8"))["episodes"]


def _bring_back_earlier(root: Path, staging: Path) -> None:
    """Of a version that kept the dataset in there while the longer one took its place."""
    earlier = staging / "earlier"
    if earlier.is_dir() and not os.path.lexists(root):
        earlier.rename(root)
