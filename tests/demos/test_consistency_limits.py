"""Comparisons between episodes, on statistics at both sides of every limit."""

from dataclasses import replace

import numpy as np
import pytest

from hrc_learn.demos.quality import consistency_checks as checks
from hrc_learn.demos.read.columns import ColumnSelection
from hrc_learn.demos.read.dataset_folder import EpisodeEntry
from hrc_learn.demos.read.profiles import (
    ColumnProfile,
    EpisodeProfile,
    FeatureProfiles,
    Tracking,
    are_positions,
    commanded_rates,
    is_discrete,
)
from hrc_learn.demos.read.units import UnitDecision

pytestmark = pytest.mark.simulation

STATE = "observation.state"
NAMES = ("a", "b", "c")
RAMP = [0.0, 0.05, 0.5, 0.95, 1.0]
"""Quantiles of a motion from 0 to 1."""


def entry(index, length=100):
    return EpisodeEntry(index=index, length=length, tasks=(), file=f"{index}.parquet", start=0)


def profile(**statistics):
    """Statistics of three components that go from 0 to 1, but for those given."""
    made = {
        "levels": np.tile(RAMP, (3, 1)).T,
        "start": np.zeros(3),
        "goal": np.ones(3),
        "step": np.full(3, 0.02),
        "noise": np.full(3, 1e-3),
        "held": np.ones(3, int),
        "distinct": np.full(3, 100),
        "low": np.zeros(3),
        "high": np.ones(3),
        "at_ends": np.ones((2, 3), int),
        "flat": np.zeros(3),
    }
    for name, value in statistics.items():
        made[name] = np.broadcast_to(np.asarray(value, made[name].dtype), made[name].shape)
    return ColumnProfile(**made)


def feature(profiles, key=STATE, smooth=True, lengths=(), names=NAMES, fps=50.0):
    lengths = lengths or [100] * len(profiles)
    return FeatureProfiles(
        key=key,
        fps=fps,
        entries=[entry(k, n) for k, n in enumerate(lengths)],
        profiles=profiles,
        names=list(names),
        smooth=np.broadcast_to(smooth, 3).copy(),
    )


def alike(*odd, count=4, **usual):
    """Four equal episodes, and others that are given."""
    return [*(profile(**usual) for _ in range(count)), *odd]


def said(issues):
    return [(issue.episode, issue.components, issue.message) for issue in issues]


@pytest.mark.parametrize(
    ("lengths", "odd"),
    [
        ([100, 100, 20, 100], [2]),
        ([100, 100, 21, 100], []),
        ([100, 499, 100, 100], []),
        ([100, 500, 100, 100], [1]),
        ([100, 500, 100], []),
        ([], []),
    ],
)
def test_episodes_five_times_as_long_or_short(lengths, odd):
    entries = [entry(k, n) for k, n in enumerate(lengths)]
    found = said(checks.lengths(entries))
    assert [episode for episode, *_ in found] == odd
    for episode, _, text in found:
        assert text.startswith(f"has {lengths[episode]} frames where 100 are usual")


def test_features_that_never_change_are_named_each_or_in_one_line():
    still = profile(low=[0, 1, 2], high=[1, 1, 2])
    (issue,) = checks.column_ranges([feature([still, still])])
    assert (issue.key, issue.message) == (STATE, "never changes: b, c")
    rest = profile(low=1, high=1)
    other = profile(low=1, high=[1, 1, 2])
    (issue,) = checks.column_ranges([feature([rest, rest])])
    assert issue.message == "never changes: all components"
    (issue,) = checks.column_ranges([feature([rest, other])])
    assert issue.message == "never changes: a, b"
    for count in (6, 7):
        many = [feature([rest, rest], key=f"k{i}") for i in range(count)]
        found = [*checks.column_ranges([*many, feature([other, other])])]
        if count == 6:
            assert [issue.key for issue in found] == [*(f"k{i}" for i in range(6)), STATE]
        else:
            assert [issue.key for issue in found] == [None, STATE]
            text = "7 features never change: k0, k1, k2, k3, k4, k5, ..."
            assert found[0].message == text


