"""What a column of a dataset can mean to us, and in which unit we keep it."""

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Role:
    """One meaning a group of columns can have."""

    width: int | None
    """Columns it takes; None: one a joint."""
    unit: str
    """Unit of the arrays in a `Demonstration`."""


ROLES: dict[str, Role] = {
    "time": Role(width=1, unit="s"),
    "joint_position": Role(width=None, unit="rad"),
    "joint_velocity": Role(width=None, unit="rad/s"),
    "joint_effort": Role(width=None, unit="N m"),
    "position": Role(width=3, unit="m"),
    "quaternion_wxyz": Role(width=4, unit="1"),
    "quaternion_xyzw": Role(width=4, unit="1"),
    "rotation_vector": Role(width=3, unit="rad"),
    "euler_xyz": Role(width=3, unit="rad"),
    "euler_intrinsic_xyz": Role(width=3, unit="rad"),
    "rotation_6d": Role(width=6, unit="1"),
    "pose_matrix": Role(width=16, unit="m"),
    "gripper": Role(width=1, unit="m"),
    "feature": Role(width=2, unit="px"),
    "feature_visible": Role(width=1, unit="1"),
    "human_effort": Role(width=None, unit="N m"),
    "command_position": Role(width=None, unit="rad"),
    "command_velocity": Role(width=None, unit="rad/s"),
}
"""Every role. `euler_xyz` is roll, pitch, yaw about the fixed axes x, y, z,
`euler_intrinsic_xyz` angles about the axes x, y, z as they turn along; `rotation_6d` the first
two columns of the rotation matrix, one after the other; `pose_matrix` a flattened 4x4
homogeneous transform."""

ORIENTATION_ROLES = (
    "quaternion_wxyz",
    "quaternion_xyzw",
    "rotation_vector",
    "euler_xyz",
    "euler_intrinsic_xyz",
    "rotation_6d",
    "pose_matrix",
)
"""The encodings of an orientation, preferred first."""

INDEX_KEYS = ("timestamp", "frame_index", "episode_index", "index", "task_index")
"""Columns that LeRobot keeps for itself."""
