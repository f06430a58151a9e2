"""The vision-based adaptive controller with multiple regional feedback."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, final

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.utils import _pytree

from hrc_learn.controller import resolved_rate as law
from hrc_learn.controller.interface import (
    Command,
    Goals,
    Observation,
    SafetyConfig,
    SafetyReport,
    SafetyState,
)
from hrc_learn.controller.resolved_rate import (
    BlendingConfig,
    BlendingState,
    Feedback,
    PoseDrift,
    VisionBlending,
)
from hrc_learn.controller.safety_filter import SafetyFilter
from hrc_learn.controller.task_pace import WayMakingConfig, null_space_input
from hrc_learn.geometry import Pose, quaternion
from hrc_learn.geometry.numerics import ArrayLike, check_settings, has_numbers, is_number
from hrc_learn.jacobian import ImageJacobianEstimator, Measurement
from hrc_learn.kinematics import Arm, SerialChain, TaskSpace, task_basis, task_rank
from hrc_learn.kinematics.inverse import TASK_ROWS
from hrc_learn.pytree import pytree
from hrc_learn.regions import JointRegion


@dataclass(frozen=True, kw_only=True)
class ControllerConfig:
    """Settings of the control law; the defaults performed best in our studies."""

    linear_speed: float = 0.25
    """Cap on the linear part of the twist [m/s]; the direction of the twist is kept."""
    angular_speed: float = 1.0
    """Cap on the angular part of the twist [rad/s]."""
    vision_rate: float = 4.0
    """Fastest decay of the pixel error [1/s], as predicted by the estimated image Jacobian. The
    gain of the law grows with the square of the image Jacobian. Without a cap, it can be too
    high for stability with images at 15 to 30 Hz and a delay of one frame or more."""
    approach_linear_speed: float = 0.5
    """Cap on the linear speed of the tool while it approaches `Goals.posture` [m/s]."""
    approach_angular_speed: float = 2.0
    """Cap on the angular speed of the tool while it approaches `Goals.posture` [rad/s]."""
    command_delay: float = 0.0
    """Time from a command until the arm follows it, servo lag included [s]. The joint velocity
    is computed at the joint positions predicted for that time."""
    null_damping: float = 3.0
    """c_d [N m s/rad]: a null-space input d requests the null-space velocity d/c_d."""
    yields_to_limits: bool = True
    """True: near joint limits, free joints take over the motion that limited joints cannot make
    (saturation in the null space). A joint at its limit may no longer cancel the motion of
    another joint; where the tool would then move faster than requested, the task slows down.
    Null-space motion is scaled down in proportion for all joints. False: only the safety filter
    keeps the limits."""
    drift_compensation_rate: float = 2.0
    """Decay rate of the tool's pose drift under a null-space input [1/s]; 0: no
    compensation."""
    blending: BlendingConfig = field(default_factory=BlendingConfig)
    """Blending of vision feedback."""
    way_making: WayMakingConfig | None = None
    """Null-space motion away from the people and objects of `Observation.distances`; None: the
    input of a person is the only null-space input."""
    safety: SafetyConfig = field(default_factory=SafetyConfig)
    """Safety filter."""

    unbounded = "linear_speed", "angular_speed", "vision_rate"

    def __post_init__(self):
        approach = "approach_linear_speed", "approach_angular_speed"
        check_settings(
            self,
            positive=(*self.unbounded, *approach, "null_damping"),
            not_negative=("drift_compensation_rate", "command_delay"),
        )

    @classmethod
    def paper(cls) -> ControllerConfig:
        """Settings of the law as printed in the paper, without our extensions of the law.

        The safety filter stays.
        """
        return cls(
            linear_speed=math.inf,
            angular_speed=math.inf,
            vision_rate=math.inf,
            yields_to_limits=False,
            drift_compensation_rate=0.0,
            blending=BlendingConfig(hysteresis=0.0, blend_time=0.0),
        )


@pytree
class ControllerState:
    """State of the controller between two steps."""

    blending: BlendingState
    """State of the vision blending."""
    task_level: Float[Tensor, "*batch"]
    """Fraction of task-space feedback in the command after a joint-space approach, 0 to 1."""
    pose_drift: PoseDrift
    """Drift of the tool under a null-space input."""
    safety: SafetyState
    """State of the safety filter, with its counts of interventions."""
    estimator: Any
    """State of the image-Jacobian estimator."""


class _Given(NamedTuple):
    """Inputs of a step, with invalid values of `dt` and `q` replaced."""

    observation: Observation
    goals: Goals
    dt: float | Tensor
    q: Tensor
    pose: Pose
    J: Tensor


class _Motion(NamedTuple):
    """Joint velocity of the law before the safety filter, and the terms of this velocity."""

    joint_velocity: Tensor
    null_velocity: Tensor
    twist: Tensor
    """Twist of the tool: sum of the task's twist and the drift compensation."""
    task_twist: Tensor
    """Twist of the task alone."""
    xi_q: Tensor
    """Joint-space feedback."""
    pose_drift: PoseDrift | None
    """Measured drift; None: not compensated."""
    jacobian: Tensor
    """Jacobian of the controlled part of the tool's motion."""


