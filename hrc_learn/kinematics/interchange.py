"""Serial chains as URDF text, and to and from chains of the library pytorch-kinematics.

URDF serves viewers, simulators and other kinematics libraries. pytorch-kinematics is imported
only when it is asked for.
"""

from __future__ import annotations

from typing import TYPE_CHECKING
from xml.etree import ElementTree

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.geometry import quaternion
from hrc_learn.kinematics.chain import SerialChain
from hrc_learn.kinematics.limits import JointLimits

if TYPE_CHECKING:
    import pytorch_kinematics


def to_urdf(chain: SerialChain, name: str = "arm") -> str:
    """Describe a chain: links link0 to linkN, `flange` and `tcp`, joints under their names.

    Args:
        chain: Arm to describe.
        name: Of the robot.

    Returns:
        URDF with links as bare frames: no masses, meshes or collision shapes.
    """
    robot = ElementTree.Element("robot", name=name)
    links = [f"link{i}" for i in range(len(chain.joint_names) + 1)] + ["flange", "tcp"]
    for link in links:
        ElementTree.SubElement(robot, "link", name=link)
    limits = chain.limits
    for i, joint_name in enumerate(chain.joint_names):
        joint = _add_joint(
            robot, joint_name, chain.kinds[i], links[i], links[i + 1], chain.mounts[i]
        )
        ElementTree.SubElement(joint, "axis", xyz="0 0 1")
        ElementTree.SubElement(
            joint,
            "limit",
            lower=repr(float(limits.lower[i])),
            upper=repr(float(limits.upper[i])),
            velocity=repr(float(limits.velocity[i])),
            effort=repr(float(limits.torque[i])),
        )
    _add_joint(robot, "flange_joint", "fixed", links[-3], "flange", chain.flange)
    _add_joint(robot, "tcp_joint", "fixed", "flange", "tcp", chain.tcp)
    ElementTree.indent(robot)
    return ElementTree.tostring(robot, encoding="unicode")


def _add_joint(
    robot: ElementTree.Element,
    name: str,
    kind: str,
    parent: str,
    child: str,
    transform: Float[Tensor, "4 4"],
) -> ElementTree.Element:
    joint = ElementTree.SubElement(robot, "joint", name=name, type=kind)
    rpy = " ".join(repr(angle) for angle in _roll_pitch_yaw(transform[:3, :3]))
    xyz = " ".join(repr(value) for value in transform[:3, 3].tolist())
    ElementTree.SubElement(joint, "origin", xyz=xyz, rpy=rpy)
    ElementTree.SubElement(joint, "parent", link=parent)
    ElementTree.SubElement(joint, "child", link=child)
    return joint


def _roll_pitch_yaw(R: Float[Tensor, "3 3"]) -> list[float]:
    """Angles about fixed x, y, z [rad]; at pitch +-pi/2, where two coincide, yaw is zero."""
    horizontal = torch.hypot(R[0, 0], R[1, 0])
    pitch = torch.atan2(-R[2, 0], horizontal)
    if horizontal < 1e-12:  # beyond rounding of entries of size 1: roll and yaw coincide
        return [torch.atan2(-R[1, 2], R[1, 1]).item(), pitch.item(), 0.0]
    roll, yaw = torch.atan2(R[2, 1], R[2, 2]), torch.atan2(R[1, 0], R[0, 0])
    return [roll.item(), pitch.item(), yaw.item()]


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
