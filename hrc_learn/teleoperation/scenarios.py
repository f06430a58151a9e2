"""Tasks to learn in the simulated workplace: set up, demonstrate, execute, and judge success.

Success is judged by MuJoCo's contacts and poses.
"""

from __future__ import annotations

from collections.abc import Callable, Set
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import ClassVar

import numpy as np
import torch
from jaxtyping import Float, UInt8

from hrc_learn.controller import SafetyConfig
from hrc_learn.controller.contact_limits import PersonMode
from hrc_learn.kinematics import Arm, gripper_down
from hrc_learn.protocols import ArmState, Feedback, Human, HumanInput
from hrc_learn.sim import (
    CameraChange,
    CameraKind,
    Imperfections,
    Worker,
    WorkerConfig,
    WorkerSensor,
    WorkerVisit,
    World,
    open_camera,
    random_visit,
    whole_arm,
)
from hrc_learn.sim.cameras import hidden_markers
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills.arm_motion import PositionServo, PositionServoConfig
from hrc_learn.skills.grasping import CLOSED, OPEN
from hrc_learn.skills.marker_sensor import MarkerSensor
from hrc_learn.skills.person_watch import PersonWatch
from hrc_learn.teleoperation.scripted_demonstrations import (
    PlacingDemonstrationConfig,
    placing_expert,
)
from hrc_learn.teleoperation.scripted_expert import GuidedPath, ScriptedExpert, Tremor
from hrc_learn.vision import CameraModel, ImageNoise, Marker, SyntheticCamera

_RELEASE = 1.5  # time for the fingers to open [s]
_REACH = (0.10, 0.08, 0.0)  # largest distance of the object from the middle of the table [m]
# Durations of the phases of a grasp [s]: approach from above, closing fingers, lift, rest.
_APPROACH, _GRIP, _LIFT, _SETTLE = 4.0, 0.7, 2.0, 0.5
_HEIGHT = 0.15  # height to which the object is lifted [m]
_TREMOR = 2e-4  # amplitude of the end effector's tremor while it grasps [m]


# `_PLACING`: settings of the placing expert. `_LET_GO`: time at which it releases the object
# [s].
_PLACING = PlacingDemonstrationConfig()
_LET_GO = _PLACING.duration + _PLACING.settle


@dataclass(frozen=True, kw_only=True)
class Placing:
    """Place the object that the gripper holds on a shelf, and release it."""

    workplace: Workplace = field(default_factory=Workplace)
    shelf: str = "middle"
    duration: ClassVar[float] = _LET_GO + _RELEASE
    """Duration of the task [s]."""

    @property
    def task(self) -> str:
        """Description of the task."""
        return f"place the box on the {self.shelf} shelf"

    def begin(self, world: World, rng: np.random.Generator) -> Human:
        expert = placing_expert(world, self.workplace, self.shelf, _PLACING, rng)
        return SequencedInput([(0.0, expert, CLOSED), (_LET_GO, expert, OPEN)])

    def succeeded(self, world: World) -> bool:
        return world.rests_on(self.workplace.scene.objects[0].name, f"board_{self.shelf}")


@dataclass(frozen=True, kw_only=True)
class Grasping:
    """Grasp an object at a random place on the table, and lift it."""

    workplace: Workplace = field(default_factory=Workplace)
    task: ClassVar[str] = "grasp the box and lift it"
    duration: ClassVar[float] = _APPROACH + _GRIP + _LIFT + _SETTLE

    def begin(self, world: World, rng: np.random.Generator) -> Human:
        item = self.workplace.scene.objects[0]
        pose = self.workplace.random_object_pose(self.workplace.scaled(_REACH), rng)
        # Actual heights of table and object, which differ from the nominal ones.
        pose[2, 3] = world.table_top + world.config.objects[0].half_size[2]
        hover = self.workplace.hover()
        joints = self.workplace.robot.inverse(hover, near=self.workplace.hover_joints())
        world.reset(joints.numpy(), {item.name: pose})
        grasp = pose[:3, 3]
        size = self.workplace.robot.hand_size
        above, lifted = (grasp + np.array([0.0, 0.0, size * h]) for h in (0.08, _HEIGHT))

        def lead(points: list[np.ndarray], duration: float, start: float) -> ScriptedExpert:
            return ScriptedExpert(
                self.workplace.robot.chain,
                GuidedPath(np.vstack(points), duration, start),
                lambda _position, _time: gripper_down(),
                Tremor(_TREMOR, rng),
            )

        closing = _APPROACH + _GRIP
        down = lead([hover.position.numpy(), above, grasp], _APPROACH, 0.0)
        up = lead([grasp, lifted], _LIFT, closing)
        return SequencedInput(
            [(0.0, down, OPEN), (_APPROACH, down, CLOSED), (closing, up, CLOSED)]
        )

    def succeeded(self, world: World) -> bool:
        item = self.workplace.scene.objects[0]
        bottom = world.object_pose(item.name)[2, 3] - max(item.half_size)
        return world.holds(item.name) and bool(
            bottom > 0.5 * self.workplace.robot.hand_size * _HEIGHT
        )


