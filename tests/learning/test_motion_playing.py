"""Models of a Panda and of an SO-101 carried out to goals, judged by Pinocchio."""

import re
from dataclasses import replace
from importlib.metadata import distribution
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from hrc_learn.demos import Demonstration, DemonstrationSet
from hrc_learn.geometry import minimum_jerk
from hrc_learn.kinematics import UnreachableError, panda
from hrc_learn.kinematics.registry import arm
from hrc_learn.learning import fit_primitives
from hrc_learn.learning.fitted_model import FittedModel, Target, arm_for
from hrc_learn.learning.motion_playing import play_on_arm, play_path

DESCRIPTIONS = {
    "panda": ("panda_description/urdf/panda.urdf", "panda_hand_tcp"),
    "so101": ("so_arm_description/urdf/so101.urdf", "gripper_frame_link"),
}
MOVES = {
    "panda": [(0.3, 0.1, -0.1, 0.2, 0.1, 0.0, 0.1), (-0.3, 0.2, 0.1, 0.1, 0.0, 0.2, 0.1)],
    "so101": [(0.3, 0.2, -0.2, 0.1, 0.3), (-0.3, 0.3, -0.2, -0.1, 0.2)],
}
GOALS = {"panda": (0.5, -0.1, 0.4), "so101": (0.25, 0.1, 0.15)}


def taught(name, folder, factor=1.0, without=()):
    """Model of two demonstrations of an arm, with joints in units of `1 / factor` rad."""
    robot, demos, s = arm(name), [], np.linspace(0, 1, 101)[:, None]
    progress = minimum_jerk(torch.from_numpy(s))[0].numpy()
    for episode, move in enumerate(MOVES[name]):
        q = robot.ready.numpy() + progress * np.array(move) + 0.05 * np.sin(np.pi * s)
        tool = robot.forward(torch.from_numpy(q))
        demo = Demonstration(
            episode=episode,
            fps=50,
            time=2 * s[:, 0],
            joint_names=robot.chain.joint_names,
            joint_position=factor * q,
            position=tool.position.numpy(),
            orientation=tool.orientation.numpy(),
        )
        demos.append(replace(demo, **dict.fromkeys(without)))
    unit = "rad" if factor == 1.0 else "deg"
    channels = ("position",) if without else ()
    fit_primitives(DemonstrationSet(demos, joint_unit=unit), 20, channels=channels).save(folder)
    return FittedModel.load(folder)


@pytest.fixture(scope="module")
def models(tmp_path_factory):
    folder = tmp_path_factory.mktemp("play")
    return {name: taught(name, folder / name) for name in MOVES}


def moved(model, name, goal, start=None, duration=None):
    return play_on_arm(model, arm_for(model, name), start, goal, duration)


def at(position, **values):
    return Target(position=torch.tensor(position).double(), **values)


def tool_by_pinocchio(name, joints):
    """Position of the tool by Pinocchio, from the maker's description [m]."""
    pin = pytest.importorskip("pinocchio")
    file, frame = DESCRIPTIONS[name]
    share = "cmeel.prefix/share/example-robot-data/robots"
    path = str(distribution("example-robot-data").locate_file(f"{share}/{file}"))
    model = pin.buildModelFromUrdf(path)
    q = pin.neutral(model)
    for joint, value in zip(arm(name).chain.joint_names, joints, strict=True):
        q[model.joints[model.getJointId(joint)].idx_q] = value
    data = model.createData()
    pin.framesForwardKinematics(model, data, q)
    return data.oMf[model.getFrameId(frame)].translation


def beyond(name, joints):
    """Largest ratio of a motion at 50 Hz to the limits of velocity, acceleration and jerk."""
    limits, padded = arm(name).limits, np.concatenate([joints[:1]] * 3 + [joints])
    ratios = [
        np.abs(np.diff(padded, n, axis=0) * 50.0**n).max(0) / getattr(limits, kind).numpy()
        for n, kind in enumerate(("velocity", "acceleration", "jerk"), 1)
    ]
    assert (joints >= limits.lower.numpy()).all()
    assert (joints <= limits.upper.numpy()).all()
    return float(np.max(ratios))


