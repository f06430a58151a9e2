"""Evaluation of a learned image Jacobian in simulation.

Its error against the true one, and closed loops that start from it or from guesses.
"""

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from hrc_learn.controller import AdaptiveController, Goals
from hrc_learn.geometry import Pose, quaternion
from hrc_learn.jacobian import (
    FixedEstimator,
    ImageJacobianEstimator,
    KalmanEstimator,
    RBFImageJacobian,
)
from hrc_learn.kinematics import Arm, gripper_down
from hrc_learn.sim.closed_loop import Imperfections, VirtualCamera, simulate_closed_loop
from hrc_learn.skills.visual_skill import guessed_network
from hrc_learn.vision import CameraModel
from hrc_learn.vision.camera_model import IMAGE_SIZE


@dataclass(frozen=True, kw_only=True)
class StartsConfig:
    """Distribution of initial conditions. Lengths [m], angles [rad]."""

    count: int = 200
    """Number of closed loops."""
    largest_roll: float = math.pi
    """Largest rotation of the camera about its axis, either way, so that no guess is right by
    chance; 0: as in the demonstrations."""
    tilt: float = 0.1
    """Largest tilt of the end effector at the start, either way about each axis."""
    reached: float = 5.0
    """Pixel error below which a loop counts as converged once it stays there [px]."""
    duration: float = 4.0
    """[s]"""
    dt: float = 0.008
    """Control step [s]."""
    seed: int = 0
    """Seed of initial conditions, targets, cameras and noise."""
    imperfections: Imperfections = field(
        default_factory=lambda: Imperfections(frame_steps=4, latency_frames=1, noise=0.5)
    )
    """Imperfections of the measurement."""


@dataclass(frozen=True, kw_only=True, eq=False)
class TurnedCamera:
    """Camera of the scene, with lens distortion, rotated by another angle for each loop.

    The image is rotated about the middle of the workspace, which is moved to the middle of the
    image: a camera rotated about its axis, with its sensor shifted.
    """

    model: CameraModel
    offset: Float[Tensor, "3"]
    """Offset of the marker in the frame of the tool centre point [m]."""
    middle: Pose
    """Pose of the tool in the middle of the workspace."""
    roll: Float[Tensor, " starts"]
    """[rad]"""

    def project(self, tool: Pose) -> tuple[Float[Tensor, "starts 2"], Bool[Tensor, " starts"]]:
        """Pixel of the marker [px], and a flag for points inside the image."""
        about = self._pixel(tool) - self._pixel(self.middle)
        half = about.new_tensor(IMAGE_SIZE) / 2
        turned = (turn_rows(self.roll) @ about[..., None])[..., 0]
        return turned + half, (turned.abs() < half).all(dim=-1)

    def _pixel(self, tool: Pose) -> Tensor:
        return torch.from_numpy(self.model.project(tool.apply(self.offset).numpy()))


def turn_rows(roll: Float[Tensor, " starts"]) -> Float[Tensor, "starts 2 2"]:
    """Rotation of pixels about the image centre when the camera turns about its axis."""
    c, s = roll.cos(), roll.sin()
    return torch.stack([torch.stack([c, s], -1), torch.stack([-s, c], -1)], -2)


