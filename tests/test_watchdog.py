"""The watchdog in its thread, and faults of the stop that it calls."""

import threading
import time
from itertools import pairwise

import pytest

from hrc_learn.watchdog import Watchdog, WatchdogError, bring_to_rest


class Clock:
    """Time that passes when told to."""

    now = 0.0

    def __call__(self) -> float:
        return self.now


def test_it_stops_a_silent_loop_once_and_watches_again_when_fed():
    clock, stops = Clock(), []
    dog = Watchdog(0.1, lambda: stops.append(clock.now), clock=clock)
    assert not dog.check()  # not fed yet: nothing moves
    for clock.now in (0.0, 0.09, 0.18):
        dog.feed()
        assert not dog.check()
    clock.now = 0.29
    assert dog.check()
    clock.now = 5.0
    assert not dog.check()
    dog.feed()
    clock.now = 5.2
    assert dog.check()
    assert stops == [0.29, 5.2]
    assert dog.trips == 2


def test_its_thread_notices_a_loop_that_hangs():
    stopped = threading.Event()
    with Watchdog(0.01, stopped.set) as dog:
        assert stopped.wait(timeout=600)
    assert dog.trips == 1


def test_one_that_has_not_begun_may_be_closed():
    Watchdog(1.0, lambda: None).close()


@pytest.mark.parametrize("timeout", [0.0, float("nan"), float("inf"), 1e12])
def test_a_timeout_must_be_positive_and_finite(timeout):
    with pytest.raises(ValueError, match="timeout must be positive and finite"):
        Watchdog(timeout, lambda: None)


def test_its_thread_looks_often_enough():
    """A silence is noticed at most a quarter of the timeout late."""
    clock, stops = Clock(), []

    class Waiting:
        """Lets time pass as fast as the thread waits."""

        def wait(self, duration: float) -> bool:
            clock.now += duration
            return clock.now > 2.0

    dog = Watchdog(0.1, lambda: stops.append(clock.now), clock=clock)
    dog.feed()
    dog._done = Waiting()
    dog._watch()
    assert len(stops) == 1
    assert 0.1 < stops[0] <= 0.125 + 1e-9


class Stop:
    """Raises so many times, then works."""

    def __init__(self, failing: float, error: BaseException | None = None, clock=None):
        self.failing, self.error = failing, error or OSError("the control box is offline")
        self.clock, self.tried, self.worked = clock, [], threading.Event()

    def __call__(self) -> None:
        self.tried.append(self.clock() if self.clock else 0.0)
        if len(self.tried) <= self.failing:
            raise self.error
        self.worked.set()


@pytest.mark.parametrize("error", [OSError("offline"), SystemExit(1), RuntimeError()])
def test_its_thread_survives_stops_that_raise(error):
    stop = Stop(4, error)
    with Watchdog(0.01, stop) as dog:
        assert stop.worked.wait(timeout=60)
        stop.failing, first = 6, dog.trips
        dog.feed()
        stop.worked.clear()
        assert stop.worked.wait(timeout=60)  # it watches on
        assert dog.trips > first
        assert len(stop.tried) == 7


def test_it_tries_on_with_growing_pauses_and_for_ever():
    clock = Clock()
    stop = Stop(float("inf"), clock=clock)
    dog = Watchdog(0.1, stop, clock=clock)
    dog.feed()
    while clock.now < 600:
        clock.now += 0.005
        dog.check()
    tried = stop.tried
    pauses = [b - a for a, b in pairwise(tried)]
    assert 0.1 < tried[0] <= 0.105 + 1e-9
    assert pauses[:6] == pytest.approx([0.02, 0.04, 0.08, 0.16, 0.32, 0.64], abs=0.006)
    assert max(pauses) < 1.01
    assert len(tried) > 590
    assert dog.trips == 1
    dog.feed()  # the loop is back: there is nothing to stop any more
    for _ in range(15):
        clock.now += 0.005
        assert not dog.check()


def test_failures_are_reported_and_a_report_that_fails_changes_nothing(capsys, monkeypatch):
    clock = Clock()
    dog = Watchdog(0.1, Stop(3), clock=clock)
    dog.feed()
    for _ in range(500):
        clock.now += 0.01
        dog.check()
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 2  # the first and the second; then the fourth, the eighth, ...
    assert "stop failed 1 times, retrying: OSError('the control box is offline')" in lines[0]
    monkeypatch.setattr("sys.stderr", None)
    monkeypatch.setattr("builtins.print", Stop(float("inf"), BrokenPipeError()))
    stop = Stop(3)
    with Watchdog(0.01, stop):
        assert stop.worked.wait(timeout=60)


def test_a_loop_learns_that_the_thread_has_ended():
    with Watchdog(5.0, Stop(0)) as dog:
        dog.feed()
        dog._done.set()
        dog._thread.join(60)
        with pytest.raises(WatchdogError, match="thread has ended"):
            dog.feed()


def test_a_loop_learns_that_a_stop_hangs_and_can_still_leave():
    hanging, free = threading.Event(), threading.Event()

    def stop() -> None:
        hanging.set()
        free.wait(60)

    began = time.monotonic()
    with Watchdog(0.02, stop) as dog:
        assert hanging.wait(60)
        time.sleep(0.05)
        with pytest.raises(WatchdogError, match="stop has not returned"):
            dog.feed()
    assert time.monotonic() - began < 30
    free.set()


def test_a_loop_that_raises_leaves_the_arm_at_rest():
    stop = Stop(2)
    with pytest.raises(ZeroDivisionError), Watchdog(60.0, stop):
        raise ZeroDivisionError
    assert stop.worked.is_set()
    stop = Stop(0)
    with Watchdog(60.0, stop) as dog:
        dog.feed()
    assert not stop.tried


def test_bringing_to_rest_gives_up_when_its_patience_ends():
    assert bring_to_rest(Stop(3), 10.0)
    stop = Stop(float("inf"))
    began = time.monotonic()
    assert not bring_to_rest(stop, 0.3)
    assert 0.1 < time.monotonic() - began < 5
    assert len(stop.tried) == 4  # after 0, 0.02, 0.06, 0.14 s; the next would be after 0.30
