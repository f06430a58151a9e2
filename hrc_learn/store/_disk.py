"""Disk operations: file locks, listing, syncing, carrying over and deleting."""

import contextlib
import errno
import filecmp
import os
import shutil
import socket
from collections.abc import Iterable, Iterator
from fnmatch import fnmatchcase
from pathlib import Path
from typing import TextIO

# Errors of file systems without locks, such as some network ones; not every OS has each.
_NO_LOCKS = {
    getattr(errno, name)
    for name in ("ENOTSUP", "EOPNOTSUPP", "ENOSYS", "ENOLCK", "EINVAL")
    if hasattr(errno, name)
}


SUFFIX = ".writing"
"""Suffix of a workspace."""
DISK_ERRORS = {
    getattr(errno, name)
    for name in ("ENOSPC", "EDQUOT", "EFBIG", "EROFS", "EACCES", "EPERM", "EIO")
    if hasattr(errno, name)
}
"""Errors of a full, read-only, protected or broken disk."""


def try_lock(file: TextIO) -> bool:
    """Lock an open file; False if another process holds the lock."""
    try:
        if os.name == "nt":
            import msvcrt

            # One byte far behind the text, which other processes must be able to read.
            file.seek(2**30)
            msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)  # pyright: ignore
        else:
            import fcntl

            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno not in _NO_LOCKS:
            return False
        # Without locks, the process named in the file decides.
        file.seek(0)
        number = file.read().partition(" ")[0]
        return not (number.isdecimal() and is_alive(int(number)))
    return True


def sign(file: TextIO) -> None:
    """Write the process and host into its locked file."""
    os.truncate(file.fileno(), 0)
    # Unbuffered: on a full disk, closing the file shall not fail as well.
    os.write(file.fileno(), f"{os.getpid()} {socket.gethostname()}\n".encode())


def holder(path: Path) -> str:
    """Holder of the lock on a file, in words."""
    with contextlib.suppress(OSError):
        number, _, host = path.read_text(encoding="utf-8").strip().partition(" ")
        if number:
            return f"process {number}" + ("" if host == socket.gethostname() else f" on {host}")
    return "another process"


def is_at(file: TextIO, path: Path) -> bool:
    """True if an open file still has that name."""
    try:
        return os.path.samestat(os.fstat(file.fileno()), os.stat(path))
    except FileNotFoundError:
        return False


def is_alive(pid: int) -> bool:
    """True if a process of this machine may be running."""
    if os.name == "nt":
        return True  # signal 0 would end the process on Windows
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except (PermissionError, OverflowError):
        pass
    return True


def entries(folder: Path) -> set[str]:
    """Relative paths of all entries of a folder; folders end in "/", links count as files."""
    found = set()
    for place, folders, files in os.walk(folder):
        base = Path(place).relative_to(folder)
        for name in (*folders, *files):
            entry = (base / name).as_posix()
            is_folder = name in folders and not (Path(place) / name).is_symlink()
            found.add(f"{entry}/" if is_folder else entry)
    return found


@contextlib.contextmanager
def naming(path: str | os.PathLike[str]) -> Iterator[None]:
    """Context that names a path in errors of the disk that name none, or a temporary place.

    A full disk, for example, shows when a buffered file is closed, and that error has no name.
    """
    try:
        yield
    except OSError as error:
        named = error.filename is not None and SUFFIX not in str(error.filename)
        if error.errno in DISK_ERRORS and not named:
            raise OSError(error.errno, os.strerror(error.errno), str(path)) from error
        raise


def sync_tree(folder: Path) -> None:
    """Sync a folder and its content to disk."""
    for place, _, files in os.walk(folder):
        for name in files:
            if not (Path(place) / name).is_symlink():
                sync_file(Path(place) / name)
        sync_folder(Path(place))


def sync_file(path: Path) -> None:
    """Sync the content of a file to disk."""
    # Windows syncs only files open for writing; other systems also read-only ones.
    with path.open("r+b" if os.name == "nt" else "rb") as file:
        os.fsync(file.fileno())


def sync_folder(path: Path) -> None:
    """Sync the names in a folder to disk, if the system supports it."""
    if os.name == "nt":
        return
    descriptor = os.open(path, os.O_RDONLY)
    try:
        # Some network file systems refuse; they keep the order of names themselves.
        with contextlib.suppress(OSError):
            os.fsync(descriptor)
    finally:
        os.close(descriptor)


def carry_over(names: Iterable[str], source: Path, target: Path) -> set[str]:
    """Give entries of a folder a second name in another one.

    Returns:
        Entries carried over; a file whose name is taken by other content is not.
    """
    carried = set()
    for entry in sorted(names):  # folders before their content
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
    """Delete a file, or a folder with its content."""
    if place.is_dir() and not place.is_symlink():
        shutil.rmtree(place)
    else:
        place.unlink()


def delete_entries(folder: Path, names: Iterable[str]) -> None:
    """Delete entries of a folder, and the folder if it is empty then."""
    # Only entries found in the folder: a foreign list may name "../elsewhere".
    for entry in sorted(entries(folder) & set(names), reverse=True):  # content first
        with contextlib.suppress(OSError):  # entries that cannot be deleted remain visible
            if entry.endswith("/"):
                (folder / entry).rmdir()
            else:
                (folder / entry).unlink()
    with contextlib.suppress(OSError):
        folder.rmdir()


def delete_files(folder: Path, patterns: Iterable[str]) -> bool:
    """Delete a folder of temporary files, but no other file in it.

    Args:
        folder: The folder.
        patterns: Patterns of the temporary files' relative paths; * matches / too.

    Returns:
        True if the folder is gone.
    """
    patterns = tuple(patterns)
    delete_entries(
        folder, [e for e in entries(folder) if e.endswith("/") or matches(e, patterns)]
    )
    return not folder.exists()


def matches(entry: str, patterns: Iterable[str]) -> bool:
    """True if an entry matches one of the patterns."""
    return any(fnmatchcase(entry, pattern) for pattern in patterns)
