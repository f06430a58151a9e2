"""An arm that a person leads: the hand by its motion, the body by pulls, both by regions."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from hrc_learn.controller import SafetyFilter, SafetyState
from hrc_learn.geometry import Pose
from hrc_learn.kinematics import SerialChain
from hrc_learn.protocols import Arm, ArmState, DrawnRegion, Human, HumanInput
from hrc_learn.regions import PositionRegion
from hrc_learn.skills.cartesian_motion import resolved_rate


@dataclass(frozen=True, kw_only=True)
class LedArmConfig:
    """How the arm follows."""

    dt: float = 0.01
    """Control step [s]."""
    damping: float = 3.0
    """c_d [N m s/rad]."""
    attraction: float = 0.12
    """Fastest that a region or a target draws the hand [m/s]."""
    approach_rate: float = 1.5
    """How fast the distance to a target decays [1/s]."""

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not value > 0:
                raise ValueError(f"{name} must be positive, but is {value}.")


Frame = dict[str, np.ndarray | float | bool]
"""Columns of one recorded instant, as `DatasetWriter.add_frame` takes them."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Instant:
    """One step of an arm that is led."""

    state: ArmState
    asked: HumanInput
    pose: Pose
    """Of the hand."""
    command: Float[np.ndarray, " joints"]
    """Joint velocity sent [rad/s]."""

    def frame(self) -> Frame:
        """What is recorded of it."""
        return {
            "time": self.state.time,
            "joint_position": self.state.joint_position,
            "joint_velocity": self.state.joint_velocity,
            "position": self.pose.position.numpy(),
            "orientation": self.pose.orientation.numpy(),
            "gripper": self.state.gripper_width,
            "human_effort": self.asked.effort,
            "command_velocity": self.command,
        }


class LedArm:
    """Does at each step what a person asks, as far as the safety filter lets it.

    u = J^+ (v + attraction) + N c_d^-1 d: the law of the paper (eq. globalControl) with the
    person's own motion v of the hand in place of the camera's.

    Attributes:
        safety: State of the safety filter, with its counts of interventions.
    """

    def __init__(
        self, chain: SerialChain, arm: Arm, human: Human, config: LedArmConfig | None = None
    ):
        """Take hold of the arm at rest.

        Args:
            chain: Its kinematics.
            arm: Its driver.
            human: Who leads it.
            config: How it follows.
        """
        self.config = config or LedArmConfig()
        self._chain, self._arm, self._human = chain, arm, human
        self._filter = SafetyFilter(chain.limits)
        self.safety: SafetyState
        self.restart()

    def restart(self) -> None:
        """Begin anew where the arm is, at rest."""
        q = torch.from_numpy(self._arm.read().joint_position)
        self.safety = self._filter.initial_state(q)

    def step(self) -> Instant:
        """Read, ask, command. The caller lets `dt` pass."""
        state = self._arm.read()
        asked = self._human.read(state)
        q = torch.from_numpy(state.joint_position)
        pose, J = self._chain.forward_and_jacobian(q)
        twist = torch.from_numpy(asked.twist.copy())
        # A hand that leads knows better than the region it has drawn.
        if not asked.twist.any():
            twist[:3] = self._attraction(asked, pose.position)
        wish = torch.from_numpy(asked.effort / self.config.damping)
        velocity, self.safety, _ = self._filter.step(
            self.safety, q, resolved_rate(J, twist, wish), self.config.dt, jacobian=J
        )
        command = velocity.numpy()
        self._arm.command(command)
        return Instant(state=state, asked=asked, pose=pose, command=command)

    def _attraction(
        self, asked: HumanInput, position: Float[torch.Tensor, "3"]
    ) -> Float[torch.Tensor, "3"]:
        """Velocity towards the region and the target that the person has drawn [m/s]."""
        pull = torch.zeros_like(position)
        if asked.region is not None:
            pull = _into(asked.region, position)
        if asked.target is not None:
            towards = position.new_tensor(asked.target) - position
            pull = pull + self.config.approach_rate * towards
        return pull / max(1.0, float(pull.norm()) / self.config.attraction)


def _into(region: DrawnRegion, position: Float[torch.Tensor, "3"]) -> Float[torch.Tensor, "3"]:
    """Velocity that takes a point into a region; zero inside."""
    box = PositionRegion(
        centre=position.new_tensor(region.centre),
        half_size=position.new_tensor(region.half_size),
    )
    return -box.feedback(position)[1]
