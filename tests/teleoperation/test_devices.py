"""Keys and gamepads, with a terminal and a controller that the tests play; several at once."""

import atexit
import ctypes
import os
import pty
import sys
import termios
from pathlib import Path
from types import SimpleNamespace
from typing import ClassVar

import numpy as np
import pytest
import torch

from hrc_learn.kinematics import coarse_orientation, panda
from hrc_learn.protocols import ArmState, Feedback, Human, HumanInput
from hrc_learn.teleoperation import InteractionForceConfig
from hrc_learn.teleoperation.devices import (
    DIRECTIONS,
    Gamepad,
    HapticDevice,
    KeyboardState,
    TerminalKeyboard,
    deflection,
    rumble_strength,
)
from hrc_learn.teleoperation.hand_guiding import (
    CombinedInput,
    InputFilter,
    InputFilterConfig,
    LinkGuide,
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
        self.pulses = []

    def get_axis(self, axis):
        return self.axes.get(axis, 0)

    def get_button(self, button):
        return button in self.buttons

    def attached(self):
        return self.plugged

    def rumble(self, low_frequency, high_frequency, duration):
        self.pulses.append((low_frequency, high_frequency, duration))
        return True


def test_the_numbers_are_those_of_the_library():
    pygame = pytest.importorskip("pygame", reason="the extra `gamepad` is not installed")
    controller = pytest.importorskip("pygame._sdl2.controller")
    from hrc_learn.teleoperation import devices as gamepad

    for name in ("get_axis", "get_button", "attached", "rumble"):
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
    with pytest.raises(ValueError, match="SDL finds no gamepad"):
        Gamepad.open(panda)


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
    assert asked.nullspace_input is None


def test_a_stick_near_its_middle_rests():
    for value in (0, 2000, -3900):
        assert not Gamepad(panda, Pad({1: value})).read(STATE).twist.any()


def test_deflection_is_continuous_bounded_and_keeps_its_direction():
    stick = np.array([0.6, -0.3, 0.1])
    stick /= np.linalg.norm(stick)
    lengths = np.linspace(0.0, 2.0, 400)
    effect = np.array([deflection(s * stick) @ stick for s in lengths])
    assert not effect[lengths <= 0.12].any()
    assert (np.diff(effect) > -1e-12).all()
    assert np.diff(effect).max() < 0.02
    assert effect[-1] == pytest.approx(1.0)
    assert effect[np.searchsorted(lengths, 0.56)] == pytest.approx(0.25, abs=0.01)
    np.testing.assert_allclose(np.cross(deflection(0.7 * stick), stick), 0, atol=1e-12)


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
    gamepad = Gamepad(panda, pad)
    assert gamepad.read(STATE).gripper is None
    pad.buttons = {9}
    assert gamepad.read(STATE).gripper == 0.08
    assert gamepad.read(STATE).gripper is None  # a press counts once
    pad.buttons = {10}
    assert gamepad.read(STATE).gripper == 0.0
    pad.buttons = set()
    gamepad.read(STATE)
    pad.buttons = {9, 10}
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


def test_keys_count_for_a_moment_and_together():
    clock = Clock()
    keys = KeyboardState(clock)
    keys.press("i")
    keys.press("x")
    assert keys.direction().tolist() == [0.4, 0.0, 0.0]
    clock.time = 0.15
    keys.press("u")
    np.testing.assert_allclose(keys.direction(), [0.4, 0, 0.4])
    clock.time = 0.7
    assert keys.direction().tolist() == [0.0, 0.0, 0.4]
    clock.time = 0.86
    assert not keys.direction().any()


@pytest.mark.parametrize(("delay", "period"), [(0.25, 0.03), (0.5, 0.033), (0.66, 0.1)])
def test_a_held_key_moves_without_a_pause_and_soon_ends(delay, period):
    clock = Clock()
    keys, speeds = KeyboardState(clock), []
    presses = [0.0, *np.arange(delay, 2.0, period)]
    for clock.time in np.arange(0.0, 2.5, 0.01):
        while presses and presses[0] <= clock.time:
            keys.press("j")
            presses.pop(0)
        speeds.append(keys.direction()[1])
    first, end = round(100 * delay) + 2, round(100 * (2.0 + 0.31))
    np.testing.assert_array_equal(speeds[: first - 3], 0.4)
    np.testing.assert_array_equal(speeds[first:200], 1.0)
    np.testing.assert_array_equal(speeds[end:], 0.0)


def test_opposite_keys_cancel():
    keys = KeyboardState(Clock())
    keys.press("j")
    keys.press("l")
    assert not keys.direction().any()
    assert {tuple(-x for x in d) for d in DIRECTIONS.values()} == set(DIRECTIONS.values())


def test_what_is_typed_leads_grips_and_asks():
    typed = iter(["i", "", "]13", "[q"])
    clock = Clock()
    keyboard = TerminalKeyboard(panda, lambda: next(typed), KeyboardState(clock))
    assert isinstance(keyboard, Human)
    asked = keyboard.read(STATE)
    np.testing.assert_allclose(asked.twist[:3], [0.4 * SPEED, 0, 0])
    assert asked.gripper is None
    clock.time = 0.8
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


def test_a_terminal_is_read_key_by_key_and_given_back(monkeypatch):
    ours, theirs = pty.openpty()
    given_back = []
    monkeypatch.setattr(atexit, "register", lambda *call: given_back.append(call))
    with os.fdopen(theirs, closefd=False) as terminal:
        monkeypatch.setattr("sys.stdin", terminal)
        before = termios.tcgetattr(theirs)
        keyboard = TerminalKeyboard.open(panda)
        assert not termios.tcgetattr(theirs)[3] & (termios.ICANON | termios.ECHO)
        assert keyboard.read(STATE).gripper is None  # nothing was typed: it does not wait
        os.write(ours, b"]" + 70 * b"x" + b"i")  # without the end of a line
        read = keyboard.read(STATE)
        assert read.gripper == 0.0
        assert read.twist[:3] @ np.array(DIRECTIONS["i"]) > 0
        (give, *values), *others = given_back
        assert others == []
        give(*values)
        assert termios.tcgetattr(theirs) == before
    os.close(ours)
    os.close(theirs)


def test_a_haptic_device_needs_its_library_and_a_device(monkeypatch):
    monkeypatch.setitem(sys.modules, "forcedimension_core", None)
    with pytest.raises(ValueError, match="extra `haptic` and Force Dimension's SDK"):
        HapticDevice.open(panda)
    dhd = SimpleNamespace(open=lambda: -1, errorGetLastStr=lambda: "no cable")
    monkeypatch.setitem(sys.modules, "forcedimension_core", SimpleNamespace(dhd=dhd))
    with pytest.raises(ValueError, match=r"no haptic device: no cable\."):
        HapticDevice.open(panda)
    dhd.open = lambda: 0
    assert isinstance(HapticDevice.open(panda), HapticDevice)


CONFIG = InputFilterConfig(linear=1.5, angular=5.0)
LED = np.array([0.25, 0.0, 0.0, 0.0, 0.4, 0.3])


class Person(Human):
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
    class Device(Human):
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


def feedback(followed=1.0, force=0.0, pace=1.0):
    return Feedback(
        pushed=followed < 1,
        followed=followed,
        contact_force=np.array([0.0, 0.6 * force, -0.8 * force]),
        pace=pace,
    )


@pytest.mark.parametrize(
    ("told", "slow", "quick"),
    [
        (feedback(), 0.0, 0.0),
        (feedback(followed=0.25), 0.0, 0.75),
        (feedback(force=20.0), 0.0, 0.0),
        (feedback(force=40.0), 0.5, 0.0),
        (feedback(force=500.0, followed=0.0), 1.0, 1.0),
        (feedback(pace=0.2), 0.8, 0.0),
        (feedback(force=40.0, pace=0.9), 0.5, 0.0),
        (Feedback(), 0.0, 0.0),  # an arm that feels nothing
    ],
)
def test_what_a_hand_at_the_gamepad_feels(told, slow, quick):
    assert rumble_strength(told) == pytest.approx((slow, quick))


def test_a_gamepad_rumbles_in_pulses_while_there_is_something_to_tell():
    pad, clock = Pad(), Clock()
    gamepad = Gamepad(panda, pad, clock=clock)
    for k in range(300):  # at 100 Hz: a second each of nothing, a hindrance, a contact
        clock.time = 0.01 * k
        gamepad.tell((feedback(), feedback(followed=0.3), feedback(force=60.0))[k // 100])
    assert pad.pulses == 4 * [(0.0, pytest.approx(0.7), 120)] + 4 * [(1.0, 0.0, 120)]
    pad.plugged = False
    clock.time = 9.0
    gamepad.tell(feedback(followed=0.0))
    assert len(pad.pulses) == 8


def test_a_motor_that_would_hardly_turn_is_left_alone():
    pad = Pad()
    Gamepad(panda, pad).tell(feedback(followed=0.95))
    assert pad.pulses == []


class VirtualJoystick(ctypes.Structure):
    """SDL_VirtualJoystickDesc of SDL 2.24 and later."""

    _fields_: ClassVar = [
        *((name, ctypes.c_uint16) for name in ("version", "type", "axes", "buttons", "hats")),
        *((name, ctypes.c_uint16) for name in ("vendor", "product", "padding")),
        *((name, ctypes.c_uint32) for name in ("button_mask", "axis_mask")),
        *((name, ctypes.c_void_p) for name in ("name", "userdata", "update", "player")),
        *((name, ctypes.c_void_p) for name in ("rumble", "triggers", "led", "effect")),
    ]


def test_the_motors_of_a_gamepad_of_the_librarys_own_turn(monkeypatch):
    """SDL itself makes the gamepad, and tells what its motors were asked for."""
    pytest.importorskip("pygame", reason="the extra `gamepad` is not installed")
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    with pytest.raises(ValueError, match="no gamepad"):  # which starts the library
        Gamepad.open(panda)
    maps = Path("/proc/self/maps")
    lines = maps.read_text().splitlines() if maps.exists() else []
    loaded = [line.split()[-1] for line in lines if "libSDL2-2" in line]
    if not loaded:
        pytest.skip("pygame's SDL is not to be found among the loaded libraries")
    sdl, asked = ctypes.CDLL(loaded[0]), []
    kind = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p, ctypes.c_uint16, ctypes.c_uint16)
    rumble = kind(lambda _, slow, quick: asked.append((slow, quick)) or 0)
    pad = VirtualJoystick(
        version=1, type=1, axes=6, buttons=15, rumble=ctypes.cast(rumble, ctypes.c_void_p)
    )
    index = sdl.SDL_JoystickAttachVirtualEx(ctypes.byref(pad))
    assert index >= 0
    try:
        gamepad = Gamepad.open(panda)
        assert not gamepad.read(STATE).twist.any()
        gamepad.tell(feedback(followed=0.5, force=60.0))
        assert asked == [(65535, 32767)]
    finally:
        sdl.SDL_JoystickDetachVirtual(index)


def test_all_that_lies_between_hands_on_what_the_arm_tells():
    pads, told = [Pad(), Pad()], feedback(followed=0.0)
    guide = LinkGuide(Gamepad(panda, pads[0]), panda)
    InputFilter(CombinedInput(guide, Gamepad(panda, pads[1]), Person())).tell(told)
    assert [len(pad.pulses) for pad in pads] == [1, 1]
