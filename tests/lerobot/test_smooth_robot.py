"""A robot led at the rate of its motors, through LeRobot's own programs and engines."""

import json
import time
from dataclasses import asdict
from threading import Event

import numpy as np
import pytest
import torch
from lerobot.policies.rtc.configuration_rtc import RTCConfig
from lerobot.robots import make_robot_from_config
from lerobot.rollout.inference.rtc import RTCInferenceEngine
from lerobot.rollout.robot_wrapper import ThreadSafeRobot
from lerobot.utils.errors import DeviceNotConnectedError
from obedient_pair import NAMES

from hrc_learn.lerobot.smoothing import ActionLimits, SmoothRobot, SmoothRobotConfig

LIMITS = ActionLimits(
    names=NAMES,
    fps=20.0,
    velocity=[1.0, 2.0],
    acceleration=[4.0, 8.0],
    jerk=[80.0, 160.0],
    lower=[-1.0, None],
    upper=[1.0, None],
    state_columns=[0, 1],
)


@pytest.fixture
def make(tmp_path):
    """A smooth robot around a fake one, as LeRobot makes it of its configuration."""

    def make(*, options=None, limits=LIMITS, **settings):
        limits.save(tmp_path / "limits.json")
        config = SmoothRobotConfig(
            of="obedient_pair",
            options=options or {},
            limits=tmp_path / "limits.json",
            calibration_dir=tmp_path,
            **{"rate": 200.0} | settings,
        )
        robot = make_robot_from_config(config)
        assert isinstance(robot, SmoothRobot)
        return robot

    return make


def worst(path, rate):
    """Largest velocity, acceleration and jerk of setpoints, as shares of the limits."""
    path = np.concatenate([np.repeat(path[:1], 3, 0), path])
    found = []
    for limit in (LIMITS.velocity, LIMITS.acceleration, LIMITS.jerk):
        path = np.diff(path, axis=0) * rate
        found.append(float((np.abs(path) / limit).max()))
    return max(found)


def test_it_is_the_robot_it_leads(make):
    robot = make(clock="actions")
    assert robot.name == robot.robot_type == "obedient_pair"
    assert robot.action_features == dict.fromkeys(NAMES, float)
    assert robot.cameras == {}
    assert not robot.is_connected
    with pytest.raises(DeviceNotConnectedError, match="connect"):
        robot.send_action({})
    robot.connect()
    assert robot.get_observation() == {"a.pos": 0.25, "b.pos": -0.25}


def test_actions_become_setpoints_within_limits(make):
    robot = make(clock="actions")
    robot.connect()
    for k in range(60):
        sent = robot.send_action({"a.pos": 0.8 * (k % 20 > 10), "b.pos": float(k > 30)})
    path = np.array(robot.inner.sent)
    assert len(path) == 1 + 60 * 10
    assert worst(path, 200.0) <= 1 + 1e-6
    assert list(sent.values()) == path[-1].tolist()
    assert path[-1, 1] == pytest.approx(1.0, abs=1e-3)
    # A value that is not named stays.
    for _ in range(40):
        robot.send_action({"a.pos": 0.1})
    assert robot.inner.sent[-1] == pytest.approx([0.1, 1.0], abs=1e-3)


def test_after_a_hand_it_begins_where_the_robot_is(make):
    robot = make(clock="actions")
    robot.connect()
    robot.send_action(dict.fromkeys(NAMES, 0.0))
    robot.inner.sent.append([0.6, 0.4])
    robot.begin()
    robot.send_action({"a.pos": 0.6, "b.pos": 0.4})
    np.testing.assert_allclose(robot.inner.sent[-10:], [[0.6, 0.4]] * 10, atol=1e-12)


def test_a_robot_without_a_finite_position_is_not_led(make):
    robot = make(clock="actions", options={"start": float("nan")})
    with pytest.raises(ValueError, match=r"does not report a.pos, b.pos.*check the sensor"):
        robot.connect()


def send_for(robot, seconds, of_time, fps=20.0):
    begun = time.perf_counter()
    for k in range(round(seconds * fps)):
        robot.send_action(of_time(k / fps))
        time.sleep(max(0.0, begun + (k + 1) / fps - time.perf_counter()))


def both(value):
    return dict.fromkeys(NAMES, float(value))


def test_a_thread_sends_them_in_their_time(make):
    robot = make(rate=100.0, options={"start": 0.0})
    robot.connect()
    assert len(robot.inner.sent) == 1  # nothing moves before the first action
    send_for(robot, 1.5, lambda t: both(0.2 * (1 - np.cos(2 * t))))
    time.sleep(0.5)
    robot.disconnect()
    path, times = np.array(robot.inner.sent), np.array(robot.inner.times)
    assert worst(path, 100.0) <= 1 + 1e-6  # however late a setpoint was
    rate = (len(times) - 1) / (times[-1] - times[0])
    assert 50.0 < rate <= 101.0
    # With no further actions it has come to rest at the last one.
    assert path[-1] == pytest.approx(0.2 * (1 - np.cos(2 * 29 / 20)), abs=2e-3)


