"""Folders on disk: locks, listing, syncing, deleting, and manifests of the files written here.

Only files that this package has written may be deleted with their folder.
"""

import contextlib
import errno
import fcntl
import filecmp
import hashlib
import os
import shutil
import socket
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Literal, TextIO

from hrc_learn.store._reading import json_text, read_json

MADE_BY = "made_by.json"
"""File in a folder of results that records the inputs of these results."""
MANIFEST = ".manifest.json"
"""File that lists all other files of a folder, with their checksums."""
# Errors of file systems without locks, such as some network ones.
_NO_LOCKS = {errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOSYS, errno.ENOLCK, errno.EINVAL}


SUFFIX = ".writing"
"""Suffix of the name of a workspace (see `hrc_learn.store`)."""
DISK_ERRORS = {
    *(errno.ENOSPC, errno.EDQUOT, errno.EFBIG),
    *(errno.EROFS, errno.EACCES, errno.EPERM, errno.EIO),
}
"""Errors of a full, read-only, protected or broken disk."""


def cache_home() -> Path:
    """Folder of the user's caches: `XDG_CACHE_HOME`, or `~/.cache`."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")


def try_lock(file: TextIO) -> bool:
    """Lock an open file; False if another process holds the lock."""
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        return error.errno in _NO_LOCKS  # then nothing keeps two writers apart
    return True


def sign(file: TextIO) -> None:
    """Write the ID and host of this process into a locked file."""
    os.truncate(file.fileno(), 0)
    # Unbuffered, so that closing the file cannot fail as well if the disk is full.
    os.write(file.fileno(), f"{os.getpid()} {socket.gethostname()}\n".encode())


def holder(path: Path) -> str:
    """Process that holds the lock on a file, in words."""
    with contextlib.suppress(OSError):
        number, _, host = path.read_text(encoding="utf-8").strip().partition(" ")
        if number:
            return f"process {number}" + ("" if host == socket.gethostname() else f" on {host}")
    return "another process"


def is_at(file: TextIO, path: Path) -> bool:
    """True if an open file still has this path."""
    try:
        return os.path.samestat(os.fstat(file.fileno()), os.stat(path))
    except FileNotFoundError:
        return False


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
    """Context that adds a path to disk errors that name no file or only a temporary one.

    An example is a full disk, noticed when a buffered file is closed.
    """
    try:
        yield
    except OSError as error:
        named = error.filename is not None and SUFFIX not in str(error.filename)
        if error.errno is not None and error.errno in DISK_ERRORS and not named:
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
    with path.open("rb") as file:
        os.fsync(file.fileno())


def sync_folder(path: Path) -> None:
    """Sync the names in a folder to disk, if the system supports it."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        # Some network file systems refuse; they keep the order of names themselves.
        with contextlib.suppress(OSError):
            os.fsync(descriptor)
    finally:
        os.close(descriptor)


def carry_over(names: Iterable[str], source: Path, target: Path) -> set[str]:
    """Link entries of a folder into another one; copy them where links are not supported.

    Returns:
        Entries carried over: all but files whose names are taken by other content.
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
    """Delete entries of a folder, and the folder if that leaves it empty."""
    # Delete only entries found in the folder: a damaged list may contain "../other".
    for entry in sorted(entries(folder) & set(names), reverse=True):  # content first
        with contextlib.suppress(OSError):  # entries that cannot be deleted remain visible
            if entry.endswith("/"):
                (folder / entry).rmdir()
            else:
                (folder / entry).unlink()
    with contextlib.suppress(OSError):
        folder.rmdir()


def delete_files(folder: Path, patterns: Iterable[str]) -> bool:
    """Delete the temporary files of a folder, and the folder if no other file is in it.

    Args:
        folder: The folder.
        patterns: Patterns of the temporary files' relative paths; "*" also matches "/".

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


@dataclass(frozen=True, kw_only=True)
class Kind:
    """Kind of folder that this package writes; only a folder of the same kind replaces it."""

    name: str
    files: tuple[str, ...] = ()
    """Patterns of the package's files in a folder that users may extend; "*" also matches "/".

    Such a folder may lack a manifest, and its foreign files are carried over. Without patterns,
    a folder that contains foreign files is not replaced.
    """


