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
    assert rate.wait() == pytest.approx(0.035, abs=1e-5)  # the first one was due at 0.010
    assert (rate.ticks, rate.missed) == (1, 3)
    rate.wait()
    assert clock.now == pytest.approx(5.05, abs=1e-5)
    assert rate.latest == pytest.approx(0.035, abs=1e-5)


@pytest.mark.parametrize("work", [0.004, 0.0199, 0.0299, 0.0421])
def test_lateness_and_missed_ticks_are_those_of_an_independent_log(clock, rate, work):
    """A loop whose work takes as long each time, against the due times of all its ticks."""
    due, returned = [5.0 + 0.01 * k for k in range(1, 400)], []
    lateness = []
    for _ in range(60):
        clock.now += work
        lateness.append(rate.wait())
        returned.append(clock.now)
    # Each return serves the newest tick that was due; it is late for the oldest not yet served.
    served = [max(t for t in due if t <= now) for now in returned]
    owed = [min(t for t in due if t > last) for last in [5.0, *served[:-1]]]
    expected = [now - t for now, t in zip(returned, owed, strict=True)]
    assert lateness == pytest.approx(expected, abs=1e-5)
    passed = sum(t <= returned[-1] for t in due)
    assert rate.missed == passed - 60
    assert rate.missed / (rate.ticks + rate.missed) == pytest.approx(1 - 60 / passed)
    assert rate.latest == max(lateness)


@pytest.mark.parametrize("step", [0.0025, 0.004, 0.01])
def test_a_clock_that_advances_in_steps_is_asked_now_and_then(clock, step):
    """As the time of an arm's newest state, which another process is asked for."""
    asked = []

    def stepped() -> float:
        asked.append(clock())
        return 5.0 + step * int((asked[-1] - 5.0) / step)

    rate = Rate(0.01, clock=stepped, sleep=clock.sleep)
    for k in range(1, 101):
        rate.wait()
        # The first state at or after the tick is met within a fifth of a millisecond.
        due = 5.0 + step * -(-10 * k // (1000 * step))
        assert due <= asked[-1] < due + 3e-4
    assert (rate.ticks, rate.missed) == (100, 0)
    assert len(asked) < 101 * 60


def test_a_period_of_nothing_is_refused():
    with pytest.raises(ValueError, match="period must be positive, but is 0"):
        Rate(0.0)
