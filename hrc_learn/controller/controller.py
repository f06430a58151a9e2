"""The vision-based adaptive controller with multiple regional feedback."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple, final

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.utils import _pytree

from hrc_learn.controller.activation import Activation, HandOver, fade
from hrc_learn.controller.analytic import analytic_descent
from hrc_learn.controller.config import ControllerConfig
from hrc_learn.controller.goals import Goals
from hrc_learn.controller.hold import Hold, measure_drift, planned_motion
from hrc_learn.controller.interface import Command, ControllerState, Observation
from hrc_learn.controller.lyapunov import potential_rate
from hrc_learn.controller.resolution import excess_speed, fit_null_space, resolve
from hrc_learn.controller.safety import SafetyFilter
from hrc_learn.geometry import Pose
from hrc_learn.jacobian import ImageJacobianEstimator, Measurement
from hrc_learn.kinematics import SerialChain
from hrc_learn.regions import JointRegion, PostureRegion

# Keeps the cap on the pixel rate finite at the target.
_ONE_PIXEL_PER_SECOND = 1.0


# Region function of the posture beyond which a joint-space approach begins anew: at the
# default tolerance of 0.5 rad, a distance of 1.5 rad.
_FAR_AWAY = 2.0


class _Feedback(NamedTuple):
    """Regional feedback vectors and their combination."""

    xi_x: Tensor
    xi_r: Tensor
    s: Tensor
    image_jacobian: Tensor
    potential: Tensor


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
        goals, known = _effective_goals(observation, self.goals)
        q, stale = _trusted_position(state, observation)
        pose, J = self.chain.forward_and_jacobian(q)
        arrival = self._arrival(state, goals, q, observation.dt)
        usable = observation.feature_visible & goals.vision_enabled & known
        activation, seen, stop = self.hand_over.step(
            state.activation,
            observation.feature,
            usable if goals.posture is None else usable & (arrival > 0),
            observation.dt,
            age=observation.feature_age,
        )
        feedback = self._feedback(state, goals, pose, activation)
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
            stop=_either(stop, observation.stop),
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
            image_jacobian=feedback.image_jacobian,
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

    def _arrival(
        self, state: ControllerState, goals: Goals, q: Tensor, dt: float | Tensor
    ) -> Float[Tensor, "*batch"]:
        """Share in which task-space feedback has taken over from a joint-space approach.

        It does so inside the posture region: earlier it would lead an arm from whatever
        posture it is in, and many of those end at a joint limit. Once it has, it keeps the
        lead, also where a person or the task moves the joints out of the region, unless the
        posture lies far away, as when a new phase begins.
        """
        if goals.posture is None:
            return torch.zeros_like(state.arrival)
        f = goals.posture.value(q)
        leads = (state.arrival > 0) & ((f <= _FAR_AWAY) | state.activation.active)
        return fade(state.arrival, leads | (f <= 0), dt, self.config.activation.blend_time)

    def _feedback(
        self, state: ControllerState, goals: Goals, pose: Pose, activation: Activation
    ) -> _Feedback:
        """Regional feedback in image and Cartesian space."""
        P_t, xi_position = goals.position.feedback(pose.position)
        P_o, xi_orientation = goals.orientation.feedback(pose.orientation)
        P_v, xi_x = goals.vision.feedback(activation.feature)
        xi_r = torch.cat([xi_position, xi_orientation], dim=-1)
        J_s = self.estimator.jacobian(state.estimator, pose)
        error = activation.feature - goals.vision.target
        share = activation.level.unsqueeze(-1)
        if self.config.vision_rate < math.inf:
            share = share / self._excess_rate(J_s, xi_x, error)
        xi_x = share * xi_x
        s = torch.linalg.vecdot(J_s, xi_x.unsqueeze(-1), dim=-2) + xi_r
        return _Feedback(xi_x, xi_r, s, J_s, P_t + P_o + activation.level * P_v)

    def _excess_rate(
        self, J_s: Tensor, xi_x: Tensor, error: Tensor
    ) -> Float[Tensor, "*batch 1"]:
        """What to divide vision feedback by to keep the rate of the pixel error; at least 1."""
        push = torch.linalg.vecdot(J_s, xi_x.unsqueeze(-1), dim=-2)
        speed = torch.linalg.vecdot(J_s, push.unsqueeze(-2))
        speed = torch.linalg.vector_norm(speed, dim=-1, keepdim=True)
        distance = torch.linalg.vector_norm(error, dim=-1, keepdim=True)
        allowed = self.config.vision_rate * distance + _ONE_PIXEL_PER_SECOND
        return (speed / allowed).clamp(min=1)

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
            approach = self._approach(goals.posture, q, J)
            task = torch.lerp(approach, task, arrival.unsqueeze(-1))
        bounds = self.safety.velocity_bounds(q)
        if self.config.null_space_yields:
            null = fit_null_space(task, null, *bounds)
        return _Motion(task + null, null, twist, task_twist, xi_q, bounds), hold

    def _approach(
        self, posture: PostureRegion, q: Tensor, J: Tensor
    ) -> Float[Tensor, "*batch n"]:
        """Joint velocity towards a posture, as slow as the caps of the tool ask [rad/s]."""
        velocity = -posture.gradient(q)
        twist = torch.linalg.vecdot(J, velocity.unsqueeze(-2))
        return velocity / excess_speed(twist, self.caps[1])

    def _adapted(
        self,
        state: ControllerState,
        observation: Observation,
        pose: Pose,
        seen: Tensor,
        activation: Activation,
        feedback: _Feedback,
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


def _effective_goals(
    observation: Observation, default: Goals
) -> tuple[Goals, Bool[Tensor, "*batch"] | bool]:
    """Goals of this step, and whether the target is known: one that is NaN is not."""
    goals = default if observation.goals is None else observation.goals
    target = observation.target
    if target is None:
        return goals, True
    known = target.isfinite().all(-1)
    target = torch.where(known.unsqueeze(-1), target, goals.vision.target)
    return goals.aimed_at(target), known


def _either(a: Tensor | None, b: Tensor | None) -> Tensor | None:
    """Whether one of two optional conditions holds."""
    if a is None or b is None:
        return b if a is None else a
    return a | b


def _trusted_position(
    state: ControllerState, observation: Observation
) -> tuple[Tensor, Bool[Tensor, "*batch"]]:
    """Measured joint position, or the expected one where that is NaN or stale."""
    q = observation.joint_position
    stale = ~q.isfinite().all(-1)
    if observation.joint_state_stale is not None:
        stale = stale | observation.joint_state_stale
    return torch.where(stale.unsqueeze(-1), state.safety.position, q), stale
