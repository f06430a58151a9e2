"""Evidence for units: sizes of values, and every guess at both sides of its bounds."""

import math

import numpy as np
import pytest

from hrc_learn.demos.read import unit_evidence as evidence
from hrc_learn.demos.read.columns import ColumnSelection
from hrc_learn.demos.read.dataset_folder import EpisodeEntry
from hrc_learn.demos.read.unit_evidence import Guess, Sizes, measure
from hrc_learn.demos.read.units import decide_units, units_from_episodes

pytestmark = pytest.mark.simulation


def sizes(*peak, clipped=0.0, whole=False, unit_length=False, opening=False):
    """Sizes of components, of which the other figures are alike or given one by one."""
    size = np.array(peak, float)
    flags = [np.broadcast_to(flag, size.shape).copy() for flag in (whole, unit_length, opening)]
    return Sizes(size, np.broadcast_to(clipped, size.shape).astype(float), *flags)


def test_sizes_are_measured_without_outliers():
    """The 199th of 201 sorted sizes is the 99.5 % quantile."""
    values = np.stack([np.arange(201.0), -np.arange(201.0) / 10, np.zeros(201)], axis=1)
    values[7, 2] = np.inf
    got = measure(values)
    np.testing.assert_allclose(got.peak, [199, 19.9, 0])
    np.testing.assert_allclose(got.clipped, [1 / 201, 0, 0])
    assert got.whole.tolist() == [True, False, True]
    assert not got.unit_length.any()
    assert not got.opening.any()


def test_openings_go_from_exactly_0_to_exactly_1():
    t = np.linspace(0, 1, 11)
    got = measure(np.stack([t, t * 0.99, 0.01 + 0.99 * t, -t, 2 * t], axis=1))
    assert got.opening.tolist() == [True, False, False, False, False]


def turning(frames=50, error=0.0):
    angle = np.linspace(0, 1, frames)
    return (1 + error) * np.stack([np.cos(angle), np.sin(angle), 0 * angle, 0 * angle], axis=1)


@pytest.mark.parametrize(
    ("columns", "found"),
    [
        (turning(), [True, False, False, False]),
        (np.hstack([np.full((50, 1), 2.0), turning()]), [False, True, False, False, False]),
        (turning()[:, :3], [False] * 3),
        (turning(error=1.9e-3), [True, False, False, False]),
        (turning(error=2.1e-3), [False] * 4),
        (turning(error=-2.1e-3), [False] * 4),
        # Of unit length, but at rest.
        (np.tile([0.6, 0, 0.8, 0], (50, 1)), [False] * 4),
    ],
)
def test_four_columns_of_unit_length_that_move(columns, found):
    assert measure(columns).unit_length.tolist() == found


@pytest.mark.parametrize(
    ("largest", "clipped"), [(1.0, [0.5, 0]), (100.0, [0, 0.5]), (50.0, [0, 0]), (0.9, [0, 0])]
)
def test_values_at_the_limit_of_1_or_100_are_counted(largest, clipped):
    values = np.array([[1.0, 0.1], [0.2, 0.1], [-1.0, 0.3], [0.5, 0.2]])
    values[:, 1] = [largest, -largest, 0.3, 0.2] if largest > 1 else values[:, 1]
    values[:, 0] *= min(largest, 1)
    assert measure(values).clipped.tolist() == clipped


@pytest.mark.parametrize(("angle", "moves"), [(0.9e-3, False), (1.1e-3, True)])
def test_a_quaternion_moves_by_a_thousandth(angle, moves):
    turn = np.linspace(0, angle, 20)
    q = np.stack([np.cos(turn), np.sin(turn), 0 * turn, 0 * turn], axis=1)
    assert measure(q).unit_length[0] == moves


def test_no_single_episode_decides():
    many = [
        sizes(1, 2, whole=True),
        sizes(3, 4, clipped=0.3, whole=[True, False]),
        sizes(90, 9),
    ]
    got = evidence.typical(many)
    assert got.peak.tolist() == [3, 4]
    np.testing.assert_allclose(got.clipped, 0.1)
    assert got.whole.tolist() == [False, False]
    one = [sizes(1, opening=True, unit_length=True), sizes(2, opening=True, unit_length=True)]
    assert evidence.typical(one).opening.tolist() == [True]
    assert evidence.typical(one).unit_length.tolist() == [True]
    assert evidence.typical([*one, sizes(3)]).opening.tolist() == [False]
    assert evidence.typical([*one, sizes(3)]).unit_length.tolist() == [False]


