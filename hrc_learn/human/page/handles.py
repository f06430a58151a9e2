"""The mouse on the arm: links, knobs and the hand's handle, turned into grips."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from ...geometry import Pose
from .grips import Grip, Grips
from .library import Holdable, SceneNodeDragEvent, ViserServer
from .stage import Stage

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
