"""Devices that move the end effector: a gamepad, the keys of a terminal, and a haptic device
with force feedback, such as the Omega of the paper.

A device implements `Human.read`, which returns the person's input at each step. The haptic
device has not been run on hardware: it needs `forcedimension-core` (the extra `haptic`) and the
maker's SDK; tests drive the same interface without a device.
"""

from __future__ import annotations

import contextlib
import os
import select
import sys
import time
from collections.abc import Callable
from threading import Event, Thread
from types import MappingProxyType
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from hrc_learn.kinematics import SerialChain
from hrc_learn.protocols import ArmState, Feedback, Human, HumanInput, Request
from hrc_learn.teleoperation.hand_guiding import (
    InteractionForceConfig,
    capped,
    guiding_twist,
)
from hrc_learn.teleoperation.page_operator import gizmo_command

OPEN = 0.08
"""Width of the open gripper [m]."""


# SDL's layout of a game controller, the same for every make (CONTROLLER_AXIS_*, _BUTTON_*).
_LEFT_X, _LEFT_Y, _RIGHT_Y = 0, 1, 3
_A, _B, _X, _Y, _BACK, _START, _LEFT_SHOULDER, _RIGHT_SHOULDER = 0, 1, 2, 3, 4, 6, 9, 10
_FULL = 32767.0  # value of an axis at its end

BUTTONS: MappingProxyType[int, Request] = MappingProxyType(
    {_A: "start", _B: "stop", _X: "save", _Y: "discard", _BACK: "home", _START: "finish"}
)
"""Request sent by each button: A starts, B stops, X saves, Y discards, "back" returns home,
"start" finishes.
"""


# Rumble: the slow motor reports contact and nearby people; the quick motor reports input that
# the arm does not follow. Pulses are easier to notice than motors that run continuously.
PULSE_EVERY, _PULSE = 0.25, 0.12  # period and duration of the pulses [s]
_LEAST_RUMBLE = 0.1  # fraction of full strength below which motors hardly turn
_CONTACT = (20.0, 60.0)
"""Contact forces at which pulses begin, and at which they are strongest [N]. Friction of the
simulated joints looks like a contact of 17 N; a scripted person pulls with 60 N at most."""


def rumble_strength(feedback: Feedback) -> tuple[float, float]:
    """Strengths of a gamepad's slow and quick motors, 0 to 1.

    Args:
        feedback: Feedback of the arm.
    """
    met, (least, most) = 0.0, _CONTACT
    if feedback.contact_force is not None:
        met = (float(np.linalg.norm(feedback.contact_force)) - least) / (most - least)
    slow = min(max(met, 1.0 - feedback.pace, 0.0), 1.0)
    return slow, 1.0 - feedback.followed


_DEAD_ZONE = 0.12
"""Fraction of its range in which a stick has no effect: worn sticks do not return to 0."""
_CURVE = 2.0
"""Exponent of the deflection; above 1, control is finer near the middle."""


def deflection(stick: Float[np.ndarray, " axes"]) -> Float[np.ndarray, " axes"]:
    """Effect of a stick: a vector of length 0 to 1 in the direction of the stick.

    It is zero in the dead zone and rises continuously from the edge of the zone. The zone is a
    ball: separate zones for each axis would bend slow motions towards the axes.

    Args:
        stick: Deflection of the stick, each axis -1 to 1.
    """
    length = float(np.linalg.norm(stick))
    if length <= _DEAD_ZONE:
        return np.zeros_like(stick)
    beyond = min((length - _DEAD_ZONE) / (1 - _DEAD_ZONE), 1.0)
    return stick / length * beyond**_CURVE


