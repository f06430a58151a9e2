"""The models of the demo: recorded, learned, and found again by the commands that use them."""

from pathlib import Path

from rich.console import Console

from hrc_learn.cli.arguments.learn import FitImageJacobian, FitPrimitives
from hrc_learn.cli.arguments.record import RecordPlacing, RecordServoing

MODELS = Path("outputs/demo")
"""Where commands that are given no model look for those of the demo."""


def learn(out: Path, console: Console, steps: int = 4) -> None:
    """Record demonstrations of placing and aiming, and learn from them.

    Args:
        out: Folder for `placing_demos`, `aiming_demos` and the models `placing`, `aiming`;
            older ones in it are replaced.
        console: Told what is being done.
        steps: How many there are, with those of the caller.

    Raises:
        RuntimeError: If the scripted expert fails.
    """
    from hrc_learn.cli.commands import (
        fit_image_jacobian,
        fit_primitives,
        record_placing,
        record_servoing,
    )

    placing, aiming = out / "placing_demos", out / "aiming_demos"
    announce(console, 1, steps, "Demonstrations of placing")
    if record_placing.run(RecordPlacing(out=placing, overwrite=True)):
        raise RuntimeError("the scripted expert could not place")
    announce(console, 2, steps, "Demonstrations of aiming with an uncalibrated camera")
    record_servoing.run(RecordServoing(out=aiming, overwrite=True))
    announce(console, 3, steps, "Movement primitives from the first")
    fit_primitives.run(FitPrimitives(dataset=placing, out=out / "placing", overwrite=True))
    announce(console, 4, steps, "Image Jacobian from the second")
    fit_image_jacobian.run(FitImageJacobian(dataset=aiming, out=out / "aiming", overwrite=True))


def model(given: Path | None, name: str, console: Console) -> Path:
    """Folder of a model: the one given, or the demo's, learned first where it is missing.

    Args:
        given: By the user; None for the demo's.
        name: "placing" or "aiming".
        console: Told what is being done.
    """
    if given is not None:
        return given
    found = MODELS / name
    if not found.is_dir():
        console.print(f"note: no model given and none in {MODELS}, so it is learned first")
        learn(MODELS, console)
    return found


def announce(console: Console, step: int, steps: int, what: str) -> None:
    """Say which step of how many begins."""
    console.print(f"[bold]\\[{step}/{steps}] {what}[/]", highlight=False)
