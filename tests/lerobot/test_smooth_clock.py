"""A smooth robot in its own time, by a clock that is the test's."""

import threading
from types import SimpleNamespace

import numpy as np
import pytest
from lerobot.robots import make_robot_from_config
from obedient_pair import NAMES

from hrc_learn.lerobot.smoothing import ActionLimits, ActionUpsampler, SmoothRobotConfig, robot

PATIENCE = 20.0
LIMITS = ActionLimits(
    names=NAMES,
    fps=16.0,
    velocity=[8.0, 8.0],
    acceleration=[400.0, 400.0],
    jerk=[1e5, 1e5],
    lower=[None, None],
    upper=[None, None],
    state_columns=[0, 1],
)
RATE = 64.0


class Clock(threading.Event):
    """The clock and the event that the thread of setpoints waits for, which lets time pass.

    Attributes:
        delays: How much longer than it should each wait lasts [s], by its number.
        last: Number of waits after which the thread ends.
    """

    def __init__(self):
        super().__init__()
        self.now, self.delays, self.last, self.waits, self.act = 100.0, {}, 0, [], {}

    def perf_counter(self):
        return self.now

    def wait(self, timeout=None):
        number = len(self.waits)
        self.waits.append(timeout)
        self.now += timeout + self.delays.get(number, 0.0)
        self.act.get(number, lambda: None)()
        return number >= self.last


@pytest.fixture
def clock(monkeypatch):
    clock = Clock()
    monkeypatch.setattr(robot, "time", clock)
    monkeypatch.setattr(robot, "Event", lambda: clock)
    return clock


@pytest.fixture
def smooth(clock, tmp_path):
    LIMITS.save(tmp_path / "limits.json")
    config = SmoothRobotConfig(
        of="obedient_pair",
        options={"start": 0.0},
        limits=tmp_path / "limits.json",
        calibration_dir=tmp_path,
        rate=RATE,
    )
    return make_robot_from_config(config)


def both(value):
    return dict.fromkeys(NAMES, float(value))


def run(smooth, clock, waits):
    """Let the thread wait so many times, then end it."""
    clock.last = waits
    smooth.connect()
    smooth._thread.join(PATIENCE)
    assert not smooth._thread.is_alive()
    assert smooth._thread.daemon
    smooth.disconnect()
    return np.array(smooth.inner.sent[1:])


def test_setpoints_follow_the_actions_each_period(smooth, clock):
    """As those that the upsampler makes of the same actions, four an action."""
    actions = 0.02 * np.arange(1, 9) ** 2
    for k, value in enumerate(actions):
        clock.act[2 + 4 * k] = lambda value=value: smooth.send_action(both(value))
    made = run(smooth, clock, 2 + 4 * len(actions))
    upsampler = ActionUpsampler(LIMITS, RATE)
    upsampler.reset(np.zeros(2))
    expected = np.concatenate([upsampler.frame(np.full(2, value)) for value in actions])
    # Nothing is sent before the first action.
    np.testing.assert_allclose(made, expected, atol=1e-9)
    assert (smooth.sent, smooth.late) == (len(expected), 0)
    np.testing.assert_allclose(clock.waits[1:], 1 / RATE, atol=1e-9)


@pytest.mark.parametrize(("delay", "late"), [(0.9, 0), (1.0, 0), (1.1, 1), (3.0, 1)])
def test_a_setpoint_counts_as_late_by_more_than_a_period(smooth, clock, delay, late):
    clock.act[0] = lambda: smooth.send_action(both(0.1))
    clock.delays[5] = delay / RATE
    run(smooth, clock, 12)
    assert smooth.late == late
    # Missed ones are not made up for; by less than a period it catches up.
    slept = np.array(clock.waits[6:]) * RATE
    expected = [1.0] * 6 if late else [1.0 - delay, *[1.0] * 5]
    np.testing.assert_allclose(slept[: len(slept)], [*expected, 1.0][: len(slept)], atol=1e-6)


