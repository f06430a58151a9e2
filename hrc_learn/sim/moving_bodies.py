"""Everything that moves in a world, to be drawn: shapes, poses, and where they have been."""

from collections.abc import Callable

import mujoco
import numpy as np
from jaxtyping import Bool, Float

from hrc_learn.geometry import Body, Box, Capsule
from hrc_learn.kinematics.arm_shapes import arm_meshes
from hrc_learn.sim.scene import OCCLUDER, WORKER_BODIES, WORKER_ITEM
from hrc_learn.sim.worker_distance import NearestPair, WorkerDistance
from hrc_learn.sim.world import World, body_geoms

# pyright: reportAttributeAccessIssue=false
# MuJoCo ships no type stubs; its names come from a compiled module.


class MovingBodies:
    """The links of the arm, its fingers, the objects, and what people put in the way."""

    def __init__(self, world: World):
        self._world = world
        model = world.model
        obstacles = (box.name for box in world.config.obstacles)
        objects = (item.name for item in world.config.objects)
        worker = () if world.config.worker is None else (*WORKER_BODIES, WORKER_ITEM)
        movers = ["link0", *objects, *obstacles, *worker, OCCLUDER]
        geoms = body_geoms(model, movers)
        self._indices = sorted({int(b) for b in model.geom_bodyid[geoms]})
        self.names = tuple(model.body(b).name for b in self._indices)

    def poses(self) -> tuple[Float[np.ndarray, "bodies 3"], Float[np.ndarray, "bodies 4"]]:
        """Current positions [m] and unit quaternions (w, x, y, z) of the bodies."""
        data = self._world.data
        return data.xpos[self._indices].copy(), data.xquat[self._indices].copy()

    def drawn(
        self,
        positions: Float[np.ndarray, "time bodies 3"],
        orientations: Float[np.ndarray, "time bodies 4"],
    ) -> tuple[Body, ...]:
        """The bodies as they are to be drawn, along poses collected over time."""
        bodies = []
        for i, index in enumerate(self._indices):
            capsules, boxes = _shapes(self._world.model, index)
            bodies.append(
                Body(
                    name=self.names[i],
                    position=positions[:, i],
                    orientation=orientations[:, i],
                    capsules=capsules,
                    boxes=boxes,
                    meshes=arm_meshes(self._world.arm.robot, self.names[i]),
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
            name = model.geom(g).name
            # Meshes of the arm show all but the markers on it.
            boxes.append(
                Box(
                    centre=_triple(centre),
                    half_size=half_size,
                    colour=colour,
                    name=name if name.endswith("_plate") else "",
                )
            )
    return tuple(capsules), tuple(boxes)


def _triple(vector: np.ndarray) -> tuple[float, float, float]:
    x, y, z = vector.tolist()
    return x, y, z


class MotionLog:
    """Remembers where everything that moves was at each step, and how near the worker was."""

    def __init__(self, world: World, advance: Callable[[float], None] | None = None):
        """Begin.

        Args:
            world: The world.
            advance: Lets a time pass in it [s]; None: its own physics does.
        """
        self._world = world
        self._let_pass = advance or world.advance
        self._bodies = MovingBodies(world)
        self._distance = None if world.config.worker is None else WorkerDistance(world)
        self._positions: list[np.ndarray] = []
        self._orientations: list[np.ndarray] = []
        self._nearest: list[NearestPair] = []
        self._held: list[tuple[str, ...]] = []

    def __len__(self) -> int:
        return len(self._orientations)

    def advance(self, duration: float) -> None:
        """Note where everything is, then let the world go on [s]."""
        if self._distance is not None:
            self._held.append(self._world.held())
            self._nearest.append(self._distance.now(self._held[-1]))
        position, orientation = self._bodies.poses()
        self._positions.append(position)
        self._orientations.append(orientation)
        self._let_pass(duration)

    def bodies(self, steps: int | None = None) -> tuple[Body, ...]:
        """Everything that moved, as it is to be drawn.

        Args:
            steps: The first steps only.
        """
        positions = np.stack(self._positions[:steps])
        return self._bodies.drawn(positions, np.stack(self._orientations[:steps]))

    def nearest(self, steps: int | None = None) -> tuple[NearestPair, ...]:
        """Nearest points of worker and robot, its load included, at each step.

        Empty in a world without a worker.

        Args:
            steps: The first steps only.
        """
        return tuple(self._nearest[:steps])

    def held(self, name: str) -> Bool[np.ndarray, " steps"]:
        """True where the robot held an object, at each step of a world with a worker."""
        return np.array([name in held for held in self._held], dtype=bool)
