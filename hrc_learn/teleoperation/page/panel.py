"""The panel beside the scene: status, buttons, folders of controls and settings."""

from __future__ import annotations

import html
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float

from hrc_learn.geometry import Box
from hrc_learn.protocols import DrawnRegion, Request
from hrc_learn.teleoperation.devices.keyboard import DIRECTIONS, KeyboardState
from hrc_learn.teleoperation.interaction_force import InteractionForceConfig
from hrc_learn.teleoperation.page._viser import ViserServer
from hrc_learn.teleoperation.page.page_config import PageConfig, PageStatus
from hrc_learn.teleoperation.page.region_editor import RegionEditor
from hrc_learn.viz.palette import BLUE, GREEN, GREY, PERSON, VERMILION


def state_html(status: PageStatus, rate: float, people: int) -> str:
    """What is guided here, what it is doing, and who watches.

    Args:
        status: Of the session.
        rate: Steps that the loop takes [1/s].
        people: Browsers that show the page.
    """
    return (
        '<div style="padding:.2em .9em .5em;line-height:1.5">'
        f'<div style="font-size:1.15em;font-weight:600">{html.escape(status.title)}</div>'
        f"{_doing_html(status) if status.doing else _recording_html(status)}"
        f'<div style="opacity:.75;font-size:.85em">{html.escape(status.note) or "&nbsp;"}</div>'
        f'<div style="opacity:.75;font-size:.85em">{rate:.0f} steps a second, '
        f"{people} connected</div></div>"
    )


def _doing_html(status: PageStatus) -> str:
    return f"{_badge(BLUE, status.doing)}&ensp;{status.seconds:.1f} s"


def _recording_html(status: PageStatus) -> str:
    colour = {"ready": GREY, "recording": VERMILION, "stopped": PERSON}[status.recording]
    words = {
        "ready": "ready",
        "recording": f"recording {status.seconds:.1f} s",
        "stopped": f"stopped at {status.seconds:.1f} s",
    }[status.recording]
    return f"{_badge(colour, words)}&ensp;{status.saved} saved"


def _badge(colour: str, words: str) -> str:
    return (
        f'<span style="color:white;background:{colour};border-radius:.8em;padding:.1em .7em">'
        f"{html.escape(words)}</span>"
    )


def nullspace_input_html(d: Float[np.ndarray, " joints"], largest: float) -> str:
    """A bar to the left or right for each joint.

    Args:
        d: Of each joint [N m].
        largest: That fills half the width [N m].
    """
    rows = []
    for k, value in enumerate(d):
        width = 50 * min(abs(value) / largest, 1.0)
        left = 50 - (width if value < 0 else 0)
        rows.append(
            f'<div style="display:flex;align-items:center;height:1.15em">'
            f'<span style="width:1.4em;opacity:.7">{k + 1}</span>'
            '<div style="flex:1;position:relative;height:.7em;background:rgba(128,128,128,.15);'
            'border-radius:.2em"><div style="position:absolute;height:100%;'
            f"left:{left:.1f}%;width:{width:.1f}%;background:{PERSON};"
            'border-radius:.2em"></div></div>'
            f'<span style="width:3.4em;text-align:right">{value:+.1f}</span></div>'
        )
    return _block("Null-space input d [N m]", "".join(rows))


def interventions_html(status: PageStatus, more: Sequence[str], latest: str) -> str:
    """What the safety filter had to do.

    Args:
        status: Of the session.
        more: Kinds of interventions that have just been needed.
        latest: Kind that was needed last; empty if none was.
    """
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
            task: What is to be demonstrated, in words.
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
        """What is demonstrated, in words."""
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


class EndEffectorControls:
    """Move the end effector by keys, turn it, open and close it.

    Attributes:
        gripper: Opening the person wants [m]; None until asked for.
    """

    def __init__(self, server: ViserServer, let_turn: Callable[[bool], None]):
        """Add them to the folder that is open.

        Args:
            server: Of the page.
            let_turn: Whether the end effector's gizmo can be turned.
        """
        gui = server.gui
        self.gripper: float | None = None
        self._keys = KeyboardState()
        self._coarse = gui.add_checkbox(
            "Coarse orientation rule",
            True,
            hint="Down in front of the robot, level at the end of its reach.",
        )
        self._coarse.on_update(lambda _: let_turn(not self._coarse.value))
        gripper = gui.add_button_group("Gripper", ("open", "close"))
        gripper.on_click(lambda _: self._move_gripper(gripper.value))
        for key in DIRECTIONS:
            command = gui.add_command(
                f"Move the end effector {_KEYS[key]}",
                hotkey=key.upper(),  # type: ignore
            )
            command.on_trigger(self._presses(key))
        gui.add_markdown(
            "Keys **I K J L U O** move the end effector away, back, left, right, up, down."
        )

    @property
    def coarse(self) -> bool:
        """Whether the end effector turns by the coarse orientation rule."""
        return self._coarse.value

    def direction(self) -> Float[np.ndarray, "3"]:
        """Where the keys move the end effector: a unit vector, or zero."""
        return self._keys.direction()

    def _presses(self, key: str) -> Callable[[Any], Any]:
        async def pressed(_event: Any) -> None:
            self._keys.press(key)

        return pressed

    def _move_gripper(self, word: str) -> None:
        self.gripper = OPEN if word == "open" else 0.0


