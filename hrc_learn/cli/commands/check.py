"""`hrc check`: what is wrong with a dataset, and where."""

import json

from hrc_learn.cli._values import configuration, write_json, write_text
from hrc_learn.cli.arguments.dataset import Check as Args
from hrc_learn.demos import check_dataset
from hrc_learn.store import new_folder


def run(args: Args) -> int:
    """Check the dataset and print the findings."""
    if not args.dataset.is_dir():
        raise FileNotFoundError(f"there is no dataset at {args.dataset}")
    report = check_dataset(args.dataset, units=args.units, speed_limits=args.speed_limits)
    print(report)
    findings = json.dumps(report.records(), indent=2) + "\n"
    counts = {
        "errors": len(report.errors),
        "warnings": len(report.warnings),
        "episodes": report.episodes,
        "frames": report.frames,
    }
    if args.out is not None:
        with new_folder(args.out, configuration(args), args.overwrite) as folder:
            write_text(folder / "findings.json", findings)
            write_json(folder / "metrics.json", counts)
    if args.findings is not None:
        write_text(args.findings, findings)
    if args.json is not None:
        write_json(args.json, counts)
    return int(bool(report.errors or (args.strict and report.warnings)))
