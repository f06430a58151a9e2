"""The mouse on the arm: links, knobs and the end effector's gizmo, and who holds which."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from threading import Lock
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from hrc_learn.geometry import Pose
from hrc_learn.teleoperation.page._viser import Holdable, SceneNodeDragEvent, ViserServer
from hrc_learn.teleoperation.page.page_scene import PageScene


@dataclass(frozen=True, kw_only=True, eq=False)
class HeldGizmo:
    """A gizmo that somebody holds in their browser."""

    joint: int | None
    """Joint that moves the link held, counted from 1; None: the end effector is held."""
    held_at: Float[np.ndarray, "3"]
    """Point of the link that is held, in the frame of the link; of the end effector: that point
    less the tool centre point, in the base frame [m]."""
    pointer: Float[np.ndarray, "3"]
    """Where the gizmo has been dragged to, in the base frame [m]."""
    orientation: Float[np.ndarray, "4"] | None = None
    """Orientation the end effector's gizmo has been turned to (wxyz)."""


class HeldGizmos:
    """All held gizmos, each until it is released or its holder's browser times out.

    Safe to use from several threads. A holder is whatever tells two browsers apart.
    """

    def __init__(self, timeout: float, clock: Callable[[], float] = time.monotonic):
        """Start with nobody holding anything.

        Args:
            timeout: Time after the last sign of life at which a holder is given up [s].
            clock: Tells the time [s].

        Raises:
            ValueError: The timeout is not positive.
        """
        if not timeout > 0:
            raise ValueError(f"timeout must be positive, but is {timeout}.")
        self.timeout = timeout
        self._clock = clock
        self._held: dict[tuple[int, str], HeldGizmo] = {}
        self._heard: dict[int, float] = {}
        self._lock = Lock()

    def take(self, holder: int, handle: str, held: HeldGizmo) -> None:
        """Begin to hold a gizmo."""
        with self._lock:
            self._held[holder, handle] = held
            self._heard[holder] = self._clock()

    def move(
        self,
        holder: int,
        handle: str,
        pointer: Float[np.ndarray, "3"],
        orientation: Float[np.ndarray, "4"] | None = None,
    ) -> None:
        """Drag a gizmo on; one that is not held (any more) stays where it is."""
        with self._lock:
            self._heard[holder] = self._clock()
            held = self._held.get((holder, handle))
            if held is not None:
                self._held[holder, handle] = replace(
                    held, pointer=pointer, orientation=orientation
                )

    def release(self, holder: int, handle: str) -> None:
        """Let go of a gizmo."""
        with self._lock:
            self._held.pop((holder, handle), None)

    def release_all(self, holder: int) -> None:
        """Forget somebody who has left."""
        with self._lock:
            self._drop(holder)

    def hear(self, holder: int) -> None:
        """Note a sign of life."""
        with self._lock:
            if holder in self._heard:
                self._heard[holder] = self._clock()

    @property
    def holders(self) -> set[int]:
        """Those who hold something."""
        with self._lock:
            return {holder for holder, _ in self._held}

    def held(self) -> dict[tuple[int, str], HeldGizmo]:
        """Those whose holders have been heard of lately, by holder and name.

        The others are released for good: a connection that comes back does not move the arm
        before its gizmo is taken anew.
        """
        with self._lock:
            now = self._clock()
            for holder in [h for h, t in self._heard.items() if now - t > self.timeout]:
                self._drop(holder)
            return dict(self._held)

    def _drop(self, holder: int) -> None:
        self._heard.pop(holder, None)
        for key in [key for key in self._held if key[0] == holder]:
            del self._held[key]


_BASE_AXES = (1.0, 0.0, 0.0, 0.0)  # unit quaternion (wxyz)


class Gizmos:
    """Lets people hold links, knobs and the end effector's gizmo with the mouse.

    Callbacks are coroutines: the browser's messages then come in their order.
    """

    def __init__(
        self,
        server: ViserServer,
        scene: PageScene,
        held_gizmos: HeldGizmos,
        links: Callable[[], Pose | None],
        *,
        guides: bool = True,
    ):
        """Connect.

        Args:
            server: Of the page.
            scene: What can be held.
            held_gizmos: Who holds what.
            links: Frames of the arm as they are now (see `SerialChain.link_poses`); None
                before the arm is known.
            guides: Whether the end effector can be held, too, and has a gizmo.
        """
        self._held_gizmos, self._links, self._turns = held_gizmos, links, False
        for node, joint, offset in scene.holdables():
            if guides or joint is not None:
                self._connect(node, joint, offset)
        self._gizmo = None
        if guides:
            self._gizmo = server.scene.add_transform_controls(
                "/end_effector", scale=0.2, disable_rotations=True, depth_test=False
            )
            self._gizmo.on_update(self._gizmo_dragged)
        server.on_client_disconnect(lambda client: held_gizmos.release_all(client.client_id))

    def follow(self, pose: Pose) -> None:
        """Keep the end effector's gizmo at the end effector while nobody holds it."""
        gizmo = self._gizmo
        if gizmo is None or any(name == gizmo.name for _, name in self._held_gizmos.held()):
            return
        gizmo.position = pose.position.numpy()
        # Without rotation it moves along the axes of the base.
        gizmo.wxyz = pose.orientation.numpy() if self._turns else _BASE_AXES

    def let_turn(self, turns: bool) -> None:
        """Whether the end effector's gizmo has rings to turn it by."""
        self._turns = turns
        if self._gizmo is not None:
            self._gizmo.disable_rotations = not turns

    def _connect(
        self, node: Holdable, joint: int | None, offset: Float[np.ndarray, "3"]
    ) -> None:
        @node.on_drag
        async def dragged(event: SceneNodeDragEvent) -> None:
            pointer = np.array(event.end_position) - offset
            if event.phase == "start":
                held = np.array(event.start_position) - offset
                self._take(event.client_id, node.name, joint, held, pointer)
            elif event.phase == "update":
                self._held_gizmos.move(event.client_id, node.name, pointer)
            else:
                self._held_gizmos.release(event.client_id, node.name)

    def _take(
        self,
        holder: int,
        name: str,
        joint: int | None,
        held: Float[np.ndarray, "3"],
        pointer: Float[np.ndarray, "3"],
    ) -> None:
        links = self._links()
        if links is None:
            return
        if joint is None:
            held_at = held - links[-1].position.numpy()
        else:
            held_at = links[joint - 1].inverse().apply(torch.from_numpy(held)).numpy()
        self._held_gizmos.take(
            holder, name, HeldGizmo(joint=joint, held_at=held_at, pointer=pointer)
        )

    async def _gizmo_dragged(self, event: Any) -> None:
        name, pointer = event.target.name, event.target.position.copy()
        if event.client_id is None:
            return
        if event.phase == "start":
            held = HeldGizmo(joint=None, held_at=np.zeros(3), pointer=pointer)
            self._held_gizmos.take(event.client_id, name, held)
        elif event.phase == "update":
            self._held_gizmos.move(event.client_id, name, pointer, event.target.wxyz.copy())
        else:
            self._held_gizmos.release(event.client_id, name)