@pytest.mark.parametrize(
    ("low", "high", "told"),
    [
        (1, 25, None),
        (1, 26, "26 %"),
        (26, 1, "26 %"),
        (40, 30, "40 %"),
        (50, 49, "50 %"),
        (50, 50, None),  # a gripper, open or closed
        (60, 50, None),
    ],
)
def test_components_at_an_end_of_their_range(low, high, told):
    odd = profile(at_ends=[[low, 1, 1], [high, 1, 1]])
    found = said(checks.column_ranges([feature([odd, odd])]))
    expected = f"sits at an end of its range for up to {told} of the frames: a"
    assert [text for *_, text in found] == ([expected] if told else [])
    assert said(checks.column_ranges([feature([odd, odd], key="observation.force")])) == []
    for key in ("action.arm", "state", "observation.state.q"):
        assert len(said(checks.column_ranges([feature([odd, odd], key=key)]))) == bool(told)


def test_only_the_ends_over_all_episodes_count():
    inner = profile(at_ends=90, low=0.1, high=0.9)
    whole = profile()
    assert said(checks.column_ranges([feature([inner, whole])])) == []
    # Half of the frames of both episodes, of different lengths.
    odd = [profile(at_ends=[[100] * 3, [1] * 3]), profile()]
    for length, found in ((299, 1), (304, 0)):
        given = feature(odd, lengths=[100, length])
        assert len(said(checks.column_ranges([given]))) == found


@pytest.mark.parametrize(
    ("largest", "told"),
    [(999, False), (1000, False), (-1000, False), (1001, True), (-1001, True), (2e12, True)],
)
def test_sizes_that_no_robot_reports(largest, told):
    odd = profile(low=[0, min(largest, 0), 0], high=[1, max(largest, 1), 1])
    found = [*checks.sizes(feature(alike(odd)))]
    assert [(issue.episode, issue.components) for issue in found] == (
        [(4, ("b",))] if told else []
    )
    for issue in found:
        assert issue.message.startswith(f"b reaches {abs(largest):.3g}, usually 1: ")
        assert issue.level == "error"
        assert issue.severity == pytest.approx(np.log(abs(largest)))


@pytest.mark.parametrize("name", ["time", "Time_s", "stamp"])
def test_clocks_are_large_by_nature(name):
    odd = profile(high=[1, 5e12, 1])
    assert said(checks.sizes(feature(alike(odd), names=("a", name, "c")))) == []
    assert said(checks.sizes(feature(alike(odd), key=f"observation.{name}"))) == []


def test_components_that_hardly_move_have_a_least_size():
    """A thousand times a thousandth; a gripper has no such bound but flipped bits."""
    small = {"levels": np.tile(RAMP, (3, 1)).T * 1e-6}
    for high, told in ((0.9, 0), (1.1, 1)):
        given = alike(profile(high=[1e-6, high, 1e-6], **small), high=1e-6, **small)
        assert len(said(checks.sizes(feature(given)))) == told
    for high, told in ((1e11, 0), (1e12, 0), (2e12, 1)):
        given = alike(profile(high=[1, high, 1]))
        assert len(said(checks.sizes(feature(given, smooth=False)))) == told


@pytest.mark.parametrize(
    ("held", "usual", "length", "fps", "told"),
    [
        (16, 1, 100, 50, True),
        (15, 1, 100, 50, False),  # 0.3 s
        (11, 1, 100, 20, True),
        (10, 1, 100, 20, False),  # ten frames
        (20, 1, 200, 50, False),  # a tenth
        (21, 1, 200, 50, True),
        (42, 8, 100, 50, False),  # five usual ones and 2 %
        (43, 8, 100, 50, True),
    ],
)
def test_holds_of_an_encoder(held, usual, length, fps, told):
    given = alike(profile(held=[1, held, 1]), held=[1, usual, 1])
    found = said(checks.holds(feature(given, lengths=[100] * 4 + [length], fps=fps)))
    assert [(episode, names) for episode, names, _ in found] == ([(4, ("b",))] if told else [])
    for *_, text in found:
        begin = f"b stays the same for {held} of {length} frames, usually for {usual} %"
        assert text.startswith(begin)
    assert said(checks.holds(feature(given, smooth=False, fps=fps))) == []
    still = {"levels": 1.0}
    rest = alike(profile(held=90, **still), **still)
    assert said(checks.holds(feature(rest))) == []


@pytest.mark.parametrize(
    ("noise", "usual", "told"),
    [
        (0.0101, 1e-3, True),
        (0.01, 1e-3, False),
        (0.0051, 1e-5, True),
        (0.005, 1e-5, False),
    ],
)
def test_noise_of_ten_times_the_usual_and_half_a_percent(noise, usual, told):
    given = alike(profile(noise=[noise, noise, usual]), noise=usual)
    found = said(checks.noise(feature(given)))
    text = "is far noisier than in the other episodes: a, b"
    assert found == ([(4, ("a", "b"), text)] if told else [])
    assert [issue.severity for issue in checks.noise(feature(given))] == [2.0] * told
    assert said(checks.noise(feature(given, smooth=False))) == []


