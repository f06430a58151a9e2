"""Recording and drawing of a world: poses of all bodies, and the arm with its meshes.

The physics uses capsules of the arm: meshes would cost time in each step and change the
contacts. Pictures are rendered from a second model, which copies the state of the first.
"""

from collections.abc import Callable, Collection
from typing import NamedTuple

import mujoco
import numpy as np
from jaxtyping import Bool, Float

from hrc_learn.geometry import Body, Box, Capsule, MeshFile, read_mesh
from hrc_learn.kinematics.drawing import arm_meshes
from hrc_learn.log import RunRecording
from hrc_learn.sim.arm_model import add_box, add_capsule
from hrc_learn.sim.scene import OCCLUDER, WORKER_BODIES, WORKER_ITEM, add_surroundings
from hrc_learn.sim.step_checks import body_geoms
from hrc_learn.sim.world import World

# pyright: reportAttributeAccessIssue=false
# MuJoCo ships no type stubs; its names come from a compiled module.


class MovingBodies:
    """Links and fingers of the arm, objects, obstacles, and the body of a worker."""

    def __init__(self, world: World):
        self._world = world
        model = world.model
        obstacles = (box.name for box in world.config.obstacles)
        objects = (item.name for item in world.config.objects)
        worker = () if world.config.worker is None else (*WORKER_BODIES, WORKER_ITEM)
        movers = ["link0", *objects, *obstacles, *worker, OCCLUDER]
        self._indices = np.unique(model.geom_bodyid[body_geoms(model, movers)]).tolist()
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
        """The bodies with shapes to draw, along recorded poses."""
        bodies = []
        for i, name in enumerate(self.names):
            capsules, boxes = _shapes(self._world.model, self._indices[i])
            body = Body(
                name=name,
                position=positions[:, i],
                orientation=orientations[:, i],
                capsules=capsules,
                boxes=boxes,
                meshes=arm_meshes(self._world.arm.robot, name),
            )
            bodies.append(body)
        return tuple(bodies)


def _shapes(model: mujoco.MjModel, body: int) -> tuple[tuple[Capsule, ...], tuple[Box, ...]]:
    """Capsules and boxes of a body in its own frame."""
    capsules, boxes = [], []
    for g in np.flatnonzero(model.geom_bodyid == body):
        kind, size, centre = model.geom_type[g], model.geom_size[g], model.geom_pos[g]
        r, green, b, opacity = model.geom_rgba[g].tolist()
        colour = (r, green, b, opacity)
        R = np.empty(9)
        mujoco.mju_quat2Mat(R, model.geom_quat[g])
        R = R.reshape(3, 3)
        if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
            half = size[1] * R[:, 2]
            start, end = _triple(centre - half), _triple(centre + half)
            capsules.append(Capsule(start=start, end=end, radius=float(size[0]), colour=colour))
        elif kind == mujoco.mjtGeom.mjGEOM_BOX:
            # All our boxes are turned by multiples of a quarter turn.
            half_size, name = _triple(np.abs(R @ size)), model.geom(g).name
            # Boxes with a name are drawn in addition to meshes, which lack the marker plates.
            name = name if name.endswith("_plate") else ""
            box = Box(centre=_triple(centre), half_size=half_size, colour=colour, name=name)
            boxes.append(box)
    return tuple(capsules), tuple(boxes)


def _triple(vector: np.ndarray) -> tuple[float, float, float]:
    x, y, z = vector.tolist()
    return x, y, z


_FARTHEST = 100.0  # largest distance that is measured [m]


class NearestPair(NamedTuple):
    """Nearest pair of points of worker and robot."""

    distance: float
    """Distance between the surfaces; negative is the depth of the overlap [m]."""
    points: Float[np.ndarray, "2 3"]
    """Nearest point on the robot or its load, and on the worker [m]."""
    arm_geom: str
    """Geom of the robot or of its load."""
    worker_geom: str


class WorkerDistance:
    """Finds the smallest distance between the worker and the robot in a world."""

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
        """Nearest points over all pairs of geoms.

        Args:
            held: Names of the objects that the robot holds; they count as parts of the robot.
        """
        model, data = self._world.model, self._world.data
        loads = [model.geom(name).id for name in held]
        geoms = np.concatenate([self._arm, np.array(loads, dtype=int)])
        # Distances of spheres around the geoms are lower bounds. Pairs are measured in order of
        # these bounds, until a bound exceeds the smallest distance. About a dozen of four
        # hundred pairs are measured.
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


