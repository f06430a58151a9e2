"""Keys and gamepads, with a terminal and a controller that the tests play; several at once."""

import numpy as np
import pytest
import torch

from hrc_learn.kinematics import coarse_orientation, panda
from hrc_learn.protocols import ArmState, Human, HumanInput
from hrc_learn.teleoperation import InputFilter, InputFilterConfig, InteractionForceConfig
from hrc_learn.teleoperation.devices import (
    DIRECTIONS,
    Gamepad,
    GamepadConfig,
    KeyboardState,
    LinkGuide,
    TerminalKeyboard,
    deflection,
)

Q = panda.ready.numpy()
STATE = ArmState(time=0.0, joint_position=Q, joint_velocity=0 * Q, gripper_width=0.08)
SPEED = InteractionForceConfig().speed


class Clock:
    time = 0.0

    def __call__(self):
        return self.time


class Pad:
    """A controller with the names and numbers of SDL's."""

    def __init__(self, axes=None, buttons=()):
        self.axes, self.buttons, self.plugged = axes or {}, set(buttons), True

    def get_axis(self, axis):
        return self.axes.get(axis, 0)

    def get_button(self, button):
        return button in self.buttons

    def attached(self):
        return self.plugged


def test_the_numbers_are_those_of_the_library():
    pygame = pytest.importorskip("pygame", reason="the extra `gamepad` is not installed")
    controller = pytest.importorskip("pygame._sdl2.controller")
    from hrc_learn.teleoperation import devices as gamepad

    for name in ("get_axis", "get_button", "attached"):
        assert callable(getattr(controller.Controller, name))
    assert gamepad._LEFT_X == pygame.CONTROLLER_AXIS_LEFTX
    assert gamepad._LEFT_Y == pygame.CONTROLLER_AXIS_LEFTY
    assert gamepad._RIGHT_Y == pygame.CONTROLLER_AXIS_RIGHTY
    buttons = ("A", "B", "X", "Y", "BACK", "START")
    assert [getattr(pygame, f"CONTROLLER_BUTTON_{b}") for b in buttons] == list(gamepad.BUTTONS)
    assert gamepad._LEFT_SHOULDER == pygame.CONTROLLER_BUTTON_LEFTSHOULDER
    assert gamepad._RIGHT_SHOULDER == pygame.CONTROLLER_BUTTON_RIGHTSHOULDER


def test_a_gamepad_that_is_not_there_is_named():
    pytest.importorskip("pygame", reason="the extra `gamepad` is not installed")
    with pytest.raises(ValueError, match="no gamepad 63"):
        Gamepad.open(panda, index=63)


@pytest.mark.parametrize(
    ("axes", "way"),
    [
        ({1: -32767}, (1, 0, 0)),  # forward: away from the robot
        ({0: -32767}, (0, 1, 0)),  # left
        ({3: -32767}, (0, 0, 1)),  # up
        ({1: 32767, 0: 32767}, (-(0.5**0.5), -(0.5**0.5), 0)),
    ],
)
def test_sticks_lead_where_they_point(axes, way):
    asked = Gamepad(panda, Pad(axes)).read(STATE)
    np.testing.assert_allclose(asked.twist[:3], SPEED * np.array(way), atol=1e-12)
    assert not asked.nullspace_input.any()


def test_a_stick_near_its_middle_rests():
    for value in (0, 2000, -3900):
        assert not Gamepad(panda, Pad({1: value})).read(STATE).twist.any()


def test_deflection_is_continuous_bounded_and_keeps_its_direction():
    stick = np.array([0.6, -0.3, 0.1])
    stick /= np.linalg.norm(stick)
    lengths = np.linspace(0.0, 2.0, 400)
    effect = np.array([deflection(s * stick, 0.12, 2.0) @ stick for s in lengths])
    assert not effect[lengths <= 0.12].any()
    assert (np.diff(effect) > -1e-12).all()
    assert np.diff(effect).max() < 0.02
    assert effect[-1] == pytest.approx(1.0)
    assert effect[np.searchsorted(lengths, 0.56)] == pytest.approx(0.25, abs=0.01)
    np.testing.assert_allclose(
        np.cross(deflection(0.7 * stick, 0.12, 2.0), stick), 0, atol=1e-12
    )