class Gamepad(Human):
    """Moves the end effector by sticks: the left one horizontally, the right one vertically.

    Shoulder buttons open and close the gripper; other buttons send the requests of `BUTTONS`.
    The end effector turns to the orientation that `coarse_orientation` gives for its position.
    An unplugged gamepad requests nothing. The gamepad rumbles when the arm touches something,
    slows down for people, or does not follow the input.

    Attributes:
        forces: Largest speeds, and orientation of the end effector.
    """

    def __init__(
        self,
        chain: SerialChain,
        controller: Any,
        update: Callable[[], None] = lambda: None,
        clock: Callable[[], float] = time.monotonic,
    ):
        """Take an open controller; `Gamepad.open` finds a controller.

        Args:
            chain: The arm that is guided.
            controller: The gamepad, as `pygame._sdl2.controller.Controller`.
            update: Lets the library read the device.
            clock: Monotonic clock [s].
        """
        self._chain, self._controller, self._update = chain, controller, update
        self.forces = InteractionForceConfig()
        self._clock, self._next_pulse = clock, float("-inf")
        self._held: set[int] = set()

    @classmethod
    def open(cls, chain: SerialChain) -> Gamepad:
        """Open the first gamepad with pygame, which the extra `gamepad` installs.

        Args:
            chain: The arm that is guided.

        Raises:
            ValueError: There is no gamepad.
        """
        # This program has no window, so SDL must report events without a focused window.
        os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
        os.environ.setdefault("SDL_JOYSTICK_ALLOW_BACKGROUND_EVENTS", "1")
        os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
        import pygame
        from pygame._sdl2 import controller as library

        pygame.display.init()
        library.init()
        found = [k for k in range(library.get_count()) if library.is_controller(k)]
        if not found:
            raise ValueError(
                "SDL finds no gamepad: plug one in. This user must be able to read /dev/input."
            )
        return cls(chain, library.Controller(found[0]), pygame.event.pump)

    def read(self, state: ArmState) -> HumanInput:
        """Motion of the end effector, gripper and requests, from present sticks and buttons."""
        self._update()
        if not self._controller.attached():
            self._held = set()
            return HumanInput()
        buttons = (*BUTTONS, _LEFT_SHOULDER, _RIGHT_SHOULDER)
        held = {button for button in buttons if self._controller.get_button(button)}
        pressed, self._held = held - self._held, held
        opens = OPEN if _LEFT_SHOULDER in pressed else None
        return HumanInput(
            twist=self._twist(state),
            gripper=0.0 if _RIGHT_SHOULDER in pressed else opens,
            requests=tuple(BUTTONS[b] for b in sorted(pressed & BUTTONS.keys())),
        )

    def tell(self, feedback: Feedback) -> None:
        """Rumble in pulses, one per `PULSE_EVERY`; a gamepad without motors stays still."""
        now = self._clock()
        if now < self._next_pulse:
            return
        slow, quick = rumble_strength(feedback)
        if max(slow, quick) >= _LEAST_RUMBLE and self._controller.attached():
            self._controller.rumble(slow, quick, round(1000 * _PULSE))
            self._next_pulse = now + PULSE_EVERY

    def _twist(self, state: ArmState) -> Float[np.ndarray, "6"]:
        x, y, z = (
            self._controller.get_axis(axis) / _FULL for axis in (_LEFT_X, _LEFT_Y, _RIGHT_Y)
        )
        # A stick that points forward or up reads negative; the base's y axis points left.
        q, direction = state.joint_position, deflection(np.array([-y, -x, -z]))
        return gizmo_command(self._chain, q, (), self.forces, direction=direction).twist


DIRECTIONS = MappingProxyType(
    {
        "i": (1.0, 0.0, 0.0),
        "k": (-1.0, 0.0, 0.0),
        "j": (0.0, 1.0, 0.0),
        "l": (0.0, -1.0, 0.0),
        "u": (0.0, 0.0, 1.0),
        "o": (0.0, 0.0, -1.0),
    }
)
"""Direction of each key in the base frame: i away from the robot, j to its left, u up."""


_FIRST, _REPEATED, _TAP = 0.7, 0.3, 0.4
"""`_FIRST`: time for which a first press counts [s]; keyboards begin to repeat a held key after
0.25 to 0.66 s. `_REPEATED`: time for which a repeat counts [s]. `_TAP`: fraction of the largest
speed before the key repeats; at this speed, a tap moves the end effector by 7 cm."""


