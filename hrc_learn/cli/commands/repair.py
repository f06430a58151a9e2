"""`hrc repair`: what can be mended of a dataset, in a copy."""

from dataclasses import fields

from rich.progress import track

from hrc_learn.cli._values import write_json
from hrc_learn.cli.arguments.dataset import Repair as Args
from hrc_learn.demos.repair import RepairOptions, repair_dataset


def run(args: Args) -> None:
    """Repair the dataset and print what was changed."""
    # The options of both go by the same names.
    options = RepairOptions(
        **{field.name: getattr(args, field.name) for field in fields(RepairOptions)}
    )
    report = repair_dataset(
        args.dataset,
        args.folder,
        options,
        units=args.units,
        progress=lambda episodes: track(episodes, description="Repairing"),
    )
    print(report)
    if args.json:
        counts = {
            "episodes": len(report.changes),
            "episodes_changed": report.changed,
            "episodes_left_out": len(report.left_out),
            "frames_before": report.frames_before,
            "frames": report.frames,
        }
        write_json(args.json, counts)