@pytest.mark.parametrize(
    ("distinct", "held", "usual", "told"),
    [
        (19, 9, 100, True),
        (20, 9, 100, False),
        (19, 10, 100, False),
        (9, 9, 50, True),
        (11, 9, 50, False),
    ],
)
def test_levels_of_less_than_a_fifth_of_the_usual(distinct, held, usual, told):
    odd = profile(distinct=[usual, distinct, usual], held=[1, held, 1])
    found = said(checks.noise(feature(alike(odd, distinct=usual))))
    text = "has far fewer levels than in the other episodes: b"
    assert found == ([(4, ("b",), text)] if told else [])


def gripper(start, goal, span=1.0):
    low = min(start, goal)
    levels = np.tile(RAMP, (3, 1)).T * span + low
    return profile(start=[0, start, 0], goal=[0, goal, 0], levels=levels)


@pytest.mark.parametrize(
    ("start", "goal", "span", "text"),
    [
        (0, 0, 0, "b does not switch, unlike in the other episodes"),
        (1, 0, 1, "b switches the other way than in the other episodes"),
        (0.91, 0.09, 1, "b switches the other way than in the other episodes"),
        (0.89, 0.0, 1, None),
        (1.0, 0.11, 1, None),
        (0.0, 1.0, 1, None),
        (0.09, 0.91, 1, None),
        (0.5, 0.5, 0.5, None),
        (0.0, 0.0, 1e-3, None),
    ],
)
def test_grippers_that_stay_or_switch_the_other_way(start, goal, span, text):
    given = [*(gripper(0, 1) for _ in range(4)), gripper(start, goal, span)]
    expected = [(4, ("b",), text)] if text else []
    assert said(checks.switches(feature(given, smooth=False))) == expected
    assert said(checks.switches(feature(given, smooth=True))) == []


def test_a_gripper_is_compared_where_all_others_switch():
    stays = gripper(0, 0, 0)
    three = feature([*(gripper(0, 1) for _ in range(3)), stays], smooth=False)
    assert len(said(checks.switches(three))) == 1
    two = feature([gripper(0, 1), gripper(0, 1), stays], smooth=False)
    assert said(checks.switches(two)) == []
    more = feature([*(gripper(0, 1) for _ in range(4)), stays, stays], smooth=False)
    assert said(checks.switches(more)) == []
    # Half of the range from start to goal is no switch.
    for goal, told in ((0.5, 0), (0.52, 1)):
        half = [*(gripper(0, goal) for _ in range(4)), stays]
        assert len(said(checks.switches(feature(half, smooth=False)))) == told


@pytest.mark.parametrize(("start", "goal", "told"), [(1, 9, False), (9, 1, True)])
def test_ends_at_a_tenth_of_the_range_count_as_the_same_level(start, goal, told):
    given = [*(gripper(0, 10, 10) for _ in range(4)), gripper(start, goal, 10)]
    assert bool(said(checks.switches(feature(given, smooth=False)))) == told


def figures(*columns, span=1.0):
    """A profile with quantiles 5, 50 and 95 %, start and goal of each component."""
    low, middle, high, start, goal = np.array(columns, float).T
    outer = middle - span / 2, middle + span / 2
    levels = np.stack([outer[0], low, middle, high, outer[1]])
    return profile(levels=levels, start=start, goal=goal)


RISING, FALLING, ARCH = (
    (0.05, 0.5, 0.95, 0, 1),
    (2.05, 2.5, 2.95, 3, 2),
    (5.0, 5.4, 5.9, 5, 5),
)


def compared(odd, usual=(RISING, FALLING, ARCH), **options):
    given = [*(figures(*usual) for _ in range(4)), figures(*odd)]
    return said(checks.exchanged_columns(feature(given, **options)))


def moved(column, shift):
    return tuple(np.add(column, shift))


def test_nothing_is_found_among_equal_episodes():
    assert compared((RISING, FALLING, ARCH)) == []
    # Spread of the episodes is 5 % of the range at least: three of them are 0.15.
    assert compared((moved(RISING, 0.149), FALLING, ARCH)) == []


