"""One experiment tried again and again, each time with another seed: kept on disk,
resumed, summed up.
"""

import gc
import json
import math
import multiprocessing
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from hrc_learn.skills.work_cell import TaskFailedError
from hrc_learn.store import Claim, new_file, sync_file

if TYPE_CHECKING:
    from rich.table import Table

# Trials on disk: one line of JSON each, written as soon as it is known.
#
# The first line tells what was tried, so that results of different things never mix.

_SEED, _FAILURE, _MADE_BY = "seed", "failure", "made_by"


@dataclass(frozen=True, kw_only=True)
class Trial:
    """What one seed came to."""

    seed: int
    values: Mapping[str, float | int | str]
    """Measured, by name; of a failed trial what was measured all the same."""
    failure: str = ""
    """Why it failed; empty if it did not."""

    @classmethod
    def of(cls, seed: int, measured: Mapping[str, Any]) -> "Trial":
        """From what a run returned: measured values, and "failure" with a reason if it failed.

        Raises:
            ValueError: If a value is neither a number nor text, or one is named "seed".
        """
        if _SEED in measured:
            raise ValueError("a trial measures no 'seed': that names the trial itself.")
        values = {name: _plain(name, value) for name, value in measured.items()}
        return cls(seed=seed, failure=str(values.pop(_FAILURE, "")), values=values)

    def line(self) -> str:
        """As one line of JSON, which has no NaN or infinity: they become null."""
        row = {_SEED: self.seed, _FAILURE: self.failure, **self.values}
        finite = {
            name: None if isinstance(value, float) and not math.isfinite(value) else value
            for name, value in row.items()
        }
        return json.dumps(finite) + "\n"

    @classmethod
    def from_line(cls, line: str) -> "Trial":
        """The trial of a line; null becomes NaN."""
        row = json.loads(line)
        seed, failure = row.pop(_SEED), row.pop(_FAILURE)
        values = {name: math.nan if value is None else value for name, value in row.items()}
        return cls(seed=seed, failure=failure, values=values)


