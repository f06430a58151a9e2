"""Import public recordings with `hrc import`: count correct, unclear and wrong columns; train.

The meaning of every column was determined by hand, from the sources named in this file. The
recordings are not part of the project: put each repository, or the named files, into a folder
OWNER+NAME.

    python benchmarks/bench_recordings.py --folder FOLDER --train --json figures.json
"""

import os
import sys
import tempfile
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

os.environ["HF_HUB_OFFLINE"] = "1"
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

import numpy as np
from lerobot_folders import one_step_of_act  # pyright: ignore[reportMissingImports]
from rich.console import Console
from rich.table import Table

from hrc_learn import cli
from hrc_learn.demos import DatasetError
from hrc_learn.demos.recording_import import ImportPlan, plan_import, write_plan
from hrc_learn.demos.recording_names import ImportOptions

STATE_AND_ACTION = {"observation.state": "?", "action": "?"}


@dataclass(frozen=True, kw_only=True)
class Public:
    """One public recording and its contents."""

    path: str
    """File or folder below the folder of all recordings."""
    licence: str
    expected: dict[str, str]
    """Quantity -> unit on disk; "?" for columns that nothing documents, kept as recorded."""
    options: ImportOptions = field(default_factory=ImportOptions)
    """Options that a user has to know and give."""
    columns: tuple[str, ...] = ()


RECORDINGS = (
    Public(
        # columns t and q of the text file
        path="mosesnah-shared+ModularRobotControl/pour_demo1.npz",
        licence="MIT",
        expected={"joint_position": "rad"},
    ),
    Public(
        path="mosesnah-shared+DMP-MATLAB/iiwa_example1_pose.npz",
        licence="MIT",
        expected={"joint_position": "rad", "position": "m", "rotation_matrix": "1"},
    ),
    Public(
        path="sayantanauddy+clfd-snode/datasets/robottasks/pos_ori/pouring.npy",
        licence="MIT",
        expected={"position": "cm", "quaternion_wxyz": "1"},
        options=ImportOptions(duration=5, units={"position": "cm"}),
        columns=("px", "py", "pz", "qw", "qx", "qy", "qz"),
    ),
    Public(
        path="octo-models+octo/tests/debug_dataset/bridge_dataset/1.0.0",
        licence="MIT",
        expected=STATE_AND_ACTION,
        options=ImportOptions(fps=5),
    ),
    Public(  # xArm: millimetres and degrees, by the manufacturer's SDK
        path="BAEK26+lfd/data/first_attempt_pouring",
        licence="none stated",
        expected={
            "position": "mm",
            "euler_xyz": "deg",
            "joint_position": "deg",
            "gripper": "1",
        },
        options=ImportOptions(units={"position": "mm"}),
    ),
    Public(  # UR: the manufacturer's RTDE guide
        path="moelyaakoubi+GUI-RTDE/robot_data.csv",
        licence="none stated",
        expected={
            "joint_position": "rad",
            "joint_velocity": "rad/s",
            "command_position": "rad",
            "command_velocity": "rad/s",
            "position": "m",
            "rotation_vector": "rad",
        },
    ),
    Public(
        path="Himanshu12328+7DOF_Robotic_Manipulation_IL/data/demos.hdf5",
        licence="none stated",
        expected=STATE_AND_ACTION,
        options=ImportOptions(fps=20),
    ),
    Public(
        path="Slifer64+DMPM/data/demos.mat",
        licence="none stated",
        expected={"observation.state": "?"},
        options=ImportOptions(columns={"observation.state": "demo_data"}, time="Time", fps=250),
    ),
    Public(
        path="Slifer64+DMPM/data/data.mat",
        licence="none stated",
        expected={"observation.state": "?"},
        options=ImportOptions(columns={"observation.state": "Y"}, time="Time"),
    ),
    Public(
        path="nvidia+Isaac-GR00T/data/chunk-000/episode_000000.parquet",
        licence="Apache-2.0",
        expected=STATE_AND_ACTION,
    ),
)


@dataclass(frozen=True, kw_only=True)
class Args:
    folder: Path
    """Folder of the recordings."""
    train: bool = False
    """Train LeRobot's ACT on each dataset for 20 steps."""
    json: Path | None = None
    """File for the measured values, one flat JSON object of numbers."""


def main(args: Args) -> int:
    """Import all recordings and count; status 1 if a column is wrong."""
    table = Table("recording", "licence", "right", "asked", "wrong", "episodes", "trained")
    total: Counter[str] = Counter()
    for public in RECORDINGS:
        path = args.folder / public.path
        if not path.exists():
            table.add_row(public.path, public.licence, "not there")
            continue
        found = judged(path, public)
        with tempfile.TemporaryDirectory() as folder:
            plan = plan_import([path], public.options, public.columns)
            wrong = compared(plan, public)["wrong"]
            summary = write_plan(plan, Path(folder) / "set", "unknown", True)
            trained = args.train and np.isfinite(one_step_of_act(Path(folder) / "set", 20))
        found["wrong"] += wrong
        total += found + Counter(recordings=1, trained=int(trained))
        counts = [str(found[name]) for name in ("right", "asked", "wrong")]
        row = (public.path, public.licence, *counts, str(summary["episodes"]))
        table.add_row(*row, "yes" if trained else "no")
    Console().print(table)
    names = ("recordings", "right", "asked", "wrong", "trained")
    cli.write_values(args.json, {name: total[name] for name in names})
    return int(total["wrong"] > 0)


def judged(path: Path, public: Public) -> Counter[str]:
    """Quantities that are correct, unclear (the import asks) and wrong, without user input."""
    silent = ImportOptions(fps=public.options.fps, duration=public.options.duration)
    try:
        return compared(plan_import([path], silent, public.columns), public)
    except DatasetError:
        return Counter(asked=len(public.expected))


def compared(plan: ImportPlan, public: Public) -> Counter[str]:
    """The same counts for a plan."""
    meaning, counts = plan.meaning, Counter[str]()
    found = {role: decision.unit for role, decision in meaning.decisions.items()}
    found |= dict.fromkeys(meaning.kept, "?")
    for role in public.expected.keys() | found.keys():
        if role not in found:
            counts["asked"] += 1  # listed among the fields that are left out
        else:
            counts["right" if found[role] == public.expected.get(role) else "wrong"] += 1
    return counts


if __name__ == "__main__":
    cli.run(main, Args)
