"""Where arms and their fingers are drawn, compared with Pinocchio and MuJoCo."""

import re
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from hrc_learn.geometry import quaternion
from hrc_learn.kinematics import arm, panda
from hrc_learn.kinematics.described_arm import _finger
from hrc_learn.kinematics.description import Joint
from hrc_learn.kinematics.drawing import arm_bodies, panda_meshes
from hrc_learn.kinematics.registry import arm_of_robot

SHAPES = '<visual><geometry><mesh filename="part.stl"/></geometry></visual>'
LINKS = "".join(
    f'<link name="{name}">{SHAPES}</link>'
    for name in ("base", "l1", "hand", "left", "right", "tip")
)
HAND = f"""<robot name="r">
{LINKS}<link name="tcp"/>
<joint name="j1" type="revolute"><parent link="base"/><child link="l1"/>
  <origin xyz="0.1 0.2 0.3" rpy="0.1 0.2 0.3"/><axis xyz="0 1 0"/>
  <limit lower="-2" upper="2" velocity="1" effort="1"/></joint>
<joint name="h" type="fixed"><parent link="l1"/><child link="hand"/>
  <origin xyz="0 0 0.2" rpy="0 0 0.7"/></joint>
<joint name="t" type="fixed"><parent link="hand"/><child link="tcp"/>
  <origin xyz="0 0 0.1"/></joint>
<joint name="left_finger" type="revolute"><parent link="hand"/><child link="left"/>
  <origin xyz="0 0.03 0.02" rpy="0.4 0 0"/><axis xyz="1 0 0"/>
  <limit lower="0" upper="0.9" velocity="1" effort="1"/></joint>
<joint name="right_finger" type="prismatic"><parent link="hand"/><child link="right"/>
  <origin xyz="0 -0.03 0.02"/><axis xyz="0 -1 0"/><mimic joint="left_finger" multiplier="0.05"/>
  <limit lower="0" upper="0.05" velocity="1" effort="1"/></joint>
<joint name="finger_tip" type="revolute"><parent link="left"/><child link="tip"/>
  <origin xyz="0 0 0.03" rpy="0 0.5 0"/><axis xyz="0 0 1"/>
  <mimic joint="left_finger" multiplier="-2" offset="0.1"/>
  <limit lower="-2" upper="2" velocity="1" effort="1"/></joint>
</robot>"""
TRIANGLE = "solid t\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 0.1 0 0\n" + (
    "vertex 0 0.1 0\nendloop\nendfacet\nendsolid t\n"
)


@pytest.mark.filterwarnings("ignore:.*the arm ends at.*:UserWarning")
def test_fingers_move_as_pinocchio_says(tmp_path):
    pinocchio = pytest.importorskip("pinocchio")
    path = tmp_path / "robot.urdf"
    path.write_text(HAND)
    (tmp_path / "part.stl").write_text(TRIANGLE)
    described = arm(path, tip="tcp")
    q, opening = np.array([[0.7], [-1.1]]), np.array([0.3, 1.0])
    bodies = {body.name: body for body in arm_bodies(described, q, opening)}
    names = {
        "finger_left_finger": "left",
        "finger_right_finger": "right",
        "finger_finger_tip": "tip",
    }
    assert bodies.keys() == {"link0", "link1", "tool", *names}
    model = pinocchio.buildModelFromUrdf(str(path))
    data = model.createData()
    for row in range(2):
        posture = pinocchio.neutral(model)
        left = 0.9 * opening[row]
        for name, value in (
            ("j1", q[row, 0]),
            ("left_finger", left),
            ("right_finger", 0.05 * left),
            ("finger_tip", 0.1 - 2 * left),
        ):
            posture[model.joints[model.getJointId(name)].idx_q] = value
        pinocchio.framesForwardKinematics(model, data, posture)
        for body, link in names.items():
            placed = data.oMf[model.getFrameId(link)]
            np.testing.assert_allclose(
                bodies[body].position[row], placed.translation, atol=1e-12
            )
            turn = quaternion.to_matrix(torch.from_numpy(bodies[body].orientation[row]))
            np.testing.assert_allclose(turn, placed.rotation, atol=1e-12)


def test_the_jaw_of_an_so101_opens(tmp_path):
    mujoco = pytest.importorskip("mujoco")
    so101 = arm_of_robot("so101")
    if so101 is None:
        pytest.skip("example-robot-data is not installed")
    q = so101.ready.numpy()[None].repeat(2, axis=0) + 0.2
    jaw = arm_bodies(so101, q, np.array([0.0, 1.0]))[-1]
    assert jaw.name == "finger_gripper"
    bare = re.sub(
        r"<(visual|collision)>.*?</\1>",
        "",
        Path(so101.description).read_text(),
        flags=re.DOTALL,
    )
    (tmp_path / "robot.urdf").write_text(bare)
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "robot.urdf"))
    data = mujoco.MjData(model)
    for row, value in ((0, so101.shape.gripper[0].closed), (1, so101.shape.gripper[0].opened)):
        for name, position in zip(
            [*so101.joint_names, "gripper"], [*q[row], value], strict=True
        ):
            data.joint(name).qpos[0] = position
        mujoco.mj_kinematics(model, data)
        body = model.body(model.joint("gripper").bodyid[0]).name
        np.testing.assert_allclose(jaw.position[row], data.body(body).xpos, atol=1e-6)


