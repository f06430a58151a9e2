"""People at the page as one `Human`: what they hold by mouse or hand, and their input."""

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
from hrc_learn.kinematics import SerialChain, coarse_orientation
from hrc_learn.protocols import ArmState, Feedback, Human, HumanInput, Request
from hrc_learn.teleoperation.gate.messages import Grip, Hands, MessageError, TrackedHand
from hrc_learn.teleoperation.hand_guiding import (
    InteractionForceConfig,
    bounded,
    gizmo_nullspace_input,
    guiding_twist,
)

_NO_TURN = torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=torch.float64)


@dataclass(frozen=True, kw_only=True, eq=False)
class HeldGizmo:
    """Gizmo held in a browser."""

    joint: int | None
    """Joint that moves the link held, counted from 1; None: the end effector is held."""
    held_at: Float[np.ndarray, "3"]
    """Point of the link that is held, in the frame of the link; of the end effector: that point
    less the tool centre point, in the base frame [m]."""
    pointer: Float[np.ndarray, "3"]
    """Position to which the gizmo has been dragged, in the base frame [m]."""
    orientation: Float[np.ndarray, "4"] | None = None
    """Orientation the end effector's gizmo has been turned to (wxyz)."""


class HeldGizmos:
    """All held gizmos, each until it is released or its holder leaves.

    Safe to use from several threads. A holder is whatever tells two browsers apart.
    """

    def __init__(
        self,
        changed: Callable[[], object] = lambda: None,
        links: Callable[[], Pose | None] = lambda: None,
    ) -> None:
        """Start without held gizmos.

        Args:
            changed: Callback for gizmos taken, dragged or released.
            links: Present frames of the arm (see `SerialChain.link_poses`); None before the arm
                is known.
        """
        self._changed, self.links = changed, links
        self._held: dict[tuple[Hashable, str], HeldGizmo] = {}
        self._lock = Lock()

    def take(self, holder: Hashable, handle: str, held: HeldGizmo) -> None:
        """Begin to hold a gizmo."""
        with self._lock:
            self._held[holder, handle] = held
        self._changed()

    def grab(
        self,
        holder: Hashable,
        handle: str,
        joint: int | None,
        start: Float[np.ndarray, "3"],
        pointer: Float[np.ndarray, "3"],
    ) -> None:
        """Begin to hold a link, or the end effector, at a point of the base frame [m]."""
        links = self.links()
        if links is None:
            return
        if joint is None:
            held_at = start - links[-1].position.numpy()
        else:
            held_at = links[joint - 1].inverse().apply(torch.from_numpy(start)).numpy()
        self.take(holder, handle, HeldGizmo(joint=joint, held_at=held_at, pointer=pointer))

    def move(
        self,
        holder: Hashable,
        handle: str,
        pointer: Float[np.ndarray, "3"],
        orientation: Float[np.ndarray, "4"] | None = None,
    ) -> None:
        """Drag a gizmo on; one that is not held (any more) stays where it is."""
        with self._lock:
            held = self._held.get((holder, handle))
            if held is not None:
                self._held[holder, handle] = replace(
                    held, pointer=pointer, orientation=orientation
                )
        self._changed()

    def release(self, holder: Hashable, handle: str) -> None:
        """Let go of a gizmo."""
        with self._lock:
            self._held.pop((holder, handle), None)
        self._changed()

    def release_all(self, holder: Hashable) -> None:
        """Forget a client that has left."""
        with self._lock:
            for key in [key for key in self._held if key[0] == holder]:
                del self._held[key]

    def clear(self) -> None:
        """Let go of everything: a connection that comes back has to take its gizmo anew."""
        with self._lock:
            self._held.clear()

    def held(self) -> dict[tuple[Hashable, str], HeldGizmo]:
        """All of them, by holder and name."""
        with self._lock:
            return dict(self._held)


