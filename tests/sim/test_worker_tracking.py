"""What a tracker makes of the worker, against the truth and the sizes of its errors."""

from dataclasses import replace

import numpy as np
import pytest

from hrc_learn.protocols import PersonTracker
from hrc_learn.sim import Imperfections, SceneConfig, Worker, WorkerSensor, random_visit

VISIT = random_visit(
    Worker(),
    np.random.default_rng(2),
    bench=SceneConfig().table,
    under=(0.24, 0.54),
    begin=(0.0, 0.0),
)


class Clock:
    def __init__(self):
        self.time = 0.0

    def __call__(self):
        return self.time


def readings(times, seed=0, **sizes):
    clock = Clock()
    sizes = replace(Imperfections.ideal(), **sizes)
    sensor = WorkerSensor(
        VISIT.ends_at, VISIT.worker.radius, clock, sizes, np.random.default_rng(seed)
    )
    assert isinstance(sensor, PersonTracker)
    read = []
    for clock.time in times:
        read.append(sensor.read())
    return read


TICKS = np.arange(0.0, 6.0, 0.01)


def test_an_ideal_tracker_sees_him_where_he_is():
    for time, seen in zip(TICKS[::10], readings(TICKS[::10]), strict=True):
        assert seen.time == pytest.approx(time)
        truth = VISIT.capsules_at(time)
        np.testing.assert_allclose(seen.ends, truth.ends, atol=1e-9)
        np.testing.assert_array_equal(seen.radius, truth.radius)


def test_observations_come_late_and_in_order():
    seen = readings(TICKS, person_delay=0.08)
    assert all(one is None for one in seen[:8])
    ages = np.array([t - one.time for t, one in zip(TICKS, seen, strict=True) if one])
    # Not before the delay, and replaced as soon as the next one has come.
    assert ages.min() >= 0.08 - 1e-6
    assert ages.max() < 0.08 + 1 / 30 + 0.01
    times = [one.time for one in seen if one]
    assert times == sorted(times)


def test_noise_has_the_size_that_was_asked_for():
    seen = {one.time: one for one in readings(TICKS, person_noise=0.01)}
    errors = np.array([one.ends - VISIT.capsules_at(t).ends for t, one in seen.items()])
    assert errors.std() == pytest.approx(0.01, rel=0.02)
    assert np.abs(errors.mean(axis=0)).max() < 0.005
    # From image to image it is new.
    following = (errors[1:] * errors[:-1]).mean() / 0.01**2
    assert abs(following) < 0.03


def test_a_share_of_the_images_is_lost():
    def taken(**sizes):
        return len({one.time for one in readings(TICKS, **sizes)})

    assert taken() == 180
    # Of a binomial distribution, three deviations of 5.4.
    assert taken(person_loss=0.2) == pytest.approx(144, abs=17)


@pytest.mark.parametrize("loss", [0.0, 0.4])
def test_velocities_follow_from_what_was_seen(loss):
    """Those of a constant speed are exact, others late by half of the time they are from."""
    seen = {one.time: one for one in readings(TICKS[::3], person_loss=loss)}
    first, *rest = sorted(seen)
    assert (seen[first].velocity == 0).all()
    for time in rest[5::4]:
        past = max(t for t in seen if t <= time - 0.1 + 1e-9)
        expected = (VISIT.capsules_at(time).ends - VISIT.capsules_at(past).ends) / (time - past)
        np.testing.assert_allclose(seen[time].velocity, expected, atol=1e-9)


def test_noise_of_velocities_is_that_of_two_images_a_tenth_of_a_second_apart():
    late = np.arange(0.0, 6.0, 0.03) + VISIT.end + 1.0
    clock = Clock()
    clock.time = late[0]
    noisy = replace(Imperfections.ideal(), person_noise=0.01)
    radius = VISIT.worker.radius
    sensor = WorkerSensor(VISIT.ends_at, radius, clock, noisy, np.random.default_rng(0))
    velocities = {}
    for clock.time in late:
        seen = sensor.read()
        velocities[seen.time] = seen.velocity
    values = np.array(list(velocities.values())[10:])
    assert values.std() == pytest.approx(0.01 * np.sqrt(2) / 0.1, rel=0.05)


def test_what_is_seen_does_not_depend_on_how_often_one_looks():
    sizes = {"person_noise": 0.01, "person_loss": 0.2, "person_delay": 0.08}
    often, seldom = readings(TICKS, **sizes), readings(TICKS[::7], **sizes)
    for one, other in zip(often[::7], seldom, strict=True):
        assert (one is None) == (other is None)
        if one is not None:
            np.testing.assert_array_equal(one.ends, other.ends)
            np.testing.assert_array_equal(one.velocity, other.velocity)
