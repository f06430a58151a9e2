"""Tasks on an arm behind a driver, in the world's own time: no network, no clock."""

import json
from contextlib import contextmanager
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from hrc_learn.experiments import real_arm as on_arm
from hrc_learn.experiments.real_arm import ArmSite, opened_arm, run_on_arm
from hrc_learn.geometry import Pose
from hrc_learn.hardware import CameraError
from hrc_learn.kinematics import panda
from hrc_learn.sim import World
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills.grasping import as_load, joint_plan
from hrc_learn.skills.work_cell import TaskFailedError

pytestmark = pytest.mark.simulation

WORKPLACE = Workplace()
ITEM = WORKPLACE.scene.objects[0]


@pytest.fixture
def world(monkeypatch):
    """The world of the arm, whose time goes on while the loop waits."""
    world = World(WORKPLACE.scene)
    world.hold(ITEM.name, WORKPLACE.home_joints().numpy())

    class Rate:
        def __init__(self, dt, *, clock):
            assert clock() == pytest.approx(world.time)
            self.dt = dt

        def wait(self):
            world.advance(self.dt)

    @contextmanager
    def opened(site):
        yield world.arm

    monkeypatch.setattr(on_arm, "Rate", Rate)
    monkeypatch.setattr(on_arm, "opened_arm", opened)
    return world


SITE = ArmSite(ip="arm", dynamics=1.0, touch=False)


def raised(cell, by):
    up = torch.tensor([0.0, 0.0, by], dtype=torch.float64)
    return Pose(cell.pose.position + up, cell.pose.orientation)


def test_a_task_moves_the_arm_and_the_world_that_is_believed_follows(world, tmp_path):
    phases, checked = [], []

    def task(cell, check):
        cell.begin_phase("up")
        cell.move_straight(raised(cell, 0.02))
        check(joint_plan(cell, cell.joints, cell.joints))
        cell.load = as_load(ITEM)
        check(joint_plan(cell, cell.joints, cell.joints))
        cell.hold_pose(0.05)
        return ""

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(on_arm, "check_plan", lambda plan, world, held: checked.append(held))
        start = world.arm.tcp_pose()
        run = run_on_arm(SITE, WORKPLACE, task, on_phase=lambda *phase: phases.append(phase))
    there = world.arm.tcp_pose()
    np.testing.assert_allclose(there[:3, 3] - start[:3, 3], [0.0, 0.0, 0.02], atol=2e-3)
    np.testing.assert_allclose(run.world.arm.tcp_pose(), there, atol=1e-3)
    assert [name for name, _ in phases] == ["up"]
    assert checked == [None, ITEM.name]
    # What it took up goes along in its hand.
    in_hand = run.world.object_pose(ITEM.name)[:3, 3] - run.world.arm.tcp_pose()[:3, 3]
    np.testing.assert_allclose(in_hand, 0.0, atol=1e-9)
    run.save(tmp_path / "run", "a task", {"ip": "arm"})
    written = json.loads((tmp_path / "run" / "result.json").read_text())
    assert written["failure"] == ""
    assert [entry["phase"] for entry in written["phases"]] == ["up"]
    assert written["duration"] == pytest.approx(np.ptp(run.cell.log["time"]))
    assert {"run.rrd", "log.npz"} <= {file.name for file in (tmp_path / "run").iterdir()}


def test_after_a_stop_by_the_driver_the_arm_starts_from_rest(world, monkeypatch):
    """The arm's process stops it at step 20: the commands after it begin at zero velocity."""
    sent = []

    class Process:
        trips = 0

        def __getattr__(self, name):
            return getattr(world.arm, name)

        def command(self, velocity):
            sent.append(velocity)
            self.trips += len(sent) == 20
            world.arm.command(velocity if len(sent) != 20 else 0 * velocity)

    @contextmanager
    def opened(site):
        yield Process()

    def task(cell, check):
        for _ in range(40):
            cell.step(torch.tensor([0.0, 0, 0, 0, 0, 0, 0.4], dtype=torch.float64))
        return ""

    monkeypatch.setattr(on_arm, "opened_arm", opened)
    run_on_arm(SITE, WORKPLACE, task)
    speeds = np.abs(np.array(sent)[:, 6])
    assert speeds[19] == pytest.approx(0.4, abs=1e-3)
    assert speeds[20] < 0.5 * speeds[19]
    assert speeds[-1] == pytest.approx(0.4, abs=1e-3)