class AddedTurn:
    """Rotation that people add to the end effector's orientation with the rings of its gizmo.

    It stays after release, and the next drag adds to it. Safe to use from several threads.

    Attributes:
        holder: Client that holds the rings; None: they are free.
    """

    def __init__(self) -> None:
        self._turn = self._before = self._taken = _NO_TURN
        self._lock = Lock()
        self.holder: Hashable | None = None

    def take(self, holder: Hashable, orientation: Float[np.ndarray, "4"]) -> None:
        """Begin to turn a gizmo whose orientation is this (wxyz)."""
        with self._lock:
            self._taken, self._before = torch.from_numpy(orientation), self._turn
            self.holder = holder

    def release(self, holder: Hashable) -> None:
        """Let go of it."""
        with self._lock:
            if self.holder == holder:
                self.holder = None

    def drop(self) -> None:
        """Release it, for any holder."""
        with self._lock:
            self.holder = None

    def move(self, holder: Hashable, orientation: Float[np.ndarray, "4"]) -> None:
        """Rotate further, if this client holds the rings."""
        with self._lock:
            if self.holder != holder:
                return
            now = quaternion.multiply(
                torch.from_numpy(orientation), quaternion.conjugate(self._taken)
            )
            self._turn = quaternion.normalize(quaternion.multiply(now, self._before))

    def clear(self) -> None:
        """Take it back."""
        with self._lock:
            self._turn = self._before = _NO_TURN

    @property
    def rotation(self) -> Float[torch.Tensor, "4"]:
        """Unit quaternion of the rotation (wxyz)."""
        with self._lock:
            return self._turn

    @property
    def vector(self) -> tuple[float, float, float] | None:
        """Rotation vector in the base frame [rad]; None: nothing was added."""
        turn = self.rotation
        if float(quaternion.angle(turn, _NO_TURN)) == 0.0:
            return None
        x, y, z = quaternion.log(turn).tolist()
        return x, y, z


_HOLDER = "headset"
_AT_REST = np.array([1.0, 0.0, 0.0, 0.0])  # unit quaternion (wxyz)


class HeadsetHands:
    """Turns what two hands hold into held gizmos, by the rules of the mouse.

    A message names all that is held; what an earlier one named and this one does not is let go.
    """

    def __init__(
        self,
        held: HeldGizmos,
        turn: AddedTurn,
        *,
        guides: bool,
    ):
        """Start with empty hands.

        Args:
            held: Record of held gizmos.
            turn: Rotation that a hand adds to the end effector's orientation.
            guides: True if the end effector can be held.
        """
        self._held, self._turn, self._guides = held, turn, guides
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
        links = self._held.links()
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
                self._take(grip, len(links.position))
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

    def _take(self, grip: Grip, joints: int) -> None:
        if grip.joint is not None and grip.joint >= joints:
            raise MessageError(f"the arm has no joint {grip.joint}")
        if grip.joint is None and grip.orientation is not None:
            self._turn.take((_HOLDER, grip.hand), _AT_REST)
        start, pointer = np.array(grip.start), np.array(grip.pointer)
        self._held.grab(_HOLDER, grip.hand, grip.joint, start, pointer)


class PageHuman(Human):
    """Hands what a person asks for from the page's thread to the loop, without a lock.

    `read` costs the loop about a microsecond: references are exchanged, nothing is computed.
    What has been posted holds for a moment only (the dead man's switch): where the page falls
    silent, the person asks for no motion.
    """

    def __init__(
        self,
        joints: int,
        *,
        holds_for: float = 0.25,
        clock: Callable[[], float] = time.monotonic,
        present: Callable[[], bool] = lambda: True,
    ):
        """Start without input.

        Args:
            joints: Number of joints.
            holds_for: Time for which a posted input stays valid [s].
            clock: Monotonic clock [s].
            present: True while the person gives signs of life; called at each reading.

        Raises:
            ValueError: `holds_for` is not positive.
        """
        if not holds_for > 0:
            raise ValueError(f"holds_for must be positive, but is {holds_for}.")
        self._holds_for, self._clock, self._present = holds_for, clock, present
        self._idle = _locked(HumanInput(nullspace_input=np.zeros(joints)))
        # While it holds, afterwards, and until when: changed together, as one reference.
        self._posted = (self._idle, self._idle, float("-inf"))
        self._requests: deque[Request] = deque()
        self._state: ArmState | None = None
        self._feedback = Feedback()

    @property
    def feedback(self) -> Feedback:
        """Latest feedback of the arm."""
        return self._feedback

    @property
    def state(self) -> ArmState | None:
        """The newest reading of the arm; None before the first."""
        return self._state

    def post(self, asked: HumanInput) -> None:
        """Renew what the person asks for; its requests are left to `request`."""
        still = replace(self._idle, region=asked.region, target=asked.target, turn=asked.turn)
        deadline = self._clock() + self._holds_for
        self._posted = (_locked(asked), still, deadline)

    def request(self, request: Request) -> None:
        """Ask once for something other than motion."""
        self._requests.append(request)

    def read(self, state: ArmState) -> HumanInput:
        """Current input of the person. Its arrays must not be written to."""
        self._state = state
        asked, still, deadline = self._posted
        if self._clock() > deadline or not self._present():
            asked = still
        if not self._requests:
            return asked
        requests = tuple(self._requests.popleft() for _ in range(len(self._requests)))
        return replace(asked, requests=requests)

    def tell(self, feedback: Feedback) -> None:
        """Hand over what the arm tells, for the page's thread to show."""
        self._feedback = feedback


