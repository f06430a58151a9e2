"""Teaching, learning and planning of the placing motion, in the simulated workplace."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
import torch
from hrc_learn.learning.fit_primitives import fit_primitives
from unchecked import shapes_unchecked

from hrc_learn.demos import DatasetWriter, load_demos
from hrc_learn.experiments.metric_table import evaluate
from hrc_learn.experiments.placing.metrics import placing_metrics
from hrc_learn.experiments.placing.trial import PlacingOutcome, place
from hrc_learn.geometry import Pose
from hrc_learn.kinematics import UnreachableError, panda
from hrc_learn.sim import World
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills.placing import PlacingSkill, check_plan, plan_candidates
from hrc_learn.skills.work_cell import BlockedPathError
from hrc_learn.teleoperation.scripted_demonstrations import (
    PlacingDemonstrationConfig,
    demonstrate_placing,
)

WORKPLACE = Workplace()
HOME = WORKPLACE.home_joints()


@pytest.fixture(scope="module")
@shapes_unchecked()
def demos(tmp_path_factory):
    """Two demonstrations, recorded to disk and read back."""
    folder = tmp_path_factory.mktemp("demos") / "placing"
    lesson, rng = PlacingDemonstrationConfig(), np.random.default_rng(0)
    world = World(WORKPLACE.scene)
    with DatasetWriter(folder, lesson.fps, "panda", panda.joint_names) as writer:
        for _ in range(2):
            frames, touches = demonstrate_placing(world, WORKPLACE, "middle", lesson, rng)
            assert touches == []
            writer.start_episode("place")
            for frame in frames:
                writer.add_frame(images=None, **frame)
            writer.save_episode()
    return load_demos(folder)


@pytest.fixture(scope="module")
def fitted(demos):
    return fit_primitives(demos)


@pytest.fixture(scope="module")
def skill(fitted, tmp_path_factory):
    folder = tmp_path_factory.mktemp("model")
    fitted.save(folder)
    return PlacingSkill.load(folder)


@pytest.fixture(scope="module")
def world():
    world = World(WORKPLACE.scene)
    world.hold("box", HOME.numpy())
    return world


def test_the_expert_ends_at_the_shelf_and_pulls_the_body_on_the_way(demos):
    goal = WORKPLACE.shelf("middle").position.numpy()
    for demo in demos:
        assert np.linalg.norm(demo.position[-1] - goal) < 1e-3
        assert np.abs(demo.human_effort).max() > 1.0
        assert demo.joint_names == panda.joint_names


@shapes_unchecked()
def test_without_the_body_shape_the_arm_hits_the_open_door():
    world = World(WORKPLACE.scene)
    lesson = PlacingDemonstrationConfig(shape_body=False)
    _, touches = demonstrate_placing(
        world, WORKPLACE, "middle", lesson, np.random.default_rng(0)
    )
    assert "cabinet_door" in {touch.second for touch in touches}


def test_each_primitive_repeats_its_demonstration_and_their_mean_comes_close(fitted):
    metrics = fitted.metrics()
    assert metrics["joint_nrmse_max"] < 1e-3
    assert metrics["pose_nrmse_max"] < 1e-3
    assert metrics["pose_turn_rmse_max"] < 0.05
    assert metrics["mean_joint_nrmse_max"] < 1e-2


@pytest.mark.parametrize("shelf", WORKPLACE.shelf_names())
@pytest.mark.parametrize("speed", [1.0, 1.5])
@shapes_unchecked()  # a thousand steps: checked in the tests below
def test_plans_in_pose_space_reach_every_shelf_without_touching(skill, world, shelf, speed):
    goal = WORKPLACE.shelf(shelf)
    plan = skill.plan(HOME, goal, space="pose", dt=0.02, speed=speed)
    check_plan(plan, world, carried="box")
    miss = plan.hand[-1].twist_to(goal)
    assert float(miss[:3].norm()) < 1e-3
    assert float(miss[3:].norm()) < 1e-3
    np.testing.assert_allclose(plan.path[0], HOME.numpy())
    assert plan.duration == pytest.approx(15.0 / speed, rel=0.01)


def test_the_papers_plan_in_joint_space_bends_the_way_into_other_shelves(skill):
    def sideways(space, shelf):
        goal = WORKPLACE.shelf(shelf)
        hand = skill.plan(HOME, goal, space=space, dt=0.02).hand.position
        inside = hand[hand[:, 1] < WORKPLACE.scene.cabinet.front + 0.1]
        return float((inside[:, 0] - goal.position[0]).abs().max())

    for shelf in ("lower", "upper"):
        assert sideways("joint", shelf) > 0.02
        assert sideways("pose", shelf) < 0.003
    assert sideways("joint", "middle") < 0.003


def test_the_plan_keeps_the_taught_body_shape(skill, demos):
    """The elbow passes the door on the same side as in the demonstrations."""
    plan = skill.plan(HOME, WORKPLACE.shelf("upper"), space="pose", dt=0.02)
    elbow = panda.link_poses(torch.from_numpy(plan.path)).position[:, 3]
    shown = panda.link_poses(torch.from_numpy(demos[0].joint_position)).position[:, 3]
    assert float((elbow[-1] - shown[-1])[:2].norm()) < 0.12


def test_check_plan_names_what_would_be_hit(skill, world):
    plan = skill.plan(HOME, WORKPLACE.shelf("middle"), space="joint", dt=0.02)
    sweep = np.linspace(HOME.numpy(), HOME.numpy() - 1.9 * np.eye(7)[0], 200)
    with pytest.raises(BlockedPathError, match="would hit"):
        check_plan(replace(plan, path=sweep), world)
    turned = HOME.numpy() + 2.5 * np.eye(7)[0]
    beyond = np.linspace(HOME.numpy(), turned, 200)
    with pytest.raises(BlockedPathError, match="panda_joint1"):
        check_plan(replace(plan, path=beyond), world)
    hasty = np.linspace(HOME.numpy(), HOME.numpy() + 0.3, 3)
    with pytest.raises(BlockedPathError, match="slower"):
        check_plan(replace(plan, path=hasty), world)


@shapes_unchecked()
def test_a_placing_carried_out_ends_on_the_shelf_as_it_was_shown(skill, demos):
    run = place(skill, WORKPLACE, "middle", HOME, space="joint", speed=2.5)
    outcome = PlacingOutcome.of(run, WORKPLACE, demos[0])
    assert evaluate(placing_metrics(["middle"]), {"middle": outcome}).faults == ()
    assert outcome.placed
    assert outcome.jerk < 1e-2
    # Measured by the simulator, so not exactly what was planned.
    assert 0 < outcome.place_error < 5e-4
    np.testing.assert_allclose(run.path[-1], run.plan.goal.position.numpy(), atol=1e-3)
    assert [event.text for event in run.station.log.events] == [
        "transfer",
        "release",
        "retreat",
    ]


def test_a_goal_out_of_reach_is_refused_before_anything_is_planned(skill):
    shelf = WORKPLACE.shelf("middle")
    far = Pose(shelf.position - torch.tensor([0.0, 0.9, 0.0]).double(), shelf.orientation)
    for space in ("joint", "pose"):
        with pytest.raises(UnreachableError):
            skill.plan(HOME, far, space=space, dt=0.02)


def test_a_skill_of_another_arm_is_refused(fitted, tmp_path):
    fitted.save(tmp_path)
    renamed = fit_primitives(_renamed(fitted)).joint
    renamed.save(tmp_path / "joint")
    with pytest.raises(ValueError, match="j1"):
        PlacingSkill.load(tmp_path)


def _renamed(fitted):
    from hrc_learn.demos import Demonstration, DemonstrationSet

    q = fitted.demonstrations.joint_position[0].numpy()
    time = fitted.demonstrations.time[0].numpy()
    names = tuple(f"j{i}" for i in range(1, 8))
    demo = Demonstration(time=time, joint_position=q, joint_names=names, fps=50.0)
    return DemonstrationSet([demo])


def test_another_robots_demonstrations_need_no_robot_model(fitted):
    other = fit_primitives(_renamed(fitted))
    assert other.pose is None
    assert other.metrics()["joint_nrmse_max"] < 1e-3


def test_demonstrations_without_motion_are_refused():
    from hrc_learn.demos import Demonstration, DemonstrationSet

    time = np.linspace(0, 1, 20)
    empty = DemonstrationSet([Demonstration(time=time, gripper=np.zeros(20), fps=20.0)])
    with pytest.raises(ValueError, match="neither joint positions nor"):
        fit_primitives(empty)


@pytest.mark.parametrize(("low", "name"), [(0.0, "as learned"), (0.0065, "a little higher")])
@shapes_unchecked()
def test_a_thing_that_sits_low_in_the_hand_is_put_down_higher(skill, low, name):
    world, goal = World(WORKPLACE.scene), WORKPLACE.shelf("middle")
    world.hold("box", HOME.numpy())
    # Once the hand points level, its x points down.
    world.data.joint("box").qpos[:3] += low * world.arm.tcp_pose()[:3, 0]
    mujoco.mj_forward(world.model, world.data)

    def free(way):
        try:
            check_plan(way.plan, world, "box")
        except BlockedPathError:
            return False
        return True

    ways = plan_candidates(goal, HOME, skill, WORKPLACE, space="pose", dt=0.01, speed=1.5)
    way = next(filter(free, ways))
    assert way.name == name
    assert 0 <= float(way.plan.goal.position[2] - goal.position[2]) < 0.01