@pytest.mark.parametrize("key", ["observation.q", "state", "action", "action.arm"])
def test_exchanged_columns_are_named_in_both_directions(key):
    text = "columns look exchanged, in this episode alone: a like b, b like a"
    assert compared((FALLING, RISING, ARCH), key=key) == [(4, ("a", "b"), text)]
    assert compared((FALLING, RISING, ARCH), key="next.reward") == []
    assert compared((FALLING, RISING, ARCH), smooth=False) == []
    cycle = compared((ARCH, RISING, FALLING))
    text = "columns look exchanged, in this episode alone: a like c, b like a, c like b"
    assert cycle == [(4, ("a", "b", "c"), text)]


@pytest.mark.parametrize(("shift", "exchanged"), [(0.095, True), (0.105, False)])
def test_exchanged_columns_look_usual_in_their_new_places(shift, exchanged):
    """Two spreads are a tenth of the range of 1."""
    found = compared((moved(FALLING, shift), RISING, ARCH))
    assert [text.startswith("columns look exchanged") for *_, text in found] == [exchanged]


def test_columns_that_are_near_each_other_are_not_exchanged():
    """Each is four spreads from the other, and looks half usual in its place."""
    near = (0.05, 0.5, 0.95, 0.1, 1.2)
    assert compared((moved(RISING, 0.05), RISING, ARCH), (RISING, near, ARCH)) == []


NEGATED = tuple(-np.array([0.95, 0.5, 0.05, 0, 1]))


def test_the_other_sign_is_found_by_the_negated_figures():
    text = "has the opposite sign of the other episodes: a"
    assert compared((NEGATED, FALLING, ARCH)) == [(4, ("a",), text)]
    for shift, told in ((0.07, True), (-0.07, True), (0.08, False)):
        found = compared((moved(NEGATED, shift), FALLING, ARCH))
        assert [t.startswith("has the opposite sign") for *_, t in found] == [told]


def turned(column):
    low, middle, high, start, goal = column
    return low, middle, high, goal, start


def test_an_episode_that_runs_the_other_way():
    usual = (RISING, FALLING, (5.0, 5.4, 5.9, 5.0, 5.9))
    text = "runs in the reverse direction of the other episodes"
    ((episode, _, found),) = compared([turned(column) for column in usual], usual)
    assert (episode, found) == (4, text)
    one = [turned(RISING), FALLING, usual[2]]
    # Two of three would be far off the other way.
    assert compared(one, usual) == []
    # Backwards it must be 0.4 times as far off as forwards: (1.16 + 1.8 d) / 3 against d.
    for shift, told in ((0.19, True), (0.22, False)):
        odd = [moved(turned(column), shift) for column in usual]
        assert [t == text for *_, t in compared(odd, usual)] == [told]


def test_a_moved_zero_shifts_all_figures_alike():
    """Nine spreads of 0.05 are 0.45."""
    ((_, names, text),) = compared((moved(RISING, -0.5), FALLING, ARCH))
    assert names == ("a",)
    assert text.startswith("is offset from the other episodes all along: a by -0.5: ")
    assert compared((moved(RISING, -0.44), FALLING, ARCH)) == []
    for extra, offset in ((0.09, True), (0.13, False)):
        odd = np.add(RISING, [0.5, 0.5, 0.5, 0.5, 0.5 + extra])
        ((_, _, text),) = compared((odd, FALLING, ARCH))
        assert text.startswith("is offset" if offset else "is far from the other")
    assert text == "is far from the other episodes: a"


def test_the_spread_of_the_episodes_is_the_measure_of_distance():
    """Episodes that are 0.1 from their median on both sides spread by 0.15."""
    usual = [figures(moved(RISING, s), FALLING, ARCH) for s in (-0.1, -0.1, 0, 0.1, 0.1)]
    for shift, told in ((1.3, False), (1.4, True)):
        odd = figures(moved(RISING, shift), FALLING, ARCH)
        found = said(checks.exchanged_columns(feature([*usual, odd])))
        assert len(found) == told
    levels = [issue.level for issue in checks.exchanged_columns(feature([*usual, odd]))]
    assert levels == ["warning"]


