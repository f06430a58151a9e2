"""Measures of episodes, and the ranking made of them, at both sides of every limit."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hrc_learn.demos import Demonstration
from hrc_learn.demos.issues import Issue
from hrc_learn.demos.quality import ranking
from hrc_learn.demos.quality.ranking import EpisodeQuality, Ranking

pytestmark = pytest.mark.simulation


def qualities(name, values):
    return [
        EpisodeQuality(episode=k, length=100, task="", measures={name: value})
        for k, value in enumerate(values)
    ]


@pytest.mark.parametrize(
    ("name", "usual", "own", "text"),
    [
        ("distance", 1.0, 2.01, "moves unlike the other episodes: 2.0 times the usual"),
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
