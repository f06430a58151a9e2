"""`hrc import`: datasets of recordings."""

import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from hrc_learn.cli._run import updated, write_values
from hrc_learn.cli.arguments import Import
from hrc_learn.demos.recording_import import plan_import, write_plan
from hrc_learn.demos.recording_names import ImportOptions
from hrc_learn.store import read_json, read_toml, write_text


def import_recordings(args: Import) -> None:
    """Show what the recordings hold, and convert them."""
    if not args.files:
        raise ValueError("name at least one recording to import")
    if args.out is None and not args.dry_run:
        raise ValueError("name the folder of the new dataset (--out), or give --dry-run")
    template = args.dry_run and args.mapping is not None and not args.mapping.exists()
    options = _import_options(args, None if template else args.mapping)
    plan = plan_import(args.files, options, _words(args.columns))
    for line in plan.lines(args.actions):
        print(line)
    for warning in plan.meaning.warnings:
        print(f"warning: {warning}", file=sys.stderr)
    if template and args.mapping is not None:
        write_text(args.mapping, plan.template())
        print(f"{args.mapping}: a mapping file that says the same; edit it")
    if args.dry_run or args.out is None:
        write_values(args.json, plan.counts())
        return
    summary = write_plan(plan, args.out, args.robot_type, args.actions)
    print(
        f"{args.out}: {summary['episodes']} demonstrations, {summary['frames']} frames, "
        f"{summary['seconds']:.1f} s"
    )
    write_values(args.json, summary)


def _import_options(args: Import, mapping: Path | None) -> ImportOptions:
    """Options of the command line, which come before those of the mapping file."""
    said = ImportOptions()
    if mapping is not None:
        read = read_toml if mapping.suffix == ".toml" else read_json
        said = updated(said, read(mapping), f"{mapping}: ")
    turn = _words(args.orientation)
    columns = {
        "joint_position": _words(args.joints),
        "command_position": _words(args.command),
        "gripper": _words(args.gripper),
        "position": _words(args.position),
        f"quaternion_{args.quaternion_order}": turn,
    }
    given = {name: words for name, words in columns.items() if words}
    return replace(
        said,
        columns=said.columns | given,
        units=said.units | args.units,
        time=args.time or said.time,
        joint_names=tuple(_words(args.joint_names)) or said.joint_names,
        duration=args.duration or said.duration,
        fps=args.fps or said.fps,
        task=said.task if args.task is None else args.task,
    )


def _words(values: Sequence[str]) -> list[str]:
    """Words that are separated by spaces or commas."""
    return [word for value in values for word in value.split(",") if word]
