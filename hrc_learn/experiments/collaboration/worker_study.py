"""A thousand jobs beside a worker: what keeping the protective distance costs, and what making
way saves, beside an arm that stops and waits.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.controller import WayMakingConfig
from hrc_learn.experiments.collaboration.job_cycle import JobCycle
from hrc_learn.experiments.collaboration.worker import somebody_comes
from hrc_learn.experiments.collaboration.worker_runs import (
    Job,
    Reaction,
    WorkerRuns,
    run_beside_workers,
)
from hrc_learn.experiments.collaboration.worker_tables import WorkerTables
from hrc_learn.sim import Imperfections, WorkerVisit, whole_arm
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills.work_cell import WorkCellConfig
from hrc_learn.teleoperation import ScriptedForce

Mode = Literal["none", "expert", "automatic", "both"]
MODES: tuple[Mode, ...] = ("none", "expert", "automatic", "both")
"""Who moves the null space: `WayMakingConfig.mode`."""

# Runs at once: their tables of visits take some 2 GB.
_BATCH = 250
# Readings of the encoders after which their noise repeats.
_READINGS = 1000
# Of the expert, who sees the worker begin to reach [s]: as in benchmarks/bench_constraints.py.
_REACTION = 0.4
# With which the expert draws the elbow away [N], and where to, so far that the direction stays
# [m]: `random_pulls`.
_FORCE, _FAR_AWAY = 60.0, 10.0


@dataclass(frozen=True, kw_only=True)
class WorkerStudyConfig:
    """How the runs are drawn."""

    runs: int = 1000
    seed: int = 0
    """Of workers, their visits, what trackers and encoders tell; the same for all reactions."""
    limit: float = 180.0
    """Longest time of a run [s]: five cycles."""
    imperfections: Imperfections = field(default_factory=Imperfections.nominal)
    """Of encoders, commands, servos, drivers and trackers."""
    cell: WorkCellConfig = field(default_factory=WorkCellConfig)

    def __post_init__(self) -> None:
        if self.runs < 1:
            raise ValueError(f"runs must be at least 1, but is {self.runs}.")


def draw_job(
    workplace: Workplace,
    cycles: Sequence[JobCycle],
    runs: Sequence[int],
    config: WorkerStudyConfig,
) -> Job:
    """Workers beside arms that do their cycles; each run is the same in whichever batch.

    Args:
        workplace: Where.
        cycles: Done in turn.
        runs: Numbers of the runs.
        config: How they are drawn.
    """
    sizes, dt, visits, chances = config.imperfections, config.cell.dt, [], []
    offset, noise = [], []
    for run in runs:
        rng = np.random.default_rng([config.seed, run])
        visits.append(somebody_comes(workplace, rng))
        drawn = sizes.draw(rng)
        offset.append(drawn.encoder_offset)
        noise.append(sizes.encoder_noise * rng.standard_normal((_READINGS, 7)))
        chances.append(rng)
    return Job(
        workplace=workplace,
        arm=whole_arm(workplace.scene.arm),
        cycles=cycles,
        cycle=torch.tensor([run % len(cycles) for run in runs]),
        workers=WorkerTables.of(visits, sizes, chances, dt),
        pulls=[expert_pull(visit) for visit in visits],
        encoder_offset=torch.from_numpy(np.stack(offset)),
        encoder_noise=torch.from_numpy(np.stack(noise)),
        sizes=sizes,
    )


def expert_pull(visit: WorkerVisit) -> ScriptedForce:
    """Joint 4 is drawn away from the worker while he reaches for markers under the arm.

    As in Experiment 3 of the paper, by an expert who watches him.
    """
    # The last three motions of a visit: hands down, turn, walk away.
    begin, end = visit.released + _REACTION, float(visit.time[-4]) + _REACTION
    k = int(np.searchsorted(visit.time, visit.released))
    place, heading = visit.poses[k, :2], visit.poses[k, 2]
    x, y = place + _FAR_AWAY * np.array([np.cos(heading), np.sin(heading)])
    return ScriptedForce(
        start=begin, duration=end - begin, towards=(float(x), float(y), 0.5), max_force=_FORCE
    )


@dataclass(frozen=True, kw_only=True)
class WorkerStudy:
    """The runs with each reaction."""

    making_way: Mapping[Mode, WorkerRuns]
    """By who moves the null space; the protective distance is kept in all of them."""
    stopping: Mapping[float, WorkerRuns]
    """Of arms that stop and wait, by the distance within which they rest [m], least first."""

    def figures(self) -> dict[str, float]:
        """All that is measured, by name; lengths in mm, times in s."""
        figures: dict[str, float] = {}
        for mode, runs in self.making_way.items():
            own = summary(runs) | self._compared(runs)
            figures |= {f"{mode}_{key}": value for key, value in own.items()}
        for distance, runs in self.stopping.items():
            name = f"stop_{round(1e3 * distance)}_mm"
            figures |= {f"{name}_{key}": value for key, value in summary(runs).items()}
        return figures

    def stop_and_wait(self, smallest: float) -> float:
        """Median cycle time of stop-and-wait with a smallest distance [s].

        Interpolated between the distances that were tried; NaN beyond them.

        Args:
            smallest: That of 5 % of the runs, see `smallest_distance` [m].
        """
        if not self.stopping:
            return np.nan
        kept = [smallest_distance(runs) for runs in self.stopping.values()]
        times = [float(runs.cycle_time.median()) for runs in self.stopping.values()]
        # What rests sooner keeps more, but for chance.
        order = np.argsort(kept)
        return float(
            np.interp(
                smallest, np.take(kept, order), np.take(times, order), left=np.nan, right=np.nan
            )
        )

    def _compared(self, runs: WorkerRuns) -> dict[str, float]:
        """How much shorter cycles are than those of arms that stop and wait."""
        ours = float(runs.cycle_time.median())
        figures = {
            "shorter_at_same_distance": 1 - ours / self.stop_and_wait(smallest_distance(runs))
        }
        safe = [stop for stop in self.stopping.values() if not bool(stop.violations.any())]
        if safe:
            shortest = min(float(stop.cycle_time.median()) for stop in safe)
            figures["shorter_than_safe_stop"] = 1 - ours / shortest
        return {key: value for key, value in figures.items() if np.isfinite(value)}


def smallest_distance(runs: WorkerRuns) -> float:
    """From a part of the worker that the arm closed in on; 5 % of the runs have less [m]."""
    return float(runs.closing.quantile(0.05))


def summary(runs: WorkerRuns) -> dict[str, float]:
    """Counts, medians and quantiles over the runs; lengths in mm, times in s."""

    def quantile(values: Float[Tensor, " runs"], q: float) -> float:
        return float(values.quantile(q, interpolation="nearest"))

    present = runs.present.clamp(min=1e-9)
    return {
        "runs": float(len(runs.cycle_time)),
        "violated_runs": float((runs.violations > 0).sum()),
        "violated_steps": float(runs.violations.sum()),
        "margin_least_mm": 1e3 * float(runs.margin.amin()),
        "closing_least_mm": 1e3 * float(runs.closing.amin()),
        "closing_p5_mm": 1e3 * smallest_distance(runs),
        "closing_median_mm": 1e3 * quantile(runs.closing, 0.5),
        "least_median_mm": 1e3 * quantile(runs.least, 0.5),
        "elbow_p5_mm": 1e3 * quantile(runs.elbow, 0.05),
        "elbow_median_mm": 1e3 * quantile(runs.elbow, 0.5),
        "roomy": float((1 - runs.crowded / present).mean()),
        "cycle_s": quantile(runs.cycle_time, 0.5),
        "cycle_p95_s": quantile(runs.cycle_time, 0.95),
        "over_undisturbed": quantile(runs.cycle_time / runs.undisturbed, 0.5),
        "waited_s": quantile(runs.waited, 0.5),
        "waited_p95_s": quantile(runs.waited, 0.95),
        "off_path_median_mm": 1e3 * quantile(runs.off_path, 0.5),
        "off_path_p95_mm": 1e3 * quantile(runs.off_path, 0.95),
        "unfinished": float(runs.cycle_time.isinf().sum()),
        "unsolved_steps": float(runs.unsolved.sum()),
    }


def run_study(
    workplace: Workplace,
    cycles: Sequence[JobCycle],
    config: WorkerStudyConfig,
    *,
    modes: Sequence[Mode] = MODES,
    stop_distances: Sequence[float] = (),
    tell: Callable[[str, float], None] = lambda name, done: None,
) -> WorkerStudy:
    """Let arms do their cycles beside workers, with one reaction after the other.

    Args:
        workplace: Where.
        cycles: What they do, in turn.
        config: How the runs are drawn.
        modes: Who moves the null space.
        stop_distances: Of stop-and-wait [m].
        tell: Told of each reaction how many of its runs have ended.
    """
    reactions: dict[str, Reaction] = {
        mode: Reaction(way_making=WayMakingConfig(mode=mode)) for mode in modes
    }
    stops = {f"stop at {d:g} m": d for d in sorted(stop_distances)}
    still = WayMakingConfig(mode="none")
    for name, distance in stops.items():
        reactions[name] = Reaction(way_making=still, stop_distance=distance)
    parts: dict[str, list[WorkerRuns]] = {name: [] for name in reactions}
    for first in range(0, config.runs, _BATCH):
        batch = range(first, min(first + _BATCH, config.runs))
        job = draw_job(workplace, cycles, batch, config)
        for name, reaction in reactions.items():

            def ended(share: float, name: str = name, batch: range = batch) -> None:
                tell(name, batch.start + share * len(batch))

            parts[name].append(
                run_beside_workers(job, reaction, config.cell, config.limit, ended)
            )
    joined = {name: WorkerRuns.joined(part) for name, part in parts.items()}
    return WorkerStudy(
        making_way={mode: joined[mode] for mode in modes},
        stopping={distance: joined[name] for name, distance in stops.items()},
    )
