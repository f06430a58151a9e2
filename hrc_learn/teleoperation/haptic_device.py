"""Haptic device that guides the end effector with force feedback, like the paper's Omega.

Not run on hardware: `forcedimension-core`, the extra `haptic`, drives it where the maker's SDK
is installed; tests drive the same interface without a device.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from threading import Event, Thread
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float

from hrc_learn.kinematics import SerialChain, coarse_orientation
from hrc_learn.protocols import ArmState, Feedback, Human, HumanInput
from hrc_learn.teleoperation.hand_guiding import (
    InteractionForceConfig,
    capped,
    guiding_twist,
)


@runtime_checkable
class ForceDevice(Protocol):
    """Part of `forcedimension_core.dhd` that is used here, under its names; -1 reports a
    failure.
    """

    def getPosition(self, out: Any, ID: int = -1) -> int: ...
    def getLinearVelocity(self, out: Any, ID: int = -1) -> int: ...
    def setForce(self, f: Any, ID: int = -1) -> int: ...
    def getButton(self, index: int, ID: int = -1) -> int: ...
    def enableForce(self, enable: bool, ID: int = -1) -> int: ...
    def close(self, ID: int = -1) -> int: ...


_SCALE = 2.5
"""Motion of the end effector for that of the hand: an Omega's workspace is 0.16 m wide."""
_STIFFNESS = 120.0
"""Stiffness of the spring that pulls the device to where the arm has followed it [N/m]."""
_DAMPING = 4.0
"""Damping of the hand's motion while the clutch is closed [N s/m]."""
_CONTACT = 0.1
"""Fraction of the contact force at the end effector that the device renders."""
_MAX_FORCE = 6.0
"""Largest force on the hand [N]; an Omega can hold 12."""
_PERIOD = 0.001
"""Time between two forces [s]."""
_STALE = 0.1
"""Time without feedback from the control loop after which the force vanishes [s]."""
_CLUTCH = 0
"""Button that closes the clutch while it is held."""


class _Pull(NamedTuple):
    """Input of the force thread, exchanged as one reference."""

    rest: Float[np.ndarray, "3"]
    """Position of the device that corresponds to the present end-effector position [m]."""
    push: Float[np.ndarray, "3"]
    """Force of what the arm meets, as the hand feels it [N]."""
    until: float
    """Time from which on this reference is stale [s]."""


class HapticDevice(Human):
    """Guides the end effector while the clutch is held, and renders the tracking error as a
    force.

    When the clutch closes, the pointer is at the end effector. It then moves with the device,
    scaled by 2.5, and the end effector follows it like a gizmo. The person feels what the
    arm does not follow:

        f = stiffness (x_arm - x) - damping x' + contact f_contact,     |f| <= max_force

    with x_arm the device position at which the pointer would be at the end effector. The axes
    of the device are those of the base for a person that faces the arm: x towards the person, z
    up.

        with HapticDevice.open(panda) as device:
            HandGuidedArm(panda, arm, device)

    An unplugged device requests nothing.
    """

    def __init__(
        self,
        chain: SerialChain,
        device: ForceDevice,
        *,
        number: int = -1,
        clock: Callable[[], float] = time.monotonic,
    ):
        """Take an open device; `HapticDevice.open` finds one.

        Args:
            chain: Kinematics of the guided arm.
            device: Interface of Force Dimension's library.
            number: Number of the device; -1: the one opened last.
            clock: Monotonic clock [s].
        """
        self._chain, self._device, self._number = chain, device, number
        self._forces, self._clock = InteractionForceConfig(), clock
        # Positions of hand and tool at which the clutch was closed.
        self._clutched: tuple[np.ndarray, np.ndarray] | None = None
        self._tool = np.zeros(3)
        self._pull: _Pull | None = None
        self._closing = Event()
        self._thread = Thread(target=self._push_back, name="haptic device", daemon=True)

    @classmethod
    def open(cls, chain: SerialChain) -> HapticDevice:
        """Open the first device by forcedimension-core, which the extra `haptic` brings.

        Args:
            chain: Kinematics of the guided arm.

        Raises:
            ValueError: There is no device, or the maker's SDK is not installed.
        """
        try:
            from forcedimension_core import dhd  # pyright: ignore[reportMissingImports]
        except ImportError as error:
            raise ValueError(
                f"a haptic device needs the extra `haptic` and Force Dimension's SDK: {error}"
            ) from error
        connect = dhd.open  # a device, no file
        number = connect()
        if number < 0:
            raise ValueError(f"no haptic device: {dhd.errorGetLastStr()}.")
        return cls(chain, dhd, number=number)

    def __enter__(self) -> HapticDevice:
        self._device.enableForce(True, self._number)
        self._thread.start()
        return self

    def __exit__(self, *raised: object) -> None:
        self._closing.set()
        self._thread.join()
        self._device.setForce((0.0, 0.0, 0.0), self._number)
        self._device.enableForce(False, self._number)
        self._device.close(self._number)

    def read(self, state: ArmState) -> HumanInput:
        """Motion of the end effector as the hand is now."""
        still = HumanInput(nullspace_input=np.zeros(len(state.joint_position)))
        hand = self._vector(self._device.getPosition)
        tool = self._chain.forward(torch.from_numpy(state.joint_position))
        self._tool = tool.position.numpy()
        if hand is None or self._device.getButton(_CLUTCH, self._number) != 1:
            self._clutched = None
            return still
        if self._clutched is None:
            self._clutched = hand, self._tool
        began, start = self._clutched
        pointer = start + _SCALE * (hand - began)
        velocity = self._forces.rate * (pointer - self._tool)
        twist = guiding_twist(tool, velocity, coarse_orientation(tool.position), self._forces)
        return HumanInput(nullspace_input=still.nullspace_input, twist=twist)

    def tell(self, feedback: Feedback) -> None:
        """Let the hand feel how far the arm is behind, and what it meets."""
        if self._clutched is None:
            self._pull = None
            return
        began, start = self._clutched
        rest = began + (self._tool - start) / _SCALE
        push = np.zeros(3)
        if feedback.contact_force is not None and not feedback.contact_expected:
            push = _CONTACT * feedback.contact_force
        self._pull = _Pull(rest, push, self._clock() + _STALE)

    def force(self) -> Float[np.ndarray, "3"]:
        """Force on the hand now [N]; none where the clutch is open or the loop is silent."""
        pull = self._pull
        hand = self._vector(self._device.getPosition)
        velocity = self._vector(self._device.getLinearVelocity)
        if pull is None or hand is None or velocity is None or self._clock() > pull.until:
            return np.zeros(3)
        spring = _STIFFNESS * (pull.rest - hand) - _DAMPING * velocity
        return capped(spring + pull.push, _MAX_FORCE)

    def _vector(self, read: Callable[..., int]) -> Float[np.ndarray, "3"] | None:
        out = [0.0, 0.0, 0.0]
        return None if read(out, self._number) < 0 else np.array(out)

    def _push_back(self) -> None:
        with contextlib.suppress(OSError):  # it has been unplugged
            while not self._closing.wait(_PERIOD):
                self._device.setForce(self.force().tolist(), self._number)
