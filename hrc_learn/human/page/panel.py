"""The panel beside the scene: buttons, settings, and how the session stands."""

from __future__ import annotations

import html
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float

from ...protocols import Request
from ...viz import Box
from ...viz.palette import GREEN, GREY, PERSON, VERMILION
from ..drag import DragConfig
from ..held_keys import DIRECTIONS, HeldKeys
from .config import PageConfig, PageStatus
from .library import ViserServer
from .region_editor import RegionEditor

OPEN = 0.08
"""Width of the open gripper [m]."""

_ICONS: dict[str, Any] = {"start": "player-record", "stop": "player-stop"}
_MAPPINGS = {"velocity (paper's)": "pinv", "spring": "transpose"}
_KEYS = {"i": "away", "k": "back", "j": "left", "l": "right", "u": "up", "o": "down"}


class Panel:
    """All controls, and the status above them.

    Attributes:
        keys: Keys and buttons that lead the hand.
        region: The region and the target.
        gripper: Opening the person wants [m]; None until asked for.
    """

    def __init__(
        self,
        server: ViserServer,
        boxes: Sequence[Box],
        config: PageConfig,
        request: Callable[[Request], None],
        show_twin: Callable[[bool], None],
        let_turn: Callable[[bool], None],
        task: str,
    ):
        """Build the panel.

        Args:
            server: Of the page.
            boxes: Furniture that targets may be marked on.
            config: Of the page.
            request: Receives what buttons ask for.
            show_twin: Shows or hides the twin.
            let_turn: Whether the hand's handle can be turned.
            task: What is to be shown, in words.
        """
        self._server, self._config, self._request = server, config, request
        self.keys = HeldKeys()
        self.gripper: float | None = None
        gui = server.gui
        gui.configure_theme(
            control_width="medium",
            show_logo=False,
            show_share_button=False,
            brand_color=(0, 114, 178),
        )
        gui.main_panel.dock_right()
        self._state = gui.add_html("")
        with gui.add_folder("Demonstration"):
            self._task = gui.add_text("Task", task)
            self._switch = gui.add_button("Start", color="red", icon=_ICONS["start"])
            self._switch.on_click(lambda _: request(self._next))
            self._offer("Keep it?", {"save": "save", "discard": "discard"})
            self._offer("Session", {"back to start": "home", "finish": "finish"})
        with gui.add_folder("Effort and safety"):
            self._bars = gui.add_html("")
            self._safety = gui.add_html("")
        with gui.add_folder("Arm"):
            self._add_arm_controls(show_twin, let_turn)
        with gui.add_folder("Region and target"):
            self.region = RegionEditor(server, boxes)
        self._next: Request = "start"
        self._seen: Mapping[str, int] = {}
        self._latest = ""

    @property
    def task(self) -> str:
        """What is shown, in words."""
        return self._task.value

    @property
    def coarse(self) -> bool:
        """Whether the hand turns by the coarse orientation rule."""
        return self._coarse.value

    @property
    def drag(self) -> DragConfig:
        """How strongly handles act."""
        mapping: Any = _MAPPINGS[self._mapping.value]
        share = self._strength.value / 100
        base = self._config.drag
        return replace(
            base, mapping=mapping, rate=share * base.rate, stiffness=share * base.stiffness
        )

    def refresh(
        self,
        status: PageStatus,
        effort: Float[np.ndarray, " joints"],
        rate: float,
        people: int,
    ) -> None:
        """Show how the session stands.

        Args:
            status: Of the session.
            effort: That is asked for now.
            rate: Steps that the loop takes [1/s].
            people: Browsers that show the page.
        """
        running = status.recording == "recording"
        self._next = "stop" if running else "start"
        self._switch.label = self._next.capitalize()
        self._switch.icon = _ICONS[self._next]
        self._state.content = _state_html(status, rate, people)
        self._bars.content = _effort_html(effort, self._config.drag.largest_effort)
        self._safety.content = self._safety_html(status)

    def _offer(self, label: str, requests: Mapping[str, Request]) -> None:
        """A row of buttons that ask for something."""
        group = self._server.gui.add_button_group(label, tuple(requests))
        group.on_click(lambda _: self._request(requests[group.value]))

    def _add_arm_controls(
        self, show_twin: Callable[[bool], None], let_turn: Callable[[bool], None]
    ) -> None:
        gui = self._server.gui
        self._coarse = gui.add_checkbox(
            "Hand turns by the rule",
            True,
            hint="Down in front of the robot, level at the end of its reach.",
        )
        self._coarse.on_update(lambda _: let_turn(not self._coarse.value))
        twin = gui.add_checkbox("Virtual twin", True, hint="Hold it instead of the arm.")
        twin.on_update(lambda _: show_twin(twin.value))
        first = next(word for word, m in _MAPPINGS.items() if m == self._config.drag.mapping)
        self._mapping = gui.add_dropdown("A pull is a", tuple(_MAPPINGS), initial_value=first)
        self._strength = gui.add_slider("Strength [%]", 20, 200, 10, 100)
        gripper = gui.add_button_group("Gripper", ("open", "close"))
        gripper.on_click(lambda _: self._move_gripper(gripper.value))
        self._add_keys()

    def _add_keys(self) -> None:
        gui = self._server.gui
        for key in DIRECTIONS:
            command = gui.add_command(
                f"Lead the hand {_KEYS[key]}",
                hotkey=key.upper(),  # type: ignore
            )
            command.on_trigger(self._presses(key))
        gui.add_markdown(
            "Keys **I K J L U O** lead the hand away, back, left, right, up, down."
        )

    def _presses(self, key: str) -> Callable[[Any], Any]:
        async def pressed(_event: Any) -> None:
            self.keys.press(key)

        return pressed

    def _move_gripper(self, word: str) -> None:
        self.gripper = OPEN if word == "open" else 0.0

    def _safety_html(self, status: PageStatus) -> str:
        more = [
            name
            for name, count in status.interventions.items()
            if count > self._seen.get(name, 0)
        ]
        self._seen = dict(status.interventions)
        if more:
            self._latest = more[-1]
        return _interventions_html(status, more, self._latest)


