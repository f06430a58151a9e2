"""A gamepad as a stand-in for a haptic device: the sticks move the end effector."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float

from hrc_learn.kinematics import SerialChain, coarse_orientation
from hrc_learn.protocols import ArmState, HumanInput, Request
from hrc_learn.teleoperation.interaction_force import InteractionForceConfig, guiding_twist

# SDL's layout of a game controller, the same for every make (CONTROLLER_AXIS_*, _BUTTON_*).
_LEFT_X, _LEFT_Y, _RIGHT_Y = 0, 1, 3
_A, _B, _X, _Y, _BACK, _START, _LEFT_SHOULDER, _RIGHT_SHOULDER = 0, 1, 2, 3, 4, 6, 9, 10
_FULL = 32767.0  # an axis at its end

REQUESTS: MappingProxyType[int, Request] = MappingProxyType(
    {_A: "start", _B: "stop", _X: "save", _Y: "discard", _BACK: "home", _START: "finish"}
)
"""What the buttons ask for: A starts, B stops, X saves, Y discards, "back" goes back to the
start, "start" finishes."""


@runtime_checkable
class Controller(Protocol):
    """What we use of SDL's game controllers, as pygame has them."""

    def get_axis(self, axis: int) -> int: ...
    def get_button(self, button: int) -> bool: ...
    def attached(self) -> bool: ...


@dataclass(frozen=True, kw_only=True)
class GamepadConfig:
    """How sticks act."""

    dead_zone: float = 0.12
    """Fraction of its range in which a stick has no effect: worn sticks do not return to 0."""
    curve: float = 2.0
    """Power of the deflection: above 1 it is finer near the middle."""
    forces: InteractionForceConfig = field(default_factory=InteractionForceConfig)
    """Fastest motion of the end effector, and how it turns."""
    opening: float = 0.08
    """Width of the open gripper [m]."""

    def __post_init__(self) -> None:
        if not (0 <= self.dead_zone < 1 and self.curve > 0):
            raise ValueError(
                "dead_zone must be in [0, 1) and curve positive, but are "
                f"{self.dead_zone} and {self.curve}."
            )


def deflection(
    stick: Float[np.ndarray, " axes"], dead_zone: float, curve: float
) -> Float[np.ndarray, " axes"]:
    """A stick's effect, 0 to 1 in length, in the direction of the stick.

    Zero in the dead zone, and from its edge on without a jump: the zone is a ball, as one for
    each axis by itself would bend slow motions towards the axes.

    Args:
        stick: Its place, each axis -1 to 1.
        dead_zone: Fraction of its way without effect.
        curve: Power of what remains.
    """
    length = float(np.linalg.norm(stick))
    if length <= dead_zone:
        return np.zeros_like(stick)
    beyond = min((length - dead_zone) / (1 - dead_zone), 1.0)
    return stick / length * beyond**curve


class Gamepad:
    """Moves the end effector by the sticks: left one level, right one up and down.

    Shoulder buttons open and close the gripper, the others ask what `REQUESTS` says. The end
    effector turns by the coarse orientation rule. A gamepad that is unplugged asks for nothing.
    """

    def __init__(
        self,
        chain: SerialChain,
        controller: Controller,
        update: Callable[[], None] = lambda: None,
        config: GamepadConfig | None = None,
    ):
        """Take an open controller; `Gamepad.open` finds one.

        Args:
            chain: The arm that is guided.
            controller: The gamepad.
            update: Lets the library read the device.
            config: How sticks act.
        """
        self._chain, self._controller, self._update = chain, controller, update
        self._config = config or GamepadConfig()
        self._held: set[int] = set()
        self._gripper: float | None = None

    @classmethod
    def open(
        cls, chain: SerialChain, index: int = 0, config: GamepadConfig | None = None
    ) -> Gamepad:
        """Open a gamepad by pygame, which the extra `gamepad` brings.

        Args:
            chain: The arm that is guided.
            index: Which gamepad, counted from 0.
            config: How sticks act.

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
        return cls(chain, library.Controller(index), pygame.event.pump, config)

    def read(self, state: ArmState) -> HumanInput:
        """Motion of the end effector, gripper and requests, as sticks and buttons are now."""
        self._update()
        if not self._controller.attached():
            self._held = set()
            return HumanInput(nullspace_input=np.zeros(len(state.joint_position)))
        pressed = self._pressed()
        for button, width in ((_LEFT_SHOULDER, self._config.opening), (_RIGHT_SHOULDER, 0.0)):
            if button in pressed:
                self._gripper = width
        return HumanInput(
            nullspace_input=np.zeros(len(state.joint_position)),
            twist=self._twist(state),
            gripper=self._gripper,
            requests=tuple(REQUESTS[b] for b in sorted(pressed & REQUESTS.keys())),
        )

    def _twist(self, state: ArmState) -> Float[np.ndarray, "6"]:
        config = self._config
        x, y, z = (
            self._controller.get_axis(axis) / _FULL for axis in (_LEFT_X, _LEFT_Y, _RIGHT_Y)
        )
        # A stick that points forward or up reads negative; the base's y axis points left.
        stick = np.array([-y, -x, -z])
        way = deflection(stick, config.dead_zone, config.curve)
        if not way.any():
            return np.zeros(6)
        tool = self._chain.forward(torch.from_numpy(state.joint_position))
        orientation = coarse_orientation(tool.position)
        return guiding_twist(tool, config.forces.speed * way, orientation, config.forces)

    def _pressed(self) -> set[int]:
        """Buttons that have gone down since the last reading."""
        buttons = (*REQUESTS, _LEFT_SHOULDER, _RIGHT_SHOULDER)
        held = {button for button in buttons if self._controller.get_button(button)}
        pressed, self._held = held - self._held, held
        return pressed