class KeyboardState:
    """Keys held down, and the direction that they request.

    Terminals report presses and repeats but no releases. A press or repeat therefore counts for
    a limited time. A first press moves slowly until a repeat shows that the key is held. A
    keyboard that falls silent requests no motion.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic):
        """Start with no key held.

        Args:
            clock: Monotonic clock [s].
        """
        self._clock = clock
        # Time until which each key counts [s], and its fraction of the speed.
        self._held = dict.fromkeys(DIRECTIONS, (float("-inf"), 0.0))

    def press(self, key: str) -> None:
        """Note a press or repeat; keys that are not in `DIRECTIONS` have no effect."""
        if key in self._held:
            now = self._clock()
            repeats = now < self._held[key][0]
            self._held[key] = (now + _REPEATED, 1.0) if repeats else (now + _FIRST, _TAP)

    def direction(self) -> Float[np.ndarray, "3"]:
        """Direction requested now, as a fraction of the largest speed."""
        now = self._clock()
        speeds = {key: speed for key, (until, speed) in self._held.items() if now < until}
        held = [speed * np.array(DIRECTIONS[key]) for key, speed in speeds.items()]
        return capped(np.sum([np.zeros(3), *held], axis=0), 1.0)


KEYS: MappingProxyType[str, Request] = MappingProxyType(
    {"1": "start", "2": "stop", "3": "save", "4": "discard", "0": "home", "q": "finish"}
)
"""Request sent by each key; `DIRECTIONS` has the keys that move the end effector."""

_GRIPPER = {"[": OPEN, "]": 0.0}


class TerminalKeyboard(Human):
    """Moves the end effector by keys: i/k away and back, j/l left and right, u/o up and down.

    [ opens the gripper, ] closes it; `KEYS` has the requests. The end effector turns to the
    orientation that `coarse_orientation` gives for its position.

    Attributes:
        forces: Largest speeds, and orientation of the end effector.
    """

    def __init__(
        self, chain: SerialChain, typed: Callable[[], str], keys: KeyboardState | None = None
    ):
        """Take a source of characters; `TerminalKeyboard.open` takes the terminal.

        Args:
            chain: The arm that is guided.
            typed: Returns the characters typed since the last call, without waiting.
            keys: State of the keys.
        """
        self._chain, self._typed, self._keys = chain, typed, keys or KeyboardState()
        self.forces = InteractionForceConfig()

    @classmethod
    def open(cls, chain: SerialChain) -> TerminalKeyboard:
        """Read the terminal this process runs in, key by key, until the process ends.

        Raises:
            ValueError: Standard input is not a terminal.
        """
        if not sys.stdin.isatty():
            raise ValueError("the keyboard needs a terminal: standard input is none.")
        _take_terminal()
        return cls(chain, _typed_in_terminal)

    def read(self, state: ArmState) -> HumanInput:
        """Motion of the end effector, gripper and requests, from keys typed lately."""
        requests, gripper = [], None
        for key in self._typed():
            if key in KEYS:
                requests.append(KEYS[key])
            elif key in _GRIPPER:
                gripper = _GRIPPER[key]
            else:
                self._keys.press(key)
        q, direction = state.joint_position, self._keys.direction()
        twist = gizmo_command(self._chain, q, (), self.forces, direction=direction).twist
        return HumanInput(twist=twist, gripper=gripper, requests=tuple(requests))


def _take_terminal() -> None:
    """Receive each character immediately and without echo; restore the terminal at exit."""
    import atexit
    import termios
    import tty

    number = sys.stdin.fileno()
    before = termios.tcgetattr(number)
    atexit.register(termios.tcsetattr, number, termios.TCSADRAIN, before)
    tty.setcbreak(number)


def _typed_in_terminal() -> str:
    number, text = sys.stdin.fileno(), ""
    while select.select([number], [], [], 0)[0]:
        more = os.read(number, 64)
        if not more:  # the terminal is gone
            break
        text += more.decode(errors="ignore")
    return text


_HAPTIC_SCALE = 2.5
"""Motion of the end effector per motion of the hand: an Omega's workspace is 0.16 m wide."""
_HAPTIC_STIFFNESS = 120.0
"""Stiffness of the spring that pulls the device back to the arm's position [N/m]."""
_HAPTIC_DAMPING = 4.0
"""Damping of the hand's motion while the clutch is closed [N s/m]."""
_HAPTIC_CONTACT = 0.1
"""Fraction of the contact force at the end effector that the device renders."""
_HAPTIC_MAX_FORCE = 6.0
"""Largest force on the hand [N]; an Omega can hold 12."""
_HAPTIC_PERIOD = 0.001
"""Period of updates of the force [s]."""
_HAPTIC_STALE = 0.1
"""Time without feedback from the control loop after which the force vanishes [s]."""
_HAPTIC_CLUTCH = 0
"""Button that closes the clutch while it is pressed."""