MODEL = Kind(name="saved model")
EXPORT = Kind(name="export")
RESULTS = Kind(name="folder of results")
DATASET = Kind(
    name="dataset",
    files=(
        "meta/info.json",
        "meta/stats.json",
        "meta/tasks.parquet",
        "meta/hrc_learn.json",
        "meta/episodes/chunk-*/file-*.parquet",
        "data/chunk-*/file-*.parquet",
        "videos/*/chunk-*/file-*.mp4",
    ),
)


def owned_entries(folder: Path, kind: Kind) -> set[str] | None:
    """Entries of a folder that this package wrote, and that may be deleted with the folder.

    Args:
        folder: The folder.
        kind: Expected kind.

    Returns:
        Relative paths; folders end in "/". None for a folder of another kind.
    """
    if not folder.is_dir():
        return None
    present = entries(folder)
    if not present:
        return set()  # nothing could be lost
    manifest = _read_manifest(folder)
    known = bool(kind.files) if manifest is None else manifest.kind == kind.name
    if not known:
        return None
    owned = set() if manifest is None else _listed(folder, manifest)
    if kind.files:
        owned |= {entry for entry in present if matches(entry, kind.files)}
        owned |= {f"{parent.as_posix()}/" for entry in owned for parent in Path(entry).parents}
    return present & owned


@dataclass(frozen=True, kw_only=True)
class _Manifest:
    format: Literal["hrc_learn manifest"] = "hrc_learn manifest"
    version: Literal[1] = 1
    kind: str
    source: str = ""
    entries: list[str]
    """All files and folders inside; folders end in "/"."""
    sha256: dict[str, str] = field(default_factory=dict)
    """Checksums of the files, by entry."""


def write_manifest(folder: Path, kind: Kind, source: str) -> None:
    """Write the manifest of a folder whose whole content this package wrote."""
    names = sorted(entries(folder) - {MANIFEST})
    checksums = {name: _checksum(folder / name) for name in names if (folder / name).is_file()}
    manifest = _Manifest(kind=kind.name, source=source, entries=names, sha256=checksums)
    (folder / MANIFEST).write_text(json_text(manifest), encoding="utf-8")


def changed_files(folder: str | os.PathLike[str]) -> list[str]:
    """Files of a folder that have changed, or are missing, since this package wrote it.

    Returns:
        Paths relative to the folder; none for a folder without a manifest.

    Raises:
        ValueError: The manifest is damaged.
    """
    folder = Path(folder)
    if not (folder / MANIFEST).is_file():
        return []
    manifest = read_json(
        folder / MANIFEST, _Manifest, "restore the folder, or delete this file"
    )
    return [
        name
        for name, checksum in manifest.sha256.items()
        if not (folder / name).is_file() or _checksum(folder / name) != checksum
    ]


def require_unchanged(folder: str | os.PathLike[str]) -> None:
    """Check that a folder is as this package wrote it.

    Raises:
        ValueError: A file has changed or is missing.
    """
    if changed := changed_files(folder):
        raise ValueError(
            f"{Path(folder) / changed[0]} has changed since it was written: restore it, or "
            f"delete {MANIFEST} next to it if the change is intended"
        )


def source_of(folder: str | os.PathLike[str]) -> str:
    """Source that the writer of a folder put into its manifest; "" if there is none."""
    manifest = _read_manifest(Path(folder))
    return "" if manifest is None else manifest.source


def _checksum(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _read_manifest(folder: Path) -> _Manifest | None:
    try:
        return read_json(folder / MANIFEST, _Manifest)
    except (OSError, ValueError):
        return None


def _listed(folder: Path, manifest: _Manifest) -> set[str]:
    """Entries of a manifest and, recursively, of the manifests in the folders that it lists.

    A foreign folder added later is not listed, whatever its own manifest says.
    """
    listed = {*manifest.entries, MANIFEST}
    for entry in [entry for entry in listed if entry.endswith("/")]:
        inner = _read_manifest(folder / entry)
        if inner is not None:
            listed |= {entry + name for name in _listed(folder / entry, inner)}
    return listed