@pytest.mark.parametrize(
    ("robot", "labels", "hobby"),
    [
        ("so100_follower", (), True),
        ("SO-101", (), True),
        ("koch", (), True),
        ("panda", ("shoulder_pan", "elbow_flex", "j3"), False),
        ("", ("shoulder_pan", "Main_Elbow_flex", "wrist_roll"), True),
        ("franka", ("a", "b"), False),
    ],
)
def test_arms_of_hobby_servos(robot, labels, hobby):
    assert evidence.is_hobby_arm(robot, labels) == hobby


REACH = "values usually reach"
SIX = ("a", "b", "c", "d", "e", "f")
HOBBY = ("shoulder_pan", "shoulder_lift", "elbow_flex")


@pytest.mark.parametrize(
    ("given", "labels", "guess"),
    [
        (sizes(0, 0), SIX, Guess("rad", 0.9, "the joints do not move")),
        (sizes(1e-6, 0.9e-6), SIX, Guess("rad", 0.9, "the joints do not move")),
        (sizes(1.1e-6, 0), SIX, Guess("rad", 0.95, "values usually reach 1.1e-06", "deg")),
        (sizes(1, 6.28), SIX, Guess("rad", 0.95, "values usually reach 6.28", "deg")),
        (sizes(6.38, 6.3), SIX, Guess("rad", 0.95, "values usually reach 6.38", "deg")),
        (sizes(12.5, 12.5), SIX, Guess("rad", 0.7, "values usually reach 12.5", "deg")),
        (sizes(400, 400), SIX, Guess("deg", 0.8, "values usually reach 400", "%")),
        (sizes(401, 401), SIX, Guess("tick", 0.4, "values usually reach 401", "deg")),
        (sizes(math.tau, 1), SIX, Guess("rad", 0.95, "values usually reach 6.28", "deg")),
        (sizes(12.6, 12.6), SIX, Guess("deg", 0.75, "values usually reach 12.6", "%")),
        (sizes(100.0, 100.0), SIX, Guess("deg", 0.75, "values usually reach 100", "%")),
        (sizes(100.1, 12.6), SIX, Guess("deg", 0.8, "values usually reach 100", "%")),
        (sizes(100.1, 99, 98), HOBBY, Guess("deg", 0.9, "values usually reach 100", "%")),
        (
            sizes(99, 50, 30),
            HOBBY,
            Guess(
                "deg", 0.5, "values usually reach 99; this arm is recorded in both units", "%"
            ),
        ),
        (
            sizes(100.0, 50, clipped=[0.0021, 0]),
            SIX,
            Guess("%", 0.9, "a joint is at exactly 100 in 0 % of the frames", "deg"),
        ),
        (
            sizes(100.0, 50, clipped=[0.25, 0.1]),
            SIX,
            Guess("%", 0.9, "a joint is at exactly 100 in 25 % of the frames", "deg"),
        ),
        (
            sizes(100.0, 50, clipped=0.002),
            SIX,
            Guess("deg", 0.75, "values usually reach 100", "%"),
        ),
        (sizes(2000, 3000, whole=True), SIX, Guess("tick", 0.8, f"{REACH} 3e+03", "mdeg")),
        # Beyond two turns of an encoder, counts may be thousandths of a degree.
        (sizes(2000, 8191, whole=True), SIX, Guess("tick", 0.8, f"{REACH} 8.19e+03", "mdeg")),
        (sizes(2000, 8192, whole=True), SIX, Guess("tick", 0.4, f"{REACH} 8.19e+03", "mdeg")),
        # Values that were scaled to -1..1.
        (
            sizes(1, 1, 0.5, clipped=[0.1, 0.1, 0]),
            SIX,
            Guess("1", 0.5, "joints reach exactly 1, but never exceed it", "rad"),
        ),
        (sizes(1, 1, clipped=[0.1, 0]), SIX, Guess("rad", 0.95, f"{REACH} 1", "deg")),
        (sizes(1, 1.5, clipped=0.1), SIX, Guess("rad", 0.95, f"{REACH} 1.5", "deg")),
        (sizes(2000, 3000), SIX, Guess("tick", 0.4, f"{REACH} 3e+03", "deg")),
        (
            sizes(2000, 3000, whole=[True, False]),
            SIX,
            Guess("tick", 0.4, f"{REACH} 3e+03", "deg"),
        ),
        # One joint of three is out of line.
        (
            sizes(1, 2, 90),
            SIX,
            Guess("rad", 0.3, f"{REACH} 2, but not those of all joints (c 90)", "deg"),
        ),
        (
            sizes(90, 80, 900, 901, 70),
            SIX,
            Guess(
                "deg",
                0.3,
                "values usually reach 90, but not those of all joints (c 900, d 901)",
                "",
            ),
        ),
        (
            sizes(0.1, 0.2, 0.3, 0.4, unit_length=[True, False, False, False]),
            SIX,
            Guess("rad", 0.3, "a .. d always have unit length, as a quaternion has"),
        ),
    ],
)  # fmt: skip
def test_the_unit_of_joints_by_their_reach(given, labels, guess):
    arm = np.ones(len(given.peak), bool)
    assert evidence.guess_joints(given, arm, labels, "") == guess


