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
from hrc_learn.teleoperation.page.page_scene import Stage
from hrc_learn.teleoperation.page.viser_names import Holdable, SceneNodeDragEvent, ViserServer

# Who holds the arm where: handles that people have taken in their browsers.


@dataclass(frozen=True, kw_only=True, eq=False)
class Grip:
    """A handle that somebody holds."""

    joint: int | None
    """Joint that moves the link held, counted from 1; None: the hand is held."""
    held_at: Float[np.ndarray, "3"]
    """Point of the link that is held, in the frame of the link; of the hand: that point less
    the tool centre point, in the base frame [m]."""
    pointer: Float[np.ndarray, "3"]
    """Where the handle has been dragged to, in the base frame [m]."""
    orientation: Float[np.ndarray, "4"] | None = None
    """Orientation the handle of the hand has been turned to (wxyz)."""


class Grips:
    """All grips, each until it is let go or its holder is not heard of any more.

    Safe to use from several threads. A holder is whatever tells two browsers apart.
    """

    def __init__(self, patience: float, clock: Callable[[], float] = time.monotonic):
        """Start with nobody holding anything.

        Args:
            patience: Time after the last sign of life at which a holder is given up [s].
            clock: Tells the time [s].

        Raises:
            ValueError: The patience is not positive.
        """
        if not patience > 0:
            raise ValueError(f"patience must be positive, but is {patience}.")
        self.patience = patience
        self._clock = clock
        self._grips: dict[tuple[int, str], Grip] = {}
        self._heard: dict[int, float] = {}
        self._lock = Lock()

    def take(self, holder: int, handle: str, grip: Grip) -> None:
        """Begin to hold a handle."""
        with self._lock:
            self._grips[holder, handle] = grip
            self._heard[holder] = self._clock()

    def move(
        self,
        holder: int,
        handle: str,
        pointer: Float[np.ndarray, "3"],
        orientation: Float[np.ndarray, "4"] | None = None,
    ) -> None:
        """Drag a handle on; one that is not held (any more) stays where it is."""
        with self._lock:
            self._heard[holder] = self._clock()
            grip = self._grips.get((holder, handle))
            if grip is not None:
                self._grips[holder, handle] = replace(
                    grip, pointer=pointer, orientation=orientation
                )

    def release(self, holder: int, handle: str) -> None:
        """Let go of a handle."""
        with self._lock:
            self._grips.pop((holder, handle), None)

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
            return {holder for holder, _ in self._grips}

    def held(self) -> dict[tuple[int, str], Grip]:
        """Grips of those who have been heard of lately, by holder and handle.

        The others lose theirs for good: a connection that comes back does not move the arm
        before its handle is taken anew.
        """
        with self._lock:
            now = self._clock()
            for holder in [h for h, t in self._heard.items() if now - t > self.patience]:
                self._drop(holder)
            return dict(self._grips)

    def _drop(self, holder: int) -> None:
        self._heard.pop(holder, None)
        for key in [key for key in self._grips if key[0] == holder]:
            del self._grips[key]


# The mouse on the arm: links, knobs and the hand's handle, turned into grips.

_BASE_AXES = (1.0, 0.0, 0.0, 0.0)


class Handles:
    """Connects what can be held in the scene with the grips.

    Callbacks are coroutines: the browser's messages then come in their order.
    """

    def __init__(
        self,
        server: ViserServer,
        stage: Stage,
        grips: Grips,
        links: Callable[[], Pose | None],
        *,
        leads: bool = True,
    ):
        """Connect.

        Args:
            server: Of the page.
            stage: What can be held.
            grips: Who holds what.
            links: Frames of the arm as they are now (see `SerialChain.link_poses`); None
                before the arm is known.
            leads: Whether the hand can be held, too, and has a handle.
        """
        self._grips, self._links, self._turns = grips, links, False
        for node, joint, offset in stage.handles():
            if leads or joint is not None:
                self._connect(node, joint, offset)
        self._gizmo = None
        if leads:
            self._gizmo = server.scene.add_transform_controls(
                "/hand_handle", scale=0.2, disable_rotations=True, depth_test=False
            )
            self._gizmo.on_update(self._gizmo_dragged)
        server.on_client_disconnect(lambda client: grips.release_all(client.client_id))

    def follow(self, hand: Pose) -> None:
        """Keep the hand's handle at the hand while nobody holds it."""
        gizmo = self._gizmo
        if gizmo is None or any(handle == gizmo.name for _, handle in self._grips.held()):
            return
        gizmo.position = hand.position.numpy()
        # A hand that is only moved is moved along the axes of the base.
        gizmo.wxyz = hand.orientation.numpy() if self._turns else _BASE_AXES

    def let_turn(self, turns: bool) -> None:
        """Whether the hand's handle has rings to turn it by."""
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
                self._grips.move(event.client_id, node.name, pointer)
            else:
                self._grips.release(event.client_id, node.name)

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
        self._grips.take(holder, name, Grip(joint=joint, held_at=held_at, pointer=pointer))

    async def _gizmo_dragged(self, event: Any) -> None:
        name, pointer = event.target.name, event.target.position.copy()
        if event.client_id is None:
            return
        if event.phase == "start":
            grip = Grip(joint=None, held_at=np.zeros(3), pointer=pointer)
            self._grips.take(event.client_id, name, grip)
        elif event.phase == "update":
            self._grips.move(event.client_id, name, pointer, event.target.wxyz.copy())
        else:
            self._grips.release(event.client_id, name)
