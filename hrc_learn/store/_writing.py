"""Write files and folders so that they are complete or absent.

A `Claim` is the exclusive right to write a path. A claim replaces the content in steps, so that
`recover` can complete or undo what a killed process has begun.
"""

import contextlib
import itertools
import os
import time
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, ClassVar, TextIO

from hrc_learn.store import _folder as disk
from hrc_learn.store._folder import MADE_BY, MANIFEST, RESULTS, SUFFIX, Kind
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
        new: Path of the new content, in the workspace.
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
        # A workspace inside another one is synced to disk together with the outer one.
        self._sync = not any(_is_workspace(parent.name) for parent in self.target.parents)
        self._old = self.workspace / _OLD
        self._owned = self.workspace / _OWNED
        with disk.naming(self.target):
            self._lock = self._acquire(wait)
            try:
                disk.sign(self._lock)
                self.mended = self.clear()
            except BaseException:
                with contextlib.suppress(OSError):
                    self.release()
                raise

    def __enter__[C: Claim](self: C) -> C:
        return self

    def __exit__(self, *_: object) -> None:
        self.release()

    def release(self) -> None:
        """Remove uncommitted content, and release the lock."""
        if self._lock.closed:
            return
        try:
            self.clear()
            # Delete the file while it is locked: a process that has just opened it notices this
            # and retries.
            (self.workspace / _LOCK).unlink(missing_ok=True)
        finally:
            self._lock.close()
        with contextlib.suppress(OSError):  # another process may already use the workspace
            self.workspace.rmdir()

    def require_replaceable(
        self, kind: Kind, overwrite: bool, *, foreign: bool = False
    ) -> None:
        """Check that the target may be written.

        Args:
            kind: Kind of the new folder.
            overwrite: Allow an older folder of this kind to be replaced.
            foreign: Allow the older folder to contain foreign files, whatever its kind.

        Raises:
            InTheWayError: The target exists and may not be replaced.
        """
        path = self.target
        if not os.path.lexists(path):
            return
        if not overwrite:
            raise InTheWayError(f"{path} exists: choose another folder, or allow overwriting")
        owned = disk.owned_entries(path, kind)
        if owned is None:
            raise InTheWayError(
                f"{path} is not a {kind.name} written by hrc_learn (these have a {MANIFEST}), "
                f"so it is not overwritten: choose another folder"
            )
        others = sorted(disk.entries(path) - owned)
        if others and not (foreign or kind.files):
            more = f" and {len(others) - 1} more" if len(others) > 1 else ""
            raise InTheWayError(
                f"{path} holds files that are not part of the {kind.name} and would be lost, "
                f"{others[0]}{more}: move them elsewhere, or choose another folder"
            )

    def commit_file(self, part: Path) -> None:
        """Move a finished file from the workspace to the target."""
        if self._sync:
            disk.sync_file(part)
        os.replace(part, self.target)
        if self._sync:
            disk.sync_folder(self.target.parent)

    def commit(self, kind: Kind, overwrite: bool, source: str) -> None:
        """Move the finished folder `new` to the target.

        Args:
            kind: Kind of the folder.
            overwrite: Replace an older folder.
            source: Source kept in the manifest, see `source_of`.

        Raises:
            FileNotFoundError: Nothing was written.
            InTheWayError: The target exists and may not be replaced.
        """
        if not self.new.is_dir():
            raise FileNotFoundError(f"nothing was written for {self.target}")
        try:
            # Files added to the target meanwhile are set aside by `clear`.
            self.require_replaceable(kind, overwrite, foreign=True)
        except InTheWayError as error:
            error.add_note(f"The new content is in {self.set_aside(self.new, 'new')}.")
            raise
        replaces = os.path.lexists(self.target)
        disk.write_manifest(self.new, kind, source)
        if replaces:
            owned = disk.owned_entries(self.target, kind) or set()
            if kind.files:  # carried over after the manifest, which must not list them
                foreign = disk.entries(self.target) - owned
                owned |= disk.carry_over(foreign, self.target, self.new)
            self._owned.write_text(json_text(sorted(owned)), encoding="utf-8")
        if self._sync:
            disk.sync_tree(self.workspace)
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
                    done.append(f"{self.set_aside(place, word)}: left over from a replacement")
            else:
                self.rename(self.new, self.target)
                done.append(f"{name}: finished an interrupted replacement")
        if os.path.lexists(self._old):
            with contextlib.suppress(OSError, ValueError):  # without a list nothing is deleted
                disk.delete_entries(self._old, map(str, read_json(self._owned, list)))
            if os.path.lexists(self._old):
                kept = self.set_aside(self._old, "kept")
                warnings.warn(f"{kept} holds the foreign files of {name}", stacklevel=2)
                done.append(f"{kept}: foreign files of {name}")
            else:
                done.append(f"{name}: removed the replaced folder")
        rest = [place for place in self.workspace.iterdir() if place.name != _LOCK]
        for place in rest:
            disk.delete(place)
        if any(place.name == _NEW for place in rest):
            done.append(f"{name}: removed unfinished content")
        return done

    def rename(self, source: Path, target: Path) -> None:
        """Rename between the workspace and its parent folder, and sync both to disk."""
        os.rename(source, target)
        if self._sync:
            disk.sync_folder(self.target.parent)
            disk.sync_folder(self.workspace)

    def set_aside(self, place: Path, word: str) -> Path:
        """Move an entry of the workspace to a visible name next to the target."""
        names = itertools.chain([word], (f"{word}-{n}" for n in itertools.count(2)))
        free = (self.target.with_name(f"{self.target.name}.{name}") for name in names)
        there = next(path for path in free if not os.path.lexists(path))
        self.rename(place, there)
        return there

    def _acquire(self, wait: bool) -> TextIO:
        path = self.workspace / _LOCK
        while True:
            _require_ours(self.workspace)
            with contextlib.suppress(FileExistsError):
                self.workspace.mkdir()
            try:
                file = path.open("a+", encoding="utf-8")
            except FileNotFoundError:
                continue  # the last writer has just removed the workspace
            try:
                if not disk.try_lock(file):
                    if not wait:
                        raise BusyError(
                            f"{self.target} is being written by {disk.holder(path)}: wait "
                            f"until that ends, or choose another place"
                        )
                    time.sleep(_POLL)
                elif disk.is_at(file, path):
                    return file
            except BaseException:
                file.close()
                raise
            file.close()


