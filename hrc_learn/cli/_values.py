"""What commands write and print: measured values, whole files, lines of error."""

import json
import math
import shlex
import sys
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any, SupportsFloat

from hrc_learn.store import new_file


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


def show_values(title: str, values: Mapping[str, float]) -> None:
    """Print measured values as a table."""
    from rich.console import Console
    from rich.table import Table

    table = Table("measure", "value", title=title)
    for name, value in values.items():
        table.add_row(name.replace("_", " "), f"{value:.3g}")
    Console().print(table)


def one_line(error: BaseException) -> str:
    """What an exception says, with the notes added to it, on one line."""
    if isinstance(error, OSError) and error.strerror and error.filename:
        text = f"{error.filename}: {error.strerror}"
    else:
        text = str(error) or type(error).__name__
    return " ".join(" ".join([text, *getattr(error, "__notes__", ())]).split())


def refuse_existing(path: Path, overwrite: bool) -> None:
    """Say before any work that its result would find something in its place.

    Raises:
        FileExistsError: If there is something that may not be replaced.
    """
    if path.exists() and not overwrite:
        raise FileExistsError(f"{path} exists: give another --out, or --overwrite it")


def configuration(args: Any) -> dict[str, Any]:
    """The arguments of a command as they are kept with its results: plain JSON."""
    return json.loads(json.dumps(asdict(args), default=str))


def command_line() -> str:
    """What was typed to start this process, to be typed again."""
    program, *arguments = sys.argv
    # The installed command is found by its name; a program needs Python before it.
    start = ["python", program] if program.endswith(".py") else [Path(program).name]
    return shlex.join([*start, *arguments])


def _number(value: Any) -> float | int | bool | None:
    # numpy's and torch's scalars come as their plain counterparts.
    plain = value.item() if hasattr(value, "item") else value
    return None if isinstance(plain, float) and not math.isfinite(plain) else plain
