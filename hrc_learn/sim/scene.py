"""The workplace: arm, table with objects, a cabinet with three shelves, a fixed camera.

The robot stands at the origin. To its left (+y) is the table, where people work too; to its
right (-y) is the cabinet. The arm must keep its elbow away from the cabinet's open door.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType

import mujoco
import numpy as np
from jaxtyping import Float

from hrc_learn.geometry import Box
from hrc_learn.kinematics import panda
from hrc_learn.sim.arm_model import (
    FIRM,
    ArmModelConfig,
    Plate,
    add_arm,
    add_box,
    add_picture,
    add_plate,
)
from hrc_learn.sim.worker import COLOURS, PARTS, WORKER_ITEM_HALF_SIZE, Worker, WorkerConfig
from hrc_learn.vision import CameraModel, Marker
from hrc_learn.vision.imaging import carton, wood_grain

# pyright: reportAttributeAccessIssue=false
# MuJoCo ships no type stubs; its names come from a compiled module.


HAND_MARKER = 7
"""ArUco number of the plate on the end effector."""

OCCLUDER = "occluder"
"""Name of the board that occludes markers."""
OCCLUDER_HALF_SIZE = (0.07, 0.09, 0.004)
"""Half edges of this board [m]."""
OCCLUDER_COLOUR = (0.55, 0.36, 0.30, 1.0)
WORKER_BODIES = tuple(f"worker_{part}" for part in PARTS)
"""Names of the bodies, and of the capsules, that a worker is made of."""
WORKER_ITEM = "worker_item"
"""Name of the object that the worker puts on the table; it is visible but has no contacts."""
NOWHERE = (0.0, 0.0, -5.0)
"""Position of objects that are not in the scene: far below the floor [m]."""


@dataclass(frozen=True, kw_only=True)
class CabinetConfig:
    """A cabinet that opens towards +y, with a door that stands open at right angles."""

    left: float = 0.12
    """x of the inner face of the left wall, where the door hangs [m]."""
    right: float = 0.72
    """x of the inner face of the right wall [m]."""
    front: float = -0.50
    """y of the boards' front edges [m]."""
    depth: float = 0.36
    """Depth of the boards [m]."""
    bottom: float = -0.72
    """Height of the walls' lower end [m]; the robot's base is at zero."""
    top: float = 0.86
    """Height of the walls' upper end [m]."""
    shelves: Mapping[str, float] = field(
        default_factory=lambda: MappingProxyType({"lower": 0.12, "middle": 0.36, "upper": 0.60})
    )
    """Height of each board's upper face, by name [m]."""
    thickness: float = 0.02
    """Thickness of boards and walls [m]."""
    door_reach: float = 0.34
    """Width of the open door [m]; 0: no door."""

    def boxes(self) -> list[Box]:
        """Boards, walls, back and door."""
        x, w = (self.left + self.right) / 2, (self.right - self.left) / 2
        y, d = self.front - self.depth / 2, self.depth / 2
        t, z, h = self.thickness / 2, (self.top + self.bottom) / 2, (self.top - self.bottom) / 2
        wood, glass = (0.75, 0.62, 0.45, 1.0), (0.55, 0.70, 0.75, 0.45)
        door_y, back_y = self.front + self.door_reach / 2, self.front - self.depth - t
        parts = [
            *(
                (f"board_{name}", (x, y, top - t), (w, d, t))
                for name, top in self.shelves.items()
            ),
            ("cabinet_top", (x, y, self.top - t), (w, d, t)),
            ("cabinet_left", (self.left - t, y, z), (t, d, h)),
            ("cabinet_right", (self.right + t, y, z), (t, d, h)),
            ("cabinet_back", (x, back_y, z), (w + 2 * t, t, h)),
        ]
        if self.door_reach > 0:
            door = (self.left - t, door_y, z), (t, self.door_reach / 2, h)
            parts.append(("cabinet_door", *door))
        return [
            Box(
                name=name,
                centre=centre,
                half_size=half_size,
                colour=glass if name == "cabinet_door" else wood,
            )
            for name, centre, half_size in parts
        ]


