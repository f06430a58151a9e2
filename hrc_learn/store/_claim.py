"""The sole right to write something, the steps by which it takes its name, and mending."""

import contextlib
import itertools
import os
import time
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import TextIO

from hrc_learn.store._disk import (
    carry_over,
    delete,
    delete_entries,
    dump_json,
    entries,
    holder,
    is_at,
    read_json,
    sign,
    sync_file,
    sync_folder,
    sync_tree,
    try_lock,
)
from hrc_learn.store._ownership import Kind, owned_entries, write_manifest

SUFFIX = ".writing"
"""End of the name of a workspace."""
_LOCK, _NEW, _OLD, _OWNED = "lock", "new", "old", "owned.json"
# Between two attempts at a lock that is waited for [s]: short beside any work worth a lock.
_POLL = 0.05


class InTheWayError(FileExistsError, ValueError):
    """Something is at the path that may not be replaced."""


class BusyError(FileExistsError):
    """Another process is writing there."""


class Claim:
    """The sole right to write one file or folder, until it is released.

    Attributes:
        target: What is to be written, symbolic links resolved.
        new: Where it takes shape.
        mended: What an interrupted writer had left and what became of it, in words.
    """

    def __init__(self, path: str | os.PathLike[str], *, wait: bool = False):
        """Take the lock, and mend what a killed process has left.

        Args:
            path: What is to be written; its folder must exist.
            wait: Wait for another writer to end instead of raising.

        Raises:
            BusyError: Another process is writing there.
            FileNotFoundError: Its folder does not exist.
            InTheWayError: The workspace's name is taken by a folder of other origin.
        """
        self.target = resolved(path)
        if not self.target.parent.is_dir():
            raise FileNotFoundError(f"there is no folder {self.target.parent}")
        self.workspace = workspace_of(self.target)
        self.new = self.workspace / _NEW
        # What is written inside another workspace is brought to disk with all that is in there.
        self._sync = not any(_is_workspace(parent.name) for parent in self.target.parents)
        self._old = self.workspace / _OLD
        self._owned = self.workspace / _OWNED
        self._lock = self._acquire(wait)
        try:
            self.mended = self.clear()
        except BaseException:
            self._lock.close()
            raise

    def __enter__(self) -> "Claim":
        return self

    def __exit__(self, *_: object) -> None:
        self.release()

    def release(self) -> None:
        """Remove what was not committed, and let others write."""
        if self._lock.closed:
            return
        try:
            self.clear()
            if os.name == "nt":  # which deletes no open file
                self._lock.close()
            # While it is held: who has opened it meanwhile sees it gone, and begins anew.
            (self.workspace / _LOCK).unlink(missing_ok=True)
        finally:
            self._lock.close()
        with contextlib.suppress(OSError):  # another process is in it already
            self.workspace.rmdir()

    def require_replaceable(
        self, kind: Kind, overwrite: bool, *, foreign: bool = False, adopt: bool = False
    ) -> None:
        """Raise InTheWayError if there is something at the target that may not be replaced.

        Args:
            kind: What is to be written.
            overwrite: Whether an older one may be replaced.
            foreign: Whether that may hold files of other origin.
            adopt: Of `owned_entries`.
        """
        path = self.target
        if not os.path.lexists(path):
            return
        if not overwrite:
            raise InTheWayError(
                f"{path} exists: choose another folder, or allow to overwrite it"
            )
        owned = owned_entries(path, kind, adopt=adopt)
        if owned is None:
            raise InTheWayError(
                f"{path} is no {kind.name} of hrc_learn (one has {kind.mark}), so it is not "
                f"ours to overwrite: choose another folder"
            )
        others = sorted(entries(path) - owned)
        if others and not foreign:
            more = f" and {len(others) - 1} more" if len(others) > 1 else ""
            raise InTheWayError(
                f"{path} holds more than a {kind.name}, {others[0]}{more}, which would be "
                f"lost: move that elsewhere, or choose another folder"
            )

    def commit_file(self, part: Path) -> None:
        """Give a finished file in the workspace its name."""
        if self._sync:
            sync_file(part)
        os.replace(part, self.target)
        if self._sync:
            sync_folder(self.target.parent)

    def commit(
        self, kind: Kind, overwrite: bool = False, *, keep: bool = False, source: str = ""
    ) -> None:
        """Give the finished folder `new` its name.

        Args:
            kind: What it is.
            overwrite: Replace an older one.
            keep: Carry files of other origin over from it.
            source: Kept in the manifest, see `source_of`.
        """
        if not self.new.is_dir():
            raise FileNotFoundError(f"nothing was written for {self.target}")
        try:
            # Files that were put there since the work began are kept aside in the end.
            self.require_replaceable(kind, overwrite, foreign=True, adopt=keep)
        except InTheWayError as error:
            error.add_note(f"What was written is in {self.set_aside(self.new, 'new')}.")
            raise
        replaces, owned = os.path.lexists(self.target), set()
        if kind.manifest:
            write_manifest(self.new, kind, source)
        if replaces:
            owned = owned_entries(self.target, kind, adopt=keep) or set()
            if keep:  # after the manifest: they are not ours in the new one either
                owned |= carry_over(entries(self.target) - owned, self.target, self.new)
        if replaces:
            dump_json(self._owned, sorted(owned))
        if self._sync:
            sync_tree(self.workspace)
        if replaces:
            self.rename(self.target, self._old)
        try:
            self.rename(self.new, self.target)
        except OSError:
            if replaces and not os.path.lexists(self.target):
                self.rename(self._old, self.target)
            raise
        self.clear()

    def clear(self) -> list[str]:
        """Finish or undo what is in the workspace, and leave only the lock there.

        Returns:
            What was done, in words.
        """
        done = []
        name = self.target
        if os.path.lexists(self._old) and os.path.lexists(self.new):
            if os.path.lexists(self.target):  # something took the name between the renames
                for place, word in ((self._old, "kept"), (self.new, "new")):
                    done.append(f"{self.set_aside(place, word)}: left from a replacement")
            else:
                self.rename(self.new, self.target)
                done.append(f"{name}: finished an interrupted replacement")
        if os.path.lexists(self._old):
            listed = read_json(self._owned)
            delete_entries(self._old, listed if isinstance(listed, list) else [])
            if os.path.lexists(self._old):
                kept = self.set_aside(self._old, "kept")
                warnings.warn(f"{kept} is what {name} held besides results", stacklevel=2)
                done.append(f"{kept}: held by {name} besides results")
            else:
                done.append(f"{name}: removed the one it replaced")
        rest = [place for place in self.workspace.iterdir() if place.name != _LOCK]
        for place in rest:
            delete(place)
        if any(place.name == _NEW for place in rest):
            done.append(f"{name}: removed what was left unfinished")
        return done

    def rename(self, source: Path, target: Path) -> None:
        """Rename between workspace and the folder around it, and bring both to disk."""
        os.rename(source, target)
        if self._sync:
            sync_folder(self.target.parent)
            sync_folder(self.workspace)

    def set_aside(self, place: Path, word: str) -> Path:
        """Give something in the workspace a visible name beside the target."""
        names = itertools.chain([word], (f"{word}-{n}" for n in itertools.count(2)))
        free = (self.target.with_name(f"{self.target.name}.{name}") for name in names)
        there = next(path for path in free if not os.path.lexists(path))
        self.rename(place, there)
        return there

    def _acquire(self, wait: bool) -> TextIO:
        path = self.workspace / _LOCK
        while True:
            _require_ours(self.workspace)
            self.workspace.mkdir(exist_ok=True)
            try:
                file = path.open("a+", encoding="utf-8")
            except FileNotFoundError:
                continue  # its last writer has just removed the workspace
            try:
                if not try_lock(file):
                    if not wait:
                        raise BusyError(
                            f"{self.target} is being written by {holder(path)}: wait until "
                            f"that ends, or choose another place"
                        )
                    time.sleep(_POLL)
                elif is_at(file, path):
                    sign(file)
                    return file
            except BaseException:
                file.close()
                raise
            file.close()


