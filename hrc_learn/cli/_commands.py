"""The commands of `hrc`, and the dispatch from typed words to a command."""

import dataclasses
import shutil
import sys
import textwrap
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from importlib import import_module, metadata
from typing import Any, NoReturn

from hrc_learn.cli import arguments
from hrc_learn.cli._run import parse, status_of


@dataclass(frozen=True)
class Command:
    """A command, whose code is imported when it runs."""

    runs: str
    """Module of `hrc_learn.cli` and its function, which takes the arguments and returns the
    exit status or None."""
    arguments: type
    """Dataclass of its command line."""
    leading: tuple[str, ...] = ()
    """Options whose values may come first without their names. The last one may take several
    values."""

    @property
    def summary(self) -> str:
        """First sentence of its help."""
        text = " ".join((self.arguments.__doc__ or "").split("\n\n")[0].split())
        return text.split(": ")[0].rstrip(".")

    def run(self, args: Any) -> int:
        """Run the command and return its exit status."""
        module, function = self.runs.split(".")
        return getattr(import_module(f"hrc_learn.cli.{module}"), function)(args) or 0


COMMANDS: dict[str, Command] = {
    "demo": Command("experiment_commands.demo", arguments.Demo),
    "run": Command("experiment_commands.run", arguments.Run, ("experiment",)),
    "record": Command("record_command.record", arguments.Record, ("demonstration",)),
    "import": Command("dataset_commands.import_recordings", arguments.Import, ("files",)),
    "show": Command("dashboard_commands.show", arguments.Show, ("dataset",)),
    "check": Command("dataset_commands.check", arguments.Check, ("dataset",)),
    "repair": Command("dataset_commands.repair", arguments.Repair, ("dataset", "out")),
    "merge": Command("dataset_commands.merge", arguments.Merge, ("datasets",)),
    "curate": Command("dataset_commands.curate", arguments.Curate, ("dataset",)),
    "push": Command("dataset_commands.push", arguments.Push, ("dataset", "repo")),
    "fit": Command("fit_command.fit_primitives", arguments.FitPrimitives, ("dataset",)),
    "fit image-jacobian": Command(
        "image_jacobian_commands.fit_image_jacobian", arguments.FitImageJacobian, ("dataset",)
    ),
    "tokens": Command("tokens_command.tokens", arguments.Tokens, ("action",)),
    "evaluate": Command("model_commands.evaluate", arguments.Evaluate, ("model", "dataset")),
    "play": Command("play_command.play", arguments.Play, ("model",)),
    "multiply": Command("multiply_command.multiply", arguments.Multiply, ("dataset",)),
    "smooth": Command("model_commands.smooth", arguments.Smooth, ("checkpoint",)),
    "report": Command("dashboard_commands.report", arguments.Report, ("runs",)),
    "page": Command("loop_commands.page", arguments.ServePage),
    "serve": Command("loop_commands.serve", arguments.Serve),
}
"""Commands by the words typed after `hrc`."""

_NAME_COLUMNS, _LONGEST_LINE = 20, 100


def main(*words: str) -> NoReturn:
    """Run the command given on the command line and exit.

    Exit status: 0 done, 1 the work failed, 2 bad input.

    Args:
        *words: Command, such as "record", "placing"; the command line follows it.
    """
    sys.exit(status_of(lambda: _run([*words, *sys.argv[1:]])))


def commands() -> dict[str, list[str]]:
    """Options by command. `--json` and `--help`, which every command has, are left out."""
    return {
        name: [
            field.name.replace("_", "-")
            for field in dataclasses.fields(command.arguments)
            if field.name != "json"
        ]
        for name, command in COMMANDS.items()
    }


def _run(words: Sequence[str]) -> int:
    name, rest = find(words)
    if name:
        command = COMMANDS[name]
        rest = name_leading(command.leading, rest)
        return command.run(parse(command.arguments, rest, f"hrc {name}"))
    if rest and rest[0] == "--version":
        print(metadata.version("hrc-learn"))
        return 0
    if rest and rest[0] not in ("-h", "--help"):
        close = get_close_matches(rest[0], COMMANDS, 1)
        hint = f"did you mean {close[0]}?" if close else f"it has {', '.join(COMMANDS)}"
        raise ValueError(f"hrc has no command {rest[0]!r}; {hint}")
    print("\n".join(_overview()))
    return 0 if rest else 2


def find(words: Sequence[str]) -> tuple[str, list[str]]:
    """Split words into the name of a command ("" if there is none) and its command line."""
    for count in (2, 1):
        name = " ".join(words[:count])
        if len(words) >= count and name in COMMANDS:
            return name, list(words[count:])
    return "", list(words)


def name_leading(options: Sequence[str], words: Sequence[str]) -> list[str]:
    """Insert the names of leading options whose values were given without names."""
    count = next((i for i, word in enumerate(words) if word.startswith("-")), len(words))
    values, named = list(words[:count]), []
    for i, option in enumerate(options):
        if not values:
            break
        # All remaining values go to the last option: tyro refuses those that it cannot take.
        taken = values if i == len(options) - 1 else values[:1]
        named += [f"--{option}", *taken]
        values = values[len(taken) :]
    return [*named, *values, *words[count:]]


def _overview() -> list[str]:
    return [
        "usage: hrc COMMAND [OPTIONS]",
        "",
        "Learn robot arm motions from a few demonstrations and work safely near people.",
        "",
        *_table((name, command.summary) for name, command in COMMANDS.items()),
        "",
        "`hrc COMMAND --help` lists the options of a command. Every command writes its",
        "measured values with --json FILE.",
    ]


def _table(rows: Iterable[tuple[str, str]]) -> list[str]:
    indent = " " * (_NAME_COLUMNS + 2)
    width = min(shutil.get_terminal_size().columns, _LONGEST_LINE)
    lines = []
    for name, text in rows:
        first, *more = textwrap.wrap(text, width - len(indent))
        lines += [f"  {name:{_NAME_COLUMNS}}{first}", *(indent + line for line in more)]
    return lines