def resolved(path: str | os.PathLike[str]) -> Path:
    """Absolute path without symbolic links; nothing has to exist there."""
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
        names = {"?"} if workspace.is_symlink() else set()
    except NotADirectoryError:
        names = {"?"}
    # Checked again: another process may just have removed its lock and the workspace.
    if names and _LOCK not in names and os.path.lexists(workspace):
        raise InTheWayError(f"{workspace} is not a workspace of hrc_learn: move it elsewhere")


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
        # Skip paths that are in use, foreign or not writable.
        with contextlib.suppress(FileExistsError, PermissionError):
            done += _recover_one(other)
    return done


def settle(path: str | os.PathLike[str]) -> None:
    """Complete an interrupted replacement that left nothing at `path`; call this before
    reading.
    """
    place = resolved(path)
    while not place.exists():
        if _is_interrupted(place):
            # Without write access, or while another process writes, nothing can be recovered.
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


@contextlib.contextmanager
def new_file(path: str | os.PathLike[str] | Claim) -> Iterator[Path]:
    """Context for writing a file in a temporary folder; the complete file moves to its path.

    Args:
        path: Path of the file, whose folder must exist, or a claim to the path. A claim is not
            released. An existing file is replaced.

    Yields:
        Path to write to, with the same file name.

    Raises:
        BusyError: Another process is writing this file.
        InTheWayError: There is a folder of that name.
    """
    if not isinstance(path, Claim) and _is_device(path):
        with disk.naming(path):
            yield Path(path)  # such as /dev/stdout, which cannot be replaced
        return
    with _claimed(path) as claim:
        if claim.target.is_dir():
            raise InTheWayError(f"{claim.target} is a folder: choose another file")
        claim.new.mkdir()
        part = claim.new / claim.target.name
        yield part
        claim.commit_file(part)


