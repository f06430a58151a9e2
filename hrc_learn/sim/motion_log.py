"""Where everything that moves has been, to be drawn afterwards."""

# pyright: reportAttributeAccessIssue=false
# MuJoCo ships no type stubs; its names come from a compiled module.

import mujoco
import numpy as np

from ..viz import Body, Box, Capsule
from .contacts import body_geoms
from .world import World


class MotionLog:
    """Remembers where everything that moves was after each step of the station."""

    def __init__(self, world: World):
        self._world = world
        model = world.model
        movers = ["link0", *(item.name for item in world.config.objects)]
        geoms = body_geoms(model, movers)
        self._bodies = sorted({int(b) for b in model.geom_bodyid[geoms]})
        self._positions: list[np.ndarray] = []
        self._orientations: list[np.ndarray] = []

    def advance(self, duration: float) -> None:
        """Note where everything is, then let the world go on [s]."""
        data = self._world.data
        self._positions.append(data.xpos[self._bodies].copy())
        self._orientations.append(data.xquat[self._bodies].copy())
        self._world.advance(duration)

    def bodies(self) -> tuple[Body, ...]:
        """Everything that moved, as it is to be drawn."""
        positions, orientations = np.stack(self._positions), np.stack(self._orientations)
        bodies = []
        for i, body in enumerate(self._bodies):
            capsules, boxes = _shapes(self._world.model, body)
            bodies.append(
                Body(
                    name=self._world.model.body(body).name,
                    position=positions[:, i],
                    orientation=orientations[:, i],
                    capsules=capsules,
                    boxes=boxes,
                )
            )
        return tuple(bodies)


def _shapes(model: mujoco.MjModel, body: int) -> tuple[tuple[Capsule, ...], tuple[Box, ...]]:
    """Capsules and boxes of a body in its own frame."""
    capsules, boxes = [], []
    for g in np.flatnonzero(model.geom_bodyid == body):
        kind, size, centre = model.geom_type[g], model.geom_size[g], model.geom_pos[g]
        r, green, b, opacity = (float(c) for c in model.geom_rgba[g])
        colour = (r, green, b, opacity)
        R = np.empty(9)
        mujoco.mju_quat2Mat(R, model.geom_quat[g])
        R = R.reshape(3, 3)
        if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
            half = size[1] * R[:, 2]
            start, end = _triple(centre - half), _triple(centre + half)
            capsules.append(Capsule(start=start, end=end, radius=float(size[0]), colour=colour))
        elif kind == mujoco.mjtGeom.mjGEOM_BOX:
            # All boxes of ours are turned by multiples of a quarter turn.
            half_size = _triple(np.abs(R @ size))
            boxes.append(Box(centre=_triple(centre), half_size=half_size, colour=colour))
    return tuple(capsules), tuple(boxes)


def _triple(vector: np.ndarray) -> tuple[float, float, float]:
    x, y, z = vector.tolist()
    return x, y, z
