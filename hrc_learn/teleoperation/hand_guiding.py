"""Guide an arm by hand: pulls at the links become null-space input d, a held end effector
follows the hand, and several inputs are combined and filtered.

This is the mixed interface of the paper, with gizmos (handles that a person drags) on joints
and end effector. In the paper, the displacement of a joint's gizmo commands a proportional
velocity, which the pseudo-inverse of the joint's Jacobian maps to the joints (section VII; the
mapping "pinv"). By default, this module instead takes the displacement as a force, which the
transposed Jacobian maps to the joints (the mapping "transpose"). The gizmo of the end effector
requests a velocity of the end effector.
"""

from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float

from hrc_learn.controller import SafetyConfig, SafetyFilter, SafetyState
from hrc_learn.controller.null_space_motion import fraction_in_null_space, fraction_kept
from hrc_learn.controller.resolved_rate import resolved_rate
from hrc_learn.geometry import Pose, quaternion
from hrc_learn.geometry.numerics import check_positive, null_projection
from hrc_learn.kinematics import SerialChain, coarse_orientation
from hrc_learn.protocols import Arm, ArmState, Feedback, Human, HumanInput
from hrc_learn.regions import PositionRegion
from hrc_learn.skills.step_report import PersonFeedback, filter_hindrance

ForceMapping = Literal["transpose", "pinv"]
DEFAULT_MAPPING: ForceMapping = "transpose"
"""Default mapping of a pull: the pull is a force. After projection into the null space, the
paper's pseudo-inverse moves the elbow about a third as fast as this force. For 6 to 23 % of the
pull directions, it moves the elbow against the pull (benchmarks/bench_pull_mapping.py).
"""


@dataclass(frozen=True, kw_only=True)
class InteractionForceConfig:
    """Gains of gizmo displacements, and bounds of their effect."""

    mapping: ForceMapping = DEFAULT_MAPPING
    """Effect of a joint's gizmo: "transpose" is a spring between joint and gizmo, and never
    moves the joint against the pull; "pinv", the paper's mapping, commands a velocity.
    """
    rate: float = 2.0
    """Speed per displacement [1/s]."""
    speed: float = 0.25
    """Largest speed that a gizmo requests [m/s]."""
    stiffness: float = 150.0
    """Force per displacement [N/m], if a gizmo is a spring."""
    max_force: float = 45.0
    """Largest force [N]."""
    damping: float = 3.0
    """c_d of the mapping "pinv": null-space input per joint velocity [N m s/rad]."""
    max_nullspace_input: float = 20.0
    """Bound on the null-space input d of each joint [N m]; d is scaled as a whole."""
    turn_rate: float = 4.0
    """Decay rate of the end effector's orientation error [1/s]."""
    turn_speed: float = 0.8
    """Largest angular speed of the end effector [rad/s]."""
    level_at: float = 0.6
    """Distance to the right of the base at which the end effector is level [m]. `hrc page` sets
    it to that of the arm's work cell.
    """

    __post_init__ = check_positive


# Floor of divisors, against a division by zero; far below any length that matters.
TINY = 1e-12


def capped(vector: Float[np.ndarray, " n"], most: float) -> Float[np.ndarray, " n"]:
    """The vector, shortened to a length of `most` if it is longer."""
    return vector * min(1.0, most / max(float(np.linalg.norm(vector)), TINY))


def bounded(vector: Float[np.ndarray, " n"], most: float) -> Float[np.ndarray, " n"]:
    """The vector, scaled as a whole so that no component exceeds `most`."""
    return vector * min(1.0, most / max(float(np.abs(vector).max()), TINY))


