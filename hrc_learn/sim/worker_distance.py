"""True distance of the worker from arm, tool and load, known to the simulator only."""

from __future__ import annotations

from collections.abc import Collection
from typing import NamedTuple

import mujoco
import numpy as np
from jaxtyping import Float

from hrc_learn.sim.scene import WORKER_BODIES
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