@pytest.mark.parametrize("error", [TaskFailedError, CameraError])
def test_a_task_that_fails_says_why(world, error, tmp_path):
    def task(cell, check):
        raise error("lost its way")

    run = run_on_arm(SITE, WORKPLACE, task)
    assert run.failure == "lost its way"
    assert len(run.cell.log) == 0
    # Nothing has moved yet, so that there is nothing to draw.
    run.save(tmp_path / "run", "a task", {"ip": "arm"})
    written = json.loads((tmp_path / "run" / "result.json").read_text())
    assert (written["failure"], written["duration"]) == ("lost its way", 0.0)


def test_a_site_bounds_what_its_arm_may_do():
    for driver in ("franky", "franka", "lerobot", "ros2"):
        site = ArmSite(ip="arm", driver=driver, dynamics=0.4, speed=0.5, camera_delay=0.07)
        config, bounds = site.cell_config(), site.cell_config().safety
        assert bounds.braking == 0.4
        assert bounds.tcp_speed == 0.25  # ISO 10218-1, reduced speed [m/s]
        assert bounds.delay == config.command_delay > 0
        assert (config.speed, config.latency.delay) == (0.5, 0.07)
    servo, box = (replace(SITE, driver=name).cell_config() for name in ("lerobot", "franky"))
    assert servo.command_delay > box.command_delay


@pytest.mark.parametrize("driver", ["franka", "franky", "lerobot", "ros2"])
def test_each_driver_is_opened_with_the_settings_of_the_site(monkeypatch, capsys, driver):
    made, closed = {}, []

    @contextmanager
    def connected(*settings):
        made["settings"] = settings
        yield "arm"
        closed.append("arm")

    @contextmanager
    def process(opened, *, timeout):
        made["timeout"] = timeout
        with opened() as arm:
            yield arm

    monkeypatch.setattr(on_arm, "ArmProcess", process)
    monkeypatch.setattr(on_arm, "ros2_origin", lambda: "ROS 2: of the test")
    for name in ("FrankaArm", "FrankyArm", "LeRobotArm", "Ros2Arm"):
        monkeypatch.setattr(on_arm, name, connected if name.lower()[:-3] == driver else None)
    device = {"type": "so101_follower"}
    site = ArmSite(ip="box", driver=driver, dynamics=0.3, realtime=False, device=device)
    with opened_arm(site, SimpleNamespace(joint_names="others")) as arm:
        assert arm == "arm"
        assert closed == []
    assert closed == ["arm"]
    settings = made["settings"]
    if driver in ("franka", "franky"):
        config = settings[-1]
        assert settings[0] == "box"
        assert (config.dynamics, config.realtime) == (0.3, False)
        assert config.timeout == made.get("timeout", config.timeout)
        assert ("timeout" in made) == (driver == "franky")
        if driver == "franka":
            assert settings[1].joint_names == "others"
    else:
        assert settings[-2].joint_names == "others"
        assert settings[-1] == (site.lerobot if driver == "lerobot" else site.ros2)
        assert ("ROS 2" in capsys.readouterr().err) == (driver == "ros2")
    if driver == "lerobot":
        assert settings[0] == device
    if driver == "franky":
        with (
            pytest.raises(ValueError, match="ip is empty: give the address"),
            opened_arm(replace(site, ip="")),
        ):
            pass


def test_the_chain_is_that_of_the_robot_named():
    assert replace(SITE, robot="panda").chain is panda
    assert replace(SITE, robot="fr3").chain is not panda
