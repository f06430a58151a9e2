"""Exclusive right to write a path, the steps of a replacement, and its recovery."""

import contextlib
import itertools
import os
import time
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import TextIO

from hrc_learn.store._folder import (
    MANIFEST,
    SUFFIX,
    Kind,
    carry_over,
    delete,
    delete_entries,
    entries,
    holder,
    is_at,
    naming,
    owned_entries,
    sign,
    sync_file,
    sync_folder,
    sync_tree,
    try_lock,
    write_manifest,
)
from hrc_learn.store._reading import json_text, read_json

_LOCK, _NEW, _OLD, _OWNED = "lock", "new", "old", "owned.json"
# Time between two attempts at a lock [s]: short compared with any work under a lock.
_POLL = 0.05


class InTheWayError(FileExistsError, ValueError):
    """The path is taken by something that may not be replaced."""


class BusyError(FileExistsError):
    """Another process is writing to the path."""


class Claim:
    """Exclusive right to write one file or folder, until it is released.

    Attributes:
        target: Path to be written, symbolic links resolved.
        workspace: Folder next to the target.
        new: Place of the new content in the workspace.
        mended: Actions taken on the leftovers of an interrupted writer, in words.
    """

    def __init__(self, path: str | os.PathLike[str], *, wait: bool = False):
        """Take the lock, and complete or remove the leftovers of a killed process.

        Args:
            path: Path to be written; its folder must exist.
            wait: Wait for another writer to end instead of raising.

        Raises:
            BusyError: Another process is writing to the path.
            FileNotFoundError: The folder of the path does not exist.
            InTheWayError: A foreign folder has the name of the workspace.
        """
        self.target = resolved(path)
        if not self.target.parent.is_dir():
            raise FileNotFoundError(f"there is no folder {self.target.parent}")
        self.workspace = workspace_of(self.target)
        self.new = self.workspace / _NEW
        # A workspace inside another one is synced to disk together with that one.
        self._sync = not any(_is_workspace(parent.name) for parent in self.target.parents)
        self._old = self.workspace / _OLD
        self._owned = self.workspace / _OWNED
        with naming(self.target):
            self._lock = self._acquire(wait)
            try:
                sign(self._lock)
                self.mended = self.clear()
            except BaseException:
                with contextlib.suppress(OSError):
                    self.release()
                raise

    def __enter__(self) -> "Claim":
        return self

    def __exit__(self, *_: object) -> None:
        self.release()

    def release(self) -> None:
        """Remove uncommitted content, and let others write."""
        if self._lock.closed:
            return
        try:
            self.clear()
            # Deleted while held: a process that has opened it meanwhile notices and retries.
            (self.workspace / _LOCK).unlink(missing_ok=True)
        finally:
            self._lock.close()
        with contextlib.suppress(OSError):  # another process uses it already
            self.workspace.rmdir()

    def require_replaceable(
        self, kind: Kind, overwrite: bool, *, foreign: bool = False, adopt: bool = False
    ) -> None:
        """Check that the target may be written.

        Args:
            kind: Kind of the new folder.
            overwrite: Allow an older folder of this kind to be replaced.
            foreign: Allow the older folder to hold foreign files.
            adopt: As in `owned_entries`.

        Raises:
            InTheWayError: The target exists and may not be replaced.
        """
        path = self.target
        if not os.path.lexists(path):
            return
        if not overwrite:
            raise InTheWayError(f"{path} exists: choose another folder, or allow overwriting")
        owned = owned_entries(path, kind, adopt=adopt)
        if owned is None:
            raise InTheWayError(
                f"{path} is no {kind.name} of hrc_learn (one has a {MANIFEST}), so it is not "
                f"ours to overwrite: choose another folder"
            )
        others = sorted(entries(path) - owned)
        if others and not foreign:
            more = f" and {len(others) - 1} more" if len(others) > 1 else ""
            raise InTheWayError(
                f"{path} holds more than a {kind.name}, {others[0]}{more}, which would be "
                f"lost: move it elsewhere, or choose another folder"
            )

    def commit_file(self, part: Path) -> None:
        """Move a finished file from the workspace to the target."""
        if self._sync:
            sync_file(part)
        os.replace(part, self.target)
        if self._sync:
            sync_folder(self.target.parent)

    def commit(
        self, kind: Kind, overwrite: bool = False, *, keep: bool = False, source: str = ""
    ) -> None:
        """Move the finished folder `new` to the target.

        Args:
            kind: Kind of the folder.
            overwrite: Replace an older folder.
            keep: Carry foreign files over from the older folder.
            source: Source kept in the manifest, see `source_of`.

        Raises:
            FileNotFoundError: Nothing was written.
            InTheWayError: The target exists and may not be replaced.
        """
        if not self.new.is_dir():
            raise FileNotFoundError(f"nothing was written for {self.target}")
        try:
            # Files added to the target meanwhile are set aside in the end.
            self.require_replaceable(kind, overwrite, foreign=True, adopt=keep)
        except InTheWayError as error:
            error.add_note(f"The new content is in {self.set_aside(self.new, 'new')}.")
            raise
        replaces = os.path.lexists(self.target)
        write_manifest(self.new, kind, source)
        if replaces:
            owned = owned_entries(self.target, kind, adopt=keep) or set()
            if keep:  # after the manifest: carried files are foreign in the new folder too
                owned |= carry_over(entries(self.target) - owned, self.target, self.new)
            self._owned.write_text(json_text(sorted(owned)), encoding="utf-8")
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
        """Complete or undo a replacement, and leave only the lock in the workspace.

        Returns:
            Actions taken, in words.
        """
        done = []
        name = self.target
        if os.path.lexists(self._old) and os.path.lexists(self.new):
            if os.path.lexists(self.target):  # created by others between the renames
                for place, word in ((self._old, "kept"), (self.new, "new")):
                    done.append(f"{self.set_aside(place, word)}: left from a replacement")
            else:
                self.rename(self.new, self.target)
                done.append(f"{name}: finished an interrupted replacement")
        if os.path.lexists(self._old):
            with contextlib.suppress(OSError, ValueError):  # without a list nothing is ours
                delete_entries(self._old, map(str, read_json(self._owned, list)))
            if os.path.lexists(self._old):
                kept = self.set_aside(self._old, "kept")
                warnings.warn(f"{kept} holds the foreign files of {name}", stacklevel=2)
                done.append(f"{kept}: foreign files of {name}")
            else:
                done.append(f"{name}: removed the replaced folder")
        rest = [place for place in self.workspace.iterdir() if place.name != _LOCK]
        for place in rest:
            delete(place)
        if any(place.name == _NEW for place in rest):
            done.append(f"{name}: removed unfinished content")
        return done

    def rename(self, source: Path, target: Path) -> None:
        """Rename between the workspace and its parent folder, and sync both to disk."""
        os.rename(source, target)
        if self._sync:
            sync_folder(self.target.parent)
            sync_folder(self.workspace)

    def set_aside(self, place: Path, word: str) -> Path:
        """Give an entry of the workspace a visible name next to the target."""
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
                continue  # the last writer has just removed the workspace
            try:
                if not try_lock(file):
                    if not wait:
                        raise BusyError(
                            f"{self.target} is being written by {holder(path)}: wait until "
                            f"that ends, or choose another place"
                        )
                    time.sleep(_POLL)
                elif is_at(file, path):
                    return file
            except BaseException:
                file.close()
                raise
            file.close()


