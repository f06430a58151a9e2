"""Description files: loaded as Pinocchio and MuJoCo load them, or refused in one line.

One arm of six joints is changed in many ways. Where others load a change, ours moves as theirs;
where one of them refuses it, ours does, too. Exceptions say why.
"""

import warnings
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import mujoco
import numpy as np
import pytest
import torch
from sampling import generator, within
from torch.testing import assert_close

from hrc_learn.kinematics import Arm, MissingModelError, arm
from hrc_learn.kinematics.urdf import read_urdf

NAMES = [f"j{i}" for i in range(1, 7)]
MESH = '<visual><geometry><mesh filename="package://not/there.stl"/></geometry></visual>'
FAR = (
    '<collision><origin xyz="0 0 1e300"/><geometry><sphere radius="1"/></geometry></collision>'
)
HEAVY = '<inertial><mass value="1"/><inertia ixx="nan" iyy="1" izz="1"/></inertial>'
LIGHT = '<inertial><mass value="-1"/><inertia ixx="1" iyy="1" izz="1"/></inertial>'
XMLNS = 'xmlns:xacro="http://www.ros.org/wiki/xacro"'


def joint(number: int, *, child: str = "", kind: str = "revolute", more: str = "") -> str:
    axis = ("0 0 1", "0 1 0", "1 0 0")[number % 3]
    return (
        f'<joint name="j{number}" type="{kind}"><parent link="l{number - 1}"/>'
        f'<child link="{child or f"l{number}"}"/>'
        f'<origin xyz="0.1 0.0{number} 0.2" rpy="0.{number} 0 -0.2"/><axis xyz="{axis}"/>'
        f'<limit lower="-2.5" upper="2.6" velocity="2" effort="50"/>{more}</joint>\n'
    )


def fixed(name: str, parent: str, child: str) -> str:
    return (
        f'<link name="{child}"/><joint name="{name}" type="fixed"><parent link="{parent}"/>'
        f'<child link="{child}"/><origin xyz="0 0 0.1"/></joint>\n'
    )


LINKS = "".join(f'<link name="l{i}"/>\n' for i in range(7))
ARM = LINKS + "".join(joint(i) for i in range(1, 7))
TOOL = fixed("mount", "l6", "tool0")


def robot(content: str, head: str = '<robot name="r">') -> str:
    return f"{head}\n{content}</robot>"


def changed(old: str, new: str, count: int = -1) -> str:
    assert old in ARM
    return ARM.replace(old, new, count) + TOOL


def jaw(name: str, link: str, parent: str = "l6", kind: str = "revolute") -> str:
    text = joint(7, child=link, kind=kind).replace('"j7"', f'"{name}"')
    return f'<link name="{link}"/>' + text.replace(
        'parent link="l6"', f'parent link="{parent}"'
    )


def load(tmp_path: Path, text: str, suffix: str = ".urdf", **choice: Any) -> Arm:
    path = tmp_path / f"robot{suffix}"
    path.write_text(text, encoding="utf-8")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return arm(path, **choice)


def mujoco_flange(text: str, tip: str, q: np.ndarray) -> np.ndarray:
    """Pose of the tip by MuJoCo, which is given the kinematics alone."""
    tree = ElementTree.fromstring(text.strip())
    for link in tree.findall("link"):
        for part in list(link):
            link.remove(part)
        inertial = ElementTree.SubElement(link, "inertial")
        ElementTree.SubElement(inertial, "mass", value="1")
        ElementTree.SubElement(
            inertial, "inertia", ixx="1", iyy="1", izz="1", ixy="0", ixz="0", iyz="0"
        )
    tree.append(ElementTree.fromstring('<mujoco><compiler fusestatic="false"/></mujoco>'))
    model = mujoco.MjModel.from_xml_string(ElementTree.tostring(tree, encoding="unicode"))
    data = mujoco.MjData(model)
    for name, value in zip(NAMES, q, strict=True):
        data.joint(name).qpos[0] = value
    mujoco.mj_kinematics(model, data)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = data.body(tip).xmat.reshape(3, 3), data.body(tip).xpos
    return T


