"""A Franka arm at 1 kHz, through Franka's own binding pylibfranka.

The FR3 only: pylibfranka 0.21 speaks version 10 of the protocol, that of an FR3 with system
5.9 or later. A Panda (FER) needs libfranka 0.9 or before, version 5 of the protocol, for which
there is no such binding: take `FrankyArm` in franky's build for its server version.

Tested against the protocol simulators franka-sim, with all that it enforces, and franky-sim.
NOT RUN ON HARDWARE.
"""

from __future__ import annotations

import math
import multiprocessing
import os
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import final

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.controller import VelocityStep, WantedVelocity
from hrc_learn.deploy import EagerRunner, PackageRunner, StepRunner, export_step
from hrc_learn.distributed import ByValue
from hrc_learn.hardware.driver_process import Connected, DriverError, checked_velocity
from hrc_learn.hardware.franka_loop import import_pylibfranka, serve
from hrc_learn.hardware.franka_memory import JOINTS, Orders, Phase, Report, Shared
from hrc_learn.hardware.franka_settings import CYCLE, FrankaConfig
from hrc_learn.hardware.gripper import GripperProcess, GripperThread
from hrc_learn.kinematics import SerialChain
from hrc_learn.protocols import ArmState

_STARTUP = 60.0
"""Longest that connecting may take [s]."""
_STALE = 0.2
"""Age of a reading at which the loop counts as stalled [s]: ten times what the control box
allows before it stops the arm by itself."""
_STALE_IN_LOCKSTEP = 2.0
"""The same of a simulator [s]: its machine may be busy with the task. libfranka itself gives a
connection up after 1 s."""
_REST = 3.0
"""Longest that coming to rest may take [s]: at the limits of the maker half a second, with a
tenth of the acceleration three."""
_RECOVERY = 15.0
"""Longest that recovery may take [s]; the control box needs some seconds."""
_LOOK = 0.02
"""Time over which a velocity is measured, by two positions [s]: a single one is noisy."""
_STILL = 0.02
"""Below this it is rest [rad/s]: an encoder's noise of 0.1 mrad is a quarter of it."""
_PAUSE = 5e-4
"""Between two looks at whether something has happened [s]."""


