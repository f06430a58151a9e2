"""A recording session, step by step: what is asked, recorded, remarked and shown."""

from contextlib import ExitStack
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
import torch
from unchecked import shapes_unchecked

from hrc_learn.controller import INTERVENTIONS
from hrc_learn.demos import DatasetWriter, load_demos
from hrc_learn.kinematics import panda
from hrc_learn.protocols import DrawnRegion, Human, HumanInput
from hrc_learn.sim import World
from hrc_learn.sim.workplace import Workplace
from hrc_learn.teleoperation import page_session
from hrc_learn.teleoperation.demonstration_recorder import DemonstrationRecorder
from hrc_learn.teleoperation.gate.messages import TrackedHand
from hrc_learn.teleoperation.hand_guiding import HandGuidingConfig
from hrc_learn.teleoperation.page_session import (
    FEATURES,
    PageSession,
    PageSessionConfig,
    _way,
    place_target_hint,
    place_targets,
)
from hrc_learn.viz.palette import GREEN, rgba

pytestmark = pytest.mark.simulation

WORKPLACE = Workplace()
HOME = WORKPLACE.home_joints().numpy()
ITEM = WORKPLACE.scene.objects[0].name


class Script(Human):
    """Input of chosen steps; nothing otherwise."""

    def __init__(self):
        self.steps, self.now = {}, 0

    def read(self, state):
        self.now += 1
        return self.steps.get(self.now - 1, HumanInput())


class Screen:
    """The parts of a page that a session uses."""

    def __init__(self):
        self.human, self.hands, self.shown, self.placed = Script(), {}, [], 0
        self.control = SimpleNamespace(people=1)
        self.farewell = ""

    def place(self):
        self.placed += 1

    def show(self, status):
        self.shown.append((self.human.now - 1, status))


class Fingers:
    """Openings that a gripper is sent."""

    def __init__(self):
        self.sent = []

    def move(self, width):
        self.sent.append(width)


@pytest.fixture(scope="module")
def world():
    return World(WORKPLACE.scene)


@pytest.fixture
def screen():
    return Screen()


@pytest.fixture
def session(world, screen, tmp_path):
    """A session of the simulated arm, recorded at every second step."""
    made: Any = screen
    fps, folder = PageSessionConfig().fps, tmp_path / "demos"
    writer = DatasetWriter(folder, fps, "panda", panda.joint_names, FEATURES)
    with shapes_unchecked(), ExitStack() as stack:
        recorder = stack.enter_context(DemonstrationRecorder(writer, lambda: "show it"))
        found: Any = PageSession(WORKPLACE, made, recorder, world)
        found.recorder, found.close = recorder, stack.close
        yield found


def request(name):
    return HumanInput(requests=(name,))


MOVE = HumanInput(twist=np.array([0.1, 0.0, 0.0, 0.0, 0.0, 0.0]))


def run(session, steps):
    return [session.step() for _ in range(steps)]


def test_every_second_step_is_recorded_with_all_that_was_asked(session, screen, tmp_path):
    region = DrawnRegion(centre=(0.3, 0.2, 0.4), half_size=(0.5, 0.6, 0.7))
    asked = HumanInput(twist=MOVE.twist, region=region)
    screen.human.steps = dict.fromkeys(range(1, 64), asked) | {0: request("start")}
    hand = TrackedHand(hand="right", position=(1.0, 2.0, 3.0), orientation=(0.0, 1.0, 0.0, 0.0))
    screen.hands = {"right": hand}
    steps = run(session, 64)
    session.close()
    (demo,) = load_demos(tmp_path / "demos")
    assert demo.fps == pytest.approx(50.0)
    # Step 0 starts the recording, so that steps 2, 4, ... are kept.
    recorded = [s.state.joint_position for s in steps[2::2]]
    np.testing.assert_allclose(demo.joint_position, recorded, atol=1e-6)
    np.testing.assert_allclose(np.diff(demo.time), 0.02, atol=1e-6)
    (table,) = (tmp_path / "demos").rglob("data/**/*.parquet")
    columns = pq.read_table(table).to_pydict()
    regions = np.stack(columns["observation.region"])
    np.testing.assert_allclose(regions, np.tile([0.3, 0.2, 0.4, 0.5, 0.6, 0.7], (31, 1)))
    hands = {side: np.stack(columns[f"observation.{side}_hand"]) for side in ("left", "right")}
    assert not hands["left"].any()
    np.testing.assert_allclose(hands["right"], np.tile([1, 2, 3, 0, 1, 0, 0], (31, 1)))
    twists = np.stack(columns["observation.human_twist"])
    np.testing.assert_allclose(twists[-1], MOVE.twist, atol=1e-6)


