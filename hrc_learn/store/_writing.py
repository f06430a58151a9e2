"""Writing of files and folders that are complete or absent."""

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

from hrc_learn.store._claim import Claim, InTheWayError, resolved, settle
from hrc_learn.store._folder import MADE_BY, RESULTS, Kind, naming
from hrc_learn.store._reading import json_text, read_json


@contextmanager
def new_file(path: str | os.PathLike[str] | Claim) -> Iterator[Path]:
    """Temporary place for a new file, which takes its name when it is complete.

    Args:
        path: Path of the file, whose folder must exist, or the claim to it, which stays held.
            An existing file is replaced.

    Yields:
        Path to write to, with the same file name.

    Raises:
        BusyError: Another process is writing this file.
        InTheWayError: There is a folder of that name.
    """
    if not isinstance(path, Claim) and _is_device(path):
        with naming(path):
            yield Path(path)  # such as /dev/stdout, which cannot be replaced
        return
    with _claimed(path) as claim:
        if claim.target.is_dir():
            raise InTheWayError(f"{claim.target} is a folder: choose another file")
        claim.new.mkdir()
        part = claim.new / claim.target.name
        yield part
        claim.commit_file(part)


@contextmanager
def replacing(
    path: str | os.PathLike[str] | Claim,
    kind: Kind,
    overwrite: bool = False,
    *,
    others: Literal["refuse", "keep"] = "refuse",
    source: str = "",
) -> Iterator[Path]:
    """Temporary place for a new folder, which takes its name when it is complete.

    Args:
        path: Path of the folder, or the claim to it, which stays held.
        kind: Kind of the folder.
        overwrite: Replace an older folder of the same kind; others are never touched.
        others: Treatment of foreign files in the older folder: "refuse" does not replace it,
            "keep" carries them over. With "keep" the older folder needs no mark, and files
            with names of the kind count as its own.
        source: Identifier of the source, for `source_of`.

    Yields:
        Path that does not exist yet.

    Raises:
        BusyError: Another process is writing this folder.
        InTheWayError: `path` exists and may not be replaced.
    """
    keep = others == "keep"
    if not isinstance(path, Claim):
        resolved(path).parent.mkdir(parents=True, exist_ok=True)
    with _claimed(path) as claim:
        claim.require_replaceable(kind, overwrite, foreign=keep, adopt=keep)
        yield claim.new
        claim.commit(kind, overwrite, keep=keep, source=source)


@contextmanager
def new_folder(
    path: str | os.PathLike[str], made_by: Mapping[str, Any], overwrite: bool = False
) -> Iterator[Path]:
    """Temporary folder for results, which takes its name when it is complete.

    Args:
        path: Path of the folder.
        made_by: Inputs of the results, kept inside as JSON; other values as text.
        overwrite: Replace an older folder of results.

    Yields:
        Empty folder.

    Raises:
        BusyError: Another process is writing this folder.
        InTheWayError: `path` exists and may not be replaced.
    """
    with replacing(path, RESULTS, overwrite) as folder:
        folder.mkdir()
        yield folder
        (folder / MADE_BY).write_text(json_text(made_by), encoding="utf-8")


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
        content: Dataclass, mapping or list. Arrays and tensors become lists, numbers that are
            not finite null, other objects text.
    """
    write_text(path, json_text(content))


@contextmanager
def _claimed(path: str | os.PathLike[str] | Claim) -> Iterator[Claim]:
    """A new claim for the duration of the context, or the given one, which stays held."""
    if not isinstance(path, Claim):
        with naming(path), Claim(path) as claim:
            yield claim
        return
    try:
        with naming(path.target):
            yield path
    finally:
        path.clear()


def _is_device(path: str | os.PathLike[str]) -> bool:
    return os.path.exists(path) and not (os.path.isfile(path) or os.path.isdir(path))
