"""Positions followed within limits: for certain, without lag, and without overshoot."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hrc_learn.controller.motion_filter import MotionFilter, MotionState

DT = 0.02


def limits(lower=-3.0, upper=3.0, velocity=1.0, acceleration=3.0, jerk=30.0, width=1):
    values = {
        "lower": lower,
        "upper": upper,
        "velocity": velocity,
        "acceleration": acceleration,
        "jerk": jerk,
    }
    return {name: np.full(width, value) for name, value in values.items()}


def worst(path, given, dt=DT):
    """Largest velocity, acceleration and jerk of a path from rest, over their limits."""
    path = np.concatenate([path[:1].repeat(3, 0), path])
    found = []
    for name in ("velocity", "acceleration", "jerk"):
        path = np.diff(path, axis=0) / dt
        found.append(float((np.abs(path) / given[name]).max()))
    return max(found)


def follow(given, asked, dt=DT, start=None):
    """The start, and all positions handed out."""
    smoother = MotionFilter(dt, **given)
    state = MotionState.moving(np.zeros_like(asked[0]) if start is None else start)
    path = [state.position]
    for row in asked:
        state = smoother.step(state, row)
        path.append(state.position)
    return np.stack(path)


def wave(steps):
    """A motion that keeps `limits()`."""
    t = np.arange(1, steps + 1) * DT
    return (0.3 * (1 - np.cos(1.5 * t)))[:, None]


HOSTILE = st.one_of(
    st.floats(-10, 10),
    st.floats(allow_nan=True, allow_infinity=True),
    st.sampled_from([-1e12, 1e12, 0.99, -0.99, 0.0]),
)


@settings(max_examples=60)
@given(
    asked=st.lists(HOSTILE, min_size=1, max_size=60),
    velocity=st.floats(0.05, 50),
    brake_time=st.floats(0.02, 2.0),
    ramp_time=st.floats(0.01, 1.0),
    dt=st.floats(0.001, 0.1),
    repeats=st.integers(1, 8),
)
def test_limits_hold_for_anything(asked, velocity, brake_time, ramp_time, dt, repeats):
    acceleration = velocity / brake_time
    given_limits = limits(-1.0, 1.0, velocity, acceleration, acceleration / ramp_time)
    path = follow(given_limits, np.repeat(asked, repeats)[:, None], dt)
    assert np.isfinite(path).all()
    assert np.abs(path).max() <= 1 + 1e-9
    assert worst(path, given_limits, dt) <= 1 + 1e-5


def test_a_motion_that_keeps_the_limits_comes_out_as_it_went_in():
    motion = wave(120)
    np.testing.assert_allclose(follow(limits(), motion)[1:], motion, rtol=0, atol=1e-12)


@pytest.mark.parametrize(("step", "slope"), [(0.02, 0.0), (0.3, 0.4), (-1.0, 0.4), (0.3, 0.0)])
def test_a_step_is_blended_without_overshoot(step, slope):
    asked = wave(260)
    seam = np.arange(1, 201)[:, None] * DT
    asked[60:] += step + slope * seam.clip(max=1.0)
    path = follow(limits(), asked)
    assert worst(path, limits()) <= 1 + 1e-6
    assert worst(np.concatenate([np.zeros((1, 1)), asked]), limits()) > 100
    left = (path[1:] - asked)[60:110] * -np.sign(step)
    assert left.min() > -2e-3  # does not pass it by
    np.testing.assert_allclose(path[-50:], asked[-50:], rtol=0, atol=2e-4)


def test_a_step_settles_nearly_as_fast_as_can_be():
    """Against the shortest time from rest to rest at any speed, 2 sqrt(d/A) + A/j."""
    given_limits = limits(velocity=10.0, acceleration=3.0, jerk=60.0)
    for distance in (0.3, 0.8):
        path = follow(given_limits, np.full((150, 1), distance))[1:]
        arrived = DT * int((np.abs(path - distance) > 1e-3).sum())
        shortest = 2 * (distance / 3.0) ** 0.5 + 3.0 / 60.0
        assert shortest < arrived + 2 * DT
        assert arrived < 1.6 * shortest


def test_noise_is_followed_as_far_as_the_limits_let_it():
    noise = 3e-4 * np.random.default_rng(0).normal(size=(250, 1))
    path = follow(limits(), wave(250) + noise)
    assert worst(path, limits()) <= 1 + 1e-6
    assert np.abs(path[1:] - wave(250)).max() < 5e-3


def test_batches_and_values_are_followed_one_by_one():
    given_limits = limits(width=3)
    given_limits["velocity"] = np.array([0.5, 1.0, 2.0])
    asked = np.random.default_rng(1).normal(size=(12, 2, 3))
    together = follow(given_limits, asked)
    for b, j in np.ndindex(2, 3):
        own = {name: values[j : j + 1] for name, values in given_limits.items()}
        alone = follow(own, asked[:, b, j : j + 1])
        np.testing.assert_allclose(together[:, b, j], alone[:, 0], rtol=0, atol=1e-12)


def test_what_is_not_finite_is_taken_for_what_came_before():
    broken, mended = wave(10), wave(10)
    broken[3:5], mended[3:5] = [[np.nan], [np.inf]], mended[2]
    np.testing.assert_array_equal(follow(limits(), broken), follow(limits(), mended))


@pytest.mark.parametrize("dt", [0.001, 0.1])
def test_it_can_stop_within_a_tenth_of_the_range_and_gives_up_no_more(dt):
    """The larger of both terms of the way that braking from rest takes is half of that."""
    j = np.logspace(0, 4, 40)
    given_limits = limits(-1.0, 2.0, 1.0, 15.0, width=40) | {"jerk": j}
    used = MotionFilter(dt, **given_limits).acceleration
    way = np.maximum(used**3 / (8 * j**2), used**2 * dt / (2 * j))
    lowered = used < 15.0
    assert lowered.any()
    assert not lowered.all()
    np.testing.assert_allclose(way[lowered], 3.0 / 20)


def test_a_start_that_is_not_finite_is_refused():
    for start in ([np.nan], [0.0, np.inf], [0.0, 0.0, -np.inf]):
        with pytest.raises(ValueError, match="finite position, velocity and acceleration"):
            MotionState.moving(*(np.array([0.0, value]) for value in start))


@pytest.mark.parametrize("dt", [0.0, float("inf"), float("nan")])
def test_dt_must_be_positive(dt):
    with pytest.raises(ValueError, match="dt must be positive"):
        MotionFilter(dt, **limits())


@pytest.mark.parametrize("side", [1, -1])
def test_a_push_against_a_limit_ends_where_braking_from_rest_needs_the_way(side):
    """A^3/(8 j^2) + A^2 dt/(2 j) before the limit."""
    given_limits = limits(-0.2, 0.3, 1.0, 3.0, 12.0)
    motion = MotionFilter(DT, **given_limits)
    A, j = float(motion.acceleration[0]), 12.0
    path = follow(given_limits, np.full((200, 1), side * 9.0))
    wall = 0.3 if side > 0 else 0.2
    expected = wall - (A**3 / (8 * j**2) + A**2 * DT / (2 * j))
    assert side * path[-1, 0] == pytest.approx(expected, rel=1e-3)


def test_small_errors_decay_at_the_rate_of_the_weakest_limit():
    """Jerk over acceleration, but no faster than a third of the sampling rate."""
    ratios = []
    for jerk, step in ((6.0, 1e-3), (300.0, 3e-3)):
        error = step - follow(limits(jerk=jerk), np.full((60, 1), step))[:, 0]
        ratios.append((error[1:] / error[:-1])[8:40])
    np.testing.assert_allclose(ratios[0], 1 / (1 + 6.0 / 3.0 * DT), rtol=1e-3)
    assert 0.7 < ratios[1].min() <= ratios[1].max() < 0.8


def test_a_motion_under_way_goes_on_from_its_velocity_and_acceleration():
    """A parabola within the limits, begun at its second sample."""
    t = np.arange(40) * DT
    asked = (0.1 + 0.3 * t - 0.2 * t**2)[:, None]
    v = np.diff(asked, axis=0) / DT
    a = np.diff(v, axis=0) / DT
    state = MotionState.moving(asked[2], v[1], a[0])
    np.testing.assert_array_equal(state.reference_velocity, v[1])
    motion = MotionFilter(DT, **limits())
    for row in asked[3:]:
        before, state = state, motion.step(state, row)
        assert np.abs(state.acceleration - before.acceleration) <= 30 * DT * (1 + 1e-9)
        np.testing.assert_allclose(state.position, row, rtol=0, atol=2e-3)
    np.testing.assert_allclose(state.velocity, v[-1], rtol=0, atol=2e-3)