def test_path_starts_from_the_measured_motion(make):
    robot = make(rate=100.0, options={"start": 0.0, "drift": 0.5})
    robot.connect()
    for _ in range(3):
        time.sleep(0.05)
        seen = robot.get_observation()
    robot.send_action(both(1.0))
    time.sleep(0.1)
    robot.disconnect()
    here = np.array([seen[name] for name in NAMES])
    first, second = np.array(robot.inner.sent[1:3])
    # At 4 /s^2 the velocity changes by 0.04 from one setpoint to the next.
    np.testing.assert_allclose(first - here, 0.5 / 100, atol=1e-3)
    np.testing.assert_allclose(second - first, 0.5 / 100, atol=1e-3)


def test_what_the_driver_says_is_told(make):
    robot = make(options={"breaks_after": 5})
    robot.connect()
    robot.send_action(both(0.3))
    robot._thread.join(5)
    with pytest.raises(
        DeviceNotConnectedError, match=r"refused a setpoint: no answer on the bus"
    ):
        robot.send_action(both(0.3))
    with pytest.raises(DeviceNotConnectedError, match="no answer on the bus"):
        robot.get_observation()
    robot.disconnect()
    robot.connect()  # with the cable plugged in again
    assert robot.get_observation()["a.pos"] == pytest.approx(robot.inner.sent[-1][0])
    robot.disconnect()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"of": ""}, "--robot.of must be one of .*obedient_pair.*got ''"),
        ({"of": "smooth"}, "got 'smooth'"),
        ({"limits": None}, "--robot.limits is needed: `hrc smooth "),
        ({"rate": 10.0}, "at least the 20 actions a second"),
    ],
)
def test_settings_that_make_no_robot_are_refused(tmp_path, settings, message):
    LIMITS.save(tmp_path / "limits.json")
    given = {"of": "obedient_pair", "limits": tmp_path / "limits.json"}
    with pytest.raises(ValueError, match=message):
        SmoothRobot(SmoothRobotConfig(calibration_dir=tmp_path, **given | settings))


def test_limits_of_another_robot_are_refused(make):
    values = asdict(LIMITS) | {"names": ["a.pos", "c.pos"]}
    with pytest.raises(
        ValueError, match=r"limits for a.pos, c.pos, but actions .* a.pos, b.pos"
    ):
        make(limits=ActionLimits(**values))


def test_limits_are_kept_in_a_file(tmp_path):
    file = tmp_path / "limits.json"
    LIMITS.save(file)
    assert ActionLimits.load(file) == LIMITS
    wrong = [("velocity", x) for x in (None, "fast", float("nan"), [], True, 10**400, -1.0)]
    wrong += [("fps", 0), ("names", "ab"), ("names", []), ("lower", 1.0)]
    wrong += [("state_columns", [0, 1.5]), ("state_columns", [-2, 0])]
    for key, value in wrong:
        entry = [value, 1.0] if key == "velocity" else value
        file.write_text(json.dumps(asdict(LIMITS) | {key: entry}))
        with pytest.raises(ValueError, match=rf"limits\.json: {key}\b|limits\.json: not valid"):
            ActionLimits.load(file)
    file.write_text(json.dumps({"names": ["a"]}))
    with pytest.raises(ValueError, match=r"limits\.json: lacks the field .*hrc smooth"):
        ActionLimits.load(file)
    file.write_text("{")
    with pytest.raises(ValueError, match=r"limits\.json: not valid JSON"):
        ActionLimits.load(file)
    with pytest.raises(FileNotFoundError, match="there is no"):
        ActionLimits.load(tmp_path / "none.json")


class JumpingChunks:
    """A fake policy whose chunks each lead elsewhere, after some time of thinking."""

    config = type("Config", (), {"use_amp": False, "action_feature_names": None})

    def __init__(self):
        self.chunks = 0

    def reset(self):
        pass

    def predict_action_chunk(self, batch, inference_delay=0, prev_chunk_left_over=None, **_):
        time.sleep(0.1)
        self.chunks += 1
        rng = torch.Generator().manual_seed(self.chunks)
        end = torch.rand(2, generator=rng) - 0.5
        return (end * torch.linspace(0.5, 1, 20)[:, None])[None]


class Untouched:
    """A pipeline without steps."""

    steps = ()

    def __call__(self, values):
        return values

    def reset(self):
        pass


def test_lerobots_engine_of_real_time_chunks_leads_it(make):
    robot = make(rate=100.0, options={"start": 0.0})
    robot.connect()
    wrapped, policy = ThreadSafeRobot(robot), JumpingChunks()
    engine = RTCInferenceEngine(
        policy=policy,
        preprocessor=Untouched(),
        postprocessor=Untouched(),
        robot_wrapper=wrapped,
        rtc_config=RTCConfig(execution_horizon=10),
        hw_features={
            "observation.state": {"dtype": "float32", "shape": (2,), "names": list(NAMES)}
        },
        task="",
        fps=20.0,
        device="cpu",
        rtc_queue_threshold=10,
        shutdown_event=Event(),
    )
    engine.start()
    engine.resume()
    taken = 0
    begun = time.perf_counter()
    while taken < 30 and time.perf_counter() - begun < 20:
        engine.notify_observation(wrapped.get_observation())
        action = engine.get_action(None)
        if action is not None:
            taken += 1
            wrapped.send_action(dict(zip(NAMES, action.tolist(), strict=True)))
        time.sleep(1 / 20)
    engine.stop()
    robot.disconnect()
    assert taken == 30
    assert policy.chunks > 1
    path = np.array(robot.inner.sent)
    assert np.ptp(path, axis=0).min() > 0.05
    assert worst(path, 100.0) <= 1 + 1e-6
