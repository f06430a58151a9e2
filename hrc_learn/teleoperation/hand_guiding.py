"""Hand guiding: a person moves the end effector, pulls in the null space, and draws regions."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from hrc_learn.controller import SafetyFilter, SafetyState
from hrc_learn.geometry import Pose
from hrc_learn.kinematics import SerialChain
from hrc_learn.protocols import Arm, ArmState, Human, HumanInput
from hrc_learn.regions import PositionRegion
from hrc_learn.skills.cartesian_motion import resolved_rate


@dataclass(frozen=True, kw_only=True)
class HandGuidingConfig:
    """How the arm follows."""

    dt: float = 0.01
    """Control step [s]."""
    damping: float = 3.0
    """c_d [N m s/rad]."""
    attraction: float = 0.12
    """Largest speed towards a region or a target [m/s]."""
    approach_rate: float = 1.5
    """Decay rate of the distance to a target [1/s]."""

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not value > 0:
                raise ValueError(f"{name} must be positive, but is {value}.")


Frame = dict[str, np.ndarray | float | bool]
"""Columns of one recorded step, as `DatasetWriter.add_frame` takes them."""


@dataclass(frozen=True, kw_only=True, eq=False)
class GuidedStep:
    """One step of a hand-guided arm."""

    state: ArmState
    human_input: HumanInput
    pose: Pose
    """Of the end effector."""
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
            "human_effort": self.human_input.nullspace_input,
            "command_velocity": self.command,
        }


class HandGuidedArm:
    """Executes at each step what a person asks, within the safety filter's limits.

    u = J^+ (v + attraction) + N c_d^-1 d: the law of the paper (eq. globalControl) with the
    person's own end-effector motion v in place of the camera's.

    Attributes:
        safety: State of the safety filter, with its counts of interventions.
    """

    def __init__(
        self,
        chain: SerialChain,
        arm: Arm,
        human: Human,
        config: HandGuidingConfig | None = None,
    ):
        """Connect to the arm at rest.

        Args:
            chain: Its kinematics.
            arm: Its driver.
            human: Who guides it.
            config: How it follows.
        """
        self.config = config or HandGuidingConfig()
        self._chain, self._arm, self._human = chain, arm, human
        self._filter = SafetyFilter(chain.limits)
        self.safety: SafetyState
        self.restart()

    def restart(self) -> None:
        """Restart where the arm is, at rest."""
        q = torch.from_numpy(self._arm.read().joint_position)
        self.safety = self._filter.initial_state(q)

    def step(self) -> GuidedStep:
        """Read the arm and the human input, then command. The caller lets `dt` pass."""
        state = self._arm.read()
        human_input = self._human.read(state)
        q = torch.from_numpy(state.joint_position)
        pose, J = self._chain.forward_and_jacobian(q)
        twist = torch.from_numpy(human_input.twist.copy())
        # Direct motion overrides the attraction: the person may leave a region they have drawn.
        if not human_input.twist.any():
            twist[:3] = self._attraction(human_input, pose.position)
        null_velocity = torch.from_numpy(human_input.nullspace_input / self.config.damping)
        desired = resolved_rate(J, twist, null_velocity)
        velocity, self.safety, _ = self._filter.step(
            self.safety, q, desired, self.config.dt, jacobian=J
        )
        command = velocity.numpy()
        self._arm.command(command)
        return GuidedStep(state=state, human_input=human_input, pose=pose, command=command)

    def _attraction(
        self, human_input: HumanInput, position: Float[torch.Tensor, "3"]
    ) -> Float[torch.Tensor, "3"]:
        """Velocity towards the region and the target that the person has drawn [m/s]."""
        velocity = torch.zeros_like(position)
        if (region := human_input.region) is not None:
            box = PositionRegion(
                centre=position.new_tensor(region.centre),
                half_size=position.new_tensor(region.half_size),
            )
            velocity = -box.feedback(position)[1]  # zero inside
        if human_input.target is not None:
            towards = position.new_tensor(human_input.target) - position
            velocity = velocity + self.config.approach_rate * towards
        # Shortened as a whole: the direction is kept.
        return velocity / max(1.0, float(velocity.norm()) / self.config.attraction)
