"""Devices that move the end effector, as stand-ins for a haptic one: a gamepad, the keys of a
terminal; several sources of human input at once, and a filter that bounds their acceleration.

A device is whatever has `Human.read`: it says at each step what the person asks for.
"""

from __future__ import annotations

import os
import select
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from hrc_learn.kinematics import SerialChain
from hrc_learn.protocols import ArmState, Feedback, Human, HumanInput, Request
from hrc_learn.teleoperation.hand_guiding import (
    InteractionForceConfig,
    bounded,
    capped,
    pull_to_nullspace_input,
    steering_twist,
)

OPEN = 0.08
"""Width of the open gripper [m]."""


class CombinedInput(Human):
    """Joins several sources, as the paper's mixed interface has a haptic device and a headset.

    Null-space inputs and twists add up. Of gripper, region, target and turn the first source
    that sets them is used; requests of all are passed on, and any of them pauses or stops.
    """

    def __init__(self, *sources: Human):
        """Join them.

        Raises:
            ValueError: There are none.
        """
        if not sources:
            raise ValueError("a combined input needs at least one source.")
        self._sources = sources

    def read(self, state: ArmState) -> HumanInput:
        """Combined input of all sources."""
        inputs = [source.read(state) for source in self._sources]
        joints = len(state.joint_position)
        return HumanInput(
            nullspace_input=np.sum([i.effort(joints) for i in inputs], axis=0),
            twist=np.sum([i.twist for i in inputs], axis=0),
            gripper=next((i.gripper for i in inputs if i.gripper is not None), None),
            region=next((i.region for i in inputs if i.region is not None), None),
            target=next((i.target for i in inputs if i.target is not None), None),
            turn=next((i.turn for i in inputs if i.turn is not None), None),
            requests=tuple(request for i in inputs for request in i.requests),
            pause=any(i.pause for i in inputs),
            stop=next((i.stop for i in inputs if i.stop), ""),
        )

    def tell(self, feedback: Feedback) -> None:
        """Tell all sources."""
        for source in self._sources:
            source.tell(feedback)


_ELBOW = 4
"""Joint whose origin a `LinkGuide` pulls, counted from 1."""


class LinkGuide(Human):
    """Pulls a link in the null space with a device that otherwise guides the end effector.

    The device's speed, as a fraction of its largest, is that fraction of the largest force on
    the link. The end effector is left alone.
    """

    def __init__(
        self,
        human: Human,
        chain: SerialChain,
    ):
        """Take a device.

        Args:
            human: The device.
            chain: The arm.
        """
        self._human, self._chain, self._config = human, chain, InteractionForceConfig()

    def read(self, state: ArmState) -> HumanInput:
        """The null-space input now."""
        asked, config = self._human.read(state), self._config
        # As a gizmo's displacement, whose largest force and speed are those of the device.
        force = capped(config.max_force / config.speed * asked.twist[:3], config.max_force)
        d = pull_to_nullspace_input(self._chain, state.joint_position, _ELBOW, force, config)
        return replace(
            asked,
            nullspace_input=bounded(asked.effort(len(d)) + d, config.max_nullspace_input),
            twist=np.zeros(6),
        )

    def tell(self, feedback: Feedback) -> None:
        """Tell the person at the device."""
        self._human.tell(feedback)


@dataclass(frozen=True, kw_only=True)
class InputFilterConfig:
    """Bounds on the acceleration of the end effector."""

    linear: float = 1.5
    """[m/s^2]: from rest to a gizmo's full speed, and back, in a sixth of a second."""
    angular: float = 5.0
    """[rad/s^2]"""

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not value > 0:
                raise ValueError(f"{name} must be positive, but is {value}.")


class InputFilter(Human):
    """Passes human input on with the acceleration of the end effector bounded.

    A key that is pressed asks for full speed at once, and a gizmo that is released for none:
    unfiltered, the arm would jerk, and so would what is learned from it.
    """

    def __init__(self, human: Human, config: InputFilterConfig | None = None):
        """Start at rest.

        Args:
            human: Source of the input.
            config: Bounds.
        """
        self._human, self._config = human, config or InputFilterConfig()
        # The first reading has no predecessor: an infinite time makes its dt zero below.
        self._twist, self._time = np.zeros(6), np.inf

    def read(self, state: ArmState) -> HumanInput:
        """The filtered input now."""
        human_input, config = self._human.read(state), self._config
        dt = max(state.time - self._time, 0.0)
        change = human_input.twist - self._twist
        self._time = state.time
        self._twist = self._twist + np.concatenate(
            [capped(change[:3], config.linear * dt), capped(change[3:], config.angular * dt)]
        )
        return replace(human_input, twist=self._twist)

    def tell(self, feedback: Feedback) -> None:
        """Tell the person whose input it is."""
        self._human.tell(feedback)


