from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from unchecked import shapes_unchecked

from hrc_learn.controller import SafetyConfig, SafetyFilter
from hrc_learn.geometry import Box
from hrc_learn.kinematics import arm, panda
from hrc_learn.protocols import ArmState
from hrc_learn.sim import ArmModelConfig, SceneConfig, World
from hrc_learn.sim.workplace import Workplace
from hrc_learn.sim.world import _PADS


@pytest.fixture(scope="module")
def workplace():
    return Workplace()


@pytest.fixture
def world(workplace):
    world = World(workplace.scene)
    world.reset(workplace.home_joints().numpy())
    return world


def test_simulator_and_kinematics_agree(world):
    rng = np.random.default_rng(0)
    lower, upper = panda.limits.lower.numpy(), panda.limits.upper.numpy()
    for _ in range(20):
        q = rng.uniform(lower, upper)
        world.reset(q)
        expected = panda.forward(torch.from_numpy(q)).matrix().numpy()
        np.testing.assert_allclose(world.arm.tcp_pose(), expected, atol=1e-9)


def test_arm_follows_a_velocity_without_lag(world):
    start = world.arm.read().joint_position
    velocity = np.array([0.2, -0.1, 0.15, 0.1, -0.2, 0.1, 0.3])
    world.arm.command(velocity)
    world.advance(2.0)
    state = world.arm.read()
    # The servos must make up the start's jerk; what is left is the load of gravity and inertia.
    np.testing.assert_allclose(state.joint_position, start + 2.0 * velocity, atol=1e-3)
    np.testing.assert_allclose(state.joint_velocity, velocity, atol=1e-3)


@pytest.mark.long
@pytest.mark.parametrize("joint", range(7))
@shapes_unchecked()
def test_the_filter_allows_for_what_the_servo_overshoots(world, joint):
    """What counts is the measured velocity: it keeps the limit, and breaks it if the command
    may use all of it."""

    def fastest(config: SafetyConfig) -> float:
        start = torch.from_numpy(_OUT_OF_THE_WAY)
        world.reset(_OUT_OF_THE_WAY)
        safety = SafetyFilter(panda.limits, config)
        state = safety.initial_state(start)
        shares = []
        for k in range(60):
            command = torch.zeros(7).double()
            command[joint] = 3 * panda.limits.velocity[joint] * (1 if k < 30 else -1)
            q = torch.from_numpy(world.arm.read().joint_position)
            velocity, state, _ = safety.step(state, q, command, 0.01)
            world.arm.command(velocity.numpy())
            world.advance(0.01)
            measured = world.arm.read().joint_velocity
            shares.append(np.abs(measured / panda.limits.velocity.numpy()).max())
        return max(shares)

    assert fastest(SafetyConfig()) <= 1
    assert fastest(SafetyConfig(velocity_margin=0.0)) > 1


_OUT_OF_THE_WAY = np.array([0.0, -0.8, 0.0, -1.8, 0.0, 1.6, 0.8])


