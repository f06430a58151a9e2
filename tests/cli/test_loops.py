"""Loops of `hrc page` and `hrc serve` on stand-ins of clock and arm, step by step."""

import json
import sys
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from rich.console import Console
from scipy.spatial.transform import Rotation
from unchecked import shapes_unchecked

from hrc_learn.cli import loop_commands
from hrc_learn.cli.arguments import Serve
from hrc_learn.controller import GRIPPER_DOWN, INTERVENTIONS, SafetyConfig
from hrc_learn.experiments.real_arm import ArmSite
from hrc_learn.hardware import DriverError
from hrc_learn.kinematics import panda
from hrc_learn.protocols import ArmState
from hrc_learn.teleoperation.gate import qr_code

pytestmark = pytest.mark.simulation

CENTRE = np.array([0.35, 0.35, 0.35])


@pytest.fixture(autouse=True)
def _unchecked():
    """Stand-ins are not of the annotated types."""
    with shapes_unchecked():
        yield


class Rate:
    """A rate that waits for nothing: the k-th tick is k microseconds late."""

    def __init__(self, period):
        self.period, self.missed, self.latest, self.ticks = period, 3, 0.25, 0

    def wait(self):
        self.ticks += 1
        return 1e-6 * self.ticks


class Clock:
    """Time that advances by more from call to call, by a microsecond each time."""

    def __init__(self):
        self.now, self.calls = 0.0, 0

    def __call__(self):
        self.calls += 1
        # Each step calls twice: as it begins and as it ends.
        self.now += 1e-6 * (self.calls // 2) if self.calls % 2 == 0 else 1.0
        return self.now


@pytest.fixture
def timeless(monkeypatch):
    monkeypatch.setattr(loop_commands, "Rate", Rate)
    monkeypatch.setattr(
        loop_commands, "time", SimpleNamespace(perf_counter=Clock(), monotonic=Clock())
    )


class Arm:
    """Moves by what it is commanded; nothing is delayed."""

    def __init__(self, dt):
        self.q, self.dt, self.sent = panda.ready.numpy().copy(), dt, []

    def read(self):
        return ArmState(
            time=0.0,
            joint_position=self.q.copy(),
            joint_velocity=np.full(7, 0.1),
            gripper_width=0.0,
        )

    def command(self, velocity):
        self.sent.append(np.array(velocity))
        self.q = self.q + self.dt * np.asarray(velocity)


class Runner:
    """Commands a constant velocity, and keeps what it observed."""

    def __init__(self):
        self.observation = {
            "joint_position": np.zeros(7),
            "feature": np.array([300.0, 200.0]),
            "feature_new": np.zeros(()),
            "feature_visible": np.zeros(()),
            "image_joint_position": np.zeros(7),
        }
        self.seen, self.started = [], None

    def step(self):
        self.seen.append({name: np.copy(x) for name, x in self.observation.items()})
        return np.full(7, 0.2)

    def start(self, position, velocity):
        self.started = len(self.seen), position, velocity


@pytest.mark.parametrize(("dt", "every"), [(0.004, 8), (0.01, 3), (0.1, 1)])
def test_serve_observes_the_marker_at_the_rate_of_images_and_reports_quantiles(
    timeless, dt, every
):
    runner, arm, passed, steps = Runner(), Arm(dt), [], 100
    opened: Any = SimpleNamespace(arm=arm, gripper=None, advance=passed.append)
    camera = loop_commands._camera(CENTRE)
    run: Any = loop_commands._run_serve
    figures = run(runner, opened, panda, camera, dt, steps)
    assert passed == [dt] * steps
    # The first, slow step is not sent, and the state begins anew after it.
    assert runner.started[0] == 1
    np.testing.assert_array_equal(runner.started[1], panda.ready)
    np.testing.assert_array_equal(runner.started[2], np.full(7, 0.1))
    assert len(runner.seen) == steps + 1
    np.testing.assert_array_equal(arm.sent, [np.full(7, 0.2)] * steps + [np.zeros(7)])
    for k, seen in enumerate(runner.seen[1:]):
        q = panda.ready.numpy() + k * dt * 0.2
        np.testing.assert_allclose(seen["joint_position"], q, atol=1e-9)
        if k:
            # What the step before saw last: an image, or that there was none.
            assert seen["feature_new"] == ((k - 1) % every == 0)
            taken = panda.ready.numpy() + ((k - 1) // every * every + 1) * dt * 0.2
            np.testing.assert_allclose(seen["image_joint_position"], taken, atol=1e-9)
            pose = panda.forward(torch.from_numpy(taken))
            turn = Rotation.from_quat(pose.orientation.numpy(), scalar_first=True)
            marker = pose.position.numpy() + turn.apply((0.05, 0.0, -0.08))
            np.testing.assert_allclose(seen["feature"], camera.project(marker), atol=1e-6)
            assert seen["feature_visible"] == camera.in_view(marker)
    last = runner.observation["feature"]
    assert figures["pixel_error"] == pytest.approx(np.hypot(*(last - [300.0, 200.0])))
    assert (figures["steps"], figures["missed_ticks"]) == (steps, 3)
    assert figures["missed_percent"] == pytest.approx(300 / 103)
    for kind in ("step", "late"):
        for name, value in {
            "50": 50.5,
            "90": 90.1,
            "99": 99.01,
            "99.9": 99.901,
            "100": 100,
        }.items():
            assert figures[f"{kind}_p{name}_us"] == pytest.approx(value, rel=1e-4)


def test_the_camera_of_serve_looks_at_the_box_from_1_1_m_with_a_lean():
    camera = loop_commands._camera(CENTRE)
    place, sight = camera.pose[:3, 3], camera.pose[:3, 2]
    away = place - CENTRE
    assert np.linalg.norm(away) == pytest.approx(1.1)
    np.testing.assert_allclose(sight, -away / 1.1, atol=1e-12)
    assert np.arccos(away[2] / 1.1) == pytest.approx(0.2)
    assert np.arctan2(away[1], away[0]) == pytest.approx(1.0)
    np.testing.assert_allclose(camera.project(CENTRE), camera.principal)
    assert camera.focal == (1600.0, 1600.0)


def test_the_controller_of_serve_aims_at_the_marker_of_a_tool_in_the_box():
    camera = loop_commands._camera(CENTRE)
    safety = SafetyConfig(delay=0.01)
    controller, observation = loop_commands._controller(panda, camera, CENTRE, 0.004, safety)
    # The tool points down beside the centre; its marker lies behind it.
    turn = Rotation.from_quat(GRIPPER_DOWN, scalar_first=True)
    tool = CENTRE + np.array([0.03, -0.02, 0.0])
    marker = tool + turn.apply((0.05, 0.0, -0.08))
    np.testing.assert_allclose(observation.feature, camera.project(marker), rtol=1e-9)
    assert controller.config.safety == safety
    assert float(observation.dt) == 0.004


@pytest.mark.parametrize(("duration", "steps"), [(0.1, 10), (0.095, 10), (0.01, 1), (None, 25)])
def test_the_page_runs_for_its_duration_or_until_the_person_finishes(
    timeless, monkeypatch, duration, steps
):
    session: Any = SimpleNamespace(taken=0, finished=False, stopped=0)

    def step():
        session.taken += 1
        session.finished = session.taken == 25

    def stop():
        session.stopped += 1

    session.step, session.arm = step, SimpleNamespace(stop=stop)
    page: Any = SimpleNamespace(alive=True)
    figures = loop_commands._run_page(session, page, 0.01, duration)
    assert figures == {"steps": steps, "missed_ticks": 3, "latest_s": 0.25}
    assert (session.taken, session.stopped) == (steps, 1)


def test_a_page_that_has_died_and_ctrl_c_end_the_loop_at_rest(timeless, capsys):
    session: Any = SimpleNamespace(finished=False, stopped=[])
    session.arm = SimpleNamespace(stop=lambda: session.stopped.append(True))
    page: Any = SimpleNamespace(alive=False)
    assert loop_commands._run_page(session, page, 0.01, None)["steps"] == 0

    def interrupted():
        raise KeyboardInterrupt

    session.step, page.alive = interrupted, True
    assert loop_commands._run_page(session, page, 0.01, None)["steps"] == 0
    assert len(session.stopped) == 2


@pytest.mark.parametrize("arm", ["sim", "franky", "lerobot", "ros2"])
def test_the_safety_filter_allows_for_the_driver_of_the_arm(monkeypatch, arm):
    access = SimpleNamespace(delay=0.02, dynamics=0.4, open=lambda world: ("opened", world))
    monkeypatch.setattr(loop_commands, "access_by", lambda driver, robot: access)
    world: Any = SimpleNamespace(arm=SimpleNamespace(robot="arm"))
    for real in {"sim": [False], "franky": [False, True]}.get(arm, [True]):
        args: Any = SimpleNamespace(arm=arm, ip="10.0.0.1", drives_real_arm=lambda r=real: r)
        safety = SafetyConfig(delay=0.03, braking=0.5)
        site = ArmSite(dynamics=0.2)
        connect, allowed = loop_commands._access(args, site, world, safety)
        if real:
            expected = replace(site, driver=arm, ip="10.0.0.1")
            assert allowed == expected.cell_config().safety
            assert connect.args == (expected, world, "arm")
        else:
            assert allowed == replace(safety, delay=0.05, braking=0.4)
            assert connect() == ("opened", world)
    access.dynamics = 0.7
    args = SimpleNamespace(arm="sim", ip="", drives_real_arm=lambda: False)
    assert loop_commands._access(args, ArmSite(), world, safety)[1].braking == 0.5


def test_a_world_follows_a_real_arm_from_the_start(monkeypatch):
    followed, readings = [], iter("abc")
    arm = SimpleNamespace(read=lambda: next(readings))
    monkeypatch.setattr(loop_commands, "opened_arm", lambda site, chain: nullcontext(arm))
    world: Any = SimpleNamespace(follow=followed.append)
    with loop_commands._real_arm(ArmSite(), world, panda) as opened:
        assert followed == ["a"]
        opened.advance(0.01)
        assert followed == ["a", "b"]
        assert opened.arm is opened.gripper is arm

    @contextmanager
    def failing(site, chain):
        raise DriverError("the arm is off")
        yield

    monkeypatch.setattr(loop_commands, "opened_arm", failing)
    with (
        pytest.raises(ConnectionError, match="the arm is off"),
        loop_commands._real_arm(ArmSite(), world, panda),
    ):
        pass


@pytest.mark.parametrize("device", ["haptic", "gamepad", "keyboard", "none"])
def test_the_device_that_is_named_is_opened(monkeypatch, device):
    made = SimpleNamespace(
        HapticDevice=SimpleNamespace(open=lambda chain: nullcontext(("haptic", chain))),
        Gamepad=SimpleNamespace(open=lambda chain: ("gamepad", chain)),
        TerminalKeyboard=SimpleNamespace(open=lambda chain: ("keyboard", chain)),
    )
    for name, kind in vars(made).items():
        monkeypatch.setattr(loop_commands, name, kind)
    with loop_commands._opened_device(device, panda) as devices:
        assert devices == (((device, panda),) if device != "none" else ())


@pytest.mark.parametrize("scheme", ["http", "https"])
@pytest.mark.parametrize("headset", ["", "https://x/xr"])
def test_addresses_are_printed_and_a_code_where_others_can_reach_them(capsys, scheme, headset):
    page: Any = SimpleNamespace(
        url=f"{scheme}://x/#token=1",
        watch_url=f"{scheme}://x/#token=2",
        headset_url=headset,
        address=SimpleNamespace(scheme=scheme),
    )
    loop_commands._announce(Console(width=200), page)
    said = capsys.readouterr().out
    assert f"Page at {page.url}\n" in said
    assert f"To watch only: {page.watch_url}\n" in said
    assert (f"For headsets and phones: {headset}\n" in said) == bool(headset)
    assert ("No client for headsets: build it with" in said) == (not headset)
    assert ("Anyone with this address can move the arm" in said) == (scheme == "https")
    assert (qr_code(page.url) in said) == (scheme == "https")


class Node:
    """A node of ROS 2 that can or cannot start."""

    starts, made = True, []

    def __init__(self, *given):
        self.calls = ["made", *given[3:]]
        Node.made.append(self)

    def start(self):
        self.calls.append("start")
        return self.starts

    def deactivate(self):
        self.calls.append("deactivate")

    def figures(self):
        return {"commands": 1234567, "p99": 0.000123456}

    def close(self):
        self.calls.append("close")


@pytest.fixture
def node(monkeypatch):
    monkeypatch.setitem(
        sys.modules, "hrc_learn.hardware.ros2_node", SimpleNamespace(ControllerNode=Node)
    )
    for name, value in {"ros2_origin": lambda: "ROS", "found_description": lambda x: x}.items():
        monkeypatch.setattr(loop_commands, name, value)
    slept, now = [], SimpleNamespace(time=100.0)

    def sleep(seconds):
        slept.append(seconds)
        now.time += seconds
        if len(slept) > 40:
            raise KeyboardInterrupt

    clock = SimpleNamespace(monotonic=lambda: now.time, sleep=sleep)
    monkeypatch.setattr(loop_commands, "time", clock)
    monkeypatch.setattr(Node, "made", [])
    return slept


@pytest.mark.parametrize(("duration", "sleeps"), [(1.0, 10), (2.5, 25), (None, 41)])
@pytest.mark.parametrize("autostart", [True, False])
def test_a_node_runs_for_its_duration_or_until_ctrl_c(
    node, tmp_path, capsys, duration, sleeps, autostart
):
    args: Any = Serve(robot="panda", duration=duration, json=tmp_path / "j")
    settings = loop_commands._ServeSettings(step="eager", autostart=autostart)
    loop_commands._serve_node(args, settings)
    assert abs(len(node) - sleeps) <= 1
    (made,) = Node.made
    started = ["start"] if autostart else []
    assert made.calls == ["made", loop_commands.EagerRunner, *started, "deactivate", "close"]
    said = capsys.readouterr().out
    assert "ROS\n" in said
    assert f"{'commands':22} 1.235e+06\n" in said
    assert f"{'p99':22} 0.0001235\n" in said
    assert json.loads((tmp_path / "j").read_text())["commands"] == 1234567


def test_a_node_that_cannot_start_is_closed_and_reported(node, monkeypatch):
    monkeypatch.setattr(Node, "starts", False)
    args: Any = Serve(robot="panda", duration=1.0)
    with pytest.raises(ConnectionError, match="its log says why"):
        loop_commands._serve_node(args, loop_commands._ServeSettings())
    assert Node.made[0].calls == ["made", loop_commands.open_step, "start", "close"]


@pytest.mark.parametrize(
    ("rate", "duration", "refused"),
    [(0.0, 1.0, True), (5.0, 0.0, True), (4.99, 1.0, True), (5.0, 0.3, False)],
)
def test_the_rate_is_at_least_that_of_the_safety_filter(monkeypatch, rate, duration, refused):
    monkeypatch.setattr(
        loop_commands, "_report", lambda args, figures: reported.append(figures)
    )
    ran, reported = [], []

    def run(runner, arm, chain, camera, dt, steps):
        ran.append((dt, steps))
        return {"steps": steps}

    monkeypatch.setattr(loop_commands, "_run_serve", run)
    args = Serve(rate=rate, duration=duration, config=("step=eager",))
    if refused:
        with pytest.raises(ValueError, match="--rate must be"):
            loop_commands.serve(args)
        return
    loop_commands.serve(args)
    assert ran == [(1 / 5, 2)]
    (figures,) = reported
    assert figures["open_s"] > 0
    assert [k for k in figures if k.startswith("safety_")] == [
        f"safety_{k}" for k in INTERVENTIONS
    ]
    assert figures["safety_invalid"] == 0
