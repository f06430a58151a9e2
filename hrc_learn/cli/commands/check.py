"""`hrc check`, `hrc repair`, `hrc recover`: errors in a dataset, and their repair."""

import json
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path

from rich.progress import track

from hrc_learn.cli._run import configuration, write_values
from hrc_learn.cli.arguments.dataset import Check, Recover, Repair
from hrc_learn.demos import (
    RepairOptions,
    check_dataset,
    load_demos,
    recover_all,
    repair_dataset,
)
from hrc_learn.demos.format.dataset_folder import open_folder
from hrc_learn.demos.format.metadata import SIDECAR_PATH
from hrc_learn.demos.issues import ValidationReport
from hrc_learn.demos.read.contract import Contract, keep_contract
from hrc_learn.jacobian import camera_placements
from hrc_learn.learning.visual_servo_fitting import feature_trajectories
from hrc_learn.store import new_folder, write_json, write_text
from hrc_learn.vision.camera_model import IMAGE_SIZE


def columns(mapping: Mapping[str, str]) -> dict[str, str | list[str]]:
    """Columns by quantity as typed: a feature, a range of it, or names joined by commas."""
    return {role: text.split(",") if "," in text else text for role, text in mapping.items()}


def check(args: Check) -> int:
    """Check the dataset and print the findings.

    Raises:
        FileNotFoundError: There is no dataset.
        ValueError: Options name what does not exist, or there is nothing to keep a contract of
            or to tell the camera's place by; the findings are written before.
    """
    if not args.dataset.is_dir():
        raise FileNotFoundError(f"there is no dataset at {args.dataset}")
    report = check_dataset(
        args.dataset,
        columns(args.mapping),
        units=args.units,
        speed_limits=args.speed_limits,
    )
    contract = report.contract
    if contract is not None:
        print(*contract.lines(), "", sep="\n")
    print(*report.lines(full=args.full), sep="\n")
    counts = {
        "errors": len(report.errors),
        "warnings": len(report.warnings),
        "episodes": report.episodes,
        "frames": report.frames,
    }
    moved = False
    try:
        if args.keep_contract:
            _keep(args.dataset, contract)
        if args.camera:
            moved = _camera_moved(args)
            counts["camera_moved"] = int(moved)
    finally:
        _write(args, report, counts)
    return int(bool(report.errors or (args.strict and (report.warnings or moved))))


def _keep(dataset: Path, contract: Contract | None) -> None:
    if contract is None:
        raise ValueError(f"{dataset}: nothing could be read to keep a contract of")
    contract.selections(open_folder(dataset).features)  # refuses what nobody could read
    keep_contract(dataset, contract)
    print(f"contract kept in {dataset / SIDECAR_PATH}: edit it there")


def _write(args: Check, report: ValidationReport, counts: Mapping[str, int]) -> None:
    findings = json.dumps(report.records(), indent=2) + "\n"
    if args.out is not None:
        with new_folder(args.out, configuration(args), args.overwrite) as folder:
            write_text(folder / "findings.json", findings)
            write_json(folder / "metrics.json", counts)
            if report.contract is not None:
                text = json.dumps(report.contract.content(), indent=2) + "\n"
                write_text(folder / "contract.json", text)
    if args.findings is not None:
        write_text(args.findings, findings)
    write_values(args.json, counts)


def _camera_moved(args: Check) -> bool:
    """Whether the camera was moved between episodes; prints where it stood in which."""
    demos = load_demos(args.dataset, mapping=columns(args.mapping), units=args.units)
    placements = camera_placements(list(feature_trajectories(demos)), IMAGE_SIZE)
    if not placements:
        print("camera: the marker is seen in fewer than two episodes, nothing to compare")
    for number, placement in enumerate(placements):
        episodes = ", ".join(str(demos[index].episode) for index in placement.episodes)
        found = placement.motion if number else "camera stood still"
        print(f"{found} in episodes {episodes}")
    return len(placements) > 1


def repair(args: Repair) -> None:
    """Repair the dataset and print what was changed."""
    # The options of both go by the same names.
    options = RepairOptions(
        **{field.name: getattr(args, field.name) for field in fields(RepairOptions)}
    )
    report = repair_dataset(
        args.dataset,
        args.folder,
        options,
        mapping=columns(args.mapping),
        units=args.units,
        progress=lambda episodes: track(episodes, description="Repairing"),
    )
    print(report)
    counts = {
        "episodes": len(report.changes),
        "episodes_changed": report.changed,
        "episodes_left_out": len(report.left_out),
        "frames_before": report.frames_before,
        "frames": report.frames,
    }
    write_values(args.json, counts)


def recover(args: Recover) -> None:
    """Finish or remove what a process that was killed left behind."""
    done = recover_all(args.path)
    if not done and not args.path.exists():
        raise FileNotFoundError(f"there is nothing at {args.path}, nor was it being written")
    for mended in done:
        print(mended)
    if not done:
        print(f"{args.path}: nothing to recover")
    write_values(args.json, {"mended": len(done)})
