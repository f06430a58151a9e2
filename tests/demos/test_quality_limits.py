"""Measures, edits and files of episodes at both sides of every limit."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from lerobot_folders import write_folder
from scipy.interpolate import CubicSpline

from hrc_learn.demos import DatasetError, Demonstration
from hrc_learn.demos.issues import Issue
from hrc_learn.demos.quality import episode_edits as edits
from hrc_learn.demos.quality import ranking, structure_checks, video_checks
from hrc_learn.demos.quality.ranking import Decision, EpisodeQuality, Ranking
from hrc_learn.demos.read.columns import ColumnMapping, ColumnSelection
from hrc_learn.demos.read.dataset_folder import EpisodeEntry, open_folder
from hrc_learn.demos.read.profiles import FeatureProfiles, profile_columns
from hrc_learn.demos.read.units import UnitDecision
from hrc_learn.demos.videos import VideoSegment

pytestmark = pytest.mark.simulation

STATE = "observation.state"


def entry(index=0, length=100, start=0, file="data/a.parquet", tasks=()):
    return EpisodeEntry(index=index, length=length, tasks=tasks, file=file, start=start)


def qualities(name, values):
    return [
        EpisodeQuality(episode=k, length=100, task="", measures={name: value})
        for k, value in enumerate(values)
    ]


@pytest.mark.parametrize(
    ("name", "usual", "own", "text"),
    [
        ("distance", 1.0, 2.01, "moves unlike all others: 2.0 times as far"),
        ("distance", 1.0, 1.99, None),
        ("duration", 5.0, 6.15, "takes 6.2 s, 5.0 s are usual"),
        ("duration", 5.0, 6.09, None),
        ("duration", 5.0, 4.06, "takes 4.1 s, 5.0 s are usual"),
        ("duration", 5.0, 4.1, None),
        ("gripper", 2.0, 4.0, "its gripper moves 4 times, 2 are usual"),
        ("gripper", 2.0, 0.0, None),
        ("idle", 0.1, 0.21, "rests for 21% of the time, 10% are usual"),
        ("idle", 0.1, 0.19, None),
        ("jerk", 5.0, 6.1, "moves jerkily: e^1.1 times the usual jerk"),
        ("jerk", 5.0, 5.9, None),
        ("late", 0.0, 0.021, "2% of its frames came late, 0% are usual"),
        ("late", 0.0, 0.019, None),
    ],
)
def test_measures_that_are_unusual(name, usual, own, text):
    given = qualities(name, [usual] * 4 + [own])
    ranking._mark_unusual(given)
    assert [q.score > 0 for q in given] == [False] * 4 + [text is not None]
    if text:
        (reason,) = given[4].reasons
        assert reason.startswith(text)
        assert 1 < given[4].score <= 5
    few = qualities(name, [usual] * 2 + [own])
    ranking._mark_unusual(few)
    assert not any(q.reasons for q in few)


def test_doubts_grow_with_the_distance_up_to_five():
    given = qualities("jerk", [5.0] * 4 + [5 + 8 * 0.25, 99.0])
    ranking._mark_unusual(given)
    assert given[4].score == pytest.approx(2)
    assert given[5].score == 5
    # By the spread of the episodes: a median deviation of 1 is a spread of 1.48.
    for own in (5.9, 6.0, 6.5):
        given = qualities("jerk", [-1.0, -1, 0, 1, 1, own])
        ranking._mark_unusual(given)
        spread = 1.4826 * np.median(np.abs(np.array([-1, -1, 0, 1, 1, own]) - 0.5))
        assert bool(given[5].reasons) == ((own - 0.5) / spread > 4)


def test_measures_that_are_unknown_are_passed_over():
    given = qualities("jerk", [5.0, 5.0, 5.0, np.nan, 9.0])
    ranking._mark_unusual(given)
    assert [bool(q.reasons) for q in given] == [False] * 4 + [True]


@pytest.mark.parametrize(
    ("opening", "moves"),
    [
        ([0, 0, 0], 0),
        ([0, 1, 0, 1], 3),
        ([0, 0.34, 0, 1], 1),
        ([0, 0.32, 0.65, 0.68, 1], 1),
        ([0, 1, 0.65, 1], 1),
        ([0, 1, 0.32, 1], 3),
        ([np.nan, 0, np.nan, 1], 1),
        ([np.nan, np.nan], 0),
        ([5, 5.3, 8, 5], 2),
        ([-1, 1], 1),
    ],
)
def test_a_gripper_moves_between_the_outer_thirds_of_its_travel(opening, moves):
    assert ranking.gripper_moves(np.array(opening, float)) == moves


def test_jerk_without_units_is_that_of_the_closed_form():
    """For q = sin t over a whole period: jerk squared integrates to pi, the path is 4 long."""
    t = np.linspace(0, 2 * np.pi, 4001)
    for scale, rate, columns in ((1, 1, 1), (30, 1, 1), (1, 9, 1), (1, 1, 2)):
        q = scale * np.stack([np.sin(t)] * columns, axis=1)
        expected = np.log(np.pi * (2 * np.pi) ** 5 / 16)
        found = ranking.log_dimensionless_jerk(t / rate, q)
        assert found == pytest.approx(expected, abs=2e-3)
    assert np.isnan(ranking.log_dimensionless_jerk(t, np.ones((4001, 1))))
    assert np.isnan(ranking.log_dimensionless_jerk(t[:50], np.outer(np.arange(50.0) * 0, [1])))


def test_episodes_are_measured():
    time = np.arange(200) / 100
    q = np.clip(np.arange(200) - 50, 0, 100)[:, None] * [0.01, 0.02]
    gripper = (np.arange(200) > 120) * 0.08
    demo = Demonstration(
        time=time, joint_position=q, joint_names=("a", "b"), gripper=gripper, fps=100
    )
    quality = EpisodeQuality(episode=0, length=200, task="")
    shape = ranking._measure(quality, demo)
    np.testing.assert_array_equal(shape, np.column_stack([q, gripper]))
    assert quality.measures["gripper"] == 1
    assert quality.measures["duration"] == pytest.approx(1.99)
    assert quality.measures["late"] == 0
    assert quality.measures["idle"] == pytest.approx(0.5, abs=0.08)
    assert abs(quality.start - 40) <= 8
    assert abs(quality.stop - 161) <= 8
    # Frames that come more than half a period late.
    for step, late in ((1.49, 0.0), (1.51, 2 / 199)):
        moved = time.copy()
        moved[50:] += (step - 1) / 100
        moved[90:] += (step - 1) / 100
        own = EpisodeQuality(episode=0, length=200, task="")
        ranking._measure(own, replace(demo, time=moved))
        assert own.measures["late"] == pytest.approx(late)
    short = EpisodeQuality(episode=0, length=4, task="")
    few = {"time": time[:4], "joint_names": ("a", "b"), "fps": 100}
    ranking._measure(short, Demonstration(joint_position=q[:4], **few))
    assert "jerk" not in short.measures
    five = {**few, "time": time[:5]}
    ranking._measure(short, Demonstration(joint_position=q[60:65], **five))
    assert "jerk" in short.measures
    still = EpisodeQuality(episode=0, length=200, task="", stop=200)
    ranking._measure(still, replace(demo, joint_position=0 * q))
    assert (still.start, still.stop, still.measures["idle"]) == (0, 200, 1)
    none = replace(demo, joint_position=None, gripper=None)
    assert ranking._measure(still, none) is None
    one = Demonstration(time=[0.0], gripper=[0.1], fps=100)
    assert ranking._measure(still, one).tolist() == [[0.1]]
    assert still.measures["late"] == 0


def test_the_distance_is_that_of_the_three_nearest_in_usual_ones():
    """Episodes on a line: 0, 1, 2, 3 and 9 steps apart."""
    ramp = np.linspace(0, 1, 20)
    shapes = {k: ramp + 0.01 * x for k, x in enumerate([0.0, 1, 2, 3, 9])}
    given = {k: EpisodeQuality(episode=k, length=9, task="") for k in shapes}
    ranking._compare(given, shapes)
    # Distances of the third nearest are 3, 2, 2, 3 and 8 steps.
    expected = [2.0, 4 / 3, 4 / 3, 2.0, 7.0]
    found = [given[k].measures["distance"] for k in shapes]
    np.testing.assert_allclose(found, np.divide(expected, 3), rtol=1e-6)
    places = np.array([given[k].place[0] for k in shapes])
    steps = 0.01 * np.diff([0, 1, 2, 3, 9])
    np.testing.assert_allclose(np.abs(np.diff(places)), steps, rtol=1e-6)
    few = {k: EpisodeQuality(episode=k, length=9, task="") for k in range(3)}
    ranking._compare(few, {k: shapes[k] for k in range(3)})
    assert few[0].place is None
    same = {k: EpisodeQuality(episode=k, length=9, task="") for k in range(5)}
    ranking._compare(same, dict.fromkeys(range(5), ramp))
    assert "distance" not in same[0].measures


def test_findings_count_once_a_kind_and_where_few_episodes_have_them():
    known = {k: EpisodeQuality(episode=k, length=9, task="") for k in range(6)}

    def issue(episode, message, severity=0.0):
        return Issue(message=message, episode=episode, key="action", severity=severity)

    issues = [issue(0, "is late by 3"), issue(0, "is late by 9", 2.0), issue(9, "lost")]
    found = [*ranking._one_of_each_kind(known, issues)]
    assert [(q.episode, i.message) for q, i in found] == [(0, "is late by 9")]
    common = [issue(k, "is late") for k in range(4)]
    assert len([*ranking._one_of_each_kind(known, common, 4)]) == 4
    assert len([*ranking._one_of_each_kind(known, common, 3)]) == 0
    assert len([*ranking._one_of_each_kind(known, common[:1], 0)]) == 1
    assert len([*ranking._one_of_each_kind(known, common)]) == 4


def test_a_ranking_as_text():
    odd = EpisodeQuality(episode=3, length=70, task="", measures={"duration": 1.234567})
    odd.doubt(10.0, "lost")
    odd.doubt(1.5, "late")
    whole = Ranking(path=Path("x"), episodes=(odd, *qualities("late", [0.0] * 3)), notes=("n",))
    lines = [*whole.lines(2)]
    assert lines[0].split()[:4] == ["episode", "doubt", "frames", "distance"]
    words = ["3", "11.5", "70", "-", "1.23", "-", "-", "-", "-", "lost;", "late"]
    assert lines[1].split() == words
    assert lines[3:] == ["and 2 less doubtful episodes", "n"]
    assert len([*whole.lines()]) == 6


@pytest.mark.parametrize(
    ("start", "stop", "valid"),
    [
        (0, 2, True),
        (0, 1, False),
        (5, 5, False),
        (98, 100, True),
        (99, 101, False),
        (-1, 5, False),
        (50, 101, False),
        (50, 102, False),
        (50, 100, True),
    ],
)
def test_a_cut_keeps_two_frames_of_the_episode_at_least(start, stop, valid):
    make = {"verdict": "cut", "length": 100, "start": start, "stop": stop}
    if valid:
        assert Decision(**make).stop == stop
    else:
        with pytest.raises(ValueError, match="are no part of two frames or more"):
            Decision(**make)


FACTORS = {"rad": 1.0, "deg": np.pi / 180}


def edit(values, role="joint_position", unit="rad", labels=None, time=None, **columns):
    """An episode of one quantity in the column of the state, and other columns."""
    values = np.asarray(values, float).reshape(len(values), -1)
    width, frames = values.shape[1], len(values)
    labels = tuple(labels or (f"j{k}" for k in range(width)))
    selections = {
        role: ColumnSelection(
            role=role, columns=tuple((STATE, k) for k in range(width)), labels=labels
        )
    }
    units = {role: UnitDecision(role=role, unit=unit)}
    if "action" in columns:
        columns["action"] = np.asarray(columns["action"], float).reshape(frames, -1)
        selections["command_position"] = ColumnSelection(
            role="command_position",
            columns=tuple(("action", k) for k in range(columns["action"].shape[1])),
            labels=labels,
        )
        units["command_position"] = UnitDecision(role="command_position", unit=unit)
    known = {key: np.asarray(v).reshape(frames, -1) for key, v in columns.items()}
    return edits.EpisodeEdit(
        entry=entry(length=frames),
        columns=ColumnMapping(
            selections=selections, joint_names=labels, extra=(), notes=(), unmatched={}
        ),
        units=units,
        frames={STATE: values, **known},
        time=np.arange(frames) / 50 if time is None else np.asarray(time, float),
        kept=np.arange(frames),
    )


SLOW = np.linspace(0, 1, 60)


def test_frames_are_dropped_with_their_stamps_and_their_count():
    given = edit(SLOW)
    wanted = np.arange(60) % 2 == 0
    half = given.only(wanted, "halved")
    assert half.kept.tolist() == [*range(0, 60, 2)]
    np.testing.assert_allclose(half.time, np.arange(30) / 25)
    assert half.changes == ("halved",)
    assert given.only(np.ones(60, bool), "none") is given
    assert len(given.only(np.arange(60) < 2, "two")) == 2
    with pytest.raises(DatasetError, match="one: no two frames are left"):
        given.only(np.arange(60) < 1, "one")
    assert half.fault("odd", frame=3).frame == 6
    assert replace(half, resampled=True).fault("odd", frame=3).frame is None


def test_stamps_that_do_not_increase_are_renewed_or_dropped():
    time = np.arange(60) / 50
    stalled = time.copy()
    stalled[[20, 21, 40]] = [time[19], time[18], time[39]]
    given = edit(SLOW, time=stalled)
    renewed = edits.renew_stamps(given, 50)
    np.testing.assert_allclose(renewed.time, time)
    text = "renewed the stamps: 3 steps that did not increase -> 0"
    assert renewed.changes == (text,)
    assert edits.renew_stamps(edit(SLOW), 50).changes == ()
    dropped = edits.drop_late(given)
    assert dropped.kept.tolist() == [k for k in range(60) if k not in (20, 21, 40)]
    text = "dropped 3 frames whose stamp does not increase: 60 -> 57"
    assert dropped.changes == (text,)


def test_frames_that_are_not_finite_are_dropped_if_allowed():
    values = np.stack([SLOW, SLOW], axis=1)
    values[[7, 9], [0, 1]] = np.nan, np.inf
    given = edit(values)
    text = "holds values that are not finite in 2 frames; drop those"
    with pytest.raises(DatasetError, match=text) as error:
        edits.drop_bad_frames(given, False)
    assert error.value.frame == 7
    left = edits.drop_bad_frames(given, True)
    assert [k for k in range(60) if k not in left.kept] == [7, 9]
    assert left.changes == ("dropped 2 frames with values that are not finite",)
    assert edits.drop_bad_frames(edit(SLOW), False).changes == ()
    late = edit(SLOW, time=np.where(np.arange(60) == 5, np.nan, np.arange(60) / 50))
    assert 5 not in edits.drop_bad_frames(late, True).kept


@pytest.mark.parametrize(("held", "dropped"), [(6, 5), (7, 0)])
def test_repeats_of_a_tenth_of_a_second_are_dropped(held, dropped):
    """At 50 Hz: six equal frames last 0.1 s."""
    values = SLOW.copy()
    values[20 : 20 + held] = values[20]
    left = edits.drop_repeats(edit(values))
    assert [k for k in range(60) if k not in left.kept] == [*range(21, 21 + dropped)]
    if dropped:
        assert left.changes == (f"dropped {dropped} repeated frames: 60 -> {60 - dropped}",)
    # Another command, or a clock that goes on.
    moving = edits.drop_repeats(edit(values, speed=np.outer(SLOW, [1, -1])))
    assert len(moving) == 60
    moved = edits.drop_repeats(edit(values, action=np.where(np.arange(60) == 23, 1.0, 0.0)))
    assert len(moved) == {6: 57, 7: 56}[held]


def test_a_repeat_at_the_end_and_two_of_them():
    values = SLOW.copy()
    values[57:] = values[57]
    values[10:12] = values[10]
    left = edits.drop_repeats(edit(values))
    assert [k for k in range(60) if k not in left.kept] == [11, 58, 59]


def jump(turns, at=30, speed=0.02, remainder=0.0):
    """A joint that creeps, and jumps by whole turns."""
    values = np.arange(60) * speed
    values[at:] += turns * 2 * np.pi + remainder
    return values


@pytest.mark.parametrize("unit", ["rad", "deg"])
@pytest.mark.parametrize("turns", [1, -1, 2])
def test_jumps_by_whole_turns_are_removed(unit, turns):
    values = np.stack([jump(turns), jump(0)], axis=1) / FACTORS[unit]
    mended = edits.unwrap(edit(values, unit=unit))
    np.testing.assert_allclose(mended.frames[STATE][:, 0] * FACTORS[unit], jump(0), atol=1e-9)
    np.testing.assert_array_equal(mended.frames[STATE][:, 1], values[:, 1])
    (change,) = mended.changes
    assert change.startswith("unwrapped joint_position (j0): largest step")
    old, new = (np.abs(np.diff(v)).max() for v in (values[:, 0], jump(0) / FACTORS[unit]))
    assert change.endswith(f"{old:.4g} -> {new:.4g} {unit}")
    assert edits.unwrap(edit(values[:, 1:], unit=unit)).changes == ()


@pytest.mark.parametrize(
    ("remainder", "removed"),
    [(0.0, True), (0.035, True), (0.05, False), (-0.07, True), (-0.09, False)],
)
def test_what_is_left_of_a_jump_fits_the_motion_around(remainder, removed):
    """Steps of 0.02 rad, thrice and a thousandth of a turn: at most 0.0663 rad."""
    values = jump(1, remainder=remainder)
    assert bool(edits.unwrap(edit(values)).changes) == removed


@pytest.mark.parametrize(("left", "removed"), [(0.29, True), (0.31, False)])
def test_no_more_than_0_3_rad_are_left_of_a_jump(left, removed):
    values = jump(1, speed=0.2, remainder=left - 0.2)
    assert bool(edits.unwrap(edit(values)).changes) == removed


def test_hands_switches_and_joints_that_follow_a_jump_stay():
    values = jump(1)
    assert edits.unwrap(edit(values, labels=("gripper",))).changes == ()
    assert edits.unwrap(edit(values, action=values)).changes == ()
    assert edits.unwrap(edit(values, action=jump(0))).changes != ()
    switch = np.where(np.arange(60) < 30, 0, 2 * np.pi)
    assert edits.unwrap(edit(switch)).changes == ()


def test_quaternions_keep_their_sign():
    angle = SLOW[:, None]
    q = np.hstack([np.cos(angle), np.sin(angle), 0 * angle, 0 * angle])
    flipped = q * np.where((np.arange(60) > 20) & (np.arange(60) < 40), -1, 1)[:, None]
    fixed = edits.fix_signs(edit(flipped, role="quaternion_wxyz", unit="1"))
    np.testing.assert_allclose(fixed.frames[STATE], q)
    text = "fixed 2 jumps of the sign of quaternion_wxyz: 2 -> 0"
    assert fixed.changes == (text,)
    assert edits.fix_signs(edit(q, role="quaternion_wxyz", unit="1")).changes == ()


def test_columns_are_resampled_by_splines_lines_and_levels():
    time = np.cumsum(np.random.default_rng(0).uniform(0.015, 0.025, 60)) + 3
    force = np.random.default_rng(1).normal(size=60)
    count = np.arange(60) // 10
    given = edit(np.sin(time * 3), time=time, force=force, count=count)
    moved = edits.resample_to_grid(given, 40)
    grid = np.arange(int((time[-1] - time[0]) * 40) + 1) / 40 + time[0]
    np.testing.assert_allclose(moved.time, grid)
    np.testing.assert_allclose(
        moved.frames[STATE][:, 0], CubicSpline(time - time[0], np.sin(time * 3))(grid - time[0])
    )
    np.testing.assert_allclose(moved.frames["force"][:, 0], np.interp(grid, time, force))
    nearest = [int(np.abs(time - t).argmin()) for t in grid]
    assert moved.kept.tolist() == nearest
    assert moved.frames["count"][:, 0].tolist() == count[nearest].tolist()
    assert moved.resampled
    assert moved.changes == (f"resampled 60 frames to {len(grid)} at 40 Hz",)
    with pytest.raises(DatasetError, match="hold no two frames"):
        edits.resample_to_grid(given, 0.1)
    turned = edits.resample_to_grid(edit(jump(1)), 50)
    np.testing.assert_allclose(turned.frames[STATE][:, 0], jump(0), atol=1e-9)
    with pytest.raises(DatasetError, match="holds poses as matrices"):
        edits.resample_to_grid(
            edit(np.tile(np.eye(4).ravel(), (60, 1)), role="pose_matrix", unit="m"), 50
        )


def rest_and_motion(before, after):
    return np.concatenate([np.zeros(before), SLOW, np.ones(after)])


def test_rest_is_trimmed_but_for_a_tenth_of_a_second_and_what_else_moves():
    values = rest_and_motion(50, 50)
    left = edits.trim(edit(values))
    assert abs(left.kept[0] - 45) <= 4
    assert abs(left.kept[-1] - 114) <= 4
    first = f"trimmed {left.kept[0] / 50:.2f} s at the beginning, "
    assert left.changes[0].startswith(first)
    end = f"{(159 - left.kept[-1]) / 50:.2f} s at the end: 160 -> {len(left)} frames"
    assert left.changes[0].endswith(end)
    # A command that begins to move before, and a gripper that closes after.
    for size, kept in ((0.02, True), (0.005, False)):
        command = rest_and_motion(50, 50)
        command[20:50] = size
        command[140:] = 1 - size
        own = edits.trim(edit(values, action=command))
        assert (own.kept[0] == 19) == kept
        assert (own.kept[-1] == 140) == kept
    gripper = np.where(np.arange(160) < 10, 0.0, 1.0)
    assert edits.trim(edit(values, **{"observation.grip": gripper})).kept[0] == 9
    assert edits.trim(edit(values, note=gripper)).kept[0] > 9
    none = edit(values, role="gripper", unit="1")
    assert edits.trim(none) is none
    with pytest.raises(DatasetError, match="the arm rests all the time"):
        edits.trim(edit(np.zeros(100)))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Three episodes of 20 frames at 50 Hz."""
    root = tmp_path_factory.mktemp("limits") / "set"
    episodes = [{STATE: np.zeros((20, 2))}] * 3
    return open_folder(write_folder(root, episodes, {STATE: ["a", "b"]}))


