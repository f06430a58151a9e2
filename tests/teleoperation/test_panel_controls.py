"""Controls of the page's panel, used as a browser uses them."""

import asyncio
import re
from types import SimpleNamespace

import numpy as np
import pytest

from hrc_learn.geometry import Box
from hrc_learn.kinematics import panda
from hrc_learn.protocols import DrawnRegion, Feedback
from hrc_learn.skills.grasping import OPEN
from hrc_learn.teleoperation.devices import DIRECTIONS
from hrc_learn.teleoperation.gate import messages
from hrc_learn.teleoperation.hand_guiding import InteractionForceConfig
from hrc_learn.teleoperation.page_operator import HeldGizmos
from hrc_learn.teleoperation.page_scene import PageScene
from hrc_learn.teleoperation.panel import PageStatus, Panel, felt_words

viser = pytest.importorskip("viser", reason="the extra `ui` is not installed")

BOARD = Box(centre=(0.4, 0.5, 0.0), half_size=(0.3, 0.3, 0.02), name="table")
FORCES = InteractionForceConfig(rate=2.0, stiffness=100.0, max_nullspace_input=20.0)


@pytest.fixture(scope="module")
def server():
    server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    yield server
    server.stop()


@pytest.fixture
def made(server):
    """A function that makes a panel, its scene, the gizmos held, and what was requested."""

    def panel(guides=True, draws=True, robot=panda):
        server.gui.reset()
        server.scene.reset()
        asked, held = [], HeldGizmos()
        scene = PageScene(server, [], [], held, robot, guides=guides, turns=True)
        with server.gui.add_folder("all"):
            found = Panel(
                server,
                [BOARD],
                FORCES,
                asked.append,
                asked.append,
                scene,
                "show it",
                draws=draws,
            )
        return found, scene, held, asked

    return panel


def control(server, label):
    """The control of a label, and a function that uses it."""
    (handle,) = [
        handle
        for handle in server.gui._gui_input_handle_from_uuid.values()
        if getattr(handle, "label", None) == label
    ]

    def use(value=None):
        if value is not None:
            handle._impl.value = value
        event = SimpleNamespace(target=handle, client_id=1)
        for callback in handle._impl.update_cb:
            asyncio.run(callback(event))

    return handle, use


def labels(server):
    handles = server.gui._gui_input_handle_from_uuid.values()
    return {handle.label for handle in handles if hasattr(handle, "label")}


RECORDING = {"Task", "Start", "Keep it?", "Session", "Fine turn", "Gripper"}
DRAWING = {"Draw on the table", "Active", "Clear the turn"}


@pytest.mark.parametrize("guides", [True, False])
@pytest.mark.parametrize("draws", [True, False])
def test_a_panel_has_the_controls_of_what_the_page_offers(made, server, guides, draws):
    panel, *_ = made(guides, draws)
    offered = labels(server)
    assert (offered & RECORDING) == (RECORDING if guides else set())
    assert (offered & DRAWING) == (DRAWING if draws else set())
    assert {"Virtual twin", "Strength [%]"} <= offered
    assert (panel.editor is not None) == draws
    assert panel.task == ("show it" if guides else "")
    # Messages of what is not offered are left alone.
    panel.hear(messages.Task(task="another"))
    panel.hear(messages.Region(centre=(1, 2, 3), half_size=(0.1, 0.2, 0.3), active=True))
    panel.hear(messages.Target(point=(1.0, 2.0, 3.0)))
    assert panel.task == ("another" if guides else "")
    if draws:
        region = DrawnRegion(centre=(1, 2, 3), half_size=(0.1, 0.2, 0.3))
        assert panel.editor.region == region
        assert panel.editor.target == (1.0, 2.0, 3.0)
        panel.hear(messages.Target(point=None))
        assert panel.editor.target is None
    panel.refresh(PageStatus(), Feedback(), np.zeros(7), 0)


def test_buttons_ask_for_what_they_say(made, server):
    _, scene, held, asked = made()
    _, start = control(server, "Start")
    start()
    for label, word in (
        ("Keep it?", "save"),
        ("Keep it?", "discard"),
        ("Session", "back to start"),
        ("Session", "finish"),
    ):
        control(server, label)[1](word)
    assert asked == ["start", "save", "discard", "home", "finish"]
    _, gripper = control(server, "Gripper")
    for word in ("open", "close", "close"):
        gripper(word)
    assert asked[5:] == [OPEN, 0.0, 0.0]
    for value in (False, True):
        control(server, "Virtual twin")[1](value)
        assert scene._twin.visible is value
        control(server, "Fine turn")[1](value)
        assert scene._gizmo.disable_rotations is not value
    held._turn = held._turn.new_tensor([0.0, 1.0, 0.0, 0.0])
    assert held.turn_vector is not None
    control(server, "Clear the turn")[1]()
    assert held.turn_vector is None


@pytest.mark.parametrize("key", DIRECTIONS)
def test_keys_move_the_end_effector(made, server, key):
    panel, *_ = made()
    commands = server.gui._command_handle_from_uuid.values()
    (command,) = [c for c in commands if c.hotkey == key.upper()]
    for callback in command._impl.trigger_cb:
        asyncio.run(callback(SimpleNamespace()))
    np.testing.assert_allclose(panel.keys.direction(), 0.4 * np.array(DIRECTIONS[key]))
    words = {"i": "away", "k": "back", "j": "left", "l": "right", "u": "up", "o": "down"}
    assert command.label == f"Move the end effector {words[key]}"


