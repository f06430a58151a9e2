"""Arms from descriptions, against MuJoCo; their inverses, and what is said of bad files."""

import sys
from importlib.metadata import PackageNotFoundError

import mujoco
import numpy as np
import pytest
import torch
from sampling import generator
from scipy.spatial.transform import Rotation
from torch.testing import assert_close

from hrc_learn.kinematics import (
    Arm,
    ArmChoice,
    LinkCapsule,
    MissingModelError,
    arm,
    null_space_dimension,
    panda,
    registered_arms,
    registry,
    solve_inverse,
)
from hrc_learn.kinematics.capsule_fit import (
    capsule_volume,
    fit_body,
    fit_link,
    hull_of,
    shape_points,
)
from hrc_learn.kinematics.chain import transform_and_jacobian
from hrc_learn.kinematics.description import Shape, turn_to

ODD = """
<robot name="odd">
  <link name="base"/><link name="a"/><link name="b"/><link name="c"/><link name="tip"/>
  <link name="finger"/>
  <joint name="turn" type="continuous"><parent link="base"/><child link="a"/>
    <origin xyz="0.1 0 0.3" rpy="0.2 0.1 -0.4"/><axis xyz="0.6 0 -0.8"/></joint>
  <joint name="slide" type="prismatic"><parent link="a"/><child link="b"/>
    <origin xyz="0 0.2 0.1" rpy="0 0 0.7"/><axis xyz="0 -1 0"/>
    <limit lower="-0.2" upper="0.5" velocity="0.4" effort="6"/></joint>
  <joint name="bend" type="revolute"><parent link="b"/><child link="c"/>
    <origin xyz="0 0 0.2" rpy="0 -1.1 0"/><axis xyz="1 0 0"/>
    <limit lower="-3" upper="3" velocity="7" effort="8"/></joint>
  <joint name="end" type="fixed"><parent link="c"/><child link="tip"/>
    <origin xyz="0 0.1 0.1" rpy="0 0 0.3"/></joint>
  <joint name="grip" type="prismatic"><parent link="c"/><child link="finger"/>
    <axis xyz="0 1 0"/><limit lower="0" upper="0.04" velocity="1" effort="1"/></joint>
</robot>
"""
INERTIAL = """<inertial><mass value="1"/>
<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>"""


def installed(name: str) -> Arm:
    try:
        return arm(name)
    except MissingModelError as error:
        pytest.skip(str(error))


def random_positions(chain, count: int, seed: int) -> torch.Tensor:
    lower, upper = chain.limits.lower, chain.limits.upper
    random = torch.rand(count, len(lower), generator=generator(seed), dtype=torch.float64)
    return lower + (upper - lower) * random


def assert_moves_like(a: Arm, model, base: str | None, tip: str, count: int) -> None:
    """Pose and Jacobian of the tip in the base frame are MuJoCo's."""
    data = mujoco.MjData(model)
    addresses = [int(model.joint(name).qposadr[0]) for name in a.joint_names]
    columns = [int(model.joint(name).dofadr[0]) for name in a.joint_names]
    flange = a.with_tool(torch.eye(4, dtype=torch.float64))
    q = random_positions(flange, count, seed=1)
    poses, jacobians = flange.forward_and_jacobian(q)
    J = np.zeros((6, model.nv))
    for row, T, ours in zip(q, poses.matrix(), jacobians, strict=True):
        data.qpos[addresses] = row
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_jacBody(model, data, J[:3], J[3:], model.body(tip).id)
        root = data.body(base) if base else data.body(0)
        R, place = root.xmat.reshape(3, 3), data.body(tip)
        assert_close(T[:3, 3].numpy(), R.T @ (place.xpos - root.xpos), rtol=0, atol=1e-9)
        assert_close(T[:3, :3].numpy(), R.T @ place.xmat.reshape(3, 3), rtol=0, atol=1e-9)
        turned = np.concatenate([R.T @ J[:3, columns], R.T @ J[3:, columns]])
        assert_close(ours.numpy(), turned, rtol=0, atol=1e-9)