def pinocchio_flange(text: str, tip: str, q: np.ndarray) -> np.ndarray:
    pinocchio = pytest.importorskip("pinocchio")
    model = pinocchio.buildModelFromXML(text)
    data, full = model.createData(), pinocchio.neutral(model)
    for name, value in zip(NAMES, q, strict=True):
        moving = model.joints[model.getJointId(name)]
        at = [value] if moving.nq == 1 else [np.cos(value), np.sin(value)]
        full[moving.idx_q : moving.idx_q + moving.nq] = at
    pinocchio.framesForwardKinematics(model, data, full)
    return data.oMf[model.getFrameId(tip)].homogeneous


LOADED = {
    "blank first lines": "\n\n  <?xml version='1.0'?>\n" + robot(ARM + TOOL),
    "byte order mark": "\ufeff" + robot(ARM + TOOL),
    "default namespace": robot(ARM + TOOL, '<robot name="r" xmlns="http://www.ros.org">'),
    "unused property": robot(
        '<xacro:property name="w" value="1"/>' + ARM + TOOL, f'<robot name="r" {XMLNS}>'
    ),
    "undeclared prefix": robot('<xacro:property name="w" value="1"/>' + ARM + TOOL),
    "expressions of a simulator": robot('<gazebo><plugin name="${x}"/></gazebo>' + ARM + TOOL),
    "visual without a shape": robot(
        changed('<link name="l3"/>', '<link name="l3"><visual><geometry/></visual></link>')
    ),
    "missing mesh": robot(changed('<link name="l3"/>', f'<link name="l3">{MESH}</link>')),
    "continuous joint with empty limits": robot(
        ARM.replace(
            joint(4), joint(4, kind="continuous").replace("-2.5", "0").replace("2.6", "0")
        )
        + TOOL
    ),
    "joints before links, in any order": robot(
        "".join(joint(i) for i in (4, 1, 6, 2, 5, 3)) + TOOL + LINKS
    ),
    "mimic before its leader": robot(
        jaw("grip_left", "left_finger").replace(
            "</joint>", '<mimic joint="grip_right" multiplier="-1"/></joint>'
        )
        + jaw("grip_right", "right_finger")
        + ARM
        + TOOL
    ),
    "mimic of a joint that there is not": robot(
        jaw("grip_left", "left_finger").replace("</joint>", '<mimic joint="gone"/></joint>')
        + ARM
        + TOOL
    ),
    "two fingers": robot(
        ARM + TOOL + jaw("a", "b", "tool0", "prismatic") + jaw("c", "d", "tool0", "prismatic")
    ).replace('<link name="l0"/>', '<link name="l0"/><!-- <mujoco/> -->'),
}


@pytest.mark.parametrize("kind", LOADED)
def test_what_others_load_is_loaded_and_moves_as_theirs(tmp_path, kind):
    text = LOADED[kind]
    ours = load(tmp_path, text, tip="tool0")
    assert ours.joint_names == tuple(NAMES)
    positions = within(ours.limits.lower, ours.limits.upper, 3, rng=generator(1), margin=0.0)
    for q in positions:
        flange = ours.forward(q).matrix().numpy()
        theirs = pinocchio_flange(text.lstrip("\ufeff"), "tool0", q.numpy())
        assert_close(flange, theirs, rtol=0, atol=1e-9)
        if "xmlns" not in text and "xacro" not in text:  # which the tests' parser treats
            theirs = mujoco_flange(text.lstrip("\ufeff"), "tool0", q.numpy())
            assert_close(flange, theirs, rtol=0, atol=1e-9)


