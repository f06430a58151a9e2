"""Writing files and folders that are whole or not there at all."""

import json
import math
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal, SupportsFloat

from hrc_learn.store._claim import Claim, InTheWayError, resolved, settle
from hrc_learn.store._disk import dump_json
from hrc_learn.store._ownership import MADE_BY, RESULTS, Kind


@contextmanager
def new_file(path: str | os.PathLike[str] | Claim) -> Iterator[Path]:
    """A place to write a file, which takes its name only when it is complete.

    Args:
        path: Where the file will be; replaces one that is there. Its folder must exist. Or the
            claim to it, which is kept.

    Yields:
        The place to write to, of the same name.

    Raises:
        BusyError: Another process is writing this file.
        InTheWayError: There is a folder of that name.
    """
    if not isinstance(path, Claim) and _is_device(path):
        yield Path(path)  # such as /dev/stdout: there is nothing to replace
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
    """A place to build a folder, which takes its name only when it is complete.

    Args:
        path: Where the folder will be, or the claim to it, which is kept.
        kind: What it is.
        overwrite: Replace an older folder of the kind; any other is never touched.
        others: What becomes of files of other origin in the older one. "refuse": it is not
            replaced. "keep": they are carried over; the older one needs no mark then, and what
            has the name of a file of the kind counts as one.
        source: What it is made from, in a word, which `source_of` reads.

    Yields:
        A path beside `path` at which nothing is yet.

    Raises:
        BusyError: Another process is writing this folder.
        InTheWayError: There is something at `path` that may not be replaced.
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
    """A folder of results to fill, which takes its name only when it is complete.

    Args:
        path: Where it will be.
        made_by: What it is made from, kept inside as JSON; paths and the like as text.
        overwrite: Replace an older folder of results.

    Yields:
        The empty folder.

    Raises:
        BusyError: Another process is writing this folder.
        InTheWayError: There is something at `path` that may not be replaced.
    """
    with replacing(path, RESULTS, overwrite) as folder:
        folder.mkdir()
        yield folder
        dump_json(folder / MADE_BY, made_by)


def read_made_by(folder: str | os.PathLike[str]) -> dict[str, Any]:
    """What a folder of results was made from.

    Raises:
        FileNotFoundError: It says nothing of that.
    """
    settle(folder)
    return json.loads((Path(folder) / MADE_BY).read_text(encoding="utf-8"))


def write_text(path: str | Path, text: str) -> None:
    """Write a text file, UTF-8; its folder is made where missing."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    with new_file(path) as part:
        part.write_text(text, encoding="utf-8")


def write_json(path: str | Path, values: Mapping[str, SupportsFloat]) -> None:
    """Write measured values as one flat JSON object.

    Args:
        path: File to write; its folder is made where missing.
        values: Name -> number. Numbers that are not finite become null, as JSON has none.
    """
    content = {name: _plain(value) for name, value in values.items()}
    write_text(path, json.dumps(content, indent=2) + "\n")


def _plain(value: Any) -> float | int | bool | None:
    # numpy's and torch's scalars come as their plain counterparts.
    plain = value.item() if hasattr(value, "item") else value
    return None if isinstance(plain, float) and not math.isfinite(plain) else plain


@contextmanager
def _claimed(path: str | os.PathLike[str] | Claim) -> Iterator[Claim]:
    """A claim for as long as it takes, or one that is there already."""
    if not isinstance(path, Claim):
        with Claim(path) as claim:
            yield claim
        return
    try:
        yield path
    finally:
        path.clear()


def _is_device(path: str | os.PathLike[str]) -> bool:
    return os.path.exists(path) and not (os.path.isfile(path) or os.path.isdir(path))
