"""The step of an arm that is told joint velocities: whatever is asked for, through the safety
filter, with the speed of the tool capped.

It steps as `AdaptiveController` does, so it is exported and run likewise (`hrc_learn.deploy`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

from jaxtyping import Bool, Float
from torch import Tensor, nn

from hrc_learn.controller.safety_filter import (
    SafetyConfig,
    SafetyFilter,
    SafetyReport,
    SafetyState,
)
from hrc_learn.kinematics import SerialChain
from hrc_learn.pytree import pytree


@pytree
@dataclass(frozen=True, kw_only=True)
class WantedVelocity:
    """What a step is given."""

    joint_position: Float[Tensor, "*batch n"]
    """Measured [rad]."""
    joint_velocity: Float[Tensor, "*batch n"]
    """Wanted [rad/s]."""
    stop: Bool[Tensor, "*batch"]
    """Whether to brake to rest whatever is wanted."""


@pytree
@dataclass(frozen=True, kw_only=True)
class FilteredVelocity:
    """What a step gives."""

    joint_velocity: Float[Tensor, "*batch n"]
    """To send [rad/s]."""
    safety: SafetyReport
    """What the filter did."""


@pytree
@dataclass(frozen=True, kw_only=True)
class VelocityStepState:
    """What a step remembers."""

    safety: SafetyState


@final
class VelocityStep(nn.Module):
    """A joint velocity that keeps the limits of an arm and of its tool's speed.

    Attributes:
        chain: The arm, which has the limits.
    """

    def __init__(self, chain: SerialChain, *, dt: float, config: SafetyConfig | None = None):
        """Take the limits of an arm.

        Args:
            chain: The arm.
            dt: Time between two steps [s].
            config: Of the filter.

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

    def initial_state(self, joint_position: Float[Tensor, "*batch n"]) -> VelocityStepState:
        """State of an arm at rest [rad]."""
        return VelocityStepState(safety=self.safety.initial_state(joint_position))

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
