"""Folders of results that are whole or not there at all."""

import json
import os
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

MARK = "made_by.json"
"""File in each folder of ours: which program made it, from what."""


@contextmanager
def new_folder(
    path: Path, made_by: Mapping[str, Any], overwrite: bool = False
) -> Iterator[Path]:
    """A folder to fill, which takes its name only when it is complete.

    Args:
        path: Where it will be.
        made_by: What it is made from, kept inside as JSON; paths and the like as text.
        overwrite: Replace an older folder of ours. One that we did not make is never touched.

    Yields:
        An empty folder beside `path`.

    Raises:
        FileExistsError: If there is something at `path` that may not be replaced.
    """
    if path.exists() and not overwrite:
        raise FileExistsError(f"{path} exists: choose another folder, or allow to overwrite it")
    if path.exists() and not (path / MARK).is_file():
        raise FileExistsError(
            f"{path} exists and is not ours to overwrite: choose another folder"
        )
    partial = path.with_name(f".{path.name}.partial.{os.getpid()}")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    try:
        yield partial
        (partial / MARK).write_text(json.dumps(made_by, indent=2, default=str) + "\n")
        if path.exists():
            shutil.rmtree(path)
        partial.rename(path)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
