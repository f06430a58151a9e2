"""Positions followed within limits in NumPy, against the same in PyTorch and by themselves."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from hrc_learn.controller import ActionChunkFilter
from hrc_learn.kinematics import MotionLimits, panda
from hrc_learn.lerobot.smoothing import ActionLimits
from hrc_learn.lerobot.smoothing.motion_filter import MotionFilter, MotionState


def limits(width=1, **change):
    values = {
        "names": [f"{i}.pos" for i in range(width)],
        "fps": 30.0,
        "velocity": [1.0] * width,
        "acceleration": [4.0] * width,
        "jerk": [60.0] * width,
        "lower": [-1.0] * width,
        "upper": [1.0] * width,
        "state_columns": list(range(width)),
    }
    return ActionLimits(**values | change)


def shares(path, given, rate):
    """Largest velocity, acceleration and jerk of a path from rest, over their limits."""
    path = np.concatenate([path[:1].repeat(3, 0), path])
    found = []
    for limit in (given.velocity, given.acceleration, given.jerk):
        path = np.diff(path, axis=0) * rate
        found.append(float((np.abs(path) / limit).max()))
    return found


def follow(smoother, asked, start):
    state, path = MotionState.moving(start), [start]
    for row in asked:
        state = smoother.step(state, row)
        path.append(state.position)
    return np.stack(path)


@pytest.mark.parametrize("dt", [0.001, 0.004, 0.05])
def test_it_is_the_filter_of_chunks(dt):
    """Steps, noise and NaN, over limits of position, for two robots at once."""
    rng = np.random.default_rng(0)
    start = panda.ready.numpy() + rng.uniform(-0.1, 0.1, (2, 7))
    asked = start[:, None] + 2.0 * rng.normal(size=(2, 6, 7)).repeat(25, axis=1)
    asked += 1e-3 * rng.normal(size=asked.shape)
    asked[0, 40:44, 2] = np.nan
    bounds = {k: getattr(panda.limits, k) for k in vars(limits()) if hasattr(panda.limits, k)}
    ours = MotionFilter(limits(7, **{k: v.tolist() for k, v in bounds.items()}), dt)
    oracle = ActionChunkFilter(MotionLimits(**bounds), dt)
    expected, _, report = oracle(
        torch.from_numpy(asked), oracle.initial_state(torch.from_numpy(start))
    )
    state, path = MotionState.moving(start), []
    valid = np.where(np.isnan(asked), asked[:, 39:40], asked)
    np.testing.assert_array_equal(ours.broken(state, valid), report.broken.numpy())
    assert report.broken.any(dim=1).all()
    for k in range(asked.shape[1]):
        state = ours.step(state, asked[:, k])
        path.append(state.position)
    np.testing.assert_allclose(np.stack(path, 1), expected.numpy(), rtol=0, atol=1e-9)


HOSTILE = st.one_of(
    st.floats(-10, 10),
    st.floats(allow_nan=True, allow_infinity=True),
    st.sampled_from([-1e12, 1e12, 0.99, -0.99, 0.0]),
)


@settings(max_examples=60, deadline=None)
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
    given_limits = limits(
        velocity=[velocity], acceleration=[acceleration], jerk=[acceleration / ramp_time]
    )
    smoother = MotionFilter(given_limits, dt)
    path = follow(smoother, np.repeat(asked, repeats)[:, None], np.zeros(1))
    assert np.isfinite(path).all()
    assert np.abs(path).max() <= 1 + 1e-9
    assert max(shares(path, given_limits, 1 / dt)) <= 1 + 1e-5


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"jerk": [0.0]}, "limit of jerk of 0.pos must be positive"),
        ({"velocity": [float("nan")]}, "limit of velocity of 0.pos"),
        ({"velocity": [1.0, 1.0]}, "velocity must have one entry for each of 0.pos"),
        ({"lower": [2.0]}, "the lowest position of 0.pos, 2, must be below the highest, 1"),
        ({"fps": 0.0}, "fps must be positive"),
    ],
)
def test_limits_that_make_no_sense_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        limits(**change)


def test_a_start_that_is_not_finite_is_refused():
    with pytest.raises(ValueError, match="finite position"):
        MotionState.moving(np.array([0.0, np.nan]))


@pytest.mark.parametrize("dt", [0.0, float("inf"), float("nan")])
def test_dt_must_be_positive(dt):
    with pytest.raises(ValueError, match="dt must be positive"):
        MotionFilter(limits(), dt)