Scenario = Placing | Grasping
"""Task of both the demonstrator and the learned policy.

`begin(world, rng)` sets up the scene, with the world's clock at zero, and returns a
demonstrator. `succeeded(world)` is true if the task is done.
"""


class SequencedInput(Human):
    """Demonstrators that guide the arm in turn, each with a gripper width."""

    def __init__(self, turns: list[tuple[float, Human, float]]):
        """Store the turns.

        Args:
            turns: Start time [s], demonstrator and gripper width [m] of each turn.
        """
        self._turns, self._leads = turns, turns[0][1]

    def read(self, state: ArmState) -> HumanInput:
        """Input of the demonstrator whose turn it is."""
        begun = [turn for turn in self._turns if turn[0] <= state.time]
        _, self._leads, width = begun[-1] if begun else self._turns[0]
        return replace(self._leads.read(state), gripper=width)

    def tell(self, feedback: Feedback) -> None:
        """Pass the feedback to the demonstrator whose turn it is."""
        self._leads.tell(feedback)


class ScenarioRun:
    """Simulated world that repeats a scenario, each time from a given seed.

    Time advances with commands only, so the same seed and commands give the same result.

    Attributes:
        scenario: Task to perform.
        world: Simulated world.
        dt: Control period [s].
        expert: Demonstrator for the present initial configuration.
        servo: Position servo of the arm.
        camera: Fixed camera at its present pose.
        seed: Seed of the present initial configuration.
        commands: Number of commands since the initial configuration.
        visit: Motion of the worker; None: no worker.
    """

    expert: Human
    visit: WorkerVisit | None

    def __init__(
        self,
        scenario: Scenario,
        fps: float,
        *,
        seed: int = 0,
        imperfections: Imperfections | None = None,
        worker: PersonMode | None = None,
    ):
        """Build the world, and set up the first initial configuration.

        Args:
            scenario: Task to perform.
            fps: Commands per second of simulated time.
            seed: Seed of the first initial configuration.
            imperfections: Imperfections of arm, calibration and workplace, drawn again for each
                seed; None: no imperfections.
            worker: Reaction of the arm to a worker at the table; None: no worker. Each seed
                draws another worker.
        """
        self._worker, self.visit = worker, None
        self.scenario, self.dt = scenario, 1.0 / fps
        self._sizes = imperfections or Imperfections.ideal()
        self._build(np.random.default_rng(0))
        self.camera = scenario.workplace.scene.camera
        self._noise, self._tool_noise = np.random.default_rng(0), np.random.default_rng(0)
        self.begin(seed)

    def begin(self, seed: int) -> None:
        """Set up the initial configuration of a seed."""
        self.seed, self.commands = seed, 0
        if self._sizes != Imperfections.ideal() or self._worker is not None:
            self._build(np.random.default_rng([seed, 2]))
        self.expert = self.scenario.begin(self.world, np.random.default_rng(seed))
        self.servo.restart()
        self._pixel: np.ndarray | None = None
        _reseed(self._tool_noise, [seed, 3])

    def _build(self, rng: np.random.Generator) -> None:
        """Build the world with drawn imperfections, and the servo of its arm."""
        workplace, robot = self.scenario.workplace, self.scenario.workplace.robot
        drawn = self._sizes.draw(rng, robot.joints, robot.hand_size)
        scene, safety = workplace.scene, self._sizes.plant(SafetyConfig())
        if self._worker is not None:
            body = Worker(WorkerConfig.draw(rng))
            under = workplace.table_centre
            self.visit = random_visit(body, rng, bench=scene.table, under=under)
            scene = replace(scene, worker=body.config)
        world = self.world = World(scene, drawn)
        watch = None
        if self._worker is not None and self.visit is not None:
            radius, clock = self.visit.worker.radius, lambda: world.time
            watch = PersonWatch(
                WorkerSensor(self.visit.ends_at, radius, clock, self._sizes, rng),
                whole_arm(scene.arm),
                replace(safety.separation, mode=self._worker),
                furniture=scene.boxes(),
            )
        self.servo = PositionServo(
            robot.chain, world.arm, self.dt, PositionServoConfig(safety=safety), watch
        )

    def command(self, joints: Float[np.ndarray, " joints"], width: float) -> np.ndarray:
        """Command joints and gripper, and advance the world by a control period.

        Args:
            joints: Joint positions to reach by the next command [rad].
            width: Opening of the gripper [m].

        Returns:
            Joint positions that were actually commanded, within the limits [rad].
        """
        with torch.inference_mode():
            _, sent = self.servo.follow(joints)
        if np.isfinite(width):
            self.world.arm.move(width)
        if self.visit is not None:
            ends = self.visit.ends_at(self.world.time)
            self.world.move_worker(ends, self.visit.item_at(self.world.time, ends))
        self.world.advance(self.dt)
        self.commands += 1
        return sent

    def object_pixel(self) -> Float[np.ndarray, "2"]:
        """Pixel (u, v) of the object's marker in the fixed camera.

        The marker is detected once per configuration. The arm never hides it.

        Raises:
            ValueError: The object is not in view.
        """
        marker = self.scenario.workplace.scene.objects[0].marker.id
        if self._pixel is None:
            sensor = self._sensor  # before reseeding: its background takes random numbers
            _reseed(self._noise, [self.seed, 1])
            self._pixel = sensor.detect().get(marker)
        if self._pixel is None:
            raise ValueError(
                f"the fixed camera does not see marker {marker} at the beginning: leave out "
                "the pixels of the object."
            )
        return self._pixel

    @cached_property
    def _sensor(self) -> MarkerSensor:
        """Marker detector of the fixed camera, for an image of the object alone."""
        return self._sensor_of(self.scenario.workplace.scene.objects[0].marker, self._noise)

    def tool_pixel(self) -> Float[np.ndarray, "2"] | None:
        """Pixel (u, v) of the tool's marker in the fixed camera; None: not in view."""
        return self._tool_sensor.detect().get(self.scenario.workplace.tool_marker)

    @cached_property
    def _tool_sensor(self) -> MarkerSensor:
        plate = self.scenario.workplace.scene.arm.marker
        if plate is None:
            raise ValueError("the arm of this scene carries no marker: leave out its pixel.")
        return self._sensor_of(
            plate.marker,
            self._tool_noise,
            lambda: hidden_markers(self.world, self.camera, [plate.marker]),
        )

    def _sensor_of(
        self,
        marker: Marker,
        rng: np.random.Generator,
        hidden: Callable[[], Set[int]] = frozenset,
    ) -> MarkerSensor:
        camera = SyntheticCamera(
            self.camera,
            [marker],
            lambda: {marker.id: self.world.marker_poses()[marker.id]},
            rng=rng,
            hidden=hidden,
        )
        return MarkerSensor(camera, [marker.id])

    def move_camera(self, change: CameraChange, rng: np.random.Generator) -> None:
        """Move the fixed camera to another pose, from which it still sees the table.

        Args:
            change: Displacement from the camera's pose in the scene.
            rng: Source of the direction.

        Raises:
            ValueError: No camera pose at this distance sees the table.
        """
        self.camera = change.applied(self.scenario.workplace.scene.camera, self._watched(), rng)
        for name in ("_sensor", "_tool_sensor"):
            self.__dict__.pop(name, None)
        self._pixel = None

    def _watched(self) -> Float[np.ndarray, "points 3"]:
        """Points that the camera must see, in the base frame [m].

        They are the corners of the objects' region on the table, and the corners of the region
        of the tool's marker at two heights above the table.
        """
        place = self.scenario.workplace
        middle, half = (x.numpy() for x in place.object_region())
        corners = np.array([[a, b, 0.0] for a in (-1, 1) for b in (-1, 1)]) * half
        tool = self.world.hand_marker_offset() * (1.0, -1.0, -1.0)  # the tool points down
        heights = (place.hover_height, 2 * middle[2])
        above = [np.array([*middle[:2], h]) + tool for h in heights]
        return np.concatenate([centre + corners for centre in (middle, *above)])

    def succeeded(self) -> bool:
        """True if the task is done according to MuJoCo's contacts."""
        return self.scenario.succeeded(self.world)