@pytest.mark.parametrize(
    ("names", "length", "told"),
    [
        (("quat_x", "quat_y", "quat_z"), 0.0, False),
        (("rotvec_x", "rotvec_y", "rotvec_z"), 3.0, False),
        (("rotvec_x", "rotvec_y", "rotvec_z"), 2.7, True),
        (("x", "y", "z"), 3.0, True),
    ],
)
def test_orientations_whose_sign_means_nothing_are_passed_over(names, length, told):
    """A rotation vector of 0.9 half turns, 2.83 rad, may be one the other way round."""
    column = tuple(np.add(RISING, length / np.sqrt(3) - 0.5))
    usual = (column, column, column)
    negated = tuple(-np.array(column)[[2, 1, 0, 3, 4]])
    found = compared((negated, negated, negated), usual, names=names)
    assert bool(found) == told


def tracking(delay=2, slope=1.0, fit=0.95, offset=np.nan, residual=None):
    own = np.full(201, 0.5, np.float32)
    own[100 + delay] = 0.02
    return Tracking(
        delay=delay,
        residual=own if residual is None else np.asarray(residual, np.float32),
        slope=np.broadcast_to(slope, 3).astype(float),
        fit=np.broadcast_to(fit, 3).astype(float),
        offset=np.broadcast_to(offset, 3).astype(float),
    )


def columns(role, key):
    return ColumnSelection(role=role, columns=tuple((key, i) for i in range(3)), labels=NAMES)


COMMAND = columns("command_position", "action")
JOINTS = columns("joint_position", STATE)


def tracked(*odd, usual=None, count=4, role="command_position"):
    given = [*(usual or tracking() for _ in range(count)), *odd]
    profiles = [
        EpisodeProfile(entry=entry(k), columns={}, tracking={role: own})
        for k, own in enumerate(given)
    ]
    return [
        (issue.episode, issue.level, issue.message)
        for issue in checks.command_tracking(COMMAND, profiles)
    ]


@pytest.mark.parametrize(
    ("usual", "delay", "told"),
    [(2, 5, False), (2, 6, True), (2, -2, True), (2, -1, False), (0, 3, False), (0, -4, True)],
)
def test_delays_differ_by_more_than_three_frames(usual, delay, told):
    found = tracked(tracking(delay), usual=tracking(usual))
    text = (
        f"the state comes {delay} frames after its command, in the other episodes {usual}: "
        f"actions were shifted against states"
    )
    assert found == ([(4, "error", text)] if told else [])


def test_findings_on_commands_of_several_features_are_kept_with_the_first():
    mixed = replace(
        COMMAND, columns=(("action.left", 0), ("action.left", 1), ("action.right", 0))
    )
    given = [*(tracking() for _ in range(4)), tracking(9)]
    profiles = [
        EpisodeProfile(entry=entry(k), columns={}, tracking={"command_position": own})
        for k, own in enumerate(given)
    ]
    (issue,) = checks.command_tracking(mixed, profiles)
    assert (issue.episode, issue.key) == (4, "action.left")


def test_long_delays_scatter_by_a_tenth():
    assert tracked(tracking(44), usual=tracking(40)) == []
    assert len(tracked(tracking(45), usual=tracking(40))) == 1


@pytest.mark.parametrize(("other", "told"), [(0.11, True), (0.09, False)])
def test_the_own_delay_explains_far_more_of_the_motion(other, told):
    """A gain of 0.8 over the usual delay, from residuals of 0.02."""
    residual = np.full(41, 0.5)
    residual[30], residual[22] = 0.02, other
    assert bool(tracked(tracking(10, residual=residual))) == told


def test_delays_that_scatter_tell_nothing():
    odd = [tracking(d) for d in (9, -9, 15)]
    assert [episode for episode, *_ in tracked(*odd)] == [4, 5, 6]
    assert [episode for episode, *_ in tracked(*odd, tracking(18), count=3)] == []
    half = [tracking(d) for d in (-9, 2, 2, 20)]
    assert tracked(*half, count=0) == []
    # Two frames from the usual delay are agreement.
    near = [tracking(4), tracking(4), tracking(2), tracking(2), tracking(2), tracking(14)]
    assert [episode for episode, *_ in tracked(*near, count=0)] == [5]


@pytest.mark.parametrize(("delay", "told"), [(-1, False), (-2, True)])
def test_states_that_move_before_their_commands(delay, told):
    found = tracked(usual=tracking(delay))
    text = f"the state moves {-delay} frames before its command in most episodes: "
    assert len(found) == told
    assert all(message.startswith(text) for *_, message in found)
    assert all(level == "warning" for _, level, _ in found)


OPPOSITE = "the state goes the other way than its command, in this episode alone: "
LOST = "the state does not follow its command, as it does in the other episodes: "


