"""The page in a browser from which a person guides the arm: a stand-in for an AR headset."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from threading import Event, Thread
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from hrc_learn.geometry import Body, Box, Pose
from hrc_learn.kinematics import SerialChain
from hrc_learn.protocols import ArmState, HumanInput
from hrc_learn.teleoperation.hand_guiding import InteractionForceConfig, leading_twist
from hrc_learn.teleoperation.page.page_operator import (
    AddedTurn,
    GizmoCommand,
    HeldGizmos,
    PageHuman,
    gizmo_command,
)
from hrc_learn.teleoperation.page.page_scene import Gizmos, PageScene
from hrc_learn.teleoperation.page.panel import PageStatus, Panel
from hrc_learn.viz.palette import followed_colour


@dataclass(frozen=True, kw_only=True)
class PageConfig:
    """The page's own settings."""

    host: str = "127.0.0.1"
    """Address to serve at. Whoever reaches it can move the arm."""
    port: int = 8080
    """Port to serve at; the next free one is taken if it is in use."""
    forces: InteractionForceConfig = field(default_factory=InteractionForceConfig)
    """How strongly gizmos act."""
    timeout: float = 0.6
    """Time without a sign of life from a browser after which its grips are let go [s]."""
    refresh: float = 25.0
    """Times a second that the page follows the arm, and efforts are computed anew [1/s]."""
    twin: tuple[float, float, float] = (-0.1, 1.3, 0.0)
    """Where the virtual twin stands, from the arm [m]."""

    def __post_init__(self) -> None:
        for name in ("timeout", "refresh"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be positive, but is {getattr(self, name)}.")


_PANEL_EVERY = 5  # refreshes of the scene for one of the panel: text need not be as smooth


class Page:
    """Serves the page and keeps it up to date, in threads of its own.

        with Page(panda, bodies, boxes) as page:
            while running:
                human_input = page.human.read(arm.read())
                ...
                page.place(positions, orientations)
                page.show(status)

    The control loop pays for `human.read`, `place` and `show`, which exchange references.

    Attributes:
        human: The person at the page.
        url: Where the page is.
    """

    def __init__(
        self,
        chain: SerialChain,
        bodies: Sequence[Body],
        boxes: Sequence[Box] = (),
        config: PageConfig | None = None,
        *,
        task: str = "",
        guides: bool = True,
        draws: bool | None = None,
    ):
        """Serve the page; it follows the arm within the `with` block.

        Args:
            chain: The arm.
            bodies: What moves, with its shapes and first poses. "link1", "link2", ... can be
                held, and "hand", "finger_left", "finger_right", which move the end effector.
            boxes: What stands.
            config: Of the page.
            task: What is to be demonstrated, in words.
            guides: Whether the person guides the end effector and records. Beside an arm that
                works by itself they do not.
            draws: Whether they draw regions, mark targets and turn the end effector; None: as
                they guide. People pull in the null space in any case.
        """
        import viser

        self._config = config = config or PageConfig()
        self._chain = chain
        self.human = PageHuman(len(chain.joint_names))
        self._server = viser.ViserServer(config.host, config.port, verbose=False)
        self.url = f"http://{config.host}:{self._server.get_port()}"
        self._held_gizmos, self._turn = HeldGizmos(config.timeout), AddedTurn()
        draws = guides if draws is None else draws
        self._scene = PageScene(self._server, bodies, boxes, config.twin)
        self._gizmos = Gizmos(
            self._server,
            self._scene,
            self._held_gizmos,
            self._links,
            self._turn,
            guides=guides,
            turns=draws,
        )
        self._panel = Panel(
            self._server,
            boxes,
            config.forces,
            self.human.request,
            self._scene.show_twin,
            self._gizmos.let_turn,
            task,
            self._turn,
            guides=guides,
            draws=draws,
        )
        self._poses = (
            np.stack([body.position[0] for body in bodies]),
            np.stack([body.orientation[0] for body in bodies]),
        )
        self._status = PageStatus()
        self._placed, self._counted = 0, (0, time.monotonic())
        self._closing = Event()
        self._error: BaseException | None = None
        self._threads = [
            Thread(target=self._guarded, args=(work,), name=f"page {name}", daemon=True)
            for name, work in (("refresh", self._refresh), ("listen", self._listen))
        ]

    def __enter__(self) -> Page:
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, kind: Any, error: BaseException | None, trace: Any) -> None:
        self._closing.set()
        for thread in self._threads:
            thread.join()
        self._server.stop()
        if self._error is not None and error is None:
            raise self._error

    @property
    def task(self) -> str:
        """What is demonstrated, in words, as the person has put it."""
        return self._panel.task

    @property
    def alive(self) -> bool:
        """Whether the page still follows the arm; leaving the block raises why it does not."""
        return self._error is None

    def place(
        self,
        positions: Float[np.ndarray, "bodies 3"],
        orientations: Float[np.ndarray, "bodies 4"],
    ) -> None:
        """Tell after each step where the bodies are: positions [m], unit quaternions (wxyz)."""
        self._poses = (positions, orientations)
        self._placed += 1

    def show(self, status: PageStatus) -> None:
        """Tell how the session stands."""
        self._status = status

    def _guarded(self, work: Callable[[], None]) -> None:
        try:
            work()
        except Exception as error:  # handed over to the thread that closes
            self._error = error

    def _links(self) -> Pose | None:
        state = self.human.state
        return None if state is None else self._chain.link_poses(_joints(state))

    def _refresh(self) -> None:
        """Follow the arm, and renew what is asked of it."""
        period, ticks = 1 / self._config.refresh, 0
        while not self._closing.wait(period):
            state = self.human.state
            if state is None:
                continue
            command = self._command(state)
            links = self._chain.link_poses(_joints(state))
            feedback = self.human.feedback
            colour = followed_colour(feedback.followed)
            with self._server.atomic():
                self._scene.move(*self._poses, links.position.numpy())
                self._scene.point(command.arrows, colour, command.held)
                self._scene.show_region(self._status.region)
                self._gizmos.follow(links[-1])
                if ticks % _PANEL_EVERY == 0:
                    people = len(self._server.get_clients())
                    self._panel.refresh(
                        self._status, command.nullspace_input, self._rate(), people
                    )
                    self._panel.tell(feedback)
            ticks += 1

    def _rate(self) -> float:
        """Steps that the loop has taken since the last time this was asked [1/s]."""
        placed, began = self._counted
        self._counted = self._placed, time.monotonic()
        return (self._counted[0] - placed) / max(self._counted[1] - began, 1e-9)

    def _command(self, state: ArmState) -> GizmoCommand:
        panel, forces = self._panel, self._panel.forces
        gizmos = self._held_gizmos.held().values()
        turn = self._turn.rotation
        command = gizmo_command(
            self._chain, state.joint_position, gizmos, forces, coarse=panel.coarse, turn=turn
        )
        twist = command.twist
        if not twist.any():
            way, joints = panel.direction(), state.joint_position
            twist = leading_twist(
                self._chain, joints, way, forces, coarse=panel.coarse, turn=turn
            )
        self.human.post(
            HumanInput(
                nullspace_input=command.nullspace_input,
                twist=twist,
                gripper=panel.gripper,
                region=panel.region,
                target=panel.target,
                turn=self._turn.vector,
            )
        )
        return command

    def _listen(self) -> None:
        """Ask the browsers of those who hold something whether they are still there.

        A browser that is told nothing for a while may be gone, its network cable pulled: the
        server learns of that much later. A pointer at rest sends nothing either.
        """
        while not self._closing.wait(self._config.timeout / 4):
            for holder in self._held_gizmos.holders:
                client = self._server.get_clients().get(holder)
                if client is None:
                    self._held_gizmos.release_all(holder)
                    continue
                with contextlib.suppress(TimeoutError, RuntimeError):
                    sent = time.monotonic()
                    client.local_storage.get_item("alive", timeout=self._config.timeout)
                    if time.monotonic() - sent < self._config.timeout:
                        self._held_gizmos.hear(holder)


def _joints(state: ArmState) -> Float[torch.Tensor, " joints"]:
    return torch.from_numpy(state.joint_position)
