"""Turn recordings kept as plain arrays (.npz, .npy, .csv) into a LeRobot dataset.

Each file is one demonstration; an array of three axes (demonstrations, frames, components)
is as many as it holds. The stamps are kept as they are in `observation.time`, whatever the
frame rate LeRobot counts by.

    import_arrays.py pour.npz --out pour --joints q --time t
    import_arrays.py shelf.npy --out shelf --columns px,py,pz,qw,qx,qy,qz --duration 5
    import_arrays.py run1.csv run2.csv --out runs --joints j1,j2,j3,j4,j5,j6 --time stamp
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from hrc_learn import cli
from hrc_learn.demos import DatasetWriter, Demonstration
from hrc_learn.demos.read.arrays import ArraySources, demonstrations_from_table, read_table


@dataclass(frozen=True, kw_only=True)
class Args:
    files: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Recordings to import."""
    out: Path
    """Folder of the dataset to write; must not exist."""
    joints: str | None = None
    """Array with the joint positions, or columns joined by commas."""
    position: str | None = None
    """Array with the end effector's position, or columns joined by commas."""
    orientation: str | None = None
    """Array with its orientation (quaternion or rotation vector), or columns."""
    time: str | None = None
    """Array or column with the stamps."""
    columns: str = ""
    """Names of the columns of a .npy file, or of a .csv without a header, joined by commas.
    px,py,pz and qw,qx,qy,qz are poses, t is time, others are joints."""
    joint_names: tuple[str, ...] = ()
    """Names of the joints; joint1, joint2, ... where not given."""
    duration: float | None = None
    """Length of each demonstration [s] where there are no stamps."""
    fps: float | None = None
    """Frame rate [1/s] where there are no stamps."""
    joint_unit: Literal["rad", "deg"] = "rad"
    """Unit of the joint positions."""
    position_unit: Literal["m", "cm", "mm"] = "m"
    """Unit of the positions."""
    time_unit: Literal["s", "ms", "us", "ns"] = "s"
    """Unit of the stamps."""
    quaternion_order: Literal["wxyz", "xyzw"] = "wxyz"
    """Order of a quaternion's components."""
    robot_type: str = "unknown"
    """Name of the robot, kept in the dataset."""
    task: str | None = None
    """What was shown, in words; the file's name where not given."""
    dtype: Literal["float32", "float64"] = "float32"
    """Type on disk; LeRobot's policies want float32."""
    json: Path | None = None
    """Receives the counts as one flat object."""


def main(args: Args) -> None:
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
        cli.write_json(args.json, summary)


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


if __name__ == "__main__":
    cli.run(main, Args)
