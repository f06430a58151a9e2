import threading

import pytest
import torch

from hrc_learn.controller import Watchdog
from hrc_learn.controller.monitors import LimitMonitor
from hrc_learn.kinematics import panda

LIMITS, DT = panda.limits, 0.001


def test_each_limit_is_seen_by_itself():
    """A motion of joint 1 that breaks one limit after the other."""
    q = panda.ready.clone()
    monitor = LimitMonitor(LIMITS, torch.zeros(7).double(), DT)

    def violations(velocity: float, position: float = 0.0) -> list[bool]:
        q[0] = position
        return monitor.violations(q, velocity * torch.eye(7).double()[0]).tolist()

    assert violations(0.007) == [False] * 4  # 7 rad/s^2, at 7000 rad/s^3
    assert violations(0.014) == [False] * 4
    assert violations(0.014, position=2.9) == [True, False, False, False]
    assert violations(0.014 + 0.0076) == [False, False, False, True]
    assert violations(0.014 + 0.0076 + 0.0152) == [False, False, True, True]
    assert violations(3.0)[1]


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
    assert dog.tripped
    clock.now = 5.0
    assert not dog.check()
    dog.feed()
    assert not dog.tripped
    clock.now = 5.2
    assert dog.check()
    assert stops == [0.29, 5.2]
    assert dog.trips == 2


def test_its_thread_notices_a_loop_that_hangs():
    stopped = threading.Event()
    with Watchdog(0.01, stopped.set) as dog:
        assert stopped.wait(timeout=600)
    assert dog.trips == 1


def test_a_timeout_must_be_positive():
    with pytest.raises(ValueError, match="timeout must be positive"):
        Watchdog(0.0, lambda: None)


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
