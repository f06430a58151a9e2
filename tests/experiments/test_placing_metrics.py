"""What counts as a good placing, and how trials are summed up."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from hrc_learn.experiments.metric_table import evaluate
from hrc_learn.experiments.placing_metrics import (
    PlacingOutcome,
    placing_metrics,
)
from hrc_learn.experiments.placing_trial import (
    demonstrated_shelf,
    random_start,
    taught_correction,
)
from hrc_learn.experiments.run_measures import place_angle, place_pitch_and_yaw
from hrc_learn.geometry import Pose, quaternion
from hrc_learn.kinematics import panda
from hrc_learn.sim import Imperfections, Touch, World
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills.placing import PlaceCorrection
from hrc_learn.skills.work_cell import TaskFailedError

WORKPLACE = Workplace()
SHELVES = WORKPLACE.shelf_names()
GOOD = PlacingOutcome(
    deviation=2e-3,
    place_error=1e-4,
    place_tilt=1e-4,
    violations=0,
    contacts=(),
    peak_speed=0.5,
    jerk=1e-5,
    placed=True,
)


def faults(**changes):
    outcomes = dict.fromkeys(SHELVES, GOOD) | {"upper": replace(GOOD, **changes)}
    return evaluate(placing_metrics(SHELVES), outcomes).faults


def test_a_good_placing_has_no_faults():
    assert faults() == ()


@pytest.mark.parametrize("half_turn", [False, True])
def test_pitch_and_yaw_of_a_placed_box_are_turns_about_horizontal_and_vertical(half_turn):
    # The hand points along -y and closes along x: its box stands with its top towards +y.
    goal = WORKPLACE.shelf("middle").orientation
    box = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    if half_turn:
        box = box @ np.diag([-1.0, -1, 1])
    for axis, expected in ((0, (0.02, 0.0)), (1, (0.0, 0.0)), (2, (0.0, 0.02))):
        c, s = np.cos(-0.02), np.sin(-0.02)
        i, k = (axis + 1) % 3, (axis + 2) % 3
        pose = np.eye(4)
        pose[np.ix_([i, k], [i, k])] = [[c, -s], [s, c]]
        pose[:3, :3] = pose[:3, :3] @ box
        assert place_pitch_and_yaw(pose, goal) == pytest.approx(expected, abs=1e-9)
        assert place_angle(pose, goal) == pytest.approx(0.02)


def test_five_joints_have_rows_for_pitch_and_yaw():
    keys = {"place_pitch_deg", "place_yaw_deg"}
    outcomes = dict.fromkeys(SHELVES, GOOD)
    assert not keys & evaluate(placing_metrics(SHELVES), outcomes).values.keys()
    outcomes = dict.fromkeys(SHELVES, replace(GOOD, place_turns=(0.02, 0.0)))
    outcomes["upper"] = replace(GOOD, place_turns=(0.01, 0.03))
    values = evaluate(placing_metrics(SHELVES), outcomes).values
    assert values["place_pitch_deg"] == pytest.approx(np.rad2deg(0.02))
    assert values["place_yaw_deg"] == pytest.approx(np.rad2deg(0.03))


TOUCH = Touch(first="box", second="board_middle", start=6.1, end=6.2, depth=0.0121)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"deviation": 0.0121}, "upper shelf, approach-path deviation: 12.1 mm"),
        ({"place_error": 0.0035}, "place error: 3.5 mm"),
        ({"place_tilt": 0.1}, "place tilt: 5.73 deg"),
        ({"violations": 3}, "joint limit violations: 3"),
        ({"contacts": (TOUCH,)}, "upper shelf: box met board_middle at 6.10 s, 12.1 mm deep"),
        ({"placed": False}, "objects that stand on their shelf: 2"),
    ],
)
def test_each_fault_is_named(changes, words):
    (fault,) = faults(**changes)
    assert words in fault


@pytest.mark.parametrize("changes", [{"peak_speed": 1.1}, {"jerk": 0.02}])
def test_what_is_only_wanted_is_missed_but_no_fault(changes):
    outcomes = dict.fromkeys(SHELVES, replace(GOOD, **changes))
    evaluation = evaluate(placing_metrics(SHELVES), outcomes)
    assert [m.ok for m in evaluation.table].count(False) == 1
    assert evaluation.faults == ()


def test_the_demonstrated_shelf_is_where_the_end_effector_ended():
    for shelf in SHELVES:
        goal = WORKPLACE.shelf(shelf).position.numpy()
        assert demonstrated_shelf(goal + 0.01, WORKPLACE) == shelf
    with pytest.raises(ValueError, match="12 cm from the nearest shelf"):
        demonstrated_shelf(goal + np.array([0.0, 0.12, 0.0]), WORKPLACE)


def test_random_starts_are_free_and_each_another():
    world, rng = World(WORKPLACE.scene), np.random.default_rng(0)
    starts = [random_start(world, WORKPLACE, 0.1, rng) for _ in range(2)]
    assert world.holds(WORKPLACE.scene.objects[0].name)
    assert not torch.equal(*starts)
    for start in starts:
        assert panda.limits.contain(start)
        assert float((start - WORKPLACE.home_joints()).abs().max()) < 0.5


def true_tool(world, read):
    """Where the tool is when the arm reads a pose."""
    joints = panda.inverse(read, near=WORKPLACE.home_joints()).numpy()
    world.reset(joints - world.imperfections.encoder_offset)
    return world.arm.tcp_pose()


@pytest.mark.parametrize("seed", range(3))
def test_a_place_shown_once_takes_the_calibration_out_of_all_places(seed):
    rng = np.random.default_rng(seed)
    sizes = replace(Imperfections.nominal(), encoder_noise=0.0, teaching_error=0.0)
    world = World(WORKPLACE.scene, sizes.draw(rng))
    near = WORKPLACE.home_joints()
    correction = taught_correction(world, WORKPLACE.shelf("middle"), near, rng)
    for shelf in SHELVES:
        goal = WORKPLACE.shelf(shelf)
        misses = [
            np.linalg.norm(true_tool(world, read)[:3, 3] - goal.position.numpy())
            for read in (goal, correction.apply(goal))
        ]
        believed, corrected = 1e3 * np.array(misses)
        assert corrected < (1e-6 if shelf == "middle" else min(1.5, believed))
        assert believed > 0.3


def test_a_correction_shifts_and_turns_in_the_frame_of_the_tool():
    place = WORKPLACE.shelf("middle")
    turn = quaternion.exp(torch.tensor([0.02, 0.0, -0.01], dtype=torch.float64))
    shift = torch.tensor([1e-3, -2e-3, 3e-3], dtype=torch.float64)
    read = Pose(place.position + shift, quaternion.multiply(place.orientation, turn))
    other = WORKPLACE.shelf("upper")
    corrected = PlaceCorrection(read=read, place=place).apply(other)
    torch.testing.assert_close(corrected.position - other.position, shift)
    back = quaternion.multiply(quaternion.conjugate(other.orientation), corrected.orientation)
    torch.testing.assert_close(back, turn)


def test_starts_that_cannot_be_free_are_given_up():
    world, rng = World(WORKPLACE.scene), np.random.default_rng(0)
    with pytest.raises(TaskFailedError, match="no collision-free start"):
        random_start(world, WORKPLACE, 1e3, rng)