def _reseed(rng: np.random.Generator, seed: list[int]) -> None:
    """Reseed a generator in place: cameras keep a reference to their source of noise."""
    rng.bit_generator.state = np.random.default_rng(seed).bit_generator.state


class ScenarioView:
    """Images of a run, small enough to learn from."""

    def __init__(self, run: ScenarioRun, width: int, height: int, kind: CameraKind = "auto"):
        """Set up a camera that sees table, arm and cabinet.

        Args:
            run: Run to look at.
            width: Width of the images [px].
            height: Height of the images [px].
            kind: "egl" renders everything; "synthetic" draws the markers on the table only.

        Raises:
            RenderingUnavailableError: `kind` is "egl" and this machine cannot render.
        """
        model = overview(width, height)
        if kind == "synthetic":
            model = _scaled(run.scenario.workplace.scene.camera, width, height)
        self._run, self._model = run, model
        self._kind: CameraKind = kind
        self._open()

    def _open(self) -> None:
        self._world, rng = self._run.world, np.random.default_rng(0)
        self._camera = open_camera(
            self._world, self._kind, self._model, rng=rng, noise=ImageNoise()
        )

    def read(self) -> UInt8[np.ndarray, "height width 3"]:
        """Present image, RGB."""
        if self._world is not self._run.world:  # rebuilt with other imperfections
            self._open()
        return self._camera.read()


