"""The people at the page as one `Human`: what all who hold a gizmo ask for together."""

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
    InteractionForceConfig,
    bounded,
    gizmo_nullspace_input,
    guiding_twist,
)
from hrc_learn.teleoperation.page.gizmos import HeldGizmo


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
        self._idle = _locked(HumanInput(nullspace_input=np.zeros(joints)))
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
    for array in (asked.nullspace_input, asked.twist):
        array.setflags(write=False)
    return asked


@dataclass(frozen=True, kw_only=True, eq=False)
class GizmoCommand:
    """Null-space input and motion, and the arrows that show where they come from."""

    nullspace_input: Float[np.ndarray, " joints"]
    """d [N m]."""
    twist: Float[np.ndarray, "6"]
    """Of the end effector, linear [m/s] and angular [rad/s]."""
    arrows: Float[np.ndarray, "gizmos 2 3"]
    """From the point held to the pointer, in the base frame [m]."""


def gizmo_command(
    chain: SerialChain,
    joint_position: Float[np.ndarray, " joints"],
    gizmos: Collection[HeldGizmo],
    config: InteractionForceConfig,
    *,
    coarse: bool = True,
) -> GizmoCommand:
    """The command of several held gizmos: their inputs add up, and are bounded as one is.

    Args:
        chain: The arm.
        joint_position: Where it is [rad].
        gizmos: Who holds it where.
        config: How strongly gizmos act.
        coarse: Whether a hand-guided end effector turns by the coarse orientation rule;
            otherwise it turns as its gizmo is turned, if it is.
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
    return GizmoCommand(
        nullspace_input=bounded(d, config.max_nullspace_input),
        twist=guiding_twist(tool, velocity, orientation, config) if guided else np.zeros(6),
        arrows=arrows,
    )


def _point_held(links: Pose, gizmo: HeldGizmo) -> Float[np.ndarray, "3"]:
    """Where the point held is now, in the base frame [m]."""
    if gizmo.joint is None:
        return links[-1].position.numpy() + gizmo.held_at
    return links[gizmo.joint - 1].apply(torch.as_tensor(gizmo.held_at)).numpy()
