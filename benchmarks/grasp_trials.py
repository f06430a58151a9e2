"""Grasp trials: many random starts, cameras and targets as one batch of closed loops."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from typing import Literal

import torch
from closed_loop import Imperfections, VirtualCamera, simulate_closed_loop
from jaxtyping import Bool, Float, Int
from limit_monitor import LimitMonitor
from paper_law import paper_goals, paper_joint_region
from pinhole_camera import PinholeCamera
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
)
from hrc_learn.controller.interface import HALF_SIZE
from hrc_learn.geometry import Pose, quaternion
from hrc_learn.jacobian import ImageJacobianEstimator, RBFImageJacobian, paper_grid
from hrc_learn.kinematics import (
    SINGULAR_BELOW,
    Arm,
    ArmChoice,
    CapsuleArm,
    LinkCapsule,
    TaskSpace,
    UnreachableError,
    gripper_down,
)
from hrc_learn.kinematics.inverse import best_postures, solutions_from
from hrc_learn.regions import JointRegion

TABLE = ((0.26, 0.54, -0.02), (0.42, 0.34, 0.02))
"""Centre and half edges of the simulated table [m]."""
PEDESTAL = ((-0.03, 0.0, -0.36), (0.12, 0.12, 0.36))
"""Centre and half edges of the arm's pedestal [m]."""


ROLL_CLASSES = ((0, 30), (30, 60), (60, 90), (90, 135), (135, 180))
"""Camera roll from the paper's camera [deg], one class for each fifth of the trials."""

CENTRE = (0.2, 0.5, 0.3)
"""Centre of the Cartesian region: the middle of the paper's RBF centres in x and y [m]."""

MARKER = (0.05, 0.0, -0.08)
"""Marker in the frame of the tool centre point [m]."""
_HALF_SIDE = 0.024
CORNERS = tuple(
    (x * _HALF_SIDE, y * _HALF_SIDE, 0.0) for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))
)
"""Corners of the marker relative to its centre, in the tool's frame [m]."""

# Number of starts for the inverse kinematics of arms without a closed form.
_STARTS = 200
# Candidate centres for an arm with its tool pointing down: heights, as for a Franka arm [m],
# and fractions of the distance from the base. An arm with a long tool, or with a wrist that
# bends little, has a shorter reach.
_HEIGHTS, _NEARER = (CENTRE[2], 0.2, 0.1), (1.0, 0.85, 0.7)
_SPREAD = (0.08, 0.08, 0.05)
"""Largest distance of targets from the centre along each axis, either way [m]."""