REFUSED = {
    "two parents": (ARM + TOOL + joint(7, child="l3"), "l3 has two .* joints j3 and j7"),
    "two parents of a tool": (
        ARM
        + TOOL
        + '<joint name="x" type="fixed"><parent link="l1"/><child link="tool0"/></joint>',
        "tool0 has two parents",
    ),
    "two joints of one name": (changed('"j3"', '"j2"'), "two joints of the name 'j2'"),
    "two links of one name": (ARM + '<link name="l2"/>' + TOOL, "two links of the name 'l2'"),
    "cycle": (changed('parent link="l0"', 'parent link="tool0"'), "form a cycle"),
    "cycle apart": (
        ARM + TOOL + '<link name="a"/><link name="b"/>'
        '<joint name="x" type="fixed"><parent link="a"/><child link="b"/></joint>'
        '<joint name="y" type="fixed"><parent link="b"/><child link="a"/></joint>',
        "link a is its own ancestor",
    ),
    "own parent": (changed('parent link="l2"', 'parent link="l3"'), "cycle"),
    "two pieces": (changed(joint(3), ""), "no joint carries the links l0, l3"),
    "unknown child": (changed('child link="l3"', 'child link="x"'), "no such link"),
    "unknown type": (changed('"j3" type="revolute"', '"j3" type="hinge"'), "'hinge'"),
    "velocity 0": (changed('velocity="2"', 'velocity="0"', 1), "j1 .*velocity limit 0"),
    "velocity -3": (changed('velocity="2"', 'velocity="-3"', 1), "velocity limit -3"),
    "range 0": (changed('lower="-2.5"', 'lower="2.6"', 1), "range 2.6 to 2.6"),
    "offset 1e300": (changed('xyz="0.1', 'xyz="1e300', 1), r"1e\+300 m"),
    "far shape": (changed('<link name="l2"/>', f'<link name="l2">{FAR}</link>'), "m from"),
    "inertia": (changed('<link name="l2"/>', f'<link name="l2">{HEAVY}</link>'), "not finite"),
    "millimetres": (changed('xyz="0.1', 'xyz="333', 1), "lengths are in metres"),
    "infinite": (changed('xyz="0.1', 'xyz="inf', 1), "not finite numbers"),
    "not a number": (changed('upper="2.6"', 'upper="nan"', 1), "finite"),
    "digits apart": (changed('xyz="0.1', 'xyz="1_0', 1), "finite number"),
    "a unit": (changed('lower="-2.5"', 'lower="-2.5m"', 1), "lower='-2.5m'"),
    "zero axis": (changed('axis xyz="0 1 0"', 'axis xyz="0 0 0"', 1), "axis .* is zero"),
    "expression": (changed('xyz="0.1', 'xyz="${x}', 1), r"holds \$\{x\}.*xacro first"),
    "macro": (ARM + TOOL + "<xacro:macro name='m'/>", "xacro:macro"),
    "planar": (changed('"j3" type="revolute"', '"j3" type="planar"'), "j3 is planar"),
    "tie": (
        changed(joint(3), joint(3, more='<mimic joint="j2"/>')),
        "j3 only follows j2",
    ),
    "own leader": (
        ARM + TOOL + jaw("left", "a").replace("</joint>", '<mimic joint="left"/></joint>'),
        "joint left follows left: let",
    ),
    "ring of leaders": (
        ARM + TOOL
        + jaw("left", "a").replace("</joint>", '<mimic joint="right"/></joint>')
        + jaw("right", "b").replace("</joint>", '<mimic joint="left"/></joint>'),
        "joint left follows right, which follows left: let",
    ),
    "negative mass": (
        changed('<link name="l2"/>', f'<link name="l2">{LIGHT}</link>'),
        "link l2 has the negative mass -1 kg",
    ),
    "no parent": (changed('<parent link="l2"/>', ""), "joint j3 has no <parent>"),
    "no child": (changed('<child link="l3"/>', ""), "joint j3 has no <child>"),
    "unnamed parent": (changed('link="l2"/><c', '/><c'), "<parent> of joint j3 has no link"),
    "nothing": ("", "has no links"),
}  # fmt: skip