def test_fingers_do_not_speak_for_the_unit_of_an_arm():
    given = sizes(1, 2, 255, 90, clipped=[0, 0, 0, 0.5], unit_length=[False, False, True, True])
    arm = np.array([True, True, False, False])
    assert evidence.guess_joints(given, arm, SIX, "").unit == "rad"
    assert evidence.guess_joints(given, arm, SIX, "").confidence == 0.95
    given = sizes(90, 60, 50, clipped=[0, 0, 0.5])
    assert evidence.guess_joints(given, np.array([True, True, False]), SIX, "").unit == "deg"


def test_names_of_old_hobby_arms():
    old = [f"main_{name}" for name in HOBBY]
    text = "values usually reach 99, the names are older than -100..100"
    expected = Guess("deg", 0.85, text, "%")
    assert evidence.guess_joints(sizes(99, 50, 30), np.ones(3, bool), old, "") == expected
    guess = evidence.guess_joints(sizes(99, 50, 30), np.ones(3, bool), ["main_a", "b", "c"], "")
    assert guess.confidence == 0.75


@pytest.mark.parametrize(
    ("peaks", "whole", "label", "arm_unit", "hobby", "units"),
    [
        # A hand that counts to 255, with a finger that moves little.
        ((255, 80), True, "hand", "rad", False, ["byte", "byte"]),
        ((255, 80), [True, False], "hand", "rad", False, ["byte", "%"]),
        ((105, 80), True, "hand", "rad", False, ["%", "%"]),
        ((106, 80), True, "hand", "rad", False, ["byte", "byte"]),
        ((256, 80), True, "hand", "rad", False, ["rad", "%"]),
        ((255.5, 1.05), True, "hand", "rad", False, ["byte", "1"]),
        ((0.12, 0.13), False, "finger", "rad", False, ["m", "1"]),
        ((0.0, 0.12), False, "Left_Finger", "rad", False, ["1", "m"]),
        ((0.04, 1.05), False, "gripper", "rad", False, ["1", "1"]),
        ((1.06, 12.5), False, "gripper", "rad", False, ["rad", "rad"]),
        ((1.06, 12.5), False, "gripper", "deg", True, ["%", "%"]),
        ((12.6, 105), False, "gripper", "rad", False, ["%", "%"]),
        ((12.6, 105), False, "gripper", "deg", True, ["%", "%"]),
        ((12.6, 105), False, "gripper", "deg", False, ["deg", "deg"]),
        ((105.1, 255.5), False, "gripper", "rad", False, ["byte", "byte"]),
        ((105.1, 255.6), False, "gripper", "deg", False, ["deg", "deg"]),
        ((400, 255.6), False, "gripper", "tick", True, ["tick", "tick"]),
    ],
)
def test_the_unit_of_fingers_by_their_size(peaks, whole, label, arm_unit, hobby, units):
    given, hand = sizes(*peaks, whole=whole), np.ones(2, bool)
    labels = (label, label)
    assert evidence.guess_fingers(given, hand, labels, arm_unit, hobby) == units


SURE = Guess("rad", 0.95, "small", "deg")


