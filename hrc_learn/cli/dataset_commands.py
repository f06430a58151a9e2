"""`hrc import`, `check`, `repair`, `merge`, `curate`, `push`: making and repairing datasets."""

import sys
import webbrowser
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from rich.console import Console
from rich.progress import track

from hrc_learn.cli._run import configuration, has_screen, one_line, updated, write_values
from hrc_learn.cli.arguments import Check, Curate, Import, Merge, Push, Repair, columns
from hrc_learn.demos import (
    RepairOptions,
    check_dataset,
    load_demos,
    merge_datasets,
    recover_all,
    repair_dataset,
)
from hrc_learn.demos.issues import counted
from hrc_learn.demos.quality.ranking import (
    Decision,
    Decisions,
    Ranking,
    Verdict,
    decisions_path,
    keep_decisions,
    rank_episodes,
    read_decisions,
    write_curated,
)
from hrc_learn.demos.read.contract import Contract, keep_contract
from hrc_learn.demos.read.dataset_folder import open_folder
from hrc_learn.demos.read.metadata import SIDECAR_PATH
from hrc_learn.demos.recording_import import plan_import, write_plan
from hrc_learn.demos.recording_names import ImportOptions
from hrc_learn.jacobian import camera_placements
from hrc_learn.kinematics import ArmChoice
from hrc_learn.learning.visual_servo_fitting import feature_trajectories
from hrc_learn.store import new_folder, read_json, read_toml, write_json, write_text
from hrc_learn.vision.camera_model import IMAGE_SIZE

_SKIPPED = {"trim": "trim", "unwrap": "unwrap", "signs": "fix_signs", "late": "drop_late"}
"""Word of `--skip` -> option of a repair."""
_RANKED_LINES = 20
"""Episodes of a ranking that fit on a screen."""


def import_recordings(args: Import) -> None:
    """Show what the recordings hold, and convert them."""
    if args.out is None and not args.dry_run:
        raise ValueError("name the folder of the new dataset (--out), or give --dry-run")
    template = args.dry_run and args.mapping is not None and not args.mapping.exists()
    options = _import_options(args, None if template else args.mapping)
    with Console().status("Reading"):
        plan = plan_import(args.files, options, _words(args.columns))
    for line in plan.lines(args.actions):
        print(line)
    for warning in plan.meaning.warnings:
        print(f"warning: {warning}", file=sys.stderr)
    if template and args.mapping is not None:
        write_text(args.mapping, plan.template())
        print(f"{args.mapping}: a mapping file with this meaning; edit it")
    if args.dry_run or args.out is None:
        write_values(args.json, plan.counts())
        return
    with Console().status(f"Writing {args.out}"):
        summary = write_plan(plan, args.out, args.robot_type, args.actions)
    print(
        f"{args.out}: {summary['episodes']} demonstrations, {summary['frames']} frames, "
        f"{summary['seconds']:.1f} s"
    )
    write_values(args.json, summary)


def _import_options(args: Import, mapping: Path | None) -> ImportOptions:
    """Options of the mapping file, overridden by those of the command line."""
    said = ImportOptions()
    if mapping is not None:
        read = read_toml if mapping.suffix == ".toml" else read_json
        said = updated(said, read(mapping), f"{mapping}: ")
    fields = {
        "joint_position": _words(args.joints),
        "command_position": _words(args.command),
        "gripper": _words(args.gripper),
        "position": _words(args.position),
        f"quaternion_{args.quaternion_order}": _words(args.orientation),
    }
    given = {name: words for name, words in fields.items() if words}
    own = {"duration": args.duration, "fps": args.fps, "task": args.task}
    own |= {"time": args.time or None, "joint_names": tuple(_words(args.joint_names)) or None}
    own = {name: value for name, value in own.items() if value is not None}
    return replace(said, columns=said.columns | given, units=said.units | args.units, **own)


def _words(values: Sequence[str]) -> list[str]:
    """Words that are separated by spaces or commas."""
    return [word for value in values for word in value.split(",") if word]


