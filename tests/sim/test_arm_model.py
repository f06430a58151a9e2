"""The simulated arm against its own chain, for arms of other shapes than the Panda's."""

from dataclasses import replace
from functools import cache

import mujoco
import numpy as np
import pytest
import torch
from bare_arm import bare
from scipy.spatial.transform import Rotation

from hrc_learn.geometry import Pose, quaternion
from hrc_learn.kinematics import Arm, ArmChoice, LinkCapsule, panda
from hrc_learn.sim import ArmModelConfig, SceneConfig, World
from hrc_learn.sim.arm_model import Plate, add_arm, add_plate, whole_arm
from hrc_learn.sim.recorded_world import DrawnWorld
from hrc_learn.sim.scene import marked_plate
from hrc_learn.sim.workplace import Workplace
from hrc_learn.vision import Marker, marker_texture

ARMS = {
    "panda": lambda: panda,
    "fr3": ArmChoice("fr3").work_arm,
    "six": cache(lambda: bare().with_hand()),
}


@pytest.fixture(params=ARMS)
def robot(request):
    return ARMS[request.param]()


def test_mujoco_has_the_tool_where_the_chain_has_it(robot):
    world = World(Workplace.of(robot).scene)
    rng = np.random.default_rng(0)
    limits = robot.chain.limits
    for _ in range(5):
        q = rng.uniform(limits.lower.numpy(), limits.upper.numpy())
        world.reset(q)
        pose = robot.chain.forward(torch.from_numpy(q))
        np.testing.assert_allclose(world.arm.tcp_pose(), pose.matrix().numpy(), atol=1e-9)
        np.testing.assert_allclose(world.arm.read().joint_position, q)


def test_a_joint_that_slides_slides_in_mujoco_too():
    robot = bare((), slides=(0, 2)).with_hand()
    spec = mujoco.MjSpec()
    add_arm(spec, ArmModelConfig(robot=robot))
    model = spec.compile()
    data, rng, limits = mujoco.MjData(model), np.random.default_rng(0), robot.chain.limits
    for _ in range(5):
        q = rng.uniform(limits.lower.numpy(), limits.upper.numpy())
        data.qpos[:7] = q
        mujoco.mj_kinematics(model, data)
        T = robot.chain.forward(torch.from_numpy(q)).matrix().numpy()
        tool = data.site("tcp")
        np.testing.assert_allclose(tool.xpos, T[:3, 3], atol=1e-9)
        np.testing.assert_allclose(tool.xmat.reshape(3, 3), T[:3, :3], atol=1e-9)


def test_a_small_hand_is_a_small_copy_of_the_franka_hand():
    large, small = (
        World(SceneConfig(arm=ArmModelConfig(robot=bare().with_hand(size))))
        for size in (1.0, 0.7)
    )
    for name in ("finger_left", "finger_right", "finger_left_pad", "finger_right_pad"):
        one, other = large.model.geom(name), small.model.geom(name)
        np.testing.assert_allclose(other.size, 0.7 * one.size)
        np.testing.assert_allclose(other.pos, 0.7 * one.pos)
    for name in ("finger_left", "finger_right"):
        one, other = large.model, small.model
        np.testing.assert_allclose(other.body(name).pos, 0.7 * one.body(name).pos)
        np.testing.assert_allclose(
            other.actuator(name).forcerange, 0.7 * one.actuator(name).forcerange
        )
    widths = []
    for world in (large, small):
        world.arm.move(1.0)
        world.advance(1.0)
        widths.append(world.arm.read().gripper_width)
        world.reset(world.arm.robot.ready.numpy(), gripper_width=1.0)
        assert world.arm.read().gripper_width == pytest.approx(widths[-1], abs=1e-3)
    # The Franka hand opens by 80 mm.
    assert widths == pytest.approx([0.08, 0.056], abs=1e-3)


def test_it_holds_its_posture_and_follows_a_velocity(robot):
    workplace = Workplace.of(robot)
    world = World(workplace.scene)
    start = robot.chain.ready.numpy().copy()
    world.reset(start)
    world.advance(0.5)
    np.testing.assert_allclose(world.arm.read().joint_position, start, atol=2e-4)
    velocity = np.full(robot.joints, 0.1)
    world.arm.command(velocity)
    world.advance(0.5)
    moved = world.arm.read().joint_position - start
    np.testing.assert_allclose(moved, 0.05, atol=5e-3)


