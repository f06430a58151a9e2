"""The simulated arm against its own chain, for arms of other shapes than the Panda's."""

from functools import cache

import mujoco
import numpy as np
import pytest
import torch
from bare_arm import bare

from hrc_learn.geometry import Pose, quaternion
from hrc_learn.kinematics import Arm, ArmChoice, LinkCapsule, panda
from hrc_learn.sim import ArmModelConfig, SceneConfig, World
from hrc_learn.sim.arm_model import add_arm, whole_arm
from hrc_learn.sim.recorded_world import DrawnWorld
from hrc_learn.sim.workplace import Workplace

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
