"""From a handle that a person has dragged away from the arm to what the arm should do.

The paper's mixed interface: the displacement of a joint's handle is a velocity in proportion,
brought to the joints by the pseudo-inverse of that joint's Jacobian (section VII); that of
the hand's handle leads the end effector.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from ..geometry import Pose, quaternion
from ..kinematics import SerialChain
from .pull import PullMapping, pull_effort


@dataclass(frozen=True, kw_only=True)
class DragConfig:
    """How strongly a displacement acts, and what bounds it."""

    mapping: PullMapping = "pinv"
    """How a joint's handle acts: "pinv", the paper's, asks for a velocity; "transpose" is a
    spring between joint and handle, and never moves the joint against the pull."""
    rate: float = 2.0
    """Speed for each metre of displacement [1/s]."""
    speed: float = 0.25
    """Fastest that a handle asks for [m/s]."""
    stiffness: float = 150.0
    """Force for each metre of displacement [N/m], where a handle is a spring."""
    strongest: float = 45.0
    """Largest force [N]."""
    damping: float = 3.0
    """c_d: effort divided by it is velocity [N m s/rad]."""
    largest_effort: float = 20.0
    """Bound on the effort on each joint; the direction is kept [N m]."""
    turn_rate: float = 4.0
    """How fast an error of the hand's orientation is corrected [1/s]."""
    turn_speed: float = 0.8
    """Fastest turn of the hand [rad/s]."""

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if isinstance(value, float | int) and not value > 0:
                raise ValueError(f"{name} must be positive, but is {value}.")


def capped(vector: Float[np.ndarray, " n"], most: float) -> Float[np.ndarray, " n"]:
    """The vector, shortened to a length of `most` where it is longer."""
    return vector * min(1.0, most / max(float(np.linalg.norm(vector)), 1e-12))


def bounded(vector: Float[np.ndarray, " n"], most: float) -> Float[np.ndarray, " n"]:
    """The vector, scaled as a whole so that no component exceeds `most`."""
    return vector * min(1.0, most / max(float(np.abs(vector).max()), 1e-12))


def drag_effort(
    chain: SerialChain,
    joint_position: Float[np.ndarray, " joints"],
    joint: int,
    point: Float[np.ndarray, "3"],
    displacement: Float[np.ndarray, "3"],
    config: DragConfig,
) -> Float[np.ndarray, " joints"]:
    """Null-space effort d from a handle on the body of the arm.

        d = c_d J^+ v,  v = rate * displacement      ("pinv", the paper's)
        d = J^T f,      f = stiffness * displacement ("transpose")

    J is that of the point by which the link is held. v, f and d are bounded with their
    direction kept.

    Args:
        chain: The arm.
        joint_position: Joint positions [rad].
        joint: The joint that moves the link, counted from 1.
        point: Where the link is held, in the base frame [m].
        displacement: From there to the handle, in the base frame [m].
        config: How strongly it acts.

    Raises:
        ValueError: If the arm has no such joint.
    """
    if config.mapping == "pinv":
        pull = config.damping * capped(config.rate * displacement, config.speed)
    else:
        pull = capped(config.stiffness * displacement, config.strongest)
    effort = pull_effort(chain, joint_position, joint, pull, config.mapping, point)
    return bounded(effort, config.largest_effort)


def hand_twist(
    pose: Pose,
    velocity: Float[np.ndarray, "3"],
    orientation: Float[torch.Tensor, "4"] | None,
    config: DragConfig,
) -> Float[np.ndarray, "6"]:
    """Twist of a hand that is led with a velocity and turned towards an orientation.

    Args:
        pose: Of the hand.
        velocity: Asked for [m/s]; capped with its direction kept.
        orientation: To turn to (wxyz), such as the coarse rule's; None: no turn.
        config: Speeds.
    """
    angular = np.zeros(3)
    if orientation is not None:
        turn = quaternion.multiply(orientation, quaternion.conjugate(pose.orientation))
        angular = capped(config.turn_rate * quaternion.log(turn).numpy(), config.turn_speed)
    return np.concatenate([capped(velocity, config.speed), angular])
