"""Mending what interrupted writers left."""

import contextlib
import os
import re
from collections.abc import Iterator
from pathlib import Path

from hrc_learn.store._claim import SUFFIX, Claim, resolved, workspace_of
from hrc_learn.store._disk import delete, delete_entries
from hrc_learn.store._lock import is_alive
from hrc_learn.store._ownership import DATASET, RESULTS, owned_entries

# Workspaces, and what versions without them left: .NAME.partial.PID and .NAME.old.PID.
_HIDDEN = re.compile(
    rf"\.(?P<name>.+?)({re.escape(SUFFIX)}"
    r"|\.(?P<what>partial|old)\.(?P<pid>\d+)(\.recording)?)"
)


def recover(path: str | os.PathLike[str]) -> list[str]:
    """Mend what interrupted writers left, of a path and of anything below it.

    Args:
        path: What was being written, or a folder of such things. What is still being written
            below it is left alone.

    Returns:
        What was done, in words.

    Raises:
        BusyError: `path` itself is being written.
    """
    target = resolved(path)
    done = _recover_one(target) if _is_interrupted(target) else []
    for other in list(_interrupted_below(target)):
        # In use, or of other origin, or not ours to write.
        with contextlib.suppress(FileExistsError, PermissionError):
            done += _recover_one(other)
    return done


def settle(path: str | os.PathLike[str]) -> None:
    """Finish an interrupted replacement that has left nothing at `path`, for who reads it."""
    place = resolved(path)
    while not place.exists() and place != place.parent:
        if _is_interrupted(place):
            # Who may not mend it, or comes while it is written, sees that nothing is there.
            with contextlib.suppress(OSError):
                _recover_one(place)
        place = place.parent


def mend_earlier_versions(claim: Claim) -> list[str]:
    """Mend what a killed process of a version without workspaces left of a folder."""
    done = []
    for place, what in _of_earlier_versions(claim.target):
        if what == "partial":
            delete(place)
            done.append(f"{place}: removed, it was left unfinished")
        elif not os.path.lexists(claim.target):
            claim.rename(place, claim.target)
            done.append(f"{claim.target}: brought back from an interrupted replacement")
        else:
            for kind in (RESULTS, DATASET):
                delete_entries(place, owned_entries(place, kind) or ())
            done.append(f"{place}: removed, it was replaced")
            if place.exists():
                done[-1] = f"{claim.set_aside(place, 'kept')}: from an interrupted replacement"
    return done


def _recover_one(target: Path) -> list[str]:
    with Claim(target) as claim:
        return claim.mended + mend_earlier_versions(claim)


def _is_interrupted(target: Path) -> bool:
    return bool(target.name) and (
        workspace_of(target).is_dir() or bool(_of_earlier_versions(target))
    )


def _interrupted_below(folder: Path) -> Iterator[Path]:
    for place, folders, _ in os.walk(folder):
        for name in list(folders):
            match = _HIDDEN.fullmatch(name)
            if match:
                folders.remove(name)  # what is in there goes with it
                yield Path(place) / match["name"]


def _of_earlier_versions(target: Path) -> list[tuple[Path, str]]:
    """Temporary folders of dead processes, and which of the two each is."""
    found = []
    with contextlib.suppress(OSError), os.scandir(target.parent) as places:
        for place in places:
            match = _HIDDEN.fullmatch(place.name)
            if not match or match["name"] != target.name or not match["what"]:
                continue
            if not is_alive(int(match["pid"])):
                found.append((Path(place.path), match["what"]))
    return found
