"""The person at the page, as a control loop meets them: input, and what all who hold the
arm ask of it together.
"""

import time
from collections import deque
from collections.abc import Callable, Collection
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float

from hrc_learn.geometry import Pose
from hrc_learn.kinematics import SerialChain, coarse_orientation
from hrc_learn.protocols import ArmState, HumanInput, Request
from hrc_learn.teleoperation.interaction_force import (
    DragConfig,
    bounded,
    drag_effort,
    hand_twist,
)
from hrc_learn.teleoperation.page.gizmos import Grip

# The person at the page, as a control loop meets them.


class PageHuman:
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
    ):
        """Start with a person who asks for nothing.

        Args:
            joints: Number of joints.
            holds_for: Time that a posted wish holds [s].
            clock: Tells the time [s].

        Raises:
            ValueError: `holds_for` is not positive.
        """
        if not holds_for > 0:
            raise ValueError(f"holds_for must be positive, but is {holds_for}.")
        self._holds_for, self._clock = holds_for, clock
        self._idle = _locked(HumanInput(effort=np.zeros(joints)))
        # While it holds, afterwards, and until when: changed together, as one reference.
        self._posted = (self._idle, self._idle, float("-inf"))
        self._requests: deque[Request] = deque()
        self._state: ArmState | None = None

    @property
    def state(self) -> ArmState | None:
        """The newest reading of the arm; None before the first."""
        return self._state

    def post(self, asked: HumanInput) -> None:
        """Renew what the person asks for; its requests are left to `request`."""
        still = replace(self._idle, region=asked.region, target=asked.target)
        deadline = self._clock() + self._holds_for
        self._posted = (_locked(asked), still, deadline)

    def request(self, request: Request) -> None:
        """Ask once for something other than motion."""
        self._requests.append(request)

    def read(self, state: ArmState) -> HumanInput:
        """What the person asks for now. Its arrays are shared: they may not be written to."""
        self._state = state
        asked, still, deadline = self._posted
        if self._clock() > deadline:
            asked = still
        if not self._requests:
            return asked
        requests = tuple(self._requests.popleft() for _ in range(len(self._requests)))
        return replace(asked, requests=requests)


def _locked(asked: HumanInput) -> HumanInput:
    for array in (asked.effort, asked.twist):
        array.setflags(write=False)
    return asked


# What all who hold the arm ask of it together.


@dataclass(frozen=True, kw_only=True, eq=False)
class Asked:
    """Effort and motion, and the arrows that show where they come from."""

    effort: Float[np.ndarray, " joints"]
    """Null-space effort d [N m]."""
    twist: Float[np.ndarray, "6"]
    """Of the hand, linear [m/s] and angular [rad/s]."""
    arrows: Float[np.ndarray, "grips 2 3"]
    """From the point held to the handle, in the base frame [m]."""


def ask(
    chain: SerialChain,
    joint_position: Float[np.ndarray, " joints"],
    grips: Collection[Grip],
    config: DragConfig,
    *,
    coarse: bool = True,
) -> Asked:
    """What comes of several grips: their efforts add up, and are bounded as one is.

    Args:
        chain: The arm.
        joint_position: Where it is [rad].
        grips: Who holds it where.
        config: How strongly handles act.
        coarse: Whether a hand that is led turns by the coarse orientation rule; otherwise it
            turns as its handle is turned, if it is.
    """
    links = chain.link_poses(torch.as_tensor(joint_position, dtype=torch.float64))
    hand = links[-1]
    effort, velocity = np.zeros(len(chain.joint_names)), np.zeros(3)
    orientation, led = None, False
    arrows = np.empty((len(grips), 2, 3))
    for k, grip in enumerate(grips):
        point = _point_held(links, grip)
        displacement = grip.pointer - point
        arrows[k] = point, grip.pointer
        if grip.joint is not None:
            effort += drag_effort(
                chain, joint_position, grip.joint, point, displacement, config
            )
            continue
        led = True
        velocity += config.rate * displacement
        if grip.orientation is not None:
            orientation = torch.as_tensor(grip.orientation, dtype=torch.float64)
    if coarse:
        orientation = coarse_orientation(hand.position)
    return Asked(
        effort=bounded(effort, config.largest_effort),
        twist=hand_twist(hand, velocity, orientation, config) if led else np.zeros(6),
        arrows=arrows,
    )


def _point_held(links: Pose, grip: Grip) -> Float[np.ndarray, "3"]:
    """Where the point held is now, in the base frame [m]."""
    if grip.joint is None:
        return links[-1].position.numpy() + grip.held_at
    return links[grip.joint - 1].apply(torch.as_tensor(grip.held_at)).numpy()
