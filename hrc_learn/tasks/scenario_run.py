"""A scenario under way in simulation: begun by seed, moved by targets, looked at."""

from dataclasses import replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float, UInt8

from ..kinematics import panda
from ..protocols import Human
from ..sim import CameraKind, World, open_camera
from ..vision import CameraModel, ImageNoise, SyntheticCamera
from .eye import Eye
from .position_servo import PositionServo, PositionServoConfig
from .scenario import Scenario


class ScenarioRun:
    """A world in which a scenario is done over and over, each time from a seed.

    Time passes by commands only, so that the same seed and commands lead to the same end.

    Attributes:
        scenario: What is to be done.
        world: Where.
        dt: Time that passes with each command [s].
        expert: Who can show it from where it began.
        servo: Leads the arm by positions.
        seed: Of the present beginning.
        commands: Given since then.
    """

    expert: Human

    def __init__(
        self,
        scenario: Scenario,
        fps: float,
        *,
        seed: int = 0,
        servo: PositionServoConfig | None = None,
    ):
        """Begin.

        Args:
            scenario: What is to be done.
            fps: Commands a second of the world's time.
            seed: Of the first beginning.
            servo: How positions are followed.
        """
        self.scenario, self.dt = scenario, 1.0 / fps
        self.world = World(scenario.workplace.scene)
        self.servo = PositionServo(panda, self.world.arm, self.dt, servo)
        self._noise = np.random.default_rng(0)
        self.begin(seed)

    def begin(self, seed: int) -> None:
        """Put everything in place as a seed has it."""
        self.seed, self.commands = seed, 0
        self.expert = self.scenario.begin(self.world, np.random.default_rng(seed))
        self.servo.restart()
        self._pixel: np.ndarray | None = None

    def command(self, joints: Float[np.ndarray, "7"], width: float) -> np.ndarray:
        """Send the joints and the gripper on their way, and let time pass.

        Args:
            joints: Positions to be reached when the next command is due [rad].
            width: Opening of the gripper [m].

        Returns:
            Where the joints were sent instead, within their limits [rad].
        """
        with torch.inference_mode():
            _, sent = self.servo.follow(joints)
        if np.isfinite(width):
            self.world.arm.move(width)
        self.world.advance(self.dt)
        self.commands += 1
        return sent

    def object_pixel(self) -> Float[np.ndarray, "2"]:
        """Where the fixed camera saw the object's marker (u, v) [px].

        It looked before the arm came between both, as a person would let it.

        Raises:
            ValueError: The object was not in its view.
        """
        marker = self.scenario.workplace.scene.objects[0].marker.id
        if self._pixel is None:
            eye = self._eye  # whose background takes random numbers when it is first made
            noise = np.random.default_rng([self.seed, 1])
            self._noise.bit_generator.state = noise.bit_generator.state
            self._pixel = eye.look().get(marker)
        if self._pixel is None:
            raise ValueError(
                f"the fixed camera does not see marker {marker} at the beginning: leave out "
                "the pixels of the object."
            )
        return self._pixel

    @cached_property
    def _eye(self) -> Eye:
        """Of the fixed camera, before which nothing but the object is ever seen."""
        scene = self.scenario.workplace.scene
        marker = scene.objects[0].marker

        def poses() -> dict[int, np.ndarray]:
            return {marker.id: self.world.marker_poses()[marker.id]}

        camera = SyntheticCamera(scene.camera, [marker], poses, rng=self._noise)
        return Eye.on(camera, scene)

    def succeeded(self) -> bool:
        """Whether the job is done, by MuJoCo's contacts."""
        return self.scenario.succeeded(self.world)


class ScenarioView:
    """Images of a run, small enough to learn from."""

    def __init__(self, run: ScenarioRun, width: int, height: int, kind: CameraKind = "auto"):
        """Set up a camera that sees table, arm and cabinet.

        Args:
            run: What to look at.
            width: Of the images [px].
            height: Of the images [px].
            kind: "egl" renders everything; "synthetic" draws the markers on the table only.

        Raises:
            RenderingUnavailableError: `kind` is "egl" and this machine cannot render.
        """
        rng, noise = np.random.default_rng(0), ImageNoise()
        model = overview(width, height)
        if kind == "synthetic":
            model = _scaled(run.scenario.workplace.scene.camera, width, height)
        self._camera = open_camera(run.world, kind, model, rng=rng, noise=noise)

    def read(self) -> UInt8[np.ndarray, "height width 3"]:
        """The image now, RGB."""
        return self._camera.read()


def overview(width: int, height: int) -> CameraModel:
    """A camera in front of the arm that has table, hand and shelves in view."""
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
