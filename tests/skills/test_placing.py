"""Teaching, learning and planning of the placing motion, in the simulated workplace."""

from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
import torch
from unchecked import shapes_unchecked

from hrc_learn.demos import DatasetWriter, load_demos
from hrc_learn.experiments.metric_table import evaluate
from hrc_learn.experiments.placing_experiment import PlacingExperiment
from hrc_learn.experiments.placing_metrics import PlacingOutcome, PlacingRun, placing_metrics
from hrc_learn.experiments.placing_trial import SPACES, PlacingScene
from hrc_learn.geometry import Pose
from hrc_learn.kinematics import UnreachableError, panda
from hrc_learn.learning.primitive_fitting import fit_primitives
from hrc_learn.sim import World
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills.placing import PlacingSkill, check_plan, plan_candidates
from hrc_learn.skills.work_cell import BlockedPathError, TaskFailedError
from hrc_learn.teleoperation.scripted_demonstrations import (
    PlacingDemonstrationConfig,
    demonstrate_placing,
    guided_frames,
    placing_expert,
)

pytestmark = [pytest.mark.simulation, pytest.mark.long]

WORKPLACE = Workplace()
HOME = WORKPLACE.home_joints()
DURATION = 7.0
"""Duration of a demonstration [s]."""


@pytest.fixture(scope="module")
@shapes_unchecked()
def demos(tmp_path_factory):
    """Two demonstrations, recorded to disk and read back."""
    folder = tmp_path_factory.mktemp("demos") / "placing"
    config = PlacingDemonstrationConfig(duration=DURATION)
    rng = np.random.default_rng(0)
    world = World(WORKPLACE.scene)
    with DatasetWriter(folder, config.fps, "panda", panda.joint_names) as writer:
        for _ in range(2):
            frames, discarded = demonstrate_placing(world, WORKPLACE, "middle", config, rng)
            assert discarded == 0
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
    return PlacingSkill.load(folder, panda)


@pytest.fixture(scope="module")
def plans(skill):
    """Plans from home, each made once: several tests look at the same ones."""

    @cache
    def planned(space, shelf, speed=1.0):
        return skill.plan(HOME, WORKPLACE.shelf(shelf), space=space, dt=0.05, speed=speed)

    return planned


@pytest.fixture(scope="module")
def world():
    world = World(WORKPLACE.scene)
    world.hold("box", HOME.numpy())
    return world


def test_the_expert_ends_at_the_shelf_and_pulls_the_elbow_on_the_way(demos):
    goal = WORKPLACE.shelf("middle").position.numpy()
    for demo in demos:
        assert np.linalg.norm(demo.position[-1] - goal) < 1e-3
        assert np.abs(demo.human_effort).max() > 1.0
        assert demo.joint_names == panda.joint_names


@shapes_unchecked()
def test_without_pulling_the_elbow_the_arm_hits_the_open_door():
    world = World(WORKPLACE.scene)
    config = PlacingDemonstrationConfig(pull_elbow=False, duration=6.0, settle=0.0)
    expert = placing_expert(world, WORKPLACE, "middle", config, np.random.default_rng(0))
    for _ in guided_frames(world, expert, config):
        pass
    assert "cabinet_door" in {touch.second for touch in world.cabinet_contacts.touches}


@shapes_unchecked()
def test_a_demonstration_that_does_not_arrive_is_none():
    # The arm cannot get there in 0.3 s.
    config = PlacingDemonstrationConfig(pull_elbow=False, duration=0.3, settle=0.0)
    with pytest.raises(TaskFailedError, match=r"3 demonstrations .* \d+ cm from its place"):
        demonstrate_placing(
            World(WORKPLACE.scene), WORKPLACE, "middle", config, np.random.default_rng(0)
        )


def test_each_primitive_repeats_its_demonstration_and_their_mean_comes_close(fitted):
    metrics = fitted.metrics()
    assert metrics["joint_nrmse_max"] < 1e-3
    assert metrics["pose_nrmse_max"] < 1e-3
    assert metrics["pose_turn_rmse_max"] < 0.05
    assert metrics["mean_joint_nrmse_max"] < 1e-2


