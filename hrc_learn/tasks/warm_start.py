"""What a learned image Jacobian is worth: closed loops that start from it, and from a guess.

The arm's kinematics against the scene's camera, lens and all, which the controller cannot
see. So that a guess is not right by luck, the camera is turned about its axis by another
angle in each of the starts; a learned Jacobian turns along exactly, as would one that was
learned from the turned camera.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..controller import AdaptiveController, ControllerConfig, Goals
from ..controller.goals import IMAGE_SIZE
from ..controller.rehearsal import Imperfections, VirtualCamera, rehearse
from ..controller.table1 import INITIAL_IMAGE_JACOBIAN
from ..geometry import Pose, quaternion
from ..human import gripper_down
from ..jacobian import (
    FixedEstimator,
    ImageJacobianEstimator,
    KalmanEstimator,
    RBFImageJacobian,
    paper_grid,
)
from ..kinematics import panda
from ..vision import CameraModel
from .workplace import nearest_configuration


@dataclass(frozen=True, kw_only=True)
class WarmStartConfig:
    """How starts are drawn. Lengths [m], angles [rad]."""

    starts: int = 200
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
    control: ControllerConfig = field(default_factory=ControllerConfig)
    """The same for all."""
    seed: int = 0
    imperfections: Imperfections = field(
        default_factory=lambda: Imperfections(frame_steps=4, latency_frames=1, noise=0.5)
    )


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


class _Turned(KalmanEstimator):
    """Starts from a learned Jacobian, as seen by cameras that are turned."""

    def __init__(self, network: RBFImageJacobian, roll: Float[Tensor, " starts"]):
        super().__init__(network)
        self._turn = turn_rows(roll)

    def initial_weight(self, *batch: int) -> Float[Tensor, "*batch 12 K"]:
        rows = super().initial_weight(*batch).unflatten(-2, (2, 6))
        return torch.einsum("nij,njck->nick", self._turn, rows).flatten(1, 2)


def compare_starts(
    network: RBFImageJacobian,
    camera: CameraModel,
    offset: Float[np.ndarray, "3"],
    workspace: Float[Tensor, "2 3"],
    near: Float[Tensor, "joints"],
    config: WarmStartConfig | None = None,
    on_run: Callable[[str], None] = lambda name: None,
) -> dict[str, float]:
    """Time to bring the marker to its target [s], from what was learned and from a guess.

    Args:
        network: Learned from demonstrations of the camera.
        camera: The true one.
        offset: Of the marker in the frame of the tool centre point [m].
        workspace: Lower and upper corner of the box of starts and targets, which was
            demonstrated [m].
        near: Joints with the hand in the workspace, near which starts are chosen [rad].
        config: How.
        on_run: Told the name of each run as it begins.

    Returns:
        For `learned`, `guessed` (the paper's initial Jacobian, adapted alike) and `fixed`
        (the same, not adapted): median and 95th percentile of the time, and the share that
        got there. `speed_up_over_guessed` and `speed_up_over_fixed` are medians of the other
        time over that of the learned one, start by start; infinite where most of the others
        never get there.
    """
    config, rng = config or WarmStartConfig(), torch.Generator()
    rng.manual_seed(config.seed)
    n = config.starts

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
    start = _postures(Pose(middle + half * uniform(3), tilted), near)
    goals = Goals.at(middle, down[0], target)
    guess = torch.tensor(INITIAL_IMAGE_JACOBIAN, dtype=torch.float64)
    guessed = RBFImageJacobian.from_jacobian(guess, paper_grid(), 0.1)
    estimators: dict[str, ImageJacobianEstimator] = {
        "learned": _Turned(network.double(), turned.roll),
        "guessed": KalmanEstimator(guessed),
        "fixed": FixedEstimator(guessed),
    }
    times, figures = {}, {}
    for name, estimator in estimators.items():
        on_run(name)
        controller = AdaptiveController(panda, estimator, goals, config=config.control)
        times[name] = _converge(controller, turned, start, target, config)
        figures |= {f"{name}_{k}": v for k, v in _summary(times[name]).items()}
    for name in ("guessed", "fixed"):
        ratio = (times[name] / times["learned"]).nan_to_num(
            nan=1.0, posinf=math.inf
        )  # neither: inf / inf
        figures[f"speed_up_over_{name}"] = float(ratio.quantile(0.5, interpolation="lower"))
    return figures


def _postures(hand: Pose, near: Float[Tensor, "joints"]) -> Float[Tensor, "starts joints"]:
    """Joint positions with the hand at each of the poses [rad]."""
    return torch.stack(
        [nearest_configuration(hand[i], near, samples=9) for i in range(len(hand.position))]
    )


def _converge(
    controller: AdaptiveController,
    camera: TurnedCamera,
    start: Float[Tensor, "starts joints"],
    target: Float[Tensor, "starts 2"],
    config: WarmStartConfig,
) -> Float[Tensor, " starts"]:
    """Time until the marker stays at its target [s]; infinite where it does not."""
    reached = torch.full((len(start),), math.inf, dtype=torch.float64)

    def watch(step: int, q: Tensor, *_: object) -> None:
        error = camera.project(panda.forward(q))[0] - target
        near = torch.linalg.vector_norm(error, dim=-1) < config.reached
        # The first step of the last spell inside.
        reached.copy_(torch.where(near, reached.clamp(max=step * config.dt), math.inf))

    noise = torch.Generator().manual_seed(config.seed + 1)
    with torch.inference_mode():
        rehearse(
            controller,
            VirtualCamera(camera=camera, imperfections=config.imperfections, generator=noise),
            start,
            steps=round(config.duration / config.dt),
            dt=config.dt,
            watch=watch,
        )
    return reached


def _summary(times: Float[Tensor, " starts"]) -> dict[str, float]:
    """Quantiles where infinity, for never, is a time like any other."""
    return {
        "t50": float(times.quantile(0.5, interpolation="higher")),
        "t95": float(times.quantile(0.95, interpolation="higher")),
        "converged": float(times.isfinite().double().mean()),
    }
