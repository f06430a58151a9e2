"""Combine the people at the page into one `Human`: gizmos held by mouse or hand, other input.

A gizmo is a handle that a person drags: a link of the arm, or its end effector.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Collection, Hashable, Mapping
from dataclasses import dataclass, replace
from threading import Lock

import numpy as np
import torch
from jaxtyping import Float

from hrc_learn.geometry import Pose, quaternion
from hrc_learn.kinematics import SerialChain
from hrc_learn.protocols import ArmState, Feedback, Human, HumanInput, Request
from hrc_learn.teleoperation.gate.messages import Grip, Hands, MessageError, TrackedHand
from hrc_learn.teleoperation.hand_guiding import (
    InteractionForceConfig,
    bounded,
    gizmo_nullspace_input,
    guiding_twist,
)

_NOWHERE = np.zeros(3)
_NO_TURN = torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=torch.float64)


@dataclass(frozen=True, kw_only=True, eq=False)
class HeldGizmo:
    """Gizmo that a person holds in a browser."""

    joint: int | None
    """Joint that moves the held link, counted from 1; None: the end effector is held."""
    held_at: Float[np.ndarray, "3"]
    """Held point, in the frame of the link; for the end effector: offset of the held point from
    the tool centre point, along the base axes [m]."""
    pointer: Float[np.ndarray, "3"]
    """Position to which the gizmo has been dragged, in the base frame [m]."""


Key = tuple[Hashable, str]
"""Holder (ID of a browser's client, or "headset"), and name of the held gizmo or hand."""


class HeldGizmos:
    """Record of all held gizmos, and of the rotation that people add to the end effector's
    orientation with the rings of its gizmo.

    A gizmo is held until it is released or its holder leaves. The added rotation stays after
    release, and the next drag adds to it. Safe to use from several threads.
    """

    def __init__(
        self,
        changed: Callable[[], object] = lambda: None,
        links: Callable[[], Pose | None] = lambda: None,
    ) -> None:
        """Start without held gizmos.

        Args:
            changed: Called when a gizmo is taken, dragged or released.
            links: Present frames of the arm (see `SerialChain.link_poses`); None before the arm
                is known.
        """
        self._changed, self.links = changed, links
        self._held: dict[Key, HeldGizmo] = {}
        self._turning: Key | None = None
        self._turn = self._turn_before = self._turned_from = _NO_TURN
        self._lock = Lock()

    def take(
        self,
        key: Key,
        held: HeldGizmo | None,
        turned_from: Float[np.ndarray, "4"] | None = None,
    ) -> None:
        """Begin to hold a gizmo.

        Args:
            key: Holder and gizmo.
            held: Joint and point held; None: the gizmo is only turned.
            turned_from: Present orientation of the gizmo's rings (wxyz), from which the added
                rotation counts; None: no rings are held.
        """
        with self._lock:
            if held is not None:
                self._held[key] = held
            if turned_from is not None:
                self._turning, self._turn_before = key, self._turn
                self._turned_from = torch.from_numpy(turned_from)
        self._changed()

    def grab(
        self,
        key: Key,
        joint: int | None,
        start: Float[np.ndarray, "3"],
        pointer: Float[np.ndarray, "3"],
        turned_from: Float[np.ndarray, "4"] | None = None,
    ) -> None:
        """Begin to hold a link, or the end effector, at a point of the base frame [m]."""
        links = self.links()
        if links is None:
            return
        if joint is None:
            held_at = start - links[-1].position.numpy()
        else:
            held_at = links[joint - 1].inverse().apply(torch.from_numpy(start)).numpy()
        held = HeldGizmo(joint=joint, held_at=held_at, pointer=pointer)
        self.take(key, held, turned_from)

    def move(
        self,
        key: Key,
        pointer: Float[np.ndarray, "3"],
        orientation: Float[np.ndarray, "4"] | None = None,
    ) -> None:
        """Drag and turn a held gizmo; a gizmo that is not held (any more) stays in place."""
        with self._lock:
            if (held := self._held.get(key)) is not None:
                self._held[key] = replace(held, pointer=pointer)
            if self._turning == key and orientation is not None:
                now = quaternion.multiply(
                    torch.from_numpy(orientation), quaternion.conjugate(self._turned_from)
                )
                self._turn = quaternion.normalize(quaternion.multiply(now, self._turn_before))
        self._changed()

    def release(self, holder: Hashable = None, name: str | None = None) -> None:
        """Release one gizmo of a holder, all gizmos of a holder, or all held gizmos.

        After a lost connection is restored, the person must take the gizmo again.
        """

        def chosen(key: Key) -> bool:
            return holder in (None, key[0]) and name in (None, key[1])

        with self._lock:
            released = [key for key in self._held if chosen(key)]
            for key in released:
                del self._held[key]
            if self._turning is not None and chosen(self._turning):
                self._turning = None
        if released:
            self._changed()

    def held(self) -> dict[Key, HeldGizmo]:
        """All held gizmos."""
        with self._lock:
            return dict(self._held)

    @property
    def turning(self) -> bool:
        """True while a person holds the rings."""
        return self._turning is not None

    def clear_turn(self) -> None:
        """Remove the added rotation."""
        with self._lock:
            self._turn = self._turn_before = _NO_TURN

    @property
    def turn(self) -> Float[torch.Tensor, "4"]:
        """Unit quaternion of the added rotation (wxyz)."""
        with self._lock:
            return self._turn

    @property
    def turn_vector(self) -> tuple[float, float, float] | None:
        """Vector of the added rotation, in the base frame [rad]; None: no added rotation."""
        turn = self.turn
        if float(quaternion.angle(turn, _NO_TURN)) == 0.0:
            return None
        x, y, z = quaternion.log(turn).tolist()
        return x, y, z


_AT_REST = np.array([1.0, 0.0, 0.0, 0.0])  # unit quaternion (wxyz)


class HeadsetHands:
    """Converts the grips of two hands into held gizmos, with the same rules as for the mouse.

    A message lists everything that is held; whatever is no longer listed is released.

    Attributes:
        tracked: Tracked hands that are visible now, by name.
    """

    def __init__(self, held: HeldGizmos, *, guides: bool):
        """Start with empty hands.

        Args:
            held: Record of held gizmos.
            guides: True if the end effector can be held.
        """
        self._held, self._guides = held, guides
        # Last grip of each hand. None: the next message only states what is held already, and
        # moves nothing.
        self._grips: dict[str, Grip] | None = None
        self.tracked: Mapping[str, TrackedHand] = {}

    def hear(self, hands: Hands) -> None:
        """Handle a message.

        Raises:
            MessageError: The message names a joint that the arm does not have.
        """
        self.tracked = {seen.hand: seen for seen in hands.tracked}
        links = self._held.links()
        if links is None:
            return
        now = {
            grip.hand: grip for grip in hands.grips if self._guides or grip.joint is not None
        }
        if self._grips is None:
            self._grips = now
        for hand in self._grips.keys() - now.keys():
            self._held.release("headset", hand)
        for hand, grip in now.items():
            key, pointer = ("headset", hand), np.array(grip.pointer)
            turned = grip.orientation if grip.joint is None else None
            before = self._grips.get(hand)
            if before is None or (before.joint, before.start) != (grip.joint, grip.start):
                # Flange and tool centre point, the last two, have no joint.
                if grip.joint is not None and grip.joint > len(links.position) - 2:
                    raise MessageError(f"the arm has no joint {grip.joint}")
                start, turned_from = np.array(grip.start), None if turned is None else _AT_REST
                self._held.grab(key, grip.joint, start, pointer, turned_from)
            self._held.move(key, pointer, None if turned is None else np.array(turned))
        self._grips = now

    def forget(self) -> None:
        """Forget the hands when control changes; held gizmos move nothing until they are taken
        again.
        """
        self._grips, self.tracked = None, {}


class PageHuman(Human):
    """Passes a person's input from the page's thread to the control loop, without a lock.

    `read` takes about a microsecond: it exchanges references and computes nothing. Posted
    input expires after `holds_for` (the dead man's switch): if the page falls silent, no motion
    is requested.

    Attributes:
        state: The newest reading of the arm; None before the first.
        feedback: Latest feedback of the arm.
    """

    def __init__(
        self,
        *,
        holds_for: float = 0.25,
        clock: Callable[[], float] = time.monotonic,
        present: Callable[[], bool] = lambda: True,
    ):
        """Start without input.

        Args:
            holds_for: Time for which a posted input stays valid [s].
            clock: Monotonic clock [s].
            present: True while the person gives signs of life; called at each reading.
        """
        self._holds_for, self._clock, self._present = holds_for, clock, present
        # The input and the end of its validity: changed together, as one reference.
        self._posted = (HumanInput(), float("-inf"))
        self._requests, self._openings = deque[Request](), deque[float](maxlen=1)
        self.state: ArmState | None = None
        self.feedback = Feedback()

    def post(self, asked: HumanInput) -> None:
        """Renew the person's input; requests are passed to `request` instead."""
        self._posted = (asked, self._clock() + self._holds_for)

    def request(self, request: Request) -> None:
        """Make a request, which the next `read` returns once."""
        self._requests.append(request)

    def grip(self, width: float) -> None:
        """Request an opening of the gripper [m], which the next `read` returns once."""
        self._openings.append(width)

    def read(self, state: ArmState) -> HumanInput:
        """Present input of the person. Region, target and turn remain when the rest expires."""
        self.state = state
        asked, deadline = self._posted
        if self._clock() > deadline or not self._present():
            asked = HumanInput(region=asked.region, target=asked.target, turn=asked.turn)
        if self._openings:
            asked = replace(asked, gripper=self._openings.pop())
        if not self._requests:
            return asked
        requests = tuple(self._requests.popleft() for _ in range(len(self._requests)))
        return replace(asked, requests=requests)

    def tell(self, feedback: Feedback) -> None:
        """Keep the feedback of the arm, for the page's thread to show."""
        self.feedback = feedback


@dataclass(frozen=True, kw_only=True, eq=False)
class GizmoCommand:
    """Null-space input and end-effector motion, and the arrows that show the pulls."""

    nullspace_input: Float[np.ndarray, " joints"]
    """Null-space input d [N m]."""
    twist: Float[np.ndarray, "6"]
    """Twist of the end effector: linear [m/s] and angular [rad/s]."""
    arrows: Float[np.ndarray, "gizmos 2 3"]
    """Arrows from the held points to the pointers, in the base frame [m]."""
    held: tuple[int | None, ...] = ()
    """Joints that are held, counted from 1; None: the end effector."""


def gizmo_command(
    chain: SerialChain,
    joint_position: Float[np.ndarray, " joints"],
    gizmos: Collection[HeldGizmo],
    config: InteractionForceConfig,
    *,
    direction: Float[np.ndarray, "3"] = _NOWHERE,
    turn: Float[torch.Tensor, "4"] | None = None,
) -> GizmoCommand:
    """Command of held gizmos and keys. All inputs add up, with the bounds of a single gizmo.

    Args:
        chain: Kinematics of the arm.
        joint_position: Joint positions [rad].
        gizmos: Held gizmos.
        config: Gains and bounds of gizmos.
        direction: Direction in which keys move the end effector, as a fraction of the largest
            speed; zero: no key is pressed.
        turn: Rotation added to the orientation that `coarse_orientation` gives (wxyz); None: no
            rotation.
    """
    links = chain.link_poses(torch.as_tensor(joint_position, dtype=torch.float64))
    d, velocity = np.zeros(len(chain.joint_names)), config.speed * direction
    arrows, held = np.empty((len(gizmos), 2, 3)), tuple(gizmo.joint for gizmo in gizmos)
    for k, gizmo in enumerate(gizmos):
        if gizmo.joint is None:
            point = links[-1].position.numpy() + gizmo.held_at
            velocity += config.rate * (gizmo.pointer - point)
        else:
            point = links[gizmo.joint - 1].apply(torch.as_tensor(gizmo.held_at)).numpy()
            pull = gizmo.pointer - point
            d += gizmo_nullspace_input(chain, joint_position, gizmo.joint, point, pull, config)
        arrows[k] = point, gizmo.pointer
    guided = direction.any() or None in held
    return GizmoCommand(
        nullspace_input=bounded(d, config.max_nullspace_input),
        twist=guiding_twist(links[-1], velocity, config, turn) if guided else np.zeros(6),
        arrows=arrows,
        held=held,
    )
