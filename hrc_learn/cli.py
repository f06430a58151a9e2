"""What every program shares: its command line, its exit status, its measured values.

Exit status: 0 done, 1 the work failed, 2 bad input. Bad input ends in one line on stderr.
"""

import sys
import warnings
from collections.abc import Callable, Mapping
from typing import NoReturn

from hrc_learn.output import write_json as write_json
from hrc_learn.output import write_text as write_text


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


def _summary(main: Callable) -> str | None:
    """The program's own docstring."""
    text = sys.modules[main.__module__].__doc__ or main.__doc__
    return text and text.strip()