@pytest.mark.parametrize("kind", REFUSED)
def test_what_is_no_serial_arm_is_refused_in_a_line(tmp_path, kind):
    content, message = REFUSED[kind]
    with pytest.raises(ValueError, match=message) as refusal:
        load(tmp_path, robot(content), tip="tool0" if content else None)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize(
    ("choice", "message"),
    [
        ({"base": "x"}, "has no link 'x' to be the base; its links are l0, l1, l2"),
        ({"tip": "y"}, "has no link 'y' to be the tip"),
        ({"base": "l3", "tip": "l1"}, "link 'l1' does not hang on 'l3', but on 'l0'"),
        ({"base": "l6", "tip": "tool0"}, "no joint moves between 'l6' and 'tool0'"),
        ({"base": "l6"}, "no joint moves a link that hangs on 'l6'"),
        ({"limits": {"j9": {"velocity": 1.0}}}, "limits are given for 'j9', but the joints"),
        ({"limits": {"j1": {"speed": 1.0}}}, "unknown limits of j1: speed; known are .*jerk"),
    ],
)
def test_choices_that_the_file_does_not_offer_are_named(tmp_path, choice, message):
    with pytest.raises(ValueError, match=message) as refusal:
        load(tmp_path, robot(ARM + TOOL), **choice)
    assert "\n" not in str(refusal.value)


def test_a_file_that_is_not_there_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"there is no robot description .*gone\.urdf"):
        arm(tmp_path / "gone.urdf")


@pytest.mark.parametrize(
    "kind", ["two parents", "two joints of one name", "two links of one name", "infinite"]
)
def test_pinocchio_refuses_them_too(kind):
    pinocchio = pytest.importorskip("pinocchio")
    with pytest.raises(ValueError, match=r"valid URDF model|any body named l6"):
        pinocchio.buildModelFromXML(robot(REFUSED[kind][0]))


def test_a_broken_mesh_is_no_capsule(tmp_path):
    (tmp_path / "no.stl").write_bytes(b"solid\n")
    content = changed('<link name="l3"/>', f'<link name="l3">{MESH}</link>')
    described = load(tmp_path, robot(content.replace("package://not/there.stl", "no.stl")))
    with pytest.warns(UserWarning, match=r"no capsule for a shape of link 3: .*no\.stl"):
        assert described.whole.capsules


def test_a_long_chain_is_no_deep_recursion(tmp_path):
    many = "".join(fixed(f"f{i}", f"e{i}" if i else "l6", f"e{i + 1}") for i in range(2000))
    assert load(tmp_path, robot(ARM + many)).tip == "e2000"


def test_missing_meshes_are_told_in_one_warning(tmp_path):
    path = tmp_path / "robot.urdf"
    path.write_text(LOADED["missing mesh"])
    with pytest.warns(UserWarning, match=r"1 meshes are missing, such as package://not/there"):
        described = arm(path)
    assert len(described.whole.capsules) > 0


HANDS = {
    "one jaw": (ARM + jaw("gripper", "jaw"), "l6"),
    "a jaw on a plate": (ARM + TOOL + jaw("j7", "moving_jaw", "tool0"), "tool0"),
    "knuckle and finger": (
        ARM + jaw("left_knuckle_joint", "a") + jaw("left_finger_joint", "b", "a"),
        "l6",
    ),
    "two fingers": (
        ARM + fixed("h", "l6", "hand") + fixed("t", "hand", "hand_tcp")
        + jaw("f1", "left", "hand", "prismatic") + jaw("f2", "right", "hand", "prismatic"),
        "hand_tcp",
    ),
    "fingers of no name": (ARM + jaw("j7", "l7") + jaw("j8", "l8"), "l6"),
    "camera beside": (ARM + TOOL + fixed("c", "l6", "wrist_camera_link"), "tool0"),
    "fixed jaw": (
        ARM.replace('"j6"', '"wrist_roll"').replace('"l6"', '"fixed_jaw"')
        + jaw("jaw", "moving_jaw", "fixed_jaw"),
        "fixed_jaw",
    ),
}  # fmt: skip


@pytest.mark.parametrize("kind", HANDS)
def test_joints_of_a_gripper_are_not_the_arms(tmp_path, kind):
    content, tip = HANDS[kind]
    path = tmp_path / "robot.urdf"
    path.write_text(robot(content))
    with warnings.catch_warnings(record=True) as notes:
        warnings.simplefilter("always")
        described = arm(path)
    assert described.joints == 6
    assert described.tip == tip
    named = {element.get("name") for element in ElementTree.fromstring(robot(content))}
    assert {finger.name for finger in described.shape.gripper} <= named
    assert (len(described.shape.gripper) > 0) == (kind != "camera beside")
    assert any(described.shape.gripper[0].name in str(note.message) for note in notes) or (
        kind == "camera beside" and not notes
    )


