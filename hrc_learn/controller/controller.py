"""The vision-based adaptive controller with multiple regional feedback."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, final

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.utils import _pytree

from hrc_learn.controller.activation import Activation, HandOver
from hrc_learn.controller.config import ControllerConfig
from hrc_learn.controller.goals import Goals
from hrc_learn.controller.hold import Hold, measure_drift, planned_motion
from hrc_learn.controller.interface import Command, ControllerState, Observation
from hrc_learn.controller.resolution import cap_twist, fit_null_space, resolve
from hrc_learn.controller.safety import SafetyFilter
from hrc_learn.geometry import Pose
from hrc_learn.kinematics import SerialChain
from hrc_learn.regions import JointRegion

# A wish for the middle of the joint ranges too weak to be seen [1/s]. It gives the null space
# a direction where nothing else does, so that it can turn away to let the task through.
_CENTRING = 1e-6


class _Feedback(NamedTuple):
    """Regional feedback vectors and their combination."""

    xi_x: Tensor
    xi_r: Tensor
    s: Tensor
    image_jacobian: Tensor
    potential: Tensor


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
        estimator: nn.Module,
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
        caps = torch.tensor([config.linear_speed, config.angular_speed], dtype=torch.float64)
        self.register_buffer("caps", caps)

    caps: Tensor

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
        pose, J = self.chain.forward_and_jacobian(joint_position)
        still = torch.zeros_like(J[..., 0])
        return ControllerState(
            activation=self.hand_over.initial_state(joint_position),
            hold=Hold(drift=still, joint_position=joint_position, jacobian=J, planned=still),
            safety=self.safety.initial_state(joint_position, joint_velocity),
            estimator=self.estimator.initial_state(pose),
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
        goals = _effective_goals(observation, self.goals)
        q, stale = _trusted_position(state, observation)
        pose, J = self.chain.forward_and_jacobian(q)
        activation, seen, stop = self.hand_over.step(
            state.activation,
            observation.feature,
            observation.feature_visible & goals.vision_enabled,
            observation.dt,
            age=observation.feature_age,
        )
        feedback = self._feedback(state, goals, pose, activation)

        task_twist = cap_twist(-feedback.s, self.caps)
        d = observation.human_effort
        drift = self._drift(state, q, J, d)
        twist = task_twist if drift is None else task_twist + self.config.hold_rate * drift

        xi_q = self.joint_region.gradient(q)
        bounds = self.safety.velocity_bounds(q)
        u, null_velocity = self._joint_velocity(q, J, twist, d, xi_q, bounds)
        v, safety, report = self.safety.step(
            state.safety,
            q,
            u,
            observation.dt,
            jacobian=J,
            stop=stop,
            stale=stale,
            bounds=bounds,
        )
        command = Command(
            joint_velocity=v,
            twist=twist,
            null_velocity=null_velocity,
            xi_x=feedback.xi_x,
            xi_r=feedback.xi_r,
            xi_q=xi_q,
            s=feedback.s,
            image_jacobian=feedback.image_jacobian,
            weight_norm=self.estimator.weight_norm(state.estimator),
            vision_activation=activation.level,
            potential=feedback.potential,
            safety=report,
        )
        hold = state.hold
        if drift is not None:
            planned = planned_motion(task_twist, J, v, observation.dt)
            hold = Hold(drift=drift, joint_position=q, jacobian=J, planned=planned)
        estimator = self.estimator.update(
            state.estimator,
            pose=pose,
            feature=activation.feature,
            seen=seen,
            xi_x=feedback.xi_x,
            s=feedback.s,
            dt=observation.dt,
        )
        return command, ControllerState(
            activation=activation, hold=hold, safety=safety, estimator=estimator
        )

    def _feedback(
        self, state: ControllerState, goals: Goals, pose: Pose, activation: Activation
    ) -> _Feedback:
        """Regional feedback in image and Cartesian space."""
        P_t, xi_position = goals.position.feedback(pose.position)
        P_o, xi_orientation = goals.orientation.feedback(pose.orientation)
        P_v, xi_x = goals.vision.feedback(activation.feature)
        xi_x = activation.level.unsqueeze(-1) * xi_x
        xi_r = torch.cat([xi_position, xi_orientation], dim=-1)
        J_s = self.estimator.jacobian(state.estimator, pose)
        s = torch.linalg.vecdot(J_s, xi_x.unsqueeze(-1), dim=-2) + xi_r
        return _Feedback(xi_x, xi_r, s, J_s, P_t + P_o + activation.level * P_v)

    def _drift(
        self, state: ControllerState, q: Tensor, J: Tensor, d: Tensor | None
    ) -> Tensor | None:
        """Drift of the tool under human effort; None where no pose hold is asked for."""
        if d is None or self.config.hold_rate == 0:
            return None
        return measure_drift(state.hold, q, J, acting=(d != 0).any(-1))

    def _joint_velocity(
        self,
        q: Tensor,
        J: Tensor,
        twist: Tensor,
        d: Tensor | None,
        xi_q: Tensor,
        bounds: tuple[Tensor, Tensor],
    ) -> tuple[Tensor, Tensor]:
        """The law's joint velocity, and its part in the null space."""
        wish = (-xi_q if d is None else d - xi_q) / self.config.null_damping
        wish = torch.add(wish, q - self.joint_region.centre, alpha=-_CENTRING)
        task, null = resolve(J, twist, wish)
        if self.config.null_space_yields:
            null = fit_null_space(task, null, *bounds)
        return task + null, null


def _effective_goals(observation: Observation, default: Goals) -> Goals:
    goals = default if observation.goals is None else observation.goals
    return goals if observation.target is None else goals.aimed_at(observation.target)


def _trusted_position(
    state: ControllerState, observation: Observation
) -> tuple[Tensor, Bool[Tensor, "*batch"]]:
    """Measured joint position, or the expected one where that is NaN or stale."""
    q = observation.joint_position
    stale = (q * 0).sum(-1) != 0
    if observation.joint_state_stale is not None:
        stale = stale | observation.joint_state_stale
    return torch.where(stale.unsqueeze(-1), state.safety.position, q), stale