def mujoco_model(a: Arm):
    """MuJoCo's own reading of the file; of URDF without shapes, which it does not all know."""
    assert a.description is not None
    if a.description.suffix != ".urdf":
        return mujoco.MjModel.from_xml_path(str(a.description))
    from xml.etree import ElementTree

    robot = ElementTree.parse(a.description).getroot()
    for link in robot.findall("link"):
        for part in list(link):
            link.remove(part)
        link.append(ElementTree.fromstring(INERTIAL))
    # Links without a joint between them are kept apart.
    extension = '<mujoco><compiler fusestatic="false"/></mujoco>'
    robot.append(ElementTree.fromstring(extension))
    return mujoco.MjModel.from_xml_string(ElementTree.tostring(robot, encoding="unicode"))


DESCRIBED = sorted(set(registered_arms()) - {"panda", "fr3"})


@pytest.mark.parametrize("name", DESCRIBED)
def test_registered_arms_move_like_mujocos(name):
    a = installed(name)
    assert_moves_like(a, mujoco_model(a), a.base, a.tip, 20)


@pytest.mark.slow
@pytest.mark.parametrize("name", DESCRIBED)
def test_registered_arms_move_like_mujocos_in_many_states(name):
    a = installed(name)
    assert_moves_like(a, mujoco_model(a), a.base, a.tip, 10_000)


@pytest.mark.parametrize("name", registered_arms())
def test_registered_arms_find_poses_they_can_reach(name):
    chain = installed(name).chain
    task = "pose" if len(chain.joint_names) > 5 else "position+axis"
    q = random_positions(chain, 20, seed=2)
    pose = chain.forward(q)
    solution = solve_inverse(chain, pose, task=task)
    found = solution.found
    assert found.double().mean() >= 0.95
    q = solution.position[found]
    assert chain.limits.contain(q).all()
    reached = chain.forward(q).matrix()
    assert_close(reached[:, :3, 3], pose.position[found], rtol=0, atol=1e-5)
    wanted = pose.matrix()[found]
    columns = slice(2, 3) if task == "position+axis" else slice(0, 3)
    assert_close(reached[:, :3, columns], wanted[:, :3, columns], rtol=0, atol=1e-5)


@pytest.mark.parametrize("name", registered_arms())
def test_registered_arms_are_ready_within_limits(name):
    a = installed(name)
    assert a.chain.limits.contain(a.chain.ready)
    assert a.shape.meshes or a.description is None
    assert all(mesh.path.is_file() for meshes in a.shape.meshes.values() for mesh in meshes)


@pytest.mark.parametrize("name", ["panda", "fr3"])
def test_the_links_of_frankas_arms_weigh_what_their_description_says(name):
    ur5 = installed("ur5").description
    assert ur5 is not None
    robots = next(folder for folder in ur5.parents if folder.name == "robots")
    described = arm(robots / "panda_description/urdf/panda.urdf", tip="panda_link8")
    assert_close(
        ArmChoice(name).work_arm().masses[1:8], described.masses[1:8], rtol=0, atol=0.005
    )
    # The description has the fingers apart.
    assert installed(name).masses[-1] == pytest.approx(described.masses[-1], abs=0.05)


def odd(tmp_path, text: str = ODD) -> Arm:
    (tmp_path / "odd.urdf").write_text(text, encoding="utf-8")
    return arm(tmp_path / "odd.urdf", tip="tip")


def test_any_axis_and_sliding_joints(tmp_path):
    a = odd(tmp_path)
    assert a.chain.kinds == ("continuous", "prismatic", "revolute")
    assert_moves_like(a, mujoco_model(a), "base", "tip", 50)
    assert [(j.name, j.closed, j.opened) for j in a.shape.gripper] == [("grip", 0.0, 0.04)]


def test_written_out_kinematics_slide_too(tmp_path):
    chain = odd(tmp_path).chain
    q = random_positions(chain, 5, seed=3)
    tip = (chain.flange @ chain.tcp).tolist()
    written = transform_and_jacobian(q, chain.mounts.tolist(), tip, (False, True, False))
    for ours, expected in zip(written, chain.transform_and_jacobian(q), strict=True):
        assert_close(ours, expected, rtol=0, atol=1e-14)