def test_a_hand_on_a_hand_is_placed_once(tmp_path):
    """Hands are found as a set, in an order that changes from one process to the next."""
    text = ARM + TOOL
    for k, below in enumerate(("l6", "hand1", "hand2", "hand3"), start=1):
        text += fixed(f"h{k}", below, f"hand{k}") + jaw(f"f{k}", f"finger{k}", f"hand{k}")
    for k, finger in enumerate(load(tmp_path, robot(text), tip="tool0").shape.gripper, 1):
        # Each hand is 0.1 m above the one below, and the tool 0.1 m above the link.
        height = finger.mount[2, 3] - 0.2
        assert finger.name == f"f{k}"
        assert height == pytest.approx(0.1 * (k - 1), abs=1e-12)


def test_a_tip_behind_the_jaw_is_taken_at_its_word(tmp_path):
    path = tmp_path / "robot.urdf"
    path.write_text(robot(HANDS["one jaw"][0]))
    with pytest.warns(UserWarning, match=r"joint gripper looks like a gripper's"):
        assert arm(path, tip="jaw").joints == 7


# Descriptions of public packages with several ends, and their tool frames.
@pytest.mark.parametrize(
    ("file", "tools"),
    [
        ("panda_description/urdf/panda.urdf", {"panda_hand_tcp"}),
        ("so_arm_description/urdf/so101.urdf", {"gripper_frame_link"}),
        ("tiago_description/robots/tiago.urdf", {"hand_tool_link"}),
        ("pr2_description/urdf/pr2.urdf", {"r_gripper_tool_frame", "l_gripper_tool_frame"}),
        ("talos_data/robots/talos_reduced.urdf", {"gripper_left_base_link"}),
        ("kinova_description/robots/kinova.urdf", {"j2s6s200_end_effector"}),
    ],
)
def test_the_tip_suggested_is_the_tool_frame(file, tools):
    try:
        known = arm("ur5").description
    except MissingModelError as error:
        pytest.skip(str(error))
    path = next(folder for folder in known.parents if folder.name == "robots") / file
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            suggested = arm(path).tip
    except ValueError as error:
        suggested = str(error).partition("likeliest first: ")[2].split(", ")[0]
    assert suggested in tools


def test_a_wrist_with_a_bar_and_fingers_ends_at_its_effector_frame(tmp_path):
    """The tree of Interbotix's WidowX 250s."""
    hand = (
        fixed("arm", "l6", "ee_arm_link")
        + jaw("gripper", "gripper_prop_link", kind="continuous")
        + fixed("bar", "ee_arm_link", "gripper_bar_link")
        + fixed("bar2", "gripper_bar_link", "fingers_link")
        + jaw("left_finger", "left_finger_link", "fingers_link", "prismatic")
        + jaw("right_finger", "right_finger_link", "fingers_link", "prismatic")
        + fixed("ee", "fingers_link", "ee_gripper_link")
    )  # fmt: skip
    assert load(tmp_path, robot(ARM + hand)).tip == "ee_gripper_link"


MJCF = """
<mujoco><compiler angle="radian"/><worldbody><body name="base">
{bodies}
</worldbody><equality>{equality}</equality><keyframe>{keyframe}</keyframe></mujoco>
"""


def mjcf(equality: str = "", keyframe: str = "") -> str:
    open_ = "".join(
        f'<body name="b{i}" pos="0.1 0 0.2"><geom size="0.02"/>'
        f'<joint name="j{i}" axis="{(i + 1) % 2} {i % 2} 0" range="-2 2"/>'
        for i in range(1, 7)
    )
    bodies = open_ + '<site name="tcp" pos="0 0 0.1"/>' + "</body>" * 7
    return MJCF.format(bodies=bodies, equality=equality, keyframe=keyframe)


