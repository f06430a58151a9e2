"""Edits that repair one episode, at both sides of every limit."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from hrc_learn.demos import DatasetError
from hrc_learn.demos.quality import episode_edits as edits
from hrc_learn.demos.quality.ranking import Decision
from hrc_learn.demos.read.columns import ColumnMapping, ColumnSelection
from hrc_learn.demos.read.dataset_folder import EpisodeEntry
from hrc_learn.demos.read.units import UnitDecision

pytestmark = pytest.mark.simulation


STATE = "observation.state"


def entry(index=0, length=100, start=0, file="data/a.parquet", tasks=()):
    return EpisodeEntry(index=index, length=length, tasks=tasks, file=file, start=start)


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
        with pytest.raises(ValueError, match="must keep two frames or more of the"):
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
    with pytest.raises(DatasetError, match="one: fewer than two frames are left"):
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


def test_a_feature_that_was_not_visible_need_not_be_finite():
    """Frames 3 and 4 show no marker; frame 9 shows one at no place."""
    pixels = np.stack([SLOW, SLOW], axis=1)
    pixels[[3, 4, 9], [0, 1, 1]] = np.nan
    visible = np.ones(60)
    visible[3], visible[4] = 0.0, -1.0
    given = edit(pixels, role="feature", unit="px", seen=visible)
    seen = ColumnSelection(role="feature_visible", columns=(("seen", 0),), labels=("seen",))
    columns = replace(given.columns, selections=given.selections | {"feature_visible": seen})
    given = replace(given, columns=columns)
    left = edits.drop_bad_frames(given, True)
    assert [k for k in range(60) if k not in left.kept] == [9]
    # Without a column that says whether it was visible, each value counts.
    unsaid = edits.drop_bad_frames(edit(pixels, role="feature", unit="px"), True)
    assert [k for k in range(60) if k not in unsaid.kept] == [3, 4, 9]


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


def test_a_feature_is_resampled_where_both_neighbours_show_it():
    frame = np.arange(60)
    seen = (frame < 20) | (frame >= 30)
    pixels = np.stack([100.3 + 3 * frame, 200 - 2.1 * frame], axis=1)
    given = edit(np.where(seen[:, None], pixels, np.nan), role="feature", unit="px", seen=seen)
    selection = ColumnSelection(
        role="feature_visible", columns=(("seen", 0),), labels=("visible",)
    )
    selections = {**given.selections, "feature_visible": selection}
    given = replace(given, columns=replace(given.columns, selections=selections))
    moved = edits.resample_to_grid(given, 75)
    at = (moved.time - given.time[0]) * 50
    visible = moved.frames["seen"][:, 0] > 0
    both = seen[np.floor(at + 1e-6).astype(int)] & seen[np.ceil(at - 1e-6).astype(int)]
    np.testing.assert_array_equal(visible, both)
    expected = np.stack([100.3 + 3 * at, 200 - 2.1 * at], axis=1)
    np.testing.assert_allclose(moved.frames[STATE][visible], expected[visible])


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


STUCK = np.where((np.arange(160) > 70) & (np.arange(160) < 74), 70, np.arange(160))


@pytest.mark.parametrize(
    "repair",
    [
        edits.trim,
        edits.drop_repeats,
        edits.drop_late,
        edits.unwrap,
        lambda given: edits.drop_bad_frames(given, True),
        lambda given: edits.resample_to_grid(given, 48),
    ],
)
def test_a_repair_does_not_depend_on_the_clock_of_the_recorder(repair):
    """By stamps in 64ths of a second, which are exact."""
    values, time = rest_and_motion(50, 50)[STUCK], np.arange(160) / 64
    values[100:] += 2 * np.pi
    early, late = (repair(edit(values, time=time + begun)) for begun in (0.0, 4096.0))
    np.testing.assert_allclose(late.time - 4096, early.time, atol=1e-9)
    np.testing.assert_array_equal(late.kept, early.kept)
    np.testing.assert_array_equal(late.frames[STATE], early.frames[STATE])
    assert late.changes == early.changes