@dataclass(frozen=True, kw_only=True, eq=False)
class ClosedLoops:
    """Many short visual-servoing loops in one batch, the same for all estimators compared."""

    camera: TurnedCamera
    start: Float[Tensor, "starts joints"]
    """[rad]"""
    goals: Goals
    config: StartsConfig
    robot: Arm

    @classmethod
    def draw(
        cls,
        camera: CameraModel,
        offset: Float[np.ndarray, "3"],
        workspace: Float[Tensor, "2 3"],
        near: Float[Tensor, "joints"],
        config: StartsConfig,
        robot: Arm,
    ) -> "ClosedLoops":
        """Draw closed loops at random.

        Args:
            camera: True camera.
            offset: Offset of the marker in the frame of the tool centre point [m].
            workspace: Lower and upper corner of the box of starts and targets [m].
            near: Joint positions with the end effector in that box, near which starts are
                chosen [rad].
            config: Distribution of the initial conditions.
            robot: The arm.
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
            start=robot.inverse(Pose(middle + half * uniform(3), tilted), near=near, samples=9),
            goals=Goals.at(middle, down[0], target),
            config=config,
            robot=robot,
        )

    def times(self, estimator: ImageJacobianEstimator) -> Float[Tensor, " starts"]:
        """Time until the marker stays at its target [s]; infinite where it does not."""
        config, target = self.config, self.goals.vision.target
        controller = AdaptiveController(self.robot.chain, estimator, self.goals)
        reached = torch.full((len(self.start),), math.inf, dtype=torch.float64)

        def watch(step: int, q: Tensor, *_: object) -> None:
            error = self.camera.project(self.robot.chain.forward(q))[0] - target
            near = torch.linalg.vector_norm(error, dim=-1) < config.reached
            # The first step of the last interval inside.
            reached.copy_(torch.where(near, reached.clamp(max=step * config.dt), math.inf))

        noise = torch.Generator().manual_seed(config.seed + 1)
        camera = VirtualCamera(
            camera=self.camera, imperfections=config.imperfections, generator=noise
        )
        with torch.inference_mode():
            simulate_closed_loop(
                controller,
                camera,
                self.start,
                steps=round(config.duration / config.dt),
                dt=config.dt,
                on_step=watch,
            )
        return reached


class _Turned(KalmanEstimator):
    """Starts from the learned Jacobian, rotated as the turned camera would have taught it."""

    def __init__(self, network: RBFImageJacobian, roll: Float[Tensor, " starts"]):
        super().__init__(network)
        self._turn = turn_rows(roll)

    def initial_weight(self, *batch: int) -> Float[Tensor, "*batch 12 K"]:
        rows = super().initial_weight(*batch).unflatten(-2, (2, 6))
        return torch.einsum("nij,njck->nick", self._turn, rows).flatten(1, 2)


def compare_starts(
    network: RBFImageJacobian,
    loops: ClosedLoops,
    on_run: Callable[[str], None] = lambda name: None,
) -> dict[str, float]:
    """Convergence times [s] from the learned Jacobian and from a guess.

    Args:
        network: Image Jacobian learned from demonstrations with the camera.
        loops: Closed loops to run.
        on_run: Called with the name of each run at its start.

    Returns:
        For `learned`, `guessed` (the paper's initial Jacobian, adapted alike) and `fixed`
        (the same, not adapted): median and 95th percentile of the time, and the fraction
        that converged. `speed_up_over_guessed` and `speed_up_over_fixed` are medians of the
        other time over that of the learned one, loop by loop; infinite where most of the
        others never converge.
    """
    guessed = guessed_network()
    estimators: dict[str, ImageJacobianEstimator] = {
        "learned": _Turned(network.double(), loops.camera.roll),
        "guessed": KalmanEstimator(guessed),
        "fixed": FixedEstimator(guessed),
    }
    times, figures = {}, {}
    for name, estimator in estimators.items():
        on_run(name)
        times[name] = loops.times(estimator)
        figures |= {f"{name}_{k}": v for k, v in summary(times[name]).items()}
    for name in ("guessed", "fixed"):
        # Where neither converges, neither is faster.
        ratio = (times[name] / times["learned"]).nan_to_num(nan=1.0, posinf=math.inf)
        figures[f"speed_up_over_{name}"] = float(ratio.quantile(0.5, interpolation="lower"))
    return figures


def summary(times: Float[Tensor, " starts"]) -> dict[str, float]:
    """Quantiles of the times, infinite ones included, and the fraction that converged."""
    return {
        "t50": float(times.quantile(0.5, interpolation="higher")),
        "t95": float(times.quantile(0.95, interpolation="higher")),
        "converged": float(times.isfinite().double().mean()),
    }


ROTATION_SCALE = 0.15
"""Weight of a radian in the norm of a Jacobian [m/rad]: a typical lever arm."""
REACH = 0.02
"""Points this close to a demonstrated one are inside the demonstrated workspace [m]."""


def held_out_grid(
    demonstrated: Float[Tensor, "frames 3"], points: int = 9, tilt: float = 0.0, seed: int = 0
) -> Pose:
    """Poses inside the demonstrated workspace, on a grid that no demonstration follows.

    Args:
        demonstrated: Positions of the end effector [m].
        points: Number of points along each axis, over the demonstrated range.
        tilt: Largest tilt of the end effector from pointing down, about each axis [rad].
        seed: Seed of the tilts.
    """
    low, high = demonstrated.amin(dim=0), demonstrated.amax(dim=0)
    axes = [
        torch.linspace(float(a), float(b), points, dtype=torch.float64)
        for a, b in zip(low, high, strict=True)
    ]
    grid = torch.tensor(list(itertools.product(*axes)), dtype=torch.float64)
    inside = torch.cdist(grid, demonstrated).amin(dim=1) < REACH
    grid = grid[inside]
    rng = torch.Generator().manual_seed(seed)
    turn = tilt * (2 * torch.rand(len(grid), 3, generator=rng, dtype=torch.float64) - 1)
    down = gripper_down().expand(len(grid), 4)
    return Pose(grid, quaternion.multiply(quaternion.exp(turn), down))


def compare_with_truth(
    network: RBFImageJacobian,
    poses: Pose,
    camera: CameraModel,
    offset: Float[np.ndarray, "3"],
) -> dict[str, float]:
    """Relative errors of the estimate, and calibration of its uncertainty.

    Args:
        network: Learned image Jacobian with its covariance.
        poses: Poses of the tool, (n,).
        camera: True camera.
        offset: Offset of the marker in the frame of the tool centre point [m].

    Returns:
        `relative_error_median` and `_p95`: |estimate - truth| / |truth|, Frobenius norms with
        rotation counted in metres. `within_1_sigma` and `within_2_sigma`: fractions of
        the entries that close to the truth; 0.68 and 0.95 of a Gaussian.
    """
    scale = torch.tensor([1.0] * 3 + [1 / ROTATION_SCALE] * 3, dtype=torch.float64)
    marker = poses.apply(torch.from_numpy(offset)).numpy()
    truth = torch.from_numpy(camera.image_jacobian(marker, poses.position.numpy()))
    with torch.no_grad():
        error = network(poses) - truth
        sigmas = error.abs() / network.uncertainty(poses)[..., None, :]
    relative = (error * scale).flatten(-2).norm(dim=-1) / (truth * scale).flatten(-2).norm(
        dim=-1
    )
    return {
        "relative_error_median": float(relative.median()),
        "relative_error_p95": float(relative.quantile(0.95)),
        "within_1_sigma": float((sigmas < 1).double().mean()),
        "within_2_sigma": float((sigmas < 2).double().mean()),
    }