def test_the_hand_turns_by_the_rule_while_it_is_led():
    asked = Gamepad(panda, Pad({3: -32767})).read(STATE)
    hand = panda.forward(torch.from_numpy(Q))
    goal = coarse_orientation(hand.position)
    # At "ready" the fingers close along y: the rule asks for a quarter turn about z.
    cosine = abs(float(goal @ hand.orientation))
    assert 2 * np.degrees(np.arccos(cosine)) == pytest.approx(90.0)
    np.testing.assert_allclose(
        np.abs(asked.twist[3:]), [0, 0, InteractionForceConfig().turn_speed], atol=1e-9
    )


def test_a_button_asks_once_for_each_time_it_goes_down():
    pad = Pad(buttons={0})
    gamepad = Gamepad(panda, pad)
    assert gamepad.read(STATE).requests == ("start",)
    assert gamepad.read(STATE).requests == ()
    pad.buttons = {1, 2}
    assert gamepad.read(STATE).requests == ("stop", "save")
    pad.buttons = set()
    gamepad.read(STATE)
    pad.buttons = {1}
    assert gamepad.read(STATE).requests == ("stop",)


def test_shoulder_buttons_open_and_close_the_gripper():
    pad = Pad()
    gamepad = Gamepad(panda, pad, config=GamepadConfig(opening=0.06))
    assert gamepad.read(STATE).gripper is None
    pad.buttons = {9}
    assert gamepad.read(STATE).gripper == 0.06
    pad.buttons = set()
    assert gamepad.read(STATE).gripper == 0.06
    pad.buttons = {10}
    assert gamepad.read(STATE).gripper == 0.0


def test_a_gamepad_that_is_unplugged_asks_for_nothing():
    pad = Pad({1: -32767}, buttons={0})
    pad.plugged = False
    asked = Gamepad(panda, pad).read(STATE)
    assert not asked.twist.any()
    assert asked.requests == ()


def test_the_device_is_read_before_it_is_asked():
    pad = Pad()
    asked = Gamepad(panda, pad, update=lambda: pad.axes.update({1: -32767})).read(STATE)
    assert asked.twist[0] == pytest.approx(SPEED)


@pytest.mark.parametrize("wrong", [{"dead_zone": 1.0}, {"dead_zone": -0.1}, {"curve": 0.0}])
def test_sticks_without_sense_are_refused(wrong):
    with pytest.raises(ValueError, match="dead_zone must be in"):
        GamepadConfig(**wrong)


def test_keys_count_for_a_moment_and_together():
    clock = Clock()
    keys = KeyboardState(holds_for=0.2, clock=clock)
    assert keys.press("i")
    assert not keys.press("x")
    assert keys.direction().tolist() == [1.0, 0.0, 0.0]
    clock.time = 0.15
    keys.press("u")
    np.testing.assert_allclose(keys.direction(), np.array([1, 0, 1]) / 2**0.5)
    clock.time = 0.2
    assert keys.direction().tolist() == [0.0, 0.0, 1.0]
    clock.time = 0.36
    assert not keys.direction().any()


def test_opposite_keys_cancel():
    keys = KeyboardState(clock=Clock())
    keys.press("j")
    keys.press("l")
    assert not keys.direction().any()
    assert {tuple(-x for x in d) for d in DIRECTIONS.values()} == set(DIRECTIONS.values())


def test_what_is_typed_leads_grips_and_asks():
    typed = iter(["i", "", "]13", "[q"])
    clock = Clock()
    keyboard = TerminalKeyboard(panda, lambda: next(typed), KeyboardState(0.3, clock))
    assert isinstance(keyboard, Human)
    asked = keyboard.read(STATE)
    np.testing.assert_allclose(asked.twist[:3], [SPEED, 0, 0])
    assert asked.gripper is None
    clock.time = 0.4
    assert not keyboard.read(STATE).twist.any()
    asked = keyboard.read(STATE)
    assert asked.requests == ("start", "save")
    assert asked.gripper == 0.0
    asked = keyboard.read(STATE)
    assert asked.requests == ("finish",)
    assert asked.gripper == 0.08