def test_its_capsules_are_those_of_the_distances(robot):
    spec_world = World(Workplace.of(robot).scene)
    world_capsules = [
        spec_world.model.geom(g)
        for g in range(spec_world.model.ngeom)
        if spec_world.model.geom_type[g] == mujoco.mjtGeom.mjGEOM_CAPSULE
    ]
    radii = sorted(float(geom.size[0]) for geom in world_capsules)
    assert radii == pytest.approx(sorted(c.radius for c in robot.body.capsules))
    total = sum(robot.masses[1 : robot.joints + 1])
    links = [spec_world.model.body(f"link{i + 1}").mass[0] for i in range(robot.joints)]
    assert sum(links) == pytest.approx(total)
    assert whole_arm(ArmModelConfig(robot=robot)) is robot.whole


@pytest.mark.parametrize("name", ["panda", "fr3"])
def test_the_workplace_is_within_reach(name):
    robot = ARMS[name]()
    workplace = Workplace.of(robot)
    reached = {
        "home": (workplace.home_joints(), workplace.home()),
        "hover": (workplace.hover_joints(), workplace.hover()),
    }
    near = workplace.home_joints()
    for shelf in workplace.shelf_names():
        goal = workplace.shelf(shelf)
        reached[shelf] = robot.inverse(goal, near=near), goal
    for q, goal in reached.values():
        assert robot.chain.limits.contain(q)
        tool: Pose = robot.chain.forward(q)
        assert (tool.position - goal.position).norm() < 1e-6
        assert quaternion.angle(tool.orientation, goal.orientation) < 1e-6


def test_a_drawn_world_is_where_the_world_is_and_leaves_it_alone():
    workplace = Workplace.of(panda)
    world = World(workplace.scene)
    before = world.model.ngeom
    drawn = DrawnWorld(world)
    world.reset(workplace.home_joints().numpy())
    world.move_obstacle("occluder", (0.1, 0.2, 0.3))
    drawn.update()
    assert world.model.ngeom == before
    for body in range(world.model.nbody):
        name = world.model.body(body).name
        np.testing.assert_allclose(drawn.data.body(name).xpos, world.data.body(name).xpos)
    # What is seen touches nothing, whatever touches something stays as it was.
    seen = drawn.model.ngeom - before
    touching = (drawn.model.geom_contype | drawn.model.geom_conaffinity) != 0
    own = (world.model.geom_contype | world.model.geom_conaffinity) != 0
    assert touching.sum() == own.sum()
    assert seen == 0 or seen > 50


def test_a_capsule_without_a_length_is_a_ball_and_a_base_may_have_several():
    point, radius = (0.0, 0.0, 0.1), 0.05
    balls = [LinkCapsule(link=i, start=point, end=point, radius=radius) for i in range(8)]
    robot = Arm(name="panda", chain=panda, capsules=[balls[0], *balls])
    spec = mujoco.MjSpec()
    add_arm(spec, ArmModelConfig(robot=robot))
    model = spec.compile()
    geoms = [model.geom(name) for name in ("link0", "link0_1", "link4_0")]
    for geom in geoms:
        assert geom.type[0] == mujoco.mjtGeom.mjGEOM_SPHERE
        np.testing.assert_allclose(geom.pos, point)
        assert geom.size[0] == radius


@pytest.fixture(scope="module")
def gripping():
    """The Panda's model alone, its plate included."""
    spec = mujoco.MjSpec()
    add_arm(spec, ArmModelConfig(robot=panda, marker=marked_plate()))
    return spec.compile()


def faces(model, data, name, axis):
    """Least and greatest coordinate of a box along an axis of the hand [m]."""
    hand, geom = data.body("hand"), data.geom(name)
    R = hand.xmat.reshape(3, 3).T @ geom.xmat.reshape(3, 3)
    middle = (hand.xmat.reshape(3, 3).T @ (geom.xpos - hand.xpos))[axis]
    reach = np.abs(R[axis]) @ model.geom(name).size
    return middle - reach, middle + reach


