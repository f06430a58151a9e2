"""Measured values and texts as files that are whole or not there at all."""

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, SupportsFloat

from hrc_learn.store._writing import new_file


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
