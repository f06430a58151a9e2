"""Locks on files, and what lies in folders: listed, brought to disk, carried over, deleted."""

import contextlib
import errno
import filecmp
import json
import os
import shutil
import socket
from collections.abc import Iterable
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, TextIO

# Of file systems that have no locks, such as some network ones. Not every system has each.
_NO_LOCKS = {
    getattr(errno, name)
    for name in ("ENOTSUP", "EOPNOTSUPP", "ENOSYS", "ENOLCK", "EINVAL")
    if hasattr(errno, name)
}


def try_lock(file: TextIO) -> bool:
    """Lock an open file, unless another process has done so."""
    try:
        if os.name == "nt":
            import msvcrt

            # One byte far behind the text: others must be able to read that.
            file.seek(2**30)
            msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)  # pyright: ignore
        else:
            import fcntl

            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno not in _NO_LOCKS:
            return False
        # The best there is then: to believe what the file says of its writer.
        file.seek(0)
        number = file.read().partition(" ")[0]
        return not (number.isdecimal() and is_alive(int(number)))
    return True


def sign(file: TextIO) -> None:
    """Say in a locked file who holds it."""
    file.seek(0)
    file.truncate()
    file.write(f"{os.getpid()} {socket.gethostname()}\n")
    file.flush()


def holder(path: Path) -> str:
    """Who holds the lock on a file, in words."""
    with contextlib.suppress(OSError):
        number, _, host = path.read_text(encoding="utf-8").strip().partition(" ")
        if number:
            return f"process {number}" + ("" if host == socket.gethostname() else f" on {host}")
    return "another process"


def is_at(file: TextIO, path: Path) -> bool:
    """Whether an open file still has that name."""
    try:
        return os.path.samestat(os.fstat(file.fileno()), os.stat(path))
    except FileNotFoundError:
        return False


def is_alive(pid: int) -> bool:
    """Whether a process of this machine is running, as far as can be told."""
    if os.name == "nt":
        return True  # signal 0 is no question there: it would end the process
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except (PermissionError, OverflowError):
        pass
    return True


def entries(folder: Path) -> set[str]:
    """Everything in a folder, by relative path with /; folders end in one, links are files."""
    found = set()
    for place, folders, files in os.walk(folder):
        base = Path(place).relative_to(folder)
        for name in (*folders, *files):
            entry = (base / name).as_posix()
            is_folder = name in folders and not (Path(place) / name).is_symlink()
            found.add(f"{entry}/" if is_folder else entry)
    return found


def dump_json(path: Path, content: object) -> None:
    """Write a file of JSON; what JSON does not know becomes text."""
    path.write_text(json.dumps(content, indent=2, default=str) + "\n", encoding="utf-8")


def read_json(path: Path) -> Any:
    """Content of a file of JSON; None where there is none."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None


def sync_tree(folder: Path) -> None:
    """Bring a folder and all that is in it to disk."""
    for place, _, files in os.walk(folder):
        for name in files:
            if not (Path(place) / name).is_symlink():
                sync_file(Path(place) / name)
        sync_folder(Path(place))


def sync_file(path: Path) -> None:
    """Bring the contents of a file to disk."""
    # Windows syncs only what is open for writing, others also what may not be written.
    with path.open("r+b" if os.name == "nt" else "rb") as file:
        os.fsync(file.fileno())


def sync_folder(path: Path) -> None:
    """Bring the names in a folder to disk, where the system can."""
    if os.name == "nt":
        return
    descriptor = os.open(path, os.O_RDONLY)
    try:
        # Some network file systems refuse, and keep names in order by themselves.
        with contextlib.suppress(OSError):
            os.fsync(descriptor)
    finally:
        os.close(descriptor)


def carry_over(names: Iterable[str], source: Path, target: Path) -> set[str]:
    """Give entries of a folder a second name in another.

    Returns:
        Those that are there now: not a file whose name is taken by one of other content.
    """
    carried = set()
    for entry in sorted(names):  # folders before what is in them
        here, there = source / entry, target / entry
        if entry.endswith("/"):
            there.mkdir(exist_ok=True, parents=True)
        elif not os.path.lexists(there):
            there.parent.mkdir(exist_ok=True, parents=True)
            try:
                os.link(here, there, follow_symlinks=False)
            except OSError:  # a file system without links
                shutil.copy2(here, there, follow_symlinks=False)
        elif here.is_symlink() or not filecmp.cmp(here, there, shallow=False):
            continue
        carried.add(entry)
    return carried


def delete(place: Path) -> None:
    """Delete a file or folder, with all that is in it."""
    if place.is_dir() and not place.is_symlink():
        shutil.rmtree(place)
    else:
        place.unlink()


def delete_entries(folder: Path, names: Iterable[str]) -> None:
    """Delete these entries of a folder, and the folder if nothing else is in it."""
    # Only what is found in the folder: a list of another origin may say "../elsewhere".
    for entry in sorted(entries(folder) & set(names), reverse=True):  # what is inside first
        with contextlib.suppress(OSError):  # what cannot be deleted stays, and so is seen
            if entry.endswith("/"):
                (folder / entry).rmdir()
            else:
                (folder / entry).unlink()
    with contextlib.suppress(OSError):
        folder.rmdir()


def delete_files(folder: Path, patterns: Iterable[str]) -> bool:
    """Delete a folder of temporary files, but no file that does not look like one of them.

    Args:
        folder: Which.
        patterns: Of relative paths with /; * matches / too.

    Returns:
        Whether the folder is gone.
    """
    patterns = tuple(patterns)
    delete_entries(
        folder, [e for e in entries(folder) if e.endswith("/") or matches(e, patterns)]
    )
    return not folder.exists()


def matches(entry: str, patterns: Iterable[str]) -> bool:
    """Whether an entry is of one of these patterns."""
    return any(fnmatchcase(entry, pattern) for pattern in patterns)