def _locked(asked: HumanInput) -> HumanInput:
    for array in (asked.nullspace_input, asked.twist):
        if array is not None:
            array.setflags(write=False)
    return asked


@dataclass(frozen=True, kw_only=True, eq=False)
class GizmoCommand:
    """Null-space input and motion, and the arrows that show where they come from."""

    nullspace_input: Float[np.ndarray, " joints"]
    """d [N m]."""
    twist: Float[np.ndarray, "6"]
    """Twist of the end effector: linear [m/s] and angular [rad/s]."""
    arrows: Float[np.ndarray, "gizmos 2 3"]
    """Arrows from the points held to the pointers, in the base frame [m]."""
    held: tuple[int | None, ...] = ()
    """Joints that are held, counted from 1; None: the end effector."""


def gizmo_command(
    chain: SerialChain,
    joint_position: Float[np.ndarray, " joints"],
    gizmos: Collection[HeldGizmo],
    config: InteractionForceConfig,
    *,
    coarse: bool = True,
    turn: Float[torch.Tensor, "4"] | None = None,
) -> GizmoCommand:
    """Command of several held gizmos. Their inputs add up, with the bounds of a single one.

    Args:
        chain: Kinematics of the arm.
        joint_position: Joint positions [rad].
        gizmos: Held gizmos.
        config: Gains and bounds of gizmos.
        coarse: Turn a hand-guided end effector by the coarse orientation rule; otherwise it
            turns with its gizmo.
        turn: Rotation added to that rule (wxyz); None: none.
    """
    links = chain.link_poses(torch.as_tensor(joint_position, dtype=torch.float64))
    tool = links[-1]
    d, velocity = np.zeros(len(chain.joint_names)), np.zeros(3)
    orientation, guided = None, False
    arrows = np.empty((len(gizmos), 2, 3))
    for k, gizmo in enumerate(gizmos):
        point = _point_held(links, gizmo)
        displacement = gizmo.pointer - point
        arrows[k] = point, gizmo.pointer
        if gizmo.joint is not None:
            d += gizmo_nullspace_input(
                chain, joint_position, gizmo.joint, point, displacement, config
            )
            continue
        guided = True
        velocity += config.rate * displacement
        if gizmo.orientation is not None:
            orientation = torch.as_tensor(gizmo.orientation, dtype=torch.float64)
    if coarse:
        orientation = coarse_orientation(tool.position)
        if turn is not None:
            orientation = quaternion.multiply(turn, orientation)
    return GizmoCommand(
        nullspace_input=bounded(d, config.max_nullspace_input),
        twist=guiding_twist(tool, velocity, orientation, config) if guided else np.zeros(6),
        arrows=arrows,
        held=tuple(gizmo.joint for gizmo in gizmos),
    )


def _point_held(links: Pose, gizmo: HeldGizmo) -> Float[np.ndarray, "3"]:
    """Present position of the point held, in the base frame [m]."""
    if gizmo.joint is None:
        return links[-1].position.numpy() + gizmo.held_at
    return links[gizmo.joint - 1].apply(torch.as_tensor(gizmo.held_at)).numpy()
