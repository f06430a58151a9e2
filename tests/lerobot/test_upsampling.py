"""Setpoints between actions: the curve, its latency, and limits at the rate of the motors."""

import numpy as np
import pytest
from scipy.interpolate import BSpline

from hrc_learn.lerobot.smoothing import ActionLimits, ActionUpsampler

FPS = 30.0


def limits(width=2, **change):
    values = {
        "names": [f"{i}.pos" for i in range(width)],
        "fps": FPS,
        "velocity": [1.0] * width,
        "acceleration": [4.0] * width,
        "jerk": [60.0] * width,
        "lower": [None] * width,
        "upper": [None] * width,
        "state_columns": list(range(width)),
    }
    return ActionLimits(**values | change)


def gentle(seconds=2.5):
    """Actions that keep the limits, from rest."""
    t = np.arange(round(seconds * FPS)) / FPS
    return np.stack([0.2 * (1 - np.cos(1.5 * t)), 0.1 * (1 - np.cos(2.2 * t))], axis=-1)


def setpoints(upsampler, actions, start):
    upsampler.reset(start)
    return np.concatenate([upsampler.frame(action) for action in actions])


@pytest.mark.parametrize("degree", [1, 2, 3])
@pytest.mark.parametrize("rate", [120.0, 300.0])
def test_gentle_actions_lead_to_the_spline_of_scipy(degree, rate):
    actions, per = gentle(), round(rate / FPS)
    made = setpoints(ActionUpsampler(limits(), rate, degree=degree), actions, actions[0])
    points = np.concatenate([actions[:1].repeat(degree, 0), actions])
    knots = np.arange(len(points) + degree + 1, dtype=float)
    expected = BSpline(knots, points, degree)(degree + np.arange(len(made)) / per)
    # The corners of lines exceed the limits at the rate of the motors.
    np.testing.assert_allclose(made, expected, rtol=0, atol=1e-3 if degree == 1 else 1e-9)


@pytest.mark.parametrize(
    ("degree", "latency"), [(3, None), (3, 1.0), (3, 0.0), (2, 0.5), (1, 0.0)]
)
def test_it_is_as_late_as_it_says(degree, latency):
    rate = 240.0
    upsampler = ActionUpsampler(limits(), rate, degree=degree, latency=latency)
    assert upsampler.latency == ((degree + 1) / 2 if latency is None else latency) / FPS
    speed = 0.3
    ramp = speed * np.arange(60)[:, None] / FPS * np.ones(2)
    made = setpoints(upsampler, ramp, ramp[0])
    t = np.arange(len(made)) / rate
    late = t - made[:, 0] / speed
    np.testing.assert_allclose(late[-100:], upsampler.latency, atol=1e-6)


@pytest.mark.parametrize("rate", [125.0, 1000.0])
@pytest.mark.parametrize("latency", [None, 0.0])
def test_any_actions_are_followed_within_limits(rate, latency):
    rng = np.random.default_rng(1)
    actions = rng.normal(size=(14, 2)).repeat(3, 0)
    actions[25:28] = np.nan
    given = limits(lower=[-1.0, None], upper=[1.0, None])
    made = setpoints(ActionUpsampler(given, rate, latency=latency), actions, np.zeros(2))
    assert np.isfinite(made).all()
    assert np.abs(made[:, 0]).max() <= 1 + 1e-9
    path = np.concatenate([np.zeros((3, 2)), made])
    for limit in (1.0, 4.0, 60.0):
        path = np.diff(path, axis=0) * rate
        assert np.abs(path).max() <= limit * (1 + 1e-5)


def test_several_robots_are_led_as_each_by_itself():
    rng = np.random.default_rng(2)
    actions = rng.normal(size=(12, 3, 2)).repeat(2, 0)
    together = setpoints(ActionUpsampler(limits(), 125.0, latency=1.0), actions, actions[0])
    for k in range(3):
        one = ActionUpsampler(limits(), 125.0, latency=1.0)
        alone = setpoints(one, actions[:, k], actions[0, k])
        np.testing.assert_allclose(together[:, k], alone, rtol=0, atol=1e-12)


def test_rates_that_do_not_divide_keep_time():
    upsampler = ActionUpsampler(limits(), 125.0)
    upsampler.reset(np.zeros(2))
    counts = [len(upsampler.frame(np.zeros(2))) for _ in range(60)]
    assert sum(counts) == 250
    assert set(counts) == {4, 5}


def test_a_motion_whose_actions_stop_comes_to_rest_at_the_last():
    upsampler = ActionUpsampler(limits(), 250.0)
    actions = gentle()[:50]
    setpoints(upsampler, actions, actions[0])
    for _ in range(30):
        upsampler.repeat()
        for k in range(8):
            upsampler.setpoint(k / 8)
    np.testing.assert_allclose(upsampler.position, actions[-1], atol=1e-4)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"rate": 20.0}, "at least the 30 actions a second, got 20"),
        ({"rate": float("inf")}, "at least the 30"),
        ({"rate": 250.0, "degree": 4}, "degree must be 0 to 3, got 4"),
        (
            {"rate": 250.0, "degree": 1, "latency": 1.5},
            "0 to 1 actions for a curve of degree 1",
        ),
        ({"rate": 250.0, "latency": -0.1}, "latency must be 0 to 2"),
    ],
)
def test_settings_that_make_no_path_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        ActionUpsampler(limits(), **arguments)


def test_values_that_do_not_fit_are_refused():
    upsampler = ActionUpsampler(limits(), 250.0)
    with pytest.raises(RuntimeError, match="reset"):
        upsampler.push(np.zeros(2))
    with pytest.raises(ValueError, match=r"given for 0.pos, 1.pos, but .* shape \(3,\)"):
        upsampler.reset(np.zeros(3))
    upsampler.reset(np.zeros(2))
    with pytest.raises(ValueError, match="shape"):
        upsampler.push(np.zeros(1))