@pytest.mark.parametrize(
    ("slope", "fit", "found"),
    [
        (1.0, 0.95, []),
        ([1, -1, 1], 0.95, [(OPPOSITE + "b", "error")]),
        ([1, -0.51, 1], 0.95, [(OPPOSITE + "b", "error"), ("goes -0.51 times", "warning")]),
        ([1, -1.49, 1], 0.95, [(OPPOSITE + "b", "error")]),
        ([1, -0.5, 1], 0.95, [("goes -0.5 times", "warning")]),
        ([1, -1.5, 1], 0.95, []),
        ([1, -1, 1], [0.95, 0.8, 0.95], []),
        (1.0, [0.95, 0.4, 0.95], [(LOST + "b", "warning")]),
        ([1, -1, 1], [0.95, 0.79, 0.95], []),
        (1.0, [0.95, 0.39, 0.95], [(LOST + "b", "warning")]),
        (1.0, [0.95, 0.41, 0.95], []),
        (1.0, [0.95, np.nan, 0.95], []),
        (1.0, [0.3, 0.39, 0.95], [(LOST + "a, b", "warning")]),
        ([1, 1.66, 1], 0.95, [("goes 1.7 times as far as its", "warning")]),
        ([1, 1.64, 1], 0.95, []),
        ([1, 0.60, 1], 0.95, [("goes 0.6 times as far as its", "warning")]),
        ([1, 0.62, 1], 0.95, []),
        ([1, 1.66, 1], [0.95, 0.79, 0.95], []),
    ],
)  # fmt: skip
def test_components_follow_their_command_in_the_other_episodes_only(slope, fit, found):
    told = tracked(tracking(slope=slope, fit=fit))
    assert [(episode, level) for episode, level, _ in told] == [
        (4, level) for _, level in found
    ]
    for (*_, text), (begin, _) in zip(told, found, strict=True):
        assert begin in text


def test_gain_is_named_with_the_usual_one():
    (found,) = tracked(tracking(slope=[1, 1, 4]), usual=tracking(slope=[1, 1, 2]))
    text = "the state goes 4 times as far as its command, in the other episodes 2: c"
    assert found == (4, "warning", text)


def test_two_episodes_are_too_few_to_compare_and_rest_follows_nothing():
    assert tracked(tracking(slope=3), count=1) == []
    assert len(tracked(tracking(slope=3), count=2)) == 1
    assert tracked(tracking(slope=3), usual=tracking(fit=0.79)) == []
    assert tracked(tracking(slope=3), usual=tracking(fit=0.8)) == []
    assert tracked(tracking(slope=3), usual=tracking(fit=np.nan)) == []


def offsets(*rows, span=1.0, names=NAMES, unit="%"):
    profiles = [
        EpisodeProfile(
            entry=entry(k), columns={}, tracking={"command_position": tracking(offset=own)}
        )
        for k, own in enumerate(rows)
    ]
    levels = np.tile(RAMP, (3, 1)).T * span
    known = [feature([profile(levels=levels)] * len(rows))]
    command = ColumnSelection(role="command_position", columns=COMMAND.columns, labels=names)
    states = UnitDecision(role="joint_position", unit=unit)
    found = checks.command_offsets(command, JOINTS, profiles, known, states)
    return [(issue.episode, issue.message) for issue in found]


NONE = (np.nan,) * 3


@pytest.mark.parametrize(("offset", "told"), [(0.101, True), (-0.101, True), (0.1, False)])
def test_a_distance_of_a_tenth_of_the_range_at_rest(offset, told):
    rows = [(0, offset, np.nan)] * 3 + [NONE]
    found = offsets(*rows)
    text = f"b rests {offset:.4g} from its command (action minus state) in 3 episodes: "
    assert len(found) == told
    assert all(episode is None and message.startswith(text) for episode, message in found)
    assert offsets(*rows, span=0.0) == []
    assert offsets(*rows, names=("a", "gripper", "c")) == []
    # In different units, as a hundredth of the range.
    assert offsets(*rows, span=1.02) == []
    assert len(offsets(*rows, span=0.5)) == 1


@pytest.mark.parametrize(("own", "odd"), [(0.299, False), (0.301, True), (0.099, True)])
def test_an_offset_that_changed_in_one_episode(own, odd):
    rows = [(0.2, 0, 0)] * 3 + [(own, 0, 0)]
    found = [(e, t) for e, t in offsets(*rows) if e is not None]
    assert [episode for episode, _ in found] == ([3] if odd else [])
    text = f"a rests {own:.4g} from its command, in the other episodes 0.2: "
    assert all(message.startswith(text) for _, message in found)


