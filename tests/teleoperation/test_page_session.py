"""A page beside a task: who is there reaches the task, and time goes on for all."""

import time
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest
import torch

from hrc_learn.demos import DatasetWriter
from hrc_learn.kinematics import panda
from hrc_learn.protocols import DrawnRegion, Feedback, Human, HumanInput, Reason
from hrc_learn.regions import PositionRegion
from hrc_learn.sim import World
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills.work_cell import WorkCell
from hrc_learn.teleoperation import CombinedInput, ScriptedPerturbation, page_session
from hrc_learn.teleoperation.demonstration_recorder import DemonstrationRecorder
from hrc_learn.teleoperation.page import Page, PageConfig
from hrc_learn.teleoperation.page_operator import HeldGizmo
from hrc_learn.teleoperation.page_session import (
    FEATURES,
    PageSession,
    PageSessionConfig,
    TaskPage,
)
from hrc_learn.viz.palette import PERSON, VERMILION, rgba


class Pulling(Human):
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
    with TaskPage(world, 0.01, PageConfig()) as beside:
        assert beside.url.startswith("http://127.0.0.1:")
        yield beside


def joined(beside, person, advance):
    """A person and those at the page as one, and time that passes for both."""

    def advance_and_show(duration):
        advance(duration)
        beside.tick()

    return CombinedInput(person, beside.human), advance_and_show


class Asking(Human):
    """Asks once for the arm to go home."""

    def __init__(self):
        self.requests = ("home",)

    def read(self, state):
        requests, self.requests = self.requests, ()
        return HumanInput(requests=requests)


@contextmanager
def session_from(start, tmp_path):
    """A session with an arm that a driver leads, asked to go home from a posture [rad]."""
    pytest.importorskip("viser", reason="the extra `ui` is not installed")
    workplace, config = Workplace(), PageSessionConfig()
    world = World(workplace.scene)
    world.hold(workplace.scene.objects[0].name, start.numpy())
    writer = DatasetWriter(tmp_path / "demos", config.fps, "panda", panda.joint_names, FEATURES)
    page = Page(world, PageConfig(), task="show it")
    with DemonstrationRecorder(writer, lambda: page.task) as recorder, page:
        yield PageSession(
            workplace, page, recorder, world, opened=world.opened_arm, inputs=(Asking(),)
        )


@pytest.mark.long
@pytest.mark.simulation
def test_an_arm_with_a_driver_moves_home_and_never_jumps(tmp_path):
    home = Workplace().home_joints()
    start = home + torch.tensor([0.1, -0.05, 0.05, 0.05, 0.0, 0.05, -0.1]).double()
    with session_from(start, tmp_path) as session:
        path = [session.step().state.joint_position for _ in range(380)]
        assert session.world.holds(session.world.config.objects[0].name)
    np.testing.assert_allclose(path[0], start, atol=0.01)
    np.testing.assert_allclose(path[-1], home, atol=5e-3)
    assert np.abs(np.diff(path, axis=0)).max() < 0.01 * 0.5


@pytest.mark.simulation
@pytest.mark.long
def test_an_arm_with_a_driver_does_not_go_home_through_a_board(tmp_path):
    home, shelf = Workplace().home_joints(), Workplace().shelf("upper")
    with session_from(panda.inverse(shelf, near=home), tmp_path) as session:
        steps = [session.step() for _ in range(50)]
        status = session._status(steps[-1])
    note = status.note
    assert status.title == "Panda"
    assert "would meet board_upper" in note
    assert "guide the arm out first" in note
    moved = steps[-1].state.joint_position - steps[0].state.joint_position
    assert np.abs(moved).max() < 5e-3


def test_the_script_and_the_page_pull_together_while_somebody_holds_on(world, beside):
    human, _ = joined(beside, Pulling(), world.advance)

    def effort():
        return human.read(world.arm.read()).effort(7)

    np.testing.assert_array_equal(effort(), np.ones(7))
    beside.control.join("somebody")
    for _ in range(1000):  # the page renews what is asked, and may come in between
        beside.control.hear("somebody")
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
    _, advance = joined(beside, Pulling(), world.advance)
    began = time.perf_counter()
    for _ in range(20):
        advance(0.01)
    assert time.perf_counter() - began > 0.15
    assert world.time == pytest.approx(0.2)


