"""What a column or one of its components means, by its name."""

import re
from dataclasses import dataclass

# What the name of a component says about its meaning.
#
# There is no single convention; these are the ones met in published datasets. Anything not
# recognised is left to the caller's explicit mapping.

JOINT_SUFFIXES = {
    "joint_position": ("pos", "position", "obs_pos", "cmd_pos", "qpos"),
    "joint_velocity": ("vel", "velocity", "obs_vel", "cmd_vel", "qvel"),
    "joint_effort": (
        "torque",
        "effort",
        "obs_torque",
        "obs_effort",
        "external_torque",
        "obs_external_torque",
    ),
    "human_effort": ("human_effort", "human_torque"),
}
"""`JOINT.SUFFIX`, as lerobot-record and the Franka plug-ins write them."""

_JOINT_PREFIXES = {"qpos": "joint_position", "qvel": "joint_velocity", "effort": "joint_effort"}

_XYZ = {"x": 0, "y": 1, "z": 2}
_POSE_COMPONENTS = {
    **{name: ("position", slot) for name, slot in _XYZ.items()},
    **{f"p{name}": ("position", slot) for name, slot in _XYZ.items()},
    **{f"pos_{name}": ("position", slot) for name, slot in _XYZ.items()},
    **{f"w{name}": ("rotation_vector", slot) for name, slot in _XYZ.items()},
    **{f"r{name}": ("rotation_vector", slot) for name, slot in _XYZ.items()},
    **{f"q{name}": ("quaternion_wxyz", slot) for slot, name in enumerate("wxyz")},
    **{f"quat_{name}": ("quaternion_wxyz", slot) for slot, name in enumerate("wxyz")},
    **{f"euler_{name}": ("euler_xyz", slot) for name, slot in _XYZ.items()},
    **{f"rot6d_{slot}": ("rotation_6d", slot) for slot in range(6)},
    **{f"r6d_{slot}": ("rotation_6d", slot) for slot in range(6)},
    "roll": ("euler_xyz", 0),
    "pitch": ("euler_xyz", 1),
    "yaw": ("euler_xyz", 2),
}
_EE = re.compile(r"(?:ee|eef|tcp|end_effector)[._/](.+)")
_MATRIX = re.compile(r"(?:ee|eef|tcp)_(?:pose|matrix)[._](\d+)")

KEY_ROLES = {
    "joint_position": "joint_position|joint_positions|joint_pos|joints|qpos",
    "joint_velocity": "joint_velocity|joint_velocities|joint_vel|qvel|velocity",
    "joint_effort": "joint_effort|joint_efforts|joint_torque|joint_torques|torque|effort",
    "position": "(?:ee|eef|tcp)_(?:pos|position)",
    "rotation_vector": "(?:ee|eef|tcp)_(?:rotvec|axis_angle|rot_axis_angle)",
    "euler_xyz": "(?:ee|eef|tcp)_(?:euler|rpy)",
    "rotation_6d": "(?:ee|eef|tcp)_(?:rot6d|rotation_6d)",
    "quaternion_xyzw": "(?:ee|eef|tcp)_(?:quat|quaternion|orientation)",
    "cartesian": "cartesian_position|cartesian_pose|(?:ee|eef|tcp)_pose|(?:ee|eef|tcp)",
    "gripper": "gripper|gripper_position|gripper_width|gripper_pos",
    "feature": "image_feature",
    "human_effort": "human_effort",
    "time": "time|time_stamp|timestamp|stamp",
}
"""What the last part of a feature's key says of the whole feature."""


@dataclass(frozen=True)
class Meaning:
    """What one component stands for."""

    role: str
    slot: str | int
    """Joint name, or index of the component within its role."""


def meaning_of_component(name: str) -> Meaning | None:
    """What a name says on its own; None where it says nothing (a bare joint name, say)."""
    plain = name.strip().lower()
    matrix = _MATRIX.fullmatch(plain)
    if matrix:
        return Meaning("pose_matrix", int(matrix[1]))
    ee = _EE.fullmatch(plain)
    component = _POSE_COMPONENTS.get(ee[1] if ee else plain)
    if component:
        return Meaning(*component)
    stem, _, suffix = name.strip().rpartition(".")
    roles = [role for role, names in JOINT_SUFFIXES.items() if suffix.lower() in names]
    if (ee and "gripper" in ee[1]) or ("gripper" in plain and (not stem or roles)):
        # A gripper's velocity or force is of no use here and must not pass for its opening.
        return Meaning("gripper", name) if roles in ([], ["joint_position"]) else None
    if stem and roles:
        return Meaning(roles[0], stem)
    prefix, _, number = plain.rpartition("_")
    if number.isdigit() and prefix in _JOINT_PREFIXES:
        return Meaning(_JOINT_PREFIXES[prefix], f"joint_{number}")
    return None


def says_joint_quantity(name: str) -> bool:
    """Whether the name ends in a suffix of `JOINT_SUFFIXES`."""
    _, dot, suffix = name.rpartition(".")
    return bool(dot) and any(suffix.lower() in names for names in JOINT_SUFFIXES.values())


def role_of_key(key: str) -> str | None:
    """What the key says of the whole feature; None for a state or action of mixed content."""
    last = re.split(r"[./]", key.lower())[-1]
    for role, pattern in KEY_ROLES.items():
        if re.fullmatch(pattern, last):
            return role
    return None


# What a column of a dataset can mean to us, and in which unit we keep it.


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
