"""CPU time and memory of the commands that read datasets, on very large datasets.

By default, one dataset has 10,000 episodes of 100 frames and 14 numbers, a million frames; the
other has four episodes of an hour at 50 Hz. A dataset of ten episodes measures the cost of
imports. Each command runs in its own process, whose largest resident memory is reported. In
addition, a recording with as many episodes is killed before it ends, and then recovered.

    python benchmarks/bench_big_sets.py --commands fit curate
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import shutil
import signal
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from multiprocessing import Process
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from hrc_learn import cli
from hrc_learn.demos import DatasetWriter

JOINTS = tuple(f"joint{k}" for k in range(7))
_FPS = 50
_HOUR = 3600 * _FPS  # frames
COMMANDS = ("check", "fit", "evaluate", "show", "curate", "repair", "recover")


@dataclass(frozen=True, kw_only=True)
class Args:
    """Sizes of the datasets, and commands to run on them."""

    episodes: int = 10_000
    """Number of episodes of the dataset with many episodes."""
    frames: int = 100
    """Number of frames in each of these episodes."""
    hours: int = 4
    """Number of one-hour episodes of the dataset with long episodes; 0: no such dataset."""
    commands: tuple[str, ...] = COMMANDS
    """Commands to run."""
    folder: Path | None = None
    """Folder in which the datasets are made and kept. Default: a temporary folder."""
    json: Path | None = None
    """File for the measured values, one flat JSON object of numbers."""


@dataclass(frozen=True)
class Set:
    """A dataset of one size; commands write next to it."""

    name: str
    episodes: int
    frames: int
    folder: Path

    @property
    def root(self) -> Path:
        """Folder of the dataset."""
        return self.folder / "set"


@dataclass(frozen=True)
class Used:
    """CPU time and memory of a process."""

    seconds: float
    """CPU time [s]."""
    memory: float
    """Largest resident memory [MiB]."""
    status: int


def main(args: Args) -> int:
    """Make the datasets, run the commands and print a table."""
    if unknown := set(args.commands) - set(COMMANDS):
        raise ValueError(f"there is no command {min(unknown)}; there are {', '.join(COMMANDS)}")
    table = Table("command", "set", "CPU [s]", "memory [MiB]", "status")
    figures: dict[str, float] = {}
    with tempfile.TemporaryDirectory() as temporary:
        folder = args.folder or Path(temporary)
        sizes = {
            "few": (10, args.frames),
            "many": (args.episodes, args.frames),
            "hours": (args.hours, _HOUR),
        }
        for name, (episodes, frames) in sizes.items():
            if not episodes:
                continue
            dataset = Set(name, episodes, frames, folder / name)
            if not dataset.root.exists():
                write(dataset.root, episodes, frames)
            for command in args.commands:
                used = _run(command, dataset)
                row = (f"{used.seconds:.1f}", f"{used.memory:.0f}", str(used.status))
                table.add_row(command, name, *row)
                Console().print(command, name, *row, highlight=False)
                key = f"{command}_{name}"
                figures |= {f"{key}_s": used.seconds, f"{key}_mib": used.memory}
                figures[f"{key}_status"] = used.status
    Console().print(table)
    if args.json is not None:
        cli.write_json(args.json, figures)
    return int(any(value for key, value in figures.items() if key.endswith("_status")))


def write(root: Path, episodes: int, frames: int, die: bool = False) -> None:
    """Record smooth reaches to random goals, with a little noise.

    Args:
        root: Folder of the dataset.
        episodes: Number of episodes.
        frames: Number of frames in each episode.
        die: Kill this process instead of ending the recording.
    """
    rng = np.random.default_rng(0)
    s = np.linspace(0, 1, frames)
    # In an episode of an hour, a person reaches more than once.
    reach = s**3 * (10 - 15 * s + 6 * s**2) if frames < _HOUR else np.sin(360 * np.pi * s) ** 2
    with DatasetWriter(root, _FPS, "any", JOINTS, {"action": JOINTS}) as writer:
        for _ in range(episodes):
            # All amplitudes are positive; otherwise, with four motions, a joint could look
            # mirrored in one of them.
            goal = rng.uniform(0.2, 1, len(JOINTS))
            joints = reach[:, None] * goal + rng.normal(0, 1e-4, (frames, len(JOINTS)))
            writer.start_episode("reach")
            for row, after in zip(joints, [*joints[1:], joints[-1]], strict=True):
                writer.add_frame(joint_position=row, action=after)
            writer.save_episode()
        if die:
            os.kill(os.getpid(), signal.SIGKILL)


def _run(command: str, dataset: Set) -> Used:
    root, out, model = dataset.root, dataset.folder / "out", dataset.folder / "model"
    shutil.rmtree(out, ignore_errors=True)
    words = {
        "check": ["--dataset", root],
        "fit": ["--dataset", root, "--out", model, "--overwrite"],
        "evaluate": ["--model", model, "--dataset", root],
        "show": [root, "--out", dataset.folder / "shown.rrd"],
        "curate": [root, "--no-browser"],
        "repair": ["--dataset", root, "--out", out],
        "recover": ["--dataset", out],
    }[command]
    if command == "recover":
        killed = Process(target=write, args=(out, dataset.episodes, dataset.frames, True))
        killed.start()
        killed.join()
    if command == "evaluate" and not model.exists():
        _run("fit", dataset)
    name = "repair" if command == "recover" else command
    line = [sys.executable, "-m", "hrc_learn.cli", name, *map(str, words)]
    process = subprocess.Popen(line, stdout=subprocess.DEVNULL)
    _, status, used = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    return Used(used.ru_utime + used.ru_stime, used.ru_maxrss / 1024, process.returncode)


if __name__ == "__main__":
    cli.run(main, Args)
