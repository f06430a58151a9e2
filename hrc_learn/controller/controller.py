"""The vision-based adaptive controller with multiple regional feedback."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple, final

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.utils import _pytree

from hrc_learn.controller.blending import Activation, HandOver, approach_velocity, next_arrival
from hrc_learn.controller.config import ControllerConfig
from hrc_learn.controller.feedback import (
    Feedback,
    analytic_descent,
    effective_goals,
    either,
    regional_feedback,
    trusted_position,
)
from hrc_learn.controller.interface import Command, ControllerState, Goals, Observation
from hrc_learn.controller.monitors import potential_rate
from hrc_learn.controller.resolved_rate import (
    Hold,
    excess_speed,
    fit_null_space,
    measure_drift,
    planned_motion,
    resolve,
)
from hrc_learn.controller.safety_filter import SafetyFilter
from hrc_learn.geometry import Pose
from hrc_learn.jacobian import ImageJacobianEstimator, Measurement
from hrc_learn.kinematics import SerialChain
from hrc_learn.regions import JointRegion


class _Motion(NamedTuple):
    """Joint velocity of the law before the safety filter, and how it came about."""

    joint_velocity: Tensor
    null_velocity: Tensor
    twist: Tensor
    task_twist: Tensor
    xi_q: Tensor
    bounds: tuple[Tensor, Tensor]


@final
class AdaptiveController(nn.Module):
    """The control law of the paper, one step at a time.

    u = -J^+ (J_s_hat^T xi_x + xi_r) + N c_d^-1 (d - xi_q)               (globalControl)

    with what it takes to run it on an arm: the twist is capped with its direction kept, J^+
    is damped where J is singular, vision feedback fades in and out, null-space motion yields
    to the task where a limit is near, and a safety filter has the last word.

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
        """
        super().__init__()
        self.chain = chain
        self.estimator = estimator
        self.goals = goals
        self.config = config = config or ControllerConfig()
        limits = chain.limits
        self.joint_region = joint_region or JointRegion.from_limits(limits.lower, limits.upper)
        self.hand_over = HandOver(config.activation)
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

    def initial_state(
        self,
        joint_position: Float[Tensor, "*batch n"],
        joint_velocity: Float[Tensor, "*batch n"] | None = None,
    ) -> ControllerState:
        """State of an arm that starts at a joint position [rad], at rest unless told."""
        J = self.chain.jacobian(joint_position)
        still = torch.zeros_like(J[..., 0])
        return ControllerState(
            activation=self.hand_over.initial_state(
                joint_position, self.estimator.network.rows // 2
            ),
            arrival=torch.zeros_like(joint_position[..., 0]),
            hold=Hold(
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

        Args:
            state: Of the step before.
            observation: Of this step.

        Returns:
            What to send and why, and the next state.

        Raises:
            ValueError: dt is not in (0, 1/rate] of the safety filter.
        """
        goals, known = effective_goals(observation, self.goals)
        q, stale = trusted_position(observation, state.safety.position)
        pose, J = self.chain.forward_and_jacobian(q)
        arrival = next_arrival(
            state.arrival,
            goals.posture,
            q,
            state.activation.active,
            observation.dt,
            self.config.activation.blend_time,
        )
        usable = observation.feature_visible & goals.vision_enabled & known
        activation, seen, stop = self.hand_over.step(
            state.activation,
            observation.feature,
            usable if goals.posture is None else usable & (arrival > 0),
            observation.dt,
            age=observation.feature_age,
        )
        J_s = self.estimator.jacobian(state.estimator, pose)
        feedback = regional_feedback(goals, pose, activation, J_s, self.config.vision_rate)
        descent = feedback.s
        if self.config.jacobian == "analytic":
            descent = analytic_descent(descent, pose.orientation)
        motion, hold = self._motion(state, observation, goals, q, J, arrival, descent)
        v, safety, report = self.safety.step(
            state.safety,
            q,
            motion.joint_velocity,
            observation.dt,
            jacobian=J,
            human_distance=observation.human_distance,
            stop=either(stop, observation.stop),
            stale=stale,
            bounds=motion.bounds,
        )
        if hold is None:
            hold = replace(state.hold, active=torch.zeros_like(state.hold.active))
        else:
            planned = planned_motion(motion.task_twist, J, v, observation.dt)
            hold = replace(hold, planned=planned)
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
            vision_activation=activation.level,
            potential=feedback.potential,
            potential_rate=potential_rate(feedback.s, J, v),
            safety=report,
        )
        estimator = self._adapted(state, observation, pose, seen & ~stale, activation, feedback)
        return command, ControllerState(
            activation=activation,
            arrival=arrival,
            hold=hold,
            safety=safety,
            estimator=estimator,
        )

    def _motion(
        self,
        state: ControllerState,
        observation: Observation,
        goals: Goals,
        q: Tensor,
        J: Tensor,
        arrival: Tensor,
        descent: Tensor,
    ) -> tuple[_Motion, Hold | None]:
        """Joint velocity of the law, and the pose hold where one is asked for."""
        d = observation.human_effort
        xi_q = self.joint_region.gradient(q)
        wish = (-xi_q if d is None else d - xi_q) / self.config.null_damping

        twist = task_twist = -descent / excess_speed(descent, self.caps[0])
        hold = None
        if d is not None and self.config.hold_rate > 0:
            # A joint-space approach has planned no path of the tool that could be held.
            holds = (d != 0).any(-1) & ((arrival == 1) | (goals.posture is None))
            hold = measure_drift(state.hold, q, J, holds)
            twist = torch.add(task_twist, hold.drift, alpha=self.config.hold_rate)

        task, null = resolve(J, twist, wish)
        if goals.posture is not None:
            approach = approach_velocity(goals.posture, q, J, self.caps[1])
            task = torch.lerp(approach, task, arrival.unsqueeze(-1))
        bounds = self.safety.velocity_bounds(q)
        if self.config.null_space_yields:
            null = fit_null_space(task, null, *bounds)
        return _Motion(task + null, null, twist, task_twist, xi_q, bounds), hold

    def _adapted(
        self,
        state: ControllerState,
        observation: Observation,
        pose: Pose,
        seen: Tensor,
        activation: Activation,
        feedback: Feedback,
    ) -> Any:
        """State of the estimator after what the camera saw."""
        q = observation.image_joint_position
        if q is not None:
            # Estimators compute with the pose even where they must not learn from it.
            known = q.isfinite().all(-1)
            pose = self.chain.forward(
                torch.where(known.unsqueeze(-1), q, state.safety.position)
            )
            seen = seen & known
        if observation.feature_new is not None:
            seen = seen & observation.feature_new
        measurement = Measurement(
            pose=pose,
            feature=activation.feature,
            valid=seen,
            dt=observation.dt,
            xi_x=feedback.xi_x,
            xi_r=feedback.xi_r,
        )
        return self.estimator.update(state.estimator, measurement)
