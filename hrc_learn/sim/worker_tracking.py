"""Distance of the worker from the robot: the true one, and a delayed, noisy person tracker."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection
from typing import NamedTuple, Protocol, runtime_checkable

import mujoco
import numpy as np
from jaxtyping import Float

from hrc_learn.protocols import PersonObservation
from hrc_learn.sim.imperfections import Imperfections
from hrc_learn.sim.scene import WORKER_BODIES
from hrc_learn.sim.worker import Worker
from hrc_learn.sim.world import World, body_geoms

# pyright: reportAttributeAccessIssue=false
# MuJoCo ships no type stubs; its names come from a compiled module.


_FARTHEST = 100.0  # distances are measured up to here [m]


class NearestPair(NamedTuple):
    """Nearest pair of points of worker and robot."""

    distance: float
    """Between their surfaces; negative is how deep they overlap [m]."""
    points: Float[np.ndarray, "2 3"]
    """Nearest point on the robot or its load, and on the worker [m]."""
    arm_geom: str
    """Geom of the robot or of its load."""
    worker_geom: str


class WorkerDistance:
    """Finds the smallest distance between the worker and all of the robot in a world."""

    def __init__(self, world: World):
        """Find the geoms.

        Raises:
            ValueError: If there is no worker in the scene.
        """
        if world.config.worker is None:
            raise ValueError("there is no worker in this scene: give it a WorkerConfig.")
        self._world, model = world, world.model
        solid = model.geom_contype != 0
        self._arm = np.flatnonzero(body_geoms(model, ["link0"]) & solid)
        self._worker = np.array([model.geom(name).id for name in WORKER_BODIES])

    def now(self, held: Collection[str] = ()) -> NearestPair:
        """The nearest of all pairs of geoms.

        Args:
            held: Names of the objects that the robot holds: they count as parts of it.
        """
        model, data = self._world.model, self._world.data
        loads = [model.geom(name).id for name in held]
        geoms = np.concatenate([self._arm, np.array(loads, dtype=int)])
        # Distances of spheres around the geoms are lower bounds. Pairs are measured in their
        # order, until the bound exceeds what was found: a dozen of four hundred.
        centres = data.geom_xpos[geoms][:, None] - data.geom_xpos[self._worker]
        radii = model.geom_rbound[geoms][:, None] + model.geom_rbound[self._worker]
        bounds = (np.linalg.norm(centres, axis=-1) - radii).ravel()
        best, pair, points = _FARTHEST, (0, 0), np.zeros(6)
        for k in np.argsort(bounds):
            if bounds[k] > best:
                break
            a, b = geoms[k // len(self._worker)], self._worker[k % len(self._worker)]
            between = np.zeros(6)
            distance = mujoco.mj_geomDistance(model, data, a, b, _FARTHEST, between)
            if distance < best:
                best, pair, points = distance, (a, b), between
        arm_geom, worker_geom = (model.geom(int(g)).name for g in pair)
        return NearestPair(best, points.reshape(2, 3), arm_geom, worker_geom)


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
            visit: True motion of the worker.
            clock: Current time [s].
            sizes: Sizes of noise, delay and loss.
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