def check(args: Check) -> int:
    """Check the dataset and print the findings.

    Raises:
        FileNotFoundError: There is no dataset.
        ValueError: An option names something that does not exist, no columns could be read for
            the contract (the meaning of the columns), or there is no marker for `--camera`. The
            findings are printed before an error of the contract or the camera is raised.
    """
    if not args.dataset.is_dir() or not any(args.dataset.iterdir()):  # not an error in the data
        raise FileNotFoundError(f"there is no dataset at {args.dataset}")
    robot = ArmChoice(args.robot).arm() if args.robot else None
    with Console().status(f"Checking {args.dataset}"):
        report = check_dataset(args.dataset, columns(args.mapping), args.units, robot)
    if report.contract is not None:
        print(*report.contract.lines(), "", sep="\n")
    print(*report.lines(full=args.full), sep="\n")
    counts = {"errors": len(report.errors), "warnings": len(report.warnings)}
    counts |= {"episodes": report.episodes, "frames": report.frames}
    moved = False
    try:
        if args.keep_contract:
            _store_contract(args.dataset, report.contract)
        if args.camera:
            moved = _camera_moved(args)
            counts["camera_moved"] = int(moved)
    finally:
        if args.out is not None:
            with new_folder(args.out, configuration(args), args.overwrite) as folder:
                write_json(folder / "findings.json", report.records())
                write_json(folder / "metrics.json", counts)
                if report.contract is not None:
                    write_json(folder / "contract.json", report.contract)
        write_values(args.json, counts)
    return int(bool(report.errors or (args.strict and (report.warnings or moved))))


def _store_contract(dataset: Path, contract: Contract | None) -> None:
    if contract is None:
        raise ValueError(f"{dataset}: no columns could be read, so no contract is stored")
    contract.selections(open_folder(dataset).features)  # refuses an unreadable contract
    sure, doubtful = contract.without_doubt()
    keep_contract(dataset, sure)
    print(f"contract stored in {dataset / SIDECAR_PATH}: edit it there")
    if doubtful:
        print(f"note: unit left open, as the evidence is weak: {', '.join(doubtful)}")


def _camera_moved(args: Check) -> bool:
    """True if the camera was moved between episodes; prints its places."""
    demos = load_demos(args.dataset, mapping=columns(args.mapping), units=args.units)
    placements = camera_placements(list(feature_trajectories(demos)), IMAGE_SIZE)
    if not placements:
        print("camera: the marker is visible in fewer than two episodes, nothing to compare")
    for number, placement in enumerate(placements):
        episodes = ", ".join(str(demos[index].episode) for index in placement.episodes)
        found = placement.motion if number else "camera stood still"
        print(f"{found} in episodes {episodes}")
    return len(placements) > 1


def repair(args: Repair) -> None:
    """Finish what a killed process left; repair the dataset and print the changes."""
    mended = [] if args.dry_run else recover_all(args.dataset)
    print(*mended, sep="\n", end="\n" if mended else "")
    if mended and args.out is None:
        write_values(args.json, {"mended": len(mended)})
        return
    options = RepairOptions(
        **{name: word not in args.skip for word, name in _SKIPPED.items()},
        **{f"drop_{word.replace('-', '_')}": True for word in args.drop},
        offsets=args.offsets,
        fps=args.fps,
        videos=args.videos,
        dry_run=args.dry_run,
    )
    report = repair_dataset(
        args.dataset,
        args.folder,
        options,
        mapping=columns(args.mapping),
        units=args.units,
        progress=partial(track, description="Repairing"),
    )
    print(report)
    counts = {"mended": len(mended), "episodes": len(report.changes)}
    counts |= {"episodes_changed": report.changed, "episodes_left_out": len(report.left_out)}
    counts |= {"frames_before": report.frames_before, "frames": report.frames}
    write_values(args.json, counts)


def merge(args: Merge) -> None:
    """Merge the datasets and print their differences."""
    with Console().status(f"Merging {len(args.datasets)} datasets"):
        report = merge_datasets(args.datasets, args.out, fps=args.fps, videos=args.videos)
    print(report)
    counts = {name: getattr(report, name) for name in ("episodes", "frames", "tasks")}
    write_values(args.json, counts | {"notes": len(report.notes)})


