"""Steps that make demonstrations ready for learning, on motions known in closed form."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from scipy.signal import butter, freqz, savgol_filter
from scipy.spatial.transform import Rotation

from hrc_learn.demos import Demonstration, DemonstrationSet
from hrc_learn.demos.preprocessing import (
    _scale,
    align,
    at_times,
    butterworth,
    compensate_delay,
    cut,
    equalise_durations,
    estimate_joint_velocity,
    estimate_twist,
    local_polynomial,
    motion_range,
    nearest_frames,
    regular_grid,
    resample,
    resting,
    savitzky_golay,
    set_duration,
    split_at_rest,
    trim_rest,
)

AXIS = np.array([0.6, 0.0, 0.8])


def turn(time, rate=2.0):
    """Quaternions (w, x, y, z) of a turn about one axis, of continuous sign."""
    half = rate * time[:, None] / 2
    return np.hstack([np.cos(half), np.sin(half) * AXIS])


def swing(time, **fields):
    """Two joints and a pose that swing; the velocity is exact."""
    q = np.stack([np.sin(2 * time), np.cos(time)], axis=1)
    q_dot = np.stack([2 * np.cos(2 * time), -np.sin(time)], axis=1)
    return Demonstration(
        **{
            "time": time - time[0],
            "joint_position": q,
            "joint_velocity": q_dot,
            "position": np.stack([time, time**2, np.sin(time)], axis=1),
            "orientation": turn(time),
            "joint_names": ("a", "b"),
            "fps": 50,
            **fields,
        }
    )


def jittered(frames=200, seed=0):
    steps = np.random.default_rng(seed).uniform(0.012, 0.028, frames)
    return np.cumsum(steps) - steps[0]


def angle(p, q):
    """Angle between orientations, whichever their signs."""
    return (
        Rotation.from_quat(p, scalar_first=True).inv()
        * Rotation.from_quat(q, scalar_first=True)
    ).magnitude()


def test_a_cut_begins_at_zero_and_remembers_when_it_was():
    time = jittered()
    demo = swing(time, start_time=7.0, extra={"shelf": np.arange(200.0)[:, None]})
    part = cut(demo, 50, 80)
    np.testing.assert_allclose(part.time, time[50:80] - time[50])
    assert part.start_time == pytest.approx(7.0 + time[50])
    np.testing.assert_array_equal(part.joint_position, demo.joint_position[50:80])
    np.testing.assert_array_equal(part.extra["shelf"][:, 0], np.arange(50, 80))
    with pytest.raises(ValueError, match="no part of a demonstration of 200 frames"):
        cut(demo, 80, 201)


def test_resampling_finds_the_motion_between_jittered_frames():
    demo = resample(swing(jittered()), fps=100)
    truth = swing(demo.time)
    np.testing.assert_allclose(np.diff(demo.time), 0.01)
    # A spline of fourth order at steps of 20 ms; less at the ends, where it knows no slope.
    np.testing.assert_allclose(demo.joint_position[5:-5], truth.joint_position[5:-5], atol=2e-6)
    np.testing.assert_allclose(demo.joint_velocity[5:-5], truth.joint_velocity[5:-5], atol=2e-6)
    assert angle(demo.orientation, truth.orientation)[5:-5].max() < 2e-6
    np.testing.assert_allclose(np.linalg.norm(demo.orientation, axis=1), 1)
    assert demo.fps == 100


def test_a_regular_demonstration_resampled_to_its_own_rate_is_itself():
    demo = swing(np.arange(120) / 50)
    again = resample(demo, 50)
    assert len(again) == 120
    for name in demo.recorded:
        np.testing.assert_allclose(getattr(again, name), getattr(demo, name), atol=1e-12)


def test_what_is_counted_or_seen_is_not_averaged():
    time = np.arange(6) / 10
    visible = np.array([True, True, False, True, True, True])
    demo = swing(
        time,
        feature=np.where(visible[:, None], [[5.0, 5.0]], np.nan),
        feature_visible=visible,
        extra={"mixed": np.stack([np.arange(6.0), np.arange(6) / 4], axis=1)},
    )
    moved = at_times(demo, np.array([0.0, 0.04, 0.16, 0.24, 0.38, 0.5]))
    assert moved.feature_visible.tolist() == [True, True, False, False, True, True]
    np.testing.assert_allclose(moved.feature[moved.feature_visible], 5)
    np.testing.assert_allclose(moved.extra["mixed"][:, 0], [0, 0, 2, 2, 4, 5])
    np.testing.assert_allclose(moved.extra["mixed"][:, 1], [0, 0.1, 0.4, 0.6, 0.95, 1.25])
    with pytest.raises(ValueError, match=r"exceed the demonstration, which lasts 0\.5 s"):
        at_times(demo, np.array([0.0, 0.6]))


def test_velocities_at_jittered_stamps_are_those_of_the_motion():
    time = jittered()
    demo = swing(time, joint_velocity=None)
    estimated = estimate_joint_velocity(demo, window=0.1)
    np.testing.assert_allclose(
        estimated.joint_velocity[5:-5], swing(time).joint_velocity[5:-5], atol=2e-4
    )
    twist = estimate_twist(demo, window=0.1)
    linear = np.stack([np.ones_like(time), 2 * time, np.cos(time)], axis=1)
    np.testing.assert_allclose(twist[5:-5, :3], linear[5:-5], atol=2e-4)
    np.testing.assert_allclose(twist[5:-5, 3:], np.tile(2 * AXIS, (190, 1)), atol=2e-4)
    with pytest.raises(ValueError, match="none are recorded"):
        estimate_joint_velocity(replace(demo, joint_position=None))


def test_smoothing_of_orientations_does_not_depend_on_the_frame():
    time = jittered()
    noise = 0.02 * np.random.default_rng(2).normal(size=(200, 3))
    noisy = Rotation.from_quat(turn(time), scalar_first=True) * Rotation.from_rotvec(noise)
    elsewhere = Rotation.from_rotvec([1.0, -2.0, 0.5]) * noisy
    one, other = (
        savitzky_golay(
            swing(time, orientation=_continuous(r.as_quat(scalar_first=True))), window=0.3
        ).orientation
        for r in (noisy, elsewhere)
    )
    moved = Rotation.from_rotvec([1.0, -2.0, 0.5]) * Rotation.from_quat(one, scalar_first=True)
    assert angle(other, moved.as_quat(scalar_first=True)).max() < 1e-7
    assert (
        angle(one, turn(time)).mean()
        < angle(noisy.as_quat(scalar_first=True), turn(time)).mean() / 1.5
    )


def test_joints_on_even_stamps_are_smoothed_as_scipy_does_by_cubics():
    time = np.arange(120) / 50
    noisy = np.sin(3 * time) + 0.1 * np.random.default_rng(5).normal(size=120)
    demo = swing(time, joint_position=np.stack([noisy, 2 * noisy], axis=1))
    expected = savgol_filter(demo.joint_position, 15, 3, axis=0, mode="interp")
    smooth = savitzky_golay(demo, window=0.3).joint_position
    np.testing.assert_allclose(smooth, expected, atol=1e-9)


def _continuous(q):
    signs = np.sign((q[1:] * q[:-1]).sum(1))
    return q * np.concatenate([[1], np.cumprod(signs)])[:, None]


@pytest.mark.parametrize("order", [1, 2, 4])
def test_the_low_pass_halves_the_power_at_its_cutoff_without_lag(order):
    time = np.arange(2000) / 200
    wave = np.sin(2 * np.pi * 5 * time)
    demo = swing(time, joint_position=np.stack([wave, np.ones_like(wave)], axis=1))
    filtered = butterworth(demo, cutoff=5, order=order).joint_position
    middle = slice(600, 1400)
    np.testing.assert_allclose(filtered[middle, 0], wave[middle] / np.sqrt(2), atol=1e-6)
    np.testing.assert_allclose(filtered[:, 1], 1, atol=1e-9)


def test_the_low_pass_is_scipys_run_twice():
    time = np.arange(4000) / 200
    slow, fast = np.sin(2 * np.pi * 1 * time), np.sin(2 * np.pi * 12 * time)
    demo = swing(time, joint_position=np.stack([slow, fast], axis=1))
    filtered = butterworth(demo, cutoff=6).joint_position
    raised = np.arctan(np.tan(np.pi * 6 / 200) / (np.sqrt(2) - 1) ** 0.25) * 200 / np.pi
    _, gain = freqz(*butter(2, raised, fs=200), worN=[1, 12], fs=200)
    middle = slice(1500, 2500)
    for k, wave in enumerate((slow, fast)):
        np.testing.assert_allclose(
            filtered[middle, k], np.abs(gain[k]) ** 2 * wave[middle], atol=1e-6
        )


def test_filters_say_what_they_need():
    with pytest.raises(ValueError, match="needs even stamps"):
        butterworth(swing(jittered()), cutoff=5)
    even = swing(np.arange(100) / 50)
    for cutoff in (25, 60, 0):  # 60 Hz look like 10 Hz at this rate
        with pytest.raises(ValueError, match="between 0 and half the frame rate, 25 Hz"):
            butterworth(even, cutoff=cutoff)
    with pytest.raises(ValueError, match="padlen"):
        butterworth(cut(even, 0, 8), cutoff=5)


def with_rests(fps=100):
    """Rest 1 s, minimum-jerk motion 2 s, rest 1 s, motion 1 s, rest 0.5 s, with noise."""

    def s(frames):
        u = np.linspace(0, 1, frames)
        return 10 * u**3 - 15 * u**4 + 6 * u**5

    path = np.concatenate(
        [np.zeros(100), s(200), np.ones(100), 1 - s(100) / 2, np.full(50, 0.5)]
    )
    noise = 1e-4 * np.random.default_rng(3).normal(size=(len(path), 2))
    return swing(
        np.arange(len(path)) / fps,
        joint_position=np.stack([path, -path], axis=1) + noise,
        joint_velocity=None,
        position=None,
        orientation=None,
    )


def test_rest_is_told_from_motion():
    still = resting(with_rests())
    assert still[:100].all()
    assert still[310:390].all()
    assert not still[120:280].any()
    assert not still[415:485].any()


def test_a_speed_between_the_bounds_changes_nothing():
    # The speed falls to 0.02 rad/s, below the upper bound and above the lower one.
    time = np.arange(400) / 100
    speed = np.where((time > 1) & (time < 2), 0.02, 0.5)
    q = np.cumsum(speed)[:, None] * 0.01
    demo = swing(time, joint_position=np.hstack([q, q]), joint_velocity=None)
    assert not resting(demo).any()


def test_an_arm_moves_until_it_clearly_rests_and_rests_until_it_clearly_moves():
    # Between the bounds, still, between them again, and fast.
    time = np.arange(500) / 100
    speed = np.select([time < 1, time < 2, time < 3], [0.02, 0.0, 0.02], 0.5)
    q = np.cumsum(speed)[:, None] * 0.01
    still = resting(swing(time, joint_position=np.hstack([q, q]), joint_velocity=None))
    assert not still[:85].any()
    assert still[115:285].all()
    assert not still[315:].any()


def test_rest_is_trimmed_and_demonstrations_are_split_at_it():
    demo = with_rests()
    trimmed = trim_rest(demo, keep=0.1)
    assert trimmed.start_time == pytest.approx(0.95, abs=0.12)
    assert trimmed.duration == pytest.approx(4.1, abs=0.2)
    parts = split_at_rest(demo)
    assert [round(part.duration, 1) for part in parts] == [
        pytest.approx(2.1, abs=0.2),
        pytest.approx(1.1, abs=0.2),
    ]
    np.testing.assert_allclose(parts[0].joint_position[-1], [1, -1], atol=5e-3)
    still = swing(np.arange(50) / 50, joint_position=np.ones((50, 2)))
    with pytest.raises(ValueError, match="rests all the time"):
        trim_rest(still)
    assert split_at_rest(still) == []


def test_rest_of_poses_is_told_by_the_speed_of_the_hand():
    demo = with_rests()
    pose = replace(
        demo,
        joint_position=None,
        joint_names=(),
        position=0.2 * np.hstack([demo.joint_position, demo.joint_position[:, :1]]),
    )
    assert resting(pose)[:90].all()
    assert not resting(pose)[150:250].any()


def test_durations_are_made_equal_and_velocities_with_them():
    demos = DemonstrationSet([swing(np.arange(n) / 50) for n in (101, 151, 251)])
    equal = equalise_durations(demos)
    assert [demo.duration for demo in equal] == pytest.approx([3, 3, 3])
    for demo in equal:
        spline = CubicSpline(demo.time, demo.joint_position)
        np.testing.assert_allclose(
            demo.joint_velocity[5:-5], spline(demo.time, 1)[5:-5], atol=1e-3
        )
        assert 1 / np.median(np.diff(demo.time)) == pytest.approx(demo.fps)
    with pytest.raises(ValueError, match="cannot be made to last 0 s"):
        set_duration(demos[0], 0)


def test_a_late_stream_is_moved_to_when_it_was_measured():
    time = np.arange(200) / 50
    late = np.maximum(time - 0.06, 0)

    def uv(t):
        return np.stack([t**2, np.sin(t)], axis=1)

    demo = swing(time, feature=uv(late), feature_visible=np.ones(200, bool))
    moved = compensate_delay(demo, {"feature": 0.06})
    assert moved.duration == pytest.approx(demo.duration - 0.06, abs=0.021)
    np.testing.assert_allclose(moved.feature, uv(moved.time), atol=2e-4)
    np.testing.assert_allclose(
        moved.joint_position, swing(moved.time).joint_position, atol=1e-9
    )
    with pytest.raises(ValueError, match="gripper is not recorded"):
        compensate_delay(demo, {"gripper": 0.1})


def test_a_delay_of_whole_frames_is_compensated_to_the_last_one():
    time = np.arange(61) / 100  # 0.54 s and 0.06 s of delay are more than 0.6 s, by rounding
    moved = compensate_delay(swing(time, gripper=time - 0.06), {"gripper": 0.06})
    assert len(moved) == 55
    np.testing.assert_allclose(moved.gripper, moved.time, atol=1e-9)


def warped(time, strength):
    """The swing gone through at a changing pace."""
    s = time / time[-1]
    return time[-1] * (s + strength * np.sin(np.pi * s) ** 2)


@pytest.mark.parametrize(("rest", "counts"), [(0.5, True), (0.2, False)])
def test_a_rest_shorter_than_0_3_s_belongs_to_the_motion(rest, counts):
    time = np.arange(400) / 100
    speed = np.where(np.abs(time - 2) < rest / 2, 0.0, 0.5)
    q = np.cumsum(speed)[:, None] * 0.01
    still = resting(swing(time, joint_position=np.hstack([q, q]), joint_velocity=None))
    assert still.any() == counts


def test_demonstrations_are_brought_to_the_timing_of_one():
    time = np.arange(300) / 50
    paces = [warped(time, strength) for strength in (0.12, 0.0, -0.1)]
    demos = DemonstrationSet([replace(swing(pace), time=time) for pace in paces])
    aligned = align(demos)
    before = np.abs(demos[0].joint_position - demos[1].joint_position).max()
    for demo in aligned:
        np.testing.assert_array_equal(demo.time, time)
        difference = np.abs(demo.joint_position - demos[1].joint_position)
        assert difference.max() < 0.06 < before / 4
        assert difference.mean() < 0.01
    # Its velocities are those of the leader's timing now.
    np.testing.assert_allclose(aligned[0].joint_velocity, demos[1].joint_velocity, atol=0.5)


def test_commanded_velocities_follow_the_timing_of_the_leader():
    time = np.arange(300) / 50
    motion = swing(time)
    slow = replace(motion, time=1.5 * time, command_velocity=motion.joint_velocity / 1.5)
    # Without positions of joints, the measured velocities are scaled, too.
    bare = replace(slow, joint_position=None, joint_velocity=slow.command_velocity)
    for other in (slow, bare):
        _, demo = align(DemonstrationSet([motion, other]))
        np.testing.assert_allclose(demo.command_velocity, motion.joint_velocity, atol=0.02)
        np.testing.assert_allclose(demo.joint_velocity, motion.joint_velocity, atol=0.02)


def test_orientations_that_agree_are_no_angle_apart():
    """Products of unit quaternions are rounded beyond one, of which there is no arccos."""
    time = np.arange(100) / 50
    q = np.random.default_rng(0).normal(size=(100, 4))
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    assert (np.square(q).sum(1) > 1).any()
    demo = Demonstration(time=time, orientation=q, fps=50)
    aligned = align(DemonstrationSet([demo, replace(demo, episode=1)]))
    np.testing.assert_allclose(np.abs((aligned[1].orientation * q).sum(1)), 1, atol=1e-9)


def test_poses_are_aligned_too_and_the_median_leads():
    time = np.arange(200) / 50
    demos = DemonstrationSet(
        [
            replace(
                swing(warped(time, strength)),
                joint_position=None,
                joint_velocity=None,
                joint_names=(),
                time=time * stretch,
            )
            for strength, stretch in ((0.1, 1.4), (0.0, 1.0), (-0.1, 0.7))
        ]
    )
    aligned = align(demos)
    for demo in aligned:
        np.testing.assert_array_equal(demo.time, demos[1].time)
        assert angle(demo.orientation, demos[1].orientation).mean() < 0.03
    with pytest.raises(ValueError, match="empty set"):
        align(DemonstrationSet([]))


ALONE = swing(np.arange(60) / 50, position=None, orientation=None)
FRAME = Demonstration(
    time=np.zeros(1), joint_position=np.zeros((1, 1)), joint_names=("a",), fps=50
)
GRIPPER = Demonstration(time=np.arange(60) / 50, gripper=np.zeros(60), fps=50)


@pytest.mark.parametrize(
    ("step", "fault"),
    [
        (lambda: estimate_twist(ALONE), "a twist needs position and orientation"),
        (lambda: resting(GRIPPER), "rest is found in joint or tool positions; neither"),
        (lambda: resample(ALONE, 0), "fps must be positive and below 1e.06, got 0"),
        (lambda: resample(ALONE, 0.8), "1.18 s hold no two frames at 0.8 Hz"),
        (lambda: resample(FRAME, 1), "hold no two frames|of one frame cannot be interpolated"),
        (lambda: at_times(FRAME, np.zeros(2)), "of one frame cannot be interpolated"),
        (
            lambda: compensate_delay(ALONE, {"joint_velocity": -0.1}),
            r"joint_velocity must be between 0 and 1.18 s, got -0.1",
        ),
        (lambda: compensate_delay(ALONE, {"joint_velocity": 1.2}), r"0 and 1.18 s, got 1.2"),
        (
            lambda: compensate_delay(ALONE, {"gripper": 0.1}),
            "gripper is not recorded; recorded",
        ),
        (
            lambda: align(DemonstrationSet([GRIPPER, GRIPPER])),
            "alignment needs joints or poses recorded in all",
        ),
    ],
)
def test_what_a_step_needs_and_a_demonstration_lacks_is_named(step, fault):
    with pytest.raises(ValueError, match=fault):
        step()


def test_a_grid_allows_for_rounded_stamps_and_no_more():
    """A duration nine ten-thousandths of a period too short still holds its last frame."""
    for missing, frames in ((0.0, 51), (9e-4, 51), (2e-3, 50)):
        assert len(regular_grid(1 - missing / 50, 50)) == frames
    assert len(regular_grid(0.02, 50)) == 2
    np.testing.assert_allclose(np.diff(regular_grid(2.0, 8)), 1 / 8)


def at_speed(values, time=None, **fields):
    """Joints or a hand whose components move at these speeds [1/s], frame by frame."""
    time = np.arange(len(values)) / 100 if time is None else time
    path = np.cumsum(np.asarray(values, float), axis=0) * 0.01
    name = fields.pop("name", "joint_position")
    names = tuple(f"j{i}" for i in range(path.shape[1])) if name == "joint_position" else ()
    return Demonstration(
        **{"time": time, name: path, "joint_names": names, "fps": 100}, **fields
    )


@pytest.mark.parametrize(
    ("name", "slow", "fast"), [("joint_position", 0.01, 0.04), ("position", 0.003, 0.01)]
)
def test_bounds_of_rest_of_joints_and_of_the_hand(name, slow, fast):
    """A rest begins below the lower bound and ends above the upper one."""
    for before, still in ((0.99 * slow, True), (1.01 * slow, False)):
        speed = np.full(300, before)
        speed[:100] = 9 * fast
        demo = at_speed(np.outer(speed, [0, -1, 0]), name=name)
        assert resting(demo)[120:].tolist() == [still] * 180
    for after, still in ((0.99 * fast, True), (1.01 * fast, False)):
        speed = np.full(300, after)
        speed[:100] = 0
        demo = at_speed(np.outer(speed, [0, 1, 0]), name=name)
        assert resting(demo)[120:].tolist() == [still] * 180


def test_the_fastest_joint_counts_and_of_a_hand_the_speed_along_its_path():
    """Each of three components alone is below the bound, together they are above."""
    speed = np.full((300, 3), 0.0035 / 2)
    assert not resting(at_speed(speed, name="position")).any()
    assert resting(at_speed(speed * [1, 1, 0], name="position")).all()
    assert resting(at_speed(np.full((300, 3), 0.009))).all()
    assert not resting(at_speed(np.full((300, 3), [0.0, 0.009, -0.02]))).any()


def test_joints_decide_on_rest_where_a_pose_is_recorded_too():
    demo = at_speed(np.zeros((100, 2)), position=np.cumsum(np.ones((100, 3)), axis=0))
    assert resting(demo).all()


@pytest.mark.parametrize("keep", [0.0, 0.1, 0.25])
def test_motions_keep_a_margin_at_either_end(keep):
    """Motion of frames 100 to 199 and 300 to 339, at 100 Hz."""
    rest = np.ones(440, bool)
    rest[100:200] = rest[300:340] = False
    demo = at_speed(np.zeros((440, 1)))
    margin = round(100 * keep)
    assert motion_range(demo, rest, keep) == (100 - margin, 340 + margin)
    assert motion_range(demo, ~rest, 9.0) == (0, 440)
    speed = np.where(rest, 0.0, 1.0)[:, None]
    parts = split_at_rest(at_speed(speed), keep=keep)
    first = [round(100 * part.start_time) for part in parts]
    # The window of speeds is 15 frames wide: motion is seen half of it too early.
    assert np.abs(np.subtract(first, [100 - margin, 300 - margin])).max() <= 8
    assert len(split_at_rest(at_speed(speed), shortest=0.6)) == 1
    assert len(split_at_rest(at_speed(speed), shortest=1.2)) == 0
    demo, longest = at_speed(speed), split_at_rest(at_speed(speed), keep=0.0)[0]
    begin = int(np.flatnonzero(demo.time == longest.start_time)[0])
    duration = demo.time[begin + len(longest) - 1] - demo.time[begin]
    assert len(split_at_rest(demo, shortest=duration)) == 1
    one = trim_rest(at_speed(speed), keep)
    assert abs(round(100 * one.start_time) - 100 + margin) <= 8
    assert abs(len(one) - 240 - 2 * margin) <= 16


def test_margins_are_a_tenth_of_a_second_unless_told():
    rest = np.ones(400, bool)
    rest[100:300] = False
    demo = at_speed(np.zeros((400, 1)))
    assert motion_range(demo, rest) == (90, 310)
    moving = at_speed(np.where(rest, 0.0, 1.0)[:, None])
    assert len(trim_rest(moving)) == len(trim_rest(moving, 0.1))
    (one,) = split_at_rest(moving)
    assert len(one) == len(trim_rest(moving))


@pytest.mark.parametrize(("start", "stop"), [(-1, 5), (5, 5), (6, 5), (0, 11), (11, 12)])
def test_a_range_that_is_no_part_of_a_demonstration(start, stop):
    demo = at_speed(np.zeros((10, 1)))
    with pytest.raises(ValueError, match=f"frames {start} to {stop} are no part"):
        cut(demo, start, stop)
    assert len(cut(demo, 0, 10)) == 10
    assert cut(demo, 9, 10).time.tolist() == [0]


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_a_short_window_holds_two_samples_more_than_the_degree_made_odd(degree):
    values = np.random.default_rng(0).normal(size=(40, 1))
    time = np.arange(40) / 50
    taps = (degree + 2) | 1
    smooth, _ = local_polynomial(time, values, window=1e-3, degree=degree)
    np.testing.assert_allclose(
        smooth, savgol_filter(values, taps, degree, axis=0, mode="interp"), atol=1e-9
    )
    few, _ = local_polynomial(time[: degree + 1], values[: degree + 1], window=9, degree=degree)
    np.testing.assert_allclose(few, values[: degree + 1], atol=1e-9)
    for bad in (degree, 1):
        with pytest.raises(ValueError, match=f"{bad} samples do not determine"):
            local_polynomial(time[:bad], values[:bad], window=1, degree=degree)
    with pytest.raises(ValueError, match="must be positive"):
        local_polynomial(time, values, window=0.1, degree=0)


def test_commands_and_measurements_of_cameras_are_not_smoothed():
    time = np.arange(80) / 50
    noise = np.random.default_rng(1).normal(size=(80, 2))
    demo = swing(
        time,
        joint_position=noise,
        joint_velocity=noise,
        joint_effort=noise,
        human_effort=noise,
        command_position=noise,
        command_velocity=noise,
        feature=noise,
        feature_visible=np.ones(80, bool),
        gripper=noise[:, 0],
    )
    for smooth in (savitzky_golay(demo, 0.3), butterworth(demo, 4)):
        for name in demo.recorded:
            same = np.array_equal(getattr(smooth, name), getattr(demo, name))
            assert same == (name.startswith(("command", "feature", "gripper", "time")))
        np.testing.assert_allclose(np.linalg.norm(smooth.orientation, axis=1), 1)


def test_stamps_of_a_low_pass_may_be_rounded_but_not_uneven():
    steps = np.full(99, 0.02)
    for odd, refused in ((1.0099, False), (1.0101, True)):
        steps[50] = 0.02 * odd
        demo = swing(np.r_[0, np.cumsum(steps)])
        if refused:
            with pytest.raises(ValueError, match="needs even stamps"):
                butterworth(demo, 5)
        else:
            butterworth(demo, 5)
    with pytest.raises(ValueError, match="needs even stamps"):
        butterworth(cut(demo, 0, 1), 5)


def test_smooth_fields_follow_a_spline_and_others_lines():
    time = jittered(40)
    rng = np.random.default_rng(4)
    demo = swing(
        time,
        joint_effort=rng.normal(size=(40, 2)),
        command_position=rng.normal(size=(40, 2)),
        gripper=rng.normal(size=40),
    )
    at = np.linspace(0, time[-1], 77)
    moved = at_times(demo, at)
    for name in ("joint_position", "joint_velocity", "position"):
        expected = CubicSpline(time, getattr(demo, name))(at)
        np.testing.assert_allclose(getattr(moved, name), expected)
    for name in ("joint_effort", "command_position", "gripper"):
        values = getattr(demo, name).reshape(40, -1)
        expected = np.stack([np.interp(at, time, v) for v in values.T], axis=1)
        np.testing.assert_allclose(getattr(moved, name).reshape(77, -1), expected, atol=1e-12)
    assert len(resample(demo, 20)) == int(time[-1] * 20) + 1
    assert resample(demo, 20).fps == 20
    for outside in (np.array([-1e-6, 0.1]), np.array([0.1, time[-1] + 1e-6])):
        with pytest.raises(ValueError, match="exceed the demonstration"):
            at_times(demo, outside)


def test_of_two_frames_equally_near_the_earlier_one_counts():
    known = np.array([0.0, 1, 2, 4])
    at = np.array([-1.0, 0, 0.5, 0.51, 1.49, 1.5, 1.51, 3.0, 3.01, 4, 9])
    expected = [np.flatnonzero(abs(known - t) == abs(known - t).min())[0] for t in at]
    assert nearest_frames(known, at).tolist() == expected


def test_a_change_of_duration_scales_rates():
    demo = swing(np.arange(101) / 50, command_velocity=np.ones((101, 2)))
    demo = replace(demo, joint_effort=np.ones((101, 2)))
    slow = set_duration(demo, 5.0)
    assert (slow.duration, slow.fps) == (pytest.approx(5), pytest.approx(20))
    np.testing.assert_allclose(slow.joint_velocity, demo.joint_velocity * 0.4)
    np.testing.assert_allclose(slow.command_velocity, 0.4)
    np.testing.assert_array_equal(slow.joint_effort, demo.joint_effort)
    for bad in (0, -1, float("nan"), float("inf")):
        with pytest.raises(ValueError, match="101 frames cannot be made to last"):
            set_duration(demo, bad)
    with pytest.raises(ValueError, match="of 1 frames cannot be made to last 2 s"):
        set_duration(FRAME, 2)


def test_an_image_that_is_late_takes_its_visibility_along():
    time = np.arange(50) / 50
    seen = np.arange(50) >= 20
    demo = swing(time, feature=np.outer(time, [1, 2]), feature_visible=seen, gripper=time)
    moved = compensate_delay(demo, {"feature": 0.1, "gripper": 0.04})
    assert len(moved) == 45
    np.testing.assert_allclose(moved.feature[:, 0], time[5:])
    np.testing.assert_array_equal(moved.feature_visible, seen[5:])
    np.testing.assert_allclose(moved.gripper, time[2:47])
    still = compensate_delay(demo, {"gripper": 0.04})
    np.testing.assert_array_equal(still.feature_visible, seen[:48])
    assert len(compensate_delay(demo, {})) == 50
    assert len(compensate_delay(demo, {"gripper": 0})) == 50
    with pytest.raises(ValueError, match=r"between 0 and 0\.98 s, got 0\.98"):
        compensate_delay(demo, {"gripper": demo.duration})


def test_the_demonstration_of_median_duration_leads():
    """Of four the second; the leader and equal motions stay as they are."""

    def motion(seconds):
        time = np.linspace(0, seconds, 60)
        return at_speed(np.zeros((60, 1)), time=time, episode=round(10 * seconds))

    def moved(demo):
        return replace(demo, joint_position=demo.time[:, None] / demo.duration)

    demos = [moved(motion(seconds)) for seconds in (3.0, 1.0, 2.0, 4.0)]
    aligned = align(DemonstrationSet(demos))
    for demo in aligned:
        np.testing.assert_array_equal(demo.time, demos[2].time)
        np.testing.assert_allclose(demo.joint_position, demos[2].joint_position, atol=1e-9)
        assert demo.fps == demos[2].fps
    assert aligned[2] is demos[2]


def test_timing_may_differ_by_a_fifth_of_the_duration():
    """A step at a third of one motion and at two thirds of another: too far to be matched."""
    time = np.arange(101) / 100

    def step(at):
        q = np.clip((time - at) * 20, 0, 1)[:, None]
        return Demonstration(time=time, joint_position=q, joint_names=("a",), fps=100)

    for late, matched in ((0.55, True), (0.75, False)):
        demos = [step(0.4), replace(step(late), episode=1)]
        aligned = align(DemonstrationSet(demos))
        apart = np.abs(aligned[1].joint_position - aligned[0].joint_position).max()
        assert (apart < 0.2) == matched
    # Without recorded velocities none are made up.
    assert aligned[1].joint_velocity is None


def test_joints_are_aligned_by_their_own_ranges():
    """A small joint that tells the timing weighs as much as a large one that rests nearly."""
    s = np.linspace(0, 1, 101)
    late = np.interp(s, [0, 0.5, 1], [0, 0.4, 1])

    def demo(phase, size):
        q = np.stack([size * np.sin(2 * np.pi * phase), 5 * (phase > 2)], axis=1)
        return Demonstration(time=s, joint_position=q, joint_names=("a", "b"), fps=100)

    for size in (1.0, 1e-3):
        aligned = align(DemonstrationSet([demo(s, size), demo(late, size)]))
        apart = np.abs(aligned[1].joint_position - aligned[0].joint_position).max()
        assert apart < 0.1 * size


def test_motions_are_compared_by_their_ranges_over_all_of_them():
    time = np.linspace(0, 0.5, 20)
    turns = [turn(time, rate) for rate in (1.0, 2.4, 0.3)]
    np.testing.assert_allclose(_scale("orientation", turns), [1.2], rtol=1e-9)
    np.testing.assert_allclose(_scale("orientation", [-turns[1], turns[0]]), [1.2], rtol=1e-9)
    q = [np.outer(time, [1.0, -2, 0]), np.add(np.outer(time, [1.0, 1, 0]), [3, 0, 0])]
    np.testing.assert_allclose(_scale("joint_position", q), [3.5, 1.5, 1e-9])