def test_the_page_tells_what_the_task_and_its_safety_filter_do(world, beside):
    human, advance = joined(beside, ScriptedPerturbation(panda, ()), world.advance)
    cell = WorkCell(chain=panda, arm=world.arm, gripper=world.arm, human=human, advance=advance)
    beside.cell = cell
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
    assert status.region is None  # no controller is at work


def test_the_page_shows_the_region_that_a_controller_follows(world, beside, monkeypatch):
    monkeypatch.setattr(page_session, "_REMARK_STAYS", 0.05)
    human, advance = joined(beside, ScriptedPerturbation(panda, ()), world.advance)
    cell = WorkCell(chain=panda, arm=world.arm, gripper=world.arm, human=human, advance=advance)
    cell.region = PositionRegion(
        centre=torch.tensor([0.3, 0.4, 0.2], dtype=torch.float64),
        half_size=torch.tensor([0.1, 0.1, 0.003], dtype=torch.float64),
    )
    cell.tell("The region drawn leads the end effector.")
    status = beside.status(cell)
    assert status.region == DrawnRegion(centre=(0.3, 0.4, 0.2), half_size=(0.1, 0.1, 0.003))
    assert status.note == "The region drawn leads the end effector."
    cell.hold_pose(0.1)
    assert beside.status(cell).region is None
    assert beside.status(cell).note == ""


@pytest.mark.long
def test_the_page_shows_how_far_a_held_elbow_follows_and_why_not_further(world, beside):
    page = beside
    human, advance = joined(beside, ScriptedPerturbation(panda, ()), world.advance)
    cell = WorkCell(chain=panda, arm=world.arm, gripper=world.arm, human=human, advance=advance)
    # Both the arm's and its twin's, which viser's thread colours one after the other.
    elbows, wrist = page._scene._knobs[4], page._scene._knobs[6][0]
    far = panda.link_poses(cell.joints).position[3].numpy() + np.array([0.0, 0.02, 0.0])
    held = HeldGizmo(joint=4, held_at=np.zeros(3), pointer=far)
    page.control.join("somebody")

    def until(condition, holds=True):
        end = time.monotonic() + 60
        while not condition():
            assert time.monotonic() < end
            page.control.hear("somebody")
            if holds:
                page._held_gizmos.take((1, "elbow"), held)
            else:
                page._held_gizmos.release(1, "elbow")
            time.sleep(0.02)

    def arrow_colour():
        arrows = page._scene._arrows
        return tuple(np.ravel(arrows.colors)[:3]) if arrows.visible else None

    until(lambda: human.read(cell.state).effort(7).any())
    told = Feedback(
        pushed=True,
        followed=0.0,
        reasons=(Reason(hindrance="joint_limit", text="joint 4 is at its limit"),),
    )
    human.tell(told)
    until(lambda: all(elbow.color == rgba(VERMILION)[:3] for elbow in elbows))
    assert wrist.color == rgba(PERSON)[:3]
    until(lambda: "joint 4 is at its limit" in page._panel._told.content)
    until(lambda: arrow_colour() == rgba(VERMILION)[:3])
    # A pointer that goes on takes the arrow along.
    held = replace(held, pointer=far + 0.01)
    until(lambda: np.allclose(page._scene._arrows.points[0, 1], held.pointer, atol=1e-6))
    # What the loop itself tells takes its place, until nobody holds on.
    until(lambda: cell.hold_pose(0.01) or beside.human.feedback.pushed)
    assert beside.human.feedback is not told
    assert beside.human.feedback.followed > 0.5
    until(lambda: "follows by 100 %" in page._panel._told.content)
    until(lambda: cell.hold_pose(0.01) or not beside.human.feedback.pushed, holds=False)
    until(lambda: elbows[0].color == rgba(PERSON)[:3], holds=False)
    until(lambda: arrow_colour() is None, holds=False)
    until(lambda: page._panel._told.content == "", holds=False)
