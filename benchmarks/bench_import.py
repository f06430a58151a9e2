"""How long the package takes to import, against PyTorch alone.

Each figure is the median CPU time of fresh interpreters, one at a time and in turn, so that
other work on the machine counts little and slows all alike; ratios are of these medians.
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
"""What is imported, by the name of its figure."""
REACH = 1.2
"""Most that an import of the core may take, in imports of torch."""


@dataclass(frozen=True, kw_only=True)
class Args:
    repeats: int = 7
    """Interpreters started for each figure."""
    json: Path | None = None
    """Receives the figures as one flat object."""


def main(args: Args) -> None:
    """Measure, print a table, write the figures."""
    if args.repeats < 1:
        raise ValueError(f"repeats must be at least 1, but is {args.repeats}")
    figures = measure(args.repeats)
    show(figures)
    if args.json:
        cli.write_json(args.json, figures)


def measure(repeats: int) -> dict[str, float]:
    """Seconds of each import, and how many times that of torch it is."""
    seconds: dict[str, list[float]] = {name: [] for name in IMPORTS}
    for modules in IMPORTS.values():
        start_interpreter(modules)  # fills the disk's cache, writes the bytecode
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
    """Of all that have ended [s]."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def show(figures: dict[str, float]) -> None:
    """Print all figures, with what they should stay below."""
    table = Table("figure", "measured", "reach", title="Imports in fresh interpreters")
    for name, value in figures.items():
        reach = ""
        if name.endswith("_of_torch"):
            reach = f"[{'green' if value <= REACH else 'red'}]<= {REACH:g}"
        table.add_row(name, f"{value:.3g}", reach)
    Console().print(table)


if __name__ == "__main__":
    cli.run(main, Args)