def _state_html(status: PageStatus, rate: float, people: int) -> str:
    colour = {"ready": GREY, "recording": VERMILION, "stopped": PERSON}[status.recording]
    words = {
        "ready": "ready",
        "recording": f"recording {status.seconds:.1f} s",
        "stopped": f"stopped at {status.seconds:.1f} s",
    }[status.recording]
    return (
        '<div style="padding:.2em .9em .5em;line-height:1.5">'
        f'<div style="font-size:1.15em;font-weight:600">{html.escape(status.title)}</div>'
        f'<span style="color:white;background:{colour};border-radius:.8em;padding:.1em .7em">'
        f"{words}</span>&ensp;{status.saved} saved"
        f'<div style="opacity:.75;font-size:.85em">{html.escape(status.note) or "&nbsp;"}</div>'
        f'<div style="opacity:.75;font-size:.85em">{rate:.0f} steps a second, '
        f"{people} connected</div></div>"
    )


def _effort_html(effort: Float[np.ndarray, " joints"], largest: float) -> str:
    """A bar to the left or right for each joint."""
    rows = []
    for k, d in enumerate(effort):
        width = 50 * min(abs(d) / largest, 1.0)
        left = 50 - (width if d < 0 else 0)
        rows.append(
            f'<div style="display:flex;align-items:center;height:1.15em">'
            f'<span style="width:1.4em;opacity:.7">{k + 1}</span>'
            '<div style="flex:1;position:relative;height:.7em;background:rgba(128,128,128,.15);'
            'border-radius:.2em"><div style="position:absolute;height:100%;'
            f"left:{left:.1f}%;width:{width:.1f}%;background:{PERSON};"
            'border-radius:.2em"></div></div>'
            f'<span style="width:3.4em;text-align:right">{d:+.1f}</span></div>'
        )
    return _block("Effort d [N m]", "".join(rows))


def _interventions_html(status: PageStatus, more: Sequence[str], latest: str) -> str:
    rows = [
        f'<tr style="{f"color:{VERMILION};font-weight:600" if name in more else ""}">'
        f"<td>{html.escape(name.replace('_', ' '))}</td>"
        f'<td style="text-align:right">{count}</td></tr>'
        for name, count in status.interventions.items()
        if count
    ]
    nothing = f'<tr><td style="color:{GREEN}">the filter has not had to act</td></tr>'
    contacts = (
        f'<tr style="color:{VERMILION}"><td>touches of the surroundings</td>'
        f'<td style="text-align:right">{status.contacts}</td></tr>'
    )
    table = "".join(rows) or nothing
    table += contacts if status.contacts else ""
    words = f"Safety filter, steps; latest: {latest}" if latest else "Safety filter"
    return _block(words, f'<table style="width:100%;border-spacing:0">{table}</table>')


def _block(title: str, content: str) -> str:
    title = html.escape(title.replace("_", " "))
    return (
        '<div style="padding:.2em .9em .4em;font-size:.85em">'
        f'<div style="opacity:.75;margin-bottom:.2em">{title}</div>'
        f"{content}</div>"
    )
