"""Import time of the package, compared with PyTorch alone.

Each time is the median CPU time of fresh interpreters, which run in turn, one at a time, so
that other programs have little effect and slow all alike. Ratios are those of the medians.
"""

import resource
import statistics
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from rich.table import Table

from hrc_learn import cli

FLOOR = "torch"
CORE = ("dmp", "kinematics", "regions", "jacobian", "controller")
IMPORTS: dict[str, tuple[str, ...]] = {
    "nothing": (),
    FLOOR: (FLOOR,),
    "hrc_learn": ("hrc_learn",),
    **{name: (f"hrc_learn.{name}",) for name in CORE},
    "core": tuple(f"hrc_learn.{name}" for name in CORE),
}
"""Imported modules, by the name of the measured value."""
REACH = 1.2
"""Largest allowed import time of the core, relative to that of torch."""


@dataclass(frozen=True, kw_only=True)
class Args:
    repeats: int = 7
    """Number of interpreters started for each value."""
    json: Path | None = None
    """File for the measured values, one flat JSON object of numbers."""


def main(args: Args) -> None:
    """Measure, print a table, and write the measured values."""
    if args.repeats < 1:
        raise ValueError(f"repeats must be at least 1, but is {args.repeats}")
    figures = measure(args.repeats)
    show(figures)
    if args.json:
        cli.write_json(args.json, figures)


def measure(repeats: int) -> dict[str, float]:
    """Time of each import [s], and its ratio to that of torch."""
    seconds: dict[str, list[float]] = {name: [] for name in IMPORTS}
    for modules in IMPORTS.values():
        start_interpreter(modules)  # fills the disk cache and writes the bytecode
    for _ in range(repeats):
        for name, modules in IMPORTS.items():
            seconds[name].append(start_interpreter(modules))
    median = {name: statistics.median(values) for name, values in seconds.items()}
    return {f"{name}_s": value for name, value in median.items()} | {
        f"{name}_of_torch": median[name] / median[FLOOR] for name in (*CORE, "core")
    }


def start_interpreter(modules: tuple[str, ...]) -> float:
    """CPU time of a fresh interpreter that imports some modules [s]."""
    code = "\n".join(f"import {module}" for module in modules)
    start = cpu_time_of_children()
    subprocess.run([sys.executable, "-c", code], check=True)
    return cpu_time_of_children() - start


def cpu_time_of_children() -> float:
    """CPU time of all child processes that have ended [s]."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def show(figures: dict[str, float]) -> None:
    """Print all measured values with their bounds."""
    table = Table("figure", "measured", "reach", title="Imports in fresh interpreters")
    for name, value in figures.items():
        reach = ""
        if name.endswith("_of_torch"):
            reach = f"[{'green' if value <= REACH else 'red'}]<= {REACH:g}"
        table.add_row(name, f"{value:.3g}", reach)
    Console().print(table)


if __name__ == "__main__":
    cli.run(main, Args)
