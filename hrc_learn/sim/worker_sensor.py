"""A simulated person tracker: delayed, noisy, and with missed detections."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from hrc_learn.protocols import PersonObservation
from hrc_learn.sim.imperfections import Imperfections
from hrc_learn.sim.worker import Worker

# Time over which velocities are averaged, noise against lag [s]: three images.
_SPAN = 0.1
IMAGE_RATE = 30.0
"""Images a second of an ordinary depth camera."""


@runtime_checkable
class Seen(Protocol):
    """A worker's visit, as seen by a tracker."""

    @property
    def worker(self) -> Worker:
        """Body of the worker."""
        ...

    def ends_at(self, time: float) -> Float[np.ndarray, "parts 2 3"]:
        """Ends of the axes of all capsules at a time [s], in the base frame [m]."""
        ...


class WorkerSensor:
    """Implements the `PersonTracker` protocol: a body tracker on an RGB-D camera.

    Each end of a capsule has noise of its own in each image. Velocities come from these
    positions alone, so they have noise as well, and lag behind by half of 0.1 s.
    """

    def __init__(
        self,
        visit: Seen,
        clock: Callable[[], float],
        sizes: Imperfections,
        rng: np.random.Generator,
        *,
        rate: float = IMAGE_RATE,
    ):
        """Begin to watch now.

        Args:
            visit: Where the worker truly is.
            clock: Tells the time [s].
            sizes: Of noise, delay and loss.
            rng: Source of noise and loss.
            rate: Images a second.

        Raises:
            ValueError: If the rate is not positive.
        """
        if not rate > 0:
            raise ValueError(f"rate must be positive, but is {rate}.")
        self._visit, self._clock, self._sizes, self._rng = visit, clock, sizes, rng
        self._rate, self._first, self._taken = rate, clock(), 0
        self._pending: deque[PersonObservation] = deque()
        self._before: deque[PersonObservation] = deque()
        self._newest: PersonObservation | None = None

    def read(self) -> PersonObservation | None:
        """The newest observation that has arrived by now."""
        # Clocks add up steps of rounded length: a nanosecond early still counts as in time.
        now = self._clock() + 1e-9
        while (time := self._first + self._taken / self._rate) <= now:
            self._take(time)
        while self._pending and self._pending[0].time + self._sizes.person_delay <= now:
            self._newest = self._pending.popleft()
        return self._newest

    def _take(self, time: float) -> None:
        """One image."""
        self._taken += 1
        ends = self._visit.ends_at(time)
        noise = self._sizes.person_noise * self._rng.standard_normal(ends.shape)
        if self._rng.uniform() < self._sizes.person_loss:
            return
        ends, velocity = ends + noise, np.zeros_like(noise)
        while len(self._before) > 1 and self._before[1].time <= time - _SPAN + 1e-9:
            self._before.popleft()
        if self._before:
            old = self._before[0]
            velocity = (ends - old.ends) / (time - old.time)
        radius = self._visit.worker.radius
        seen = PersonObservation(time=time, ends=ends, radius=radius, velocity=velocity)
        self._before.append(seen)
        self._pending.append(seen)