def messages(issues):
    return [(issue.episode, issue.frame, issue.key, issue.message) for issue in issues]


def test_index_columns_are_of_this_episode(folder):
    second = folder.episodes[1]
    count = np.arange(20)[:, None]
    sound = {
        "frame_index": count,
        "episode_index": np.full((20, 1), 1),
        "index": count + 20,
        "task_index": np.zeros((20, 1)),
    }
    assert messages(structure_checks.indices(folder, second, sound)) == []
    assert messages(structure_checks.indices(folder, second, {})) == []
    for key, value in (
        ("frame_index", 9),
        ("episode_index", 0),
        ("index", 3),
        ("task_index", 5),
    ):
        wrong = sound[key].copy()
        wrong[7] = wrong[11] = value
        ((episode, frame, at, text),) = messages(
            structure_checks.indices(folder, second, sound | {key: wrong})
        )
        assert (episode, frame, at) == (1, 7, key)
        begin = "task 5 is not in" if key == "task_index" else f"is {value}, expected "
        assert text.startswith(begin)
        if key != "task_index":
            assert text.startswith(f"is {value}, expected {sound[key][7, 0]};")


def test_episodes_that_overlap_or_leave_a_gap(folder):
    for shift in (-1, 1):
        entries = list(folder.episodes)
        entries[1] = replace(entries[1], start=20 + shift)
        own = replace(folder, episodes=tuple(entries))
        found = messages(structure_checks.offsets(own))
        assert found[0][0] == 1
        assert found[0][3].startswith(f"begins at row {20 + shift}, but episode 0 ends at 20")
        assert found[1][3].startswith(f"begins at row 40, but episode 1 ends at {40 + shift}")
    assert messages(structure_checks.offsets(folder)) == []
    moved = replace(folder, episodes=folder.episodes[::-1])
    assert messages(structure_checks.offsets(moved)) == []