ACTUATORS = """<actuator>
<motor joint="j1" gear="5" ctrlrange="-3 2"/>
<motor joint="j2" gear="50" forcerange="-1 4"/>
<motor joint="j3" gear="-2" ctrlrange="-3 3" forcerange="-4 2.5"/>
<general joint="j4" gear="3" gainprm="7" ctrlrange="-1 2"/>
<position joint="j5" gear="2" kp="100" forcerange="-6 5"/>
<motor joint="j6" gear="90" ctrlrange="-1 1"/>
</actuator></mujoco>"""


def test_torque_limits_are_what_the_actuators_can_do_in_mujoco(tmp_path):
    text = mjcf().replace("</mujoco>", ACTUATORS)
    text = text.replace('<joint name="j6"', '<joint name="j6" actuatorfrcrange="-8 9"')
    model = mujoco.MjModel.from_xml_string(text)
    data, most = mujoco.MjData(model), np.zeros(6)
    for control in (-1e6, 1e6):
        data.ctrl[:] = control
        mujoco.mj_forward(model, data)
        most = np.maximum(most, np.abs(data.qfrc_actuator))
    limits = load(tmp_path, text, ".xml").limits
    np.testing.assert_allclose(limits.torque, most)
    free = load(tmp_path, mjcf(), ".xml").limits
    assert bool((free.torque == torch.inf).all())


TIE = '<joint joint1="j3" joint2="j2" polycoef="0 1 0 0 0" active="{}"/>'


def test_only_active_equalities_tie_joints(tmp_path):
    assert load(tmp_path, mjcf(TIE.format("false")), ".xml").joints == 6
    with pytest.raises(ValueError, match="j3 only follows j2"):
        load(tmp_path, mjcf(TIE.format("true")), ".xml")
    held = '<joint joint1="j3" polycoef="0.5 0 0 0 0"/>'
    with pytest.raises(ValueError, match=r"j3 is held at 0\.5"):
        load(tmp_path, mjcf(held), ".xml")


def test_coupled_fingers_count_from_their_reference_positions(tmp_path):
    fingers = "".join(
        f'<body name="f{i}"><geom size="0.01"/><joint name="finger{i}" type="slide" '
        f'axis="0 1 0" range="-0.1 0.1" ref="{ref}"/></body>'
        for i, ref in ((1, 0.02), (2, 0.01))
    )
    tie = '<joint joint1="finger2" joint2="finger1" polycoef="0.003 -2 0 0 0"/>'
    text = mjcf(tie).replace('<site name="tcp"', f'{fingers}<site name="tcp"')
    _, second = load(tmp_path, text, ".xml").shape.gripper
    leader, factor, offset = second.follows
    assert leader == "finger1"
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    data.qpos[6:] = 0.04, factor * 0.04 + offset
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(data.efc_pos[: data.ne], [0.0], rtol=0, atol=1e-12)


def test_a_home_outside_the_limits_is_moved_to_them_with_a_warning(tmp_path):
    path = tmp_path / "robot.xml"
    path.write_text(mjcf(keyframe='<key name="home" qpos="0 0 2.5 -3 0 1"/>'))
    with pytest.warns(UserWarning, match="`home` is outside the limits"):
        described = arm(path)
    assert described.ready.tolist() == [0, 0, 2, -2, 0, 1]
    with pytest.raises(ValueError, match=r"joint j3 at 2\.5 is outside its limits"):
        arm(path, ready=[0.0, 0.0, 2.5, 0.0, 0.0, 0.0])


def test_the_format_is_told_by_the_first_element(tmp_path):
    described = load(tmp_path, robot(ARM + TOOL), ".xml")
    assert (described.joint_names, described.tip) == (tuple(NAMES), "tool0")
    assert load(tmp_path, mjcf(), ".mjcf").tip == "tcp"
    with pytest.raises(ValueError, match="neither URDF nor MJCF: it begins with <launch>"):
        load(tmp_path, "<launch/>", ".xml")
    with pytest.raises(ValueError, match="is no XML"):
        load(tmp_path, "", ".urdf")


def test_unnamed_parts_of_mjcf_have_names_of_their_own(tmp_path):
    text = mjcf().replace('name="j2" ', "").replace('name="b2" ', "").replace('name="j4" ', "")
    assert load(tmp_path, text, ".xml").joints == 6


