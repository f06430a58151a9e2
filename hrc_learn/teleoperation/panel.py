"""Build the panel next to the scene: status, buttons, folders of controls and settings."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any

import numpy as np
from jaxtyping import Float

from hrc_learn.geometry import Box
from hrc_learn.protocols import DrawnRegion, Feedback, Request
from hrc_learn.teleoperation.demonstration_recorder import RecorderStatus
from hrc_learn.teleoperation.devices import DIRECTIONS, OPEN, KeyboardState
from hrc_learn.teleoperation.gate import messages
from hrc_learn.teleoperation.hand_guiding import InteractionForceConfig
from hrc_learn.teleoperation.page_scene import PageScene, ViserServer, in_loop
from hrc_learn.teleoperation.region_editor import QUIET, RegionEditor
from hrc_learn.viz import palette
from hrc_learn.viz.report import page_templates


@dataclass(frozen=True, kw_only=True)
class PageStatus(RecorderStatus):
    """Session status shown on the page.

    If the arm is autonomous, `seconds` is its working time.
    """

    title: str = ""
    """Name of the guided arm, or title of the autonomous task."""
    doing: str = ""
    """Present activity of an autonomous arm; empty if a person guides and records."""
    interventions: Mapping[str, int] = field(default_factory=dict)
    """Number of steps with an intervention of the safety filter, by kind of intervention."""
    contacts: int = 0
    """Number of contacts with the surroundings."""
    region: DrawnRegion | None = None
    """Region into which a controller moves the end effector; None: no region."""
    plan: Float[np.ndarray, "points 3"] | None = None
    """Path that the end effector is about to follow [m]; None: no path."""


@cache
def panel_texts() -> Any:
    """Macros of `panel.html`, which write the texts of the panel."""
    templates = page_templates("hrc_learn.teleoperation")
    return templates.get_template("panel.html", globals=vars(palette)).module


# `_LEAST_CONTACT`: smallest contact force shown [N]; simulated joint friction looks like 17 N.
# `_LEAST_SLIP`: smallest change of a gripper's opening that counts as a slip, not as noise [m].
_LEAST_CONTACT, _LEAST_SLIP = 20.0, 0.001


def felt_words(feedback: Feedback) -> list[str]:
    """Contact, joint limits, slip and the nearest person, as text.

    Args:
        feedback: Feedback of the arm.
    """
    force, felt = feedback.contact_force, []
    if force is not None and (size := float(np.linalg.norm(force))) >= _LEAST_CONTACT:
        felt.append(f"contact: {5 * round(size / 5)} N")
    if feedback.near_limits:
        felt.append(f"near their limits: {', '.join(feedback.near_limits)}")
    if feedback.slip >= _LEAST_SLIP:
        felt.append(f"slip of the held object: {1e3 * feedback.slip:.0f} mm")
    distance = feedback.person_distance
    if distance is not None:
        known = math.isfinite(distance)
        where = f"{max(distance, 0.0):.1f} m away" if known else "at an unknown distance"
        felt.append(f"nearest person: {where}, pace {10 * round(10 * feedback.pace)} %")
    return felt


LONGEST_TEXT = 200
"""Largest number of characters of a text typed on the page."""

_ICONS: dict[str, Any] = {"start": "player-record", "stop": "player-stop"}
_KEYS = {"i": "away", "k": "back", "j": "left", "l": "right", "u": "up", "o": "down"}


class Panel:
    """All controls, and the status above them.

    Attributes:
        keys: Keys that are held to move the end effector.
        editor: Region and target that people draw; None: they cannot draw.
    """

    def __init__(
        self,
        server: ViserServer,
        boxes: Sequence[Box],
        forces: InteractionForceConfig,
        request: Callable[[Request], None],
        grip: Callable[[float], None],
        scene: PageScene,
        task: str,
        *,
        draws: bool,
    ):
        """Build the panel.

        Args:
            server: Server of the page.
            boxes: Furniture that targets may be marked on.
            forces: Initial gains of gizmos.
            request: Receives the requests of buttons.
            grip: Receives the openings of the gripper that buttons request [m].
            scene: Scene, in which the panel shows or hides the virtual twin and the gizmo. If
                the end effector can be held in it, the person records.
            task: Description of the task.
            draws: True if people draw regions, mark targets and turn the end effector.
        """
        self._gui, self._initial_forces, self._held = server.gui, forces, scene.held
        self._bends = scene.robot.null_space != "none"
        gui = server.gui
        gui.configure_theme(
            control_width="medium",
            show_logo=False,
            show_share_button=False,
            brand_color=palette.rgba(palette.BLUE)[:3],
        )
        gui.main_panel.dock_right()
        self._task = self._switch = self._keep = None
        self._next: Request = "start"
        self.keys = KeyboardState()
        self._state, self._told = gui.add_html(""), gui.add_html("")
        if scene.guides:
            with gui.add_folder("Demonstration"):
                self._add_recording(request, task)
        with gui.add_folder("Null-space input and safety"):
            self._bars, self._safety = gui.add_html(""), gui.add_html("")
        with gui.add_folder("Arm"):
            if scene.guides:
                self._add_end_effector(scene, grip)
            twin = gui.add_checkbox("Virtual twin", False, hint="Hold it instead of the arm.")
            twin.on_update(in_loop(lambda _: scene.show_twin(twin.value)))
            self._strength = gui.add_slider("Strength [%]", 20, 200, 10, 100)
        self.editor: RegionEditor | None = None
        if draws:
            with gui.add_folder("Region, target and turn"):
                self.editor = RegionEditor(server, boxes, scene.robot.hand_size)
                clear = gui.add_button("Clear the turn", color=QUIET)
                clear.on_click(in_loop(lambda _: scene.held.clear_turn()))
                self._turn_text = gui.add_markdown("")
        self._seen: Mapping[str, int] = {}
        self._latest = ""

    def _add_recording(self, request: Callable[[Request], None], task: str) -> None:
        """Add the controls that start, stop, save and discard demonstrations."""
        self._task = self._gui.add_text("Task", task)
        self._switch = self._gui.add_button("Start", color="red", icon=_ICONS["start"])
        self._switch.on_click(in_loop(lambda _: request(self._next)))
        rows: dict[str, dict[str, Request]] = {
            "Keep it?": {"save": "save", "discard": "discard"},
            "Session": {"back to start": "home", "finish": "finish"},
        }
        for label, requests in rows.items():
            group = self._gui.add_button_group(label, tuple(requests))
            group.on_click(in_loop(lambda event, of=requests: request(of[event.target.value])))
            self._keep = self._keep or group  # the first: save and discard

    def _add_end_effector(self, scene: PageScene, grip: Callable[[float], None]) -> None:
        """Add the controls that move and turn the end effector and operate the gripper."""
        fine = self._gui.add_checkbox(
            "Fine turn",
            False,
            hint="By itself the end effector points down near the robot and forward at the end "
            "of its reach. Rings at the gizmo rotate it from there.",
        )
        fine.on_update(in_loop(lambda _: scene.let_turn(fine.value)))
        gripper = self._gui.add_button_group("Gripper", ("open", "close"))
        gripper.on_click(in_loop(lambda _: grip(OPEN if gripper.value == "open" else 0.0)))
        for key in DIRECTIONS:
            command = self._gui.add_command(
                f"Move the end effector {_KEYS[key]}",
                hotkey=key.upper(),  # type: ignore
            )
            command.on_trigger(in_loop(lambda _, key=key: self.keys.press(key)))
        self._gui.add_markdown(
            "Keys **I K J L U O** move the end effector away, back, left, right, up, down."
        )

    @property
    def task(self) -> str:
        """Description of the task."""
        return "" if self._task is None else self._task.value

    def hear(self, message: messages.Message) -> None:
        """Handle a message of a headset, like the panel's own controls."""
        match message:
            case messages.Task(task=task) if self._task is not None:
                self._task.value = task
            case messages.Region(centre=centre, half_size=half_size) if self.editor:
                region = DrawnRegion(centre=centre, half_size=half_size)
                self.editor.draw(region, message.active)
            case messages.Target(point=point) if self.editor:
                self.editor.mark(None if point is None else np.array(point))
            case _:
                pass  # this page does not offer it

    @property
    def forces(self) -> InteractionForceConfig:
        """Gains and bounds of gizmos."""
        scale, base = self._strength.value / 100, self._initial_forces
        return replace(base, rate=scale * base.rate, stiffness=scale * base.stiffness)

    def fits(self, update: messages.GuiUpdate) -> bool:
        """True if a browser may set a control of the panel to a value."""
        handle: Any = self._gui._gui_input_handle_from_uuid.get(update.uuid)
        if handle is None or set(update.updates) != {"value"}:
            return False
        value, now = update.updates["value"], handle.value
        if isinstance(now, bool) or isinstance(value, bool):
            return isinstance(value, bool) and isinstance(now, bool)
        if isinstance(now, str):
            options = getattr(handle, "options", None)
            fits = isinstance(value, str) and len(value) <= LONGEST_TEXT
            return fits and (options is None or value in options)
        return isinstance(value, int | float) and handle.min <= value <= handle.max

    def refresh(
        self,
        status: PageStatus,
        feedback: Feedback,
        nullspace_input: Float[np.ndarray, " joints"],
        people: int,
    ) -> None:
        """Show status.

        Args:
            status: Status of the session.
            feedback: Feedback of the arm.
            nullspace_input: Null-space input d requested now [N m].
            people: Number of browsers that show the page.
        """
        texts = panel_texts()
        self._told.content = str(texts.feedback(feedback, felt_words(feedback)))
        if self._switch is not None:
            self._next = "stop" if status.state == "recording" else "start"
            self._switch.label = self._next.capitalize()
            self._switch.icon = _ICONS[self._next]
            # Starting over would discard the demonstration that waits to be saved.
            self._switch.disabled = status.state == "stopped"
            if self._keep is not None:
                self._keep.visible = status.state == "stopped"
        largest = self._initial_forces.max_nullspace_input
        self._state.content = str(texts.state(status, people, self.task, self._bends))
        bars = nullspace_input.tolist() if self._bends else ()
        self._bars.content = str(texts.nullspace_input(bars, largest))
        if self.editor is not None:
            turn = self._held.turn_vector
            degrees = None if turn is None else tuple(np.rad2deg(turn).tolist())
            self._turn_text.content = str(texts.turn(degrees))
        counts, seen = status.interventions, self._seen
        more = [name for name, count in counts.items() if count > seen.get(name, 0)]
        self._seen, self._latest = dict(counts), more[-1] if more else self._latest
        self._safety.content = str(texts.safety(status, self._latest))
