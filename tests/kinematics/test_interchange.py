"""URDF text, and chains of pytorch-kinematics."""

from xml.etree import ElementTree

import pytorch_kinematics
import torch
from arm_samples import joint_positions
from sampling import generator
from torch.testing import assert_close
from urdf_text import to_urdf

from hrc_learn.kinematics import ArmChoice, JointLimits, SerialChain, arm, panda

# Axes along x, -z and a slant, a fixed joint in the middle and one at the end.
ODD_ARM = """
<robot name="odd">
  <link name="base"/><link name="a"/><link name="b"/><link name="plate"/><link name="c"/>
  <link name="tip"/>
  <joint name="one" type="revolute"><parent link="base"/><child link="a"/>
    <origin xyz="0.1 0 0.3" rpy="0.2 0.1 -0.4"/><axis xyz="1 0 0"/>
    <limit lower="-1" upper="2" velocity="3" effort="4"/></joint>
  <joint name="two" type="revolute"><parent link="a"/><child link="b"/>
    <origin xyz="0 0.2 0.1" rpy="0 0 0.7"/><axis xyz="0 0 -1"/>
    <limit lower="-2" upper="1" velocity="5" effort="6"/></joint>
  <joint name="bolt" type="fixed"><parent link="b"/><child link="plate"/>
    <origin xyz="0.3 0 0" rpy="0.5 0 0"/></joint>
  <joint name="three" type="revolute"><parent link="plate"/><child link="c"/>
    <origin xyz="0 0 0.2" rpy="0 -1.1 0"/><axis xyz="0 0.6 0.8"/>
    <limit lower="-3" upper="3" velocity="7" effort="8"/></joint>
  <joint name="end" type="fixed"><parent link="c"/><child link="tip"/>
    <origin xyz="0 0.1 0.1" rpy="0 0 0.3"/></joint>
</robot>
"""


def test_urdf_lists_joints_with_their_limits():
    robot = ElementTree.fromstring(to_urdf(panda))
    joints = {joint.get("name"): joint for joint in robot.findall("joint")}
    assert tuple(joints)[:7] == panda.joint_names
    for i, name in enumerate(panda.joint_names):
        limit = joints[name].find("limit")
        assert float(limit.get("lower")) == float(panda.limits.lower[i])
        assert float(limit.get("upper")) == float(panda.limits.upper[i])
        assert float(limit.get("velocity")) == float(panda.limits.velocity[i])
        assert float(limit.get("effort")) == float(panda.limits.torque[i])
    assert {link.get("name") for link in robot.findall("link")} >= {"link0", "flange", "tcp"}


def test_urdf_text_read_by_another_library_moves_alike():
    """To 1e-6: pytorch-kinematics rounds what it reads to float32."""
    q = joint_positions(50, rng=generator(1))
    parsed = pytorch_kinematics.build_serial_chain_from_urdf(to_urdf(panda).encode(), "tcp")
    parsed = parsed.to(dtype=torch.float64)
    assert_close(
        parsed.forward_kinematics(q).get_matrix(),
        panda.forward(q).matrix(),
        rtol=0,
        atol=1e-6,
    )


def test_axes_of_any_direction_move_as_in_pytorch_kinematics(tmp_path):
    (tmp_path / "odd.urdf").write_text(ODD_ARM, encoding="utf-8")
    robot = arm(tmp_path / "odd.urdf", tip="tip")
    peer = pytorch_kinematics.build_serial_chain_from_urdf(ODD_ARM.encode(), "tip")
    peer = peer.to(dtype=torch.float64)
    assert robot.joint_names == ("one", "two", "three")
    for choice in (f"{tmp_path}/odd.urdf:tip", f"{tmp_path}/odd.urdf:base:tip"):
        assert ArmChoice(choice).arm().joint_names == robot.joint_names
    assert ArmChoice(f"{tmp_path}/odd.urdf:a:tip").arm().joint_names == ("two", "three")
    assert robot.limits.velocity.tolist() == [3, 5, 7]
    q = torch.randn(20, 3, generator=generator(4), dtype=torch.float64)
    pose, J = robot.forward_and_jacobian(q)
    # 0.6, 0.8 and the peer's origins went through float32.
    assert_close(pose.matrix(), peer.forward_kinematics(q).get_matrix(), rtol=0, atol=1e-6)
    assert_close(J, peer.jacobian(q), rtol=0, atol=1e-6)


def test_urdf_keeps_the_kind_of_each_joint(tmp_path):
    turn, slide = torch.eye(4).double(), torch.eye(4).double()
    turn[:3, 3] = torch.tensor([0.1, 0.0, 0.3])
    slide[:3, :3] = torch.tensor([[0, 0, 1], [1, 0, 0], [0, 1, 0]]).double()
    still = torch.eye(4).double()
    each = torch.ones(3).double()
    limits = JointLimits(
        lower=torch.tensor([-3.0, -0.2, -1.0]).double(),
        upper=torch.tensor([3.0, 0.5, 2.0]).double(),
        velocity=each,
        acceleration=each,
        jerk=each,
        torque=each,
        vintage="test",
    )
    chain = SerialChain(
        joint_names=["turn", "slide", "bend"],
        mounts=torch.stack([turn, slide, turn @ slide]),
        flange=turn,
        tcp=still,
        limits=limits,
        ready=0.1 * each,
        kinds=("revolute", "prismatic", "revolute"),
    )
    file = tmp_path / "sliding.urdf"
    file.write_text(to_urdf(chain))
    read = arm(file, base="link0", tip="tcp").chain
    assert read.kinds == chain.kinds
    q = torch.tensor([[0.3, 0.2, -0.7], [-2.0, -0.1, 1.5]]).double()
    assert_close(read.forward(q).matrix(), chain.forward(q).matrix(), rtol=0, atol=1e-12)
    assert_close(read.jacobian(q), chain.jacobian(q), rtol=0, atol=1e-12)
