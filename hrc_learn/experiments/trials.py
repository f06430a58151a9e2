"""Monte Carlo trials: one run repeated with other seeds, saved on disk and resumable."""

import gc
import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, wait
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from hrc_learn.distributed import ByValue, worker_pool
from hrc_learn.store import Claim, json_text, naming, new_file, parse_json, sync_file

# Keys of a line of the file: one JSON object per trial. The first line of the file has the
# settings under the key `_MADE_BY`, so that results of different settings never mix.
_SEED, _FAILURE, _MADE_BY = "seed", "failure", "made_by"


@dataclass(frozen=True, kw_only=True)
class Trial:
    """Result of one seed."""

    seed: int
    values: Mapping[str, float | int | str]
    """Measured values by name; for a failed trial, values that could still be measured."""
    failure: str = ""
    """Reason of a failure; empty after a success."""

    @classmethod
    def of(cls, seed: int, measured: Mapping[str, Any]) -> "Trial":
        """Trial from the mapping that a run returned: values, and "failure" with a reason.

        Raises:
            ValueError: If a value is neither a number nor text, or a value is named "seed".
        """
        if _SEED in measured:
            raise ValueError("a trial cannot measure 'seed': that key names the trial itself.")
        values = {name: _plain(name, value) for name, value in measured.items()}
        return cls(seed=seed, failure=str(values.pop(_FAILURE, "")), values=values)

    def line(self) -> str:
        """Trial as one line of JSON; NaN and infinity become null."""
        row = {_SEED: self.seed, _FAILURE: self.failure, **self.values}
        return json_text(row, indent=False)

    @classmethod
    def from_line(cls, line: str) -> "Trial":
        """Trial from a line; null becomes NaN."""
        row = parse_json(line)
        seed, failure = row.pop(_SEED), row.pop(_FAILURE)
        values = {name: math.nan if value is None else value for name, value in row.items()}
        return cls(seed=seed, failure=failure, values=values)


class TrialFile(Claim):
    """File of trials with the same settings, to which each trial is added as soon as it ends.

    Only one process at a time may hold the file.

    Attributes:
        trials: Trials in the file, by seed.
    """

    def __init__(self, path: Path, made_by: Mapping[str, Any]):
        """Open a file to resume, or create one.

        Args:
            path: JSON-lines file.
            made_by: Settings; values that JSON cannot hold are saved as text.

        Raises:
            BusyError: Another process is adding trials to the file.
            ValueError: If the file holds trials with other settings, or no trials.
        """
        self._path = path
        self.trials: dict[int, Trial] = {}
        made_by = parse_json(json_text(made_by))
        path.parent.mkdir(parents=True, exist_ok=True)
        super().__init__(path)
        try:
            if path.exists():
                self._resume(made_by)
            else:
                self._write(json_text({_MADE_BY: made_by}, indent=False))
        except BaseException:
            self.release()
            raise

    def append(self, trial: Trial) -> None:
        """Add a trial; it is on disk when this method returns."""
        with naming(self._path), self._path.open("a", encoding="utf-8") as file:
            file.write(trial.line())
        sync_file(self._path)
        self.trials[trial.seed] = trial

    def _resume(self, made_by: Mapping[str, Any]) -> None:
        text = self._path.read_text(encoding="utf-8")
        whole = text[: text.rfind("\n") + 1]
        lines = whole.splitlines()
        try:
            before = parse_json(lines[0])[_MADE_BY]
            found = [Trial.from_line(line) for line in lines[1:]]
        except (IndexError, KeyError, TypeError, ValueError) as error:
            raise ValueError(
                f"{self._path} holds no trials: choose another file, or remove it."
            ) from error
        if before != made_by:
            raise ValueError(
                f"{self._path} holds trials with other settings "
                f"({_difference(before, made_by)}): remove it, or choose another file."
            )
        if whole != text:  # interrupted in the middle of a line
            self._write(whole)
        self.trials = {trial.seed: trial for trial in found}

    def _write(self, text: str) -> None:
        with new_file(self) as part:
            part.write_text(text, encoding="utf-8")


