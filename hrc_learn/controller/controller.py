"""The vision-based adaptive controller with multiple regional feedback."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, Literal, NamedTuple, final

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.utils import _pytree

from hrc_learn.controller.feedback import (
    BlendingConfig,
    BlendingState,
    Feedback,
    VisionBlending,
    analytic_descent,
    approach_velocity,
    effective_goals,
    known_step,
    next_task_level,
    regional_feedback,
    validated_position,
)
from hrc_learn.controller.interface import Command, Goals, Observation
from hrc_learn.controller.monitors import potential_rate
from hrc_learn.controller.resolved_rate import (
    PoseDrift,
    excess_speed,
    led_descent,
    measure_drift,
    planned_motion,
    resolved_rate,
    restored_drift,
    saturate_in_null_space,
    scale_null_space,
    scale_task,
)
from hrc_learn.controller.safety_filter import SafetyConfig, SafetyFilter, SafetyState
from hrc_learn.controller.way_making import WayMakingConfig, way_making_velocity
from hrc_learn.geometry import Pose
from hrc_learn.geometry.numerics import is_number
from hrc_learn.jacobian import ImageJacobianEstimator, Measurement
from hrc_learn.kinematics import SerialChain, TaskSpace, task_basis, task_rank
from hrc_learn.kinematics.inverse import TASK_ROWS
from hrc_learn.pytree import pytree
from hrc_learn.regions import JointRegion


@dataclass(frozen=True, kw_only=True)
class ControllerConfig:
    """Settings of the law; the defaults are those that were measured to work best."""

    linear_speed: float = 0.25
    """Cap on the linear part of the twist [m/s]; the direction of the twist is kept."""
    angular_speed: float = 1.0
    """Cap on its angular part [rad/s]."""
    vision_rate: float = 4.0
    """Fastest decay of the pixel error that the estimate may ask for [1/s]. The gain of the
    law grows with the square of the Jacobian over that of the region: uncapped it can exceed
    what images at 15 to 30 Hz, late by a frame or more, allow."""
    approach_linear_speed: float = 0.5
    """Cap on the linear speed of the tool during a joint-space approach [m/s]."""
    approach_angular_speed: float = 2.0
    """Cap on its angular speed then [rad/s]."""
    jacobian: Literal["geometric", "analytic"] = "geometric"
    """By which gradients become motions of the tool: the analytic one counts rotation by the
    rotation vector, whose rates differ from angular velocity the more the tool is turned."""
    command_delay: float = 0.0
    """From a command until the arm follows it, its servos' lag included [s]: the joint velocity
    is computed for where the arm will be by then."""
    null_damping: float = 3.0
    """c_d: null-space input divided by it is velocity."""
    null_space_saturation: bool = True
    """Saturation in the null space: the other joints do what limits take from single ones."""
    task_slows: bool = True
    """Slow the task down as a whole where a limit that cuts single joints would make the tool
    faster than the task asks for."""
    null_space_yields: bool = True
    """Scale null-space motion as a whole where a limit would cut single joints."""
    drift_compensation_rate: float = 2.0
    """Rate at which the tool returns to its place while a person acts [1/s]; 0: it does not."""
    blending: BlendingConfig = field(default_factory=BlendingConfig)
    way_making: WayMakingConfig | None = None
    """Whether the null space makes way by itself where distances are told; None: it does not,
    and follows the person."""
    safety: SafetyConfig = field(default_factory=SafetyConfig)

    def __post_init__(self):
        for name in (
            "linear_speed",
            "angular_speed",
            "vision_rate",
            "approach_linear_speed",
            "approach_angular_speed",
            "null_damping",
        ):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be positive, but is {getattr(self, name)}")
        if self.jacobian not in ("geometric", "analytic"):
            raise ValueError(
                f"jacobian must be 'geometric' or 'analytic', but is {self.jacobian!r}"
            )
        if self.drift_compensation_rate < 0:
            raise ValueError(
                "drift_compensation_rate must not be negative, but is "
                f"{self.drift_compensation_rate}"
            )

    @classmethod
    def paper(cls) -> ControllerConfig:
        """The law as printed: nothing between it and the safety filter."""
        return cls(
            linear_speed=math.inf,
            angular_speed=math.inf,
            vision_rate=math.inf,
            null_space_saturation=False,
            task_slows=False,
            null_space_yields=False,
            drift_compensation_rate=0.0,
            blending=BlendingConfig(hysteresis=0.0, blend_time=0.0),
        )


@pytree
@dataclass(frozen=True, kw_only=True)
class ControllerState:
    """All that the controller remembers from one step to the next."""

    blending: BlendingState
    """Between Cartesian and vision feedback."""
    task_level: Float[Tensor, "*batch"]
    """Fraction to which both have taken over from a joint-space approach, 0 to 1."""
    pose_drift: PoseDrift
    """Of the tool while a person acts."""
    safety: SafetyState
    """Of the safety filter, with its counts of interventions."""
    estimator: Any
    """Of the image Jacobian: whatever the estimator keeps."""


class _Motion(NamedTuple):
    """Joint velocity of the law before the safety filter, and how it came about."""

    joint_velocity: Tensor
    null_velocity: Tensor
    twist: Tensor
    """Of the tool: the task's, and the correction of the pose drift."""
    task_twist: Tensor
    xi_q: Tensor
    bounds: tuple[Tensor, Tensor]
    """Velocities that limits of position and velocity allow."""
    pose_drift: PoseDrift | None
    """None: not compensated in this step."""
    jacobian: Tensor
    """Of that part of the tool's motion which the task leads."""