# SDL's layout of a game controller, the same for every make (CONTROLLER_AXIS_*, _BUTTON_*).
_LEFT_X, _LEFT_Y, _RIGHT_Y = 0, 1, 3
_A, _B, _X, _Y, _BACK, _START, _LEFT_SHOULDER, _RIGHT_SHOULDER = 0, 1, 2, 3, 4, 6, 9, 10
_FULL = 32767.0  # an axis at its end

BUTTONS: MappingProxyType[int, Request] = MappingProxyType(
    {_A: "start", _B: "stop", _X: "save", _Y: "discard", _BACK: "home", _START: "finish"}
)
"""Request sent by each button: A starts, B stops, X saves, Y discards, "back" returns home,
"start" finishes.
"""


@runtime_checkable
class Controller(Protocol):
    """Part of pygame's SDL game controller that is used here."""

    def get_axis(self, axis: int) -> int: ...
    def get_button(self, button: int) -> bool: ...
    def attached(self) -> bool: ...
    def rumble(self, low_frequency: float, high_frequency: float, duration: int) -> bool: ...


# Rumble: the slow motor reports contact and nearby people, the quick one an input that the arm
# does not follow. Pulses are easier to notice than motors that run continuously.
PULSE_EVERY, _PULSE = 0.25, 0.12  # [s]
_LEAST_RUMBLE = 0.1  # of 1: motors hardly turn below
_CONTACT = (20.0, 60.0)
"""Contact force from which on there are pulses, and that of the strongest [N]. Friction of the
simulated joints feels like 17 N; a scripted person pulls with 60 N at most."""