def test_the_fingers_of_a_panda_part_by_the_width_of_the_gripper():
    if not panda_meshes("hand"):
        pytest.skip("example-robot-data is not installed")
    left, right = arm_bodies(panda, panda.ready.numpy()[None], np.array([0.5]))[-2:]
    assert (left.name, right.name) == ("finger_left", "finger_right")
    assert np.linalg.norm(left.position - right.position) == pytest.approx(0.04)


def test_an_mjcf_without_its_meshes_is_an_arm_of_capsules(tmp_path):
    """MuJoCo itself refuses it; the geoms that need no mesh stay, others become capsules."""
    pytest.importorskip("mujoco")
    path = tmp_path / "heron.xml"
    path.write_text(
        '<mujoco><compiler meshdir="assets"/><asset><mesh name="one" file="one.obj"/>'
        '<mesh file="two.obj"/></asset><worldbody><body name="base">'
        '<geom type="mesh" mesh="one"/><body name="l1" pos="0 0 0.2">'
        '<joint name="j1" axis="0 0 1" range="-90 90"/><geom type="mesh" mesh="two"/>'
        '<body name="l2" pos="0 0 0.3"><joint name="j2" axis="0 1 0" range="-90 90"/>'
        '<inertial pos="0 0 0" mass="2" diaginertia="0.01 0.01 0.01"/>'
        '<geom type="capsule" size="0.04 0.1" pos="0 0 0.1"/>'
        '<site name="tcp" pos="0 0 0.3"/></body></body></body></worldbody></mujoco>'
    )
    with pytest.warns(UserWarning, match="2 meshes are missing, such as one.obj"):
        found = arm(path)
    assert (found.joint_names, found.tip) == (("j1", "j2"), "tcp")
    assert found.shape.masses[:3] == (None, None, 2.0)
    np.testing.assert_allclose(found.forward([0.0, 0.0]).position, [0, 0, 0.8], atol=1e-12)
    radii = {capsule.link: capsule.radius for capsule in found.whole.capsules}
    assert radii == {0: 0.045, 1: 0.045, 2: pytest.approx(0.04)}
    assert {body.name for body in arm_bodies(found, np.zeros((1, 2)))} == {
        "link0",
        "link1",
        "link2",
    }


@pytest.mark.parametrize(
    ("lower", "upper", "closed", "opened"),
    [
        (0.0, 0.04, 0.0, 0.04),
        (-0.04, 0.0, 0.0, -0.04),
        (-0.5, 0.3, 0.3, -0.5),
        (-0.3, 0.5, -0.3, 0.5),
        (-0.3, 0.3, -0.3, 0.3),
        (0.1, 0.2, 0.1, 0.2),
        (None, 0.7, 0.0, 0.7),
        (-0.7, None, 0.0, -0.7),
        (None, None, 0.0, 0.0),
    ],
)
@pytest.mark.parametrize("kind", ["revolute", "continuous", "prismatic"])
def test_a_finger_is_open_at_the_end_of_its_range_further_from_zero(
    lower, upper, closed, opened, kind
):
    axis, parent, origin = np.array([0.6, 0.0, 0.8]), np.eye(4), np.eye(4)
    parent[:3, 3], origin[:3, 3] = (0.1, 0.2, 0.3), (0.0, 0.0, 0.05)
    parent[:3, :3] = Rotation.from_euler("xyz", [0.2, -0.4, 0.7]).as_matrix()
    joint = Joint(
        name="jaw", kind=kind, parent="hand", child="jaw", origin=origin, axis=axis,
        lower=lower, upper=upper, follows=("other", -1.0, 0.01),
    )  # fmt: skip
    finger, poses = _finger(joint, parent)
    assert (finger.closed, finger.opened) == (closed, opened)
    assert finger.kind == ("prismatic" if kind == "prismatic" else "revolute")
    assert (finger.name, finger.follows, finger.axis) == ("jaw", joint.follows, (0.6, 0.0, 0.8))
    for pose, value in zip(poses, np.linspace(closed, opened, len(poses)), strict=True):
        moved = np.eye(4)
        if kind == "prismatic":
            moved[:3, 3] = value * axis
        else:
            moved[:3, :3] = Rotation.from_rotvec(value * axis).as_matrix()
        np.testing.assert_allclose(pose, parent @ origin @ moved, atol=1e-12)
    assert len(poses) > 2