def test_fingers_are_where_mujoco_has_them_from_closed_to_open(tmp_path):
    box = '<collision><origin xyz="0 0 0.01"/><geometry><box size="1 1 1"/></geometry>'
    text = ODD.replace('<link name="finger"/>', f'<link name="finger">{box}</collision></link>')
    for axis, lower, upper in (("0 1 0", 0, 0.04), ("0.6 0 -0.8", -0.03, 0.01)):
        limits = f'<axis xyz="{axis}"/><limit lower="{lower}" upper="{upper}"'
        gripping = text.replace('<axis xyz="0 1 0"/><limit lower="0" upper="0.04"', limits)
        for kind in ("prismatic", "revolute"):
            joint = f'<joint name="grip" type="{kind}">'
            a = odd(tmp_path, gripping.replace('<joint name="grip" type="prismatic">', joint))
            model = mujoco_model(a)
            data = mujoco.MjData(model)
            (finger,) = a.shape.gripper
            assert {finger.closed, finger.opened} == {lower, upper}
            assert abs(finger.opened) > abs(finger.closed)
            values = np.linspace(finger.closed, finger.opened, 5)
            for value, (link, shape) in zip(values, a.shape.shapes, strict=True):
                assert link == a.joints + 2
                data.joint("grip").qpos[0] = value
                mujoco.mj_kinematics(model, data)
                tip, moved = data.body("tip"), data.body("finger")
                R = tip.xmat.reshape(3, 3)
                centre = moved.xpos + moved.xmat.reshape(3, 3) @ [0, 0, 0.01] - tip.xpos
                assert_close(shape.pose[:3, 3], R.T @ centre, rtol=0, atol=1e-12)
                turned = R.T @ moved.xmat.reshape(3, 3)
                assert_close(shape.pose[:3, :3], turned, rtol=0, atol=1e-12)


def test_limits_that_the_file_lacks_follow_the_rule(tmp_path):
    limits = odd(tmp_path).chain.limits
    assert limits.upper.tolist() == [2 * torch.pi, 0.5, 3.0]
    assert limits.velocity.tolist() == [1.0, 0.4, 7.0]
    assert_close(limits.acceleration, limits.velocity / 0.2)
    assert_close(limits.jerk, limits.acceleration / 0.02)
    assert limits.torque.tolist() == [torch.inf, 6.0, 8.0]


def test_limits_beside_the_file_come_first(tmp_path):
    text = "[default]\njerk = 9.0\n[bend]\nvelocity = 2.0\n"
    (tmp_path / "odd.limits.toml").write_text(text, encoding="utf-8")
    limits = odd(tmp_path).chain.limits
    assert limits.jerk.tolist() == [9.0, 9.0, 9.0]
    assert limits.velocity.tolist() == [1.0, 0.4, 2.0]


# None of them is registered.
@pytest.mark.parametrize(
    ("file", "base", "tip", "joints"),
    [
        ("kinova_description/robots/kinova.urdf", None, "j2s6s200_end_effector", 6),
        ("talos_data/robots/talos_reduced.urdf", "torso_2_link", "gripper_left_base_link", 7),
        ("tiago_description/robots/tiago_no_hand.urdf", "torso_lift_link", "arm_tool_link", 7),
        ("baxter_description/urdf/baxter.urdf", "torso", "left_gripper", 7),
    ],
)
def test_a_description_that_nobody_prepared_is_taken(file, base, tip, joints):
    ur5 = installed("ur5").description
    assert ur5 is not None
    path = next(folder for folder in ur5.parents if folder.name == "robots") / file
    a = arm(path, base=base, tip=tip)
    assert len(a.joint_names) == joints
    assert_moves_like(a, mujoco_model(a), a.base, tip, 20)
    pose = a.chain.forward(random_positions(a.chain, 20, seed=2))
    assert solve_inverse(a.chain, pose).found.double().mean() >= 0.95


def test_choices_that_an_arm_does_not_offer_are_named(monkeypatch):
    with pytest.raises(ValueError, match="panda is written in this package: tip cannot be"):
        arm("panda", tip="panda_link7")
    other = installed("ur5e")
    pose = other.forward(other.ready)
    with pytest.raises(ValueError, match="ur5e has no closed-form inverse for the task"):
        other.inverse(pose, q7=0.1)
    with pytest.raises(ValueError, match=r"panda has no .* 'position', so q7 does not apply"):
        panda.inverse(panda.forward(panda.ready), q7=0.1, task="position")
    with pytest.raises(ValueError, match="ur5e has no closed-form inverse: use `postures`"):
        other.solutions(pose)

    def missing(name):
        raise PackageNotFoundError(name)

    monkeypatch.setattr(registry, "distribution", missing)
    with pytest.raises(MissingModelError, match=r"description of ur5e is in .* pip install "):
        arm("ur5e", tip="tool0")


