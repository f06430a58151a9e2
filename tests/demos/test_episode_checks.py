"""Checks of single episodes on arrays, with cases at both sides of each limit."""

from dataclasses import replace

import numpy as np
import pytest
from lerobot_folders import write_folder

from hrc_learn.demos import Demonstration
from hrc_learn.demos.quality import episode_checks as checks
from hrc_learn.demos.read.dataset_folder import EpisodeEntry, open_folder

pytestmark = pytest.mark.simulation

FPS = 50
ENTRY = EpisodeEntry(index=7, length=100, tasks=(), file="data/a.parquet", start=0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A dataset of one episode at 50 Hz."""
    root = tmp_path_factory.mktemp("checks") / "set"
    episodes = [{"observation.state": np.zeros((20, 3))}]
    return open_folder(write_folder(root, episodes, {"observation.state": ["a", "b", "c"]}))


def places(issues):
    return [(issue.frame, issue.key, issue.message) for issue in issues]


def demo(q=None, **fields):
    """Joints on a clock of 50 Hz."""
    frames = len(q if q is not None else fields["position"])
    names = () if q is None else tuple(f"j{i}" for i in range(np.shape(q)[1]))
    parts = {"time": np.arange(frames) / FPS, "fps": FPS, "joint_names": names}
    return Demonstration(**{**parts, "joint_position": q, **fields})


def test_values_that_are_not_finite_are_counted_and_the_first_is_named(folder):
    values = np.ones((20, 3))
    values[4, 2], values[9, 0] = np.nan, -np.inf
    ((frame, key, text),) = places(
        checks.finite_values(folder, ENTRY, {"observation.state": values})
    )
    assert (frame, key) == (4, "observation.state")
    assert text.startswith("c is nan (2 values are not finite)")
    # Finite values whose sum is not.
    huge = {"observation.state": np.full((20, 3), 1e308)}
    with np.errstate(over="ignore"):
        assert places(checks.finite_values(folder, ENTRY, huge)) == []


@pytest.mark.parametrize(
    ("repeats", "told"), [(5, None), (6, "6 % of"), (99, "the state never changes")]
)
def test_repeated_frames_are_told_above_five_per_cent(folder, repeats, told):
    """Of 101 frames 100 have one before."""
    steps = np.concatenate([[0], np.ones(100)])
    first = 31 if repeats < 50 else 1
    steps[first : first + repeats + (repeats == 99)] = 0
    state = np.cumsum(steps)[:, None] * [1.0, 2.0] + [0, 1]
    state[-1] = state[-2] if repeats == 99 else state[-1]
    frames = {"observation.state": state, "observation.clock": np.arange(101.0)[:, None]}
    frames["action"] = np.random.default_rng(0).normal(size=(101, 2))
    found = places(checks.repetitions(folder, replace(ENTRY, length=101), frames))
    assert bool(found) == (told is not None)
    for frame, _, text in found:
        assert text.startswith(told)
        assert frame == (31 if repeats == 6 else 0)
    masks = checks.repeated_frames(frames)
    np.testing.assert_array_equal(masks, np.r_[False, np.diff(state[:, 0]) == 0])


def test_no_frame_is_repeated_without_observations_or_before_the_second():
    assert not checks.repeated_frames({"action": np.zeros((4, 1))}).any()
    assert checks.repeated_frames({"observation.state": np.zeros((1, 2))}).tolist() == [False]
    two = {"observation.state": np.zeros((2, 2))}
    assert checks.repeated_frames(two).tolist() == [False, True]


def test_two_frames_are_too_few_to_speak_of_repetition(folder):
    frames = {"observation.state": np.zeros((2, 2))}
    assert not [*checks.repetitions(folder, replace(ENTRY, length=2), frames)]
    frames = {"observation.state": np.zeros((3, 2))}
    assert [*checks.repetitions(folder, replace(ENTRY, length=3), frames)]


def test_a_clock_is_one_component_that_always_increases():
    assert checks.is_clock(np.arange(5.0)[:, None])
    assert not checks.is_clock(np.array([[0.0], [1], [1], [2]]))
    assert not checks.is_clock(np.arange(10.0).reshape(5, 2))


@pytest.mark.parametrize(
    ("fps", "frames", "told"),
    [(50, 24, "0.48 s"), (50, 25, ""), (10, 9, "0.9 s"), (10, 10, "")],
)
def test_a_false_start_has_less_than_half_a_second_or_ten_frames(folder, fps, frames, told):
    at = replace(folder, info={**folder.info, "fps": fps})
    found = places(checks.episode_length(at, replace(ENTRY, length=frames), {}))
    assert [text for *_, text in found] == (
        [f"only {frames} frames ({told}): a false start?"] if told else []
    )


def stamped(steps, start=0.0, key="time", fps=FPS):
    time = start + np.concatenate([[0.0], np.cumsum(steps)])
    return places(checks.stamps(ENTRY, key, time, fps))


EVEN = np.full(99, 1 / FPS)


def changed(**steps):
    """Even steps but for some, in periods."""
    made = EVEN.copy()
    for place, periods in steps.items():
        made[int(place[1:])] = periods / FPS
    return made


@pytest.mark.parametrize(
    ("steps", "found"),
    [
        (EVEN, []),
        (EVEN * 1.049, []),
        (EVEN * 0.955, []),
        (EVEN * 1.06, [(None, "frames are 21.2 ms apart (47.17 Hz), but fps says 50; ")]),
        (EVEN * 0.94, [(None, "frames are 18.8 ms apart (53.19 Hz), but fps says 50; ")]),
        (changed(_30=0), [(31, "stamps must increase, but go from 0.600000 s to 0.6")]),
        (changed(_30=-1, _40=0), [(31, "stamps must increase, but go from 0.600000 s to 0.5")]),
        (changed(_10=1.59), []),
        (changed(_10=1.61), [(11, "1 gaps, about 1 frames lost; the first is 32.2 ms long")]),
        (
            changed(_10=3, _20=6),
            [(11, "2 gaps, about 7 frames lost; the first is 60 ms long; hrc repair --fps 50")],
        ),
        # Every tenth step is late: 5 % of them by more than a tenth.
        (np.tile([*9 * [1.0], 1.2], 10) / FPS, [(None, "steps vary by 20 % (95th")]),
        (np.tile([*9 * [1.0], 1.09], 10) / FPS, []),
        # One of three steps is half a period late: the usual step is right, the rate is not.
        (
            np.tile([1.0, 1.0, 1.5], 33) / FPS,
            [(None, "100 frames in 2.31 s are 42.86 Hz, but fps says 50: the loop was late"),
             (None, "steps vary by 50 % (95th percentile); hrc repair --fps 50 resamples")],
        ),
    ],
)  # fmt: skip
def test_order_rate_gaps_and_jitter_of_stamps(steps, found):
    told = stamped(steps)
    assert [frame for frame, *_ in told] == [frame for frame, _ in found]
    for (_, key, text), (_, begin) in zip(told, found, strict=True):
        assert key == "time"
        assert text.startswith(begin)


def test_stamps_that_stall_are_counted():
    ((_, _, text),) = stamped(changed(_30=-1, _40=0))
    assert "(2 times)" in text


def test_only_stamps_of_lerobot_have_to_begin_at_zero():
    assert stamped(EVEN, 5.0) == []
    assert stamped(EVEN, 0.0099, "timestamp") == []
    ((frame, key, text),) = stamped(EVEN, 0.0101, "timestamp")
    assert (frame, key) == (0, "timestamp")
    assert text.startswith("begins at 0.0101 s, not at 0")
    assert len(stamped(EVEN, -0.0101, "timestamp")) == 1


def test_stamps_that_are_not_finite_or_alone_are_passed_over(folder):
    assert places(checks.stamps(ENTRY, "time", np.array([0, np.nan, 1]), 50)) == []
    assert places(checks.stamps(ENTRY, "time", np.zeros(1), 50)) == []
    late = {"timestamp": np.arange(20.0)[:, None] / 25}
    assert len(places(checks.recorded_stamps(folder, ENTRY, late))) == 1
    assert places(checks.recorded_stamps(folder, ENTRY, {})) == []


def test_quaternions_change_their_sign():
    q = np.tile([0.6, 0.0, 0.8, 0.0], (10, 1))
    q[4:7] *= -1
    found = places(checks.quaternion_signs(ENTRY, {"quaternion": q, "rotation_vector": -q}))
    assert [(frame, key) for frame, key, _ in found] == [(4, "quaternion")]
    assert "changes its sign 2 times" in found[0][2]
    # A quarter turn and more, without another sign.
    q = np.array([[1.0, 0, 0, 0], [0.0, 1, 0, 0]])
    assert places(checks.quaternion_signs(ENTRY, {"quaternion": q})) == []


@pytest.mark.parametrize(("size", "told"), [(0.99e-4, True), (1.01e-4, False)])
def test_less_than_a_tenth_of_a_milliradian_is_no_motion(size, told):
    q = np.stack([np.linspace(0, size, 20), np.zeros(20)], axis=1)
    assert len(places(checks.motion_present(ENTRY, demo(q)))) == told
    position = np.stack([np.linspace(0, size, 20), *np.zeros((2, 20))], axis=1)
    assert len(places(checks.motion_present(ENTRY, demo(position=position)))) == told


def test_joints_are_the_motion_and_else_the_position():
    q, p = np.ones((4, 2)), np.zeros((4, 3))
    assert checks.arm_motion(demo(q, position=p)) is not None
    np.testing.assert_array_equal(checks.arm_motion(demo(q, position=p)), q)
    np.testing.assert_array_equal(checks.arm_motion(demo(position=p)), p)
    assert checks.arm_motion(replace(demo(position=p), position=None)) is None
    assert places(checks.motion_present(ENTRY, replace(demo(q), joint_position=None))) == []


@pytest.mark.parametrize(
    ("before", "after", "found"),
    [
        (48, 48, []),
        (60, 20, [(0, "begins with 1.2 s of standing still: hrc repair trims it")]),
        (20, 100, [(69, "ends with 2.0 s of standing still: hrc repair trims it")]),
        (100, 75, [(0, "begins with 2.0 s"), (149, "ends with 1.5 s")]),
    ],
)
def test_rest_of_more_than_a_second_at_an_end(before, after, found):
    """The motion takes 50 frames; at its ends it moves by 2 % of its size a frame."""
    ramp = np.concatenate([np.zeros(before), np.linspace(0, 1, 51), np.ones(after)])
    q = np.stack([ramp, 0.3 * ramp], axis=1)
    told = places(checks.rest_at_ends(ENTRY, demo(q)))
    assert [frame for frame, *_ in told] == [frame for frame, _ in found]
    assert all(a.startswith(b) for (*_, a), (_, b) in zip(told, found, strict=True))


def test_noise_of_half_a_percent_is_rest():
    ramp = np.concatenate([np.zeros(60), np.linspace(0, 1, 51), np.ones(60)])
    for noise, ends in ((0.004, 2), (0.006, 0)):
        q = ramp + noise * (np.arange(len(ramp)) % 2)
        assert len(places(checks.rest_at_ends(ENTRY, demo(q[:, None])))) == ends
    assert places(checks.rest_at_ends(ENTRY, demo(np.ones((99, 1))))) == []


USUAL = {"joint_position": (np.array([0.01, 0.01, 0.5]), np.array([1.0, 2.0, 1.0]))}
"""Bounds: spikes of 4 x 0.01 + 0.03 = 0.07 and 0.03 x 2 + 0.03 = 0.09; jumps of 0.2 and 0.3."""


def odd(**offsets):
    """Joints that creep, with offsets at some frames."""
    q = np.linspace(0, 0.1, 60)[:, None] * [1.0, 1.0, 1.0]
    for place, (joint, size) in offsets.items():
        frame = int(place[1:])
        stop = frame + 1 if place[0] == "s" else None
        q[frame:stop, joint] += size
    return demo(q)


@pytest.mark.parametrize(
    ("offsets", "found"),
    [
        ({}, []),
        ({"s20": (0, 0.065)}, []),
        ({"s20": (0, 0.075)}, [("leaps away for one frame", 20, 0)]),
        ({"s20": (0, -0.075)}, [("leaps away for one frame", 20, 0)]),
        ({"s20": (1, 0.085)}, []),
        ({"s20": (1, 0.095)}, [("leaps away for one frame", 20, 1)]),
        ({"j30": (0, 0.19)}, []),
        ({"j30": (0, 0.21)}, [("jumps", 30, 0)]),
        ({"j30": (0, -0.21)}, [("jumps", 30, 0)]),
        ({"j30": (1, 0.29)}, []),
        ({"j30": (1, 0.31)}, [("jumps", 30, 1)]),
        # A large spike is no jump; a joint that switches does neither.
        ({"s20": (0, 0.5)}, [("leaps away for one frame", 20, 0)]),
        ({"j30": (2, 9.0)}, []),
        ({"s30": (2, 9.0)}, []),
        # The largest of two, by its joint's usual step.
        ({"j30": (0, 0.4), "j40": (0, 0.5)}, [("jumps", 40, 0)]),
        ({"s20": (0, 0.3), "j40": (1, 0.5)}, [("leaps away", 20, 0), ("jumps", 40, 1)]),
    ],
)
def test_spikes_and_jumps_are_beyond_the_usual_steps_and_range(offsets, found):
    told = [*checks.spikes_and_jumps(ENTRY, odd(**offsets), USUAL)]
    assert len(told) == len(found)
    for issue, (what, frame, joint) in zip(told, found, strict=True):
        name = f"j{joint}"
        assert issue.message.startswith(f"{name} {what}")
        assert (issue.frame, issue.components) == (frame, (name,))
        assert issue.key == f"joint_position ({name})"
        assert f"{len(offsets) - len(found) + 1} such frames" in issue.message
        size = max((abs(s) for j, s in offsets.values() if j == joint))
        assert issue.severity == pytest.approx(size / 0.01, rel=0.04)


@pytest.mark.parametrize(("step", "told"), [(0.19, True), (0.21, False)])
def test_a_joint_whose_usual_step_is_a_fifth_of_its_range_switches(step, told):
    usual = {"joint_position": (np.array([0.01, step, 0.5]), np.array([1.0, 1.0, 1.0]))}
    jumps = [*checks.spikes_and_jumps(ENTRY, odd(j30=(1, 9.0)), usual)]
    assert len(jumps) == told
    # A joint that never moved has no usual step.
    usual = {"joint_position": (np.zeros(3), np.ones(3))}
    assert not [*checks.spikes_and_jumps(ENTRY, odd(j30=(1, 9.0)), usual)]


@pytest.mark.parametrize(
    ("spans", "size", "told"), [((0.1, 0.02), 0.2, 0), ((0.1, 0.02), 0.27, 1)]
)
def test_where_a_joint_is_fast_its_step_bounds_the_jump(spans, size, told):
    """Eight times 0.02 and 0.1 rad: 0.26 rad, more than a tenth of the range and 0.1."""
    usual = {"joint_position": (np.full(3, spans[1]), np.full(3, 1.0))}
    assert len([*checks.spikes_and_jumps(ENTRY, odd(j30=(0, size)), usual)]) == told
    # Four times 0.02 and 0.03 rad: 0.11 rad for spikes.
    for spike, found in ((0.105, 0), (0.12, 1)):
        issues = [*checks.spikes_and_jumps(ENTRY, odd(s30=(0, spike)), usual)]
        assert len(issues) == found


@pytest.mark.parametrize(
    ("step", "cause"),
    [
        (11.9 / FPS, None),
        (12.1 / FPS, "a glitch"),
        (-12.1 / FPS, "a glitch"),
        (2 * np.pi - 0.31, "a glitch"),
        (2 * np.pi - 0.29, "the encoder wrapped"),
        (-2 * np.pi - 0.29, "the encoder wrapped"),
        (2 * np.pi + 0.31, "a glitch"),
    ],
)
def test_no_joint_is_faster_than_12_rad_a_second(step, cause):
    q = np.zeros((60, 3))
    q[30:, 1] = step
    told = [*checks.joint_speeds(ENTRY, demo(q))]
    assert len(told) == (cause is not None)
    for issue in told:
        assert (issue.frame, issue.key) == (30, "joint_position (j1)")
        speed = f"({abs(step) * FPS:.3g} rad/s, limit 12)"
        assert f"j1 jumps by {step:.3g} rad in one frame {speed}; {cause}" in issue.message
        assert "1 such frames" in issue.message
    hand = replace(demo(q), joint_names=("j0", "gripper", "j2"))
    assert not [*checks.joint_speeds(ENTRY, hand)]
    assert not [*checks.joint_speeds(ENTRY, demo(position=np.zeros((3, 3))))]


def test_the_first_frame_that_is_too_fast_is_named_with_its_fastest_joint():
    q = np.zeros((60, 3))
    q[10:, 1], q[10:, 2], q[20:, 0] = 1.0, -1.5, 5.0
    (issue,) = checks.joint_speeds(ENTRY, demo(q))
    assert (issue.frame, issue.components) == (10, ("j2",))
    assert "2 such frames" in issue.message
    # By the stamps, not by the nominal rate.
    slow = replace(demo(q), time=np.arange(60.0))
    assert not [*checks.joint_speeds(ENTRY, slow)]


@pytest.mark.parametrize(
    ("factor", "told"), [(1.0, ""), (2.9, ""), (57.3, "57.3"), (0.3, "0.3"), (-57.3, "")]
)
def test_velocities_in_another_unit_than_the_joints(factor, told):
    q = np.sin(np.arange(60) / 10)[:, None] * [1.0, 0.5, 0.2]
    one = demo(q)
    rate = factor * np.gradient(q, one.time, axis=0)
    issues = [*checks.joint_rates(ENTRY, replace(one, joint_velocity=rate))]
    assert len(issues) == bool(told)
    for issue in issues:
        assert f"is {told} times the rate of joint_position" in issue.message
    other = np.random.default_rng(0).normal(size=q.shape)
    assert not [*checks.joint_rates(ENTRY, replace(one, joint_velocity=100 * other))]
    assert not [*checks.joint_rates(ENTRY, one)]


def test_actions_that_copy_the_state():
    q = np.random.default_rng(0).normal(size=(20, 2))
    (issue,) = checks.copied_commands(ENTRY, demo(q, command_position=q.copy()))
    assert issue.key == "action"
    other = q.copy()
    other[-1, -1] += 1e-9
    assert not [*checks.copied_commands(ENTRY, demo(q, command_position=other))]
    assert not [*checks.copied_commands(ENTRY, demo(q))]


def test_an_episode_that_shows_the_same_motion_as_an_earlier_one():
    """Copies within a thousandth of the motion; the earliest of them is named."""
    base = np.sin(np.linspace(0, 3, 40))

    def motion(index, sketch, span=1.0):
        return replace(ENTRY, index=index), sketch, span

    far, near = base.copy(), base.copy()
    far[11] += 1.1e-3
    near[11] += 0.9e-3
    motions = [
        motion(3, base), motion(4, -base), motion(5, near), motion(6, far), motion(8, base),
    ]  # fmt: skip
    found = [(i.episode, i.message) for i in checks.duplicates(motions)]
    text = "shows the same motion as episode {}: recorded once, stored twice?"
    # The one that is 1.1e-3 from the first is 0.2e-3 from the second.
    expected = [(5, text.format(3)), (6, text.format(5)), (8, text.format(3))]
    assert found == expected
    assert not [*checks.duplicates([motion(0, base, 0.0), motion(1, base, 0.0)])]
    other = motion(1, base[:20])
    assert not [*checks.duplicates([motion(0, base), other])]
    assert not [*checks.duplicates([])]


@pytest.mark.parametrize("frames", [2, 20, 77])
def test_a_sketch_of_a_motion_knows_its_phases_only(frames):
    motion = np.linspace([0.0, 3.0], [1.0, -1.0], frames)
    sketch = checks.motion_sketch(motion)
    np.testing.assert_allclose(sketch, np.linspace([0.0, 3.0], [1.0, -1.0], 20).ravel())
    assert len(checks.motion_sketch(motion, phases=5)) == 10


# Values exactly at a limit are not reported.


def test_three_frames_may_repeat_and_two_may_not(folder):
    frames = {"observation.state": np.ones((3, 2))}
    (issue,) = checks.repetitions(folder, replace(ENTRY, length=3), frames)
    assert issue.message.startswith("the state never changes")


def test_stamps_at_their_limits_are_sound():
    half = np.arange(60) / FPS + 0.5 / FPS
    assert places(checks.stamps(ENTRY, "timestamp", half, FPS)) == []
    # A step of 1.6 usual ones.
    time = np.array([0.0, 1, 2, 3.6, 4.6, 5.6, 6.6, 7.6])
    assert np.diff(time).max() == 1.6
    assert not any("gaps" in text for *_, text in places(checks.stamps(ENTRY, "t", time, 1.0)))
    time[3:] += 1e-6
    assert any("1 gaps" in text for *_, text in places(checks.stamps(ENTRY, "t", time, 1.0)))


def test_motion_and_rest_at_their_limits():
    q = np.linspace(0, 1e-4, 20)[:, None]
    assert np.ptp(q) == 1e-4
    assert places(checks.motion_present(ENTRY, demo(q))) == []

    def ends(before, after):
        ramp = np.concatenate([np.zeros(before), np.linspace(0, 1, 51), np.ones(after)])
        return [
            text[:4] for *_, text in places(checks.rest_at_ends(ENTRY, demo(ramp[:, None])))
        ]

    # One second, at the beginning and at the end.
    assert ends(49, 10) == []
    assert ends(50, 10) == ["begi"]
    assert ends(51, 49) == ["begi"]
    assert ends(51, 50) == ["begi", "ends"]
    # Half a percent of the range is noise.
    ramp = np.concatenate([np.zeros(60), np.linspace(0, 200, 51), np.full(60, 200.0)])
    ramp[20], ramp[-20] = 1, 199
    assert len(places(checks.rest_at_ends(ENTRY, demo(ramp[:, None])))) == 2
    ramp[20], ramp[-20] = 1.01, 198.99
    assert len(places(checks.rest_at_ends(ENTRY, demo(ramp[:, None])))) == 0


@pytest.mark.parametrize(
    ("step", "span"), [(0.01, 1.0), (0.01, 2.0), (0.02, 1.0), (0.125, 1.0)]
)
def test_spikes_and_jumps_at_their_limits(step, span):
    usual = {"joint_position": (np.array([step]), np.array([span]))}
    spike = max(4 * step, 0.03 * span) + 0.03
    jump = max(8 * step, 0.1 * span) + 0.1
    for size, at, what in ((spike, slice(20, 21), "leaps"), (jump, slice(20, None), "jumps")):
        for factor, told in ((1.0, False), (1 + 1e-9, True)):
            q = np.zeros((60, 1))
            q[at] = factor * size
            found = places(checks.spikes_and_jumps(ENTRY, demo(q), usual))
            assert [f"j0 {what}" in text for *_, text in found] == [True] * told


def test_a_joint_that_usually_rests_or_switches_has_no_spikes():
    q = np.zeros((60, 1))
    q[20] = 5.0
    for step, told in ((0.0, False), (0.125, True), (0.25, False), (0.2499, True)):
        usual = {"joint_position": (np.array([step]), np.array([1.25]))}
        assert bool(places(checks.spikes_and_jumps(ENTRY, demo(q), usual))) == told


def test_a_joint_may_turn_at_12_rad_a_second():
    for step, told in ((12.0, False), (-12.0, False), (12.1, True)):
        q = np.cumsum([0, 1, step, 1.0])[:, None]
        one = demo(q, time=np.arange(4.0))
        assert bool(places(checks.joint_speeds(ENTRY, one))) == told