def test_an_arm_that_was_held_up_goes_on_from_where_it_is(world):
    world.reset(np.array([-0.2, 1.2, 0.0, -1.0, 0.0, 2.0, 0.8]))
    swing = np.array([-0.5, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    world.arm.command(swing)
    world.advance(4.0)
    stuck = world.arm.read()
    assert any(touch.second == "cabinet_door" for touch in world.cabinet_contacts.touches)
    assert abs(stuck.joint_velocity[0]) < 0.05
    assert any("touched cabinet_door" in met for met in world.touched_since(world.time - 0.02))
    touches = [t for t in world.cabinet_contacts.touches if t.second == "cabinet_door"]
    last = max(touch.end for touch in touches)
    met = world.touched_since(last)
    assert {f"{t.first} touched {t.second}" for t in touches if t.end >= last} <= set(met)
    assert len(set(met)) == len(met)
    assert world.touched_since(last + 1e-6) == ()
    world.arm.command(-swing)
    world.advance(0.5)
    assert world.touched_since(world.time - 0.02) == ()
    back = world.arm.read()
    # Two seconds of it were spent at the door: they are not made up for on the way back.
    assert back.joint_position[0] - stuck.joint_position[0] == pytest.approx(0.25, abs=0.05)
    np.testing.assert_allclose(back.joint_velocity, -swing, atol=0.02)
    world.reset(_OUT_OF_THE_WAY)
    assert world.touched_since(0.0) == ()
    assert world.time == 0.0


def test_a_held_object_stays_in_the_hand_while_the_arm_swings(world, workplace):
    world.hold("box", workplace.home_joints().numpy())
    assert world.holds("box")
    before = np.linalg.inv(world.arm.tcp_pose()) @ world.object_pose("box")
    for turn in (0.5, -0.5) * 2:
        world.arm.command(np.array([turn, 0.0, 0.0, 0.2 * np.sign(turn), 0.0, 0.0, turn]))
        world.advance(1.5)
    after = np.linalg.inv(world.arm.tcp_pose()) @ world.object_pose("box")
    assert world.holds("box")
    assert np.linalg.norm(after[:3, 3] - before[:3, 3]) < 2e-3


@pytest.mark.parametrize(
    ("yaw", "flat"), [(0, True), (180, True), (2, True), (45, False), (90, False)]
)
def test_only_a_grip_by_the_faces_across_the_x_axis_is_flat(workplace, yaw, flat):
    """Slight turns are straightened by the closing pads. A diagonal grip hangs by its edges; at
    a quarter turn the pads press on the other faces."""
    item = replace(workplace.scene.objects[0], half_size=(0.018, 0.030, 0.030))
    world = World(replace(workplace.scene, objects=(item,)))
    world.model.body_gravcomp[world.model.body("box").id] = 1.0  # it floats until it is held
    home = workplace.home_joints().numpy()
    world.reset(home)
    c, s = np.cos(np.deg2rad(yaw)), np.sin(np.deg2rad(yaw))
    in_hand = np.array([[s, c, 0, 0], [c, -s, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]])
    world.reset(home, {"box": world.arm.tcp_pose() @ in_hand})
    assert not world.holds("box")
    assert not world.holds_flat("box")
    world.arm.move(0.0)
    world.advance(1.0)
    assert world.holds("box")
    assert world.holds_flat("box") == flat


def test_a_flat_grip_does_not_depend_on_the_order_of_the_geoms(world):
    """Outward normals at both sides of 3 degrees from the object's x axis."""
    item, *pads = (world.model.geom(name).id for name in ("box", *_PADS))
    axis, side, _ = world.object_pose("box")[:3, :3].T

    def flat(*angles, reverse, dist=0.99e-4):
        contacts = []
        for pad, angle in zip(pads, np.deg2rad(angles), strict=False):
            outward = np.cos(angle) * axis + np.sin(angle) * side
            # A normal points from the first geom to the second.
            pair, normal = ([pad, item], -outward) if reverse else ([item, pad], outward)
            frame = np.concatenate([normal, np.zeros(6)])
            contacts.append(SimpleNamespace(geom=np.array(pair), frame=frame, dist=dist))
        seen = SimpleNamespace(contact=contacts)
        known = {"model": world.model, "object_pose": world.object_pose}
        return World.holds_flat(SimpleNamespace(data=seen, **known), "box")

    for reverse in (False, True):
        for angles in ((0, 180), (180, 0), (2.9, 177.1), (-2.9, 180)):
            assert flat(*angles, reverse=reverse)
            assert not flat(*angles, reverse=reverse, dist=1e-4)
        for angles in ((0, 0), (180, 180), (0, 176.9), (3.1, 180), (62, 180), (0, 90), (0,)):
            assert not flat(*angles, reverse=reverse)


def test_an_object_let_go_above_a_board_comes_to_rest_on_it(world, workplace):
    pose = np.eye(4)
    pose[:3, 3] = (0.4, -0.65, workplace.scene.cabinet.shelves["middle"] + 0.05)
    world.reset(workplace.home_joints().numpy(), {"box": pose})
    assert not world.rests_on("box", "board_middle")
    world.advance(1.0)
    assert world.rests_on("box", "board_middle")
    assert not world.rests_on("box", "board_upper")


def test_contacts_tell_who_met_whom(world, workplace):
    assert world.collisions_along(workplace.home_joints().numpy()[None]) == []
    # Swing the stretched arm into the open door.
    path = np.linspace([0.0, 1.2, 0, -1.0, 0, 2.0, 0.8], [-1.6, 1.2, 0, -1.0, 0, 2.0, 0.8], 60)
    touches = world.collisions_along(path)
    assert any(touch.second == "cabinet_door" for touch in touches)
    assert all(touch.first.startswith(("link", "hand", "finger")) for touch in touches)
    assert world.time == 0.0


def test_collisions_include_base_pedestal_and_floor():
    world = World(SceneConfig(arm=ArmModelConfig(robot=arm("ur5e").with_hand())))
    home = np.array([0.0, -1.6, 1.6, -1.6, -1.6, 0.0])
    assert world.collisions_along(home[None]) == []
    # The shoulder lift swings the upper arm down through the pedestal.
    path = home + np.linspace(0.0, 2 * np.pi, 200)[:, None] * np.eye(6)[1]
    met = {touch.second for touch in world.collisions_along(path)}
    assert {"link0", "pedestal"} <= met
    watched = {"link0": 0, "pedestal": 0, "floor": 0, "table": 0}
    for name in watched:
        geom, link = (world.model.geom(n).id for n in (name, "link3_0"))
        watched[name] = int(world.self_contacts.watched[geom, link])
    assert watched == {"link0": 1, "pedestal": 1, "floor": 1, "table": 0}


def test_collisions_include_what_is_carried(world, workplace):
    goal = workplace.shelf("middle")
    q = panda.inverse(goal, torch.tensor(0.0, dtype=torch.float64))
    world.hold("box", workplace.home_joints().numpy())
    low = goal.position.clone()
    low[2] -= 0.02
    sunk = panda.inverse(
        type(goal)(low, goal.orientation), torch.tensor(0.0, dtype=torch.float64)
    )
    met = {t.second for t in world.collisions_along(q.numpy()[None], "box") if t.first == "box"}
    assert met == set()
    met = {
        t.second for t in world.collisions_along(sunk.numpy()[None], "box") if t.first == "box"
    }
    assert met == {"board_middle"}


def test_unknown_objects_and_bad_commands_are_refused(world):
    with pytest.raises(KeyError, match="there are: box"):
        world.object_pose("bottle")
    with pytest.raises(ValueError, match="finite"):
        world.arm.command(np.full(7, np.nan))


def test_an_arm_that_is_controlled_elsewhere_is_shown_with_what_it_carries(world, workplace):
    """The object keeps its place in the gripper; without it, it stays where it was."""
    world.hold("box", workplace.home_joints().numpy())
    grip = np.linalg.inv(world.arm.tcp_pose()) @ world.object_pose("box")
    other = workplace.home_joints() + 0.2
    state = ArmState(
        time=7.5,
        joint_position=other.numpy(),
        joint_velocity=np.zeros(7),
        gripper_width=float("nan"),  # of an arm without a gripper
    )
    world.follow(state, carried="box")
    assert world.time == 7.5
    tool = panda.forward(other).matrix().numpy()
    np.testing.assert_allclose(world.arm.tcp_pose(), tool, atol=1e-9)
    np.testing.assert_allclose(world.object_pose("box"), tool @ grip, atol=1e-9)
    assert world.arm.read().gripper_width == pytest.approx(0.0, abs=1e-9)
    world.follow(replace(state, joint_position=workplace.home_joints().numpy()))
    np.testing.assert_allclose(world.object_pose("box"), tool @ grip, atol=1e-9)


def test_time_passes_in_whole_steps_one_at_least(world):
    dt = world.model.opt.timestep
    for duration, steps in ((0.0, 1), (1.4 * dt, 1), (1.6 * dt, 2), (0.02, 10)):
        before = world.time
        world.advance(duration)
        assert world.time - before == pytest.approx(steps * dt)


def test_things_are_put_in_the_hand_or_anywhere_at_rest(world):
    world.put_in_hand("box")
    tool = world.arm.tcp_pose()
    in_hand = np.linalg.inv(tool) @ world.object_pose("box")
    np.testing.assert_allclose(in_hand[:3, 3], 0, atol=1e-9)
    # The gripper closes along y of the tool, on the faces across x of the box.
    np.testing.assert_allclose(np.abs(in_hand[1, 0]), 1, atol=1e-9)
    np.testing.assert_allclose(in_hand[2, 2], -1, atol=1e-9)
    world.data.joint("box").qvel[:] = 3.0
    pose = np.eye(4)
    pose[:3, 3] = (0.3, 0.5, 0.4)
    world.carry("box", pose)
    np.testing.assert_allclose(world.object_pose("box"), pose, atol=1e-9)
    assert not world.data.joint("box").qvel.any()
    with pytest.raises(KeyError, match="there are: box"):
        world.carry("bottle", pose)
    assert world.held() == ()


def test_table_and_markers_are_where_the_scene_has_them(world):
    table = world.config.table
    assert world.table_top == pytest.approx(table.centre[2] + table.half_size[2])
    poses, plate = world.marker_poses(), world.config.arm.marker
    item = world.config.objects[0]
    assert set(poses) == {7, item.marker.id}
    box = world.object_pose("box")
    above = box @ [0, 0, item.half_size[2] + 5e-4, 1]
    np.testing.assert_allclose(poses[item.marker.id][:3, 3], above[:3], atol=1e-9)
    offset = np.subtract(plate.position, (0, 0, 0.1034))
    np.testing.assert_allclose(world.hand_marker_offset(), offset, atol=1e-9)
    bare = World(replace(world.config, arm=replace(world.config.arm, marker=None)))
    assert set(bare.marker_poses()) == {item.marker.id}
    with pytest.raises(ValueError, match="carries no marker"):
        bare.hand_marker_offset()


def test_a_path_is_looked_along_with_obstacles_and_times_are_samples(world, workplace):
    obstacle = Box(name="wall", centre=(0, 0, -5), half_size=(0.05, 0.05, 0.05))
    made = World(replace(workplace.scene, obstacles=(obstacle,)))
    home = workplace.home_joints()
    made.reset(home.numpy())
    path = np.linspace(home.numpy(), home.numpy() + 0.3, 5)
    assert made.collisions_along(path) == []
    there = panda.forward(torch.from_numpy(path[3])).position.numpy()
    made.move_obstacle("wall", there)
    touches = made.collisions_along(path)
    assert {touch.second for touch in touches} == {"wall"}
    assert min(touch.start for touch in touches) in (1.0, 2.0, 3.0)
    assert all(touch.start <= 3.0 <= touch.end for touch in touches[:1])
