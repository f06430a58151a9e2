"""`hrc import`: arrays to a dataset."""

from pathlib import Path

from hrc_learn.cli._values import write_json
from hrc_learn.cli.arguments.dataset import ImportArrays as Args
from hrc_learn.demos import DatasetWriter, Demonstration
from hrc_learn.demos.read.arrays import ArraySources, demonstrations_from_table, read_table


def run(args: Args) -> None:
    """Import the recordings."""
    if not args.files:
        raise ValueError("name at least one recording to import")
    demos = [demo for path in args.files for demo in read(args, path)]
    rates = sorted({demo.fps for demo in demos})
    if len({demo.joint_names for demo in demos}) > 1 or len(rates) > 1:
        raise ValueError(
            f"the files do not fit into one dataset: joints "
            f"{sorted({len(demo.joint_names) for demo in demos})}, frame rates {rates} Hz "
            f"(give --fps to count all alike; stamps are kept)"
        )
    with DatasetWriter(
        args.out, rates[0], args.robot_type, demos[0].joint_names, dtype=args.dtype
    ) as writer:
        for demo in demos:
            writer.add_episode(demo)
    summary = {
        "episodes": len(demos),
        "frames": sum(map(len, demos)),
        "seconds": sum(demo.duration for demo in demos),
        "fps": rates[0],
    }
    print(
        f"{args.out}: {summary['episodes']} demonstrations, {summary['frames']} frames, "
        f"{summary['seconds']:.1f} s"
    )
    if args.json:
        write_json(args.json, summary)


def read(args: Args, path: Path) -> list[Demonstration]:
    """Demonstrations of one file."""
    sources = ArraySources(
        joints=args.joints,
        position=args.position,
        orientation=args.orientation,
        time=args.time,
    )
    return demonstrations_from_table(
        read_table(path, [name for name in args.columns.split(",") if name]),
        sources,
        path=path,
        units={
            "joint_position": args.joint_unit,
            "position": args.position_unit,
            "time": args.time_unit,
        },
        quaternion_order=args.quaternion_order,
        joint_names=args.joint_names,
        duration=args.duration,
        fps=args.fps,
        task=path.stem if args.task is None else args.task,
    )
