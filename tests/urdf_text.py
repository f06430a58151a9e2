"""Serial chains as URDF text, for tests of what reads files."""

from xml.etree import ElementTree

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.kinematics import SerialChain


def to_urdf(chain: SerialChain, name: str = "arm") -> str:
    """Describe a chain: links link0 to linkN, `flange` and `tcp`, joints under their names.

    Args:
        chain: Arm to describe.
        name: Name of the robot.

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