def test_the_gripper_is_sent_a_width_once(session, screen):
    fingers: Any = Fingers()
    session._opened = SimpleNamespace(
        arm=session._opened.arm, gripper=fingers, advance=session._opened.advance
    )
    widths = [None, 0.0, 0.0, None, 0.0, 0.08, 0.08, 0.0]
    screen.human.steps = {k: HumanInput(gripper=width) for k, width in enumerate(widths)}
    run(session, len(widths) + 3)
    assert fingers.sent == [0.0, 0.08, 0.0]
    assert screen.placed == len(widths) + 3


def test_a_gripper_that_home_has_closed_is_opened_again(session, screen):
    asked = {0: HumanInput(gripper=0.08), 1: request("home"), 2: HumanInput(gripper=0.08)}
    screen.human.steps = asked
    held = session.world.config.objects[0].name
    grips = []
    for _ in range(60):
        session.step()
        grips.append(session.world.holds(held))
    assert grips[1]
    assert not grips[-1]


def test_each_step_lets_a_control_period_pass_and_every_tenth_is_shown(session, screen, world):
    began = world.time
    run(session, 21)
    assert world.time - began == pytest.approx(0.21)
    assert [k for k, _ in screen.shown] == [0, 10, 20]


def test_a_recording_that_all_have_left_stops_after_5_seconds(session, screen):
    screen.human.steps = {0: request("start")}
    step = session.step()

    def pass_steps(count, people):
        screen.control.people = people
        for _ in range(count):
            session._stop_when_left()
        return session.recorder.state

    assert pass_steps(600, people=0) == "recording"  # by somebody with a gamepad
    for _ in range(2):  # a page that is opened again in time
        assert pass_steps(1, people=1) == "recording"
        assert pass_steps(500, people=0) == "recording"
    assert pass_steps(1, people=0) == "stopped"
    note = session._status(step).note
    assert "the recording was stopped: no browser was open for 5 s" in note
    # The next request takes the remark away, and the next recording counts anew.
    screen.human.steps = {screen.human.now: request("start")}
    assert "browser" not in session._status(session.step()).note
    assert pass_steps(600, people=0) == "recording"
    assert pass_steps(1, people=2) == "recording"
    session.recorder.handle("stop")
    pass_steps(1, people=0)
    session.recorder.handle("start")
    assert pass_steps(600, people=0) == "recording"


@pytest.mark.parametrize(("saves", "said"), [(0, "0 demonstrations"), (1, "1 demonstration ")])
def test_a_session_that_is_finished_names_what_it_saved(session, screen, world, saves, said):
    if saves:
        screen.human.steps = dict.fromkeys(range(1, 70), MOVE) | {0: request("start")}
        run(session, 70)
    screen.human.steps = {screen.human.now: request("finish")}
    assert not session.finished
    assert "was ended" in screen.farewell
    run(session, 1)
    assert session.finished
    assert f"Finished: {said}" in screen.farewell
    was = world.arm.read().joint_position
    world.advance(0.2)
    np.testing.assert_allclose(world.arm.read().joint_position, was, atol=5e-3)
    assert session.recorder.status.saved == saves


def test_the_simulated_arm_jumps_home_with_its_object_and_stops_recording(
    session, screen, world
):
    screen.human.steps = dict.fromkeys(range(1, 40), MOVE) | {0: request("start")}
    assert np.abs(run(session, 40)[-1].state.joint_position - HOME).max() > 0.02
    screen.human.steps = {screen.human.now: request("home")}
    run(session, 1)
    assert session.recorder.state == "stopped"
    np.testing.assert_allclose(world.arm.read().joint_position, HOME, atol=1e-3)
    assert world.holds(ITEM)
    # An arm that goes home while nothing is recorded leaves the recorder alone.
    session.recorder.handle("discard")
    screen.human.steps = {screen.human.now: request("home")}
    run(session, 1)
    assert session.recorder.state == "ready"


def test_the_status_guides_to_the_shelf_while_a_demonstration_is_open(session, screen, world):
    step = session.step()
    ready = session._status(step)
    assert ready.title == "Panda (simulated)"
    assert ready.state == "ready"
    assert ready.note == ""
    assert list(ready.interventions) == list(INTERVENTIONS)
    session.arm.safety.counts[3] += 7
    screen.human.steps = {screen.human.now: request("start")}
    step = run(session, 2)[-1]
    status = session._status(step)
    assert status.state == "recording"
    assert status.note == place_target_hint(WORKPLACE, step.pose.position.numpy())
    assert list(status.interventions.values())[3] >= 7
    session._remark = "a remark"
    session.recorder.handle("save")
    said = session._status(step).note.split("; ")
    assert said[-1] == "a remark"
    assert "nothing to save" in said[-2]


