"""Serve the browser page from which a person guides the arm, by mouse or with an AR headset."""

from __future__ import annotations

import asyncio
import contextlib
import io
import logging
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import Future, wait
from dataclasses import dataclass, field, replace
from pathlib import Path
from threading import Event, Thread
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np
import torch

from hrc_learn.geometry import Box, Pose
from hrc_learn.geometry.numerics import check_settings
from hrc_learn.protocols import ArmState, HumanInput
from hrc_learn.store import json_text
from hrc_learn.teleoperation.devices import OPEN, rumble_strength
from hrc_learn.teleoperation.gate import AddressConfig, Gate, messages
from hrc_learn.teleoperation.hand_guiding import InteractionForceConfig
from hrc_learn.teleoperation.headset import headset_contents, headset_data
from hrc_learn.teleoperation.page_operator import (
    GizmoCommand,
    HeadsetHands,
    HeldGizmos,
    gizmo_command,
)
from hrc_learn.teleoperation.page_operator import PageHuman as PageHuman
from hrc_learn.teleoperation.page_scene import PageScene
from hrc_learn.teleoperation.page_sockets import (
    Control,
    PageSockets,
    guarded_viser,
    page_contents,
)
from hrc_learn.teleoperation.panel import PageStatus as PageStatus
from hrc_learn.teleoperation.panel import Panel, felt_words
from hrc_learn.viz.palette import followed_colour

if TYPE_CHECKING:
    from hrc_learn.sim import World


@dataclass(frozen=True, kw_only=True)
class PageConfig(AddressConfig):
    """Settings of the page."""

    forces: InteractionForceConfig = field(default_factory=InteractionForceConfig)
    """Gains and bounds of gizmos, the handles that a person drags."""
    silence: float = 0.12
    """Time without a sign of life (`messages.Beat`) from the controlling client after which the
    arm holds still until the next sign of life [s].
    """
    timeout: float = 0.6
    """Time without a sign of life from the controlling client after which the arm is released
    from all drags [s]. If a browser is busy for longer, its drag ends.
    """
    meshes: bool = True
    """True draws the arm with its meshes, False with capsules. With capsules, a browser without
    a graphics processor draws twice as many frames in AR.
    """
    touch_points: tuple[messages.Point, ...] = (
        (0.4, 0.0, 0.0),
        (0.7, 0.0, 0.0),
        (0.4, 0.3, 0.0),
    )
    """Points of the real workplace, in the base frame [m]; at least three, 10 cm apart or more.
    A person with a headset touches them to align the virtual arm with the real arm."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_settings(self, positive=("silence", "timeout"))
        level = np.array(self.touch_points).reshape(-1, 3)[:, :2]
        apart = np.linalg.norm(level[:, None] - level, axis=-1)[~np.eye(len(level), dtype=bool)]
        if len(level) < 3 or not (apart >= _APART).all():
            raise ValueError(
                f"touch_points must be three at least, {_APART} m apart or more as seen from "
                f"above, but are {self.touch_points}."
            )


# Smallest distance between touch points [m]. At this distance, an error of 1 cm at one point
# rotates the overlaid arm by 6 degrees.
_APART = 0.1
_PERIOD = 0.04
"""Period of refreshes [s]. Each refresh posts the person's input and redraws the scene."""
_PANEL_EVERY = 5  # refreshes of the scene per refresh of the panel: text may be slower
_MOST_FAILURES = 25
"""Number of successive failed refreshes after which the page ends: one second. A failed refresh
posts no input, so it requests no motion."""

_logger = logging.getLogger("hrc_learn.page")