@pytest.mark.parametrize(("unit", "angle"), [("rad", -11.5), ("deg", -0.2), ("rev", -72.0)])
def test_offsets_of_a_leader_are_told_in_degrees(unit, angle):
    (found,) = offsets(*[(-0.2, 0, 0)] * 3, unit=unit)
    assert found[1].endswith(f"calibrated differently, by {angle} deg?")
    (plain,) = offsets(*[(-0.2, 0, 0)] * 3)
    assert plain[1].endswith("calibrated differently?")


def test_offsets_that_scatter_have_no_common_cause():
    assert len(offsets((0.2, 0, 0), (0.249, 0, 0), (0.151, 0, 0))) == 1
    scattered = offsets((0.2, 0, 0), (0.252, 0, 0), (0.148, 0, 0))
    assert scattered == []
    # A tenth of 1.25 is exact, and so is half of it.
    exact = [(0.5, 0, 0), (0.5625, 0, 0), (0.4375, 0, 0)]
    assert offsets(*exact, span=1.25) == []
    same = [(0.5, 0, 0)] * 3
    assert [e for e, _ in offsets(*same, (0.625, 0, 0), span=1.25)] == [None]
    assert [e for e, _ in offsets(*same, (0.626, 0, 0), span=1.25)] == [None, 3]
    # Two episodes do not tell which of them is odd.
    assert [e for e, _ in offsets((0.0, 0, 0), (0.9, 0, 0), NONE)] == []
    assert [e for e, _ in offsets((0.0, 0, 0), (0.0, 0, 0), (0.9, 0, 0))] == [2]


def rates_of_commands(rates, positions, fps=50):
    return commanded_rates([{"rates": rates, "command_position": positions}], fps)


@pytest.mark.parametrize(
    ("rates", "positions", "told"),
    [
        ({}, {"fit": 0.39}, True),
        ({}, {"fit": 0.4}, False),
        ({"fit": 0.8}, {"fit": 0.1}, False),
        ({"slope": 0.0}, {"fit": 0.1}, False),
        ({"slope": 0.01}, {"fit": 0.1}, True),
        ({"slope": -0.01}, {"fit": 0.1}, False),
        # Joints that merely move together have factors of their own.
        ({"slope": [1.0, 1.29, 1.31]}, {"fit": 0.1}, True),
        ({"slope": [1.0, 2.0, 3.0]}, {"fit": 0.1}, False),
        ({"slope": [7.0, 10.0, 13.0]}, {"fit": 0.1}, False),
        ({"slope": [7.1, 10.0, 13.0]}, {"fit": 0.1}, True),
        # Both fit; the velocity comes at once, the position with a delay of more than 0.2 s.
        ({"delay": 10}, {"delay": 11, "fit": 0.9}, True),
        ({"delay": 10}, {"delay": -11, "fit": 0.9}, True),
        ({"delay": 10}, {"delay": 10, "fit": 0.9}, False),
        ({"delay": 11}, {"delay": 12, "fit": 0.9}, False),
        ({"delay": 10}, {"delay": 11, "fit": 0.95}, False),
        # More than half of the joints.
        ({"fit": [0.9, 0.9, 0.1]}, {"fit": 0.1}, True),
        ({"fit": [0.9, 0.1, 0.1]}, {"fit": 0.1}, False),
    ],
)
def test_commands_that_are_rates(rates, positions, told):
    found = rates_of_commands(tracking(**{"delay": 0, **rates}), tracking(**positions))
    assert (found is not None) == told
    if found is not None:
        slope, fit = found
        given = np.broadcast_to(rates.get("slope", 1.0), 3)
        followed = np.isfinite(slope)
        assert followed.sum() >= 2
        np.testing.assert_array_equal(slope[followed], given[followed])
        assert 0.8 < fit <= 1