@pytest.mark.parametrize("opening", [0.0, 0.03, 0.08])
def test_pads_stand_as_far_apart_as_the_gripper_is_open_and_about_the_tool(gripping, opening):
    data = mujoco.MjData(gripping)
    for name in ("finger_left", "finger_right"):
        data.joint(name).qpos[0] = opening / 2
    mujoco.mj_forward(gripping, data)
    left, right = (faces(gripping, data, f"finger_{s}_pad", 1) for s in ("left", "right"))
    np.testing.assert_allclose((left[0], right[1]), (opening / 2, -opening / 2), atol=1e-12)
    # The tool centre point is in the middle of the pads, whose fingers carry them.
    along = [faces(gripping, data, f"finger_{s}_pad", 2) for s in ("left", "right")]
    np.testing.assert_allclose(np.mean(along, axis=1), 0.1034, atol=1e-9)
    for side in ("left", "right"):
        finger, pad = (
            np.array([faces(gripping, data, f"finger_{side}{part}", k) for k in range(3)])
            for part in ("", "_pad")
        )
        assert (finger[:, 1] > pad[:, 0]).all()
        assert (pad[:, 1] > finger[:, 0]).all()
        np.testing.assert_allclose(finger[0].sum(), 0, atol=1e-12)
        # Fingers begin where the hand ends, within a centimetre.
        assert abs(finger[2, 0] - faces(gripping, data, "hand", 2)[1]) < 0.01
    hand = np.array([faces(gripping, data, "hand", k) for k in range(3)])
    np.testing.assert_allclose(hand.T[0], (-0.03, -0.1, 0), atol=1e-9)
    np.testing.assert_allclose(hand.T[1], (0.03, 0.1, 0.066), atol=1e-9)


def test_fingers_squeeze_with_the_force_of_the_grip_and_move_together(gripping):
    for name in ("finger_left", "finger_right"):
        servo, joint = gripping.actuator(name), gripping.joint(name)
        np.testing.assert_allclose(servo.forcerange, (-40, 40))
        np.testing.assert_allclose(joint.range, (0, 0.04))
        # A servo of position and velocity, damped well beyond critically.
        stiffness, damping = servo.gainprm[0], -servo.biasprm[2]
        mass = gripping.dof_armature[joint.dofadr[0]] + gripping.body(name).mass[0]
        assert servo.biasprm[1] == -stiffness
        assert damping > 2 * np.sqrt(stiffness * mass)
        # Four millimetres off, it pulls with a fifth of that.
        assert stiffness * 0.004 == pytest.approx(8.0)
    assert gripping.eq_type.tolist() == [mujoco.mjtEq.mjEQ_JOINT]
    np.testing.assert_allclose(gripping.eq_data[0, :5], (0, 1, 0, 0, 0))


def test_the_hand_weighs_what_frankas_does(gripping):
    """0.73 kg, with fingers of 15 g each, and a plate of 20 g."""
    assert gripping.body("hand").mass[0] == pytest.approx(0.73 + 0.02)
    for name in ("finger_left", "finger_right"):
        assert gripping.body(name).mass[0] == pytest.approx(0.015)
    own = [b for b in range(1, gripping.nbody) if gripping.body(b).name != "link0"]
    assert (gripping.body_gravcomp[own] == 1).all()
    small = mujoco.MjSpec()
    add_arm(small, ArmModelConfig(robot=bare().with_hand(0.5)))
    assert small.compile().body("hand").mass[0] == pytest.approx(0.73 / 8)


def test_neighbours_and_parts_that_overlap_do_not_collide(gripping):
    names = [gripping.body(b).name for b in range(gripping.nbody)]
    pairs = {frozenset((names[s >> 16], names[s & 0xFFFF])) for s in gripping.exclude_signature}
    expected = {("finger_left", "finger_right"), ("link0", "link1"), ("world", "link1")}
    for a, b in panda.whole.overlapping:
        link = {9: "hand"}
        one, other = (link.get(k, f"link{k}") for k in (a, b))
        if {a, b} <= {*range(8), 9}:
            expected.add((one, other))
            if a == 0:
                expected.add(("world", other))
    assert pairs == {frozenset(pair) for pair in expected}


@pytest.mark.parametrize("name", ["panda", "six"])
def test_servos_and_motors_are_as_strong_as_the_arm(name):
    robot = ARMS[name]()
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    add_arm(spec, ArmModelConfig(robot=robot))
    model = spec.compile()
    for i, joint in enumerate(robot.joint_names):
        stated = float(robot.limits.torque[i])
        torque = stated if np.isfinite(stated) else 50.0
        position, velocity = (model.actuator(f"{joint}_{k}") for k in ("position", "velocity"))
        for servo in (position, velocity):
            np.testing.assert_allclose(servo.forcerange, (-torque, torque))
        stiffness, damping = position.gainprm[0], velocity.gainprm[0]
        inertia = model.dof_armature[model.joint(joint).dofadr[0]]
        if name == "panda":
            assert 150 < stiffness / torque <= 500
            assert 0.02 <= damping / stiffness <= 0.03
            assert inertia == pytest.approx(0.1)
        else:
            # Scaled with the torque; a small motor has a light rotor.
            assert (stiffness, damping) == pytest.approx((230 * torque, 0.03 * stiffness))
            assert inertia == pytest.approx(0.1 * min(1, torque / 50))
        limits = robot.limits
        np.testing.assert_allclose(
            model.joint(joint).range, (limits.lower[i], limits.upper[i]), atol=1e-12
        )


