"""What watches a run from outside: the Lyapunov function and its rate, motion limits, and a
watchdog that stops an arm whose control loop has fallen silent.

V = P_v(x) + P_c(r) + 1/2 tr(W~ L^-1 W~^T),  W~ = W - W_hat                          (vt)

`docs/controller.md` states under which assumptions V_dot = -|s|^2. `Command.potential` and
`Command.potential_rate` hold the part that needs no true weights, at every step.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from types import TracebackType
from typing import final

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from hrc_learn.kinematics import JointLimits

# Differences of rounded numbers may exceed a limit in the last digits.
_ROUNDING = 1 + 1e-9


def lyapunov_function(
    potential: Float[Tensor, "*batch"],
    weight_error: Float[Tensor, "*batch rows K"],
    gain: float,
) -> Float[Tensor, "*batch"]:
    """V of (vt), with the factor 1/2 that its trace lacks in print.

    Args:
        potential: P_v + P_c.
        weight_error: W~, which only a simulation knows.
        gain: Of the paper's update, L = gain I.
    """
    return potential + weight_error.square().sum((-2, -1)) / (2 * gain)


def lyapunov_rate(s: Float[Tensor, "*batch 6"]) -> Float[Tensor, "*batch"]:
    """V_dot = -|s|^2 where the assumptions hold."""
    return -torch.linalg.vecdot(s, s)


def potential_rate(
    s: Float[Tensor, "*batch 6"],
    jacobian: Float[Tensor, "*batch 6 n"],
    joint_velocity: Float[Tensor, "*batch n"],
) -> Float[Tensor, "*batch"]:
    """Rate of P_v + P_c that a joint velocity brings if the image Jacobian is right [1/s].

    Its fall behind the measured change of the potential shows an image Jacobian that is wrong,
    its rise above zero a motion that a limit or a person has turned against the task.
    """
    twist = torch.linalg.vecdot(jacobian, joint_velocity.unsqueeze(-2))
    return torch.linalg.vecdot(s, twist)


@final
class LimitMonitor:
    """Checks the motion limits of commanded joint velocities, from step to step.

    Independent of the safety filter that ought to keep them.
    """

    def __init__(self, limits: JointLimits, velocity: Float[Tensor, "*batch n"], dt: float):
        """Begin.

        Args:
            limits: Of the joints.
            velocity: At the start, steady [rad/s].
            dt: Step [s].
        """
        self._limits, self._velocity, self._dt = limits, velocity, dt
        self._acceleration = torch.zeros_like(velocity)

    def violations(
        self, q: Float[Tensor, "*batch n"], velocity: Float[Tensor, "*batch n"]
    ) -> Bool[Tensor, "*batch 4"]:
        """Whether limits of position, velocity, acceleration and jerk are broken in a step.

        Args:
            q: Joint position [rad].
            velocity: Commanded for the step [rad/s].
        """
        limits = self._limits
        acceleration = (velocity - self._velocity) / self._dt
        jerk = (acceleration - self._acceleration) / self._dt
        self._velocity, self._acceleration = velocity, acceleration
        broken = [
            (q > limits.upper) | (q < limits.lower),
            velocity.abs() > limits.velocity,
            acceleration.abs() > limits.acceleration * _ROUNDING,
            jerk.abs() > limits.jerk * _ROUNDING,
        ]
        return torch.stack([flags.any(-1) for flags in broken], dim=-1)


@final
class Watchdog:
    """Calls for a stop once a loop has not reported for too long.

    with Watchdog(0.05, arm.stop) as watchdog:
        while servoing():
            arm.command(runner.step())
            watchdog.feed()

    It runs in a thread of its own, so it also notices a loop that hangs. After a trip the arm
    is at rest, which the controller does not know: start from `initial_state` again.

    Attributes:
        trips: How often it had to act.
    """

    def __init__(
        self,
        timeout: float,
        stop: Callable[[], object],
        *,
        clock: Callable[[], float] = time.monotonic,
    ):
        """Set up; the time starts with the first `feed`, or on entering the context.

        Args:
            timeout: Longest silence [s]; it is noticed up to a quarter of it late.
            stop: Brings the arm to rest. Called once for every silence.
            clock: Tells the time [s].

        Raises:
            ValueError: The timeout is not positive.
        """
        if not timeout > 0:
            raise ValueError(f"timeout must be positive, but is {timeout}")
        self.trips = 0
        self._timeout, self._stop, self._clock = timeout, stop, clock
        self._fed: float | None = None
        self._lock = threading.Lock()
        self._done = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="watchdog", daemon=True)

    @property
    def tripped(self) -> bool:
        """Whether it has acted since it was last fed."""
        return self.trips > 0 and self._fed is None

    def feed(self) -> None:
        """Report that the loop is alive."""
        with self._lock:
            self._fed = self._clock()

    def check(self) -> bool:
        """Stop the arm if the time is up; whether it was. The thread does this by itself."""
        with self._lock:
            late = self._fed is not None and self._clock() - self._fed > self._timeout
            if late:
                self._fed = None  # until fed again there is nothing to stop
                self.trips += 1
        # Outside the lock: stopping an arm may take long, and may feed.
        if late:
            self._stop()
        return late

    def __enter__(self) -> Watchdog:
        self.feed()
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._done.set()
        self._thread.join()

    def _watch(self) -> None:
        # A silence is noticed at most a quarter of the timeout late.
        while not self._done.wait(self._timeout / 4):
            self.check()
