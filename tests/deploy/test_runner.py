"""A loop's pace, on a clock that only moves when it is told to."""

import pytest

from hrc_learn.deploy import Rate


class Clock:
    def __init__(self):
        self.now = 5.0

    def __call__(self) -> float:
        self.now += 1e-6  # looking takes time, or a wait would never end
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += seconds


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def rate(clock) -> Rate:
    return Rate(0.01, clock=clock, sleep=clock.sleep)


def test_it_keeps_the_rate_however_long_the_work_takes(clock, rate):
    for k, work in enumerate([0.001, 0.009, 0.0, 0.005], start=1):
        clock.now += work
        assert rate.wait() < 1e-5
        assert clock.now == pytest.approx(5.0 + 0.01 * k, abs=1e-5)
    assert rate.missed == 0


def test_a_late_loop_catches_up_within_a_period(clock, rate):
    clock.now += 0.013
    assert rate.wait() == pytest.approx(0.003, abs=1e-5)
    rate.wait()
    assert clock.now == pytest.approx(5.02, abs=1e-5)
    assert rate.missed == 0


def test_ticks_a_loop_slept_through_are_counted_not_made_up_for(clock, rate):
    clock.now += 0.045
    assert rate.wait() == pytest.approx(0.005, abs=1e-5)
    assert rate.missed == 3
    rate.wait()
    assert clock.now == pytest.approx(5.05, abs=1e-5)


def test_a_period_of_nothing_is_refused():
    with pytest.raises(ValueError, match="period must be positive, but is 0"):
        Rate(0.0)
