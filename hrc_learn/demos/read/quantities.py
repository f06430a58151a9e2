"""Quantities of a dataset: their roles, the names they go by, and encodings of orientation."""

import re
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from hrc_learn.geometry import quaternion


@dataclass(frozen=True, kw_only=True)
class Role:
    """Quantity that a group of columns can hold."""

    width: int | None
    """Number of columns; None for one per joint."""
    unit: str
    """Unit in a `Demonstration`."""


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
"""Every role. `euler_xyz` is roll, pitch, yaw about the fixed axes x, y, z and
`euler_intrinsic_xyz` are angles about the moving axes x, y, z; `rotation_6d` is the first two
columns of the rotation matrix, one after the other; `pose_matrix` is a flattened 4x4
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
"""Encodings of an orientation, preferred first."""

INDEX_KEYS = ("timestamp", "frame_index", "episode_index", "index", "task_index")
"""Index columns that LeRobot maintains."""


# There is no single naming convention; these occur in published datasets. Unknown names are
# left to the caller's explicit mapping.
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
"""Suffixes of `JOINT.SUFFIX`, as lerobot-record and the Franka plug-ins write them."""

_JOINT_PREFIXES = {"qpos": "joint_position", "qvel": "joint_velocity", "effort": "joint_effort"}

# `joint_1_vel`: only after an unmistakable joint name, since `ee_pos` and `x_vel` are none.
_UNDERSCORED = re.compile(
    r"(.*(?:joint|motor|axis)_?\w*|\w*j\d+|\w*_\d+)_([a-z]+)", re.IGNORECASE
)
_GRIPPER = re.compile(r"gripper|(?:^|[._/ ])(?:jaw|claw)(?:$|[._/ ])")
_HAND = re.compile(
    r"finger|thumb|pinky|knuckle|"
    r"(?:^|[._/ ])(?:hand|palm|index|middle|ring|little|claw|jaw|gripper)(?:$|[._/ \d])"
)
_CAMEL = re.compile(r"(?<=[a-z\d])(?=[A-Z])")
"""Word boundaries of a name such as `kRightHandIndex`."""

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
"""Role of a whole feature -> last part of its key (regular expression)."""


@dataclass(frozen=True)
class ComponentMeaning:
    """Role of one component, and its place within the role."""

    role: str
    slot: str | int
    """Joint name, or index of the component."""


def meaning_of_component(name: str) -> ComponentMeaning | None:
    """Meaning of a component by its name; None if the name alone does not tell."""
    plain = name.strip().lower()
    matrix = _MATRIX.fullmatch(plain)
    if matrix:
        return ComponentMeaning("pose_matrix", int(matrix[1]))
    ee = _EE.fullmatch(plain)
    component = _POSE_COMPONENTS.get(ee[1] if ee else plain)
    if component:
        return ComponentMeaning(*component)
    stem, suffix = split_name(name.strip())
    roles = [role for role, names in JOINT_SUFFIXES.items() if suffix in names]
    if (ee and "gripper" in ee[1]) or (_GRIPPER.search(plain) and (not stem or roles)):
        # The velocity or force of a gripper must not be mistaken for its opening.
        if re.search(r"_(?:vel|velocity|torque|effort|force|current)$", plain):
            return None
        return ComponentMeaning("gripper", name) if roles in ([], ["joint_position"]) else None
    if stem and roles:
        return ComponentMeaning(roles[0], stem)
    prefix, _, number = plain.rpartition("_")
    if number.isdigit() and prefix in _JOINT_PREFIXES:
        return ComponentMeaning(_JOINT_PREFIXES[prefix], f"joint_{number}")
    return None


def split_name(name: str) -> tuple[str, str]:
    """Joint and quantity in a name such as `joint_1.pos` or `joint_1_vel`; "" for no joint."""
    stem, dot, suffix = name.rpartition(".")
    if not dot and (match := _UNDERSCORED.fullmatch(name)):
        known = any(match[2].lower() in names for names in JOINT_SUFFIXES.values())
        stem, suffix = (match[1], match[2]) if known else ("", name)
    return stem, suffix.lower()


def names_joint_quantity(name: str) -> bool:
    """True if the name is a joint with a suffix of `JOINT_SUFFIXES`."""
    stem, suffix = split_name(name)
    return bool(stem) and any(suffix in names for names in JOINT_SUFFIXES.values())


def joint_of(name: str) -> str:
    """Joint of a component: its name without the suffix of the quantity."""
    return split_name(name)[0] if names_joint_quantity(name) else name


def is_hand(name: str) -> bool:
    """True if the name is that of a finger, hand or gripper joint."""
    words = _CAMEL.sub("_", name.strip())
    return bool(_HAND.search(words.lower()))


def role_of_key(key: str) -> str | None:
    """Role of a whole feature by its key; None for a state or action of mixed content."""
    last = re.split(r"[./]", key.lower())[-1]
    for role, pattern in KEY_ROLES.items():
        if re.fullmatch(pattern, last):
            return role
    return None


def to_quaternion(
    role: str, values: Float64[np.ndarray, "frames components"]
) -> Float64[np.ndarray, "frames 4"]:
    """Unit quaternions (w, x, y, z), with neighbours on the same half of the sphere.

    Args:
        role: Encoding, one of `ORIENTATION_ROLES`.
        values: Components in SI units.

    Raises:
        ValueError: Quaternions are far from unit length, matrices are no transforms, or two
            columns span no plane.
    """
    numbers = torch.from_numpy(values)
    match role:
        case "quaternion_wxyz":
            orientation = _normalized(numbers)
        case "quaternion_xyzw":
            orientation = _normalized(numbers.roll(1, dims=-1))
        case "rotation_vector":
            orientation = quaternion.exp(numbers)
        case "euler_xyz":  # fixed axes: R = Rz(yaw) Ry(pitch) Rx(roll)
            orientation = _from_euler(numbers, (2, 1, 0))
        case "euler_intrinsic_xyz":  # moving axes: R = Rx Ry Rz
            orientation = _from_euler(numbers, (0, 1, 2))
        case "rotation_6d":
            orientation = _from_two_columns(numbers)
        case _:
            orientation = quaternion.from_matrix(transforms(values)[:, :3, :3])
    return quaternion.continuous(orientation).numpy()


def transforms(values: Float64[np.ndarray, "frames 16"]) -> Tensor:
    """4x4 transforms from 16 numbers, in row order or, as in libfranka, in column order.

    Raises:
        ValueError: Neither order has (0, 0, 0, 1) for its last row.
    """
    by_rows = torch.from_numpy(values).reshape(-1, 4, 4)
    last = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=by_rows.dtype)
    for matrices in (by_rows, by_rows.mT):
        # The tolerance allows for float32 and for few printed digits.
        if torch.allclose(matrices[:, 3], last.expand(len(matrices), 4), atol=1e-4):
            return matrices
    raise ValueError("16 numbers that are no 4x4 transform: no last row 0, 0, 0, 1")


def _normalized(q: Tensor) -> Tensor:
    # Rounding leaves far less than 1 %.
    wrong = ((q.norm(dim=-1) - 1).abs() > 0.01).nonzero()
    if len(wrong):
        k = int(wrong[0])
        raise ValueError(
            f"quaternion of length {float(q[k].norm()):.4g} at frame {k}: the columns hold no "
            f"quaternion, or it was lost there"
        )
    return quaternion.normalize(q)


def _from_euler(angles: Tensor, order: tuple[int, int, int]) -> Tensor:
    """Product of the rotations about x, y and z, multiplied from left to right in `order`."""
    axes = torch.eye(3, dtype=angles.dtype)
    first, second, third = (quaternion.exp(angles[:, k, None] * axes[k]) for k in order)
    return quaternion.multiply(first, quaternion.multiply(second, third))


def _from_two_columns(values: Tensor) -> Tensor:
    """Two columns of a rotation matrix, made orthonormal (Zhou et al., CVPR 2019, eq. 15)."""
    first, second = values[:, :3], values[:, 3:]
    third = torch.linalg.cross(first, second)
    # Parallel columns, or zeros where nothing was recorded.
    lost = (third.norm(dim=-1) < 1e-6).nonzero()
    if len(lost):
        raise ValueError(
            f"the two columns at frame {int(lost[0])} span no plane: they hold no rotation"
        )
    first = first / first.norm(dim=-1, keepdim=True)
    third = third / third.norm(dim=-1, keepdim=True)
    matrix = torch.stack([first, torch.linalg.cross(third, first), third], dim=-1)
    return quaternion.from_matrix(matrix)
