"""What lies in folders: listed, brought to disk, carried over, deleted."""

import contextlib
import filecmp
import json
import os
import shutil
from collections.abc import Iterable
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any


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


def write_json(path: Path, content: object) -> None:
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
        place.unlink(missing_ok=True)


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
        folder,
        [e for e in entries(folder) if e.endswith("/") or matches(e, patterns)],
    )
    return not folder.exists()


def matches(entry: str, patterns: Iterable[str]) -> bool:
    """Whether an entry is of one of these patterns."""
    return any(fnmatchcase(entry, pattern) for pattern in patterns)