@final
class FrankaArm(Connected):
    """The arm and its gripper, as an `Arm`, a `Gripper` and a `StoppableArm`.

        with FrankaArm("172.16.0.2", fr3) as arm:
            while servoing():
                arm.command(velocity(arm.read()))

    The loop has a process of its own, and so has the gripper: nothing that Python does here
    holds them up, and no call waits for either, except `stop`, `recover` and `close`. So it
    goes into no `ArmProcess`, which it takes the place of: a velocity holds for
    `FrankaConfig.timeout`; then, or when this process has died, the loop brings the arm to rest
    and ends the motion. If the loop dies or stalls, the control box stops the arm after 20 ms.

    Whatever is commanded, position, velocity, acceleration, jerk and tool speed keep the limits
    of `chain`. The arm may still hit itself or others, at which the control box stops it.

    A fault leaves the arm stopped by its control box: `command` raises what happened, `read`
    goes on as long as there is a connection, and `recover` makes the arm move again.

    Attributes:
        gripper: The gripper on its threads; None without one.
    """

    def __init__(self, ip: str, chain: SerialChain, config: FrankaConfig | None = None):
        """Connect.

        Args:
            ip: Address of the control box.
            chain: The arm with its limits and its tool centre point.
            config: How to drive it.

        Raises:
            DriverError: The arm or its gripper cannot be reached, or realtime is missing; it
                says which.
            ValueError: The arm has not seven joints.
        """
        if len(chain.joint_names) != JOINTS:
            raise ValueError(
                f"a Franka arm has {JOINTS} joints, but the chain {len(chain.joint_names)}."
            )
        self._config = config = config or FrankaConfig()
        self._names = chain.joint_names
        self._shared, self._orders = Shared(), Orders()
        # Of the threads here that command: the loop is never held up by it.
        self._writing = threading.Lock()
        context = multiprocessing.get_context("spawn")
        self._process = context.Process(
            target=serve,
            args=(self._shared, ip, config, ByValue(step_of(chain, config)), os.getpid()),
            name="franka",
            daemon=True,
        )
        self.gripper: GripperThread | None = None
        self._process.start()
        try:
            self._await(lambda report: report.phase == Phase.IDLE, _STARTUP, "connect")
            if config.gripper:
                hand = partial(FrankaHand, ip, speed=config.grip_speed, force=config.grip_force)
                # pylibfranka holds the interpreter while the fingers move.
                self.gripper = GripperThread(partial(GripperProcess, hand), startup=_STARTUP)
        except BaseException:
            self._end()
            raise

    @property
    def pid(self) -> int | None:
        """Number of the process that has the loop."""
        return self._process.pid

    @property
    def fault(self) -> str:
        """Reason for which the arm has stopped; empty if it has not."""
        stopped = self.report.phase in (Phase.FAULTED, Phase.ENDED)
        return self._shared.message if stopped else ""

    @property
    def report(self) -> Report:
        """Newest report of the loop, with its counts of cycles and faults."""
        return self._shared.report.read()

    def read(self) -> ArmState:
        """Return the newest state, by the clock of the robot.

        Raises:
            DriverError: The loop has ended, or has read none for 0.2 s (2 s in lockstep).
        """
        report = self.report
        age = time.monotonic() - report.stamp
        longest = _STALE_IN_LOCKSTEP if self._config.lockstep else _STALE
        if age > longest and report.phase != Phase.RECOVERING:
            raise DriverError(self._stalled(report, age))
        return ArmState(
            time=report.time,
            joint_position=report.joint_position,
            joint_velocity=report.joint_velocity,
            gripper_width=self.gripper.width if self.gripper else math.nan,
            external_torque=report.external_torque,
        )

    def command(self, joint_velocity: Float[np.ndarray, "7"]) -> None:
        """Set the joint velocities to hold [rad/s].

        Raises:
            ValueError: They are not seven finite numbers.
            DriverError: The arm has been stopped; `recover` makes it move again.
        """
        # The loop's filter keeps the limits, whatever is wanted.
        velocity = checked_velocity(joint_velocity, self._names, np.full(JOINTS, np.inf))
        self._check()
        self._order(joint_velocity=velocity, stamp=time.monotonic(), stop=False)

    def stop(self) -> None:
        """Bring the arm to rest, and wait until it is.

        Raises:
            DriverError: It does not come to rest, or the loop has ended: then the control box
                has stopped it.
        """
        self._order(stop=True, stamp=-math.inf)
        self._await(
            lambda report: report.resting and report.phase != Phase.MOVING, _REST, "stop"
        )
        before = self.report

        def still(report: Report) -> bool:
            nonlocal before
            passed = report.time - before.time
            if passed < _LOOK:
                # Of an arm that its control box has stopped no clock may run any more.
                return report.phase == Phase.FAULTED
            way = np.abs(report.joint_position - before.joint_position).max()
            before = report
            return bool(way < _STILL * passed)

        self._await(still, _REST, "stop")

    def move(self, width: float) -> None:
        """Open the gripper to a width, or squeeze what is between its fingers [m].

        Returns at once; failures appear on stderr and are raised by `gripper.check`.

        Raises:
            DriverError: There is no gripper.
        """
        if self.gripper is None:
            raise DriverError("this arm was opened without a gripper.")
        self.gripper.move(width)

    def recover(self) -> None:
        """Make the arm move again after a fault, connecting again if need be; does nothing
        where there is none.

        What was commanded before is forgotten.

        Raises:
            DriverError: That is not possible; it says why.
        """
        if self.report.phase != Phase.FAULTED:
            self._check()
            return
        asked = self._orders.recoveries + 1
        self._order(recoveries=asked)
        self._await(lambda report: report.recoveries >= asked, _RECOVERY, "recover")
        self._check()

    def close(self) -> None:
        """Bring the arm to rest, end the motion and both processes."""
        self._order(end=True)
        self._process.join(_REST)
        self._end()

    def _order(self, **changes: object) -> None:
        with self._writing:
            self._orders = replace(self._orders, **changes)  # pyright: ignore[reportArgumentType]
            self._shared.orders.write(self._orders)

    def _check(self) -> None:
        """Raise what keeps the arm from moving."""
        report = self.report
        stopped = report.phase in (Phase.FAULTED, Phase.ENDED)
        if stopped or not self._process.is_alive():
            raise DriverError(self._stalled(report, math.inf))

    def _stalled(self, report: Report, age: float) -> str:
        if report.phase == Phase.FAULTED:
            return self._shared.message
        if report.phase == Phase.ENDED or not self._process.is_alive():
            return (
                f"the process that has the loop has ended. {self._shared.message} The control "
                "box has stopped the arm: make sure of that, and connect again."
            )
        return (
            f"the loop has read no state for {age:.2f} s: something holds its process up, at "
            "which the control box stops the arm."
        )

    def _await(self, reached: Callable[[Report], bool], patience: float, what: str) -> None:
        end = time.monotonic() + patience
        while not reached(report := self.report):
            if report.phase == Phase.ENDED or not self._process.is_alive():
                raise DriverError(f"cannot {what}: {self._stalled(report, math.inf)}")
            if time.monotonic() > end:
                raise DriverError(f"cannot {what} within {patience:g} s. {self.fault}")
            time.sleep(_PAUSE)

    def _end(self) -> None:
        if self._process.is_alive():
            # It hangs or is stopped. Without its connection the control box ends the motion.
            self._process.kill()
        self._process.join()
        if self.gripper is not None:
            self.gripper.close()


