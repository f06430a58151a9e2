"""Control step that passes a wanted joint velocity through the safety filter.

Its interface is that of `AdaptiveController`, so it is exported and run in the same way
(`hrc_learn.deploy`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

from jaxtyping import Bool, Float
from torch import Tensor, nn

from hrc_learn.controller.safety_filter import SafetyFilter
from hrc_learn.controller.safety_state import SafetyConfig, SafetyReport, SafetyState
from hrc_learn.kinematics import SerialChain
from hrc_learn.pytree import pytree


@pytree
@dataclass(frozen=True, kw_only=True)
class WantedVelocity:
    """Observation of a velocity step."""

    joint_position: Float[Tensor, "*batch n"]
    """Measured joint positions [rad]."""
    joint_velocity: Float[Tensor, "*batch n"]
    """Wanted joint velocities [rad/s]."""
    stop: Bool[Tensor, "*batch"]
    """True to brake to rest, whatever is wanted."""


@pytree
@dataclass(frozen=True, kw_only=True)
class FilteredVelocity:
    """Command of a velocity step."""

    joint_velocity: Float[Tensor, "*batch n"]
    """Joint velocities to send [rad/s]."""
    safety: SafetyReport
    """Interventions of the safety filter."""


@pytree
@dataclass(frozen=True, kw_only=True)
class VelocityStepState:
    """State of a velocity step."""

    safety: SafetyState
    """State of the safety filter."""


@final
class VelocityStep(nn.Module):
    """Joint velocities within the limits of an arm and a cap on its tool speed.

    Attributes:
        chain: Kinematics and limits of the arm.
    """

    def __init__(self, chain: SerialChain, *, dt: float, config: SafetyConfig | None = None):
        """Prepare the filter.

        Args:
            chain: Kinematics and limits of the arm.
            dt: Time between two steps [s].
            config: Settings of the filter.

        Raises:
            ValueError: The filter cannot guarantee the limits at this step.
        """
        super().__init__()
        self.chain, self.dt = chain, dt
        self.safety = SafetyFilter(chain.limits, config)
        if not 0 < dt <= self.safety.config.longest_step:
            raise ValueError(
                f"dt must be in (0, {self.safety.config.longest_step:g}] s, but is {dt:g}"
            )

    def initial_state(
        self,
        joint_position: Float[Tensor, "*batch n"],
        joint_velocity: Float[Tensor, "*batch n"] | None = None,
        joint_acceleration: Float[Tensor, "*batch n"] | None = None,
    ) -> VelocityStepState:
        """State of an arm at rest, or in motion, see `SafetyFilter.initial_state`."""
        return VelocityStepState(
            safety=self.safety.initial_state(joint_position, joint_velocity, joint_acceleration)
        )

    def step(
        self, state: VelocityStepState, observation: WantedVelocity
    ) -> tuple[FilteredVelocity, VelocityStepState]:
        """Take one step."""
        _, jacobian = self.chain.transform_and_jacobian(observation.joint_position)
        velocity, safety, report = self.safety.step(
            state.safety,
            observation.joint_position,
            observation.joint_velocity,
            self.dt,
            jacobian=jacobian,
            stop=observation.stop,
        )
        command = FilteredVelocity(joint_velocity=velocity, safety=report)
        return command, VelocityStepState(safety=safety)
