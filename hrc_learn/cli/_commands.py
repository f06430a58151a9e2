"""The commands of `hrc`, and which of them was meant."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module, metadata
from typing import Any, NoReturn

from hrc_learn.cli._options import table
from hrc_learn.cli._run import parse, status_of


@dataclass(frozen=True)
class Command:
    """One command: where its parts are, imported when it is meant."""

    says: str
    """What it does, in a line of the list of commands."""
    runs: str
    """Module of `hrc_learn.cli.commands` and the function in it, which takes the arguments and
    returns the exit status."""
    arguments: str
    """Module of `hrc_learn.cli.arguments` and the dataclass in it."""
    leading: tuple[str, ...] = ()
    """Options whose values may come first, without their names."""

    def arguments_type(self) -> type:
        """The dataclass that is its command line."""
        return _part("arguments", self.arguments)

    def work(self, args: Any) -> int:
        """Do it; the exit status."""
        return _part("commands", self.runs)(args) or 0


def _part(package: str, place: str) -> Any:
    module, name = place.split(".")
    return getattr(import_module(f"hrc_learn.cli.{package}.{module}"), name)


COMMANDS: dict[str, Command] = {
    "demo": Command(
        "the whole main job: demonstrate, learn, grasp, place", "run.demo", "run.Demo"
    ),
    "record placing": Command(
        "demonstrations of placing, by a scripted expert in simulation",
        "record.record_placing",
        "record.RecordPlacing",
    ),
    "record servoing": Command(
        "demonstrations of servoing with an uncalibrated camera",
        "record.record_servoing",
        "record.RecordServoing",
    ),
    "record expert": Command(
        "the columns that LeRobot's robots have, by the same expert",
        "record.record_expert",
        "record.RecordExpert",
    ),
    "import": Command(
        "arrays to a LeRobot dataset", "convert.import_arrays", "dataset.ImportArrays"
    ),
    "show": Command(
        "a run, a fit or demonstrations in Rerun", "show.show", "dataset.Show", ("path",)
    ),
    "check": Command(
        "errors and oddities by file, episode, frame and key",
        "check.check",
        "dataset.Check",
        ("dataset",),
    ),
    "repair": Command(
        "what can be mended of a dataset, in a copy",
        "check.repair",
        "dataset.Repair",
        ("dataset", "out"),
    ),
    "curate": Command(
        "which episodes stay, decided in the browser",
        "curate.curate",
        "dataset.Curate",
        ("dataset",),
    ),
    "recover": Command(
        "what a process that was killed left behind",
        "check.recover",
        "dataset.Recover",
        ("path",),
    ),
    "extract": Command(
        "markers found in a dataset's videos",
        "convert.extract",
        "dataset.Extract",
        ("dataset",),
    ),
    "push": Command(
        "a dataset, checked, to the Hugging Face Hub",
        "push.push",
        "dataset.Push",
        ("dataset", "repo"),
    ),
    "fit primitives": Command(
        "movement primitives of joints and end effector",
        "fit.fit_primitives",
        "learn.FitPrimitives",
    ),
    "fit image-jacobian": Command(
        "image Jacobian and visual target", "fit.fit_image_jacobian", "learn.FitImageJacobian"
    ),
    "evaluate primitives": Command(
        "primitives on demonstrations held out",
        "evaluate.evaluate_primitives",
        "learn.EvaluatePrimitives",
        ("model", "dataset"),
    ),
    "evaluate image-jacobian": Command(
        "an image Jacobian against the simulator's true one",
        "evaluate.evaluate_image_jacobian",
        "learn.EvaluateImageJacobian",
        ("model", "dataset"),
    ),
    "smooth": Command(
        "limits on what any LeRobot policy asks for", "smooth.smooth", "learn.Smooth"
    ),
    "run placing": Command(
        "the paper's first experiment: a motion repeated for other shelves",
        "run.run_placing",
        "run.RunPlacing",
    ),
    "run grasping": Command(
        "its second: a grasp with a camera nobody calibrated",
        "run.run_grasping",
        "run.RunGrasping",
    ),
    "run collaboration": Command(
        "its third, the whole job, with one object or three",
        "run.run_collaboration",
        "run.RunCollaboration",
    ),
    "report": Command("one page from the folders of several runs", "show.report", "run.Report"),
    "sweep worker": Command(
        "a thousand jobs beside a worker, who is waited for or made way for",
        "sweep_worker.sweep_worker",
        "run.SweepWorker",
    ),
    "serve": Command(
        "the controller in a paced loop, and its latency", "serve.serve", "run.Serve"
    ),
    "page": Command(
        "a page in the browser to lead the arm and record demonstrations",
        "page.page",
        "run.ServePage",
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
