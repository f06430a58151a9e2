"""What every program shares: its command line, its exit status, its measured values.

Exit status: 0 done, 1 the work failed, 2 bad input. Bad input ends in one line on stderr.
"""

import json
import math
import sys
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NoReturn, SupportsFloat

from hrc_learn.store import new_file


def run[Args](main: Callable[[Args], int | None], args: type[Args]) -> NoReturn:
    """Parse the command line into the dataclass `args`, call `main` with it, and exit.

    `main` returns the exit status, None for 0. A ValueError or a missing or existing file is
    the user's doing and ends with status 2 and one line; anything else is ours and shows its
    traceback with status 1.
    """
    import tyro

    warnings.formatwarning = _warning_line
    parsed = tyro.cli(args, description=_summary(main))
    try:
        status = main(parsed) or 0
    except (ValueError, FileNotFoundError, FileExistsError, NotADirectoryError) as error:
        print(f"error: {one_line(error)}", file=sys.stderr)
        status = 2
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        status = 1
    sys.exit(status)


def one_line(error: BaseException) -> str:
    """What an exception says, with the notes added to it, on one line."""
    if isinstance(error, OSError) and error.strerror and error.filename:
        text = f"{error.filename}: {error.strerror}"
    else:
        text = str(error) or type(error).__name__
    return " ".join(" ".join([text, *getattr(error, "__notes__", ())]).split())


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


def _warning_line(message: Warning | str, *_place: object, **_line: object) -> str:
    """A warning as a user reads it: without the place in our code that gave it."""
    return f"warning: {message}\n"


def show_values(title: str, values: Mapping[str, float]) -> None:
    """Print measured values as a table."""
    from rich.console import Console
    from rich.table import Table

    table = Table("measure", "value", title=title)
    for name, value in values.items():
        table.add_row(name.replace("_", " "), f"{value:.3g}")
    Console().print(table)


def _number(value: Any) -> float | int | bool | None:
    # numpy's and torch's scalars come as their plain counterparts.
    plain = value.item() if hasattr(value, "item") else value
    return None if isinstance(plain, float) and not math.isfinite(plain) else plain


def _summary(main: Callable) -> str | None:
    """The program's own docstring."""
    text = sys.modules[main.__module__].__doc__ or main.__doc__
    return text and text.strip()