class TrialArm:
    """An arm for servoing, with a region that depends on its reach.

    Attributes:
        arm: The arm.
        scale: Distances, as fractions of those for a Franka arm; at most 1.
        task: Controlled part of the tool's pose: with five joints, position and axis.
        centre: Centre of the Cartesian region [m].
        down: Orientation of the tool there: the paper's orientation for Franka's arms, straight
            down for others.
        postures: Joint positions with that pose, the best first [rad]. For arms without a
            closed inverse, the postures from which the arm reaches all targets, if there are
            any, ordered by their distance from the ready posture.
    """

    def __init__(self, arm: Arm):
        """Place table and region in front of an arm.

        Raises:
            UnreachableError: The arm does not reach the region with its tool pointing down.
        """
        self.arm, self.chain = arm, arm.chain
        self.task: TaskSpace = "pose" if len(arm.joint_names) >= 6 else "position+axis"
        self.scale, self.down = (
            1.0,
            quaternion.normalize(torch.tensor(GRIPPER_DOWN, dtype=torch.float64)),
        )
        if arm.is_franka:
            self.centre = self.scaled(CENTRE)
            self.postures = arm.postures(Pose(self.centre, self.down))
            return
        self.scale, self.down = min(1.0, reach_of(arm) / _PANDA_REACH), gripper_down()
        possible = []
        for nearer, height in itertools.product(_NEARER, _HEIGHTS):
            place = self._place((nearer * CENTRE[0], nearer * CENTRE[1], height))
            possible += [] if place is None else [place]
            if place is not None and place[-1]:
                break
        if not possible:
            raise UnreachableError(
                f"the {arm.name} does not get its tool to {self.centre.tolist()} m, pointing "
                "down"
            )
        # The first centre from which the arm reaches all targets, otherwise the first reachable
        # centre.
        self.centre, self.down, self.postures, _ = max(possible, key=lambda place: place[-1])

    def _place(
        self, centre: tuple[float, float, float]
    ) -> tuple[Tensor, Tensor, Float[Tensor, "postures joints"], bool] | None:
        """Centre, orientation and postures there; and True if the arm reaches all targets."""
        self.centre = self.scaled(centre)
        found = self._solutions(self.task)
        if len(found) and self.task != "pose":
            # The joints determine the rotation of the tool about its axis.
            self.down = self.chain.forward(best_postures(self.chain, found)[0]).orientation
            found = self._solutions("pose")
        if len(found) == 0:
            return None
        postures = best_postures(self.chain, found)
        if self.task != "pose":
            return self.centre, self.down, postures, True
        reaching = postures[self._reaches_targets(postures)]
        if len(reaching) == 0:
            return self.centre, self.down, postures, False
        # The nearest posture to the ready posture comes first: servoing then has the shortest
        # way.
        far = (reaching - self.chain.ready).norm(dim=-1)
        return self.centre, self.down, reaching[far.argsort()], True

    def _reaches_targets(
        self, postures: Float[Tensor, "postures joints"]
    ) -> Bool[Tensor, " postures"]:
        """Flags of postures from which the arm reaches targets in all corners nonsingularly.

        An arm stretched out towards a target is singular there and comes no closer.
        """
        signs = torch.cartesian_prod(*[torch.tensor([-1.0, 1.0], dtype=torch.float64)] * 3)
        corners = Pose(
            self.centre + self.scaled(_SPREAD) * signs, self.down.expand(len(signs), 4)
        )
        q = solutions_from(self.chain, corners, postures.expand(len(signs), *postures.shape))
        least = torch.linalg.svdvals(self.chain.jacobian(q.nan_to_num()))[..., -1]
        return (q.isfinite().all(-1) & (least > SINGULAR_BELOW)).all(0)

    def _solutions(self, task: TaskSpace) -> Float[Tensor, "solutions joints"]:
        limits, rng = self.chain.limits, torch.Generator().manual_seed(0)
        half = ((limits.upper - limits.lower) / 2).clamp(max=math.pi)
        share = torch.rand(_STARTS, len(half), generator=rng, dtype=torch.float64)
        start = limits.middle + (2 * share - 1) * half
        found = solutions_from(self.chain, Pose(self.centre, self.down), start, task=task)
        return found[found.isfinite().all(-1)]

    def scaled(self, lengths: tuple[float, ...]) -> Float[Tensor, " n"]:
        """Lengths scaled for this arm [m]."""
        return self.scale * torch.tensor(lengths, dtype=torch.float64)

    def clearance(self, q: Float[Tensor, "*batch joints"]) -> Float[Tensor, "*batch"]:
        """Distance of the arm from itself, the table and the pedestal [m]; negative in contact.

        Args:
            q: Joint position [rad].
        """
        distance = self.arm.body.self_distance(q)
        if not self._above.capsules:  # no capsules: a description without shapes
            return distance
        below = self.centre - self.scaled(CENTRE)
        for body, (centre, half_size), lower in (
            (self._above, TABLE, below),
            (self._above_pedestal, PEDESTAL, 0 * below),
        ):
            box = self.scaled(centre) + lower, self.scaled(half_size)
            distance = torch.minimum(distance, body.box_distance(q, *box))
        return distance

    @cached_property
    def _above(self) -> CapsuleArm:
        """Arm without link 1, whose distance from the pedestal never changes."""
        body = self.arm.body
        return CapsuleArm(self.chain, [c for c in body.capsules if c.link > 1])

    @cached_property
    def _above_pedestal(self) -> CapsuleArm:
        """Arm without link 1 and links whose capsules overlap the pedestal in most postures.

        The capsule of a thick upper arm that rotates about a low shoulder gives no useful
        distance.
        """
        limits, rng = self.chain.limits, torch.Generator().manual_seed(0)
        share = torch.rand(_STARTS, len(limits.lower), generator=rng, dtype=torch.float64)
        q = limits.lower + (limits.upper - limits.lower) * share
        box = self.scaled(PEDESTAL[0]), self.scaled(PEDESTAL[1])

        def tells(capsule: LinkCapsule) -> bool:
            distance = CapsuleArm(self.chain, [capsule]).box_distance(q, *box)
            return float((distance > _START_CLEARANCE).double().mean()) > 0.5

        return CapsuleArm(self.chain, [c for c in self._above.capsules if tells(c)])