@pytest.mark.parametrize(
    ("peaks", "labels", "numbered", "reason"),
    [
        # Six columns of which the last stays small, as the fingers of a gripper do.
        ((1, 1, 1, 1, 1, 0.04), None, True, "the last column stays within 0.04"),
        ((1, 1, 1, 1, 1, 0.04), None, False, None),
        ((1, 1, 1, 1, 0.04), None, True, None),
        ((1, 1, 1, 1, 1, 1, 1, 1, 0.04), None, True, None),
        ((1, 1, 1, 1, 1, 1, 1, 0.04), None, True, "the last column stays within 0.04"),
        ((1.3, 1, 1, 1, 1, 0.12), None, True, "the last column stays within 0.12"),
        ((1.3, 1, 1, 1, 1, 0.121), None, True, None),
        ((1.1, 1, 1, 1, 1, 0.12), None, True, None),
        ((1, 1, 1, 1, 1, 0.9e-3), None, True, None),
        ((1, 1, 1, 1, 1, 1.1e-3), None, True, "the last column stays within 0.0011"),
        ((1, 1, 1, 1), "motor_", False, "4 columns are few for an arm"),
        ((1, 1, 1, 1), "Motor", False, "4 columns are few for an arm"),
        ((1, 1, 1, 1), None, True, None),
        ((1, 1, 1, 1, 1), "motor_", False, None),
    ],
)
def test_columns_without_telling_names_may_be_a_pose(peaks, labels, numbered, reason):
    names = tuple(f"{labels or 'j'}{i}" for i in range(len(peaks)))
    guess = evidence.doubt_meaning(SURE, sizes(*peaks), names, numbered)
    if reason is None:
        assert guess == SURE
    else:
        assert (guess.confidence, guess.unit, guess.other) == (0.5, "rad", "deg")
        assert guess.evidence.startswith(
            f"small; names do not tell joints from a pose, and {reason}"
        )
        low = SURE._replace(confidence=0.3)
        assert evidence.doubt_meaning(low, sizes(*peaks), names, numbered).confidence == 0.3


def test_small_values_without_names_may_be_revolutions():
    for numbered, peaks, sure in (
        (True, [0.49] * 6, 0.6),
        (True, [0.51] * 6, 0.95),
        (False, [0.49] * 6, 0.95),
    ):
        guess = evidence.doubt_meaning(SURE, sizes(*peaks), tuple("abcdef"), numbered)
        assert guess.confidence == sure
    assert evidence.doubt_meaning(SURE, sizes(0.4, 0.4), ("a", "b"), True).other == "rev"


@pytest.mark.parametrize(
    ("largest", "whole", "unit"),
    [
        (0.2, False, "m"),
        (2.0, False, "1"),
        (105, False, "%"),
        (105.1, True, "byte"),
        (254.4, False, "mm"),
        (254.6, False, "byte"),
        (255.4, False, "byte"),
        (255.6, True, "mm"),
    ],
)
def test_the_unit_of_an_opening(largest, whole, unit):
    guess = evidence.guess_by_size("gripper", sizes(0.0, largest, whole=whole))
    assert guess.unit == unit
    assert guess.evidence == f"values usually reach {largest:.3g}"


def selection(role, count, labels=None):
    labels = labels or tuple(f"j{i}" for i in range(count))
    columns = tuple((role, i) for i in range(count))
    return ColumnSelection(role=role, columns=columns, labels=labels)


def of_episodes(episodes, role="joint_position", fps=1.0, **options):
    """Decision and faults of a quantity in several episodes."""
    width = episodes[0].shape[1]
    entries = [
        EpisodeEntry(index=k, length=len(values), tasks=(), file=f"{k}.parquet", start=0)
        for k, values in enumerate(episodes)
    ]
    pairs = [(entry, {role: values}) for entry, values in zip(entries, episodes, strict=True)]
    chosen = {role: selection(role, width)}
    decisions, faults = units_from_episodes(chosen, pairs, fps, {}, {}, **options)
    return decisions[role], [(fault.episode, str(fault)) for fault in faults]


def swing(size, frames=100, width=3):
    return np.sin(np.linspace(0, 6.2, frames))[:, None] * size * np.linspace(0.5, 1, width)