def phases(smooth, clock):
    """Takes the path's phase at a time, in actions after the first."""
    smooth.begin()
    begun = clock.now
    taken = []
    push = smooth.upsampler.push
    smooth.upsampler.push = lambda action: (taken.append(float(action[0])), push(action))

    def phase(at):
        clock.now = begun + at / LIMITS.fps
        return smooth._phase(clock.now)

    return phase, taken


def test_an_action_is_taken_when_it_is_due_and_its_lateness_followed_by_a_tenth(smooth, clock):
    phase, taken = phases(smooth, clock)
    for value in (1.0, 2.0, 3.0):
        smooth._actions.append(np.full(2, value))
    assert phase(0.0) == 0.0
    assert taken == [1.0]
    assert phase(0.875) == pytest.approx(0.875)
    assert taken == [1.0]
    assert phase(1.0) == 0.0  # in time: nothing moves
    assert taken == [1.0, 2.0]
    # The third is 0.25 late: those after it are due 0.025 later.
    assert phase(2.25) == pytest.approx(0.25 - 0.025)
    assert taken == [1.0, 2.0, 3.0]


def test_half_an_action_is_waited_for_the_next_and_then_the_newest_repeated(smooth, clock):
    phase, taken = phases(smooth, clock)
    smooth._actions.append(np.full(2, 5.0))
    phase(0.0)
    assert phase(1.4375) == pytest.approx(1.4375)
    assert taken == [5.0]
    assert phase(1.5) == pytest.approx(0.5)  # no lateness is followed
    assert taken == [5.0, 5.0]
    smooth._actions.append(np.full(2, 6.0))
    assert phase(1.9375) == pytest.approx(0.9375)
    assert phase(2.0) == 0.0
    assert taken == [5.0, 5.0, 6.0]


@pytest.mark.parametrize(
    ("moved", "passed", "age", "velocity"),
    [
        (0.25, 1 / 16, 0.0, 4.0),
        (0.5, 1 / 16, 0.0, 8.0),  # exactly the limit
        (0.51, 1 / 16, 0.0, 0.0),  # it was put there
        (0.25, 1 / 16, 1 / 16, 4.0),  # read an action ago
        (0.25, 1 / 16, 1.01 / 16, None),
        (0.25, 0.0, 0.0, 0.0),
    ],
)
def test_the_path_begins_with_the_measured_velocity(
    smooth, clock, moved, passed, age, velocity
):
    smooth.begin()
    clock.now += 0.5  # only the last two readings count
    smooth.get_observation()
    started = []
    smooth.upsampler.reset = lambda *motion: started.append(motion)
    clock.now += passed
    smooth.inner.sent.append([moved, -0.5 * moved])
    smooth.get_observation()
    smooth._start(clock.now + age)
    if velocity is None:
        assert started == []
        return
    ((here, begun),) = started
    np.testing.assert_array_equal(here, [moved, -0.5 * moved])
    np.testing.assert_allclose(begun, velocity * np.array([1.0, -0.5]))


def test_actions_that_come_too_fast_are_told(smooth, clock, caplog):
    smooth.connect()
    smooth._thread.join(PATIENCE)  # takes no action
    rate = round(LIMITS.fps)
    for k in range(2 * rate):
        smooth.send_action(both(0.3))
        assert len(caplog.messages) == (k >= rate - 1)
    (told,) = caplog.messages
    assert f"faster than the {rate} a second of" in told
    assert told.endswith("the robot is behind by 1 s")


def test_a_reading_that_is_not_finite_begins_nothing(smooth, clock):
    smooth.begin()
    smooth._readings.append((clock.now, np.array([0.0, np.nan])))
    smooth.upsampler.reset = lambda *motion: pytest.fail("begun at NaN")
    smooth._start(clock.now)


def test_the_wrapped_robot_is_calibrated_and_configured(smooth):
    calls = []
    smooth.inner = SimpleNamespace(
        calibrate=lambda: calls.append("calibrate"),
        configure=lambda: calls.append("configure"),
        is_calibrated=False,
        cameras={"front": 1},
    )
    smooth.calibrate()
    smooth.configure()
    assert calls == ["calibrate", "configure"]
    assert not smooth.is_calibrated
    assert smooth.cameras == {"front": 1}