_PANDA_REACH = 0.95  # [m], as computed by `reach_of`


def reach_of(arm: Arm) -> float:
    """Largest distance of the tool centre point from joint 2 [m], over random postures."""
    limits, rng = arm.limits, torch.Generator().manual_seed(0)
    share = torch.rand(5000, arm.joints, generator=rng, dtype=torch.float64)
    q = limits.lower + (limits.upper - limits.lower) * share
    return float((arm.forward(q).position - arm.joint_origins(q)[:, 1]).norm(dim=-1).max())


def clear_posture(
    postures: Float[Tensor, "postures n"],
    start: Float[Tensor, "*batch n"],
    clearance: Callable[[Tensor], Tensor],
    *,
    least: float = 0.03,
    samples: int = 25,
) -> Float[Tensor, "*batch n"]:
    """The first posture whose straight path in joint space is free of contacts.

    A joint-space approach follows that path. If no path is free, the posture whose path has the
    largest clearance.

    Args:
        postures: Candidates [rad], the best first.
        start: Present joint positions [rad].
        clearance: Distance from all contacts [m] at joint positions (*points, n).
        least: Distance to keep [m]; near the start, the clearance of the start is sufficient.
        samples: Number of points checked along the path.
    """
    flat = start.reshape(-1, start.shape[-1])
    best = postures[:1].expand_as(flat).clone()
    found = torch.full_like(flat[:, 0], -torch.inf)
    wanted = torch.minimum(clearance(flat), found.new_tensor(least))
    # Without the start itself, where the arm is already.
    fraction = torch.linspace(0, 1, samples, dtype=flat.dtype, device=flat.device)[1:, None]
    for posture in postures:
        missing = (found < wanted).nonzero().flatten()
        if len(missing) == 0:
            break
        path = torch.lerp(flat[missing, None], posture, fraction)
        distance = clearance(path).amin(-1)
        better = distance > found[missing]
        best[missing[better]], found[missing[better]] = posture, distance[better]
    return best.reshape(start.shape)


@cache
def trial_arm(choice: ArmChoice) -> TrialArm:
    """An arm that is prepared for trials."""
    return TrialArm(choice.arm())


# Time in which the arm moves by less than 5 cm at its highest joint speeds [s].
_SECONDS_BETWEEN_CONTACT_CHECKS = 0.024
# Distance from contact below which a start is drawn again [m].
_START_CLEARANCE = 0.01
# Number of draws of all starts without a contact-free start after which the arm is refused.
_MOST_DRAWS = 20


@dataclass(frozen=True, kw_only=True)
class TrialConfig:
    """Distribution of the trials. Lengths [m], angles [rad]."""

    count: int = 1000
    seed: int = 0
    robot: ArmChoice = field(default_factory=ArmChoice)
    starts: Literal["near", "global"] = "near"
    """Ready posture with 0.4 rad of noise on each joint, or anywhere within the limits."""
    tilt: tuple[float, float] = (0.0, 0.35)
    """Range of the angle of the camera's axis with the vertical."""
    imperfections: Imperfections = field(
        default_factory=lambda: Imperfections(frame_steps=4, latency_frames=1, noise=0.5)
    )
    duration: float = 12.0
    """[s]"""
    dt: float = 0.008
    """Control step [s]."""
    feature: Literal["centre", "corners"] = "centre"
    """Feature of the marker: the paper's single point, or the four corners."""
    pull: Literal["paper", "saturated"] = "paper"
    """Potential of the vision region. The paper's pull vanishes outside the ellipse, so an arm
    that comes from a distance may stop at a wall of its box. "saturated", as in the work cell,
    pulls wherever the marker is visible (`VisionRegion`)."""
    law: Literal["recommended", "printed"] = "recommended"
    """The paper's law as printed has Table I's gains and no joint-space approach."""
    half_size: tuple[float, float, float] = HALF_SIZE
    """Half edges of the box [m], which the paper leaves to the expert."""
    stiffness: tuple[float, float, float] = (4e-4, 4e-4, 4e-5)
    """k_c of the law as printed."""
    initial_jacobian: Callable[[Tensor], Tensor] = lambda J: J
    """Modification of the paper's initial image Jacobian."""
    contacts: bool = False
    """Check for contacts of the arm with itself, the table and the pedestal, which takes a
    third more time. Starts are free of contacts in any case."""