@pytest.mark.parametrize(
    ("factor", "found"),
    [
        (180 / math.pi, "57 times as large as in the other episodes: deg among rad"),
        (math.pi / 180, "57 times as small as in the other episodes: converted twice"),
        (23.5, "24 times as large"),
        (22.0, None),
        (1 / 23.5, "24 times as small"),
        (1 / 22.0, None),
        (140.0, "140 times as large"),
        (147.0, None),
        (1.0, None),
    ],
)
def test_an_episode_in_another_unit_than_the_others(factor, found):
    decision, faults = of_episodes([swing(2.0), swing(2.0), swing(2.0 * factor), swing(2.0)])
    assert decision.unit == "rad"
    assert [index for index, _ in faults] == ([2] if found else [])
    assert all(found in text for _, text in faults)


def test_episodes_in_degrees_have_radians_among_them_or_are_converted_twice():
    many = [swing(90.0)] * 3
    radians = of_episodes([*many, swing(1.57)])[1]
    assert "57 times as small as in the other episodes: rad among deg" in radians[0][1]
    twice = of_episodes([*many, swing(90 * 57.3)])[1]
    assert "57 times as large as in the other episodes: converted twice" in twice[0][1]
    assert "joint_position (j0)" in twice[0][1]


def test_components_that_hardly_move_are_not_compared():
    still = swing(2.0) * [0.001, 1, 1]
    other = still * [57.3, 1, 1]
    assert of_episodes([still, still, other])[1] == []
    assert of_episodes([still * 0.001] * 3 + [still])[1] == []
    (fault,) = of_episodes([still, still, still * 57.3])[1]
    assert "joint_position (j1)" in fault[1]
    # Fractions of a range and quantities that are no angles.
    clipped = np.clip(swing(150.0), -100, 100)
    assert of_episodes([clipped, clipped, clipped / 57.3])[0].unit == "%"
    assert of_episodes([clipped, clipped, clipped / 57.3])[1] == []
    metres = swing(1.0)
    assert of_episodes([metres, metres, metres * 57.3], role="position")[1] == []


def test_the_episodes_of_a_sample_decide():
    episodes = [swing(90.0), swing(90.0), swing(90.0), swing(1.5)]
    assert of_episodes(episodes)[0].unit == "deg"
    assert of_episodes(episodes, sample={3})[0].unit == "rad"
    assert of_episodes(episodes, sample={9})[0].unit == "deg"


def test_long_episodes_are_sampled_evenly():
    """Every third frame of 2500 suffices, and the last ones count as the first."""
    values = np.full((2500, 1), 1.0)
    values[1::3] = values[2::3] = 90.0
    assert of_episodes([values])[0].evidence == "values usually reach 1"
    values = np.full((999, 1), 1.0)
    values[1::2] = 90.0
    assert of_episodes([values])[0].evidence == "values usually reach 90"


@pytest.mark.parametrize(
    ("factor", "unit"),
    [(1, "s"), (1e3, "ms"), (30.0, "s"), (33.0, "ms"), (1e6, "us"), (0.0, "s")],
)
def test_the_unit_of_stamps_brings_their_step_near_the_period(factor, unit):
    time = np.arange(50.0)[:, None] / 50 * factor
    time[3:] += 100 * factor  # a gap counts for little
    decision, _ = of_episodes([time, time[:1], time], role="time", fps=50)
    assert decision.unit == unit
    assert decision.guessed == (unit != "s")


def test_commands_that_are_clipped_tell_the_unit_of_joints_that_stop_before():
    near, far = sizes(95, 60), sizes(100, 99, clipped=[0.1, 0])

    def unit(joints, command):
        chosen = {r: selection(r, 2) for r in ("joint_position", "command_position")}
        known = {"joint_position": joints, "command_position": command}
        return decide_units(chosen, known, {})["joint_position"]

    assert (unit(near, far).unit, unit(near, far).evidence[:30]) == (
        "%",
        "a joint is at exactly 100 in 10"[:30],
    )
    assert unit(near, sizes(100, 99)).evidence == "values usually reach 100"
    assert unit(sizes(89, 60), sizes(120, 99)).evidence == "values usually reach 89"
    assert unit(sizes(91, 60), sizes(120, 99)).evidence == "values usually reach 120"
    assert unit(sizes(91, 60), sizes(89, 99)).evidence == "values usually reach 91"
    assert unit(sizes(120, 60), sizes(95, 99)).evidence == "values usually reach 120"


