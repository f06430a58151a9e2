"""To and from chains of the library pytorch-kinematics (imported only when called)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from hrc_learn.geometry import quaternion
from hrc_learn.kinematics.chain import SerialChain
from hrc_learn.kinematics.limits import JointLimits
from hrc_learn.kinematics.urdf import to_urdf

if TYPE_CHECKING:
    import pytorch_kinematics


def to_pytorch_kinematics(
    chain: SerialChain, dtype: torch.dtype = torch.float64
) -> pytorch_kinematics.SerialChain:
    """The same arm, from the base to the tool centre point, as a pytorch-kinematics chain.

    Its URDF parser rounds origins to float32, which costs 1e-8 m whatever dtype is asked for
    later; they are put back in float64 before the chain is assembled.
    """
    import pytorch_kinematics

    parsed = pytorch_kinematics.build_chain_from_urdf(to_urdf(chain).encode())
    frame = parsed._root.to(dtype=torch.float64, device="cpu")
    for transform in (*chain.mounts, chain.flange, chain.tcp):
        frame = frame.children[0]
        frame.joint.offset = pytorch_kinematics.Transform3d(
            matrix=transform, dtype=torch.float64
        )
    exact = pytorch_kinematics.SerialChain(parsed, "tcp", dtype=torch.float64)
    return exact.to(dtype=dtype)


def from_pytorch_kinematics(
    serial: pytorch_kinematics.SerialChain,
    *,
    acceleration: float,
    jerk: float,
) -> SerialChain:
    """An arm of revolute joints from any URDF that pytorch-kinematics reads.

    Joint frames are turned so that each joint moves about its z axis, as `SerialChain` has
    it: origins and axes of the frames of `link_poses` are those of the URDF, the other two
    axes may differ. Fixed joints after the last moving one become the flange; the tool centre
    point is the end of the chain. Constants have the precision of `serial`, usually float32.

    Args:
        serial: Chain with revolute and fixed joints.
        acceleration: Limit for every joint [rad/s^2]; URDF has none.
        jerk: Limit for every joint [rad/s^3]; URDF has none.

    Raises:
        ValueError: A joint is neither revolute nor fixed.
    """
    mounts, names = [], []
    carried = torch.eye(4, dtype=torch.float64)
    for frame in serial._serial_frames:
        carried = carried @ _matrix(frame.link.offset) @ _matrix(frame.joint.offset)
        kind = frame.joint.joint_type
        if kind == "revolute":
            turn = _z_to(frame.joint.axis.double())
            mounts.append(carried @ turn)
            names.append(frame.joint.name)
            carried = turn.mT
        elif kind != "fixed":
            raise ValueError(
                f"joint {frame.joint.name} is {kind}, but only revolute and fixed joints are "
                "supported. Shorten the chain so that it ends before this joint."
            )
    return SerialChain(
        joint_names=names,
        mounts=torch.stack(mounts),
        flange=carried,
        tcp=torch.eye(4, dtype=torch.float64),
        limits=_limits(serial, acceleration, jerk),
        ready=torch.zeros(len(names), dtype=torch.float64),
    )


def _matrix(offset) -> Tensor:
    if offset is None:
        return torch.eye(4, dtype=torch.float64)
    return offset.get_matrix()[0].double()


def _z_to(axis: Tensor) -> Tensor:
    """Rotation that takes z to a unit axis, as a homogeneous transform."""
    z = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    if axis[2] < -1 + 1e-9:  # half a turn about x: the shortest rotation is not unique
        q = torch.tensor([0.0, 1.0, 0.0, 0.0], dtype=torch.float64)
    else:
        q = torch.cat([1 + axis[2:], torch.linalg.cross(z, axis)])
    turn = torch.eye(4, dtype=torch.float64)
    turn[:3, :3] = quaternion.to_matrix(quaternion.normalize(q))
    return turn


def _limits(serial, acceleration: float, jerk: float) -> JointLimits:
    def column(values) -> Tensor:
        return torch.as_tensor(values, dtype=torch.float64)

    lower, upper = (column(side) for side in serial.get_joint_limits())
    return JointLimits(
        lower=lower,
        upper=upper,
        velocity=column(serial.get_joint_velocity_limits()[1]),
        acceleration=torch.full_like(lower, acceleration),
        jerk=torch.full_like(lower, jerk),
        torque=column(serial.get_joint_effort_limits()[1]),
        vintage="URDF",
    )