@dataclass(frozen=True, kw_only=True)
class ObjectConfig:
    """A box to grasp, with a marker on top."""

    name: str = "box"
    half_size: tuple[float, float, float] = (0.022, 0.040, 0.030)
    """Half edges [m]; the gripper closes along x of the box."""
    mass: float = 0.12
    """Mass [kg]."""
    marker: Marker = field(default_factory=lambda: Marker(11, 0.030))
    colour: tuple[float, float, float, float] = (0.16, 0.44, 0.70, 1.0)

    def scaled(self, size: float) -> "ObjectConfig":
        """The same object of the same density at another size, its marker included."""
        a, b, c = self.half_size
        return replace(
            self,
            half_size=(size * a, size * b, size * c),
            mass=size**3 * self.mass,
            marker=replace(self.marker, size=size * self.marker.size),
        )


_TABLE = Box(
    name="table",
    centre=(0.26, 0.54, -0.02),
    half_size=(0.42, 0.34, 0.02),
    colour=(0.83, 0.80, 0.74, 1.0),
)


def overhead_camera() -> CameraModel:
    """Camera above the table, with slight lens distortion; u increases along -x, v along +y."""
    pose = np.eye(4)
    pose[:3, :3] = np.diag([-1.0, 1.0, -1.0])
    pose[:3, 3] = (0.24, 0.52, 1.55)
    return CameraModel(
        focal=(2050.0, 2050.0), distortion=(-0.06, 0.02, 0.0, 0.0, 0.0), pose=pose
    )


_BEYOND = 0.04  # distance of the plate's middle from the links above the hand [m]


def marked_plate(size: float = 1.0, thickness: float = 0.0) -> Plate:
    """The marker plate on the hand.

    Args:
        size: Size of the hand relative to the Franka hand.
        thickness: Radius of the links above the hand, beyond which the plate sticks out [m].
    """
    # The plate sticks out sideways, so that the forearm does not hide it from above. The plate
    # is as wide as objects and mounted off the middle, so that it is not the first part to
    # touch a board.
    return Plate(
        marker=Marker(HAND_MARKER, 0.048 * size),
        position=(-0.008 * size, max(0.145 * size, thickness + _BEYOND), 0.02 * size),
        orientation=(0.0, 1.0, 0.0, 0.0),
    )


_ARM = ArmModelConfig(robot=panda, marker=marked_plate())


@dataclass(frozen=True, kw_only=True)
class UnmarkedLook:
    """Clutter, light and prints of a scene without markers, drawn from a seed.

    The physics stays the same, except that the marker plates are gone: clutter is visible but
    has no contacts. Frames of markers stay as sites, as ground truth for measurements.
    """

    seed: int = 0
    """Seed of clutter and light; the same object has the same print in every scene."""
    clutter: int = 10
    """Number of small items on the rim of the table."""
    distractors: int = 2
    """Number of cartons with the object's size and another print."""
    shadows: bool = True
    """True: a lamp casts shadows."""

    def apply(self, spec: mujoco.MjSpec, config: "SceneConfig") -> None:
        """Give a scene this look."""
        rng = np.random.default_rng([self.seed, 54])
        table, (x, y, z) = config.table, config.table.centre
        top = z + table.half_size[2]
        add_picture(spec, "wood", wood_grain(rng))
        spec.geom(table.name).material = "wood"
        spec.geom(table.name).rgba = np.append(rng.uniform(0.75, 1.0, 3), 1.0)
        for item in config.objects:
            add_picture(spec, f"{item.name}_print", carton(item.name, item.colour))
            spec.geom(item.name).material = f"{item.name}_print"
            spec.geom(item.name).rgba = (1.0, 1.0, 1.0, 1.0)
        item = config.objects[0]
        for k in range(self.clutter + self.distractors):
            # On the rim of the table, away from the places of objects.
            side, along = rng.uniform(0.62, 0.95) * rng.choice([-1, 1]), rng.uniform(-0.9, 0.9)
            reach = (side, along) if rng.uniform() < 0.5 else (along, side)
            w, d, _ = table.half_size
            half = rng.uniform(0.01, 0.05, 3) * (1, 1, 0.3)
            name, colour = f"clutter{k}", (*rng.uniform(0.1, 0.9, 3), 1.0)
            if k >= self.clutter:
                half, name = np.array(item.half_size), f"distractor{k - self.clutter}"
                colour = item.colour if k == self.clutter else colour
            add_picture(spec, name, carton(f"{name} {self.seed}", colour))
            turn = rng.uniform(0, np.pi)
            add_box(
                spec.worldbody,
                name,
                half,
                (1.0, 1.0, 1.0, 1.0),
                pos=(x + reach[0] * (w - 0.06), y + reach[1] * (d - 0.06), top + half[2]),
                quat=(np.cos(turn / 2), 0.0, 0.0, np.sin(turn / 2)),
                material=name,
                contype=0,
                conaffinity=0,
            )
        lamp = spec.lights[0]
        lamp.pos = np.array([x, y, 2.4]) + rng.uniform(-0.8, 0.8, 3) * (1, 1, 0.2)
        lamp.dir = np.array([x, y, 0.0]) - lamp.pos
        lamp.diffuse = np.full(3, rng.uniform(0.35, 0.65))
        lamp.castshadow = self.shadows
        spec.visual.quality.shadowsize = 2048 if self.shadows else 0


