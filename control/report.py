"""Make one page from the folders of one or several runs.

The page holds their figures, what they measured beside its targets and the paper's claims,
their configuration and versions, and the commands that run them again. It needs no network:
mail it, print it, keep it.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from hrc_learn import cli
from hrc_learn.viz.report import read_report, reports_page


@dataclass(frozen=True, kw_only=True)
class Args:
    """What to put on the page."""

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Folders of runs, in the order of the page; each holds a report.json."""
    out: Path
    """HTML file to write; replaces an older one."""
    title: str = "Runs"
    """Heading above several runs."""
    json: Path | None = None
    """File for the measured values of all runs, each behind the name of its folder."""


def main(args: Args) -> None:
    if not args.runs:
        raise ValueError("no run: name at least one folder with a report.json")
    reports = [read_report(run) for run in args.runs]
    title = reports[0].title if len(reports) == 1 else args.title
    cli.write_text(args.out, reports_page(title, reports))
    print(f"{args.out}: {', '.join(report.title for report in reports)}")
    if args.json is not None:
        values = {
            f"{run.resolve().name}_{m.key}": m.value
            for run, report in zip(args.runs, reports, strict=True)
            for m in report.table
        }
        cli.write_json(args.json, values)


if __name__ == "__main__":
    cli.run(main, Args)
