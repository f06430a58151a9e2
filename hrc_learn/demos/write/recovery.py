"""From saved episodes to a dataset, however often that is broken off.

A recording lives in `NAME.recording/`. One that is appended to a dataset says there how many
episodes the dataset has (`APPENDED_TO`); while the longer dataset takes its place, the dataset
itself waits in the same folder.
"""

import json
import shutil
from pathlib import Path

from hrc_learn.demos.format.dataset_folder import open_folder
from hrc_learn.demos.write.assembly import assemble
from hrc_learn.demos.write.staging import staged_paths, staging_folder

_APPENDED_TO = "appended_to.json"
_ASSEMBLED = "dataset"
_EARLIER = "earlier"


def begin(root: Path, earlier_episodes: int | None) -> Path:
    """Claim the folder of a recording.

    Args:
        root: The dataset it is to become, or to be appended to.
        earlier_episodes: Episodes of the dataset it is appended to; None: a new one.

    Raises:
        FileExistsError: `root`, or an interrupted recording of it, is already there.
    """
    if earlier_episodes is None and root.exists():
        raise FileExistsError(
            f"{root} already exists: choose another folder, remove it, or append to it "
            f"(append=True)"
        )
    staging = staging_folder(root)
    try:
        staging.mkdir(parents=True)
    except FileExistsError:
        raise FileExistsError(
            f"{staging} holds a recording that is still going on or was interrupted: "
            f"hrc_learn.demos.recover_dataset({str(root)!r}) makes a dataset of its saved "
            f"episodes; remove it to start anew"
        ) from None
    if earlier_episodes is not None:
        (staging / _APPENDED_TO).write_text(json.dumps({"episodes": earlier_episodes}))
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
        FileNotFoundError: There is no recording of that name.
        FileExistsError: There is a dataset of that name, and the recording was none of it.
        DatasetError: The recording holds no saved episode.
    """
    root = Path(root)
    staging = staging_folder(root)
    if not staging.is_dir():
        raise FileNotFoundError(f"no interrupted recording at {staging}")
    mark = staging / _APPENDED_TO
    if mark.is_file():
        _append(root, staging, json.loads(mark.read_text())["episodes"])
    else:
        _create(root, staging)
    discard(staging)
    return root


def discard(staging: Path) -> None:
    """Remove the folder of a recording; broken off, it leaves nothing that looks like one."""
    done = staging.with_name(f".{staging.name}.done")
    shutil.rmtree(done, ignore_errors=True)  # of an earlier attempt
    staging.rename(done)
    shutil.rmtree(done)


def _create(root: Path, staging: Path) -> None:
    if root.exists():
        raise FileExistsError(
            f"{root} already exists: remove {staging} if it is the same recording, or move "
            f"{root} away to make a dataset of it"
        )
    _assemble(staging, None, 0).rename(root)


def _append(root: Path, staging: Path, episodes: int) -> None:
    earlier = staging / _EARLIER
    if earlier.exists() and not root.exists():
        earlier.rename(root)  # broken off between the two steps below
    if len(open_folder(root).episodes) > episodes:
        return  # broken off after them
    if not any(staging.glob("episode_*.parquet")):
        return
    assembled = _assemble(staging, root, episodes)
    root.rename(earlier)
    assembled.rename(root)


def _assemble(staging: Path, earlier: Path | None, first: int) -> Path:
    paths = staged_paths(staging, first)
    assembled = staging / _ASSEMBLED
    shutil.rmtree(assembled, ignore_errors=True)  # of an earlier attempt
    assemble(paths, assembled, earlier=earlier)
    return assembled