@pytest.mark.parametrize("text", ["test", " TODO ", "Untitled", ""])
def test_texts_of_tasks_say_something(folder, text):
    own = replace(folder, tasks={0: "reach", 1: text}, info={**folder.info, "total_tasks": 2})
    (found,) = messages(structure_checks.task_texts(own))
    assert found[3].startswith("task 1")
    assert messages(structure_checks.task_texts(folder)) == []
    twice = replace(own, tasks={0: "reach", 1: "reach"})
    assert messages(structure_checks.task_texts(twice))[0][3] == "a task is listed twice"
    more = replace(folder, info={**folder.info, "total_tasks": 3})
    assert messages(structure_checks.task_texts(more))[0][3] == "says 3, but 1 are listed"
    other = replace(folder, tasks={0: "pour"})
    found = messages(structure_checks.task_texts(other))
    assert [f[0] for f in found] == [0, 1, 2]
    assert found[0][3] == "task 'reach' is not in the list of tasks"


def camera_folder(folder, shape=(4, 6, 3), version="v3.0"):
    """The dataset, with a camera declared."""
    feature = replace(folder.features[STATE], key="cam", dtype="video", shape=shape, names=None)
    return replace(
        folder,
        features={**folder.features, "cam": feature},
        info={**folder.info, "codebase_version": version},
    )


