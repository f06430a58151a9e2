"""The person at the page, as a control loop meets them."""

import time
from collections import deque
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from ...protocols import ArmState, HumanInput, Request


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