@pytest.mark.parametrize("name", GOALS)
def test_an_arm_reaches_a_position_within_its_limits(name, models):
    motion = moved(models[name], name, at(GOALS[name]))
    assert tool_by_pinocchio(name, motion.joints[-1]) == pytest.approx(GOALS[name], abs=1e-3)
    assert motion.goal_errors["goal_position_error_mm"] < 1
    assert beyond(name, motion.joints) <= 1 + 1e-6
    assert np.abs(np.diff(motion.joints, axis=0)).max() < 0.1  # continuous
    # It begins where the model does, and the other joints bend towards its goal.
    assert motion.joints[0] == pytest.approx(arm(name).ready.numpy(), abs=1e-3)


def is_reached(motion, goal):
    end = panda.forward(torch.from_numpy(motion.joints[-1]))
    assert end.position.tolist() == pytest.approx(goal.position.tolist(), abs=1e-3)
    assert abs(float(end.orientation @ goal.orientation)) == pytest.approx(1, abs=1e-5)
    assert motion.goal_errors["goal_turn_error_deg"] < 0.5


def test_a_pose_is_reached_with_its_orientation(models):
    turned = panda.forward(panda.ready + 0.1)
    goal = Target(position=turned.position + 0.05, orientation=turned.orientation)
    is_reached(moved(models["panda"], "panda", goal), goal)


def test_a_model_of_joints_alone_reaches_positions_and_poses(models):
    joint = models["panda"].primitives["joint"]
    model = replace(models["panda"], primitives={"joint": joint})
    motion = moved(model, "panda", at(GOALS["panda"]))
    position = tool_by_pinocchio("panda", motion.joints[-1])
    assert position == pytest.approx(GOALS["panda"], abs=1e-3)
    turned = panda.forward(panda.ready + 0.1)
    goal = Target(position=turned.position, orientation=turned.orientation)
    is_reached(moved(model, "panda", goal), goal)


def test_fewer_joints_turn_the_tool_as_far_as_they_can(models):
    """A posture of the SO-101 gives a pose that it can reach whole."""
    robot = arm("so101")
    wanted = robot.forward(robot.ready + torch.tensor([0.2, 0.1, 0.1, 0.2, 0.6]).double())
    goal = Target(position=wanted.position, orientation=wanted.orientation)
    motion = moved(models["so101"], "so101", goal)
    assert motion.goal_errors["goal_position_error_mm"] < 1
    assert motion.goal_errors["goal_turn_error_deg"] < 5


def test_what_is_too_fast_takes_longer_and_says_why(models):
    goal = (0.6, 0.4, 0.3, -2.0, 0.2, 1.9, 1.2)
    joints = Target(joints=torch.tensor(goal).double())
    motion = moved(models["panda"], "panda", joints, duration=0.3)
    assert re.fullmatch(r"\w+ of panda_joint\d", motion.slowed_by)
    assert motion.planned_duration == 0.3
    assert motion.joints[-1] == pytest.approx(goal, abs=2e-3)  # the allowed deviation
    error = np.abs(motion.joints[-1] - goal).max()
    assert motion.goal_errors["goal_joint_error"] == pytest.approx(error, rel=1e-6)
    assert 0.9 * 0.3 < beyond("panda", motion.joints) <= 1 + 1e-6
    # Its spring pulls it towards a distant goal: 1.2 rad take 4.4 s at 7.5 rad/s^2.
    assert 0.5 < motion.time[-1] < 6.0


def test_a_goal_out_of_reach_is_refused_with_a_place_on_the_way_to_it(models):
    goal = 4 * np.array(GOALS["panda"])
    with pytest.raises(UnreachableError, match="does not reach the path") as refused:
        moved(models["panda"], "panda", at(goal))
    found = re.search(r"\((.*)\) m", str(refused.value))
    assert found is not None
    place = torch.tensor([float(x) for x in found[1].split(",")]).double()
    # The motion leaves its reach on the way, neither at its start nor only at its goal.
    start = panda.forward(panda.ready).position
    way = float((place - start).norm())
    assert 0.1 < way < 0.8 * float((torch.from_numpy(goal) - start).norm())


def test_a_path_without_an_arm_is_the_models_own(models):
    goal = torch.tensor((0.6, 0.4, 0.3, -2.0, 0.2, 1.9, 1.2)).double()
    motion = play_path(models["panda"], None, Target(joints=goal), 1.0)
    assert motion.time[[0, -1]].tolist() == pytest.approx([0.0, 1.0])
    assert motion.joints[0] == pytest.approx(panda.ready.numpy(), abs=1e-3)
    apart = np.abs(motion.joints[-1] - goal.numpy())
    assert motion.goal_errors == {"goal_joint_error": pytest.approx(apart.max(), rel=1e-6)}