@pytest.mark.parametrize(
    ("shelf", "speed"), [*((name, 1.0) for name in WORKPLACE.shelf_names()), ("upper", 1.5)]
)
def test_plans_in_pose_space_reach_every_shelf_without_touching(plans, world, shelf, speed):
    goal = WORKPLACE.shelf(shelf)
    plan = plans("pose", shelf, speed)
    check_plan(plan, world, carried="box")
    miss = plan.tool_pose[-1].twist_to(goal)
    assert float(miss[:3].norm()) < 1e-3
    assert float(miss[3:].norm()) < 1e-3
    np.testing.assert_allclose(plan.path[0], HOME.numpy())
    assert plan.duration == pytest.approx(plans("pose", "middle").duration / speed, rel=0.02)


@pytest.mark.parametrize("space", ["joint", "pose"])
def test_plans_have_the_shapes_that_they_declare(skill, space):
    """Coarse plans, with shapes checked in every function."""
    plan = skill.plan(HOME, WORKPLACE.shelf("middle"), space=space, dt=0.1)
    steps = round(plan.duration / 0.1) + 1
    assert plan.path.shape == (steps, 7)
    assert plan.tool_pose.position.shape == (steps, 3)
    # Unless told otherwise, a motion lasts as long as its demonstrations.
    assert plan.duration == pytest.approx(float(skill.joint.duration), abs=0.1)


def test_the_papers_plan_in_joint_space_bends_the_way_into_other_shelves(plans):
    def sideways(space, shelf):
        goal = WORKPLACE.shelf(shelf)
        position = plans(space, shelf).tool_pose.position
        inside = position[position[:, 1] < WORKPLACE.scene.cabinet.front + 0.1]
        return float((inside[:, 0] - goal.position[0]).abs().max())

    for shelf in ("lower", "upper"):
        assert sideways("joint", shelf) > 0.02
        assert sideways("pose", shelf) < 0.003
    assert sideways("joint", "middle") < 0.003


def test_the_plan_keeps_the_demonstrated_arm_angle(plans, demos):
    """The elbow passes the door on the same side as in the demonstrations."""
    plan = plans("pose", "upper")
    elbow = panda.link_poses(torch.from_numpy(plan.path)).position[:, 3]
    shown = panda.link_poses(torch.from_numpy(demos[0].joint_position)).position[:, 3]
    assert float((elbow[-1] - shown[-1])[:2].norm()) < 0.12


def test_a_plan_begins_at_rest_wherever_the_elbow_is(skill):
    aside = HOME + torch.tensor([0.4, 0.0, -0.4, 0.0, 0.0, 0.0, 0.0])
    plan = skill.plan(aside, WORKPLACE.shelf("middle"), space="pose", dt=0.05, speed=3.0)
    np.testing.assert_allclose(plan.path[0], aside, atol=1e-9)
    assert np.abs(np.diff(plan.path[:3], axis=0)).max() < 0.006


def test_check_plan_names_what_would_be_hit(plans, world):
    plan = plans("joint", "middle")
    sweep = np.linspace(HOME.numpy(), HOME.numpy() - 1.9 * np.eye(7)[0], 200)
    with pytest.raises(BlockedPathError, match="would hit"):
        check_plan(replace(plan, path=sweep), world)
    # The samples that are checked are 4 apart, but for the last.
    hit = SimpleNamespace(first="hand", second="shelf", depth=0.01, start=2)
    there = SimpleNamespace(collisions_along=lambda path, carried: [hit])
    still = replace(plan, path=np.tile(HOME.numpy(), (6, 1)), dt=0.3)
    with pytest.raises(BlockedPathError, match=r"after 0\.6 s hand would hit shelf"):
        check_plan(still, there)
    with pytest.raises(BlockedPathError, match=r"after 0\.1 s hand would hit shelf"):
        check_plan(replace(still, dt=0.01), there)
    unknown = np.where(np.eye(6, 7, k=1) > 0, np.nan, still.path)
    with pytest.raises(BlockedPathError, match=r"panda_joint2 after 0\.0 s, at nan rad"):
        check_plan(replace(plan, path=unknown), world)
    turned = HOME.numpy() + 2.5 * np.eye(7)[0]
    beyond = np.linspace(HOME.numpy(), turned, 200)
    with pytest.raises(BlockedPathError, match="panda_joint1"):
        check_plan(replace(plan, path=beyond), world)
    hasty = np.linspace(HOME.numpy(), HOME.numpy() + 0.3 * np.eye(7)[2], 3)
    with pytest.raises(BlockedPathError, match=r"panda_joint3.*slower"):
        check_plan(replace(plan, path=hasty), world)