def test_contacts_since_the_last_frame_are_noted_while_recording(session, world):
    step, touched = session.step(), []
    session.world = SimpleNamespace(
        time=1.0,
        arm=world.arm,
        touched_since=lambda time: touched.append(time) or (f"since {time:g}",),
    )
    assert session._met(step) == ()
    assert touched == []
    session.recorder.handle("start")
    session.world.time = 2.5
    assert session._met(step) == ("since 1",)
    session.world.time = 4.0
    assert session._met(step) == ("since 2.5",)


def test_every_touch_of_cabinet_table_and_arm_is_counted(session):
    step = session.step()
    monitors = [SimpleNamespace(touches=[None] * n) for n in (1, 20, 300)]
    names = ("cabinet_contacts", "table_contacts", "self_contacts")
    session.world = SimpleNamespace(**dict(zip(names, monitors, strict=True)))
    assert session._status(step).contacts == 321


@pytest.mark.parametrize(("dt", "every", "fps"), [(0.01, 2, 50.0), (0.004, 5, 50.0)])
def test_the_frame_rate_follows_from_the_control_period(dt, every, fps):
    guiding = HandGuidingConfig(dt=dt)
    assert PageSessionConfig(guiding=guiding, record_every=every).fps == pytest.approx(fps)


def test_fields_lie_on_the_boards_and_are_as_large_as_the_object():
    half = WORKPLACE.scene.objects[0].half_size
    for box in place_targets(WORKPLACE):
        assert box.half_size == (half[0], half[2], 0.002)
        np.testing.assert_allclose(np.multiply(box.colour, 255), rgba(GREEN))


@pytest.mark.parametrize(
    ("cm", "said"), [(0.99, "there"), (1.01, "1 cm away"), (-1.6, "2 cm back")]
)
def test_a_centimetre_is_near_enough(cm, said):
    goal = WORKPLACE.shelf("lower").position.numpy()
    assert place_target_hint(WORKPLACE, goal - [cm / 100, 0, 0]) == f"lower shelf: {said}"


@pytest.mark.parametrize(("length", "points"), [(1, 1), (5, 5), (24, 24), (25, 24), (300, 24)])
def test_a_plan_is_drawn_by_24_points_from_start_to_end(length, points):
    cell: Any = SimpleNamespace(chain=panda, plan=HOME + np.linspace(0, 0.3, length)[:, None])
    drawn = _way(cell)
    assert drawn.shape == (points, 3)
    for end in (0, -1):
        expected = panda.forward(torch.from_numpy(cell.plan[end])).position
        np.testing.assert_allclose(drawn[end], expected, atol=1e-12)
    steps = np.linalg.norm(np.diff(drawn, axis=0), axis=1)
    assert (steps > 0).all()
    cell.plan = None
    assert _way(cell) is None


def test_a_page_beside_a_task_counts_touches_and_interventions():
    cell: Any = SimpleNamespace(
        log=SimpleNamespace(events=[SimpleNamespace(text="grasp")]),
        remarks=[SimpleNamespace(text="a remark", time=1.0)],
        time=6.99,
        region=None,
        plan=None,
    )

    class Log(dict):
        events = cell.log.events

        def __len__(self):
            return len(self["safety"])

    cell.log = Log(safety=np.eye(len(INTERVENTIONS), dtype=int)[[1, 1, 2]])
    world = SimpleNamespace(
        cabinet_contacts=SimpleNamespace(touches=[1, 2]),
        table_contacts=SimpleNamespace(touches=[1, 2, 3]),
    )
    page: Any = SimpleNamespace(_world=world, _title="Job")
    status = page_session.TaskPage.status(page, cell)
    assert (status.title, status.doing, status.contacts) == ("Job", "grasp", 5)
    assert [*status.interventions.values()][:4] == [0, 2, 1, 0]
    assert status.note == "a remark"
    cell.time = 7.01
    assert page_session.TaskPage.status(page, cell).note == ""
    cell.log = Log(safety=np.zeros((0, len(INTERVENTIONS)), dtype=int))
    assert set(page_session.TaskPage.status(page, cell).interventions.values()) == {0}


@pytest.mark.parametrize(("ticks", "shown"), [(1, 1), (10, 1), (11, 2), (21, 3)])
def test_a_page_beside_a_task_shows_every_tenth_step(ticks, shown):
    statuses = []
    page: Any = SimpleNamespace(
        place=lambda: None,
        show=statuses.append,
        status=lambda cell: cell,
        cell="cell",
        _ticks=0,
        _rate=SimpleNamespace(wait=lambda: None),
    )
    for _ in range(ticks):
        page_session.TaskPage.tick(page)
    assert statuses == ["cell"] * shown
    page.cell, page._ticks = None, 0
    page_session.TaskPage.tick(page)
    assert len(statuses) == shown