def test_shapes_that_are_no_capsules_leave_the_arm_as_it_is(tmp_path):
    """Vertices in the description itself and ellipsoids; MuJoCo moves with them alike."""
    corners = "0 0 0 0.1 0 0 0 0.1 0 0 0 0.1"
    text = mjcf().replace(
        "<worldbody>", f'<asset><mesh name="m" vertex="{corners}"/></asset><worldbody>'
    )
    text = text.replace(
        '<body name="b2" pos="0.1 0 0.2">',
        '<body name="b2" pos="0.1 0 0.2"><geom type="mesh" mesh="m"/>'
        '<geom type="ellipsoid" size="0.1 0.2 0.3"/>',
    )
    plain, shaped = load(tmp_path, mjcf(), ".xml"), load(tmp_path, text, ".xml")
    assert len(shaped.shape.shapes) == len(plain.shape.shapes) == 6
    q = within(plain.limits.lower, plain.limits.upper, 3, rng=generator(2), margin=0.0)
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    for joints in q:
        data.qpos[:] = joints
        mujoco.mj_kinematics(model, data)
        tool = shaped.forward(joints).position
        np.testing.assert_allclose(tool, data.site("tcp").xpos, rtol=0, atol=1e-9)


def test_shapes_of_a_urdf_are_as_large_and_where_mujoco_has_them(tmp_path):
    forms = (
        '<box size="0.1 0.2 0.4"/>',
        '<cylinder radius="0.03" length="0.5"/>',
        '<capsule radius="0.02" length="0.3"/>',
        '<sphere radius="0.07"/>',
    )
    shapes = "".join(
        f'<collision><origin xyz="0.{i} 0.1 -0.2" rpy="0.{i} 0.5 -0.3"/>'
        f"<geometry>{form}</geometry></collision>"
        for i, form in enumerate(forms)
    )
    weight = '<mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/>'
    link = f'<link name="l1"><inertial>{weight}</inertial>{shapes}</link>'
    text = robot(f'<link name="l0"/>{link}{joint(1)}')
    path = tmp_path / "robot.urdf"
    path.write_text(text, encoding="utf-8")
    ours = read_urdf(path).links["l1"]
    model = mujoco.MjModel.from_xml_string(text)
    for geom, shape in enumerate(ours.collisions):
        kind = mujoco.mjtGeom(model.geom_type[geom]).name.removeprefix("mjGEOM_").lower()
        assert shape.kind == kind
        size = model.geom_size[geom][: 1 if kind == "sphere" else None]
        np.testing.assert_allclose(shape.size[: len(size)], size[: len(shape.size)])
        turn = np.empty(9)
        mujoco.mju_quat2Mat(turn, model.geom_quat[geom])
        np.testing.assert_allclose(shape.pose[:3, :3], turn.reshape(3, 3), atol=1e-9)
        np.testing.assert_allclose(shape.pose[:3, 3], model.geom_pos[geom], atol=1e-9)
    assert geom == model.ngeom - 1 == 3


def test_limits_of_motion_have_to_be_positive(tmp_path):
    (tmp_path / "robot.limits.toml").write_text("[default]\nvelocity = 1.5\n")
    slow = robot(changed('velocity="2"', 'velocity="0"'))
    assert set(load(tmp_path, slow).limits.velocity.tolist()) == {1.5}
    for wrong in ("acceleration = 0", "jerk = -1", "torque = -1"):
        (tmp_path / "robot.limits.toml").write_text(f"[default]\n{wrong}\n")
        with pytest.raises(ValueError, match=r"not positive and finite; set it with limits="):
            load(tmp_path, robot(ARM + TOOL))
    for wrong in ('velocity = "fast"', "velocity = true"):
        (tmp_path / "robot.limits.toml").write_text(f"[j1]\n{wrong}\n")
        with pytest.raises(ValueError, match=r"limits.toml: \[j1\] must be a table of numbers"):
            load(tmp_path, robot(ARM + TOOL))
    (tmp_path / "robot.limits.toml").unlink()
    limits = load(tmp_path, robot(changed('effort="50"', 'effort="0"'))).limits
    assert bool((limits.torque == torch.inf).all())
