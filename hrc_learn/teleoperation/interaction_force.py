"""Interaction forces of a person on the arm as null-space input d: gizmos, pulls, scripts.

The paper's mixed interface: the displacement of a joint's gizmo is a velocity in proportion,
mapped to the joints by the pseudo-inverse of that joint's Jacobian (section VII); that of the
end effector's gizmo guides the end effector.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float

from hrc_learn.geometry import Pose, quaternion
from hrc_learn.kinematics import SerialChain
from hrc_learn.protocols import ArmState, HumanInput

ForceMapping = Literal["transpose", "pinv"]


def force_to_nullspace_input(
    chain: SerialChain,
    joint_position: Float[np.ndarray, " joints"],
    joint: int,
    pull: Float[np.ndarray, "3"],
    mapping: ForceMapping = "transpose",
    point: Float[np.ndarray, "3"] | None = None,
) -> Float[np.ndarray, " joints"]:
    """Null-space input d from a pull at a joint, or at the link that it moves.

    With "transpose", d = J_joint^T f: the torques of a force, which never move the joint
    against the pull, not even after the projection into the null space of the task. The
    paper's "pinv", d = J_joint^+ v, can (its section VII).

    Args:
        chain: The arm.
        joint_position: Joint positions [rad].
        joint: Which joint is pulled, counted from 1.
        pull: Force [N] or velocity [m/s], in the base frame.
        mapping: How it acts on the joints.
        point: Where the link is pulled, in the base frame [m]; the joint's origin if None.

    Raises:
        ValueError: If the arm has no such joint.
    """
    q = torch.as_tensor(joint_position, dtype=torch.float64)
    linear, angular = chain.joint_jacobian(q, joint).split(3)
    J = linear
    if point is not None:
        lever = torch.as_tensor(point) - chain.link_poses(q).position[joint - 1]
        J = linear + torch.linalg.cross(angular, lever[:, None], dim=0)
    f = torch.as_tensor(pull, dtype=torch.float64)
    if mapping == "transpose":
        return (J.mT @ f).numpy()
    # The first joints of an arm cannot move their own origin in all directions.
    return (torch.linalg.pinv(J, rtol=1e-6) @ f).numpy()


@dataclass(frozen=True, kw_only=True)
class ScriptedForce:
    """A pull at a joint towards a point during an interval, with soft start and end."""

    start: float
    """[s]"""
    duration: float
    """[s]"""
    towards: tuple[float, float, float]
    """Where the person's hand is, in the base frame [m]."""
    stiffness: float = 100.0
    """Force per distance between the joint and the person's hand [N/m]."""
    max_force: float = 25.0
    """Largest force [N]."""
    joint: int = 4
    """Which joint is pulled, counted from 1."""
    ramp: float = 0.4
    """Time to full strength, and back to none [s]."""

    @property
    def end(self) -> float:
        """[s]"""
        return self.start + self.duration

    def strength(self, time: float) -> float:
        """Fraction of full strength at a time, 0 to 1."""
        edge = min(time - self.start, self.end - time) / self.ramp
        s = min(max(edge, 0.0), 1.0)
        # Smoothstep: the force starts and ends without a jump of its rate.
        return s * s * (3.0 - 2.0 * s)

    def force(self, time: float, origin: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
        """Force at a time on a joint whose origin is there now [N]."""
        pull = self.stiffness * (np.array(self.towards) - origin)
        size = float(np.linalg.norm(pull))
        return pull * self.strength(time) * min(1.0, self.max_force / max(size, _TINY))


class ScriptedPerturbation:
    """A person who pulls at the arm at given times, and does nothing else."""

    def __init__(
        self, chain: SerialChain, forces: Sequence[ScriptedForce], begin: float | None = 0.0
    ):
        """Prepare the script.

        Args:
            chain: The arm.
            forces: When and where it is pulled.
            begin: Time from which their intervals count [s]; None: once `begin` is called.
        """
        self._chain = chain
        self.forces = tuple(forces)
        self._begin = begin

    def begin(self, time: float) -> None:
        """Start the script now [s]."""
        self._begin = time

    def read(self, state: ArmState) -> HumanInput:
        """The null-space input of all forces that act now."""
        d = np.zeros(len(self._chain.joint_names))
        if self._begin is None:
            return HumanInput(nullspace_input=d, twist=np.zeros(6))
        time = state.time - self._begin
        active = [force for force in self.forces if force.strength(time) > 0.0]
        if active:
            q = torch.from_numpy(state.joint_position)
            origins = self._chain.link_poses(q).position.numpy()
            for scripted in active:
                force = scripted.force(time, origins[scripted.joint - 1])
                d += force_to_nullspace_input(
                    self._chain, state.joint_position, scripted.joint, force
                )
        return HumanInput(nullspace_input=d, twist=np.zeros(6))


@dataclass(frozen=True, kw_only=True)
class InteractionForceConfig:
    """How strongly the displacement of a gizmo acts, and what bounds it."""

    mapping: ForceMapping = "pinv"
    """How a joint's gizmo acts: "pinv", the paper's, asks for a velocity; "transpose" is a
    spring between joint and gizmo, and never moves the joint against the pull."""
    rate: float = 2.0
    """Speed per displacement [1/s]."""
    speed: float = 0.25
    """Largest speed that a gizmo asks for [m/s]."""
    stiffness: float = 150.0
    """Force per displacement [N/m], where a gizmo is a spring."""
    max_force: float = 45.0
    """Largest force [N]."""
    damping: float = 3.0
    """c_d: null-space input per velocity [N m s/rad]."""
    max_nullspace_input: float = 20.0
    """Bound on d of each joint; the direction is kept [N m]."""
    turn_rate: float = 4.0
    """Decay rate of the end effector's orientation error [1/s]."""
    turn_speed: float = 0.8
    """Largest angular speed of the end effector [rad/s]."""

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if isinstance(value, float | int) and not value > 0:
                raise ValueError(f"{name} must be positive, but is {value}.")


# The floor only keeps a division by zero out; it is far below any length that matters.
_TINY = 1e-12


def capped(vector: Float[np.ndarray, " n"], most: float) -> Float[np.ndarray, " n"]:
    """The vector, shortened to a length of `most` where it is longer."""
    return vector * min(1.0, most / max(float(np.linalg.norm(vector)), _TINY))


def bounded(vector: Float[np.ndarray, " n"], most: float) -> Float[np.ndarray, " n"]:
    """The vector, scaled as a whole so that no component exceeds `most`."""
    return vector * min(1.0, most / max(float(np.abs(vector).max()), _TINY))


def gizmo_nullspace_input(
    chain: SerialChain,
    joint_position: Float[np.ndarray, " joints"],
    joint: int,
    point: Float[np.ndarray, "3"],
    displacement: Float[np.ndarray, "3"],
    config: InteractionForceConfig,
) -> Float[np.ndarray, " joints"]:
    """Null-space input d from a gizmo on the arm.

        d = c_d J^+ v,  v = rate * displacement      ("pinv", the paper's)
        d = J^T f,      f = stiffness * displacement ("transpose")

    J is that of the point by which the link is held. v, f and d are bounded with their
    direction kept.

    Args:
        chain: The arm.
        joint_position: Joint positions [rad].
        joint: The joint that moves the link, counted from 1.
        point: Where the link is held, in the base frame [m].
        displacement: From there to the gizmo, in the base frame [m].
        config: How strongly it acts.

    Raises:
        ValueError: If the arm has no such joint.
    """
    if config.mapping == "pinv":
        pull = config.damping * capped(config.rate * displacement, config.speed)
    else:
        pull = capped(config.stiffness * displacement, config.max_force)
    d = force_to_nullspace_input(chain, joint_position, joint, pull, config.mapping, point)
    return bounded(d, config.max_nullspace_input)


def guiding_twist(
    pose: Pose,
    velocity: Float[np.ndarray, "3"],
    orientation: Float[torch.Tensor, "4"] | None,
    config: InteractionForceConfig,
) -> Float[np.ndarray, "6"]:
    """Twist of a hand-guided end effector with a velocity, turned towards an orientation.

    Args:
        pose: Of the end effector.
        velocity: Asked for [m/s]; capped with its direction kept.
        orientation: To turn to (wxyz), such as the coarse rule's; None: no turn.
        config: Speeds.
    """
    angular = np.zeros(3)
    if orientation is not None:
        turn = quaternion.multiply(orientation, quaternion.conjugate(pose.orientation))
        angular = capped(config.turn_rate * quaternion.log(turn).numpy(), config.turn_speed)
    return np.concatenate([capped(velocity, config.speed), angular])
