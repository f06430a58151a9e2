"""Names and conversions of an arm's values in LeRobot's actions and observations.

Units are radians, metres and pixels; poses are in the base frame, as position and rotation
vector. Names end in `.pos` or `.vel` because lerobot-rollout passes on no others.
"""

from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float

from hrc_learn.geometry import Pose, quaternion
from hrc_learn.kinematics import SerialChain, gripper_down
from hrc_learn.protocols import ArmState

HAND = tuple(f"ee.{axis}.pos" for axis in ("x", "y", "z", "wx", "wy", "wz"))
GRIPPER = "gripper.pos"
PIXELS = ("object.u.pos", "object.v.pos")
MARKER = ("marker.u.pos", "marker.v.pos", "marker.seen.pos")
OBJECT = tuple(f"object.{axis}.pos" for axis in ("x", "y", "z", "wx", "wy", "wz"))

ActionSpace = Literal["joint", "ee"]
"""Joint positions, or pose of the end effector; each with the gripper's opening."""

DOWN = quaternion.log(gripper_down()).numpy()
"""Rotation vector of a gripper that points down [rad]. By default, the rotation vector nearest
to this one is chosen among those that describe the same orientation.
"""


class ArmValues:
    """Names of an arm's values, and conversions of actions and observations by name.

    Attributes:
        chain: Kinematics of the arm.
        joints: Names of the joints' positions [rad].
        velocities: Names of the joints' velocities [rad/s].
    """

    def __init__(self, chain: SerialChain):
        """Name the values after the joints of the arm."""
        self.chain = chain
        self.joints = tuple(f"{name}.pos" for name in chain.joint_names)
        self.velocities = tuple(f"{name}.vel" for name in chain.joint_names)

    def action_names(self, space: ActionSpace) -> tuple[str, ...]:
        """Names of an action's values, in the order of the action."""
        return (*(self.joints if space == "joint" else HAND), GRIPPER)

    def action_of(
        self,
        space: ActionSpace,
        joints: Float[np.ndarray, " joints"],
        width: float,
        near: Float[np.ndarray, "3"] = DOWN,
    ) -> dict[str, float]:
        """Action that sends the joints to positions and the gripper to an opening.

        Args:
            space: Action space.
            joints: Joint positions [rad].
            width: Opening of the gripper [m].
            near: Previous rotation vector; the new one is chosen near it [rad].
        """
        values = joints if space == "joint" else self.hand_vector(joints, near)
        names = self.action_names(space)
        return dict(zip(names, (*map(float, values), float(width)), strict=True))

    def hand_vector(
        self, joints: Float[np.ndarray, " joints"], near: Float[np.ndarray, "3"] = DOWN
    ) -> Float[np.ndarray, "6"]:
        """Position [m] and rotation vector [rad] of the end effector.

        The orientation of a gripper that points down is half a turn from that of the base.
        There, the shortest rotation vector jumps from one side to the other; `near` [rad]
        selects the side.
        """
        pose = self.chain.forward(torch.from_numpy(np.asarray(joints, dtype=float)))
        vector = pose.vector()
        pair = torch.stack([torch.from_numpy(np.array(near, dtype=float)), vector[3:]])
        return torch.cat([vector[:3], quaternion.unwrap_log(pair)[1]]).numpy()

    def target_of(
        self, action: Mapping[str, Any]
    ) -> tuple[Float[np.ndarray, " joints"] | Pose, float]:
        """Target of an action of either space; unknown names are ignored.

        Returns:
            Positions of the joints [rad] or pose of the end effector, and opening of the
            gripper [m]; NaN if no opening is given.

        Raises:
            ValueError: Names are missing.
        """
        width = float(action.get(GRIPPER, np.nan))
        if all(name in action for name in HAND):
            vector = torch.tensor([float(action[name]) for name in HAND], dtype=torch.float64)
            return Pose.from_vector(vector), width
        missing = [name for name in self.joints if name not in action]
        if missing:
            raise ValueError(
                f"an action for this arm needs {', '.join(self.joints)} or {', '.join(HAND)}, "
                f"but lacks {', '.join(missing)}."
            )
        return np.array([float(action[name]) for name in self.joints]), width

    def observed(
        self, state: ArmState, names: Sequence[str], near: Float[np.ndarray, "3"] = DOWN
    ) -> dict[str, float]:
        """Values of the arm's state by name.

        Args:
            state: State of the arm.
            names: Names of the wanted values: those of this class, `HAND` and `GRIPPER`.
            near: Previous rotation vector of the end effector [rad].
        """
        q = state.joint_position
        values = dict(zip(self.joints, q.tolist(), strict=True))
        values |= zip(self.velocities, state.joint_velocity.tolist(), strict=True)
        values[GRIPPER] = state.gripper_width
        if not {*HAND}.isdisjoint(names):
            values |= zip(HAND, self.hand_vector(q, near).tolist(), strict=True)
        return {name: float(values[name]) for name in names}