class ForceControls:
    """How a pull at the body acts, and whether the twin stands by."""

    def __init__(
        self,
        server: ViserServer,
        config: InteractionForceConfig,
        show_twin: Callable[[bool], None],
    ):
        """Add them to the folder that is open.

        Args:
            server: Of the page.
            config: How strongly gizmos act to begin with.
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
    def forces(self) -> InteractionForceConfig:
        """How strongly gizmos act."""
        mapping: Any = _MAPPINGS[self._mapping.value]
        share, base = self._strength.value / 100, self._config
        return replace(
            base, mapping=mapping, rate=share * base.rate, stiffness=share * base.stiffness
        )


class Panel:
    """All controls, and the status above them."""

    def __init__(
        self,
        server: ViserServer,
        boxes: Sequence[Box],
        config: PageConfig,
        request: Callable[[Request], None],
        show_twin: Callable[[bool], None],
        let_turn: Callable[[bool], None],
        task: str,
        *,
        guides: bool = True,
    ):
        """Build the panel.

        Args:
            server: Of the page.
            boxes: Furniture that targets may be marked on.
            config: Of the page.
            request: Receives what buttons ask for.
            show_twin: Shows or hides the twin.
            let_turn: Whether the end effector's gizmo can be turned.
            task: What is to be demonstrated, in words.
            guides: Whether the person guides the end effector, draws regions and records;
                otherwise there are no controls but those of forces.
        """
        self._max_input = config.forces.max_nullspace_input
        gui = server.gui
        gui.configure_theme(
            control_width="medium",
            show_logo=False,
            show_share_button=False,
            brand_color=(0, 114, 178),
        )
        gui.main_panel.dock_right()
        self._state = gui.add_html("")
        self._recording = self._end_effector = self._region = None
        if guides:
            with gui.add_folder("Demonstration"):
                self._recording = RecordingControls(server, request, task)
        with gui.add_folder("Null-space input and safety"):
            self._bars = gui.add_html("")
            self._safety = gui.add_html("")
        with gui.add_folder("Arm"):
            if guides:
                self._end_effector = EndEffectorControls(server, let_turn)
            self._forces = ForceControls(server, config.forces, show_twin)
        if guides:
            with gui.add_folder("Region and target"):
                self._region = RegionEditor(server, boxes)
        self._seen: Mapping[str, int] = {}
        self._latest = ""

    @property
    def task(self) -> str:
        """What is demonstrated, in words."""
        return "" if self._recording is None else self._recording.task

    @property
    def coarse(self) -> bool:
        """Whether the end effector turns by the coarse orientation rule."""
        return self._end_effector is None or self._end_effector.coarse

    @property
    def gripper(self) -> float | None:
        """Opening the person wants [m]; None until asked for."""
        return None if self._end_effector is None else self._end_effector.gripper

    @property
    def region(self) -> DrawnRegion | None:
        """The region active."""
        return None if self._region is None else self._region.region

    @property
    def target(self) -> tuple[float, float, float] | None:
        """The point marked [m]."""
        return None if self._region is None else self._region.target

    @property
    def forces(self) -> InteractionForceConfig:
        """How strongly gizmos act."""
        return self._forces.forces

    def direction(self) -> Float[np.ndarray, "3"]:
        """Where keys move the end effector: a unit vector, or zero."""
        return np.zeros(3) if self._end_effector is None else self._end_effector.direction()

    def refresh(
        self,
        status: PageStatus,
        nullspace_input: Float[np.ndarray, " joints"],
        rate: float,
        people: int,
    ) -> None:
        """Show status.

        Args:
            status: Of the session.
            nullspace_input: d that is asked for now [N m].
            rate: Steps that the loop takes [1/s].
            people: Browsers that show the page.
        """
        if self._recording is not None:
            self._recording.refresh(status.recording == "recording")
        self._state.content = state_html(status, rate, people)
        self._bars.content = nullspace_input_html(nullspace_input, self._max_input)
        self._safety.content = self._safety_html(status)

    def _safety_html(self, status: PageStatus) -> str:
        more = [
            name
            for name, count in status.interventions.items()
            if count > self._seen.get(name, 0)
        ]
        self._seen = dict(status.interventions)
        if more:
            self._latest = more[-1]
        return interventions_html(status, more, self._latest)
