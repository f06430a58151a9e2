"""Drive a Franka arm at 1 kHz, through Franka's own binding pylibfranka.

This works with an FR3 only: pylibfranka 0.21 uses version 10 of the network protocol, as does
an FR3 with system 5.9 or later. A Panda (FER) uses version 5, with libfranka 0.9 or earlier,
for which no pylibfranka exists. For a Panda, use `FrankyArm` with the build of the package
franky for the arm's protocol version.

Tested against the protocol simulators franka-sim, including all limits that it enforces, and
franky-sim. NOT RUN ON HARDWARE.
"""

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
"""Timeout for connecting [s]."""
_STALE = 0.2
"""Age of a reading at which the loop counts as stalled [s]: ten times the delay after which the
control box stops the arm by itself."""
_STALE_IN_LOCKSTEP = 2.0
"""Like `_STALE`, for a simulator in lockstep [s]: its machine may be busy with the task.
libfranka itself gives up a connection after 1 s."""
_RECOVERY = 15.0
"""Timeout for recovery [s]; the control box needs some seconds."""
_LOOK = 0.02
"""Time between the two positions from which a velocity is computed [s]: a single velocity
reading is noisy."""
_STILL = 0.02
"""Velocity below which the arm counts as at rest [rad/s]: 0.4 mrad within `_LOOK`, four times
the noise of an encoder."""
_PAUSE = 5e-4
"""Period of polling the reports [s]."""