PLACE = {"file": "v.mp4", "key": "cam"}


@pytest.mark.parametrize(
    ("shape", "size", "rate", "text"),
    [
        ((4, 6, 3), (4, 6), 50.0, None),
        ((3, 4, 6), (4, 6), 50.0, None),
        ((4, 6, 3), (6, 4), 50.0, "has images of 6 x 4, declared are [4, 6, 3]"),
        ((4, 6), (6, 4), 50.0, None),
        ((4, 6, 3), (4, 6), 50.9, None),
        ((4, 6, 3), (4, 6), 51.1, "runs at 51.1 images a second, the dataset at 50"),
        ((4, 6, 3), (4, 6), 48.9, "runs at 48.9 images a second, the dataset at 50"),
        ((4, 6, 3), (4, 6), 0.0, None),
    ],
)
def test_size_and_rate_of_a_video(folder, shape, size, rate, text):
    stream = video_checks._Stream(20, rate, size)
    found = video_checks._size_and_rate(camera_folder(folder, shape), stream, PLACE)
    assert [issue.message for issue in found] == ([text] if text else [])


def segments(*bounds):
    return [
        (entry(k, 20), VideoSegment(file=Path("v.mp4"), start=a, stop=b))
        for k, (a, b) in enumerate(bounds)
    ]


