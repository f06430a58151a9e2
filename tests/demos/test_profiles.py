"""Statistics of columns and of commands, against NumPy and motions known in closed form."""

from itertools import groupby

import numpy as np
import pytest
from scipy.stats import linregress

from hrc_learn.demos.read import profiles as read_profiles
from hrc_learn.demos.read.dataset_folder import EpisodeEntry
from hrc_learn.demos.read.profiles import (
    FeatureProfiles,
    Tracking,
    gain_over,
    is_discrete,
    listed,
    profile_columns,
    track,
    track_quantities,
)

pytestmark = pytest.mark.simulation


def profile(values):
    return profile_columns({"a": np.asarray(values, float)})["a"]


@pytest.mark.parametrize("frames", [1, 2, 3, 4, 7, 8, 19, 20, 24, 201])
def test_a_profile_is_made_of_quantiles_differences_and_counts(frames):
    """Every statistic is found once more, by sorting or by counting one value at a time."""
    rng = np.random.default_rng(frames)
    values = np.round(rng.normal(size=(frames, 3)) * [1, 1, 0.4], 1)
    got = profile(values)
    steps = abs(np.diff(values, axis=0)) if frames > 1 else np.zeros((1, 3))
    bends = abs(np.diff(values, 2, axis=0)) if frames > 2 else np.zeros((1, 3))
    few = max(1, min(5, frames // 4))
    near = np.quantile(values, (0.005, 0.05, 0.5, 0.95, 0.995), axis=0, method="nearest")
    np.testing.assert_array_equal(got.levels, near)
    np.testing.assert_allclose(got.start, np.median(values[:few], axis=0))
    np.testing.assert_allclose(got.goal, np.median(values[-few:], axis=0))
    at = min(len(steps) - 1, int(0.99 * len(steps)))
    np.testing.assert_array_equal(got.step, np.sort(steps, axis=0)[at])
    np.testing.assert_allclose(got.noise, np.median(bends, axis=0))
    np.testing.assert_allclose(got.flat, (steps == 0).mean(0))
    for i, column in enumerate(values.T):
        assert got.held[i] == max(len([*same]) for _, same in groupby(column))
        assert got.distinct[i] == len({*column})
        assert got.at_ends[:, i].tolist() == [sum(column == f(column)) for f in (min, max)]
    np.testing.assert_array_equal(got.low, values.min(0))
    np.testing.assert_array_equal(got.high, values.max(0))
    np.testing.assert_array_equal(got.peak, abs(near[[0, 4]]).max(0))
    np.testing.assert_array_equal(got.span, near[4] - near[0])


def test_profiles_are_made_of_finite_numbers_that_are_no_index():
    ok = {
        "a": np.ones((3, 1), np.float32),
        "b": np.ones((3, 1), bool),
        "c": np.ones((3, 1), np.int8),
    }
    not_ok = {
        "frame_index": np.ones((3, 1)),
        "empty": np.ones((0, 1)),
        "text": np.array([["x"]]),
        "nan": np.array([[0.0], [np.nan]]),
    }
    assert [*profile_columns(ok | not_ok)] == ["a", "b", "c"]


def levels(count, frames, flat=0.0):
    """A column of so many levels, that rests for a fraction of its steps."""
    rising = np.arange(frames) * count // frames if flat else np.arange(frames) % count
    return np.asarray(rising, float)[:, None]


@pytest.mark.parametrize(
    ("column", "discrete"),
    [
        (levels(4, 40), True),
        (levels(5, 40), False),
        (levels(5, 100), True),
        (levels(6, 100), False),
        (levels(12, 600), True),
        (levels(13, 600), False),
        # Rests for most of the time, and jumps by more than a fifth of the range.
        (np.repeat(np.tile([0.0, 0.3, 0.6, 1.0], 5), 12)[:, None], True),
    ],
)
def test_few_levels_make_a_switch(column, discrete):
    assert is_discrete(profile(column), len(column)).tolist() == [discrete]


@pytest.mark.parametrize(
    ("hold", "jump", "count", "discrete"),
    [(20, 1.0, 20, True), (9, 1.0, 20, False), (20, 0.15, 20, False), (20, 1.0, 52, False)],
)
def test_a_column_that_rests_and_jumps_far_switches(hold, jump, count, discrete):
    """Slightly different levels, of which every other is `jump` away, of a range of 1."""
    base = np.linspace(0, 0.05, count) + jump * (np.arange(count) % 2)
    base[-1], base[0] = (1, 0) if jump < 1 else (base[-1], base[0])
    column = np.repeat(base, hold)[:, None]
    made = profile(column)
    assert made.distinct[0] == count
    assert is_discrete(made, 100).tolist() == [discrete]


def features(columns, lengths=None):
    """Profiles of one feature in several episodes."""
    profiles = [profile(values) for values in columns]
    lengths = lengths or [len(values) for values in columns]
    entries = [
        EpisodeEntry(index=10 + k, length=n, tasks=(), file="f.parquet", start=0)
        for k, n in enumerate(lengths)
    ]
    width = len(profiles[0].start)
    names = [f"c{i}" for i in range(width)]
    return FeatureProfiles(
        key="a",
        fps=50.0,
        entries=entries,
        profiles=profiles,
        names=names,
        smooth=np.ones(width),
    )


def test_profiles_of_a_feature_over_episodes():
    feature = features([np.array([[1.0, 2], [1, 2]]), np.array([[1.0, 3], [1, 3], [1, 3]])])
    assert feature.constant.tolist() == [True, False]
    assert feature.lengths.tolist() == [2, 3]
    assert feature.stack("low").tolist() == [[1, 2], [1, 3]]
    assert feature.median("low").tolist() == [1, 2.5]
    assert feature.named(np.array([True, False])) == "c0"
    assert feature.named(np.array([True, True])) == "all components"
    assert features([np.ones((2, 1))]).named(np.array([True])) == "c0"
    issue = feature.issue(1, "odd", [1], 2.5, "error")
    assert (issue.episode, issue.key, issue.components) == (11, "a", ("c1",))
    assert (issue.severity, issue.level, issue.message) == (2.5, "error", "odd")
    assert (feature.issue(0, "odd", [0]).severity, feature.issue(0, "", []).level) == (
        0,
        "warning",
    )
    assert listed("abcdefgh", [7, 0, 1, 2, 3, 4, 5]) == "h, a, b, c, d, e"


def motion(frames, phase=0.0, speed=1.0):
    t = np.arange(frames)[:, None] / 50 + phase
    return np.sin(speed * t * [1.7, 2.9, 4.1]) + 0.3 * np.cos(speed * 5.3 * t + [0, 1, 2])


def delayed(delay, frames=200, gain=(1.0, -2.0, 0.5)):
    """A command, and the state that follows it by some frames and gains."""
    whole = motion(frames + 2 * abs(delay))
    first = abs(delay)
    command = whole[first : first + frames]
    return command, whole[first - delay : first - delay + frames] * gain + [0.1, 0.2, 0.3]


@pytest.mark.parametrize("delay", [-5, -1, 0, 1, 7, 30])
def test_delay_gain_and_fit_of_a_state_behind_its_command(delay):
    command, state = delayed(delay, gain=(1.0, 2.0, 0.5))
    found = track(command, state, 50)
    assert found.delay == delay
    np.testing.assert_allclose(found.slope, [1, 2, 0.5], rtol=1e-9)
    np.testing.assert_allclose(found.fit, 1, rtol=1e-9)
    # From -reach to reach frames, of at most a quarter of the episode.
    assert len(found.residual) == 2 * 50 + 1
    assert found.residual.argmin() == 50 + delay
    assert found.residual.min() == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize("delay", [0, 4, -3])
def test_slope_and_fit_are_those_of_a_linear_regression(delay):
    rng = np.random.default_rng(1)
    command, state = delayed(delay, gain=(1.0, 2.0, 0.5))
    state = state + 0.1 * rng.normal(size=state.shape)
    state[:, 2] = 0.7  # rests
    found = track(command, state, 50)
    assert found.delay == delay
    n = len(state)
    a, s = (
        command[max(-delay, 0) : n - max(delay, 0)],
        state[max(delay, 0) : n - max(-delay, 0)],
    )
    for i in range(2):
        line = linregress(a[:, i], s[:, i])
        assert found.slope[i] == pytest.approx(line.slope)
        assert found.fit[i] == pytest.approx(line.rvalue**2)
    assert np.isnan(found.slope[2])
    assert np.isnan(found.fit[2])


def test_residuals_are_variances_that_a_correlation_leaves():
    rng = np.random.default_rng(2)
    command, state = delayed(3, frames=120, gain=(1.0, 1.0, 1.0))
    state = state + 0.2 * rng.normal(size=state.shape)
    found = track(command, state, 16)  # 24 frames of delay at most
    reach = 24
    assert len(found.residual) == 49
    for delay in (-24, -7, 0, 3, 11, 24):
        inner = slice(reach, 120 - reach)
        moved = slice(reach - delay, 120 - reach - delay)
        r = [np.corrcoef(command[moved, i], state[inner, i])[0, 1] for i in range(3)]
        expected = np.mean(1 - np.maximum(r, 0) ** 2)
        assert found.residual[reach + delay] == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize(
    ("frames", "fps", "reach"), [(20, 50, 5), (19, 50, None), (400, 50, 75), (400, 20, 30)]
)
def test_delays_are_sought_to_1_5_s_and_a_quarter_of_the_episode(frames, fps, reach):
    command, state = delayed(1, frames=frames, gain=(1.0, 1.0, 1.0))
    found = track(command, state, fps)
    assert (found is None) == (reach is None)
    assert found is None or len(found.residual) == 2 * reach + 1
    assert track(command, state, 0.1) is None


def test_components_that_do_not_follow_leave_the_delay_alone():
    command, state = delayed(6, gain=(1.0, 1.0, 1.0))
    state[:, 2] = np.random.default_rng(0).normal(size=200)
    found = track(command, state, 50)
    assert found.delay == 6
    assert (found.fit > 0.8).tolist() == [True, True, False]
    assert found.residual.min() == pytest.approx(0, abs=1e-6)


def test_nothing_moves():
    command, state = delayed(0)
    assert track(np.ones_like(command), state, 50) is None
    assert track(command, np.ones_like(state), 50) is None
    # Rounding of large values is no motion.
    assert track(command, 1e6 + 1e-4 * state, 50) is None
    assert track(command, 1e6 + 1e-1 * state, 50) is not None


def test_a_command_that_rests_in_a_window_explains_nothing_there():
    command = np.zeros((100, 1))
    command[:30, 0] = np.linspace(0, 1, 30)
    command[30:] = 1
    state = np.zeros((100, 1))
    state[5:] = command[:-5]
    found = track(command, state, 10)
    # At a lead of 15 frames the command is at rest in the window that is compared.
    assert found.residual[0] == pytest.approx(1)
    assert found.delay == 5


def test_long_episodes_are_judged_by_their_middle():
    command, state = delayed(0, frames=4200, gain=(1.0, 1.0, 1.0))
    state[:100] = command[:100] * -1
    state[4100:] = 0
    found = track(command, state, 20)
    np.testing.assert_allclose(found.fit, 1)
    state[100] += 9
    assert track(command, state, 20).fit.min() < 1 - 1e-6


def resting(count, offset=0.2, move=1.0):
    """A command at rest for so many steps of five frames, and a state some way behind it."""
    ramp = np.r_[np.linspace(0, move, 80), np.full(count + 4, move)]
    return (ramp + offset)[:, None], ramp[:, None]


@pytest.mark.parametrize("offset", [0.2, -0.1])
def test_the_offset_is_that_at_rest_of_five_frames_at_least(offset):
    command, state = resting(20, offset)
    state[:80] -= 0.05  # behind while it moves
    state[80:84] = state[84]
    assert track(command, state, 50).offset[0] == pytest.approx(offset)
    for count, known in ((4, False), (5, True)):
        found = track(*resting(count, offset), 50).offset[0]
        assert np.isfinite(found) == known
        assert not known or found == pytest.approx(offset)


def test_the_offset_is_the_median_over_the_frames_at_rest():
    command, state = resting(20)
    gaps = 0.2 + 1e-3 * np.random.default_rng(0).normal(size=20)
    for count in (19, 20):
        c, s = command[: 84 + count].copy(), state[: 84 + count]
        c[84:, 0] = 1 + gaps[:count]
        assert track(c, s, 50).offset[0] == pytest.approx(np.median(gaps[:count]))


@pytest.mark.parametrize(("creep", "at_rest"), [(0.0045, True), (0.0055, False)])
def test_half_a_percent_of_the_range_in_five_frames_is_no_rest(creep, at_rest):
    command, state = resting(30)
    for moved in (state, command):
        slow = moved.copy()
        slow[80:, 0] = slow[79, 0] + creep / 5 * np.arange(1, 35)
        pair = (command, slow) if moved is state else (slow, state)
        assert np.isfinite(read_profiles._resting_offset(*pair)[0]) == at_rest


@pytest.mark.parametrize(("slope", "known"), [(1.0, True), (0.99, True), (0.97, False)])
def test_a_copy_that_never_rests_shows_its_offset(slope, known):
    command = (np.linspace(0, 2, 200) + 0.1 * np.sin(np.arange(200) / 20))[:, None]
    state = slope * command - 0.3
    offset = track(command, state, 50).offset[0]
    assert np.isfinite(offset) == known
    assert not known or offset == pytest.approx(0.3, abs=0.02)


def tracking(residual):
    none = np.zeros(1)
    values = np.asarray(residual, np.float32)
    return Tracking(delay=0, residual=values, slope=none, fit=none, offset=none)


@pytest.mark.parametrize(
    ("delay", "gain"), [(0, 0.98), (1, 0.5), (-1, 0.0), (2, 0.95), (9, 0.95), (-9, 0.9)]
)
def test_gain_of_the_own_delay_over_another(delay, gain):
    """One hundredth of the variance is negligible; delays beyond the ends count as the ends."""
    given = tracking([0.1, 0.01, 0.5, 0.02, 0.2])
    assert gain_over(given, delay) == pytest.approx(gain, abs=1e-6)


def test_commands_are_compared_with_joints_and_velocities_with_rates():
    joints = motion(200)
    rates = np.gradient(joints, axis=0) * 50
    late = np.roll(rates, -4, axis=0)
    late[-4:] = rates[-1]
    found = track_quantities({"joint_position": joints, "command_velocity": late}, 50)
    assert [*found] == ["command_velocity"]
    np.testing.assert_allclose(found["command_velocity"].slope, 1, atol=0.1)
    assert found["command_velocity"].delay == 4
    # Within 0.2 s the joints follow at once; later the rates are compared, too.
    for delay, names in (
        (10, ["command_position"]),
        (11, ["command_position", "rates"]),
        (-10, ["command_position"]),
        (-11, ["command_position", "rates"]),
    ):
        command, state = delayed(delay, gain=(1.0, 1.0, 1.0))
        given = {"joint_position": state, "command_position": command}
        assert [*track_quantities(given, 50)] == names
    given["command_position"] = command[:, :2]
    given["command_velocity"] = command[:, :2]
    assert track_quantities(given, 50) == {}
    assert track_quantities({"command_position": command}, 50) == {}
    few = {"joint_position": joints[:2], "command_position": joints[:2]}
    assert track_quantities(few, 50) == {}


def test_a_joint_that_rests_or_does_not_follow():
    command, state = delayed(2, gain=(1.0, 1.0, 1.0))
    state[:, 1] = 0.4
    given = {"joint_position": state, "command_position": command}
    assert [*track_quantities(given, 50)] == ["command_position"]
    state[:, 1] = motion(200, 17.3)[:, 1]
    assert [*track_quantities(given, 50)] == ["command_position", "rates"]


@pytest.mark.parametrize(("fps", "window"), [(10, 2), (20, 4), (50, 10), (5, 2)])
def test_rates_are_means_over_a_fifth_of_a_second(fps, window):
    """Noise of the commanded velocity is averaged over as many frames as the joints' rate."""
    rng = np.random.default_rng(fps)
    joints = motion(300)[:, :1]
    velocity = np.diff(joints, axis=0, append=joints[-1:]) * fps
    velocity += 2 * velocity.std() * rng.normal(size=velocity.shape)
    rate = (joints[window:] - joints[:-window])[:, 0] * fps / window
    mean = np.convolve(velocity[:, 0], np.full(window, 1 / window), "valid")[: len(rate)]
    given = {"joint_position": joints, "command_velocity": velocity}
    found = track_quantities(given, fps)["command_velocity"]
    late = found.delay
    pairs = (
        mean[max(-late, 0) : len(mean) - max(late, 0)],
        rate[max(late, 0) :][: len(mean) + late],
    )
    expected = linregress(pairs[0], pairs[1][: len(pairs[0])])
    np.testing.assert_allclose(found.slope, expected.slope)
    np.testing.assert_allclose(found.fit, expected.rvalue**2)