class HapticDevice(Human):
    """Guides the end effector while the clutch is held, and renders the tracking error as a
    force.

    When the clutch closes, a virtual pointer starts at the end effector. The pointer moves with
    the device, scaled by 2.5, and the end effector follows the pointer. A force f shows the
    person how far the arm lags behind:

        f = stiffness (x_arm - x) - damping x' + contact f_contact,     |f| <= max_force

    x is the device's position and x' its velocity. x_arm is the device's position at which the
    pointer would be at the end effector. f_contact is the contact force at the end effector. If
    the person faces the arm, the device's axes are those of the base: x towards the person, z
    up.

        with HapticDevice.open(panda) as device:
            HandGuidedArm(panda, arm, device)

    An unplugged device requests nothing.

    Attributes:
        forces: Gains, largest speeds, and orientation of the end effector.
    """

    def __init__(
        self,
        chain: SerialChain,
        device: Any,
        *,
        number: int = -1,
        clock: Callable[[], float] = time.monotonic,
    ):
        """Take an open device; `HapticDevice.open` finds a device.

        Args:
            chain: Kinematics of the guided arm.
            device: Interface of Force Dimension's library, `forcedimension_core.dhd`.
            number: Number of the device; -1: the device opened last.
            clock: Monotonic clock [s].
        """
        self._chain, self._device, self._number = chain, device, number
        self.forces, self._clock = InteractionForceConfig(), clock
        # Positions of hand and tool when the clutch was closed.
        self._clutched: tuple[np.ndarray, np.ndarray] | None = None
        self._tool = np.zeros(3)
        # For the force thread, exchanged as one reference: rest position of the device [m],
        # rendered contact force [N], and the time at which both expire [s].
        self._pull: tuple[np.ndarray, np.ndarray, float] | None = None
        self._closing = Event()
        self._thread = Thread(target=self._push_back, name="haptic device", daemon=True)

    @classmethod
    def open(cls, chain: SerialChain) -> HapticDevice:
        """Open the first device with forcedimension-core, which the extra `haptic` installs.

        Args:
            chain: Kinematics of the guided arm.

        Raises:
            ValueError: There is no device, or the maker's SDK is not installed.
        """
        try:
            from forcedimension_core import dhd  # pyright: ignore[reportMissingImports]
        except ImportError as error:
            raise ValueError(
                f"a haptic device needs the extra `haptic` and Force Dimension's SDK: {error}"
            ) from error
        connect = dhd.open  # opens a device, not a file
        number = connect()
        if number < 0:
            raise ValueError(f"no haptic device: {dhd.errorGetLastStr()}.")
        return cls(chain, dhd, number=number)

    def __enter__(self) -> HapticDevice:
        self._device.enableForce(True, self._number)
        self._thread.start()
        return self

    def __exit__(self, *raised: object) -> None:
        self._closing.set()
        self._thread.join()
        self._device.setForce((0.0, 0.0, 0.0), self._number)
        self._device.enableForce(False, self._number)
        self._device.close(self._number)

    def read(self, state: ArmState) -> HumanInput:
        """Motion of the end effector, from the present position of the hand."""
        hand = self._vector(self._device.getPosition)
        tool = self._chain.forward(torch.from_numpy(state.joint_position))
        self._tool = tool.position.numpy()
        if hand is None or self._device.getButton(_HAPTIC_CLUTCH, self._number) != 1:
            self._clutched = None
            return HumanInput()
        if self._clutched is None:
            self._clutched = hand, self._tool
        began, start = self._clutched
        pointer = start + _HAPTIC_SCALE * (hand - began)
        velocity = self.forces.rate * (pointer - self._tool)
        return HumanInput(twist=guiding_twist(tool, velocity, self.forces))

    def tell(self, feedback: Feedback) -> None:
        """Update the forces that show the arm's lag and contacts to the hand."""
        if self._clutched is None:
            self._pull = None
            return
        began, start = self._clutched
        rest = began + (self._tool - start) / _HAPTIC_SCALE
        push = np.zeros(3)
        if feedback.contact_force is not None and not feedback.contact_expected:
            push = _HAPTIC_CONTACT * feedback.contact_force
        self._pull = rest, push, self._clock() + _HAPTIC_STALE

    def force(self) -> Float[np.ndarray, "3"]:
        """Force on the hand now [N]; zero if the clutch is open or the loop is silent."""
        pull = self._pull
        hand = self._vector(self._device.getPosition)
        velocity = self._vector(self._device.getLinearVelocity)
        if pull is None or hand is None or velocity is None or self._clock() > pull[2]:
            return np.zeros(3)
        rest, push, _ = pull
        spring = _HAPTIC_STIFFNESS * (rest - hand) - _HAPTIC_DAMPING * velocity
        return capped(spring + push, _HAPTIC_MAX_FORCE)

    def _vector(self, read: Callable[..., int]) -> Float[np.ndarray, "3"] | None:
        out = [0.0, 0.0, 0.0]
        return None if read(out, self._number) < 0 else np.array(out)

    def _push_back(self) -> None:
        with contextlib.suppress(OSError):  # the device was unplugged
            while not self._closing.wait(_HAPTIC_PERIOD):
                self._device.setForce(self.force().tolist(), self._number)
