"""What LeRobot calls the values of a Panda, and in which units it gets them.

Radians, metres and pixels; poses in the base frame as position and rotation vector. Names end
in `.pos` or `.vel` because lerobot-rollout hands on no others.
"""

from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float

from hrc_learn.geometry import Pose, quaternion
from hrc_learn.kinematics import gripper_down, panda
from hrc_learn.protocols import ArmState

JOINTS = tuple(f"{name}.pos" for name in panda.joint_names)
VELOCITIES = tuple(f"{name}.vel" for name in panda.joint_names)
HAND = tuple(f"ee.{axis}.pos" for axis in ("x", "y", "z", "wx", "wy", "wz"))
GRIPPER = "gripper.pos"
PIXELS = ("object.u.pos", "object.v.pos")

ActionSpace = Literal["joint", "ee"]
"""Positions of the joints, or of the hand; the gripper's opening in either case."""


def action_names(space: ActionSpace) -> tuple[str, ...]:
    """Names of an action's values, in order."""
    return (*(JOINTS if space == "joint" else HAND), GRIPPER)


DOWN = quaternion.log(gripper_down()).numpy()
"""Rotation vector of a hand that points down, by which those of others are told [rad]."""


def action_of(
    space: ActionSpace,
    joints: Float[np.ndarray, "7"],
    width: float,
    near: Float[np.ndarray, "3"] = DOWN,
) -> dict[str, float]:
    """The action that sends the joints somewhere, and the gripper to an opening.

    Args:
        space: Of the action.
        joints: Positions [rad].
        width: Opening [m].
        near: Rotation vector before, which this one goes on from [rad].
    """
    values = joints if space == "joint" else hand_vector(joints, near)
    return dict(zip(action_names(space), (*map(float, values), float(width)), strict=True))


def hand_vector(
    joints: Float[np.ndarray, "7"], near: Float[np.ndarray, "3"] = DOWN
) -> Float[np.ndarray, "6"]:
    """Position [m] and rotation vector [rad] of the hand.

    A hand that points down is half a turn from the base, where the shortest rotation vector
    jumps from one side to the other; `near` picks the side.
    """
    pose = panda.forward(torch.from_numpy(np.asarray(joints, dtype=float)))
    vector = pose.vector()
    pair = torch.stack([torch.from_numpy(np.array(near, dtype=float)), vector[3:]])
    return torch.cat([vector[:3], quaternion.unwrap_log(pair)[1]]).numpy()


def target_of(action: Mapping[str, Any]) -> tuple[Float[np.ndarray, "7"] | Pose, float]:
    """Read an action of either space; names it does not know are passed over.

    Returns:
        Positions of the joints [rad] or pose of the hand, and opening of the gripper [m], NaN
        where none is given.

    Raises:
        ValueError: Names are missing.
    """
    width = float(action.get(GRIPPER, np.nan))
    if all(name in action for name in HAND):
        vector = torch.tensor([float(action[name]) for name in HAND], dtype=torch.float64)
        return Pose.from_vector(vector), width
    missing = [name for name in JOINTS if name not in action]
    if missing:
        raise ValueError(
            f"an action for a Panda needs {', '.join(JOINTS)} or {', '.join(HAND)}, but lacks "
            f"{', '.join(missing)}."
        )
    return np.array([float(action[name]) for name in JOINTS]), width


def observed(
    state: ArmState, names: Sequence[str], near: Float[np.ndarray, "3"] = DOWN
) -> dict[str, float]:
    """Values of an arm's state by name.

    Args:
        state: Of the arm.
        names: Wanted, of those of this module but `PIXELS`.
        near: Rotation vector of the hand before [rad].
    """
    values = dict(zip(JOINTS, state.joint_position.tolist(), strict=True))
    values |= zip(VELOCITIES, state.joint_velocity.tolist(), strict=True)
    values[GRIPPER] = state.gripper_width
    if HAND[0] in names:
        values |= zip(HAND, hand_vector(state.joint_position, near).tolist(), strict=True)
    return {name: float(values[name]) for name in names}
