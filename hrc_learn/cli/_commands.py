"""The commands of `hrc`, and which of them was meant."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module, metadata
from typing import Any, NoReturn

from hrc_learn.cli._help import table
from hrc_learn.cli._run import parse, status_of


@dataclass(frozen=True, kw_only=True)
class Command:
    """One command: where its parts are, imported when it is meant."""

    says: str
    """What it does, in a line of the list of commands."""
    module: str
    """Of `hrc_learn.cli.commands`; its `run` takes the arguments, returns the exit status."""
    arguments: tuple[str, str]
    """Module of `hrc_learn.cli.arguments`, and the dataclass in it."""
    leading: tuple[str, ...] = ()
    """Options whose values may come first, without their names."""

    def arguments_type(self) -> type:
        """The dataclass that is its command line."""
        module, name = self.arguments
        return getattr(import_module(f"hrc_learn.cli.arguments.{module}"), name)

    def work(self, args: Any) -> int:
        """Do it; the exit status."""
        return import_module(f"hrc_learn.cli.commands.{self.module}").run(args) or 0


COMMANDS: dict[str, Command] = {
    "demo": Command(
        says="the whole main job: demonstrate, learn, grasp, place",
        module="demo",
        arguments=("run", "Demo"),
    ),
    "record placing": Command(
        says="demonstrations of placing, by a scripted expert in simulation",
        module="record_placing",
        arguments=("record", "RecordPlacing"),
    ),
    "record servoing": Command(
        says="demonstrations of aiming with an uncalibrated camera",
        module="record_servoing",
        arguments=("record", "RecordServoing"),
    ),
    "record expert": Command(
        says="the columns that LeRobot's robots have, by the same expert",
        module="record_expert",
        arguments=("record", "RecordExpert"),
    ),
    "import": Command(
        says="arrays to a LeRobot dataset",
        module="import_arrays",
        arguments=("dataset", "ImportArrays"),
    ),
    "show": Command(
        says="demonstrations in Rerun",
        module="show",
        arguments=("dataset", "Show"),
        leading=("dataset",),
    ),
    "check": Command(
        says="errors and oddities by file, episode, frame and key",
        module="check",
        arguments=("dataset", "Check"),
        leading=("dataset",),
    ),
    "repair": Command(
        says="what can be mended of a dataset, in a copy",
        module="repair",
        arguments=("dataset", "Repair"),
        leading=("dataset", "out"),
    ),
    "recover": Command(
        says="what a process that was killed left behind",
        module="recover",
        arguments=("dataset", "Recover"),
        leading=("path",),
    ),
    "extract": Command(
        says="markers found in a dataset's videos",
        module="extract",
        arguments=("dataset", "Extract"),
        leading=("dataset",),
    ),
    "fit primitives": Command(
        says="movement primitives of joints and hand",
        module="fit_primitives",
        arguments=("learn", "FitPrimitives"),
    ),
    "fit image-jacobian": Command(
        says="image Jacobian, and where to aim",
        module="fit_image_jacobian",
        arguments=("learn", "FitImageJacobian"),
    ),
    "evaluate primitives": Command(
        says="primitives on demonstrations held out",
        module="evaluate_primitives",
        arguments=("learn", "EvaluatePrimitives"),
        leading=("model", "dataset"),
    ),
    "evaluate image-jacobian": Command(
        says="an image Jacobian against the simulator's true one",
        module="evaluate_image_jacobian",
        arguments=("learn", "EvaluateImageJacobian"),
        leading=("model", "dataset"),
    ),
    "tune": Command(
        says="gains, searched over simulated grasps",
        module="tune",
        arguments=("learn", "Tune"),
    ),
    "smooth": Command(
        says="limits on what any LeRobot policy asks for",
        module="smooth",
        arguments=("learn", "Smooth"),
    ),
    "run placing": Command(
        says="the paper's first experiment: a motion repeated for other shelves",
        module="run_placing",
        arguments=("run", "RunPlacing"),
    ),
    "run grasping": Command(
        says="its second: a grasp with a camera nobody calibrated",
        module="run_grasping",
        arguments=("run", "RunGrasping"),
    ),
    "run collaboration": Command(
        says="its third, the whole job, with one object or three",
        module="run_collaboration",
        arguments=("run", "RunCollaboration"),
    ),
    "report": Command(
        says="one page from the folders of several runs",
        module="report",
        arguments=("run", "Report"),
    ),
    "sweep": Command(
        says="thousands of simulated grasps as batches",
        module="sweep",
        arguments=("run", "Sweep"),
    ),
    "serve": Command(
        says="the controller in a paced loop, and its latency",
        module="serve",
        arguments=("run", "Serve"),
    ),
    "page": Command(
        says="a page in the browser to lead the arm and record demonstrations",
        module="page",
        arguments=("run", "ServePage"),
    ),
}
"""By what is typed after `hrc`."""

DEFAULTS = {"fit": "fit primitives", "evaluate": "evaluate primitives"}
"""What a word alone means that more than one command begins with."""


def main(*words: str) -> NoReturn:
    """Run a command with what was typed on the command line, and exit.

    Exit status: 0 done, 1 the work failed, 2 bad input.

    Args:
        *words: The command, such as "record", "placing"; without any, typed as well.
    """
    sys.exit(status_of(lambda: _run([*words, *sys.argv[1:]])))


def _run(words: Sequence[str]) -> int:
    name, rest = find(words)
    if name in COMMANDS:
        command, program = COMMANDS[name], f"hrc {name}"
        rest = name_leading(command.leading, rest)
        return command.work(parse(command.arguments_type(), rest, program))
    if rest and rest[0] == "--version":
        print(metadata.version("hrc-learn"))
        return 0
    if rest and rest[0] not in ("-h", "--help", "--help-all"):
        known = ", ".join(dict.fromkeys(_next_words(name)))
        group = f"hrc {name}".rstrip()
        raise ValueError(f"no command {rest[0]!r} of {group}; there are {known}")
    print("\n".join(_overview(name)))
    # Asked for help, that was it; a command that is missing is bad input.
    return 0 if rest else 2


def find(words: Sequence[str]) -> tuple[str, list[str]]:
    """The command that words begin with, as far as there is one, and the words after it."""
    for count in (2, 1):
        name = " ".join(words[:count])
        if len(words) >= count and name in COMMANDS:
            return name, list(words[count:])
    if not words or not any(name.startswith(f"{words[0]} ") for name in COMMANDS):
        return "", list(words)
    if words[0] in DEFAULTS:
        return DEFAULTS[words[0]], list(words[1:])
    return words[0], list(words[1:])


def name_leading(options: Sequence[str], words: Sequence[str]) -> list[str]:
    """Words with the names of options put before values that come first without them."""
    named: list[str] = []
    remaining = list(words)
    for option in options:
        if not remaining or remaining[0].startswith("-"):
            break
        named += [f"--{option}", remaining.pop(0)]
    return [*named, *remaining]


def _next_words(name: str) -> list[str]:
    """What may follow the word, or be the first one."""
    position = len(name.split())
    return [command.split()[position] for command in COMMANDS if command.startswith(name)]


def _overview(name: str) -> list[str]:
    shown = {
        command: found.says for command, found in COMMANDS.items() if command.startswith(name)
    }
    return [
        f"usage: hrc {name} COMMAND [OPTIONS]".replace("  ", " "),
        "",
        "Learn robot arm motions from a few demonstrations and work safely beside people.",
        "",
        *table(shown.items()),
        "",
        "`hrc COMMAND --help` shows the main options of a command, --help-all every one.",
        "`fit` and `evaluate` alone are those of primitives. All write figures with --json.",
    ]
