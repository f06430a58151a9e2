"""Many short closed loops in one batch: the hand's marker to its target, seen by the scene's
camera.

The arm's kinematics against the camera, lens and all, which the controller cannot see. So
that no guess is right by luck, the camera is turned about its axis by another angle in each of
the starts.
"""

import math
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..controller import AdaptiveController, ControllerConfig, Goals
from ..controller.goals import IMAGE_SIZE
from ..controller.rehearsal import Imperfections, VirtualCamera, rehearse
from ..geometry import Pose, quaternion
from ..human import gripper_down
from ..jacobian import ImageJacobianEstimator
from ..kinematics import panda
from ..vision import CameraModel
from .workplace import nearest_configuration


@dataclass(frozen=True, kw_only=True)
class StartsConfig:
    """How starts are drawn. Lengths [m], angles [rad]."""

    count: int = 200
    """Of starts."""
    largest_roll: float = math.pi
    """Of the camera about its axis, either way; 0: as the demonstrations saw it."""
    tilt: float = 0.1
    """Of the hand at the start, either way about each axis."""
    reached: float = 5.0
    """Pixel error that counts as converged once it is kept [px]."""
    duration: float = 4.0
    """[s]"""
    dt: float = 0.008
    """Control step [s]."""
    seed: int = 0
    """Of starts, targets, cameras and noise."""
    imperfections: Imperfections = field(
        default_factory=lambda: Imperfections(frame_steps=4, latency_frames=1, noise=0.5)
    )
    """Of the measurement."""


@dataclass(frozen=True, kw_only=True, eq=False)
class TurnedCamera:
    """The scene's camera, its image turned by an angle for each of the starts.

    About what it sees in the middle of the workspace, which is moved to the middle of the
    image: a camera that is turned about its axis, and its sensor shifted.
    """

    model: CameraModel
    offset: Float[Tensor, "3"]
    """Of the marker in the frame of the tool centre point [m]."""
    middle: Pose
    """Of the tool in the middle of the workspace."""
    roll: Float[Tensor, " starts"]
    """[rad]"""

    def project(self, tool: Pose) -> tuple[Float[Tensor, "starts 2"], Bool[Tensor, " starts"]]:
        """Marker in the image [px], and whether it is inside the image."""
        about = self._pixel(tool) - self._pixel(self.middle)
        half = about.new_tensor(IMAGE_SIZE) / 2
        turned = (turn_rows(self.roll) @ about[..., None])[..., 0]
        return turned + half, (turned.abs() < half).all(dim=-1)

    def _pixel(self, tool: Pose) -> Tensor:
        return torch.from_numpy(self.model.project(tool.apply(self.offset).numpy()))


def turn_rows(roll: Float[Tensor, " starts"]) -> Float[Tensor, "starts 2 2"]:
    """What a turn of the camera about its axis does to pixels about its centre."""
    c, s = roll.cos(), roll.sin()
    return torch.stack([torch.stack([c, s], -1), torch.stack([-s, c], -1)], -2)


@dataclass(frozen=True, kw_only=True, eq=False)
class ClosedLoops:
    """Starts, targets and cameras, the same for whatever is compared on them."""

    camera: TurnedCamera
    start: Float[Tensor, "starts joints"]
    """[rad]"""
    goals: Goals
    config: StartsConfig

    @classmethod
    def draw(
        cls,
        camera: CameraModel,
        offset: Float[np.ndarray, "3"],
        workspace: Float[Tensor, "2 3"],
        near: Float[Tensor, "joints"],
        config: StartsConfig,
    ) -> "ClosedLoops":
        """Draw them at random.

        Args:
            camera: The true one.
            offset: Of the marker in the frame of the tool centre point [m].
            workspace: Lower and upper corner of the box of starts and targets [m].
            near: Joints with the hand in it, near which starts are chosen [rad].
            config: How.
        """
        rng, n = torch.Generator().manual_seed(config.seed), config.count

        def uniform(*shape: int) -> Tensor:
            return 2 * torch.rand(n, *shape, generator=rng, dtype=torch.float64) - 1

        middle, half = workspace.mean(dim=0), (workspace[1] - workspace[0]) / 2
        down = gripper_down().expand(n, 4)
        turned = TurnedCamera(
            model=camera,
            offset=torch.from_numpy(offset),
            middle=Pose(middle, down[0]),
            roll=config.largest_roll * uniform(),
        )
        target = turned.project(Pose(middle + half * uniform(3), down))[0]
        tilted = quaternion.multiply(quaternion.exp(config.tilt * uniform(3)), down)
        return cls(
            camera=turned,
            start=_postures(Pose(middle + half * uniform(3), tilted), near),
            goals=Goals.at(middle, down[0], target),
            config=config,
        )

    def times(
        self, estimator: ImageJacobianEstimator, control: ControllerConfig | None = None
    ) -> Float[Tensor, " starts"]:
        """Time until the marker stays at its target [s]; infinite where it does not."""
        config, target = self.config, self.goals.vision.target
        controller = AdaptiveController(panda, estimator, self.goals, config=control)
        reached = torch.full((len(self.start),), math.inf, dtype=torch.float64)

        def watch(step: int, q: Tensor, *_: object) -> None:
            error = self.camera.project(panda.forward(q))[0] - target
            near = torch.linalg.vector_norm(error, dim=-1) < config.reached
            # The first step of the last spell inside.
            reached.copy_(torch.where(near, reached.clamp(max=step * config.dt), math.inf))

        noise = torch.Generator().manual_seed(config.seed + 1)
        camera = VirtualCamera(
            camera=self.camera, imperfections=config.imperfections, generator=noise
        )
        with torch.inference_mode():
            rehearse(
                controller,
                camera,
                self.start,
                steps=round(config.duration / config.dt),
                dt=config.dt,
                watch=watch,
            )
        return reached


def _postures(hand: Pose, near: Float[Tensor, "joints"]) -> Float[Tensor, "starts joints"]:
    """Joint positions with the hand at each of the poses [rad]."""
    return torch.stack(
        [nearest_configuration(hand[i], near, samples=9) for i in range(len(hand.position))]
    )