def rumble_strength(feedback: Feedback) -> tuple[float, float]:
    """Strengths of the slow and of the quick motor of a gamepad, 0 to 1.

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
"""Power of the deflection: above 1 it is finer near the middle."""


def deflection(stick: Float[np.ndarray, " axes"]) -> Float[np.ndarray, " axes"]:
    """A stick's effect, 0 to 1 in length, in the direction of the stick.

    Zero in the dead zone, and from its edge on without a jump: the zone is a ball, as one for
    each axis by itself would bend slow motions towards the axes.

    Args:
        stick: Deflection of the stick, each axis -1 to 1.
    """
    length = float(np.linalg.norm(stick))
    if length <= _DEAD_ZONE:
        return np.zeros_like(stick)
    beyond = min((length - _DEAD_ZONE) / (1 - _DEAD_ZONE), 1.0)
    return stick / length * beyond**_CURVE


class Gamepad(Human):
    """Moves the end effector by the sticks: left one level, right one up and down.

    Shoulder buttons open and close the gripper, the others ask what `BUTTONS` says. The end
    effector turns by the coarse orientation rule. A gamepad that is unplugged asks for nothing.
    It rumbles where the arm meets something, slows down for people or does not follow.
    """

    def __init__(
        self,
        chain: SerialChain,
        controller: Controller,
        update: Callable[[], None] = lambda: None,
        clock: Callable[[], float] = time.monotonic,
    ):
        """Take an open controller; `Gamepad.open` finds one.

        Args:
            chain: The arm that is guided.
            controller: The gamepad.
            update: Lets the library read the device.
            clock: Monotonic clock [s].
        """
        self._chain, self._controller, self._update = chain, controller, update
        self._clock, self._next_pulse = clock, float("-inf")
        self._held: set[int] = set()
        self._gripper: float | None = None

    @classmethod
    def open(cls, chain: SerialChain, index: int = 0) -> Gamepad:
        """Open a gamepad by pygame, which the extra `gamepad` brings.

        Args:
            chain: The arm that is guided.
            index: Index of the gamepad, from 0.

        Raises:
            ValueError: There is no such gamepad.
        """
        import os

        # No window is opened, so events must come without one in front.
        os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
        os.environ.setdefault("SDL_JOYSTICK_ALLOW_BACKGROUND_EVENTS", "1")
        os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
        import pygame
        from pygame._sdl2 import controller as library

        pygame.display.init()
        library.init()
        count = library.get_count()
        if not (0 <= index < count and library.is_controller(index)):
            raise ValueError(
                f"no gamepad {index}: SDL finds {count} devices. Plug one in, and see that "
                "this user may read /dev/input."
            )
        return cls(chain, library.Controller(index), pygame.event.pump)

    def read(self, state: ArmState) -> HumanInput:
        """Motion of the end effector, gripper and requests, as sticks and buttons are now."""
        self._update()
        if not self._controller.attached():
            self._held = set()
            return HumanInput(nullspace_input=np.zeros(len(state.joint_position)))
        pressed = self._pressed()
        for button, width in ((_LEFT_SHOULDER, OPEN), (_RIGHT_SHOULDER, 0.0)):
            if button in pressed:
                self._gripper = width
        return HumanInput(
            nullspace_input=np.zeros(len(state.joint_position)),
            twist=self._twist(state),
            gripper=self._gripper,
            requests=tuple(BUTTONS[b] for b in sorted(pressed & BUTTONS.keys())),
        )

    def tell(self, feedback: Feedback) -> None:
        """Rumble, a pulse every now and then; a gamepad without motors stays still."""
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
        stick = np.array([-y, -x, -z])
        return steering_twist(
            self._chain, state.joint_position, deflection(stick), InteractionForceConfig()
        )

    def _pressed(self) -> set[int]:
        """Buttons that have gone down since the last reading."""
        buttons = (*BUTTONS, _LEFT_SHOULDER, _RIGHT_SHOULDER)
        held = {button for button in buttons if self._controller.get_button(button)}
        pressed, self._held = held - self._held, held
        return pressed


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


class KeyboardState:
    """Keys held down, and the direction that they request.

    Terminals report presses and repeats but no releases. A press therefore counts for a short
    time, and a held key repeats before that time is over (after a quarter to half a second at
    first, then every 30 ms). A keyboard that falls silent requests no motion.
    """

    def __init__(self, holds_for: float = 0.3, clock: Callable[[], float] = time.monotonic):
        """Start with no key held.

        Args:
            holds_for: Time that a press counts [s].
            clock: Monotonic clock [s].

        Raises:
            ValueError: `holds_for` is not positive.
        """
        if not holds_for > 0:
            raise ValueError(f"holds_for must be positive, but is {holds_for}.")
        self._holds_for, self._clock = holds_for, clock
        self._until = dict.fromkeys(DIRECTIONS, float("-inf"))

    def press(self, key: str) -> bool:
        """Note a press or repeat; whether the key has a direction."""
        if key not in self._until:
            return False
        self._until[key] = self._clock() + self._holds_for
        return True

    def direction(self) -> Float[np.ndarray, "3"]:
        """The direction asked for now: a unit vector, or zero."""
        now = self._clock()
        held = [DIRECTIONS[key] for key, until in self._until.items() if now < until]
        total = np.sum(held, axis=0) if held else np.zeros(3)
        length = float(np.linalg.norm(total))
        return total / length if length > 0 else total


KEYS: MappingProxyType[str, Request] = MappingProxyType(
    {"1": "start", "2": "stop", "3": "save", "4": "discard", "0": "home", "q": "finish"}
)
"""Request sent by each key; `DIRECTIONS` has the keys that move the end effector."""

_GRIPPER = {"[": OPEN, "]": 0.0}


class TerminalKeyboard(Human):
    """Moves the end effector by keys: i k away and back, j l left and right, u o up and down.

    [ opens the gripper, ] closes it; `KEYS` has the rest. The end effector turns by the
    coarse orientation rule.
    """

    def __init__(
        self, chain: SerialChain, typed: Callable[[], str], keys: KeyboardState | None = None
    ):
        """Take a source of characters; `TerminalKeyboard.open` takes the terminal.

        Args:
            chain: The arm that is guided.
            typed: Characters typed since it was last asked; does not wait.
            keys: State of the keys.
        """
        self._chain, self._typed = chain, typed
        self._keys, self._config = keys or KeyboardState(), InteractionForceConfig()
        self._gripper: float | None = None

    @classmethod
    def open(cls, chain: SerialChain) -> TerminalKeyboard:
        """Read the terminal this process runs in, key by key, until the process ends.

        Raises:
            ValueError: Standard input is no terminal.
        """
        if not sys.stdin.isatty():
            raise ValueError("the keyboard needs a terminal: standard input is none.")
        _take_terminal()
        return cls(chain, _typed_in_terminal)

    def read(self, state: ArmState) -> HumanInput:
        """Motion of the end effector, gripper and requests, by the keys typed lately."""
        requests = []
        for key in self._typed():
            if key in KEYS:
                requests.append(KEYS[key])
            elif key in _GRIPPER:
                self._gripper = _GRIPPER[key]
            else:
                self._keys.press(key)
        direction = self._keys.direction()
        return HumanInput(
            nullspace_input=np.zeros(len(state.joint_position)),
            twist=steering_twist(self._chain, state.joint_position, direction, self._config),
            gripper=self._gripper,
            requests=tuple(requests),
        )


def _take_terminal() -> None:
    """Let characters come without a line's end and unseen, and give the terminal back."""
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