@dataclass(frozen=True, kw_only=True)
class SceneConfig:
    """Everything that stands in the workplace."""

    arm: ArmModelConfig = _ARM
    table: Box = _TABLE
    cabinet: CabinetConfig = field(default_factory=CabinetConfig)
    objects: tuple[ObjectConfig, ...] = (ObjectConfig(),)
    camera: CameraModel = field(default_factory=overhead_camera)
    obstacles: tuple[Box, ...] = ()
    """Obstacles that people put in the way and remove again (`World.move_obstacle`)."""
    worker: WorkerConfig | None = None
    """Worker at the table (`World.move_worker`); None: no worker."""
    look: UnmarkedLook | None = None
    """Look without markers (see `unmarked`); None: plain colours, and markers."""
    timestep: float = 0.002
    """Physics step [s]."""

    @property
    def marker_ids(self) -> tuple[int, ...]:
        """ArUco numbers of the markers on the end effector and on the objects."""
        return HAND_MARKER, *(item.marker.id for item in self.objects)

    def boxes(self) -> list[Box]:
        """The fixed furniture, for drawing and for collision checks."""
        return [self.table, *self.cabinet.boxes()]


def unmarked(
    scene: SceneConfig, look: UnmarkedLook, place: Float[np.ndarray, "3"] | None = None
) -> SceneConfig:
    """The scene without markers, with another look.

    Args:
        scene: Scene with markers.
        look: Look of the scene.
        place: Point on the tool that replaces the marker in measurements, in the tool's frame
            [m]; None: the marker's place.
    """
    arm, plate = scene.arm, scene.arm.marker
    if plate is not None:
        plate = replace(plate, printed=False)
        if place is not None:
            x, y, z = place.tolist()
            behind = float(arm.robot.tcp[:3, 3].norm())
            plate = replace(plate, position=(x, y, z + behind))
        arm = replace(arm, marker=plate)
    return replace(scene, arm=arm, look=look)


def build_scene(config: SceneConfig) -> mujoco.MjSpec:
    """Describe the workplace as an `MjSpec`; `MjSpec.compile` makes the model."""
    spec = mujoco.MjSpec()
    spec.modelname = "hrc_learn workplace"
    _set_options(spec, config)
    add_surroundings(spec)
    add_arm(spec, config.arm)
    for box in config.boxes():
        _add_box(spec, box)
    for obstacle in config.obstacles:
        _add_box(spec, obstacle).mocap = True
    for item in config.objects:
        _add_object(spec, item, printed=config.look is None)
    # A board that may be held in front of the camera; nothing can touch it.
    board = spec.worldbody.add_body(name=OCCLUDER, pos=NOWHERE, mocap=True)
    add_box(board, OCCLUDER, OCCLUDER_HALF_SIZE, OCCLUDER_COLOUR, contype=0, conaffinity=0)
    if config.worker is not None:
        _add_worker(spec, Worker(config.worker), config.objects)
    if config.look is not None:
        config.look.apply(spec, config)
    return spec