@pytest.mark.parametrize(
    ("bounds", "images", "found"),
    [
        (((0, 0.4), (0.4, 0.8)), 40, []),
        (((0, 0.42), (0.42, 0.82)), 41, []),
        (
            ((0, 0.44), (0.44, 0.84)),
            42,
            [(0, "shows 22 images, but the episode has 20 frames")],
        ),
        (
            ((0, 0.36), (0.36, 0.76)),
            38,
            [(0, "shows 18 images, but the episode has 20 frames")],
        ),
        (((0, 0.4), (0.4, 0.8)), 39, []),
        (
            ((0, 0.4), (0.4, 0.8)),
            38,
            [(None, "ends after 0.760 s, but episodes reach to 0.800")],
        ),
        (((0, 0.4), (0.392, 0.792)), 40, []),
        (
            ((0, 0.4), (0.388, 0.788)),
            40,
            [(1, "begins at 0.388 s, before episode 0 ends (0.4")],
        ),
    ],
)
def test_episodes_of_a_video_have_their_images_and_do_not_overlap(
    folder, bounds, images, found
):
    shown = segments(*bounds)
    stream = video_checks._Stream(images, 50.0, (4, 6))
    told = [*video_checks._length(camera_folder(folder), shown, stream, PLACE)]
    assert [issue.episode for issue in told] == [episode for episode, _ in found]
    for issue, (_, text) in zip(told, found, strict=True):
        assert issue.message.startswith(text)
    # In any order of the list.
    assert len(
        [*video_checks._length(camera_folder(folder), shown[::-1], stream, PLACE)]
    ) == len(found)
    old = camera_folder(folder, version="v2.1")
    for count, off in ((21, 0), (22, 2), (18, 2), (19, 0)):
        stream = video_checks._Stream(count, 50.0, (4, 6))
        told = [*video_checks._length(old, shown[:1], stream, PLACE)]
        assert [issue.severity for issue in told] == [off] * bool(off)