class MotionLog:
    """Records the poses of all moving bodies at each step, and the worker's distance."""

    def __init__(self, world: World, advance: Callable[[float], None] | None = None):
        """Begin with an empty log.

        Args:
            world: The world.
            advance: Function that lets a time pass in the world [s]; None: `World.advance`.
        """
        self._world = world
        self._let_pass = advance or world.advance
        self._bodies = MovingBodies(world)
        self._distance = None if world.config.worker is None else WorkerDistance(world)
        self._poses: list[tuple[np.ndarray, np.ndarray]] = []
        self._nearest: list[NearestPair] = []
        self._held: list[tuple[str, ...]] = []

    def __len__(self) -> int:
        return len(self._poses)

    def advance(self, duration: float) -> None:
        """Record all poses, then let a time pass in the world [s]."""
        if self._distance is not None:
            self._held.append(self._world.held())
            self._nearest.append(self._distance.now(self._held[-1]))
        self._poses.append(self._bodies.poses())
        self._let_pass(duration)

    def bodies(self, steps: int | None = None) -> tuple[Body, ...]:
        """All moving bodies with shapes to draw, along their recorded poses.

        Args:
            steps: Number of steps from the first on; None: all.
        """
        positions, orientations = zip(*self._poses[:steps], strict=True)
        return self._bodies.drawn(np.stack(positions), np.stack(orientations))

    def nearest(self, steps: int | None = None) -> tuple[NearestPair, ...]:
        """Nearest points of worker and robot, its load included, at each step.

        Empty in a world without a worker.

        Args:
            steps: Number of steps from the first on; None: all.
        """
        return tuple(self._nearest[:steps])

    def held(self, name: str) -> Bool[np.ndarray, " steps"]:
        """True where the robot held an object, at each step of a world with a worker."""
        return np.array([name in held for held in self._held], dtype=bool)


_HIDDEN = 4  # geoms and sites of this group are not drawn
_SHOWN = 1
_SPECULAR, _SHININESS = 0.3, 0.4  # highlights of painted metal and plastic


class DrawnWorld:
    """A world with meshes in place of the capsules of its arm, to be rendered.

    Where there are no meshes, capsules are drawn.

    Attributes:
        model: Model to render.
        data: State of the world at the last `update`.
    """

    def __init__(self, world: World):
        self._world = world
        spec = world.describe()
        for body in spec.bodies:
            if meshes := arm_meshes(world.arm.robot, body.name):
                for geom in body.geoms:
                    # The meshes do not include the plates and the pictures on them.
                    if "marker" not in geom.name:
                        geom.group = _HIDDEN
                for mesh in meshes:
                    add_mesh(spec, body, mesh)
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        self.update()

    def update(self) -> None:
        """Copy the poses of all bodies from the world."""
        data, now = self.data, self._world.data
        data.qpos[:], data.time = now.qpos, now.time
        data.mocap_pos[:], data.mocap_quat[:] = now.mocap_pos, now.mocap_quat
        mujoco.mj_kinematics(self.model, data)
        mujoco.mj_camlight(self.model, data)


class RecordedWorld:
    """A recorded run, which can be rendered at any of its steps.

    Only the recording is needed: runs of any task, simulated or not, can be shown without the
    world in which they took place.

    Attributes:
        model: Model to render. Its bodies have no joints; `show` places each of them.
        data: State of the run at the last `show`.
    """

    def __init__(self, recording: RunRecording):
        self._bodies = recording.bodies
        spec = mujoco.MjSpec()
        spec.compiler.degree = False
        add_surroundings(spec)
        for box in recording.boxes:
            add_box(spec.worldbody, "", box.half_size, box.colour, pos=box.centre)
        for number, body in enumerate(recording.bodies):
            drawn = spec.worldbody.add_body(name=f"body{number}", mocap=True)
            for mesh in body.meshes:
                add_mesh(spec, drawn, mesh)
            for box in body.boxes:
                # Boxes with a name are drawn in addition to meshes.
                if box.name or not body.meshes:
                    add_box(drawn, "", box.half_size, box.colour, pos=box.centre)
            for capsule in () if body.meshes else body.capsules:
                add_capsule(drawn, "", capsule, capsule.colour)
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        self.show(0)

    def show(self, step: int) -> None:
        """Place all bodies where they were at a step."""
        for number, body in enumerate(self._bodies):
            self.data.mocap_pos[number] = body.position[step]
            self.data.mocap_quat[number] = body.orientation[step]
        self.update()

    def update(self) -> None:
        """Compute the poses for rendering."""
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_camlight(self.model, self.data)


def add_mesh(spec: mujoco.MjSpec, body: mujoco.MjsBody, mesh: MeshFile) -> None:
    """Add a mesh to a body for display only: it has no contacts and no mass."""
    for part in read_mesh(mesh.path):
        placed = part.placed(mesh)
        name = f"mesh{len(spec.meshes)}"
        shape = spec.add_mesh(name=name)
        shape.uservert = placed.vertices.ravel()
        shape.usernormal = placed.normals.ravel()
        shape.userface = placed.faces.ravel()
        shape.userfacenormal = placed.faces.ravel()
        # An open surface has no volume to compute an inertia from.
        shape.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
        material = spec.add_material(name=name, specular=_SPECULAR, shininess=_SHININESS)
        material.rgba = (1.0, 1.0, 1.0, 1.0)
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_MESH,
            meshname=name,
            material=name,
            rgba=placed.colour or (1.0, 1.0, 1.0, 1.0),
            group=_SHOWN,
            contype=0,
            conaffinity=0,
            mass=0.0,
        )