@pytest.mark.parametrize(
    ("given", "fps", "positions"),
    [
        ({}, 50, True),
        ({"slope": 1.99}, 50, True),
        ({"slope": 2.0}, 50, False),
        ({"slope": 0.51}, 50, True),
        ({"slope": 0.5}, 50, False),
        ({"slope": -1.0}, 50, False),
        ({"fit": 0.41}, 50, True),
        ({"fit": 0.4}, 50, False),
        # A lead of 0.2 s and a delay of 0.75 s.
        ({"delay": -10}, 50, True),
        ({"delay": -11}, 50, False),
        ({"delay": 30}, 40, True),
        ({"delay": 31}, 40, False),
        # Half of the joints that move.
        ({"slope": [1.0, 3.0, 1.0], "fit": [0.9, 0.9, np.nan]}, 50, True),
        ({"slope": [1.0, 3.0, 3.0]}, 50, False),
    ],
)
def test_joints_that_follow_positions_in_their_unit(given, fps, positions):
    one = {"command_position": tracking(**given)}
    assert are_positions([one], fps) == positions
    # Half of the episodes; those where nothing moves do not count.
    sound = {"command_position": tracking()}
    assert are_positions([one, sound, {}], fps)
    assert are_positions([one, one, sound], fps) == positions


def test_joints_that_never_move_follow_any_command():
    assert are_positions([], 50)
    assert are_positions([{}, {}], 50)


def test_half_of_the_episodes_tell_of_rates():
    rates = {"rates": tracking(0), "command_position": tracking(fit=0.1)}
    other = {"command_position": tracking(fit=0.1)}
    assert commanded_rates([rates, other], 50) is not None
    assert commanded_rates([rates, other, other], 50) is None


def test_positions_that_follow_at_once_are_not_examined():
    assert commanded_rates([{"command_position": tracking()}], 50) is None


@pytest.mark.parametrize("scale", [0.02, 30.0])
def test_other_units_make_no_other_findings(scale):
    """Values of all episodes in another unit: nothing changes but the figures that are said."""
    values = ("levels", "start", "goal", "step", "noise", "low", "high")

    def scaled(one):
        return replace(one, **{name: getattr(one, name) * scale for name in values})

    def found(check, *given, **options):
        own = feature([*given], **options)
        other = feature([scaled(one) for one in given], **options)
        once, twice = ([(i.episode, i.components) for i in check(f)] for f in (own, other))
        assert once == twice
        return bool(once)

    usual = (RISING, FALLING, ARCH)
    odd = {
        True: (profile(noise=0.0101), profile(distinct=19), profile(held=16)),
        False: (profile(noise=0.0099), profile(distinct=20), profile(held=15)),
    }
    for told, (noisy, coarse, held) in odd.items():
        assert found(checks.noise, *alike(noisy)) == told
        assert found(checks.noise, *alike(coarse)) == told
        assert found(checks.holds, *alike(held)) == told
    switched = [gripper(0, 1)] * 4
    for start, goal, told in ((0.91, 0.09, True), (0.89, 0, False), (1, 0.11, False)):
        given = (*switched, gripper(start, goal))
        assert found(checks.switches, *given, smooth=False) == told
    same = [figures(*usual)] * 4
    for column, told in ((moved(RISING, 0.46), True), (moved(RISING, 0.44), False)):
        odd_one = figures(column, FALLING, ARCH)
        assert found(checks.exchanged_columns, *same, odd_one) == told


@pytest.mark.parametrize(
    ("statistics", "length", "discrete"),
    [
        ({"distinct": 4}, 20, True),
        ({"distinct": 5}, 20, False),
        ({"distinct": 5}, 100, True),
        ({"distinct": 12}, 240, True),
        ({"distinct": 13}, 260, False),
        ({"distinct": 49, "flat": 0.91, "step": 0.21}, 100, True),
        ({"distinct": 50, "flat": 0.91, "step": 0.21}, 100, False),
        ({"distinct": 49, "flat": 0.9, "step": 0.21}, 100, False),
        ({"distinct": 49, "flat": 0.91, "step": 0.2}, 100, False),
    ],
)
def test_switches_have_few_levels_or_rest_and_jump(statistics, length, discrete):
    assert is_discrete(profile(**statistics), length).tolist() == [discrete] * 3


@pytest.mark.parametrize(("count", "named"), [(2, 2), (4, 4), (6, 4)])
def test_of_many_exchanged_columns_four_are_named(count, named):
    usual = np.tile(RISING, (count, 1)).T + 3.0 * np.arange(count)
    own, scale = np.roll(usual, -1, axis=1), np.full(count, 0.05)
    off = np.abs(own - usual).mean(0) / scale
    names = [f"c{k}" for k in range(count)]
    level, text = checks._permuted(own, usual, scale, off, names)
    assert level == "error"
    pairs = [f"c{k} like c{(k + 1) % count}" for k in range(named)]
    assert text.endswith(f"in this episode alone: {', '.join(pairs)}")
