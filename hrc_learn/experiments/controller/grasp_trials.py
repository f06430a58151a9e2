"""Grasp trials: many random starts, cameras and targets as one batch of closed loops."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from hrc_learn.controller import (
    GRIPPER_DOWN,
    INITIAL_IMAGE_JACOBIAN,
    AdaptiveController,
    Command,
    ControllerConfig,
    ControllerState,
    Goals,
    Observation,
    paper_goals,
    paper_joint_region,
)
from hrc_learn.controller.interface import HALF_SIZE
from hrc_learn.controller.monitors import LimitMonitor
from hrc_learn.geometry import Pose, quaternion
from hrc_learn.jacobian import ImageJacobianEstimator, RBFImageJacobian, paper_grid
from hrc_learn.kinematics import (
    JointLimits,
    clear_posture,
    comfortable_postures,
    panda,
    panda_capsules,
)
from hrc_learn.regions import JointRegion
from hrc_learn.sim.closed_loop import (
    Imperfections,
    PinholeCamera,
    VirtualCamera,
    simulate_closed_loop,
)

TABLE = ((0.26, 0.54, -0.02), (0.42, 0.34, 0.02))
"""Centre and half edges of the table [m], as simulated."""
PEDESTAL = ((-0.03, 0.0, -0.36), (0.12, 0.12, 0.36))
"""The same of what the arm stands on [m]."""


def clearance(q: Float[Tensor, "*batch 7"]) -> Float[Tensor, "*batch"]:
    """Distance of the Panda from itself, the table and the pedestal [m]; negative in contact.

    Args:
        q: Joint position [rad].
    """
    distance = panda_capsules.self_distance(q)
    for box in (TABLE, PEDESTAL):
        centre, half_size = q.new_tensor(box)
        distance = torch.minimum(distance, panda_capsules.box_distance(q, centre, half_size))
    return distance


ROLL_CLASSES = ((0, 30), (30, 60), (60, 90), (90, 135), (135, 180))
"""Camera roll from the paper's camera [deg], one class for each fifth of the trials."""

CENTRE = (0.2, 0.5, 0.3)
"""Of the Cartesian region: the middle of the paper's RBF centers in x and y [m]."""

MARKER = (0.05, 0.0, -0.08)
"""In the frame of the tool centre point [m]."""
_HALF_SIDE = 0.024
CORNERS = tuple(
    (x * _HALF_SIDE, y * _HALF_SIDE, 0.0) for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))
)
"""Of the marker, from its centre in the tool's frame [m]."""

# At the joints' speeds the arm moves less than 5 cm in between [s].
_SECONDS_BETWEEN_CONTACT_CHECKS = 0.024
# Starts are drawn again below this distance from contact [m].
_START_CLEARANCE = 0.01


@dataclass(frozen=True, kw_only=True)
class TrialConfig:
    """How trials are drawn. Lengths [m], angles [rad]."""

    count: int = 1000
    seed: int = 0
    starts: Literal["near", "global"] = "near"
    """Ready posture with 0.4 rad of noise on each joint, or anywhere within the limits."""
    tilt: tuple[float, float] = (0.0, 0.35)
    """Of the camera's axis from the vertical."""
    imperfections: Imperfections = field(
        default_factory=lambda: Imperfections(frame_steps=4, latency_frames=1, noise=0.5)
    )
    duration: float = 12.0
    """[s]"""
    dt: float = 0.008
    """Control step [s]."""
    feature: Literal["centre", "corners"] = "centre"
    """Of the marker: the paper's single point, or the four corners."""
    law: Literal["recommended", "printed"] = "recommended"
    """The paper's law as printed has Table I's gains and no joint-space approach."""
    half_size: tuple[float, float, float] = HALF_SIZE
    """Half edges of the box [m], which the paper leaves to the expert."""
    stiffness: tuple[float, float, float] = (4e-4, 4e-4, 4e-5)
    """k_c of the law as printed."""
    initial_jacobian: Callable[[Tensor], Tensor] = lambda J: J
    """Change of the paper's initial image Jacobian."""
    contacts: bool = False
    """Look for contacts of the arm with itself, the table and the pedestal, at a third more
    time. Starts are free of them in any case."""


