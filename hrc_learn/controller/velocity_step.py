"""Control step that sends wanted joint velocities through the safety filter."""

from __future__ import annotations

from typing import NamedTuple, final

from jaxtyping import Bool, Float
from torch import Tensor, nn

from hrc_learn.controller.interface import SafetyConfig, SafetyReport, SafetyState
from hrc_learn.controller.safety_filter import SafetyFilter
from hrc_learn.geometry.numerics import matmul
from hrc_learn.kinematics import SerialChain
from hrc_learn.pytree import pytree


@pytree
class WantedVelocity:
    """Observation of a velocity step."""

    joint_position: Float[Tensor, "*batch n"]
    """Measured joint positions [rad]."""
    joint_velocity: Float[Tensor, "*batch n"]
    """Wanted joint velocities [rad/s]."""
    stop: Bool[Tensor, "*batch"]
    """True to brake to rest, whatever is wanted."""
    dt: float | Float[Tensor, ""]
    """Time until the next step [s]."""
    load: Float[Tensor, "*batch 3"] | None = None
    """Far end of a load in the frame of the tool centre point [m]. The cap on the tool's speed
    also applies to this point. None: no load."""


class FilteredVelocity(NamedTuple):
    """Command of a velocity step."""

    joint_velocity: Float[Tensor, "*batch n"]
    """Joint velocities to send [rad/s]."""
    safety: SafetyReport
    """Interventions of the safety filter."""


class VelocityStepState(NamedTuple):
    """State of a velocity step."""

    safety: SafetyState
    """State of the safety filter."""


@final
class VelocityStep(nn.Module):
    """Joint velocities within the limits of an arm and the speed cap of tool, elbow and load.

    Attributes:
        chain: Kinematics and limits of the arm.
    """

    def __init__(self, chain: SerialChain, config: SafetyConfig | None = None):
        """Prepare the filter.

        Args:
            chain: Kinematics and limits of the arm.
            config: Settings of the filter.
        """
        super().__init__()
        self.chain, self.safety = chain, SafetyFilter(chain, config)

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
        tool, jacobian = self.chain.transform_and_jacobian(observation.joint_position)
        load = observation.load
        if load is not None:
            load = matmul(tool[..., :3], load.unsqueeze(-1)).squeeze(-1)
        velocity, safety, report = self.safety.step(
            state.safety,
            observation.joint_position,
            observation.joint_velocity,
            observation.dt,
            jacobian=jacobian,
            load=load,
            stop=observation.stop,
        )
        command = FilteredVelocity(joint_velocity=velocity, safety=report)
        return command, VelocityStepState(safety=safety)