@dataclass(frozen=True, kw_only=True)
class TrialResult:
    """Results, one entry for each trial."""

    roll_class: Int[Tensor, "trials"]
    on_target: Bool[Tensor, "trials"]
    """Final pixel error below 5 px, wherever the tool is: success as seen in the image alone.
    """
    success: Bool[Tensor, "trials"]
    """Final pixel error below 5 px, tool in the region, and no limit exceeded. With corners,
    the mean error counts: the law rotates the tool into its orientation cone and not further.
    """
    time: Float[Tensor, "trials"]
    """Time until the pixel error stayed below 5 px [s]; infinite if it did not."""
    vision_time: Float[Tensor, "trials"]
    """Part of that time after the camera took over [s]."""
    violations: Int[Tensor, "trials"]
    """Steps that broke a limit of position, velocity, acceleration or jerk."""
    touched: Bool[Tensor, "trials"]
    """Contact of the arm with itself, the table or the pedestal; False if not checked."""
    touched_itself: Bool[Tensor, "trials"]
    """Contact of the arm with itself; False if not checked."""
    peak_speed: Float[Tensor, "trials"]
    """Largest joint velocity relative to its limit."""
    hand_overs: Int[Tensor, "trials"]
    """Number of times that the camera took over or released control."""
    jacobian_error: Float[Tensor, "trials"]
    """Relative error of the linear part of the estimated image Jacobian at the end."""

    def summary(self) -> dict[str, float]:
        """Rates, medians and totals, by name."""
        figures = {
            "on_target": _rate(self.on_target),
            "success": _rate(self.success),
            "free_success": _rate(self.success & ~self.touched),
            "touched": _rate(self.touched),
            "touched_itself": _rate(self.touched_itself),
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
    """Median in which infinity (never) counts as a value; NaN without trials."""
    if not len(times):
        return math.nan
    # never taken over: infinity minus infinity
    times = torch.where(times.isnan(), math.inf, times)
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
        make_estimator: Makes the estimator from the network with the paper's initial Jacobian.
        config: Distribution and duration of the trials.
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
    servoing = trial_arm(config.robot)
    centre = servoing.centre
    camera = PinholeCamera.above(
        centre + servoing.scale * uniform(-0.05, 0.05, 3),
        height=uniform(0.9, 1.2),
        roll=side * (low + (high - low) * uniform(0.0, 1.0)),
        tilt=uniform(*config.tilt),
        bearing=uniform(0.0, 2 * math.pi),
        marker=centre.new_tensor(MARKER),
        corners=centre.new_tensor(CORNERS) if config.feature == "corners" else None,
    )
    spread = servoing.scaled(_SPREAD)
    at = centre + spread * uniform(-1.0, 1.0, 3)
    tool = Pose(at, servoing.down.expand(config.count, 4))
    return TrialScene(
        camera=camera,
        target=camera.project(tool)[0],
        start=_starts(config, servoing, rng),
        roll_class=roll_class,
    )


def _starts(config: TrialConfig, servoing: TrialArm, rng: torch.Generator) -> Tensor:
    limits = servoing.chain.limits
    lower, upper = limits.lower + 0.03, limits.upper - 0.03
    shape = (config.count, len(lower))
    free: list[Tensor] = []
    while sum(map(len, free)) < config.count:
        if config.starts == "near":
            noise = torch.randn(shape, generator=rng, dtype=torch.float64)
            q = (servoing.chain.ready + 0.4 * noise).clamp(lower, upper)
        else:
            unit = torch.rand(shape, generator=rng, dtype=torch.float64)
            q = lower + unit * (upper - lower)
        free.append(q[servoing.clearance(q) > _START_CLEARANCE])
        if len(free) > _MOST_DRAWS and not any(map(len, free)):
            raise ValueError(
                f"no start of the {servoing.arm.name} near its ready posture is free of "
                "contacts with itself, table and pedestal: give it another ready posture, or "
                "shapes that are less coarse."
            )
    return torch.cat(free)[: config.count]


def grasp_controller(
    make_estimator: Callable[[RBFImageJacobian], ImageJacobianEstimator],
    config: TrialConfig,
    scene: TrialScene,
) -> AdaptiveController:
    """The controller of all trials, with the law and the goals of the configuration."""
    J = config.initial_jacobian(torch.tensor(INITIAL_IMAGE_JACOBIAN, dtype=torch.float64))
    J = J.repeat(scene.target.shape[-1] // 2, 1)
    servoing = trial_arm(config.robot)
    scale, chain, centre = servoing.scale, servoing.chain, servoing.centre
    network = RBFImageJacobian.from_jacobian(J, scale * paper_grid(), scale * 0.1)
    box = servoing.scaled(config.half_size)
    if config.law == "printed":
        goals = paper_goals(centre, box, scene.target, config.stiffness)
        settings, region = ControllerConfig.paper(), paper_joint_region(chain.limits)
    else:
        posture = clear_posture(servoing.postures, scene.start, servoing.clearance)
        goals = Goals.at(
            centre, servoing.down, scene.target, half_size=box.tolist(), task=servoing.task
        )
        goals = goals.approached_by(posture)
        goals = replace(goals, vision=replace(goals.vision, formulation=config.pull))
        settings = ControllerConfig()
        region = JointRegion.from_limits(chain.limits.lower, chain.limits.upper)
    return AdaptiveController(
        chain, make_estimator(network), goals, config=settings, joint_region=region
    )


class Judge:
    """Observes the closed loops and collects the values of the result."""

    def __init__(self, scene: TrialScene, controller: AdaptiveController, config: TrialConfig):
        self.scene, self.controller, self.dt = scene, controller, config.dt
        self.servoing = trial_arm(config.robot)
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
        self.limits = self.servoing.chain.limits
        self.watch = LimitMonitor(self.limits, still, config.dt)
        self.touched = torch.zeros(count, dtype=torch.bool)
        self.touched_itself = torch.zeros(count, dtype=torch.bool)
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
        tool = self.servoing.chain.forward(q)
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
        # Positions up to 5 % beyond the wall count as inside: a potential ends at the wall.
        self.in_box = ((tool.position - box.centre).abs() <= 1.05 * box.half_size).all(-1)
        v = command.joint_velocity
        self.violations += self.watch.violations(q, v).any(-1) | ~v.isfinite().all(-1)
        speed = (v.abs() / self.limits.velocity).amax(-1)
        self.peak_speed = torch.maximum(self.peak_speed, speed)
        if self.contact_steps and step % self.contact_steps == 0:
            self.touched |= self.servoing.clearance(q) < 0
            self.touched_itself |= self.servoing.arm.body.self_distance(q) < 0

    def result(self) -> TrialResult:
        return TrialResult(
            roll_class=self.scene.roll_class,
            on_target=self.entered.isfinite(),
            success=self.entered.isfinite() & self.in_box & (self.violations == 0),
            time=self.entered,
            vision_time=self.entered - self.taken_over,
            violations=self.violations,
            touched=self.touched,
            touched_itself=self.touched_itself,
            peak_speed=self.peak_speed,
            hand_overs=self.hand_overs,
            jacobian_error=self._jacobian_error(),
        )

    def _jacobian_error(self) -> Float[Tensor, "trials"]:
        assert self.last is not None
        q, state = self.last
        tool, estimator = self.servoing.chain.forward(q), self.controller.estimator
        true = self.scene.camera.image_jacobian(tool)[..., :3]
        wrong = estimator.jacobian(state.estimator, tool)[..., :3] - true
        return wrong.flatten(-2).norm(dim=-1) / true.flatten(-2).norm(dim=-1)
