"""Closed loops that start from a learned image Jacobian or from guesses, many in one batch.

python benchmarks/jacobian_starts.py --model outputs/aiming --dataset outputs/aiming_demos
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from closed_loop import (
    Imperfections,
    VirtualCamera,
    guessed_network,
    simulate_closed_loop,
)
from jaxtyping import Bool, Float
from torch import Tensor

from hrc_learn import cli
from hrc_learn.controller import AdaptiveController, Goals
from hrc_learn.demos import load_demos
from hrc_learn.geometry import Pose, quaternion
from hrc_learn.jacobian import (
    FixedEstimator,
    ImageJacobianEstimator,
    KalmanEstimator,
    RBFImageJacobian,
)
from hrc_learn.kinematics import Arm, gripper_down
from hrc_learn.sim import World
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills.visual_skill import VisualServoSkill
from hrc_learn.vision import CameraModel
from hrc_learn.vision.camera_model import IMAGE_SIZE


@dataclass(frozen=True, kw_only=True)
class Args:
    model: Path
    """Folder of the visual-servoing skill."""
    dataset: Path
    """Dataset of the demonstrations that the skill was fitted to."""
    json: Path | None = None
    """File for the measured values."""


def main(args: Args) -> None:
    """Run the closed loops and print their times."""
    torch.set_num_threads(1)
    network = VisualServoSkill.load(args.model).jacobian
    shown = torch.cat(
        [torch.from_numpy(demo.position) for demo in load_demos(args.dataset)]
    ).double()
    workplace = Workplace()
    world = World(workplace.scene)
    world.reset(workplace.home_joints().numpy(), {})
    loops = ClosedLoops.draw(
        workplace.scene.camera,
        world.hand_marker_offset(),
        torch.stack([shown.quantile(0.05, dim=0), shown.quantile(0.95, dim=0)]),
        workplace.hover_joints(),
        StartsConfig(),
        workplace.robot,
    )
    figures = compare_starts(network, loops, on_run=print)
    for name, value in figures.items():
        print(f"{name}: {value:.3g}")
    if args.json is not None:
        cli.write_json(args.json, figures)


@dataclass(frozen=True, kw_only=True)
class StartsConfig:
    """Distribution of initial conditions. Lengths [m], angles [rad]."""

    count: int = 200
    """Number of closed loops."""
    largest_roll: float = math.pi
    """Largest rotation of the camera about its axis, either way. With a large rotation, no
    guess is correct by chance; 0: as in the demonstrations."""
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
        """Time until the marker stays at its target [s]; infinite if it does not."""
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
    """Starts from the learned Jacobian, rotated as if it had been learned with the rotated
    camera.
    """

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


if __name__ == "__main__":
    cli.run(main, Args)