def force_to_nullspace_input(
    chain: SerialChain,
    joint_position: Float[np.ndarray, " joints"],
    joint: int,
    force: Float[np.ndarray, "3"],
    config: InteractionForceConfig | None = None,
    point: Float[np.ndarray, "3"] | None = None,
) -> Float[np.ndarray, " joints"]:
    """Null-space input d from a force at a joint, or at the link that it moves.

        d = J^T f         ("transpose")
        d = c_d J^+ v(f)  ("pinv", the paper's section VII)

    with the Jacobian J of the pulled point. With "transpose", this point never moves against
    the pull, not even after the projection into the null space of the task. With the paper's
    mapping, it can.

    Args:
        chain: The arm.
        joint_position: Joint positions [rad].
        joint: Index of the pulled joint, from 1.
        force: Force in the base frame [N]; with "pinv", it stands for the velocity
            `rate / stiffness * force`, capped at `speed`.
        config: Mapping of the force to the joints; None: the defaults.
        point: Point at which the link is pulled, in the base frame [m]; the joint's origin if
            None.

    Raises:
        ValueError: If the arm has no such joint.
    """
    config = config or InteractionForceConfig()
    q = torch.as_tensor(joint_position, dtype=torch.float64)
    J, angular = chain.joint_jacobian(q, joint).split(3)
    if point is not None:
        lever = torch.as_tensor(point) - chain.link_poses(q).position[joint - 1]
        J = J + torch.linalg.cross(angular, lever[:, None], dim=0)
    if config.mapping == "transpose":
        return (J.mT @ torch.as_tensor(force, dtype=torch.float64)).numpy()
    # The first joints of an arm cannot move their own origin in all directions.
    inverse = torch.linalg.pinv(J, rtol=1e-6).numpy()
    velocity = capped(config.rate / config.stiffness * force, config.speed)
    return config.damping * inverse @ velocity


def gizmo_nullspace_input(
    chain: SerialChain,
    joint_position: Float[np.ndarray, " joints"],
    joint: int,
    point: Float[np.ndarray, "3"] | None,
    displacement: Float[np.ndarray, "3"],
    config: InteractionForceConfig,
) -> Float[np.ndarray, " joints"]:
    """Null-space input d from a gizmo on the arm, bounded with its direction kept.

        d = J^T f,      f = stiffness * displacement ("transpose")
        d = c_d J^+ v,  v = rate * displacement      ("pinv", the paper's)

    Args:
        chain: The arm.
        joint_position: Joint positions [rad].
        joint: The joint that moves the link, counted from 1.
        point: Point at which the link is held, in the base frame [m]; the joint's origin if
            None.
        displacement: Vector from this point to the gizmo, in the base frame [m].
        config: Gains and bounds.

    Raises:
        ValueError: If the arm has no such joint.
    """
    force = config.stiffness * displacement
    if config.mapping == "transpose":
        force = capped(force, config.max_force)
    d = force_to_nullspace_input(chain, joint_position, joint, force, config, point)
    return bounded(d, config.max_nullspace_input)


def guiding_twist(
    pose: Pose,
    velocity: Float[np.ndarray, "3"],
    config: InteractionForceConfig,
    turn: Float[torch.Tensor, "4"] | None = None,
) -> Float[np.ndarray, "6"]:
    """Twist of a hand-guided end effector, in the base frame.

    The end effector turns to the orientation that a rule (`coarse_orientation`) gives for its
    position.

    Args:
        pose: Pose of the end effector.
        velocity: Requested velocity [m/s]; capped, with its direction kept.
        config: Gains and largest speeds.
        turn: Rotation added to the rule's orientation (wxyz); None: no rotation.
    """
    orientation = coarse_orientation(pose.position, config.level_at)
    if turn is not None:
        orientation = quaternion.multiply(turn, orientation)
    error = quaternion.multiply(orientation, quaternion.conjugate(pose.orientation))
    angular = capped(config.turn_rate * quaternion.log(error).numpy(), config.turn_speed)
    return np.concatenate([capped(velocity, config.speed), angular])


@dataclass(frozen=True, kw_only=True)
class HandGuidingConfig:
    """Gains and limits of a hand-guided arm."""

    dt: float = 0.01
    """Control step [s]."""
    damping: float = 3.0
    """c_d: null-space input per null-space velocity [N m s/rad]."""
    safety: SafetyConfig = field(default_factory=SafetyConfig)
    """Settings of the safety filter, which enforces the limits of the arm's chain."""

    __post_init__ = check_positive


ATTRACTION = 0.12
"""Largest speed towards a region or a target [m/s]."""
_APPROACH_RATE = 1.5
"""Decay rate of the distance to a target or a posture [1/s]."""
RETURN_SPEED = 0.3
"""Largest speed of a joint that moves to a posture [rad/s]."""
_ARRIVED = 1e-3
"""Distance at which a joint has reached its target [rad]: ten times the noise of an encoder."""

Frame = dict[str, np.ndarray | float | bool]
"""Columns of one recorded step, as `DatasetWriter.add_frame` takes them."""