def test_a_last_column_that_opens_from_0_to_1_is_a_gripper():
    labels = ("a", "b", "c")
    chosen = {"joint_position": selection("joint_position", 3, labels)}
    given = sizes(90, 80, 1.0, opening=[False, False, True])
    assert decide_units(chosen, {"joint_position": given}, {})["joint_position"].units == (
        "deg", "deg", "1",
    )  # fmt: skip
    given = sizes(1.0, 1.0, 1.0, opening=True)
    assert decide_units(chosen, {"joint_position": given}, {})["joint_position"].units == ()


def test_a_doubtful_guess_names_its_candidates_and_how_sure_it_is():
    chosen = {"position": selection("position", 3)}
    decision = decide_units(chosen, {"position": sizes(45.0, 1, 1)}, {})["position"]
    assert "(50 % sure)" in decision.note
    assert "taken for cm, 50 % sure" in decision.doubt
    assert "--units position cm or --units position mm" in decision.doubt
    sure = decide_units(chosen, {"position": sizes(0.5, 1, 1)}, {})["position"]
    assert "sure" not in sure.note
    assert sure.doubt is None
    assumed = decide_units(chosen, {}, {})["position"]
    assert (assumed.confidence, assumed.evidence, assumed.guessed) == (
        0.95,
        "by its name",
        False,
    )
    assert assumed.note is None


def test_units_of_components_that_differ():
    chosen = {"joint_position": selection("joint_position", 3)}
    decision = decide_units(chosen, {}, {"joint_position": ["deg", "m", "deg"]})[
        "joint_position"
    ]
    assert (decision.unit, decision.units) == ("deg", ("deg", "m", "deg"))
    np.testing.assert_allclose(decision.factor, [math.pi / 180, 1, math.pi / 180])
    assert [decision.unit_of(i) for i in range(3)] == ["deg", "m", "deg"]
    alike = decide_units(chosen, {}, {"joint_position": ["deg"] * 3})["joint_position"]
    assert (alike.units, alike.unit_of(2), alike.factor) == ((), "deg", math.pi / 180)


@pytest.mark.parametrize(
    ("step", "unit"),
    [
        # Ranges of a quarter turn to a turn step by 0.049 to 0.195 of -100..100.
        ((0.049, 0.06, 0.08, 0.1, 0.195), "%"),
        ((0.04, 0.06, 0.08, 0.1, 0.195), "deg"),
        ((0.049, 0.06, 0.08, 0.1, 0.21), "deg"),
        # Ranges that differ by a hundredth may be one range, measured with noise.
        ((0.1, 0.1, 0.1, 0.1, 0.1012), "%"),
        ((0.1, 0.1, 0.1, 0.1, 0.1008), "deg"),
    ],
)
def test_steps_count_as_fractions_of_a_range_only_if_all_ranges_are_a_joints(step, unit):
    given = sizes(*[90.0] * 5)._replace(step=np.array(step))
    labels = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll")
    found = evidence.guess_joints(given, np.ones(5, bool), labels, "so101_follower")
    assert (found.unit, found.confidence > 0.9) == (unit, unit == "%")


@pytest.mark.parametrize("robot", ["mujoco_so101", "mujoco_ur5e", "franka_panda", "ros2"])
def test_sets_of_our_own_robots_need_no_question(robot):
    """`lerobot-record` declares no units, but these robots record rad and m."""
    chosen = {role: selection(role, 2) for role in ("joint_position", "gripper")}
    given = {"joint_position": sizes(1.6, 0.3), "gripper": sizes(0.032, 0.03)}
    decided = decide_units(chosen, given, {}, robot_type=robot)
    for role, unit in (("joint_position", "rad"), ("gripper", "m")):
        assert (decided[role].unit, decided[role].confidence) == (unit, 0.99)
        assert decided[role].note is None
        assert f"{robot} records {unit}" in decided[role].evidence


@pytest.mark.parametrize("robot", ["my_mujoco_arm", "franka", "so101_follower", ""])
def test_other_robots_may_record_any_unit(robot):
    chosen, given = {"joint_position": selection("joint_position", 2)}, sizes(1.6, 0.3)
    decided = decide_units(chosen, {"joint_position": given}, {}, robot_type=robot)
    assert decided["joint_position"].note is not None


def test_values_that_contradict_one_of_our_own_robots_are_doubted():
    chosen, given = {"joint_position": selection("joint_position", 2)}, sizes(90, 45.0)
    decided = decide_units(chosen, {"joint_position": given}, {}, robot_type="mujoco_so101")
    assert decided["joint_position"].unit == "deg"
    assert decided["joint_position"].guessed