@pytest.mark.parametrize(("torque", "expected"), [(25.0, 0.05), (50.0, 0.1), (200.0, 0.1)])
def test_an_arm_without_stated_torques_is_taken_for_one_of_fifty(torque, expected):
    robot = bare().with_hand()
    stated = torch.full_like(robot.limits.torque, torque)
    robot.limits = replace(robot.limits, torque=stated)
    config = ArmModelConfig(robot=robot)
    assert (config.torque(2), config.armature(2)) == pytest.approx((torque, expected))
    robot.limits = replace(robot.limits, torque=torch.full_like(stated, torch.inf))
    assert (config.torque(0), config.armature(0)) == (50.0, 0.1)


def test_a_plate_lies_just_behind_its_picture_and_shows_its_marker():
    turn = Rotation.from_euler("xyz", [0.4, -0.7, 0.2])
    plate = Plate(
        marker=Marker(5, 0.06),
        position=(0.1, -0.2, 0.3),
        orientation=tuple(turn.as_quat(scalar_first=True).tolist()),
    )
    spec = mujoco.MjSpec()
    body = spec.worldbody.add_body(name="carrier", pos=(1, 2, 3))
    add_plate(spec, body, "mark", plate)
    picture = np.frombuffer(bytes(spec.texture("mark").data), np.uint8).reshape(400, 400, 3)
    np.testing.assert_array_equal(picture[..., 1], marker_texture(5, 400))
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    centre, half = np.add((1, 2, 3), plate.position), plate.marker.plate_size / 2
    site = data.site("mark")
    np.testing.assert_allclose(site.xpos, centre, atol=1e-12)
    np.testing.assert_allclose(site.xmat.reshape(3, 3), turn.as_matrix(), atol=1e-9)
    assert model.site("mark").group[0] > 2
    box = model.geom("mark_plate")
    np.testing.assert_allclose(box.size, (half, half, 0.001))
    at = data.geom("mark_plate")
    own = turn.inv().apply(at.xpos - centre)
    # Half a millimetre behind, and as far as it is thick.
    np.testing.assert_allclose(own, (0, 0, -0.0015), atol=1e-9)
    np.testing.assert_allclose(at.xmat.reshape(3, 3), turn.as_matrix(), atol=1e-9)
    assert model.body("carrier").mass[0] == pytest.approx(0.02)
    # The picture: its corners, and which part of the marker each one shows.
    mesh, geom = model.mesh("mark"), data.geom("mark")
    vertices = model.mesh_vert[mesh.vertadr[0] :][: mesh.vertnum[0]]
    corners = turn.inv().apply(vertices @ geom.xmat.reshape(3, 3).T + geom.xpos - centre)
    np.testing.assert_allclose(np.abs(corners[:, :2]), half, atol=1e-6)
    np.testing.assert_allclose(corners[:, 2], 0, atol=1e-6)
    shown = model.mesh_texcoord[mesh.texcoordadr[0] :]
    for face in range(2):
        for vertex, texture in zip(
            model.mesh_face[mesh.faceadr[0] + face],
            model.mesh_facetexcoord[mesh.faceadr[0] + face],
            strict=True,
        ):
            u, v = shown[texture]
            # Texture rows run downwards from the marker's top edge.
            x, y = corners[vertex, :2] / half
            np.testing.assert_allclose((u, v), ((x + 1) / 2, (1 - y) / 2), atol=1e-6)
    a, b, c = corners[model.mesh_face[mesh.faceadr[0]]]
    assert np.cross(b - a, c - a)[2] > 0
    picture_geom = model.geom("mark")
    assert (picture_geom.contype, picture_geom.conaffinity) == (0, 0)


@pytest.mark.parametrize(("solid", "printed"), [(False, True), (True, False)])
def test_a_sticker_and_a_hidden_plate_have_no_body(solid, printed):
    plate = Plate(marker=Marker(5, 0.06), position=(0, 0, 0), solid=solid, printed=printed)
    spec = mujoco.MjSpec()
    add_plate(spec, spec.worldbody, "mark", plate)
    names = [geom.name for geom in spec.worldbody.geoms]
    assert names == (["mark"] if printed else [])
    assert spec.site("mark") is not None


