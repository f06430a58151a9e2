"""Tasks on an arm that is reached over the network: our world behind a real arm's protocol."""

import json
from contextlib import contextmanager

import numpy as np
import pytest
import torch
from taught_models import teach
from unchecked import shapes_unchecked

from hrc_learn.experiments.real_arm import ArmSite, placing_task, run_on_arm
from hrc_learn.geometry import Pose
from hrc_learn.hardware.protocol_server import serve_world
from hrc_learn.kinematics import panda
from hrc_learn.sim import World
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills.work_cell import TaskFailedError

pytest.importorskip("franky")
pytest.importorskip("franky_sim")

pytestmark = pytest.mark.realtime

WORKPLACE = Workplace()


@pytest.fixture(autouse=True)
def quick():
    """A step has hundreds of shapes, and other tests check them."""
    with shapes_unchecked():
        yield


@contextmanager
def arm_at_home(**site):
    """A world whose arm is served at an address, in real time as far as the machine goes."""
    world = World(WORKPLACE.scene)
    world.hold(WORKPLACE.scene.objects[0].name, WORKPLACE.home_joints().numpy())
    with serve_world(world) as server, server.running():
        yield world, ArmSite(ip=server.address, realtime=False, dynamics=1.0, **site)


def raised(cell, by):
    position = cell.pose.position + torch.tensor([0.0, 0.0, by]).double()
    return Pose(position, cell.pose.orientation)


def test_a_task_is_done_and_what_the_robot_can_tell_is_kept(tmp_path):
    def task(cell, check):
        cell.begin_phase("up")
        cell.move_straight(raised(cell, 0.03))
        return ""

    with arm_at_home() as (world, site):
        start = world.arm.tcp_pose()
        phases = []
        run = run_on_arm(site, WORKPLACE, task, on_phase=lambda name, _: phases.append(name))
        there = world.arm.tcp_pose()
    assert run.failure == ""
    assert phases == ["up"]
    np.testing.assert_allclose(there[:3, 3] - start[:3, 3], [0.0, 0.0, 0.03], atol=2e-3)
    # The world that is believed has followed it.
    np.testing.assert_allclose(run.world.arm.tcp_pose(), there, atol=2e-3)
    assert len(run.motion) == len(run.cell.log)

    run.save(tmp_path / "run", "a task", {"ip": site.ip})
    written = json.loads((tmp_path / "run" / "result.json").read_text())
    assert written["failure"] == ""
    assert [entry["phase"] for entry in written["phases"]] == ["up"]
    assert written["duration"] == pytest.approx(np.ptp(run.cell.log["time"]))
    assert {"run.rrd", "log.npz"} <= {file.name for file in (tmp_path / "run").iterdir()}


def test_a_dry_run_takes_the_same_way_at_a_share_of_the_speed():
    def task(cell, check):
        cell.move_straight(raised(cell, 0.02), speed=0.1)
        return ""

    fastest = {}
    for speed in (1.0, 0.2):
        with arm_at_home(speed=speed) as (_, site):
            run = run_on_arm(site, WORKPLACE, task)
        log = run.cell.log
        tool = panda.forward(torch.from_numpy(log["joint_position"])).position
        fastest[speed] = float((tool.diff(dim=0).norm(dim=-1) / 0.01).max())
        assert float(tool[-1, 2] - tool[0, 2]) == pytest.approx(0.02, abs=2e-3)
    assert fastest[0.2] < 0.35 * fastest[1.0]


def test_a_task_that_fails_ends_with_the_arm_at_rest_and_says_why():
    def task(cell, check):
        for _ in range(20):
            cell.step(torch.full((7,), 0.1, dtype=torch.float64))
        raise TaskFailedError("lost its way")

    with arm_at_home() as (world, site):
        run = run_on_arm(site, WORKPLACE, task)
        speed = np.abs(world.arm.read().joint_velocity).max()
    assert run.failure == "lost its way"
    assert speed < 1e-2


@pytest.mark.parametrize(
    ("wrong", "named"), [({"speed": 0.0}, "speed"), ({"dynamics": 1.5}, "dynamics")]
)
def test_sites_that_make_no_sense_are_refused(wrong, named):
    with pytest.raises(ValueError, match=named):
        ArmSite(ip="localhost", **wrong)


def test_an_arm_without_an_address_is_asked_for():
    with pytest.raises(ValueError, match="address"):
        run_on_arm(ArmSite(), WORKPLACE, lambda cell, check: "")


@pytest.mark.slow
def test_an_object_in_the_hand_is_placed(tmp_path):
    _, placing = teach(tmp_path)
    with arm_at_home() as (world, site):
        run = run_on_arm(site, WORKPLACE, placing_task(placing, WORKPLACE, "middle", 2.0))
    assert run.failure == ""
    assert world.rests_on(WORKPLACE.scene.objects[0].name, "board_middle")
    assert not world.cabinet_contacts.touches or all(
        "board" in touch.second for touch in world.cabinet_contacts.touches
    )
