"""A world as it is recorded and drawn: poses of all bodies, and the arm with its meshes.

The physics knows the arm by its capsules: meshes would cost time in each step and change the
contacts. Pictures are rendered from a second model that takes over the state of the first.
"""

from collections.abc import Callable, Iterable

import mujoco
import numpy as np
from jaxtyping import Bool, Float

from hrc_learn.geometry import Body, Box, Capsule, MeshFile, read_mesh
from hrc_learn.geometry.shapes import Colour
from hrc_learn.kinematics.arm_shapes import arm_meshes
from hrc_learn.log import RunRecording
from hrc_learn.sim.scene import OCCLUDER, WORKER_BODIES, WORKER_ITEM, add_surroundings
from hrc_learn.sim.worker_tracking import NearestPair, WorkerDistance
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


_HIDDEN = 4  # geoms and sites of this group are not drawn
_SHOWN = 1
_SPECULAR, _SHININESS = 0.3, 0.4  # of painted metal and plastic


class DrawnWorld:
    """A world with meshes in place of the capsules of its arm, to be rendered.

    Where there are no meshes, capsules are drawn.

    Attributes:
        model: Model to render.
        data: As the world was at the last `update`.
    """

    def __init__(self, world: World):
        self._world = world
        spec = world.describe()
        for body in spec.bodies:
            if meshes := arm_meshes(world.arm.robot, body.name):
                for geom in body.geoms:
                    # Plates and the pictures on them are no part of the meshes.
                    if "marker" not in geom.name:
                        geom.group = _HIDDEN
                for mesh in meshes:
                    add_mesh(spec, body, mesh)
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        self._colours = self.model.geom_rgba.copy()
        self.update()

    def update(self) -> None:
        """Take over where everything is."""
        data, now = self.data, self._world.data
        data.qpos[:], data.time = now.qpos, now.time
        data.mocap_pos[:], data.mocap_quat[:] = now.mocap_pos, now.mocap_quat
        mujoco.mj_kinematics(self.model, data)
        mujoco.mj_camlight(self.model, data)

    def paint(self, geoms: Iterable[str], colour: Colour) -> None:
        """Let geoms of the world stand out, or the bodies that are drawn in their place.

        Args:
            geoms: Names of the geoms; all others regain their own colour.
            colour: RGBA, 0 to 1.
        """
        self.model.geom_rgba[:] = self._colours
        for name in geoms:
            geom = self.model.geom(name)
            if geom.group == _HIDDEN:
                own = self.model.geom_bodyid == geom.bodyid
                self.model.geom_rgba[own & (self.model.geom_group == _SHOWN)] = colour
            else:
                self.model.geom_rgba[geom.id] = colour


class RecordedWorld:
    """A run as its recording shows it, to be rendered at any of its steps.

    It needs no more than the recording: a run of any task, in simulation or not, can be looked
    at without the world that it ran in.

    Attributes:
        model: Model to render. Its bodies have no joints; each is put where it was.
        data: As the run was at the last `show`.
    """

    def __init__(self, recording: RunRecording):
        self._bodies = recording.bodies
        spec = mujoco.MjSpec()
        spec.compiler.degree = False
        add_surroundings(spec)
        for box in recording.boxes:
            _add_drawn_box(spec.worldbody, box)
        for number, body in enumerate(recording.bodies):
            _add_drawn_body(spec, body, f"body{number}")
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        self.show(0)

    def show(self, step: int) -> None:
        """Put everything where it was at a step."""
        for number, body in enumerate(self._bodies):
            self.data.mocap_pos[number] = body.position[step]
            self.data.mocap_quat[number] = body.orientation[step]
        self.update()

    def update(self) -> None:
        """Make ready to be rendered."""
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_camlight(self.model, self.data)

    def paint(self, geoms: Iterable[str], colour: Colour) -> None:
        """Nothing stands out: a recording does not know what touched what."""


def _add_drawn_body(spec: mujoco.MjSpec, body: Body, name: str) -> None:
    drawn = spec.worldbody.add_body(name=name, mocap=True)
    for mesh in body.meshes:
        add_mesh(spec, drawn, mesh)
    for box in body.boxes:
        if box.name or not body.meshes:  # as in every other picture of a body
            _add_drawn_box(drawn, box)
    for capsule in () if body.meshes else body.capsules:
        ends = np.array([*capsule.start, *capsule.end])
        if np.allclose(ends[:3], ends[3:]):  # a capsule without a length has no direction
            drawn.add_geom(
                type=mujoco.mjtGeom.mjGEOM_SPHERE,
                size=(capsule.radius, 0, 0),
                pos=capsule.start,
                rgba=capsule.colour,
            )
            continue
        drawn.add_geom(
            type=mujoco.mjtGeom.mjGEOM_CAPSULE,
            size=(capsule.radius, 0, 0),
            fromto=ends,
            rgba=capsule.colour,
        )


def _add_drawn_box(body: mujoco.MjsBody, box: Box) -> None:
    body.add_geom(
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=box.half_size,
        pos=box.centre,
        rgba=box.colour,
    )


def add_mesh(spec: mujoco.MjSpec, body: mujoco.MjsBody, mesh: MeshFile) -> None:
    """Add a shape that is seen, touches nothing and weighs nothing to a body."""
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
