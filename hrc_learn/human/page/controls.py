"""Folders of the panel: to record, to lead the hand, to pull at the body."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float

from ...protocols import Request
from ..drag import DragConfig
from ..held_keys import DIRECTIONS, HeldKeys
from .library import ViserServer

OPEN = 0.08
"""Width of the open gripper [m]."""

_ICONS: dict[str, Any] = {"start": "player-record", "stop": "player-stop"}
_MAPPINGS = {"velocity (paper's)": "pinv", "spring": "transpose"}
_KEYS = {"i": "away", "k": "back", "j": "left", "l": "right", "u": "up", "o": "down"}


class RecordingControls:
    """Start, stop, save and discard demonstrations."""

    def __init__(self, server: ViserServer, request: Callable[[Request], None], task: str):
        """Add them to the folder that is open.

        Args:
            server: Of the page.
            request: Receives what buttons ask for.
            task: What is to be shown, in words.
        """
        self._server, self._request = server, request
        self._next: Request = "start"
        self._task = server.gui.add_text("Task", task)
        self._switch = server.gui.add_button("Start", color="red", icon=_ICONS["start"])
        self._switch.on_click(lambda _: request(self._next))
        self._offer("Keep it?", {"save": "save", "discard": "discard"})
        self._offer("Session", {"back to start": "home", "finish": "finish"})

    @property
    def task(self) -> str:
        """What is shown, in words."""
        return self._task.value

    def refresh(self, recording: bool) -> None:
        """Let the switch offer what comes next."""
        self._next = "stop" if recording else "start"
        self._switch.label = self._next.capitalize()
        self._switch.icon = _ICONS[self._next]

    def _offer(self, label: str, requests: Mapping[str, Request]) -> None:
        """A row of buttons that ask for something."""
        group = self._server.gui.add_button_group(label, tuple(requests))
        group.on_click(lambda _: self._request(requests[group.value]))


class HandControls:
    """Lead the hand by keys, turn it, open and close it.

    Attributes:
        gripper: Opening the person wants [m]; None until asked for.
    """

    def __init__(self, server: ViserServer, let_turn: Callable[[bool], None]):
        """Add them to the folder that is open.

        Args:
            server: Of the page.
            let_turn: Whether the hand's handle can be turned.
        """
        gui = server.gui
        self.gripper: float | None = None
        self._keys = HeldKeys()
        self._coarse = gui.add_checkbox(
            "Hand turns by the rule",
            True,
            hint="Down in front of the robot, level at the end of its reach.",
        )
        self._coarse.on_update(lambda _: let_turn(not self._coarse.value))
        gripper = gui.add_button_group("Gripper", ("open", "close"))
        gripper.on_click(lambda _: self._move_gripper(gripper.value))
        for key in DIRECTIONS:
            command = gui.add_command(
                f"Lead the hand {_KEYS[key]}",
                hotkey=key.upper(),  # type: ignore
            )
            command.on_trigger(self._presses(key))
        gui.add_markdown(
            "Keys **I K J L U O** lead the hand away, back, left, right, up, down."
        )

    @property
    def coarse(self) -> bool:
        """Whether the hand turns by the coarse orientation rule."""
        return self._coarse.value

    def direction(self) -> Float[np.ndarray, "3"]:
        """Where the keys lead the hand: a unit vector, or zero."""
        return self._keys.direction()

    def _presses(self, key: str) -> Callable[[Any], Any]:
        async def pressed(_event: Any) -> None:
            self._keys.press(key)

        return pressed

    def _move_gripper(self, word: str) -> None:
        self.gripper = OPEN if word == "open" else 0.0


class PullControls:
    """How a pull at the body acts, and whether the twin stands by."""

    def __init__(
        self, server: ViserServer, config: DragConfig, show_twin: Callable[[bool], None]
    ):
        """Add them to the folder that is open.

        Args:
            server: Of the page.
            config: How strongly handles act to begin with.
            show_twin: Shows or hides the twin.
        """
        gui = server.gui
        self._config = config
        twin = gui.add_checkbox("Virtual twin", True, hint="Hold it instead of the arm.")
        twin.on_update(lambda _: show_twin(twin.value))
        first = next(word for word, m in _MAPPINGS.items() if m == config.mapping)
        self._mapping = gui.add_dropdown("A pull is a", tuple(_MAPPINGS), initial_value=first)
        self._strength = gui.add_slider("Strength [%]", 20, 200, 10, 100)

    @property
    def drag(self) -> DragConfig:
        """How strongly handles act."""
        mapping: Any = _MAPPINGS[self._mapping.value]
        share, base = self._strength.value / 100, self._config
        return replace(
            base, mapping=mapping, rate=share * base.rate, stiffness=share * base.stiffness
        )