def test_unknown_names_are_answered_with_those_there_are():
    with pytest.raises(ValueError, match="no arm 'unicorn': there are panda, fr3"):
        arm("unicorn")


@pytest.mark.parametrize("axis", [*np.eye(3), *-np.eye(3), [0.6, 0.0, -0.8]])
def test_turns_take_z_to_the_axis(axis):
    R = turn_to(np.array(axis))[:3, :3]
    assert_close(R[:, 2], np.array(axis, dtype=float), rtol=0, atol=1e-15)
    assert_close(R @ R.T, np.eye(3), rtol=0, atol=1e-15)
    assert np.linalg.det(R) == pytest.approx(1)


def test_null_space_that_tasks_leave():
    chain = installed("panda").chain
    tasks = ("pose", "position+axis", "position")
    assert [int(null_space_dimension(chain, chain.ready, task)) for task in tasks] == [1, 2, 4]


def gap(points, capsules):
    """Distance of points to the nearest of some capsules; negative inside."""
    distance = np.full(len(points), np.inf)
    for start, end, radius in capsules:
        way = end - start
        t = np.clip((points - start) @ way / max(way @ way, 1e-30), 0, 1)
        away = np.linalg.norm(points - start - t[:, None] * way, axis=1) - radius
        distance = np.minimum(distance, away)
    return distance


def tilted(*position):
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("xyz", [0.3, -0.5, 0.9]).as_matrix()
    pose[:3, 3] = position
    return pose


@pytest.mark.parametrize(
    ("kind", "size"),
    [
        ("box", (0.03, 0.05, 0.3)),
        ("box", (0.1, 0.1, 0.1)),
        ("box", (0.1, 0.2, 0.0)),  # flat: it has no hull
        ("cylinder", (0.04, 0.2)),
        ("capsule", (0.04, 0.2)),
        ("sphere", (0.04, 0.0)),
    ],
)
def test_capsules_contain_what_they_are_fitted_to(kind, size):
    shape, rng = (
        Shape(kind=kind, pose=tilted(0.1, 0.2, -0.3), size=size),
        np.random.default_rng(0),
    )
    if kind == "box":
        inside = (2 * rng.random((2000, 3)) - 1) * size
    else:
        (radius, half), unit = size, rng.normal(size=(2000, 3))
        unit /= np.linalg.norm(unit, axis=1, keepdims=True)
        if kind == "cylinder":
            unit[:, :2] /= np.linalg.norm(unit[:, :2], axis=1, keepdims=True)
            unit[:, 2] = 0.0
        inside = radius * unit + [[0, 0, half]] * rng.uniform(-1, 1, (2000, 1))
    inside = inside @ shape.pose[:3, :3].T + shape.pose[:3, 3]
    fitted = fit_link([hull_of(shape)])
    assert gap(inside, fitted).max() <= 0
    # A ball around a cube around a ball has 5.2 times its volume.
    far = np.linalg.norm(inside - shape.pose[:3, 3], axis=1).max()
    assert sum(map(capsule_volume, fitted)) < 6 * 4 / 3 * np.pi * far**3


@pytest.mark.parametrize(
    ("kind", "size", "extent", "points"),
    [
        ("box", (0.03, 0.05, 0.3), (0.03, 0.05, 0.3), 8),
        # The prism of 16 corners around a cylinder is 2 % wider.
        ("cylinder", (0.04, 0.2), (0.04 / np.cos(np.pi / 16),) * 2 + (0.2,), 32),
        ("capsule", (0.04, 0.2), (0.04, 0.04, 0.24), 8),
        ("sphere", (0.04, 0.0), (0.04, 0.04, 0.04), 8),
    ],
)
def test_corners_of_shapes_lie_at_their_ends(kind, size, extent, points):
    corners = shape_points(Shape(kind=kind, pose=np.eye(4), size=size))
    assert corners.shape == (points, 3)
    np.testing.assert_allclose(corners.max(0), extent, atol=1e-12)
    np.testing.assert_allclose(corners.min(0), -np.array(extent), atol=1e-12)