@dataclass(frozen=True, kw_only=True)
class TrialResult:
    """Results, one entry for each trial."""

    roll_class: Int[Tensor, "trials"]
    on_target: Bool[Tensor, "trials"]
    """Final pixel error below 5 px, wherever the tool is: what a person sees who looks at the
    image alone."""
    success: Bool[Tensor, "trials"]
    """Final pixel error below 5 px with the tool in the region, no limit broken. Of corners the
    mean counts: the law turns the tool into its orientation cone, not further."""
    time: Float[Tensor, "trials"]
    """Until the pixel error stayed below 5 px [s]; infinite if it did not."""
    vision_time: Float[Tensor, "trials"]
    """Of that, since the camera took over [s]."""
    violations: Int[Tensor, "trials"]
    """Steps that broke a limit of position, velocity, acceleration or jerk."""
    touched: Bool[Tensor, "trials"]
    """Contact of the arm with itself, the table or the pedestal; False if not checked."""
    peak_speed: Float[Tensor, "trials"]
    """Largest joint velocity over its limit."""
    hand_overs: Int[Tensor, "trials"]
    """How often the camera took over or let go."""
    jacobian_error: Float[Tensor, "trials"]
    """Of the linear part of the image Jacobian's estimate at the end, relative."""

    def summary(self) -> dict[str, float]:
        """Rates, medians and totals, by name."""
        figures = {
            "on_target": _rate(self.on_target),
            "success": _rate(self.success),
            "free_success": _rate(self.success & ~self.touched),
            "touched": _rate(self.touched),
            "t50": self.time.quantile(0.5, interpolation="higher").item(),
            "t95": self.time.quantile(0.95, interpolation="higher").item(),
            "vision_phase": _median(self.vision_time),
            "violations": float(self.violations.sum()),
            "peak_speed": self.peak_speed.max().item(),
            "jacobian_error": self.jacobian_error.quantile(0.95, interpolation="higher").item(),
            "hand_overs": self.hand_overs.double().mean().item(),
        }
        for k, (low, high) in enumerate(ROLL_CLASSES):
            members = self.roll_class == k
            figures[f"on_target_roll_{low}_{high}"] = _rate(self.on_target[members])
            figures[f"success_roll_{low}_{high}"] = _rate(self.success[members])
            figures[f"vision_phase_roll_{low}_{high}"] = _median(self.vision_time[members])
        return figures


def _rate(flags: Tensor) -> float:
    return flags.double().mean().item()


def _median(times: Tensor) -> float:
    """Median where infinity, for never, is a value like any other."""
    times = torch.where(times.isnan(), math.inf, times)  # never taken over: inf - inf
    return times.quantile(0.5, interpolation="higher").item()


@dataclass(frozen=True, kw_only=True)
class TrialScene:
    """Random initial conditions of all trials."""

    camera: PinholeCamera
    target: Tensor
    start: Tensor
    roll_class: Tensor


def run_trials(
    make_estimator: Callable[[RBFImageJacobian], ImageJacobianEstimator], config: TrialConfig
) -> TrialResult:
    """Run all trials of a configuration.

    Args:
        make_estimator: From the network that starts at the paper's initial Jacobian.
        config: What to draw and how long to run.
    """
    rng = torch.Generator().manual_seed(config.seed)
    scene = draw_scene(config, rng)
    controller = grasp_controller(make_estimator, config, scene)
    judge = Judge(scene, controller, config)
    with torch.inference_mode():
        simulate_closed_loop(
            controller,
            VirtualCamera(
                camera=scene.camera, imperfections=config.imperfections, generator=rng
            ),
            scene.start,
            steps=round(config.duration / config.dt),
            dt=config.dt,
            on_step=judge,
        )
    return judge.result()


def draw_scene(config: TrialConfig, rng: torch.Generator) -> TrialScene:
    """Draw cameras, targets and starts."""

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        unit = torch.rand(config.count, *shape, generator=rng, dtype=torch.float64)
        return low + (high - low) * unit

    roll_class = torch.arange(config.count) % len(ROLL_CLASSES)
    low, high = torch.deg2rad(torch.tensor(ROLL_CLASSES, dtype=torch.float64))[roll_class].mT
    side = torch.where(uniform(0.0, 1.0) < 0.5, -1.0, 1.0)
    centre = torch.tensor(CENTRE, dtype=torch.float64)
    camera = PinholeCamera.above(
        centre + uniform(-0.05, 0.05, 3),
        height=uniform(0.9, 1.2),
        roll=side * (low + (high - low) * uniform(0.0, 1.0)),
        tilt=uniform(*config.tilt),
        bearing=uniform(0.0, 2 * math.pi),
        marker=centre.new_tensor(MARKER),
        corners=centre.new_tensor(CORNERS) if config.feature == "corners" else None,
    )
    spread = centre.new_tensor((0.08, 0.08, 0.05))
    down = quaternion.normalize(centre.new_tensor(GRIPPER_DOWN))
    tool = Pose(centre + spread * uniform(-1.0, 1.0, 3), down.expand(config.count, 4))
    return TrialScene(
        camera=camera,
        target=camera.project(tool)[0],
        start=_starts(config, panda.limits, rng),
        roll_class=roll_class,
    )


def _starts(config: TrialConfig, limits: JointLimits, rng: torch.Generator) -> Tensor:
    lower, upper = limits.lower + 0.03, limits.upper - 0.03
    shape = (config.count, len(lower))
    free: list[Tensor] = []
    while sum(map(len, free)) < config.count:
        if config.starts == "near":
            noise = torch.randn(shape, generator=rng, dtype=torch.float64)
            q = (panda.ready + 0.4 * noise).clamp(lower, upper)
        else:
            unit = torch.rand(shape, generator=rng, dtype=torch.float64)
            q = lower + unit * (upper - lower)
        free.append(q[clearance(q) > _START_CLEARANCE])
    return torch.cat(free)[: config.count]