class TrialFile:
    """Trials of one thing, in a file that grows, for one process at a time.

    Attributes:
        trials: Those in the file, by seed.
    """

    def __init__(self, path: Path, made_by: Mapping[str, Any]):
        """Open a file to go on with, or begin one.

        Args:
            path: JSON-lines file.
            made_by: What is tried; whatever is no JSON is kept as text.

        Raises:
            BusyError: Another process is adding trials to it.
            ValueError: If the file holds trials of something else, or no trials.
        """
        self._path = path
        self.trials: dict[int, Trial] = {}
        made_by = json.loads(json.dumps(made_by, default=str))
        path.parent.mkdir(parents=True, exist_ok=True)
        self._claim = Claim(path)
        try:
            if path.exists():
                self._resume(made_by)
            else:
                self._write(json.dumps({_MADE_BY: made_by}) + "\n")
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> "TrialFile":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Let others add trials."""
        self._claim.release()

    def append(self, trial: Trial) -> None:
        """Add a trial; it is on disk when this returns."""
        with self._path.open("a", encoding="utf-8") as file:
            file.write(trial.line())
        sync_file(self._path)
        self.trials[trial.seed] = trial

    def _resume(self, made_by: Mapping[str, Any]) -> None:
        text = self._path.read_text(encoding="utf-8")
        whole = text[: text.rfind("\n") + 1]
        lines = whole.splitlines()
        try:
            before = json.loads(lines[0])[_MADE_BY]
            found = [Trial.from_line(line) for line in lines[1:]]
        except (IndexError, KeyError, TypeError, ValueError) as error:
            raise ValueError(
                f"{self._path} holds no trials: choose another file, or remove it."
            ) from error
        if before != made_by:
            raise ValueError(
                f"{self._path} holds trials of something else ({_difference(before, made_by)}):"
                " remove it to begin anew, or choose another place."
            )
        if whole != text:  # stopped in the middle of a line
            self._write(whole)
        self.trials = {trial.seed: trial for trial in found}

    def _write(self, text: str) -> None:
        with new_file(self._claim) as part:
            part.write_text(text, encoding="utf-8")


def _difference(before: Mapping[str, Any], now: Mapping[str, Any]) -> str:
    for name in [*before, *now]:
        if before.get(name) != now.get(name):
            return f"{name} was {before.get(name)!r} there and is {now.get(name)!r} now"
    raise AssertionError("nothing differs")


def _plain(name: str, value: Any) -> float | int | str:
    # numpy's and torch's scalars come as their plain counterparts.
    plain = value.item() if hasattr(value, "item") else value
    if not isinstance(plain, (bool, int, float, str)):
        raise ValueError(f"{name} must be a number or text, but is a {type(value).__name__}.")
    return plain


# One thing tried again and again, each time with another seed, and what it came to.
#
# An hour's work is not lost when it is stopped: every result is in a file at once, and the same
# call goes on where the last one ended.

Run = Callable[[int], Mapping[str, Any]]
"""Tries once with a seed; returns what was measured, "failure" with the reason if it failed."""


def repeat(
    run: Run,
    seeds: Iterable[int],
    file: Path,
    *,
    made_by: Mapping[str, Any],
    processes: int = 1,
    title: str = "Trials",
) -> list[Trial]:
    """Run once for each seed that is not in the file yet.

    Args:
        run: Called with each seed. A trial fails by returning `failure`, the reason, beside
            what it measured, or by raising `TaskFailedError`; any other exception stops all.
            For several processes it must be picklable: a frozen dataclass of paths and
            settings with `__call__`, say, which loads its models itself.
        seeds: In the order wanted; seeds named twice are run once.
        file: JSON-lines file of the results; those of the same seeds are taken from it.
        made_by: What is tried. A file of something else is refused.
        processes: To run at once, each with one thread.
        title: Shown beside the progress.

    Returns:
        One trial for each seed, in the order of the seeds.

    Raises:
        BusyError: Another process is adding trials to the file.
        ValueError: Without seeds or processes, or if the file is of something else.
    """
    seeds = list(dict.fromkeys(seeds))
    if not seeds or processes < 1:
        raise ValueError(
            f"there must be a seed and a process at least, but there are {len(seeds)} and "
            f"{processes}."
        )
    with TrialFile(file, made_by) as done:
        waiting = [seed for seed in seeds if seed not in done.trials]
        known = [done.trials[seed] for seed in seeds if seed in done.trials]
        with _progress(title, len(seeds), known) as tell:
            for trial in _trials(run, waiting, min(processes, len(waiting))):
                done.append(trial)
                tell(trial)
    return [done.trials[seed] for seed in seeds]


def _trials(run: Run, seeds: list[int], processes: int) -> Iterator[Trial]:
    """As they are finished."""
    if processes <= 1:
        yield from (_trial(run, seed) for seed in seeds)
        return
    # A forked process would inherit locks of threads that it does not have.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(
        processes, context, initializer=torch.set_num_threads, initargs=(1,)
    ) as pool:
        waiting = {pool.submit(_trial, run, seed) for seed in seeds}
        try:
            while waiting:
                done, waiting = wait(waiting, return_when=FIRST_COMPLETED)
                # What worked is kept before an error stops everything.
                for future in sorted(done, key=lambda f: f.exception() is not None):
                    yield future.result()
        finally:
            pool.shutdown(cancel_futures=True)


def _trial(run: Run, seed: int) -> Trial:
    try:
        return Trial.of(seed, run(seed))
    except TaskFailedError as error:
        return Trial(seed=seed, values={}, failure=str(error))
    except Exception as error:
        error.add_note(f"in the trial with seed {seed}")
        raise
    finally:
        # World, work cell and log know each other, and the simulator's memory is not counted
        # by what collects such rings: fifty trials would keep two gigabytes.
        gc.collect()


@contextmanager
def _progress(
    title: str, total: int, done: Iterable[Trial]
) -> Iterator[Callable[[Trial], None]]:
    """A bar of the trials done and how many of them failed; told of each trial."""
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeRemainingColumn,
    )

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[failed]} failed"),
        TimeRemainingColumn(),
    )
    failed = 0
    with Progress(*columns) as bar:
        task = bar.add_task(title, total=total, failed=0)

        def tell(trial: Trial) -> None:
            nonlocal failed
            failed += bool(trial.failure)
            bar.update(task, advance=1, failed=failed)

        for trial in done:
            tell(trial)
        yield tell


# What many trials come to: how often they succeed, and what they measure.

_Z = 1.959964  # of a two-sided interval of 95 %


def wilson_interval(successes: int, trials: int) -> tuple[float, float]:
    """Interval of 95 % of a share (Wilson 1927); honest for few trials and shares near 0 or 1.

    Args:
        successes: Of the trials.
        trials: At least one.

    Raises:
        ValueError: If there are no trials, or more successes than trials.
    """
    if not 0 <= successes <= trials or trials == 0:
        raise ValueError(f"{successes} successes of {trials} trials make no share.")
    share, z2 = successes / trials, _Z**2 / trials
    middle = share + z2 / 2
    half = _Z * math.sqrt(share * (1 - share) / trials + z2 / (4 * trials))
    return max(0.0, (middle - half) / (1 + z2)), min(1.0, (middle + half) / (1 + z2))


@dataclass(frozen=True, kw_only=True)
class Spread:
    """Of one measured value over the trials that know it."""

    median: float
    p95: float
    """95 % of the trials are below."""
    smallest: float
    largest: float


@dataclass(frozen=True, kw_only=True)
class Summary:
    """Of a repetition."""

    trials: int
    failed: Mapping[int, str]
    """Reason by seed."""
    spread: Mapping[str, Spread]
    """By name of the value; over failed trials too, as far as they measured it."""

    @classmethod
    def of(cls, trials: Sequence[Trial]) -> "Summary":
        """Count and sort.

        Raises:
            ValueError: Without trials.
        """
        if not trials:
            raise ValueError("there are no trials to sum up.")
        names = dict.fromkeys(name for trial in trials for name in trial.values)
        known = {name: _numbers(trials, name) for name in names}
        return cls(
            trials=len(trials),
            failed={trial.seed: trial.failure for trial in trials if trial.failure},
            spread={name: _spread(values) for name, values in known.items() if len(values)},
        )

    @property
    def successes(self) -> int:
        """Number of trials that did not fail."""
        return self.trials - len(self.failed)

    @property
    def interval(self) -> tuple[float, float]:
        """Of the share of successes, 95 %."""
        return wilson_interval(self.successes, self.trials)

    def figures(self) -> dict[str, float | int]:
        """All of it as one flat object of numbers; seeds and reasons left out."""
        low, high = self.interval
        values: dict[str, float | int] = {
            "trials": self.trials,
            "successes": self.successes,
            "success_rate": self.successes / self.trials,
            "success_rate_low": low,
            "success_rate_high": high,
        }
        for name, spread in self.spread.items():
            values |= {f"{name}_{kind}": value for kind, value in vars(spread).items()}
        return values

    def table(self, title: str) -> "Table":
        """To be printed; the heading tells how many succeeded, the foot why others did not."""
        from rich.table import Table
        from rich.text import Text

        low, high = self.interval
        heading = (
            f"{title}: {self.successes} of {self.trials} succeeded "
            f"({100 * low:.1f} to {100 * high:.1f} % with 95 % confidence)"
        )
        # As text: brackets in a reason are no markup.
        reasons = Text(
            "\n".join(f"seed {seed}: {reason}" for seed, reason in self.failed.items())
        )
        table = Table("measured", title=heading, caption=reasons, caption_justify="left")
        for column in ("median", "p95", "smallest", "largest"):
            table.add_column(column, justify="right")
        for name, spread in self.spread.items():
            numbers = (spread.median, spread.p95, spread.smallest, spread.largest)
            table.add_row(name.replace("_", " "), *(f"{number:.4g}" for number in numbers))
        return table


def _numbers(trials: Sequence[Trial], name: str) -> np.ndarray:
    values = [v for t in trials if not isinstance(v := t.values.get(name, math.nan), str)]
    numbers = np.array(values, dtype=float)
    return numbers[np.isfinite(numbers)]


def _spread(values: np.ndarray) -> Spread:
    median, p95 = (float(np.quantile(values, share, method="higher")) for share in (0.5, 0.95))
    return Spread(
        median=median, p95=p95, smallest=float(values.min()), largest=float(values.max())
    )