@final
class FrankaHand:
    """The gripper of a Franka arm, by pylibfranka."""

    def __init__(self, ip: str, *, speed: float, force: float):
        """Connect.

        Args:
            ip: Address of the control box.
            speed: Of the fingers [m/s].
            force: To squeeze with [N].

        Raises:
            ImportError: The driver is not installed.
        """
        self._gripper = import_pylibfranka().Gripper(ip)
        self._speed, self._force = speed, force

    def read_width(self) -> float:
        return float(self._gripper.read_once().width)

    def move(self, width: float) -> bool:
        return self._gripper.move(width, self._speed)

    def squeeze(self) -> bool:
        # Whatever is between the fingers is a grasp; nothing is one of width zero.
        self._gripper.grasp(0.0, self._speed, self._force, 0.1, 0.1)
        return True

    def close(self) -> None:
        """The connection ends with the process."""


def step_of(chain: SerialChain, config: FrankaConfig) -> Callable[[], StepRunner]:
    """Function that opens the runner of the loop's step, in any process."""
    limits = replace(
        chain.limits,
        acceleration=config.dynamics * chain.limits.acceleration,
        jerk=config.dynamics * chain.limits.jerk,
    )
    step = VelocityStep(chain.with_limits(limits), config.safety)
    example = WantedVelocity(
        joint_position=chain.ready,
        joint_velocity=torch.zeros_like(chain.ready),
        stop=torch.tensor(False),
        dt=CYCLE,
    )
    if config.load is not None and config.load.far_end is not None:
        # From the frame of the flange to that of the tool centre point.
        offset = chain.tcp.new_tensor(config.load.far_end) - chain.tcp[:3, 3]
        example = replace(example, load=chain.tcp[:3, :3].T @ offset)
    open_runner = partial(EagerRunner, step, example)
    if config.compiled:
        open_runner = partial(PackageRunner, export_step(step, example))
    return partial(_with_load, open_runner, example.load)


def _with_load(open_runner: Callable[[], StepRunner], far_end: Tensor | None) -> StepRunner:
    """The runner with the far end of a load, which stays the same in all cycles."""
    runner = open_runner()
    if far_end is not None:
        runner.observation["load"][:] = far_end.numpy()
    return runner