@contextlib.contextmanager
def replacing(
    path: str | os.PathLike[str] | Claim,
    kind: Kind,
    overwrite: bool = False,
    *,
    source: str = "",
) -> Iterator[Path]:
    """Context for writing a folder in a temporary place; the complete folder moves to its path.

    Args:
        path: Path of the folder, or a claim to the path. A claim is not released.
        kind: Kind of the folder.
        overwrite: Replace an older folder of the same kind; other folders are never replaced.
        source: Identifier of the source, for `source_of`.

    Yields:
        Path to write to, which does not exist yet.

    Raises:
        BusyError: Another process is writing this folder.
        InTheWayError: `path` exists and may not be replaced.
    """
    if not isinstance(path, Claim):
        resolved(path).parent.mkdir(parents=True, exist_ok=True)
    with _claimed(path) as claim:
        claim.require_replaceable(kind, overwrite)
        yield claim.new
        claim.commit(kind, overwrite, source)


@contextlib.contextmanager
def new_folder(
    path: str | os.PathLike[str], made_by: Mapping[str, Any], overwrite: bool = False
) -> Iterator[Path]:
    """Context for writing results in a temporary folder, which moves to its path when complete.

    Args:
        path: Path of the folder.
        made_by: Inputs of the results, saved in the folder as JSON. Values without a JSON type
            are saved as text.
        overwrite: Replace an older folder of results.

    Yields:
        Empty folder to write to.

    Raises:
        BusyError: Another process is writing this folder.
        InTheWayError: `path` exists and may not be replaced.
    """
    inputs = json_text(made_by)  # converted first: an error after the work would lose the work
    with replacing(path, RESULTS, overwrite) as folder:
        folder.mkdir()
        yield folder
        (folder / MADE_BY).write_text(inputs, encoding="utf-8")


def read_made_by(folder: str | os.PathLike[str]) -> dict[str, Any]:
    """Inputs of a folder of results.

    Raises:
        FileNotFoundError: The folder does not record its inputs.
    """
    settle(folder)
    return read_json(Path(folder) / MADE_BY, dict, "repeat the command that made the folder")


def write_text(path: str | Path, text: str) -> None:
    """Write a text file in UTF-8; its folder is created if missing."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    with new_file(path) as part:
        part.write_text(text, encoding="utf-8")


def write_json(path: str | Path, content: object) -> None:
    """Write a JSON file; its folder is created if missing.

    Args:
        path: File to write.
        content: Dataclass, mapping or list. Arrays and tensors become lists, non-finite numbers
            become null, other objects become text.
    """
    write_text(path, json_text(content))


class JsonFile:
    """Base of a dataclass that is saved as one JSON file with the same fields."""

    ADVICE: ClassVar[str] = "fit it again"
    """Remedy for a damaged file, the end of the error message."""

    def save(self, path: str | Path) -> None:
        """Write the file, completely or not at all."""
        write_json(path, self)

    @classmethod
    def load[S: "JsonFile"](cls: type[S], path: str | Path) -> S:
        """Read a file that `save` wrote.

        Raises:
            FileNotFoundError: There is no such file.
            ValueError: An entry is missing, of the wrong type, not finite or out of its range.
        """
        return read_json(path, cls, cls.ADVICE)


@contextlib.contextmanager
def _claimed(path: str | os.PathLike[str] | Claim) -> Iterator[Claim]:
    """Claim to a path for the duration of the context; a given claim is not released."""
    if not isinstance(path, Claim):
        with disk.naming(path), Claim(path) as claim:
            yield claim
        return
    try:
        with disk.naming(path.target):
            yield path
    finally:
        path.clear()


def _is_device(path: str | os.PathLike[str]) -> bool:
    return os.path.exists(path) and not (os.path.isfile(path) or os.path.isdir(path))
