"""A work cell on a world: what it is told of the world's delays, and who looks on."""

from contextlib import contextmanager, nullcontext
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from unchecked import shapes_unchecked

from hrc_learn.experiments import simulated_cell as cells
from hrc_learn.experiments.simulated_cell import (
    PROTOCOL_DELAY,
    ArmAccess,
    Observer,
    access_by,
    simulated_cell,
)
from hrc_learn.kinematics import ArmChoice
from hrc_learn.protocols import HumanInput
from hrc_learn.sim import Imperfections, World
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills.marker_sensor import LatencyConfig
from hrc_learn.skills.work_cell import WorkCellConfig
from hrc_learn.teleoperation import ScriptedPerturbation

pytestmark = pytest.mark.simulation

WORKPLACE = Workplace()


def world_of(**imperfections):
    sizes = replace(Imperfections.ideal(), **imperfections)
    drawn = sizes.draw(np.random.default_rng(0), 7, 1.0)
    world = World(WORKPLACE.scene, drawn)
    world.reset(WORKPLACE.home_joints().numpy(), {})
    return world


def opened(world, **options):
    human = ScriptedPerturbation(WORKPLACE.robot.chain, ())
    return simulated_cell(world, human=human, **options)


@pytest.mark.parametrize(
    ("own", "of_world", "expected"),
    [
        ((0.0, 0.0), (0.08, 0.2), (0.08, 0.2)),
        ((0.1, 0.1), (0.08, 0.2), (0.1, 0.2)),
        ((0.0, 0.3), (0.08, 0.2), (0.08, 0.3)),
    ],
)
def test_images_are_as_late_and_as_rare_as_world_or_cell_make_them(own, of_world, expected):
    """The larger value of each counts: they are two causes of the same delay."""
    world = world_of(image_delay=of_world[0], image_loss=of_world[1])
    latency = LatencyConfig(delay=own[0], frame_loss=own[1])
    with opened(world, config=WorkCellConfig(latency=latency)) as (cell, _):
        assert (cell.config.latency.delay, cell.config.latency.frame_loss) == expected


def test_a_cell_knows_the_delay_and_the_slowness_of_arm_and_driver():
    world = world_of(command_delay=0.02, servo_lag=0.01, slowness=0.1)
    access = ArmAccess(
        open=lambda world: nullcontext(world.opened_arm), delay=0.003, dynamics=0.5
    )
    with opened(world, access=access) as (cell, _):
        assert cell.config.command_delay == pytest.approx(0.02 + 0.003 + 0.01)
        driven = cell.config.safety
    with opened(world) as (cell, _):
        assert cell.config.command_delay == pytest.approx(0.02 + 0.01)
        direct = cell.config.safety
    # A slower driver brakes less, and a later one reacts later.
    assert driven.separation.reaction_time - direct.separation.reaction_time == pytest.approx(
        0.003
    )
    assert driven.braking < direct.braking


def test_the_world_moves_with_the_cell_and_is_looked_at_after_each_step():
    world, times, seen = world_of(), [], []

    @contextmanager
    def view(cell, shown, motion):
        seen.append(shown is world)
        yield
        seen.append("closed")

    with opened(
        world, on_step=lambda: times.append(world.time), observer=Observer(view=view)
    ) as (cell, _):
        assert torch.is_inference_mode_enabled()
        for _ in range(2):
            cell.step(torch.zeros(7, dtype=torch.float64))
        assert seen == [True]
        dt = cell.config.dt
    np.testing.assert_allclose(times, [dt, 2 * dt], atol=1e-9)
    assert seen[-1] == "closed"


class Page:
    """Pushes one joint, and counts the steps."""

    def __init__(self, world, dt, page, title):
        self.url, self.given, self.ticks, self.cell = "http://page", (dt, page, title), 0, None
        push = np.eye(7)[3]
        self.human = SimpleNamespace(
            read=lambda state: HumanInput(nullspace_input=push), tell=lambda feedback: None
        )

    def tick(self):
        self.ticks += 1

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.ticks = -self.ticks


def test_a_page_ticks_with_the_world_and_its_user_pushes(monkeypatch):
    made, told = [], []
    monkeypatch.setattr(cells, "TaskPage", lambda *given: made.append(Page(*given)) or made[-1])
    page: Any = "page"
    with (
        shapes_unchecked(),
        opened(world_of(), page=page, title="Grasp", observer=Observer(tell=told.append)) as (
            cell,
            _,
        ),
    ):
        assert made[0].cell is cell
        cell.step(torch.zeros(7, dtype=torch.float64))
        assert made[0].ticks == 1
        assert made[0].given == (cell.config.dt, "page", "Grasp")
        assert cell.human.read(cell.state).nullspace_input[3] == 1.0
    assert told == ["Page at http://page"]
    assert made[0].ticks == -1


@pytest.mark.parametrize("driver", ["franky", "franka"])
def test_a_driver_of_a_simulated_arm_waits_for_its_server(monkeypatch, driver):
    """Lockstep, no real-time threads, and the grip force of the simulated gripper."""
    asked = []
    for name in ("FrankyArm", "FrankaArm"):
        monkeypatch.setattr(
            cells, name, lambda *given, name=name: asked.append((name, given)) or "driver"
        )
    server = SimpleNamespace(running=nullcontext, address="1.2.3.4", advance="advance")
    monkeypatch.setattr(
        cells, "ServedArm", lambda driven, at: SimpleNamespace(close=lambda: None)
    )
    robot: Any = ArmChoice("panda").work_arm()
    serve: Any = lambda world: nullcontext(server)  # noqa: E731
    with shapes_unchecked():
        access = access_by(driver, robot, dynamics=0.4, serve=serve)
        with access.open("world") as found:
            assert found.advance == "advance"
    ((name, given),) = asked
    assert name == {"franky": "FrankyArm", "franka": "FrankaArm"}[driver]
    assert given[0] == "1.2.3.4"
    config = given[-1]
    assert config.realtime is False
    assert config.dynamics == 0.4
    if driver == "franky":
        assert config.grip_force == 40.0
    else:
        assert config.lockstep is True
    assert (access.delay, access.dynamics) == (PROTOCOL_DELAY, 0.4)