@final
class AdaptiveController(nn.Module):
    """The control law of the paper, one step at a time.

    u = -J^+ (J_s_hat^T xi_x + xi_r) + N c_d^-1 (d - xi_q)               (globalControl)

    with what it takes to run it on an arm: the twist is capped with its direction kept, J^+
    is damped where J is singular, vision feedback fades in and out, null-space motion yields
    to the task where a limit is near, and a safety filter has the last word.

    Goals that lead less than a pose of the tool (`Goals.task`) leave more null space: with rows
    J_t = B J of the Jacobian, u = -J_t^+ (J J_t^+)^T s + N_t c_d^-1 (d - xi_q), along which the
    potential falls as it does with six.

    A step is a pure function `(state, observation) -> (command, state)`; nothing is stored
    in the module. Run real-time loops under `torch.inference_mode()`.
    """

    def __init__(
        self,
        chain: SerialChain,
        estimator: ImageJacobianEstimator,
        goals: Goals,
        *,
        config: ControllerConfig | None = None,
        joint_region: JointRegion | None = None,
    ):
        """Put the parts together.

        Args:
            chain: The arm.
            estimator: Of the image Jacobian.
            goals: Regions to go to, unless an observation brings its own.
            config: Default: the recommended settings.
            joint_region: Default: that of the chain's limits.

        Raises:
            ValueError: The arm has too few joints for what the goals lead.
        """
        super().__init__()
        self.chain = chain
        self.estimator = estimator
        self.goals = goals
        self.config = config = config or ControllerConfig()
        # Here once: which they are is no question of a step.
        self._ranks = {task: task_rank(chain, task) for task in TASK_ROWS}
        self._check_task(goals)
        limits = chain.limits
        self.joint_region = joint_region or JointRegion.from_limits(limits.lower, limits.upper)
        self.blending = VisionBlending(config.blending)
        self.safety = SafetyFilter(limits, config.safety)
        caps = [
            [config.linear_speed, config.angular_speed],
            [config.approach_linear_speed, config.approach_angular_speed],
        ]
        self.register_buffer("caps", torch.tensor(caps, dtype=torch.float64))

    caps: Tensor
    """Linear and angular speed: of the task, of a joint-space approach [m/s, rad/s]."""

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True):
        # Regions are no modules, but move with the module like its buffers.
        super()._apply(fn, recurse)
        self.goals = _pytree.tree_map(fn, self.goals)
        self.joint_region = _pytree.tree_map(fn, self.joint_region)
        return self

    def null_space_dimension(self, task: TaskSpace | None = None) -> int:
        """How many dimensions of joint motion a task leaves to people and limits.

        Args:
            task: What of the tool's pose is led; None: what the goals lead.
        """
        return len(self.chain.joint_names) - self._ranks[task or self.goals.task]

    def _check_task(self, goals: Goals) -> None:
        task, n = goals.task, len(self.chain.joint_names)
        if task == "pose" and n < 6:
            left = self.null_space_dimension("position+axis")
            raise ValueError(
                f"the goals lead the whole pose of the tool, which takes six joints, but the "
                f"arm has {n}: lead its position and axis, Goals.at(..., "
                f"task='position+axis'), which leaves {left} of null space, or its position"
            )
        if task != "pose" and self.config.jacobian == "analytic":
            raise ValueError(
                f"the analytic Jacobian counts whole rotations: goals of {task!r} take "
                "ControllerConfig(jacobian='geometric')"
            )

    def initial_state(
        self,
        joint_position: Float[Tensor, "*batch n"],
        joint_velocity: Float[Tensor, "*batch n"] | None = None,
    ) -> ControllerState:
        """State of an arm that starts at a joint position [rad], at rest unless told."""
        J = self.chain.jacobian(joint_position)
        still = torch.zeros_like(J[..., 0])
        return ControllerState(
            blending=self.blending.initial_state(
                joint_position, self.estimator.network.rows // 2
            ),
            task_level=torch.zeros_like(joint_position[..., 0]),
            pose_drift=PoseDrift(
                drift=still,
                joint_position=joint_position,
                jacobian=J,
                planned=still,
                active=torch.zeros_like(still[..., 0], dtype=torch.bool),
            ),
            safety=self.safety.initial_state(joint_position, joint_velocity),
            estimator=self.estimator.initial_state(*joint_position.shape[:-1]),
        )

    def step(
        self, state: ControllerState, observation: Observation
    ) -> tuple[Command, ControllerState]:
        """One step of the law.

        What is not a number, and a tensor `dt` beyond `SafetyConfig.longest_step`, brakes the
        arm, flagged `invalid`, or is done without, as a feature not seen. It is neither
        learned from nor remembered: the next step is healthy.

        Args:
            state: Of the step before.
            observation: Of this step.

        Returns:
            What to send and why, and the next state.

        Raises:
            ValueError: A number dt is not in (0, longest_step] of the safety settings, or the
                observation's goals lead more than the arm has joints for.
        """
        state = self._restored(state)
        goals, known = effective_goals(observation, self.goals)
        self._check_task(goals)
        dt, timed = known_step(observation.dt, self.config.safety.longest_step)
        q, stale = validated_position(observation, state.safety.position)
        pose, J = self.chain.forward_and_jacobian(q)
        task_level = next_task_level(
            state.task_level,
            goals.posture,
            q,
            state.blending.active,
            dt,
            self.config.blending.blend_time,
        )
        usable = observation.feature_visible & goals.vision_enabled & known
        # During a joint-space approach the camera does not take part.
        blending, seen, stop = self.blending.step(
            state.blending,
            observation.feature,
            usable if goals.posture is None else usable & (task_level > 0),
            dt,
            age=observation.feature_age,
        )
        J_s = self.estimator.jacobian(state.estimator, pose)
        feedback = regional_feedback(goals, pose, blending, J_s, self.config.vision_rate)
        descent = feedback.s
        if self.config.jacobian == "analytic":
            descent = analytic_descent(descent, pose.orientation)
        motion = self._motion(state, observation, goals, q, pose, J, task_level, descent)
        asked = torch.cat([motion.joint_velocity, feedback.xi_x, feedback.xi_r], dim=-1)
        sound = timed & is_number(asked).all(-1)
        if observation.stop is not None:
            stop = observation.stop if stop is None else stop | observation.stop
        constrained = self.config.safety.constraints is not None
        v, safety, report = self.safety.step(
            state.safety,
            q,
            motion.joint_velocity,
            observation.dt,
            jacobian=J,
            human_distance=observation.human_distance,
            stop=stop,
            stale=stale | ~sound,
            bounds=motion.bounds,
            # Those by which the arm makes way need not be kept.
            distances=observation.distances
            if constrained or self.config.way_making is None
            else None,
        )
        # What the filter left of the task's motion is what the tool ought to do until the next
        # step: whatever else it does is drift.
        if motion.pose_drift is None:
            pose_drift = replace(state.pose_drift, active=torch.zeros_like(stale))
        else:
            led = motion.jacobian
            planned = planned_motion(motion.task_twist, motion.twist, led, v, dt)
            # An arm that only brakes does not drift.
            braking = safety.dt.unsqueeze(-1) * torch.linalg.vecdot(led, v.unsqueeze(-2))
            planned = torch.where(sound.unsqueeze(-1), planned, braking)
            pose_drift = replace(motion.pose_drift, planned=planned)
        command = Command(
            joint_velocity=v,
            twist=motion.twist,
            null_velocity=motion.null_velocity,
            xi_x=feedback.xi_x,
            xi_r=feedback.xi_r,
            xi_q=motion.xi_q,
            s=feedback.s,
            image_jacobian=J_s,
            weight_norm=torch.linalg.vector_norm(state.estimator.weight, dim=(-2, -1)),
            vision_level=blending.level,
            potential=feedback.potential,
            potential_rate=potential_rate(feedback.s, J, v),
            safety=report,
        )
        estimator = self._adapted(
            state, observation, pose, dt, seen & ~stale & sound, blending, feedback, sound
        )
        return command, ControllerState(
            blending=blending,
            task_level=task_level,
            pose_drift=pose_drift,
            safety=safety,
            estimator=estimator,
        )

    def _restored(self, state: ControllerState) -> ControllerState:
        """The state, as at the start where it is not of numbers."""
        return ControllerState(
            blending=self.blending.restored(state.blending),
            task_level=state.task_level.masked_fill(~is_number(state.task_level), 0),
            pose_drift=restored_drift(state.pose_drift),
            safety=self.safety.restored(state.safety),
            estimator=self.estimator.restored(state.estimator),
        )

    def _motion(
        self,
        state: ControllerState,
        observation: Observation,
        goals: Goals,
        q: Tensor,
        pose: Pose,
        J: Tensor,
        task_level: Tensor,
        descent: Tensor,
    ) -> _Motion:
        """Joint velocity of the law, with the pose drift compensated while a person acts."""
        d, rate = self._nullspace_input(observation), self.config.drift_compensation_rate
        xi_q = self.joint_region.gradient(q)
        if goals.rest is not None:
            xi_q = xi_q + self.config.null_damping * goals.rest.gradient(q)
        null = (-xi_q if d is None else d - xi_q) / self.config.null_damping

        # B^T B J is the Jacobian of what the task leads of the tool's motion.
        basis, led = self._basis(goals, pose, J), J
        if basis is not None:
            led = basis.mT @ (basis @ J)
            descent = led_descent(J, basis, descent)
        twist = task_twist = -descent / excess_speed(descent, self.caps[0])
        pose_drift = None
        if d is not None and rate > 0:
            # A joint-space approach plans no path of the tool from which it could drift.
            active = (d != 0).any(-1) & ((task_level == 1) | (goals.posture is None))
            pose_drift = measure_drift(state.pose_drift, q, led, active)
            twist = torch.add(task_twist, pose_drift.drift, alpha=rate)

        ahead = self.config.command_delay
        if ahead > 0:
            # Where the arm will be when it follows: the null space is that of then.
            coming = q + ahead * state.safety.velocity
            if basis is None:
                J = self.chain.jacobian(coming)
            else:
                pose, J = self.chain.forward_and_jacobian(coming)
                basis = self._basis(goals, pose, J)
        J_task, rows = J, twist
        if basis is not None:
            J_task, rows = basis @ J, (basis @ twist.unsqueeze(-1)).squeeze(-1)
        task, null = resolved_rate(J_task, rows, null)
        bounds = self.safety.velocity_bounds(q)
        # Constraints let task and null space yield better.
        cut = self.config.safety.constraints is None
        if cut and self.config.null_space_saturation:
            task = saturate_in_null_space(task, J_task, rows, *bounds)
        if cut and self.config.task_slows:
            task = scale_task(task, J, *bounds, self.caps[0])
        if goals.posture is not None:
            approach = approach_velocity(goals.posture, q, J, self.caps[1])
            task = torch.lerp(approach, task, task_level.unsqueeze(-1))
        if cut and self.config.null_space_yields:
            null = scale_null_space(task, null, *bounds)
        return _Motion(task + null, null, twist, task_twist, xi_q, bounds, pose_drift, led)

    def _basis(self, goals: Goals, pose: Pose, J: Tensor) -> Tensor | None:
        """What the goals lead of the tool's motion; None: all of it."""
        task = goals.task
        return (
            None if task == "pose" else task_basis(J, pose.orientation, task, self._ranks[task])
        )

    def _nullspace_input(self, observation: Observation) -> Tensor | None:
        """The person's, and the effort that would make the arm make way by itself."""
        d, way = observation.nullspace_input, self.config.way_making
        if way is None:
            return d
        if not way.expert:
            d = None
        if not way.automatic or observation.distances is None:
            return d
        push = self.config.null_damping * way_making_velocity(observation.distances, way)
        return push if d is None else d + push

    def _adapted(
        self,
        state: ControllerState,
        observation: Observation,
        pose: Pose,
        dt: float | Tensor,
        seen: Tensor,
        blending: BlendingState,
        feedback: Feedback,
        sound: Tensor,
    ) -> Any:
        """State of the estimator after what the camera saw."""
        q = observation.image_joint_position
        if q is not None:
            # Estimators compute with the pose even where they must not learn from it.
            known = is_number(q).all(-1)
            pose = self.chain.forward(
                torch.where(known.unsqueeze(-1), q, state.safety.position)
            )
            seen = seen & known
        if observation.feature_new is not None:
            seen = seen & observation.feature_new
        measurement = Measurement(
            pose=pose,
            feature=blending.feature,
            valid=seen,
            dt=dt,
            xi_x=feedback.xi_x.masked_fill(~sound.unsqueeze(-1), 0),
            xi_r=feedback.xi_r.masked_fill(~sound.unsqueeze(-1), 0),
        )
        return self.estimator.update(state.estimator, measurement)