def overview(width: int, height: int) -> CameraModel:
    """Camera in front of the arm, with table, end effector and shelves in view."""
    focal = 0.9 * min(width / 4 * 3, height)
    middle = ((width - 1) / 2, (height - 1) / 2)
    model = CameraModel(width=width, height=height, focal=(focal, focal), principal=middle)
    return model.look_at(np.array([1.9, 0.35, 1.15]), np.array([0.25, -0.02, 0.25]))


def _scaled(model: CameraModel, width: int, height: int) -> CameraModel:
    """The same camera with coarser pixels."""
    fx, fy = width / model.width, height / model.height
    return replace(
        model,
        width=width,
        height=height,
        focal=(model.focal[0] * fx, model.focal[1] * fy),
        principal=(
            (model.principal[0] + 0.5) * fx - 0.5,
            (model.principal[1] + 0.5) * fy - 0.5,
        ),
    )


SCENARIOS = ("placing", "grasping")
SHELVES = ("lower", "middle", "upper")


def check_scenario(name: str, shelf: str, pixels: bool) -> None:
    """Check scenario and shelf before anything is built.

    Raises:
        ValueError: There is no such scenario or shelf, or pixels are requested for placing.
    """
    if name not in SCENARIOS:
        raise ValueError(f"no scenario {name!r}: there are {', '.join(SCENARIOS)}.")
    if shelf not in SHELVES:
        raise ValueError(f"no shelf {shelf!r}: there are {', '.join(SHELVES)}.")
    if pixels and name == "placing":
        raise ValueError("placing begins with the object in the gripper, so it has no pixels.")


def make_scenario(name: str, shelf: str, robot: Arm) -> Scenario:
    """Create a scenario in the workplace of an arm.

    Raises:
        UnreachableError: The arm cannot do the task in any layout.
    """
    workplace = Workplace.of(robot)
    if name == "placing":
        return Placing(workplace=workplace, shelf=shelf)
    return Grasping(workplace=workplace)