def resolved(path: str | os.PathLike[str]) -> Path:
    """Absolute path without symbolic links; it need not exist."""
    return Path(path).resolve()


def _is_workspace(name: str) -> bool:
    return name.startswith(".") and name.endswith(SUFFIX) and name != SUFFIX


def workspace_of(target: Path) -> Path:
    """Workspace of a path."""
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
    # Checked again: another process may just have removed its lock and the workspace.
    if names and _LOCK not in names and os.path.lexists(workspace):
        raise InTheWayError(f"{workspace} is no workspace of hrc_learn: move it elsewhere")


def recover(path: str | os.PathLike[str]) -> list[str]:
    """Complete or remove the leftovers of interrupted writers, at a path and below it.

    Args:
        path: Path that was being written, or a folder of such paths. Paths below it that are
            still being written are left alone.

    Returns:
        Actions taken, in words.

    Raises:
        BusyError: `path` itself is being written.
    """
    target = resolved(path)
    done = _recover_one(target) if _is_interrupted(target) else []
    for other in list(_interrupted_below(target)):
        # In use, foreign, or not writable.
        with contextlib.suppress(FileExistsError, PermissionError):
            done += _recover_one(other)
    return done


def settle(path: str | os.PathLike[str]) -> None:
    """Complete an interrupted replacement that left nothing at `path`, before it is read."""
    place = resolved(path)
    while not place.exists() and place != place.parent:
        if _is_interrupted(place):
            # Without write access, or while it is being written, nothing is there to read.
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
            folders.remove(name)  # workspaces inside belong to this one
            yield Path(place) / name[1 : -len(SUFFIX)]