@pytest.fixture(scope="module")
def positions(tmp_path_factory):
    """Model of positions alone."""
    folder = tmp_path_factory.mktemp("positions") / "panda"
    return taught("panda", folder, without=("joint_position", "orientation"))


def test_positions_alone_are_played_from_any_start(positions):
    goal, start = at(GOALS["panda"]), at((0.35, 0.1, 0.5))
    motion = play_path(positions, start, goal, 1.5)
    assert motion.orientation is None
    assert motion.joints is None
    assert positions.joint_names == ()
    assert motion.time[-1] == pytest.approx(1.5)
    assert motion.position is not None
    assert motion.position[0] == pytest.approx(start.position.numpy(), abs=1e-9)
    off = np.linalg.norm(motion.position[-1] - goal.position.numpy())
    assert off < 1e-3
    assert motion.goal_errors["goal_position_error_mm"] == pytest.approx(1e3 * off, abs=1e-6)
    # The orientation of a goal is not part of such a motion, so it has no error.
    turned = at(GOALS["panda"], orientation=torch.tensor([0.0, 1.0, 0.0, 0.0]).double())
    assert play_path(positions, start, turned, 1.5).goal_errors == motion.goal_errors


def test_positions_alone_move_an_arm(positions):
    motion = moved(positions, "panda", at(GOALS["panda"]), at((0.35, 0.1, 0.5)))
    ends = [tool_by_pinocchio("panda", joints) for joints in motion.joints[[0, -1]]]
    assert ends[0] == pytest.approx((0.35, 0.1, 0.5), abs=1e-3)
    assert ends[1] == pytest.approx(GOALS["panda"], abs=1e-3)
    assert beyond("panda", motion.joints) <= 1 + 1e-6
    with pytest.raises(ValueError, match="holds no primitive of joints: give --goal position"):
        moved(positions, "panda", Target(joints=panda.ready))


def test_an_arm_starts_at_the_joints_that_are_given(models):
    first = panda.ready + 0.2
    motion = moved(models["panda"], "panda", at(GOALS["panda"]), Target(joints=first))
    assert motion.joints[0] == pytest.approx(first.numpy(), abs=1e-9)
    assert tool_by_pinocchio("panda", motion.joints[-1]) == pytest.approx(
        GOALS["panda"], abs=1e-3
    )


def test_what_a_model_cannot_play_is_named(models, positions):
    joints = Target(joints=panda.ready)
    with pytest.raises(ValueError, match=r"a goal of joints: it has position. With --robot"):
        play_path(positions, None, joints, None)
    with pytest.raises(ValueError, match="--start and --goal must be of one kind"):
        play_path(models["panda"], joints, at(GOALS["panda"]), None)


def test_poses_of_another_tool_are_refused_and_those_of_our_hand_found(models, tmp_path):
    model = models["panda"]
    moved_base = replace(model.pose.start, position=model.pose.start.position + 0.1)
    other = SimpleNamespace(start=moved_base)
    shifted = replace(model, primitives=model.primitives | {"pose": other})
    with pytest.raises(ValueError, match=r"begin 173 mm from the tool of"):
        arm_for(shifted, "panda")
    robot = arm("ur5e")
    hand = robot.with_hand()
    joint = SimpleNamespace(start=robot.ready, joint_names=robot.chain.joint_names, units="rad")
    for tool in (robot, hand):
        pose = SimpleNamespace(start=tool.forward(robot.ready))
        found = arm_for(replace(model, primitives={"joint": joint, "pose": pose}), "ur5e")
        reached = found.forward(robot.ready).position
        assert reached.tolist() == pytest.approx(pose.start.position.tolist(), abs=1e-9)


def test_degrees_move_an_arm_as_radians_do(models, tmp_path):
    degrees = taught("panda", tmp_path, factor=180 / np.pi)
    expected = moved(models["panda"], "panda", at(GOALS["panda"]))
    found = moved(degrees, "panda", at(GOALS["panda"]))
    assert found.joints == pytest.approx(expected.joints, abs=1e-4)