def resolved(path: str | os.PathLike[str]) -> Path:
    """The absolute path that symbolic links lead to, whether something is there or not."""
    return Path(path).resolve()


def _is_workspace(name: str) -> bool:
    return name.startswith(".") and name.endswith(SUFFIX) and name != SUFFIX


def workspace_of(target: Path) -> Path:
    """Where something is written until it is whole."""
    if not target.name:
        raise InTheWayError(f"{target} cannot be written: name a file or a folder in it")
    return target.with_name(f".{target.name}{SUFFIX}")


def _require_ours(workspace: Path) -> None:
    try:
        names = {place.name for place in workspace.iterdir()}
    except FileNotFoundError:
        return
    except NotADirectoryError:
        names = {"?"}
    # Again, as another process may just have removed its lock and with it all of it.
    if names and _LOCK not in names and os.path.lexists(workspace):
        raise InTheWayError(
            f"{workspace} is in the way, and not of hrc_learn: move it elsewhere"
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


def _recover_one(target: Path) -> list[str]:
    with Claim(target) as claim:
        return claim.mended


def _is_interrupted(target: Path) -> bool:
    return bool(target.name) and workspace_of(target).is_dir()


def _interrupted_below(folder: Path) -> Iterator[Path]:
    for place, folders, _ in os.walk(folder):
        for name in filter(_is_workspace, list(folders)):
            folders.remove(name)  # what is in there goes with it
            yield Path(place) / name[1 : -len(SUFFIX)]