def grasp_controller(
    make_estimator: Callable[[RBFImageJacobian], ImageJacobianEstimator],
    config: TrialConfig,
    scene: TrialScene,
) -> AdaptiveController:
    """The controller of all trials, with the law and the goals of the configuration."""
    J = config.initial_jacobian(torch.tensor(INITIAL_IMAGE_JACOBIAN, dtype=torch.float64))
    J = J.repeat(scene.target.shape[-1] // 2, 1)
    network = RBFImageJacobian.from_jacobian(J, paper_grid(), 0.1)
    centre = torch.tensor(CENTRE, dtype=torch.float64)
    if config.law == "printed":
        box = centre.new_tensor(config.half_size)
        goals = paper_goals(centre, box, scene.target, config.stiffness)
        settings, region = ControllerConfig.paper(), paper_joint_region(panda.limits)
    else:
        down = quaternion.normalize(centre.new_tensor(GRIPPER_DOWN))
        postures = comfortable_postures(panda, Pose(centre, down))
        posture = clear_posture(postures, scene.start, clearance)
        goals = Goals.at(centre, down, scene.target, half_size=config.half_size)
        goals = goals.approached_by(posture)
        settings = ControllerConfig()
        region = JointRegion.from_limits(panda.limits.lower, panda.limits.upper)
    return AdaptiveController(
        panda, make_estimator(network), goals, config=settings, joint_region=region
    )


class Judge:
    """Watches the closed loops and keeps what the result needs."""

    def __init__(self, scene: TrialScene, controller: AdaptiveController, config: TrialConfig):
        self.scene, self.controller, self.dt = scene, controller, config.dt
        self.contact_steps = 0
        if config.contacts:
            self.contact_steps = max(1, round(_SECONDS_BETWEEN_CONTACT_CHECKS / config.dt))
        count = len(scene.start)
        self.taken_over = torch.full((count,), math.inf, dtype=torch.float64)
        self.entered = torch.full((count,), math.inf, dtype=torch.float64)
        self.violations = torch.zeros(count, dtype=torch.int64)
        self.hand_overs = torch.zeros(count, dtype=torch.int64)
        self.peak_speed = torch.zeros(count, dtype=torch.float64)
        still = torch.zeros_like(scene.start)
        self.watch = LimitMonitor(panda.limits, still, config.dt)
        self.touched = torch.zeros(count, dtype=torch.bool)
        self.active = torch.zeros(count, dtype=torch.bool)
        self.in_box = torch.zeros(count, dtype=torch.bool)
        self.last: tuple[Tensor, ControllerState] | None = None

    def __call__(
        self,
        step: int,
        q: Tensor,
        observation: Observation,
        command: Command,
        state: ControllerState,
    ) -> None:
        now = torch.tensor(step * self.dt, dtype=torch.float64)
        self.last = q, state
        tool = panda.forward(q)
        error = self.scene.camera.project(tool)[0] - self.scene.target
        centre = error.unflatten(-1, (-1, 2)).mean(-2)
        close = torch.linalg.vector_norm(centre, dim=-1) < 5
        self.entered = torch.where(close, torch.minimum(self.entered, now), math.inf)
        active = state.blending.active
        self.taken_over = torch.where(
            active, torch.minimum(self.taken_over, now), self.taken_over
        )
        self.hand_overs += active != self.active
        self.active = active
        box = self.controller.goals.position
        # 5 % beyond the wall count as in the box: a potential ends at the wall, not inside.
        self.in_box = ((tool.position - box.centre).abs() <= 1.05 * box.half_size).all(-1)
        v = command.joint_velocity
        self.violations += self.watch.violations(q, v).any(-1) | ~v.isfinite().all(-1)
        speed = (v.abs() / panda.limits.velocity).amax(-1)
        self.peak_speed = torch.maximum(self.peak_speed, speed)
        if self.contact_steps and step % self.contact_steps == 0:
            self.touched |= clearance(q) < 0

    def result(self) -> TrialResult:
        return TrialResult(
            roll_class=self.scene.roll_class,
            on_target=self.entered.isfinite(),
            success=self.entered.isfinite() & self.in_box & (self.violations == 0),
            time=self.entered,
            vision_time=self.entered - self.taken_over,
            violations=self.violations,
            touched=self.touched,
            peak_speed=self.peak_speed,
            hand_overs=self.hand_overs,
            jacobian_error=self._jacobian_error(),
        )

    def _jacobian_error(self) -> Float[Tensor, "trials"]:
        assert self.last is not None
        q, state = self.last
        tool, estimator = panda.forward(q), self.controller.estimator
        true = self.scene.camera.image_jacobian(tool)[..., :3]
        wrong = estimator.jacobian(state.estimator, tool)[..., :3] - true
        return wrong.flatten(-2).norm(dim=-1) / true.flatten(-2).norm(dim=-1)