def _difference(before: Mapping[str, Any], now: Mapping[str, Any]) -> str:
    name = next(name for name in [*before, *now] if before.get(name) != now.get(name))
    return f"{name} is {before.get(name)!r} in the file, but {now.get(name)!r} now"


def _plain(name: str, value: Any) -> float | int | str:
    # Scalars of NumPy and PyTorch become their plain counterparts.
    plain = value.item() if hasattr(value, "item") else value
    if not isinstance(plain, (bool, int, float, str)):
        raise ValueError(f"{name} must be a number or text, but is a {type(value).__name__}.")
    return plain


TrialRun = Callable[[int], Mapping[str, Any]]
"""Runs one trial with a seed; returns the measured values, and "failure", empty or a reason."""


def repeat(
    run: TrialRun,
    seeds: Iterable[int],
    file: Path,
    *,
    made_by: Mapping[str, Any],
    processes: int = 1,
    failures: tuple[type[Exception], ...] = (),
    title: str = "Trials",
) -> list[Trial]:
    """Run once for each seed that is not in the file yet.

    Every result is saved immediately, so the same call resumes interrupted trials.

    Args:
        run: Called with each seed. A trial fails by returning a reason as `failure` with its
            values, or by raising one of `failures`; any other exception stops all trials.
            For several processes, `run` must be picklable, such as a frozen dataclass of paths
            and settings with a method `__call__` that loads the models.
        seeds: Seeds in order; repeated seeds are run once.
        file: JSON-lines file of the results; trials already in it are not repeated.
        made_by: Settings. A file of trials with other settings is refused.
        processes: Number of parallel processes, each with one thread.
        failures: Exceptions that mark a failed trial.
        title: Title of the progress bar.

    Returns:
        One trial for each seed, in the order of the seeds.

    Raises:
        ValueError: Without seeds or processes, or if the file has other settings.
        BusyError: Another process is adding trials to the file.
    """
    from rich.progress import track

    seeds = list(dict.fromkeys(seeds))
    if not seeds or processes < 1:
        counts = f"{len(seeds)} and {processes}"
        raise ValueError(f"at least one seed and one process are needed, not {counts}.")
    with TrialFile(file, made_by) as done:
        waiting = [seed for seed in seeds if seed not in done.trials]
        trials = _trials(run, waiting, min(processes, len(waiting)), failures)
        for trial in track(trials, title, total=len(waiting)):
            done.append(trial)
    return [done.trials[seed] for seed in seeds]


def _trials(
    run: TrialRun, seeds: list[int], processes: int, failures: tuple[type[Exception], ...]
) -> Iterator[Trial]:
    """Results in the order in which trials end."""
    if processes <= 1:
        yield from (_trial(run, seed, failures) for seed in seeds)
        return
    with worker_pool(processes, torch.set_num_threads, 1) as pool:
        sent: Any = ByValue(run)
        waiting = {pool.submit(_trial, sent, seed, failures) for seed in seeds}
        while waiting:
            done, waiting = wait(waiting, return_when=FIRST_COMPLETED)
            # Keep the successful trials before an error stops everything.
            for future in sorted(done, key=lambda f: f.exception() is not None):
                yield future.result()


def _trial(run: TrialRun, seed: int, failures: tuple[type[Exception], ...]) -> Trial:
    try:
        return Trial.of(seed, run(seed))
    except failures as error:
        return Trial(seed=seed, values={}, failure=str(error))
    except Exception as error:
        error.add_note(f"in the trial with seed {seed}")
        raise
    finally:
        # World, cell and log of a trial refer to each other, and the garbage collector does
        # not count the memory of the simulator. Without this call, fifty trials would occupy
        # two gigabytes.
        gc.collect()