def test_copies_of_a_video_are_known_by_their_ends(tmp_path):
    rng = np.random.default_rng(0)
    content = rng.bytes(300_000)
    one, two = tmp_path / "a", tmp_path / "b"
    one.write_bytes(content)

    def same(other):
        two.write_bytes(other)
        return video_checks._digest(one) == video_checks._digest(two)

    assert same(content)
    assert not same(content[:-1])
    ends = 2**16, 300_000 - 2**16
    for at in (0, 2**16 - 1, 2**16, 150_000, ends[1] - 1, ends[1], 299_999):
        changed = bytearray(content)
        changed[at] ^= 1
        assert same(bytes(changed)) == (ends[0] <= at < ends[1])
    one.write_bytes(b"ab")
    assert same(b"ab")
    assert not same(b"aa")


@pytest.mark.parametrize(
    ("name", "shift", "told"),
    [
        ("min", 0.19, False),
        ("min", 0.21, True),
        ("max", -0.19, False),
        ("max", -0.21, True),
        ("mean", 5.19, False),
        ("mean", 5.21, True),
        ("mean", -5.19, False),
        ("mean", -5.21, True),
        ("std", -2.0, False),
        ("std", -2.01, True),
        ("max", 190.9, False),
        ("max", 191.1, True),
        ("min", float("nan"), True),
    ],
)
def test_statistics_fit_within_a_fiftieth_of_the_range(folder, tmp_path, name, shift, told):
    """Values from 0 to 10: a fiftieth is 0.2; twenty ranges and one are 201."""
    stated = {"min": 0.0, "max": 10.0, "mean": 5.0, "std": 2.0}
    stated[name] += shift
    (tmp_path / "meta").mkdir()
    rows = {key: [value, 5.0 * (key != "min")] for key, value in stated.items()}
    text = json.dumps({STATE: rows})
    (tmp_path / "meta/stats.json").write_text(text)
    values = np.stack([np.linspace(0, 10, 30), np.linspace(0, 5, 30)], axis=1)
    profiles = [profile_columns({STATE: values})[STATE]] * 2
    feature = FeatureProfiles(
        key=STATE,
        fps=50.0,
        entries=[entry(0), entry(1)],
        profiles=profiles,
        names=["a", "b"],
        smooth=np.ones(2, bool),
    )
    found = [*structure_checks.statistics_fit(replace(folder, root=tmp_path), [feature])]
    assert len(found) == told
    assert all("do not fit the data in 1 components" in issue.message for issue in found)