@shapes_unchecked()
def test_an_executed_placing_ends_on_the_shelf_as_demonstrated(skill, demos):
    scene = PlacingScene(
        skill=skill,
        workplace=WORKPLACE,
        world=World(WORKPLACE.scene),
        demonstration=demos[0],
        demonstrated_shelf="middle",
    )
    run = scene.place("middle", HOME, space="joint", speed=2.5)
    outcome = PlacingOutcome.of(run, scene)
    assert evaluate(placing_metrics(["middle"]), {"middle": outcome}).faults == ()
    assert outcome.placed
    assert outcome.jerk < 1e-2
    # Measured by the simulator, of an object let down until the arm feels the board.
    assert 0 < outcome.place_error < 1.5e-3
    np.testing.assert_allclose(run.path[-1], run.plan.goal.position.numpy(), atol=1e-3)
    # The same placing for every shelf and space: it is recorded, measured and reported.
    shelves = WORKPLACE.shelf_names()
    placings = PlacingRun(
        scene=scene,
        placings={(space, shelf): run for space in SPACES for shelf in shelves},
        outcomes={space: dict.fromkeys(shelves, outcome) for space in SPACES},
    )
    experiment = PlacingExperiment(placing=Path(), demonstrations=Path())
    recordings = experiment.recordings(placings)
    assert set(recordings) == {"run", "run_lower", "run_upper"}
    recording = recordings["run"]
    assert recording.camera is None
    assert recording.nullspace_input is None
    carried = np.isfinite(recording.demo_joint_position).all(axis=1)
    assert carried[0]
    assert len(run.plan.path) <= carried.sum() < len(carried)
    (section,) = experiment.sections(placings, recordings)
    assert [picture.name for picture in section.figures] == ["paths", "joints"]
    values = evaluate(experiment.metrics(), placings).values
    assert values["place_error_mm"] == values["joint_space_place_error_mm"]
    assert values["reproduction_joint_rmse_deg"] > 0
    assert [event.text for event in run.cell.log.events] == [
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
    renamed = fit_primitives(_renamed(fitted)).each["joint"]
    renamed.save(tmp_path / "joint")
    with pytest.raises(ValueError, match="j1"):
        PlacingSkill.load(tmp_path, panda)


def _renamed(fitted):
    from hrc_learn.demos import Demonstration, DemonstrationSet

    q = fitted.motions.demos.joint_position[0].numpy()
    time = fitted.motions.demos.time[0].numpy()
    names = tuple(f"j{i}" for i in range(1, 8))
    demo = Demonstration(time=time, joint_position=q, joint_names=names, fps=50.0)
    return DemonstrationSet([demo])


def test_another_robots_demonstrations_need_no_robot_model(fitted):
    other = fit_primitives(_renamed(fitted))
    assert "pose" not in other.each
    assert other.metrics()["joint_nrmse_max"] < 1e-3


def test_demonstrations_without_motion_are_refused():
    from hrc_learn.demos import Demonstration, DemonstrationSet

    time = np.linspace(0, 1, 20)
    empty = DemonstrationSet([Demonstration(time=time, gripper=np.zeros(20), fps=20.0)])
    with pytest.raises(ValueError, match="neither joint positions nor"):
        fit_primitives(empty)


@pytest.mark.parametrize(("low", "number"), [(0.0, 0), (0.008, 1)])
@shapes_unchecked()
def test_an_object_that_sits_low_in_the_gripper_is_released_higher(skill, low, number):
    world, goal = World(WORKPLACE.scene), WORKPLACE.shelf("middle")
    world.hold("box", HOME.numpy())
    # Once the gripper is level, its x points down.
    world.data.joint("box").qpos[:3] += low * world.arm.tcp_pose()[:3, 0]
    mujoco.mj_forward(world.model, world.data)

    def free(candidate):
        try:
            check_plan(candidate[1], world, "box")
        except BlockedPathError:
            return False
        return True

    candidates = plan_candidates(goal, HOME, skill, WORKPLACE, dt=0.05, speed=1.5)
    which, plan = next(filter(free, enumerate(candidates)))
    assert which == number
    assert 0 <= float(plan.goal.position[2] - goal.position[2]) < 0.01