def test_capsules_of_a_plate_contain_it_and_no_more_than_eleven_millimetres():
    turn = Rotation.from_euler("xyz", [0.3, 0.2, 0.5])
    plate = replace(marked_plate(), orientation=tuple(turn.as_quat(scalar_first=True).tolist()))
    config = ArmModelConfig(robot=panda, marker=plate)
    arm = whole_arm(config)
    added = [c for c in arm.capsules if c not in panda.whole.capsules]
    assert len(added) == 3
    assert {c.link for c in added} == {9}
    half = plate.marker.plate_size / 2
    x, y, z = np.meshgrid(
        *(np.linspace(-half, half, 13),) * 2, [-0.0025, -0.0005], indexing="ij"
    )
    points = np.stack([x, y, z], -1).reshape(-1, 3)
    # From the gripper's frame at the flange to the tool's.
    points = turn.apply(points) + plate.position - [0, 0, 0.1034]
    outside = []
    for c in added:
        start, way = np.array(c.start), np.subtract(c.end, c.start)
        along = ((points - start) @ way / (way @ way)).clip(0, 1)
        gap = np.linalg.norm(points - start - along[:, None] * way, axis=-1) - c.radius
        outside.append(gap)
        assert c.radius < 0.0125
        np.testing.assert_allclose(np.linalg.norm(way), 2 * half)
    assert np.min(outside, axis=0).max() < 5e-4
    hidden = replace(config, marker=replace(plate, printed=False))
    assert whole_arm(hidden) is panda.whole


def test_an_arm_that_is_pushed_reads_the_torques_of_the_transposed_jacobian():
    world = World(replace(SceneConfig(), objects=()))
    world.reset(panda.ready.numpy())
    forearm = world.model.body("link4").id
    wrench = np.array([3.0, -5.0, 7.0, 0.4, -0.3, 0.2])
    world.data.xfrc_applied[forearm] = wrench
    jacobian = np.zeros((6, world.model.nv))
    mujoco.mj_jacBodyCom(world.model, world.data, jacobian[:3], jacobian[3:], forearm)
    expected = (jacobian.T @ wrench)[:7]
    expected += (world.data.qfrc_constraint + world.data.qfrc_applied)[:7]
    np.testing.assert_allclose(world.arm._external_torque(), expected, atol=1e-9)


def test_a_gripper_opens_to_its_stroke_and_no_further():
    world = World(SceneConfig())
    servos = [world.model.actuator(name).id for name in ("finger_left", "finger_right")]
    for width, stroke in ((0.05, 0.025), (0.3, 0.04), (-0.1, 0.0)):
        world.arm.move(width)
        np.testing.assert_allclose(world.data.ctrl[servos], stroke)
    world.reset(panda.ready.numpy(), gripper_width=0.05)
    assert world.arm.read().gripper_width == pytest.approx(0.05)
    np.testing.assert_allclose(world.data.ctrl[servos], 0.025)
    np.testing.assert_allclose(world.arm.tool_offset, (0, 0, 0.1034), atol=1e-9)
    velocity = np.full(7, 0.1)
    world.arm.command(velocity)
    world.advance(0.01)
    world.reset(panda.ready.numpy())
    assert not world.arm.read().joint_velocity.any()
    world.advance(0.01)
    np.testing.assert_allclose(world.arm.read().joint_position, panda.ready, atol=1e-4)


def test_a_link_without_a_shape_still_weighs_and_touches_nothing():
    robot = replace_capsules(panda, without=4)
    spec = mujoco.MjSpec()
    add_arm(spec, ArmModelConfig(robot=robot))
    model = spec.compile()
    geom = model.geom("link4_0")
    assert geom.type[0] == mujoco.mjtGeom.mjGEOM_SPHERE
    assert (geom.contype, geom.conaffinity) == (0, 0)
    assert geom.group[0] > 2
    for link in range(1, 8):
        assert model.body(f"link{link}").mass[0] == pytest.approx(robot.masses[link])


def replace_capsules(robot, without):
    """The arm without the capsules of one link."""
    kept = [capsule for capsule in robot.whole.capsules if capsule.link != without]
    return Arm(name="panda", chain=robot.chain, shape=robot.shape, capsules=kept)
