"""Load every URDF and MJCF file of installed packages that is no registered arm's.

Each as `--robot FILE` does and, where that asks which of several ends is the tool, with each
end that something moves. What comes of a file is an arm, or one line that says what is
missing or why not; anything else is shown with its traceback and ends this with status 1. Of
each arm the flange's pose and Jacobian in random states are compared with MuJoCo's reading of
the same file, where MuJoCo reads it.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import sysconfig
import traceback
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import torch
from arms_table import largest_difference, mujoco_kinematics
from rich.console import Console

from hrc_learn import cli
from hrc_learn.kinematics import Arm, MissingModelError, arm, registered_arms
from hrc_learn.kinematics._mjcf import read_mjcf
from hrc_learn.kinematics._urdf import read_urdf
from hrc_learn.kinematics.described_arm import arm_from_description

# What a user's mistake, or a file's, is told by: `hrc` prints these in one line.
_TOLD = (ValueError, FileNotFoundError)
_SHOWN = Console(soft_wrap=True, highlight=False, markup=False)


@dataclass(frozen=True, kw_only=True)
class Args:
    folder: Path = Path(sysconfig.get_paths()["purelib"])
    """Searched with all that is below it."""
    states: int = 100
    """Random joint positions in which an arm is compared with MuJoCo."""
    ends: int = 10
    """Of the ends of a robot so many at most are taken for a tool."""
    shapes: bool = False
    """Also fit capsules to an arm of each file, some seconds each."""
    json: Path | None = None
    """Receives the counts as one flat object."""


def main(args: Args) -> int:
    """Load, compare, count, print."""
    torch.set_num_threads(1)
    counts, worst = Counter[str](), 0.0
    for path in _files(args.folder):
        shown = str(path.relative_to(args.folder))
        if not _describes_a_robot(path):
            counts["other_xml"] += 1
            counts["tracebacks"] += _ends_otherwise(path)
            continue
        counts["files"] += 1
        try:
            arms = list(_arms(path, args.ends))
            outcome = f"{len(arms)} arm" + "s" * (len(arms) > 1)
            counts["loaded"] += 1
            counts["arms"] += len(arms)
            for described in arms:
                off = _difference(described, args.states)
                counts["compared"] += off is not None
                worst = max(worst, off or 0.0)
                if off is not None:
                    outcome += f", {off:.0e}"
            if args.shapes:
                outcome += f", {len(arms[0].body.capsules)} capsules"
        except _TOLD as error:
            outcome = f"{type(error).__name__}: {cli.one_line(error)}"
            counts["refused"] += 1
        except Exception:
            counts["tracebacks"] += 1
            outcome = traceback.format_exc()
        _SHOWN.print(f"{shown}: {outcome}")
    figures = {**counts, "tracebacks": counts["tracebacks"], "largest_difference": worst}
    _SHOWN.print(figures)
    if args.json is not None:
        cli.write_json(args.json, figures)
    return int(counts["tracebacks"] > 0)


def _files(folder: Path) -> list[Path]:
    registered = set[Path]()
    for name in registered_arms():
        try:
            description = arm(name).description
        except MissingModelError:
            continue
        if description is not None:
            registered.add(description.resolve())
    found = [path for path in folder.rglob("*") if path.suffix in (".urdf", ".xml", ".mjcf")]
    return sorted(path for path in found if path.resolve() not in registered)


def _describes_a_robot(path: Path) -> bool:
    """Whether it is a URDF or MJCF file by its first element, however broken otherwise."""
    try:
        return ElementTree.parse(path).getroot().tag in ("robot", "mujoco")
    except ElementTree.ParseError:
        return path.suffix == ".urdf"


def _ends_otherwise(path: Path) -> bool:
    """Whether anything but one line is said of a file that describes no robot."""
    try:
        arm(path)
    except _TOLD:
        return False
    except Exception:
        _SHOWN.print(f"{path}: {traceback.format_exc()}")
    return True


def _arms(path: Path, most: int) -> Iterator[Arm]:
    """The arm of a file, or that of each of its ends."""
    try:
        yield arm(path)
        return
    except ValueError as error:
        if "say which is the tool" not in str(error):
            raise
    read = read_urdf if path.suffix == ".urdf" else read_mjcf
    description = read(path)
    ends = [link for link in description.links if not description.below(link)]
    refusals, loaded = [], 0
    for tip in ends:
        if loaded == most:
            break
        try:
            found = arm_from_description(description, tip=tip)
        except _TOLD as error:
            refusals.append(error)
            continue
        loaded += 1
        yield found
    if not loaded:
        raise refusals[0]


def _difference(described: Arm, states: int) -> float | None:
    """From MuJoCo; None where it does not read the file, or does not name its joints."""
    limits, rng = described.chain.limits, torch.Generator().manual_seed(0)
    share = torch.rand(states, len(limits.lower), generator=rng, dtype=torch.float64)
    try:
        see = mujoco_kinematics(described)
    except (ValueError, KeyError):  # KeyError: of joints without names
        return None
    q = limits.lower + (limits.upper - limits.lower) * share
    return largest_difference(described, q, see)


if __name__ == "__main__":
    cli.run(main, Args)