class Page:
    """Serves the page and keeps it up to date, in threads of its own.

        with Page(world) as page:
            while running:
                human_input = page.human.read(arm.read())
                ...
                page.place()
                page.show(status)

    The control loop spends time only in `human.read`, `place` and `show`, which exchange
    references. The library viser draws the scene. Objects of viser are changed only in viser's
    own event loop, because viser's queues break otherwise.

    Attributes:
        human: Combined input of the people at the page.
        address: Address of the page.
        url: Link with the secret. Anyone with this link can move the arm.
        watch_url: Link for watching only.
        headset_url: Link for headsets and phones; empty if the headset client is not built.
        control: Control of the arm by one client at a time.
        farewell: Text shown in browsers when the page is closed.
    """

    def __init__(
        self,
        world: World,
        config: PageConfig | None = None,
        *,
        boxes: Sequence[Box] = (),
        task: str = "",
        guides: bool = True,
        draws: bool | None = None,
    ):
        """Serve the page; it follows the arm within the `with` block.

        Args:
            world: World to show. Its bodies "link1", "link2", ... can be held; the last link,
                "hand", "finger_left" and "finger_right" move the end effector.
            config: Settings of the page.
            boxes: Fixed boxes in addition to the boxes of the world.
            task: Description of the task to demonstrate.
            guides: True if the person guides the end effector and records demonstrations;
                False if the arm works autonomously.
            draws: True if people draw regions, mark targets and turn the end effector; None:
                the value of `guides`. People can always pull the arm in its null space.
        """
        import viser

        # Imports MuJoCo, which the rest of the page does not need.
        from hrc_learn.sim import MovingBodies

        self._config = config = config or PageConfig()
        self._world, self._bodies = world, MovingBodies(world)
        self._poses = self._bodies.poses()
        bodies = self._bodies.drawn(*(poses[None] for poses in self._poses))
        if not config.meshes:
            bodies = [replace(body, meshes=()) for body in bodies]
        boxes, robot = [*world.config.boxes(), *boxes], world.arm.robot
        self._chain = robot.chain
        self.control = control = Control(config.silence, config.timeout, self._let_go)
        self.human = PageHuman(present=lambda: control.present)
        draws = guides if draws is None else draws
        headset = headset_contents()
        features = {"guides": guides, "draws": draws, "task": task, "opening": OPEN}
        features["touch_points"] = config.touch_points
        self._data = headset_data(bodies, boxes, robot.joints, **features) if headset else {}
        self._wake = Event()
        self._held_gizmos = held = HeldGizmos(self._wake.set, self._links)
        self._hands = HeadsetHands(held, guides=guides)
        server, secret = guarded_viser()
        self._server = server
        self._scene = PageScene(server, bodies, boxes, held, robot, guides=guides, turns=draws)
        self._panel = Panel(
            server,
            boxes,
            config.forces,
            self.human.request,
            self.human.grip,
            self._scene,
            task,
            draws=draws,
        )
        port, fits = server.get_port(), self._panel.fits
        self._sockets = PageSockets(control, self._heard, fits, self._told, port, secret)
        routes = {"session": self._sockets.session, "view": self._sockets.view}
        contents = {**page_contents(Path(viser.__file__).parent), **headset}
        try:
            self._gate = Gate(config, contents, routes, self._data.get)
        except ValueError:
            self._stop_viewer()
            raise
        self.address = self._gate.address
        self.url, self.watch_url = self.address.link(), self.address.link(watch=True)
        self.headset_url = self.address.link("/xr") if headset else ""
        self._status = PageStatus()
        self._closing = Event()
        self._error: BaseException | None = None
        self.farewell = "The session has ended."
        self._asked = 0.0
        self._drawing: Future[None] | None = None
        self._thread = Thread(target=self._guarded, name="page refresh", daemon=True)

    def __enter__[Shown: Page](self: Shown) -> Shown:
        self._thread.start()
        self._gate.start()
        return self

    def __exit__(self, kind: Any, error: BaseException | None, trace: Any) -> None:
        self._closing.set()
        self._wake.set()
        self._thread.join()
        if self._drawing is not None:
            wait([self._drawing])
        self._gate.close(self.farewell)
        self._stop_viewer()
        if self._error is not None and error is None:
            raise self._error

    def _stop_viewer(self) -> None:
        with contextlib.redirect_stdout(io.StringIO()):  # suppresses viser's banner
            self._server.stop()

    @property
    def task(self) -> str:
        """Description of the task, as entered by the person."""
        return self._panel.task

    @property
    def hands(self) -> Mapping[str, messages.TrackedHand]:
        """Tracked hands of the controlling client, by "left" and "right", if a headset sees
        them.
        """
        return self._hands.tracked if self.control.present else {}

    @property
    def alive(self) -> bool:
        """True while the page follows the arm. If an error has stopped the page, leaving the
        `with` block raises this error.
        """
        return self._error is None

    def place(self, world: World | None = None) -> None:
        """Show the present poses of the bodies; called after each step.

        Args:
            world: World with the same bodies, which replaces the present world; None keeps the
                present world.
        """
        from hrc_learn.sim import MovingBodies

        if world is not None and world is not self._world:
            self._world, self._bodies = world, MovingBodies(world)
        self._poses = self._bodies.poses()

    def show(self, status: PageStatus) -> None:
        """Show the status of the session."""
        self._status = status

    def _links(self) -> Pose | None:
        state = self.human.state
        if state is None:
            return None
        return self._chain.link_poses(torch.from_numpy(state.joint_position))

    def _guarded(self) -> None:
        """Refresh input and scene: periodically, and as soon as hands have moved."""
        due, ticks, failures = 0.0, 0, 0
        while not self._closing.is_set():
            self._wake.wait(max(due - time.monotonic(), 0.0))
            self._wake.clear()
            try:
                command = self._refresh()
                if time.monotonic() >= due:
                    due = time.monotonic() + _PERIOD
                    if command is not None:
                        self._draw(command, panel=ticks % _PANEL_EVERY == 0)
                        ticks += 1
                failures = 0
            except Exception as error:
                failures, due = failures + 1, time.monotonic() + _PERIOD
                _logger.exception("the page could not follow the arm")
                if failures >= _MOST_FAILURES:  # raised by the thread that closes the page
                    self._error = error
                    return

    def _refresh(self) -> GizmoCommand | None:
        """Renew the person's input, and the scene for clients that draw it themselves.

        Returns:
            The command; None before the first reading of the arm.
        """
        state, links = self.human.state, self._links()
        if state is None or links is None:
            return None
        command, status, editor = self._command(state), self._status, self._panel.editor
        scene = {
            "bodies": np.concatenate(self._poses, axis=1).round(6),
            "links": links.position.numpy().round(6),
            "tool": links[-1].orientation.numpy().round(6),
            "arrows": command.arrows.round(6),
            "colour": followed_colour(self.human.feedback.followed),
            "followed": status.region,
            "drawn": None if editor is None else editor.drawn,
            "active": editor is not None and editor.region is not None,
            "plan": () if status.plan is None else status.plan.round(4),
        }
        self._sockets.scene = msgspec.Raw(json_text(scene, indent=False))
        return command

    def _draw(self, command: GizmoCommand, *, panel: bool) -> None:
        """Let viser's event loop draw, unless it is still drawing the last picture.

        Raises:
            Exception: Drawing the last picture failed.
        """
        if self._drawing is not None:
            if not self._drawing.done():
                return
            drawn, self._drawing = self._drawing, None
            drawn.result()

        async def draw() -> None:
            links, feedback = self._links(), self.human.feedback
            assert links is not None
            colour = followed_colour(feedback.followed)
            self._scene.move(*self._poses, links)
            self._scene.point(command.arrows, colour, command.held)
            self._scene.show_region(self._status.region)
            if panel:
                people, d = self.control.people, command.nullspace_input
                self._panel.refresh(self._status, feedback, d, people)

        loop = self._server.get_event_loop()
        self._drawing = asyncio.run_coroutine_threadsafe(draw(), loop)

    def _command(self, state: ArmState) -> GizmoCommand:
        """Renew the person's input.

        The server notices a lost connection, for example after a cable was unplugged, only much
        later. A pointer at rest sends nothing. Signs of life are therefore checked separately.
        """
        control, panel, held = self.control, self._panel, self._held_gizmos
        if control.gone:
            held.release()
        present = control.present
        gizmos = held.held().values() if present else ()
        if gizmos:
            control.keep()
        command = gizmo_command(
            self._chain,
            state.joint_position,
            gizmos,
            panel.forces,
            direction=panel.keys.direction() if present else np.zeros(3),
            turn=held.turn,
        )
        editor = panel.editor
        self.human.post(
            HumanInput(
                nullspace_input=command.nullspace_input,
                twist=command.twist,
                region=None if editor is None else editor.region,
                target=None if editor is None else editor.target,
                turn=held.turn_vector,
            )
        )
        return command

    def _let_go(self) -> None:
        """Release everything that was held before control changed."""
        self._held_gizmos.release()
        self._hands.forget()

    def _heard(self, message: messages.Message) -> None:
        """Handle a message from the controlling client."""
        match message:
            case messages.Hands():
                self._hands.hear(message)
                self._asked = message.sent
                self._wake.set()
            case messages.Ask(request=request):
                self.human.request(request)
            case messages.Gripper(width=width):
                self.human.grip(width)
            case _:
                loop = self._server.get_event_loop()
                loop.call_soon_threadsafe(self._panel.hear, message)

    def _told(self) -> dict[str, Any]:
        """Status for the bar at the top of the page."""
        words = slow_words(*self.control.slow, self._config)
        if self._error is not None:
            words = "The page does not follow the arm any more: see the terminal."
        feedback, status = self.human.feedback, self._status
        return {
            "words": words,
            "recording": status.state,
            "seconds": round(status.seconds, 2),
            "saved": status.saved,
            "note": status.note,
            "doing": status.doing,
            "task": self.task,
            "pushed": feedback.pushed,
            "followed": round(feedback.followed, 3),
            "pulse": rumble_strength(feedback),  # a headset's controllers rumble, too
            "reasons": [reason.text for reason in feedback.reasons],
            "felt": felt_words(feedback),
            "sent": self._asked,
        }


def slow_words(silence: float, lag: float, config: PageConfig) -> str:
    """Reason why the arm does not follow a drag; empty if it follows.

    Args:
        silence: Time without a sign of life from the controlling client [s].
        lag: Time for which the client's page did not respond [s].
        config: Settings of the page.
    """
    if lag > config.timeout / 2:
        return (
            f"This browser was busy for {lag:.1f} s. After {config.timeout:.1f} s the arm "
            "no longer follows it. Make its window smaller, hide the virtual twin, or put "
            "?fixedDpr=0.5 behind the page's address, which draws a quarter of the pixels."
        )
    if silence > config.silence:
        return (
            f"The link is slow: nothing was heard from this browser for {silence:.2f} s, "
            f"and beyond {config.silence:.2f} s the arm waits."
        )
    return ""
