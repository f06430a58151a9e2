"""Files and folders of results that are whole or not there at all."""

import json
import math
import os
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, SupportsFloat

MADE_BY = "made_by.json"
"""File in each folder of results: what it was made from."""


@contextmanager
def new_file(path: Path) -> Iterator[Path]:
    """A place beside `path` to write a file, which takes its name only when it is complete.

    Args:
        path: Where the file will be; replaces one that is there. Its folder must exist.

    Yields:
        The place to write to.
    """
    part = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        yield part
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


@contextmanager
def replacing(path: Path, mark: str, overwrite: bool = False) -> Iterator[Path]:
    """A place to build a folder, which takes its name only when it is complete.

    Args:
        path: Where the folder will be.
        mark: File inside that tells folders of this kind from others.
        overwrite: Replace an older folder of the kind; any other is never touched.

    Yields:
        A path beside `path` at which nothing is yet.

    Raises:
        FileExistsError: If there is something at `path` that may not be replaced.
    """
    if path.exists() and not overwrite:
        raise FileExistsError(f"{path} exists: choose another folder, or allow to overwrite it")
    if path.exists() and not (path / mark).is_file():
        raise FileExistsError(
            f"{path} has no {mark}, so it is not ours to overwrite: choose another folder"
        )
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.partial.{os.getpid()}")
    shutil.rmtree(partial, ignore_errors=True)
    try:
        yield partial
        _swap(partial, path)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def _swap(new: Path, path: Path) -> None:
    """Give a folder its name; the one that had it goes only after that."""
    if not path.exists():
        new.rename(path)
        return
    old = path.with_name(f".{path.name}.old.{os.getpid()}")
    path.rename(old)
    try:
        new.rename(path)
    except OSError:
        old.rename(path)
        raise
    shutil.rmtree(old)


@contextmanager
def new_folder(
    path: Path, made_by: Mapping[str, Any], overwrite: bool = False
) -> Iterator[Path]:
    """A folder of results to fill, which takes its name only when it is complete.

    Args:
        path: Where it will be.
        made_by: What it is made from, kept inside as JSON; paths and the like as text.
        overwrite: Replace an older folder of results.

    Yields:
        The empty folder.

    Raises:
        FileExistsError: If there is something at `path` that may not be replaced.
    """
    with replacing(path, MADE_BY, overwrite) as folder:
        folder.mkdir()
        yield folder
        (folder / MADE_BY).write_text(json.dumps(made_by, indent=2, default=str) + "\n")


def write_json(path: str | Path, values: Mapping[str, SupportsFloat]) -> None:
    """Write measured values as one flat object; the file is whole or not there at all.

    Args:
        path: File to write; its folder is made where missing.
        values: Name -> number. Numbers that are not finite become null, as JSON has none.
    """
    content = {name: _number(value) for name, value in values.items()}
    write_text(path, json.dumps(content, indent=2) + "\n")


def write_text(path: str | Path, text: str) -> None:
    """Write a file that is whole or not there at all; its folder is made where missing."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    with new_file(path) as part:
        part.write_text(text, encoding="utf-8")


def _number(value: Any) -> float | int | bool | None:
    # numpy's and torch's scalars come as their plain counterparts.
    plain = value.item() if hasattr(value, "item") else value
    return None if isinstance(plain, float) and not math.isfinite(plain) else plain
