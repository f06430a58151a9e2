"""Visits of many workers as tables over time: true positions and tracker observations.

A batch of runs looks up its workers once per control step, instead of computing each anew.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from hrc_learn.protocols import PersonObservation
from hrc_learn.sim import Imperfections, WorkerSensor, WorkerVisit
from hrc_learn.sim.worker import IMAGE_RATE, PARTS

# A worker who has left stands still. The tables contain this time after leaving, and repeat its
# last part: a whole number of images and of control steps [s].
_AFTER, _REPEATED = 2.0, 1.0


class Workers(NamedTuple):
    """Bodies near several arms at one time."""

    ends: Float[Tensor, "runs H 2 3"]
    """Ends of the axes of their capsules, in the base frame [m]."""
    velocity: Float[Tensor, "runs H 2 3"]
    """Velocities of the ends [m/s]."""
    radius: Float[Tensor, "runs H"]
    """Radii [m]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class WorkerTables:
    """Tables of the visits near several arms, one for each."""

    dt: float
    """Control step [s]."""
    radius: Float[Tensor, "runs H"]
    """Radii of the capsules [m]."""
    first: Int[Tensor, " runs"]
    """Control step of the first row of the truth."""
    rows: Int[Tensor, " runs"]
    """Number of rows; the worker rests before and after."""
    ends: Float[Tensor, "runs steps H 2 3"]
    """True positions of the ends [m]."""
    velocity: Float[Tensor, "runs steps H 2 3"]
    """True velocities [m/s]."""
    seen_ends: Float[Tensor, "runs images H 2 3"]
    """Observed positions [m]."""
    seen_velocity: Float[Tensor, "runs images H 2 3"]
    """Observed velocities [m/s]."""
    seen_time: Float[Tensor, "runs images"]
    """Times of the observations [s]."""
    newest: Int[Tensor, "runs steps"]
    """Number of the newest image that has arrived by each control step; -1: none yet."""
    observed: Int[Tensor, " runs"]
    """Control step from which the last observations are repeated."""

    @classmethod
    def of(
        cls,
        visits: Sequence[WorkerVisit],
        sizes: Imperfections,
        chances: Sequence[np.random.Generator],
        dt: float,
    ) -> "WorkerTables":
        """Compute the visits, each observed by its own tracker.

        Args:
            visits: Visits, one for each arm.
            sizes: Noise, delay and loss of the tracker.
            chances: Sources of its noise, one for each visit.
            dt: Control step [s]; a second is a whole number of control steps.
        """
        truth, seen = [], []
        for visit, chance in zip(visits, chances, strict=True):
            first = int(visit.begin / dt)
            steps = np.arange(first, int(np.ceil(visit.end / dt)) + 1)
            there = visit.capsules_at(dt * steps)
            truth.append((first, there.ends, there.velocity, there.radius))
            seen.append(_images(visit, sizes, chance, dt))
        return cls(
            dt=dt,
            radius=_padded([radius for *_, radius in truth]),
            first=torch.tensor([first for first, *_ in truth]),
            rows=torch.tensor([len(ends) for _, ends, *_ in truth]),
            ends=_padded([ends for _, ends, *_ in truth]),
            velocity=_padded([velocity for _, _, velocity, _ in truth]),
            seen_ends=_padded([np.stack([i.ends for i in images]) for images, _ in seen]),
            seen_velocity=_padded(
                [np.stack([i.velocity for i in images]) for images, _ in seen]
            ),
            seen_time=_padded([np.array([i.time for i in images]) for images, _ in seen]),
            newest=_padded([newest for _, newest in seen]),
            observed=torch.tensor([len(newest) for _, newest in seen]),
        )

    @classmethod
    def nobody(cls, runs: int, dt: float) -> "WorkerTables":
        """Tables of workers who stand far away and are observed without error."""
        far = torch.full((runs, 1, len(PARTS), 2, 3), 1e3, dtype=torch.float64)
        still, zero = torch.zeros_like(far), torch.zeros(runs, dtype=torch.int64)
        return cls(
            dt=dt,
            radius=torch.full((runs, len(PARTS)), 0.1, dtype=torch.float64),
            first=zero,
            rows=zero + 1,
            ends=far,
            velocity=still,
            seen_ends=far,
            seen_velocity=still,
            seen_time=torch.zeros(runs, 1, dtype=torch.float64),
            newest=torch.zeros(runs, round(_REPEATED / dt), dtype=torch.int64),
            observed=zero + round(_REPEATED / dt),
        )

    def present(self, step: int, runs: Int[Tensor, " some"]) -> Bool[Tensor, " some"]:
        """True during the visits."""
        begin = self.first[runs]
        return (step >= begin) & (step < begin + self.rows[runs])

    def truth(self, step: int, runs: Int[Tensor, " some"]) -> Workers:
        """Workers near some of the arms at a control step."""
        last = self.rows[runs] - 1
        row = torch.minimum((step - self.first[runs]).clamp(min=0), last)
        return Workers(self.ends[runs, row], self.velocity[runs, row], self.radius[runs])

    def seen(
        self, step: int, runs: Int[Tensor, " some"]
    ) -> tuple[Workers, Float[Tensor, " some"]]:
        """Newest observations of the workers near some of the arms at a control step.

        Returns:
            The observations, and their age [s]; NaN before the first observation.
        """
        until, period = self.observed[runs], round(_REPEATED / self.dt)
        beyond = step - until
        repeated = torch.where(beyond >= 0, until - period + beyond % period, step)
        image = self.newest[runs, repeated]
        known, image = image >= 0, image.clamp(min=0)
        age = self.dt * repeated.double() - self.seen_time[runs, image]
        workers = Workers(
            self.seen_ends[runs, image], self.seen_velocity[runs, image], self.radius[runs]
        )
        return workers, torch.where(known, age, torch.nan)


def _images(
    visit: WorkerVisit, sizes: Imperfections, chance: np.random.Generator, dt: float
) -> tuple[list[PersonObservation], Int[np.ndarray, " steps"]]:
    """Observations of a visit, and the newest one at each control step."""
    duration, now = visit.end + _AFTER, 0.0
    # The capsules at the times of all images, computed at once.
    ends = visit.ends_at(np.arange(int(duration * IMAGE_RATE) + 2) / IMAGE_RATE)
    sensor = WorkerSensor(
        lambda time: ends[round(time * IMAGE_RATE)],
        visit.worker.radius,
        lambda: now,
        sizes,
        chance,
    )
    images: list[PersonObservation] = []
    newest = np.empty(int(duration / dt), dtype=np.int64)
    for step in range(len(newest)):
        now = step * dt
        seen = sensor.read()
        if seen is not None and (not images or seen is not images[-1]):
            images.append(seen)
        newest[step] = len(images) - 1
    return images, newest


def _padded(arrays: Sequence[np.ndarray]) -> Tensor:
    """Arrays of different lengths side by side, the last row of each repeated."""
    longest = max(len(array) for array in arrays)
    rows = [array[np.minimum(np.arange(longest), len(array) - 1)] for array in arrays]
    return torch.from_numpy(np.stack(rows))