def test_a_keyboard_without_a_terminal_is_refused(monkeypatch):
    import io

    monkeypatch.setattr("sys.stdin", io.StringIO())
    with pytest.raises(ValueError, match="needs a terminal"):
        TerminalKeyboard.open(panda)


CONFIG = InputFilterConfig(linear=1.5, angular=5.0)
LED = np.array([0.25, 0.0, 0.0, 0.0, 0.4, 0.3])


class Person:
    twist = LED

    def read(self, state):
        return HumanInput(nullspace_input=np.ones(7), twist=self.twist, gripper=0.05)


def at(time):
    still = np.zeros(7)
    return ArmState(time=time, joint_position=still, joint_velocity=still, gripper_width=0.08)


def motion(person, times):
    eased = InputFilter(person, CONFIG)
    return np.stack([eased.read(at(time)).twist for time in times])


@pytest.mark.parametrize("dt", [0.001, 0.01, 0.04])
def test_speed_comes_up_at_the_rate_allowed_and_stays(dt):
    times = np.arange(0.0, 0.5, dt)
    twist = motion(Person(), times)
    linear, angular = LED[:3], LED[3:]
    ramp = np.minimum(times * CONFIG.linear / np.linalg.norm(linear), 1.0)
    np.testing.assert_allclose(twist[:, :3], ramp[:, None] * linear, atol=1e-12)
    ramp = np.minimum(times * CONFIG.angular / np.linalg.norm(angular), 1.0)
    np.testing.assert_allclose(twist[:, 3:], ramp[:, None] * angular, atol=1e-12)
    assert (twist[-1] == LED).all()  # to the last bit: nothing creeps on


def test_a_hand_that_is_let_go_comes_to_rest():
    person = Person()
    eased = InputFilter(person, CONFIG)
    for time in (0.0, 0.2):
        eased.read(at(time))
    person.twist = np.zeros(6)
    assert eased.read(at(0.21)).twist.any()
    assert not eased.read(at(0.41)).twist.any()


def test_all_else_is_handed_on_as_it_is():
    asked = InputFilter(Person()).read(at(3.0))
    assert not asked.twist.any()  # how long it has been asked for is not known yet
    np.testing.assert_array_equal(asked.nullspace_input, np.ones(7))
    assert asked.gripper == 0.05


def test_a_clock_that_is_set_back_stops_nothing_and_starts_nothing():
    eased = InputFilter(Person(), CONFIG)
    eased.read(at(5.0))
    before = eased.read(at(5.1)).twist
    np.testing.assert_array_equal(eased.read(at(0.0)).twist, before)
    assert np.linalg.norm(eased.read(at(0.05)).twist[:3]) > np.linalg.norm(before[:3])


@pytest.mark.parametrize("name", ["linear", "angular"])
def test_an_acceleration_that_is_none_is_refused(name):
    with pytest.raises(ValueError, match=f"{name} must be positive"):
        InputFilterConfig(**{name: 0.0})


@pytest.mark.parametrize("way", [(0.25, 0, 0), (0, -0.1, 0), (0, 0.9, 0.9)])
def test_a_device_leads_the_elbow_instead_of_the_hand(way):
    class Device:
        def read(self, state):
            return HumanInput(twist=np.array([*way, 0.1, 0.2, 0.3]), requests=("stop",))

    asked = LinkGuide(Device(), panda).read(STATE)
    assert not asked.twist.any()
    assert asked.requests == ("stop",)
    # The torques of a force along the way, as strong as the device is pushed, 45 N at most.
    J = panda.joint_jacobian(torch.from_numpy(Q), 4)[:3].numpy()
    force = np.array(way) / 0.25 * 45
    force *= min(1.0, 45 / np.linalg.norm(force))
    expected = J.T @ force
    np.testing.assert_allclose(asked.nullspace_input, expected, atol=1e-9)