def curate(args: Curate) -> None:
    """Rank the episodes and decide which of them stay, in the browser or the terminal.

    Raises:
        ValueError: There is no dataset, an episode is named twice or does not exist, or a cut
            leaves nothing.
    """
    named = Counter([*args.accept, *args.cut, *args.reject])
    if twice := [episode for episode, count in named.items() if count > 1]:
        raise ValueError(
            f"--accept, --cut and --reject name episode {min(twice)} twice: name it once"
        )
    progress = partial(track, transient=True)
    ranking = rank_episodes(args.dataset, partial(progress, description="Ranking"))
    decisions = _typed_decisions(args, ranking)
    if args.browser and not args.write:
        decisions = _browser_decisions(args, ranking)
    else:
        print(*ranking.lines(_RANKED_LINES), sep="\n")
    values = {
        "episodes": len(ranking.episodes),
        "episodes_in_doubt": sum(q.score > 0 for q in ranking.episodes),
        "episodes_broken": sum(q.broken for q in ranking.episodes),
        "episodes_rejected": sum(d.verdict == "reject" for d in decisions.values()),
        "episodes_cut": sum(d.verdict == "cut" for d in decisions.values()),
    }
    if args.write:
        writing = partial(progress, description="Writing")
        report = write_curated(args.dataset, args.folder, decisions, progress=writing)
        values["frames"] = report.frames
        print(report)
    elif decisions:
        print(
            f"decisions stored in {decisions_path(args.dataset)}; hrc curate {args.dataset} "
            f"--write makes the cleaned dataset"
        )
    write_values(args.json, values)


def _typed_decisions(args: Curate, ranking: Ranking) -> Decisions:
    """Stored decisions, updated with those of the command line and stored again."""
    decisions = read_decisions(args.dataset)
    lengths = {quality.episode: quality.length for quality in ranking.episodes}
    typed: dict[int, tuple[Verdict, str]] = {
        **dict.fromkeys(args.accept, ("accept", "")),
        **{episode: ("cut", text) for episode, text in args.cut.items()},
        **dict.fromkeys(args.reject, ("reject", "")),
    }
    if unknown := sorted(typed.keys() - lengths.keys()):
        raise ValueError(
            f"there is no episode {unknown[0]}; the dataset has {min(lengths)} to "
            f"{max(lengths)}"
        )
    for episode, (verdict, text) in typed.items():
        try:
            start, stop = (int(part) for part in text.split(":")) if text else (0, 0)
            decisions[episode] = Decision(
                verdict=verdict, length=lengths[episode], start=start, stop=stop
            )
        except ValueError as error:
            raise ValueError(
                f"--cut {episode} {text}: give the first frame to keep and the one after the "
                f"last, such as 30:410; the episode has {lengths[episode]} ({error})"
            ) from error
    if typed:
        keep_decisions(args.dataset, decisions)
    return decisions


def _browser_decisions(args: Curate, ranking: Ranking) -> Decisions:
    """Serve the page until Ctrl-C and return the decisions made there."""
    # Imported here: the terminal does not need the page's server.
    from hrc_learn.teleoperation.curation_page import CurationPage
    from hrc_learn.teleoperation.gate.address import AddressConfig

    console = Console()
    page = CurationPage(ranking, args.folder, AddressConfig(port=args.port))
    with page:
        console.print(f"Page at [bold]{page.url}[/] (Ctrl-C ends it)", soft_wrap=True)
        if has_screen():
            webbrowser.open(page.url)
        try:
            page.wait()
        except KeyboardInterrupt:
            print()
        return dict(page.decisions)


def push(args: Push) -> int:
    """Check the dataset, and have LeRobot upload it with a card and a tag.

    Raises:
        ValueError: The dataset has errors, or the Hub does not accept the name `args.repo`.
    """
    from huggingface_hub.utils import validate_repo_id

    validate_repo_id(args.repo)
    with Console().status(f"Checking {args.dataset}"):
        report = check_dataset(args.dataset)
    if report.errors and not args.unsound:
        text = f"{args.dataset} has errors: repair it, or upload it anyway (--unsound). First:"
        raise ValueError(f"{text} {report.errors[0]}")
    sizes = [path.stat().st_size for path in args.dataset.rglob("*") if path.is_file()]
    print(f"{counted(len(sizes), 'file')}, {sum(sizes) / 1e6:.1f} MB", flush=True)
    counts = {"errors": len(report.errors), "warnings": len(report.warnings)}
    write_values(args.json, {"files": len(sizes), "bytes": sum(sizes)} | counts)
    if args.dry_run:
        return 0
    from httpx import TransportError
    from huggingface_hub.errors import HfHubHTTPError
    from lerobot.datasets import LeRobotDataset

    dataset = LeRobotDataset(args.repo, root=args.dataset)
    try:
        dataset.push_to_hub(tags=[*args.tags], license=args.license, private=args.private)
    except (HfHubHTTPError, TransportError) as error:
        print(f"error: not uploaded (`hf auth login`?): {one_line(error)}", file=sys.stderr)
        return 1
    print(f"uploaded to {args.repo}")
    return 0