@pytest.mark.parametrize("percent", [20, 100, 150, 200])
def test_strength_scales_both_gains(made, server, percent):
    panel, *_ = made()
    slider, _ = control(server, "Strength [%]")
    assert (slider.min, slider.max, slider.step, slider.value) == (20, 200, 10, 100)
    slider._impl.value = percent
    assert panel.forces.rate == pytest.approx(2.0 * percent / 100)
    assert panel.forces.stiffness == pytest.approx(100.0 * percent / 100)
    assert panel.forces.speed == FORCES.speed


@pytest.mark.parametrize(
    ("state", "label", "disabled", "keep"),
    [
        ("ready", "Start", False, False),
        ("recording", "Stop", False, False),
        ("stopped", "Start", True, True),
    ],
)
def test_the_button_offers_what_can_be_done_now(made, server, state, label, disabled, keep):
    panel, _, _, asked = made()
    switch, press = control(server, "Start")
    kept, _ = control(server, "Keep it?")
    session, _ = control(server, "Session")
    panel.refresh(PageStatus(state=state), Feedback(), np.zeros(7), 1)
    assert (switch.label, switch.disabled, kept.visible) == (label, disabled, keep)
    assert switch.icon == {"Start": "player-record", "Stop": "player-stop"}[label]
    assert session.visible
    press()
    assert asked == [label.lower()]


def test_texts_show_status_input_turn_and_the_latest_intervention(made):
    panel, _, held, _ = made()

    def safety(**counts):
        status = PageStatus(title="Panda", interventions=counts)
        panel.refresh(status, Feedback(), np.array([10.0, -20.0]), 3)
        return panel._safety.content

    assert "has not had to act" in safety(velocity=0, jerk=0)
    assert "3 connected" in panel._state.content
    assert "Press Start" in panel._state.content
    # 10 of at most 20 N m fill half of one side.
    assert "left:50.0%;width:25.0%" in panel._bars.content
    assert "left:0.0%;width:50.0%" in panel._bars.content
    assert "not at all" in panel._turn_text.content
    assert bold(safety(velocity=1, jerk=0)) == ["velocity"]
    assert bold(safety(velocity=1, jerk=2)) == ["jerk"]
    assert bold(safety(velocity=1, jerk=2)) == ["jerk"]
    assert bold(safety(velocity=2, jerk=3)) == ["jerk"]
    assert bold(safety(velocity=3, jerk=3)) == ["velocity"]
    held._turn = held._turn.new_tensor([np.sqrt(0.5), 0.0, 0.0, -np.sqrt(0.5)])
    safety()
    assert "0, 0, -90 degrees about x, y, z" in panel._turn_text.content.replace("-0,", "0,")


def bold(html):
    """Names of the rows in bold."""
    rows = html.split("<tr ")[1:]
    names = [row.split("<td>")[1].split("</td>")[0] for row in rows if "600" in row]
    return [re.sub("<.*?>", "", name) for name in names]


TEXT, CHOICE, NUMBER, SWITCH = "Task", "Gripper", "Strength [%]", "Virtual twin"


@pytest.mark.parametrize(
    ("label", "value", "fits"),
    [
        (TEXT, "x" * 200, True),
        (TEXT, "x" * 201, False),
        (TEXT, 1, False),
        (TEXT, True, False),
        (CHOICE, "open", True),
        (CHOICE, "ajar", False),
        (NUMBER, 20, True),
        (NUMBER, 19.9, False),
        (NUMBER, 200.0, True),
        (NUMBER, 200.1, False),
        (NUMBER, True, False),
        (NUMBER, "100", False),
        (SWITCH, False, True),
        (SWITCH, 0, False),
        (SWITCH, "on", False),
    ],
)
def test_a_browser_sets_a_control_to_a_value_of_its_kind_within_its_range(
    made, server, label, value, fits
):
    panel, *_ = made()
    uuid = control(server, label)[0]._impl.uuid

    def update(**more):
        return messages.GuiUpdate(uuid=uuid, updates={"value": value} | more)

    assert panel.fits(update()) == fits
    assert not panel.fits(update(label="mine"))
    assert not panel.fits(messages.GuiUpdate(uuid="other", updates={"value": value}))
    assert not panel.fits(messages.GuiUpdate(uuid=uuid, updates={"label": "mine"}))


@pytest.mark.parametrize(
    ("force", "said"), [(19.9, []), (20.0, ["contact: 20 N"]), (23.0, ["contact: 25 N"])]
)
def test_forces_are_said_from_20_n_in_steps_of_5(force, said):
    assert felt_words(Feedback(contact_force=np.array([0.0, force, 0.0]))) == said


@pytest.mark.parametrize(
    ("slip", "said"), [(0.00099, []), (0.001, ["slip of the held object: 1 mm"])]
)
def test_a_slip_is_said_from_a_millimetre(slip, said):
    assert felt_words(Feedback(slip=slip)) == said


def test_a_person_at_the_arm_is_no_distance_away():
    (said,) = felt_words(Feedback(person_distance=-0.2, pace=0.0))
    assert said == "nearest person: 0.0 m away, pace 0 %"