@dataclass(frozen=True, kw_only=True, eq=False)
class GuidedStep:
    """One step of a hand-guided arm."""

    state: ArmState
    human_input: HumanInput
    pose: Pose
    """Pose of the end effector."""
    command: Float[np.ndarray, " joints"]
    """Joint velocity sent [rad/s]."""

    def frame(self) -> Frame:
        """Recorded quantities of the step."""
        return {
            "time": self.state.time,
            "joint_position": self.state.joint_position,
            "joint_velocity": self.state.joint_velocity,
            "position": self.pose.position.numpy(),
            "orientation": self.pose.orientation.numpy(),
            "gripper": self.state.gripper_width,
            "human_effort": self.human_input.effort(len(self.command)),
            "command_velocity": self.command,
        }


class HandGuidedArm:
    """Executes a person's input at each step, within the safety filter's limits.

    The joint velocity is J^+ v + N c_d^-1 d (paper, eq. globalControl), with the Jacobian J of
    the end effector, the null-space projection N, the damping c_d and the null-space input d.
    Here, the end-effector motion v comes from the person instead of the camera. If the person
    requests no motion, v is the attraction to the drawn region and target.

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
        """Connect to the arm, which must be at rest.

        Args:
            chain: Kinematics of the arm.
            arm: Driver of the arm.
            human: Person that guides the arm.
            config: Gains and limits.
        """
        self.config = config or HandGuidingConfig()
        self._chain, self._arm, self._human = chain, arm, human
        self._filter = SafetyFilter(chain, self.config.safety)
        self._feedback = PersonFeedback(chain)
        self._posture: Float[torch.Tensor, " joints"] | None = None
        self.safety: SafetyState
        self.restart()

    def restart(self) -> None:
        """Restart from the measured motion of the arm."""
        state = self._arm.read()
        q, v = map(torch.from_numpy, (state.joint_position, state.joint_velocity))
        self.safety = self._filter.initial_state(q, v)

    def stop(self) -> None:
        """Bring the arm to rest."""
        self._arm.command(np.zeros(len(self._chain.joint_names)))

    def move_to(self, joint_position: Float[torch.Tensor, " joints"]) -> None:
        """Move to a posture in a straight line in joint space, until the person moves the arm.

        Args:
            joint_position: Joint positions of the posture [rad].
        """
        self._posture = joint_position

    def step(self) -> GuidedStep:
        """Read the arm and the human input, then command the arm. The caller lets `dt` pass."""
        state = self._arm.read()
        human_input = self._human.read(state)
        q = torch.from_numpy(state.joint_position)
        pose, J = self._chain.forward_and_jacobian(q)
        twist = torch.from_numpy(human_input.twist.copy())
        # Direct motion overrides the attraction: the person may leave a region they have drawn.
        if not human_input.twist.any():
            twist[:3] = self._attraction(human_input, pose.position)
        effort = human_input.effort(len(q))
        null_velocity = torch.from_numpy(effort / self.config.damping)
        task, null = resolved_rate(J, twist, null_velocity)
        desired = task + null
        if (velocity := self._posture_velocity(q, human_input)) is not None:
            desired = velocity
        velocity, self.safety, report = self._filter.step(
            self.safety, q, desired, self.config.dt, jacobian=J
        )
        command = velocity.numpy()
        self._arm.command(command)
        pushed = bool(human_input.twist.any() or effort.any())
        if effort.any():
            projected = null_projection(J, null_velocity)
            in_null_space = float(fraction_in_null_space(null_velocity, projected))
            self._feedback.note("task", in_null_space)
        if (cause := filter_hindrance(report)) is not None:
            self._feedback.note(cause, float(fraction_kept(desired, velocity)))
        self._human.tell(self._feedback.end_step(state, J, pushed=pushed))
        return GuidedStep(state=state, human_input=human_input, pose=pose, command=command)

    def _posture_velocity(
        self, q: Float[torch.Tensor, " joints"], human_input: HumanInput
    ) -> Float[torch.Tensor, " joints"] | None:
        """Joint velocity towards the posture of `move_to` [rad/s]; None: no posture is set."""
        if human_input.twist.any() or human_input.effort(len(q)).any():
            self._posture = None
        if self._posture is None:
            return None
        ahead = self._posture - q
        if (farthest := float(ahead.abs().max())) < _ARRIVED:
            self._posture = None
        # All joints slow down together, which keeps the line straight.
        return min(_APPROACH_RATE, RETURN_SPEED / max(farthest, TINY)) * ahead

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
            velocity = velocity + _APPROACH_RATE * towards
        # Shortened as a whole: the direction is kept.
        return velocity / max(1.0, float(velocity.norm()) / ATTRACTION)


class CombinedInput(Human):
    """Combines several sources, such as the haptic device and headset of the paper's interface.

    Null-space inputs and twists add up. Gripper, region, target and turn come from the first
    source that sets them. All requests are passed on, and any source can pause or stop.
    """

    def __init__(self, *sources: Human):
        """Combine sources."""
        self._sources = sources

    def read(self, state: ArmState) -> HumanInput:
        """Combined input of all sources."""
        inputs = [source.read(state) for source in self._sources]
        joints = len(state.joint_position)

        def first(name: str) -> Any:
            found = (getattr(one, name) for one in inputs)
            return next((value for value in found if value is not None), None)

        return HumanInput(
            nullspace_input=np.sum([one.effort(joints) for one in inputs], axis=0),
            twist=np.sum([one.twist for one in inputs], axis=0),
            requests=tuple(request for one in inputs for request in one.requests),
            pause=any(one.pause for one in inputs),
            stop=next((one.stop for one in inputs if one.stop), ""),
            **{name: first(name) for name in ("gripper", "region", "target", "turn")},
        )

    def tell(self, feedback: Feedback) -> None:
        """Pass the feedback to all sources."""
        for source in self._sources:
            source.tell(feedback)


_ELBOW = 4
"""Joint whose origin a `LinkGuide` pulls, counted from 1."""


class LinkGuide(Human):
    """Pulls a link in the null space with a device that otherwise guides the end effector.

    The force on the link is proportional to the speed that the device requests: the largest
    force at the largest speed. The end effector does not move.
    """

    def __init__(self, human: Human, chain: SerialChain):
        """Use a device.

        Args:
            human: The device.
            chain: The arm.
        """
        self._human, self._chain, self._config = human, chain, InteractionForceConfig()

    def read(self, state: ArmState) -> HumanInput:
        """Present null-space input."""
        asked, config = self._human.read(state), self._config
        # Displacement of a gizmo: the largest force at the largest speed of the device.
        displacement = config.max_force / config.stiffness / config.speed * asked.twist[:3]
        d = gizmo_nullspace_input(
            self._chain, state.joint_position, _ELBOW, None, displacement, config
        )
        return replace(
            asked,
            nullspace_input=bounded(asked.effort(len(d)) + d, config.max_nullspace_input),
            twist=np.zeros(6),
        )

    def tell(self, feedback: Feedback) -> None:
        """Pass the feedback to the device."""
        self._human.tell(feedback)


@dataclass(frozen=True, kw_only=True)
class InputFilterConfig:
    """Bounds on the acceleration of the end effector."""

    linear: float = 1.5
    """Linear bound [m/s^2]: from rest to a gizmo's full speed in a sixth of a second."""
    angular: float = 5.0
    """Angular bound [rad/s^2]."""

    __post_init__ = check_positive


class InputFilter(Human):
    """Bounds the acceleration of the end effector in human input.

    A pressed key requests full speed immediately, and a released gizmo requests rest. Without
    the filter, the arm and motions learned from it would be jerky.
    """

    def __init__(self, human: Human, config: InputFilterConfig | None = None):
        """Start at rest.

        Args:
            human: Source of the input.
            config: Bounds.
        """
        self._human, self._config = human, config or InputFilterConfig()
        # The first reading has no predecessor: an infinite time makes its dt zero below.
        self._twist, self._time = np.zeros(6), np.inf

    def read(self, state: ArmState) -> HumanInput:
        """Present input, filtered."""
        human_input, config = self._human.read(state), self._config
        dt = max(state.time - self._time, 0.0)
        change = human_input.twist - self._twist
        self._time = state.time
        self._twist = self._twist + np.concatenate(
            [capped(change[:3], config.linear * dt), capped(change[3:], config.angular * dt)]
        )
        return replace(human_input, twist=self._twist)

    def tell(self, feedback: Feedback) -> None:
        """Pass the feedback to the source."""
        self._human.tell(feedback)