def test_a_bent_link_is_cut_into_its_bars():
    bars = [
        Shape(kind="box", pose=pose, size=(0.02, 0.02, 0.3))
        for pose in (tilted(0, 0, 0), tilted(0, 0, 0) @ turned_up())
    ]
    hulls = [hull_of(shape) for shape in bars]
    fitted = fit_link(hulls)
    for hull in hulls:
        assert gap(hull.points, fitted).max() <= 1e-9
    alone = [capsule for hull in hulls for capsule in fit_link([hull])]
    assert len(fitted) == len(alone) == 2
    # The fit has several optima: 14 % has been seen, beside NumPy 2.5.
    assert sum(map(capsule_volume, fitted)) < 1.2 * sum(map(capsule_volume, alone))


def turned_up():
    """A quarter turn at the end of a bar of 0.6 m, along which the next one stands."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("x", np.pi / 2).as_matrix()
    pose[:3, 3] = (0.0, -0.28, 0.28)
    return pose


@pytest.mark.parametrize("name", ["ur5e", "so101"])
def test_stored_capsules_contain_the_shapes_of_the_file(name):
    a = installed(name)
    fitted = {link for link, _ in a.shape.shapes}
    assert {capsule.link for capsule in a.whole.capsules} == fitted
    for link, shape in a.shape.shapes:
        points = shape_points(shape) @ shape.pose[:3, :3].T + shape.pose[:3, 3]
        away = np.full(len(points), np.inf)
        for capsule in a.whole.capsules:
            if capsule.link == link:
                start, way = np.array(capsule.start), np.subtract(capsule.end, capsule.start)
                t = np.clip((points - start) @ way / max(way @ way, 1e-30), 0, 1)
                gap = np.linalg.norm(points - start - t[:, None] * way, axis=1)
                away = np.minimum(away, gap - capsule.radius)
        assert away.max() < 1e-6


def test_most_postures_of_an_arm_are_no_contact_with_itself():
    a = installed("xarm7")
    q = random_positions(a, 500, seed=6)
    for body in (a.whole, fit_body(a, a.shape.shapes)):
        assert 0 < float((body.self_distance(q) < 0).double().mean()) < 0.4


def test_without_scipy_shapes_are_not_fitted_and_it_says_why(monkeypatch):
    monkeypatch.setitem(sys.modules, "scipy.spatial", None)
    box = Shape(pose=np.eye(4), kind="box", size=(0.1, 0.1, 0.1))
    with pytest.raises(ModuleNotFoundError, match=r"SciPy: pip install 'hrc-learn\[meshes\]'"):
        hull_of(box)


@pytest.mark.parametrize(("kind", "half"), [("capsule", 0.05), ("sphere", 0.0)])
def test_round_shapes_are_their_own_capsules(kind, half):
    pose = np.eye(4)
    pose[:3, :3] = [[0, 0, 1], [1, 0, 0], [0, 1, 0]]  # z along x of the link
    pose[:3, 3] = (0.1, 0.2, 0.3)
    shape = Shape(pose=pose, kind=kind, size=(0.02, half))
    # Links without shapes have capsules of their own.
    (capsule,) = (c for c in fit_body(panda, [(3, shape)]).capsules if c.link == 3)
    assert (capsule.link, capsule.radius) == (3, 0.02)
    np.testing.assert_allclose(capsule.start, (0.1 - half, 0.2, 0.3), atol=1e-12)
    np.testing.assert_allclose(capsule.end, (0.1 + half, 0.2, 0.3), atol=1e-12)


def test_masses_without_a_description_are_those_of_the_capsules():
    capsule = LinkCapsule(link=2, start=(0.0, 0.0, 0.1), end=(0.0, 0.0, 0.4), radius=0.05)
    masses = Arm(name="bare", chain=panda, capsules=[capsule]).masses
    cylinder, ball = np.pi * 0.05**2 * 0.3, 4 / 3 * np.pi * 0.05**3
    assert masses[2] == pytest.approx(1200 * (cylinder + ball))
    assert sum(masses) == masses[2]
