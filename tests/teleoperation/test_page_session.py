"""A page beside a task: who is there reaches the task, and time goes on for all."""

import time

import numpy as np
import pytest
import torch

from hrc_learn.kinematics import panda
from hrc_learn.protocols import HumanInput
from hrc_learn.sim import World
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills.work_cell import WorkCell
from hrc_learn.teleoperation import ScriptedPerturbation
from hrc_learn.teleoperation.page import PageConfig
from hrc_learn.teleoperation.page_session import task_page


class Pulling:
    """Asks for the same effort as long as it is allowed to."""

    def read(self, state):
        return HumanInput(nullspace_input=np.ones(7))


@pytest.fixture
def world():
    workplace = Workplace()
    world = World(workplace.scene)
    world.reset(workplace.home_joints().numpy())
    return world


@pytest.fixture
def beside(world):
    pytest.importorskip("viser", reason="the extra `ui` is not installed")
    opened = []
    with task_page(world, 0.01, PageConfig(port=8500), opened.append) as beside:
        assert opened[0].startswith("http://127.0.0.1:")
        yield beside


def test_the_script_and_the_page_pull_together_while_somebody_holds_on(world, beside):
    human, _ = beside.joined(Pulling(), world.advance)

    def effort():
        return human.read(world.arm.read()).nullspace_input

    np.testing.assert_array_equal(effort(), np.ones(7))
    for _ in range(1000):  # the page renews what is asked, and may come in between
        beside.human.post(HumanInput(nullspace_input=np.arange(7.0)))
        if (pulled := effort()).any() and pulled[6] > 1:
            break
    np.testing.assert_array_equal(pulled, np.arange(7.0) + 1)
    # Nobody holds anything in a browser, so the page takes the pull back.
    end = time.monotonic() + 60
    while effort()[6] > 1:
        assert time.monotonic() < end
        time.sleep(0.02)


def test_time_passes_for_the_world_as_it_does_for_the_person(world, beside):
    _, advance = beside.joined(Pulling(), world.advance)
    began = time.perf_counter()
    for _ in range(20):
        advance(0.01)
    assert time.perf_counter() - began > 0.15
    assert world.time == pytest.approx(0.2)


def test_the_page_tells_what_the_task_and_its_safety_filter_do(world, beside):
    human, advance = beside.joined(ScriptedPerturbation(panda, ()), world.advance)
    cell = WorkCell(chain=panda, arm=world.arm, gripper=world.arm, human=human, advance=advance)
    beside.follow(cell)
    assert beside.status(cell).doing == "getting ready"
    cell.begin_phase("interact")
    for _ in range(5):
        cell.step(torch.full((7,), 50.0, dtype=torch.float64))  # far beyond the limits
    status = beside.status(cell)
    assert status.doing == "interact"
    assert "Pull" in status.note
    assert status.seconds == pytest.approx(0.05)
    assert status.interventions["velocity"] == 5
    assert status.interventions["invalid"] == 0
    cell.begin_phase("grasp")
    assert beside.status(cell).note == ""