@final
class AdaptiveController(nn.Module):
    """The control law of the paper (equation globalControl), one step at a time.

    u = -J^+ (J_s_hat^T xi_x + xi_r) + N c_d^-1 (d - xi_q)               (globalControl)

    u is the joint velocity, J the arm's Jacobian and N its null-space projector. The feedback
    is xi_x from vision (with the image Jacobian J_s_hat), xi_r from the tool pose and xi_q from
    the joints; d is the null-space input, and c_d its damping (`null_damping`). For real arms
    we extend the law: the twist is capped with its direction kept, J^+ is damped near
    singularities, vision feedback fades in and out, null-space motion yields to the task near
    limits, and a safety filter has the last word.

    Goals for a part of the tool pose (`Goals.task`) leave more null space. With a basis B of
    this part, J_t = B J and s = J_s_hat^T xi_x + xi_r, the law is

        u = -J_t^+ (J J_t^+)^T s + N_t c_d^-1 (d - xi_q).

    The potentials of the regions, with the gradients s and xi_q, still fall. An arm with the
    task "nearest pose" (`Arm.task`) also follows this law for goals of the whole pose.

    A step is a pure function `(state, observation) -> (command, state)`; the module stores no
    state. Run real-time loops under `torch.inference_mode()`.
    """

    def __init__(
        self,
        arm: SerialChain,
        estimator: ImageJacobianEstimator,
        goals: Goals,
        *,
        config: ControllerConfig | None = None,
        joint_region: JointRegion | None = None,
    ):
        """Prepare the controller.

        Args:
            arm: The arm, or its kinematic chain.
            estimator: Estimator of the image Jacobian.
            goals: Regions that attract tool, image feature and joints; an observation may
                replace them.
            config: Settings; default: the recommended settings.
            joint_region: Region within the joint limits; default: from the arm's limits.

        Raises:
            ValueError: The arm has too few joints for the goals, or the estimator's feature and
                the goals' target differ in their number of points.
        """
        super().__init__()
        self.chain = arm
        self.estimator = estimator
        self.goals = goals
        self.config = config = config or ControllerConfig()
        # Ranks depend on the arm alone; computing them once keeps branches out of a step.
        self._ranks = {task: task_rank(arm, task) for task in TASK_ROWS}
        self._nearest = isinstance(arm, Arm) and arm.task == "nearest pose"
        self._check_task(goals)
        limits = arm.limits
        self.joint_region = joint_region or JointRegion.from_limits(limits.lower, limits.upper)
        self.blending = VisionBlending(config.blending)
        self.safety = SafetyFilter(arm, config.safety)
        caps = [
            [config.linear_speed, config.angular_speed],
            [config.approach_linear_speed, config.approach_angular_speed],
        ]
        self.caps = nn.Buffer(torch.tensor(caps, dtype=torch.float64))
        """Caps on linear and angular speed of the task and of a joint-space approach, (2, 2)
        [m/s, rad/s]."""

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True):
        # Regions are not modules, but have to change device and dtype with this module.
        super()._apply(fn, recurse)
        self.goals = _pytree.tree_map(fn, self.goals)
        self.joint_region = _pytree.tree_map(fn, self.joint_region)
        return self

    def null_space_dimension(self, task: TaskSpace | None = None) -> int:
        """Dimension of the joint motion that a task leaves free.

        Args:
            task: Controlled part of the tool pose; None: the part that the goals control.
        """
        return len(self.chain.joint_names) - self._ranks[task or self.goals.task]

    def _check_task(self, goals: Goals) -> None:
        task, n = goals.task, len(self.chain.joint_names)
        wanted, seen = goals.vision.target.shape[-1], self.estimator.network.rows
        if wanted != seen:
            raise ValueError(
                f"the goals' target has {wanted} coordinates, the estimator's feature {seen}: "
                "pass u and v of each point as target (with_vision(False) ignores them)"
            )
        if task == "pose" and n < 6 and not self._nearest:
            left = self.null_space_dimension("position+axis")
            raise ValueError(
                f"the goals control the whole tool pose, which needs six joints, but the "
                f"arm has {n}: control the tool's position and axis by Goals.at(..., "
                f"task='position+axis') (null space: {left}), or its position alone"
            )

    def initial_state(
        self,
        joint_position: ArrayLike,
        joint_velocity: ArrayLike | None = None,
        joint_acceleration: ArrayLike | None = None,
    ) -> ControllerState:
        """Initial state of an arm at rest or in motion.

        Args:
            joint_position: Measured joint positions (*batch, n) [rad].
            joint_velocity: Measured joint velocities (*batch, n) [rad/s]; None: at rest.
            joint_acceleration: Joint accelerations (*batch, n) [rad/s^2]; None: zero.

        Raises:
            ValueError: A vector does not have one value for each joint.
        """
        joint_position = self.safety.joint_vector(joint_position, "joint_position")
        J = self.chain.jacobian(joint_position)
        still, zero = (J.new_zeros(x.shape[:-1]) for x in (J, joint_position))
        return ControllerState(
            blending=self.blending.initial_state(
                joint_position, self.estimator.network.rows // 2
            ),
            task_level=zero,
            pose_drift=PoseDrift(
                drift=still,
                joint_position=joint_position,
                jacobian=J,
                planned=still,
                active=torch.zeros_like(zero, dtype=torch.bool),
            ),
            safety=self.safety.initial_state(
                joint_position, joint_velocity, joint_acceleration
            ),
            estimator=self.estimator.initial_state(*joint_position.shape[:-1]),
        )

    def step(
        self, state: ControllerState, observation: Observation
    ) -> tuple[Command, ControllerState]:
        """One step of the law.

        Invalid values (NaN, infinity, a tensor `dt` outside (0, `SafetyConfig.longest_step`])
        brake the arm and set the flag `invalid`; an invalid feature counts as not visible.
        Invalid values are neither learned from nor stored, so they do not affect later steps.

        Args:
            state: State after the last step.
            observation: Measurements and requests of this step.

        Returns:
            The command and the next state.

        Raises:
            ValueError: The joint positions do not fit the arm; `dt` is a number outside the
                range (0, `longest_step`] of the safety settings; or the goals of the
                observation need more joints than the arm has.
        """
        given_safety, state = state.safety, self._restored(state)
        self.safety.joint_vector(observation.joint_position, "joint_position")
        goals = self.goals if observation.goals is None else observation.goals
        self._check_task(goals)
        dt, timed = law.validated_step(observation.dt, self.config.safety.longest_step)
        q, stale = law.validated_position(observation, state.safety.position)
        pose, J = self.chain.forward_and_jacobian(q)
        given = _Given(observation, goals, dt, q, pose, J)
        blend_time = self.config.blending.blend_time
        task_level = law.next_task_level(
            state.task_level, goals.posture, q, state.blending.active, dt, blend_time
        )
        usable = visible = observation.feature_visible & goals.vision_enabled
        if goals.posture is not None:
            usable = usable & (task_level > 0)  # no vision during a joint-space approach
        blending, seen, stop = self.blending.step(
            state.blending, observation.feature, usable, dt, age=observation.feature_age
        )
        J_s = self.estimator.jacobian(state.estimator, pose)
        feedback = law.regional_feedback(goals, pose, blending, J_s, self.config.vision_rate)
        motion = self._motion(state, given, task_level, feedback.s)
        numbers = (motion.joint_velocity, feedback.xi_x, feedback.xi_r)
        sound = timed & is_number(torch.cat(numbers, dim=-1)).all(-1)
        # The filter checks its own state, and brakes the arm where this state is invalid.
        v, safety, report = self._filtered(given_safety, given, motion, stop, stale | ~sound)
        pose_drift = self._next_drift(state.pose_drift, motion, v, dt, sound, safety)
        moved = torch.linalg.vecdot(J, v.unsqueeze(-2))
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
            potential_rate=torch.linalg.vecdot(feedback.s, moved),
            safety=report,
        )
        if goals.posture is not None:
            # A joint-space approach does not use vision, but the estimator learns from the
            # images taken meanwhile.
            seen = visible & (self.blending.inside(observation.feature) >= 0)
            if observation.feature_age is not None:
                seen = seen & ~self.blending.late(observation.feature_age)
            taught = torch.where(seen.unsqueeze(-1), observation.feature, blending.feature)
            blending = replace(blending, feature=taught)
        seen = seen & ~stale & sound
        estimator = self._adapted(state, given, seen, blending, feedback, sound)
        return command, ControllerState(
            blending=blending,
            task_level=task_level,
            pose_drift=pose_drift,
            safety=safety,
            estimator=estimator,
        )

    def _filtered(
        self,
        state: SafetyState,
        given: _Given,
        motion: _Motion,
        stop: Tensor | None,
        unknown: Tensor,
    ) -> tuple[Tensor, SafetyState, SafetyReport]:
        """Results of `SafetyFilter.step`; where `unknown`, the filter brakes the arm."""
        observation = given.observation
        if observation.stop is not None:
            stop = observation.stop if stop is None else stop | observation.stop
        distances = observation.distances
        if self.config.safety.constraints is None and self.config.way_making is not None:
            distances = None  # used for way-making only
        load = observation.load
        return self.safety.step(
            state,
            given.q,
            motion.joint_velocity.masked_fill(unknown.unsqueeze(-1), math.nan),
            observation.dt,
            jacobian=given.J,
            load=None if load is None else quaternion.rotate(given.pose.orientation, load),
            joint_velocity=observation.joint_velocity,
            human_distance=observation.human_distance,
            stop=stop,
            distances=distances,
        )

    def _restored(self, state: ControllerState) -> ControllerState:
        """The state, with invalid values replaced by defaults."""
        if has_numbers(state):
            return state
        return ControllerState(
            blending=self.blending.restored(state.blending),
            task_level=state.task_level.masked_fill(~is_number(state.task_level), 0),
            pose_drift=law.restored_drift(state.pose_drift),
            safety=self.safety.restored(state.safety),
            estimator=self.estimator.restored(state.estimator),
        )

    def _motion(
        self, state: ControllerState, given: _Given, task_level: Tensor, descent: Tensor
    ) -> _Motion:
        """Joint velocity of the law, with drift compensation under a null-space input."""
        observation, goals, _, q, pose, J = given
        rate, damping = self.config.drift_compensation_rate, self.config.null_damping
        d = null_space_input(
            observation.nullspace_input, observation.distances, self.config.way_making, damping
        )
        xi_q = self.joint_region.gradient(q)
        if goals.rest is not None:
            xi_q = xi_q + damping * goals.rest.gradient(q)
        null = (-xi_q if d is None else d - xi_q) / damping

        # B^T B J is the Jacobian of the controlled part of the tool's motion.
        basis, controlled = self._basis(goals, pose, J), J
        if basis is not None:
            controlled = basis.mT @ (basis @ J)
            descent = law.task_descent(J, basis, descent)
        twist = task_twist = -descent / law.excess_speed(descent, self.caps[0])
        pose_drift = None
        if d is not None and rate > 0:
            # A joint-space approach plans no tool path, so there is no drift.
            active = (d.norm(dim=-1) > 0) & ((task_level == 1) | (goals.posture is None))
            pose_drift = law.measure_drift(state.pose_drift, q, controlled, active)
            twist = torch.add(task_twist, pose_drift.drift, alpha=rate)

        delay = self.config.command_delay
        if delay > 0:
            # Jacobian at the predicted joint positions.
            pose, J = self.chain.forward_and_jacobian(q + delay * state.safety.velocity)
            basis = self._basis(goals, pose, J)
        task, null = self._resolved(given, J, basis, twist, null, task_level)
        return _Motion(task + null, null, twist, task_twist, xi_q, pose_drift, controlled)

    def _resolved(
        self,
        given: _Given,
        J: Tensor,
        basis: Tensor | None,
        twist: Tensor,
        null: Tensor,
        task_level: Tensor,
    ) -> tuple[Tensor, Tensor]:
        """Joint velocities of task and null space; near limits, the null space yields."""
        config, q, posture = self.config, given.q, given.goals.posture
        bounds = self.safety.velocity_bounds(q)
        J_task, rows = J, twist
        if basis is not None:
            J_task, rows = basis @ J, (basis @ twist.unsqueeze(-1)).squeeze(-1)
        task, null = law.resolved_rate(J_task, rows, null)
        # Constraints resolve conflicts between task and null space themselves.
        yields = config.yields_to_limits and config.safety.constraints is None
        if yields:
            asked, task = task, law.saturate_in_null_space(task, J_task, rows, *bounds)
            if task is not asked:  # a limit acts, or not `may_branch`
                task = law.scale_task(task, J, *bounds, self.caps[0])
        if posture is not None:
            approach = law.approach_velocity(posture, q, J, self.caps[1])
            task = torch.lerp(approach, task, task_level.unsqueeze(-1))
        if yields:
            null = law.scale_null_space(task, null, *bounds)
        return task, null

    def _next_drift(
        self,
        before: PoseDrift,
        motion: _Motion,
        joint_velocity: Tensor,
        dt: float | Tensor,
        sound: Tensor,
        safety: SafetyState,
    ) -> PoseDrift:
        """Drift state for the next step.

        The part of the task's motion that passed the filter is the planned motion of the tool
        until the next step: any other motion is drift.
        """
        if motion.pose_drift is None:
            return replace(before, active=torch.zeros_like(before.active))
        done = torch.linalg.vecdot(motion.jacobian, joint_velocity.unsqueeze(-2))
        planned = law.planned_motion(motion.task_twist, motion.twist, done, dt)
        # An arm that only brakes does not drift.
        planned = torch.where(sound.unsqueeze(-1), planned, safety.dt.unsqueeze(-1) * done)
        return replace(motion.pose_drift, planned=planned)

    def _basis(self, goals: Goals, pose: Pose, J: Tensor) -> Tensor | None:
        """Basis of the controlled tool motion; None: the whole tool motion is controlled."""
        task = goals.task
        if task == "pose" and not self._nearest:
            return None
        return task_basis(J, pose.orientation, task, self._ranks[task])

    def _adapted(
        self,
        state: ControllerState,
        given: _Given,
        seen: Tensor,
        blending: BlendingState,
        feedback: Feedback,
        sound: Tensor,
    ) -> Any:
        """State of the estimator after it has learned from the camera's measurement."""
        observation, pose = given.observation, given.pose
        q = observation.image_joint_position
        if q is not None:
            # Estimators compute with the pose even where they must not learn from it, so it
            # must be finite.
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
            dt=given.dt,
            xi_x=feedback.xi_x.masked_fill(~sound.unsqueeze(-1), 0),
            xi_r=feedback.xi_r.masked_fill(~sound.unsqueeze(-1), 0),
        )
        return self.estimator.update(state.estimator, measurement)
