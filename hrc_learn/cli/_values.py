"""What commands write and print: measured values, whole files, lines of error."""

import json
import shlex
import sys
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from hrc_learn.store import write_json as write_json
from hrc_learn.store import write_text as write_text


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
