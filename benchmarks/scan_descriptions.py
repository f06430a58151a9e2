"""Load every URDF and MJCF file of installed packages, and compare with Pinocchio and MuJoCo.

Each file yields the arm of its only end or, if there are several ends, the arm of each.
Reported are also whether Pinocchio and MuJoCo load the file, and the largest difference of the
flange's pose and Jacobian from theirs in random states. The allowed results of a file are an
arm, or one line with the reason of a refusal. Any other error is shown with its traceback, with
exit status 1.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import sysconfig
import traceback
import warnings
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import torch
from arms_table import largest_difference, mujoco_kinematics, mujoco_model, pinocchio_kinematics
from rich.console import Console

from hrc_learn import cli
from hrc_learn.kinematics import Arm, arm

_SHOWN = Console(soft_wrap=True, highlight=False, markup=False)
_OFFERED = "likeliest first: "


@dataclass(frozen=True, kw_only=True)
class Args:
    folder: Path = Path(sysconfig.get_paths()["purelib"])
    """Folder to search, with all its subfolders."""
    states: int = 20
    """Number of random joint positions in which an arm is compared."""
    ends: int = 10
    """Largest number of ends of a robot that are tried as a tool."""
    json: Path | None = None
    """Receives the counts as one flat object."""


@dataclass
class _Outcome:
    """Result of one file."""

    ours: list[Arm] = field(default_factory=list)
    refusal: str = ""
    theirs: dict[str, str] = field(default_factory=dict)
    """Refusal by library; empty if it loads the file."""
    differences: list[float] = field(default_factory=list)


def main(args: Args) -> int:
    """Load the files, compare, count and print."""
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")  # about meshes and grippers
    counts, worst = Counter[str](), 0.0
    for path in sorted(args.folder.rglob("*")):
        if path.suffix not in (".urdf", ".xml", ".mjcf") or not _describes_a_robot(path):
            continue
        counts["files"] += 1
        try:
            found = _read(path, args)
        except Exception:
            counts["tracebacks"] += 1
            _SHOWN.print(f"{path}: {traceback.format_exc()}")
            continue
        loaded = bool(found.ours)
        agrees = any((not refusal) == loaded for refusal in found.theirs.values())
        counts["loaded" if loaded else "refused"] += 1
        counts["agree"] += agrees
        counts["arms"] += len(found.ours)
        counts["compared"] += len(found.differences)
        worst = max([worst, *found.differences])
        theirs = ", ".join(
            f"{n} {'refuses' if x else 'loads'}" for n, x in found.theirs.items()
        )
        told = (
            found.refusal or f"{len(found.ours)} arms, {max(found.differences, default=0):.0e}"
        )
        _SHOWN.print(
            f"{'' if agrees else 'DIFFERS '}{path.relative_to(args.folder)}: {told} [{theirs}]"
        )
    figures = {**counts, "tracebacks": counts["tracebacks"], "largest_difference": worst}
    _SHOWN.print(figures)
    if args.json is not None:
        cli.write_json(args.json, figures)
    return int(counts["tracebacks"] > 0)


def _describes_a_robot(path: Path) -> bool:
    """True if the first element is that of a URDF or MJCF file, even if the rest is broken."""
    try:
        return ElementTree.parse(path).getroot().tag in ("robot", "mujoco")
    except (ElementTree.ParseError, ValueError):
        return path.suffix == ".urdf"


def _read(path: Path, args: Args) -> _Outcome:
    found = _Outcome()
    try:
        found.ours = _arms(path, args.ends)
    except (ValueError, FileNotFoundError) as error:
        found.refusal = cli.one_line(error)
    readers: dict[str, Callable[[Arm], Any]] = {"MuJoCo": mujoco_kinematics}
    found.theirs["MuJoCo"] = _refusal(lambda: mujoco_model(path))
    if find_spec("pinocchio") is not None:
        readers["Pinocchio"] = pinocchio_kinematics
        found.theirs["Pinocchio"] = _refusal(lambda: _pinocchio_model(path))
    for described in found.ours:
        limits, rng = described.limits, torch.Generator().manual_seed(0)
        shape = (args.states, described.joints)
        fraction = torch.rand(shape, generator=rng, dtype=torch.float64)
        q = limits.lower + (limits.upper - limits.lower) * fraction
        for name, reader in readers.items():
            if not found.theirs[name]:
                try:
                    off = largest_difference(described, q, reader(described))
                # the library has no joint or frame of that name
                except (KeyError, IndexError, ValueError):
                    continue
                found.differences.append(off)
    return found


def _arms(path: Path, most: int) -> list[Arm]:
    """Arms of a file: of its only end, or of several ends."""
    try:
        return [arm(path)]
    except ValueError as error:
        if _OFFERED not in str(error):
            raise
        offered = str(error).partition(_OFFERED)[2].split(", ")
    arms, refusal = [], None
    for tip in offered[:most]:
        try:
            arms.append(arm(path, tip=tip))
        except ValueError as error:
            refusal = error
    if refusal is not None and not arms:
        raise refusal
    return arms


def _refusal(load: Callable[[], object]) -> str:
    try:
        load()
    except (ValueError, RuntimeError) as error:
        return cli.one_line(error) or type(error).__name__
    return ""


def _pinocchio_model(path: Path) -> object:
    import pinocchio  # pyright: ignore[reportMissingImports]

    if path.suffix == ".urdf":
        return pinocchio.buildModelFromUrdf(str(path))
    return pinocchio.buildModelFromMJCF(str(path))


if __name__ == "__main__":
    cli.run(main, Args)
