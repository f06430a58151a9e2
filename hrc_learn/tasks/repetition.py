"""One thing tried again and again, each time with another seed, and what it came to.

An hour's work is not lost when it is stopped: every result is in a file at once, and the same
call goes on where the last one ended.
"""

import gc
import multiprocessing
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch

from .failure import TaskFailedError
from .trial_file import Trial, TrialFile

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
        ValueError: Without seeds or processes, or if the file is of something else.
    """
    seeds = list(dict.fromkeys(seeds))
    if not seeds or processes < 1:
        raise ValueError(
            f"there must be a seed and a process at least, but there are {len(seeds)} and "
            f"{processes}."
        )
    done = TrialFile(file, made_by)
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
        # Its world, station and log know each other, and the simulator's memory is not counted
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
