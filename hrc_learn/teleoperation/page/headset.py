"""Scene state for clients that render the scene themselves, and their tracked hands."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from hrc_learn.geometry import Pose
from hrc_learn.protocols import DrawnRegion
from hrc_learn.teleoperation.gate.messages import Grip, Hands, MessageError, TrackedHand
from hrc_learn.teleoperation.page.page_operator import AddedTurn, HeldGizmo, HeldGizmos

_HOLDER = "headset"
_NO_TURN = np.array([1.0, 0.0, 0.0, 0.0])


class HeadsetHands:
    """Turns what two hands hold into held gizmos, by the rules of the mouse.

    A message names all that is held; what an earlier one named and this one does not is let go.
    """

    def __init__(
        self,
        held: HeldGizmos,
        turn: AddedTurn,
        links: Callable[[], Pose | None],
        *,
        guides: bool,
    ):
        """Start with empty hands.

        Args:
            held: Record of held gizmos.
            turn: Rotation that a hand adds to the end effector's orientation.
            links: Frames of the arm as they are now; None before the arm is known.
            guides: True if the end effector can be held.
        """
        self._held, self._turn, self._links, self._guides = held, turn, links, guides
        self._grips: dict[str, Grip] = {}
        self._tracked: Mapping[str, TrackedHand] = {}
        self._noted = False

    @property
    def tracked(self) -> Mapping[str, TrackedHand]:
        """Tracked hands that are visible now, by name."""
        return self._tracked

    def hear(self, hands: Hands) -> None:
        """Take a message over.

        Raises:
            MessageError: It holds a joint that the arm does not have.
        """
        self._tracked = {seen.hand: seen for seen in hands.tracked}
        links = self._links()
        if links is None:
            return
        now = {
            grip.hand: grip for grip in hands.grips if self._guides or grip.joint is not None
        }
        if not self._noted:
            self._grips, self._noted = now, True
        for hand in self._grips.keys() - now.keys():
            self._held.release(_HOLDER, hand)
            self._turn.release((_HOLDER, hand))
        for hand, grip in now.items():
            before = self._grips.get(hand)
            if before is None or (before.joint, before.start) != (grip.joint, grip.start):
                self._take(grip, links)
            else:
                self._held.move(_HOLDER, hand, np.array(grip.pointer))
            if grip.joint is None and grip.orientation is not None:
                self._turn.move((_HOLDER, hand), np.array(grip.orientation))
        self._grips = now

    def forget(self) -> None:
        """Forget the hands when control changes; held gizmos move nothing until they are taken
        again.
        """
        self._noted, self._tracked = False, {}

    def _take(self, grip: Grip, links: Pose) -> None:
        start = torch.tensor(grip.start, dtype=torch.float64)
        if grip.joint is None:
            held_at = start - links[-1].position
            if grip.orientation is not None:
                self._turn.take((_HOLDER, grip.hand), _NO_TURN)
        elif grip.joint < len(links.position):
            held_at = links[grip.joint - 1].inverse().apply(start)
        else:
            raise MessageError(f"the arm has no joint {grip.joint}")
        gizmo = HeldGizmo(
            joint=grip.joint, held_at=held_at.numpy(), pointer=np.array(grip.pointer)
        )
        self._held.take(_HOLDER, grip.hand, gizmo)


def scene_state(
    positions: Float[np.ndarray, "bodies 3"],
    orientations: Float[np.ndarray, "bodies 4"],
    links: Pose,
    arrows: Float[np.ndarray, "arrows 2 3"],
    colour: str,
    followed: DrawnRegion | None,
    drawn: DrawnRegion | None,
    active: bool,
    plan: Float[np.ndarray, "points 3"] | None = None,
) -> dict[str, Any]:
    """Poses and regions of the scene, for a client that renders it itself.

    Args:
        positions: Positions of the bodies [m].
        orientations: Orientations of the bodies (wxyz).
        links: Frames of the arm; the last is the tool's.
        arrows: Arrows from the points held to the pointers [m].
        colour: Colour of the arrows, which shows how far the arm follows.
        followed: Region to which a controller takes the end effector.
        drawn: Region that the person draws.
        active: True if the drawn region attracts the end effector.
        plan: Planned path of the end effector [m]; None: there is none.
    """
    return {
        "bodies": np.concatenate([positions, orientations], axis=1).round(6).tolist(),
        "links": links.position.numpy().round(6).tolist(),
        "tool": links[-1].orientation.numpy().round(6).tolist(),
        "arrows": arrows.round(6).tolist(),
        "colour": colour,
        "followed": None if followed is None else vars(followed),
        "drawn": None if drawn is None else vars(drawn),
        "active": active,
        "plan": [] if plan is None else plan.round(4).tolist(),
    }