@final
class FrankaArm(Connected):
    """The arm and its gripper, as an `Arm`, a `Gripper` and a `StoppableArm`.

        with FrankaArm("172.16.0.2", fr3) as arm:
            while servoing():
                arm.command(velocity(arm.read()))

    The loop and the gripper run in separate processes: Python code in this process cannot delay
    them, and only `stop`, `recover` and `close` wait for them. A velocity holds for
    `FrankaConfig.timeout`; afterwards, or when this process has died, the loop brings the arm
    to rest and ends the motion. The arm therefore needs no `ArmProcess` around it. If the loop
    dies or stalls, the control box stops the arm after 20 ms.

    Whatever is commanded, the arm keeps the limits of `chain` on position, velocity,
    acceleration, jerk and tool speed. The arm may still hit itself or others; the control box
    then stops it.

    After a fault, the control box has stopped the arm: `command` raises the reason, `read`
    continues as long as there is a connection, and `recover` makes the arm ready again.

    Attributes:
        gripper: The gripper, driven by its threads; None: no gripper.
    """

    def __init__(self, ip: str, chain: SerialChain, config: FrankaConfig | None = None):
        """Connect.

        Args:
            ip: Address of the control box.
            chain: The arm with its limits and its tool centre point.
            config: Settings of the loop.

        Raises:
            DriverError: The arm or its gripper cannot be reached, or real-time scheduling is
                missing; the message says which.
            ValueError: The arm does not have seven joints.
        """
        if len(chain.joint_names) != JOINTS:
            joints = len(chain.joint_names)
            raise ValueError(f"a Franka arm has {JOINTS} joints, but the chain has {joints}.")
        self._config = config = config or FrankaConfig()
        self._names, limits = chain.joint_names, chain.limits
        self._rest = config.rest_timeout(limits.velocity, limits.acceleration, limits.jerk)
        self._shared, self._orders = Shared(), Orders()
        # Lock held by a thread of this process while it commands. The loop never waits for it.
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
                # pylibfranka holds the GIL while the fingers move.
                self.gripper = GripperThread(partial(GripperProcess, hand), startup=_STARTUP)
        except BaseException:
            self._end()
            raise

    @property
    def pid(self) -> int | None:
        """ID of the loop's process."""
        return self._process.pid

    @property
    def fault(self) -> str:
        """Reason why the arm has stopped; empty if it has not."""
        stopped = self.report.phase in (Phase.FAULTED, Phase.ENDED)
        return self._shared.message if stopped else ""

    @property
    def report(self) -> Report:
        """Newest report of the loop, with the numbers of cycles and faults."""
        return self._shared.report.read()

    def read(self) -> ArmState:
        """Return the newest state; `time` is the robot's clock [s].

        Raises:
            DriverError: The loop has read no state for 0.2 s (2 s in lockstep).
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
            ValueError: The velocities are not seven finite numbers.
            DriverError: The arm has been stopped; `recover` makes it move again.
        """
        # No limit here: the loop's filter enforces the limits.
        velocity = checked_velocity(joint_velocity, self._names, np.full(JOINTS, np.inf))
        self._check()
        self._order(joint_velocity=velocity, stamp=time.monotonic(), stop=False)

    def stop(self) -> None:
        """Bring the arm to rest, and wait until it rests.

        Raises:
            DriverError: The arm does not come to rest, or the loop has ended; in that case the
                control box has stopped the arm.
        """
        self._order(stop=True, stamp=-math.inf)
        self._await(
            lambda report: report.resting and report.phase != Phase.MOVING, self._rest, "stop"
        )
        before = self.report

        def still(report: Report) -> bool:
            nonlocal before
            passed = report.time - before.time
            if passed < _LOOK:
                # Once the control box has stopped the arm, its clock may stand still.
                return report.phase == Phase.FAULTED
            way = np.abs(report.joint_position - before.joint_position).max()
            before = report
            return bool(way < _STILL * passed)

        self._await(still, self._rest, "stop")

    def move(self, width: float) -> None:
        """Open the gripper to a width [m], or squeeze what is between its fingers (below 5 mm).

        Does not wait. Failures appear on stderr and are raised by `gripper.check`.

        Raises:
            DriverError: There is no gripper.
        """
        if self.gripper is None:
            raise DriverError("this arm was opened without a gripper.")
        self.gripper.move(width)

    def recover(self) -> None:
        """Make the arm ready again after a fault; without a fault, do nothing.

        Reconnects if necessary. Earlier commands are discarded.

        Raises:
            DriverError: Recovery failed; the message says why.
        """
        if self.report.phase != Phase.FAULTED:
            self._check()
            return
        asked = self._orders.recoveries + 1
        self._order(recoveries=asked)
        self._await(lambda report: report.recoveries >= asked, _RECOVERY, "recover")
        self._check()

    def close(self) -> None:
        """Bring the arm to rest, and end the processes of the loop and the gripper."""
        self._order(end=True)
        self._process.join(self._rest)
        self._end()

    def _order(self, **changes: object) -> None:
        with self._writing:
            self._orders = replace(self._orders, **changes)  # pyright: ignore[reportArgumentType]
            self._shared.orders.write(self._orders)

    def _check(self) -> None:
        """Raise an error if the arm cannot move."""
        report = self.report
        stopped = report.phase in (Phase.FAULTED, Phase.ENDED)
        if stopped or not self._process.is_alive():
            raise DriverError(self._stalled(report, math.inf))

    def _stalled(self, report: Report, age: float) -> str:
        if report.phase == Phase.FAULTED:
            return self._shared.message
        if report.phase == Phase.ENDED or not self._process.is_alive():
            return (
                f"the process of the loop has ended. {self._shared.message} The control box "
                "has stopped the arm: make sure that it is at rest, and connect again."
            )
        return (
            f"the loop has read no state for {age:.2f} s: something delays its process, so "
            "the control box stops the arm."
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
            # The process hangs or is suspended. Once its connection is lost, the control box
            # ends the motion.
            self._process.kill()
        self._process.join()
        if self.gripper is not None:
            self.gripper.close()


@final
class FrankaHand:
    """The gripper of a Franka arm, driven through pylibfranka."""

    def __init__(self, ip: str, *, speed: float, force: float):
        """Connect.

        Args:
            ip: Address of the control box.
            speed: Finger speed [m/s].
            force: Grasping force [N].

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
        # Any width counts as a grasp, even closed fingers with nothing in between.
        self._gripper.grasp(0.0, self._speed, self._force, 0.1, 0.1)
        return True

    def close(self) -> None:
        """Nothing to do: the connection ends with the process."""


def step_of(chain: SerialChain, config: FrankaConfig) -> Callable[[], StepRunner]:
    """Return a function that opens the runner of the loop's step in any process."""
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
        # Converted from the flange's frame to the frame of the tool centre point.
        offset = chain.tcp.new_tensor(config.load.far_end) - chain.tcp[:3, 3]
        example = replace(example, load=chain.tcp[:3, :3].T @ offset)
    open_runner = partial(EagerRunner, step, example)
    if config.compiled:
        open_runner = partial(PackageRunner, export_step(step, example))
    return partial(_with_load, open_runner, example.load)


def _with_load(open_runner: Callable[[], StepRunner], far_end: Tensor | None) -> StepRunner:
    """Open the runner and set the far end of the load, which never changes."""
    runner = open_runner()
    if far_end is not None:
        runner.observation["load"][:] = far_end.numpy()
    return runner