def _set_options(spec: mujoco.MjSpec, config: SceneConfig) -> None:
    spec.compiler.degree = False
    spec.option.timestep = config.timestep
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    # Elliptic cones, a stiff friction constraint and the no-slip pass keep a grasped object
    # from slipping.
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = 10
    spec.option.noslip_iterations = 3
    spec.visual.global_.offwidth = config.camera.width
    spec.visual.global_.offheight = config.camera.height


def add_surroundings(spec: mujoco.MjSpec) -> None:
    """Add light, floor, pedestal and sky, and set the quality of rendering."""
    spec.visual.quality.offsamples = 0  # four times faster without a GPU
    spec.visual.quality.shadowsize = 0
    spec.visual.headlight.ambient = (0.45, 0.45, 0.45)
    spec.visual.headlight.diffuse = (0.35, 0.35, 0.35)
    spec.visual.headlight.specular = (0.0, 0.0, 0.0)
    spec.visual.map.znear = 0.02
    spec.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=(0.93, 0.95, 0.97),
        rgb2=(0.75, 0.80, 0.86),
        width=64,
        height=384,
    )
    spec.worldbody.add_light(
        pos=(0.5, 0.5, 2.5), dir=(-0.1, -0.1, -1), diffuse=(0.3, 0.3, 0.3), castshadow=False
    )
    spec.worldbody.add_geom(
        name="floor",
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=(2.5, 2.5, 0.1),
        pos=(0, 0, -0.72),
        rgba=(0.62, 0.64, 0.66, 1.0),
    )
    grey = (0.3, 0.3, 0.32, 1)
    add_box(spec.worldbody, "pedestal", (0.12, 0.12, 0.36), grey, pos=(-0.03, 0, -0.36))


def _add_box(spec: mujoco.MjSpec, box: Box):
    body = spec.worldbody.add_body(name=box.name, pos=box.centre)
    add_box(body, box.name, box.half_size, box.colour)
    return body


def _add_object(spec: mujoco.MjSpec, item: ObjectConfig, printed: bool) -> None:
    body = spec.worldbody.add_body(name=item.name, pos=(0.22, 0.5, item.half_size[2]))
    body.add_freejoint(name=item.name)
    friction = (1.0, 0.02, 0.001)  # sliding, torsional [m], rolling [m]
    add_box(
        body, item.name, item.half_size, item.colour, mass=item.mass, friction=friction, **FIRM
    )
    place = 0.0, 0.0, item.half_size[2] + 0.0005
    top = Plate(marker=item.marker, position=place, solid=False, printed=printed)
    add_plate(spec, body, f"{item.name}_marker", top)


# Collision bit of a worker. Furniture lacks this bit: the worker may lean on the table.
_FEELS_WORKER = 2


def _add_worker(spec: mujoco.MjSpec, worker: Worker, objects: tuple[ObjectConfig, ...]) -> None:
    """Add a worker. Contacts with the worker exert no force: bodies with a prescribed motion do
    not yield, and would push with unlimited force.
    """
    for mover in ("link0", *(item.name for item in objects)):
        for geom in spec.body(mover).find_all(mujoco.mjtObj.mjOBJ_GEOM):
            if geom.contype:
                geom.conaffinity |= _FEELS_WORKER
    lengths, radii = worker.lengths.tolist(), worker.radius.tolist()
    for name, length, radius, colour in zip(
        WORKER_BODIES, lengths, radii, COLOURS, strict=True
    ):
        body = spec.worldbody.add_body(name=name, pos=NOWHERE, mocap=True)
        body.add_geom(
            name=name,
            type=mujoco.mjtGeom.mjGEOM_CAPSULE,
            size=(radius, length / 2, 0),
            rgba=colour,
            contype=_FEELS_WORKER,
            conaffinity=0,
            # Contacts are detected as usual, but exert a force only at depths above 1 m.
            margin=-1.0,
            gap=1.0,
        )
    item = spec.worldbody.add_body(name=WORKER_ITEM, pos=NOWHERE, mocap=True)
    add_box(
        item,
        WORKER_ITEM,
        WORKER_ITEM_HALF_SIZE,
        (0.62, 0.20, 0.22, 1.0),
        contype=0,
        conaffinity=0,
    )
