"""Run the 1 kHz loop of a Franka arm in a separate process.

Each millisecond the control box sends the state of the arm and takes one answer. pylibfranka
holds the GIL while it waits, and a busy interpreter answers late: so nothing else runs in this
process. Other processes communicate with it through shared memory; neither side ever waits.

The wanted velocity passes through the exported step (`VelocityStep`), which enforces the limits
of position, velocity, acceleration, jerk and tool speed. In the first cycle and after each lost
one, the step starts from the commanded velocity and acceleration that the control box reports,
because the box continues with a constant acceleration when an answer is missing.
"""

import gc
import math
import os
import signal
import threading
import time
from collections.abc import Callable
from types import FrameType
from typing import Any, final

import numpy as np
import torch
from jaxtyping import Float

from hrc_learn.deploy import StepRunner
from hrc_learn.hardware.driver_process import imported
from hrc_learn.hardware.franka_memory import JOINTS, Orders, Phase, Report, Shared
from hrc_learn.hardware.franka_settings import CYCLE, FrankaConfig, RealtimeError

_AGREES = 1e-5
"""Largest rounding difference between the commanded velocity that the box reports and the
velocity sent [rad/s]. The box reports single precision. After a lost cycle, the difference is
larger: acceleration times period.
"""
_SAME = 1e-9
"""Largest difference between two reports of the same velocity [rad/s]."""
_RESTS = 1e-6
"""Commanded velocity below which the arm counts as at rest [rad/s]."""
_SLOWEST, _FOLLOWS = 4.0, 0.02
"""`_SLOWEST`: longest real time per second of the robot's clock [s]. `_FOLLOWS`: gain with
which the speed of the robot's clock is tracked, over about 50 cycles.
"""
_PARENT_EVERY = 50
"""Number of cycles between checks that the commanding process is alive."""


def connect(ip: str, config: FrankaConfig) -> Any:
    """Connect to an arm, clear earlier errors, and send the settings.

    Raises:
        ImportError: The driver is not installed.
        RealtimeError: Real-time scheduling is required and missing.
        RuntimeError: The arm cannot be reached.
    """
    driver = import_pylibfranka()
    modes = driver.RealtimeConfig
    _take_priority(config.realtime)
    try:
        robot = driver.Robot(ip, modes.kEnforce if config.realtime else modes.kIgnore)
    except driver.RealtimeException as error:
        raise RealtimeError(str(error).rstrip(".")) from error
    recover(robot, config)
    return robot


def recover(robot: Any, config: FrankaConfig) -> None:
    """Clear the error that has stopped the arm, and send the settings again."""
    robot.automatic_error_recovery()
    config.send_to(robot)


def import_pylibfranka() -> Any:
    """Import Franka's Python binding.

    Raises:
        ImportError: The binding is not installed, or conflicts with another driver in this
            process.
    """
    return imported(
        "pylibfranka",
        "an arm at 1 kHz needs Franka's pylibfranka, in the version for the system of its "
        "control box: pip install pylibfranka. One process cannot have both it and franky",
    )


def _take_priority(needed: bool) -> None:
    """Set real-time priority, if this is allowed.

    Raises:
        RealtimeError: The priority is needed, but not allowed.
    """
    highest = os.sched_get_priority_max(os.SCHED_FIFO)
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(highest))
    except PermissionError as error:
        if needed:
            raise RealtimeError("this user may not have realtime priority") from error


def serve(
    shared: Shared,
    ip: str,
    config: FrankaConfig,
    open_runner: Callable[[], StepRunner],
    parent: int,
) -> None:
    """Run the loop in its process until it is ended or its parent has died."""
    # Ctrl-C reaches all processes of a terminal: the commanding process decides.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    torch.set_num_threads(1)
    try:
        loop = ControlLoop(shared, ip, config, open_runner(), parent)
    except Exception as error:
        shared.message = f"{type(error).__name__}: {error}"
        shared.report.write(Report(phase=Phase.ENDED, faults=1))
        return

    def end(number: int, frame: FrameType | None) -> None:
        loop.ending = True

    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, end)
    # A garbage collection would take milliseconds; the loop creates no reference cycles.
    gc.collect()
    gc.freeze()
    gc.disable()
    loop.run()


@final
class Punctuality:
    """Detects answers that would be too late, from the clocks of this machine and the robot.

    After a delay, the process reads a state whose cycle is over. The box would drop an answer
    or, worse, use it in another cycle. It is therefore better to send no answer. A simulator's
    clock may run slower than real time on a busy machine; this alone does not make an answer
    late. Of two successive states, at least one is answered, however late, so that the arm
    moves even if each answer takes longer than a cycle.
    """

    def __init__(self, *, lockstep: bool = False):
        """Start before the first state.

        Args:
            lockstep: True for a simulator that waits for each answer, and whose clock may stand
                still in between. No answer is then late.
        """
        self._lockstep = lockstep
        self._last = math.nan
        self._pace = 1.0
        self._skipped = self._skipped_before = False

    def late(self, now: float, period: float) -> bool:
        """True if a state should stay unanswered; called once per state, before `overdue`.

        Args:
            now: Time at which the state was read [s].
            period: Time since the previous state by the robot's clock [s].
        """
        passed, self._last = now - self._last, now
        self._skipped_before, self._skipped = self._skipped, False
        if math.isnan(passed) or period <= 0:
            return False
        late = self._skip(passed > self._pace * period + CYCLE)
        pace = min(passed / period, _SLOWEST)
        self._pace = max(1.0, self._pace + _FOLLOWS * (pace - self._pace))
        return late

    def overdue(self, cost: float) -> bool:
        """True if a state should stay unanswered because its answer took longer than a cycle.

        Args:
            cost: Time since the state was read [s].
        """
        return self._skip(cost > self._pace * CYCLE)

    def _skip(self, too_late: bool) -> bool:
        may_skip = not (self._lockstep or self._skipped_before)
        self._skipped = self._skipped or (too_late and may_skip)
        return self._skipped


@final
class ControlLoop:
    """Loop that reads a state, computes a step and sends the answer.

    Attributes:
        ending: True to bring the arm to rest and end the loop.
    """

    def __init__(
        self, shared: Shared, ip: str, config: FrankaConfig, runner: StepRunner, parent: int
    ):
        """Connect to the arm.

        Args:
            shared: Memory through which the commanding process sends orders and reads reports.
            ip: Address of the control box.
            config: Settings of the loop.
            runner: Exported step with the period `CYCLE`.
            parent: ID of the commanding process; the loop ends when that process has died.
        """
        self.ending = False
        self._driver = import_pylibfranka()
        self._ip, self._config, self._runner, self._parent = ip, config, runner, parent
        self._shared, self._report = shared, Report()
        self._orders = Orders()
        self._sent = self._reported = np.full(JOINTS, np.nan)
        self._recovered = -np.inf  # velocities from before a recovery must not move the arm
        self._velocity = runner.observation["joint_velocity"]
        self._position = runner.observation["joint_position"]
        self._stop = runner.observation["stop"]
        self._warm_up()
        self._link = connect(ip, config)

    def run(self) -> None:
        """Loop until ended."""
        while not self.ending:
            try:
                self._read_orders()
                if self._report.phase == Phase.FAULTED or self._asked_to_recover():
                    self._wait_for_recovery()
                elif self._wanted().any():
                    self._move()
                else:
                    self._watch()
            except Exception as error:  # from the driver: the box has stopped the arm
                self._fail(error)
        self._publish(Phase.ENDED)

    def _warm_up(self) -> None:
        """Take the first steps, which are slow, before the arm waits for them."""
        self._position[...], self._velocity[...], self._stop[...] = 0.0, 0.0, True
        for _ in range(20):
            self._runner.step()

    def _read_orders(self) -> None:
        self._orders = self._shared.orders.read()
        self.ending |= self._orders.end

    def _wanted(self) -> Float[np.ndarray, "7"]:
        """Velocity to track now [rad/s]."""
        return np.zeros(JOINTS) if self._idles() else self._orders.joint_velocity

    def _idles(self) -> bool:
        """True if there is no current command: the last command is too old, was a stop, or came
        before the last recovery.
        """
        stamp = self._orders.stamp
        silent = time.monotonic() - stamp >= self._config.timeout
        return silent or self._orders.stop or stamp <= self._recovered

    def _watch(self) -> None:
        """Read one state while the arm is at rest."""
        self._note(self._link.read_once())
        self._check_parent()
        self._publish(Phase.IDLE)

    def _check_parent(self) -> None:
        if os.getppid() != self._parent:
            self.ending = True

    def _move(self) -> None:
        """Run one motion until the arm rests without a command, or until the loop is ended."""
        mode = self._driver.ControllerMode.JointImpedance
        control = self._link.start_joint_velocity_control(mode)
        self._sent = self._reported = np.full(JOINTS, np.nan)  # nothing yet
        report = self._report
        number, finished = 0, False
        punctuality = Punctuality(lockstep=self._config.lockstep)
        while not finished:
            state, period = control.readOnce()
            begin = time.perf_counter()
            late = punctuality.late(begin, period.to_sec())
            number += 1
            if number > 1:
                report.lost += max(0, round(period.to_sec() / CYCLE) - 1)
            self._note(state)
            self._read_orders()
            if number % _PARENT_EVERY == 0:
                self._check_parent()
            if number == 1:
                self._runner.start(report.joint_position)
            self._adopt(state)
            self._position[...] = report.joint_position
            self._velocity[...] = self._wanted()
            self._stop[...] = self._orders.stop or self.ending
            if not late:
                self._sent = np.array(self._runner.step())
            if late or punctuality.overdue(time.perf_counter() - begin):
                report.lost += 1
                self._publish(Phase.MOVING)
                continue
            rests = bool(np.abs(self._sent).max() < _RESTS)
            # A motion ends with two zero velocities, so that its acceleration is zero.
            finished = rests and report.resting and number > 1
            finished = finished and (self._idles() or self.ending)
            answer = self._driver.JointVelocities(self._sent.tolist())
            answer.motion_finished = finished
            control.writeOnce(answer)
            report.cost = time.perf_counter() - begin
            report.resting = rests
            report.cycles += 1
            self._publish(Phase.MOVING)

    def _adopt(self, state: Any) -> None:
        """Continue from the state of the control box if the box has missed the last answer."""
        reported, acceleration = np.array(state.dq_d), np.array(state.ddq_d)
        if answer_was_lost(reported, acceleration, self._reported, self._sent):
            self._runner.state["safety.velocity"][:] = reported
            self._runner.state["safety.acceleration"][:] = np.nan_to_num(acceleration)
        self._reported = reported

    def _note(self, state: Any) -> None:
        report = self._report
        report.stamp, report.time = time.monotonic(), state.time.to_sec()
        report.joint_position = np.array(state.q)
        report.joint_velocity = np.array(state.dq)
        report.external_torque = np.array(state.tau_ext_hat_filtered)

    def _publish(self, phase: Phase) -> None:
        self._report.phase = phase
        self._shared.report.write(self._report)

    def _fail(self, error: Exception) -> None:
        self._shared.message = _explained(error)
        self._report.faults += 1
        self._report.resting = True
        self._publish(Phase.FAULTED)

    def _asked_to_recover(self) -> bool:
        return self._orders.recoveries > self._report.recoveries

    def _wait_for_recovery(self) -> None:
        self._check_parent()
        if not self._asked_to_recover():
            self._look_on()
            return
        self._publish(Phase.RECOVERING)
        asked = self._orders.recoveries
        try:
            recover(self._link, self._config)
        except self._driver.NetworkException:
            self._link = connect(self._ip, self._config)
        finally:
            self._report.recoveries = asked
        self._note(self._link.read_once())
        self._recovered = time.monotonic()
        self._publish(Phase.IDLE)

    def _look_on(self) -> None:
        """Continue reading while the arm is stopped, if there still is a connection."""
        try:
            self._note(self._link.read_once())
        except Exception:
            time.sleep(0.01)  # nothing can be read until the connection is renewed
        self._publish(Phase.FAULTED)


def answer_was_lost(
    reported: Float[np.ndarray, "7"],
    acceleration: Float[np.ndarray, "7"],
    before: Float[np.ndarray, "7"],
    sent: Float[np.ndarray, "7"],
) -> bool:
    """True if the control box has missed the last answer and extrapolates at constant
    acceleration.

    The next answer must then start from the state of the box. If the box reports the same
    velocity twice despite an acceleration, the answer is not lost: the box sent the second
    report before it received the answer, and a start from this report would be a jump back.

    Args:
        reported: Commanded velocity that the box reports [rad/s].
        acceleration: Commanded acceleration that it reports [rad/s^2].
        before: Commanded velocity of the previous state; NaN: there was none.
        sent: Last answer; NaN: there was none.
    """
    if not np.isfinite(reported).all():
        return False
    if np.isnan(sent).any():
        return True  # a motion starts from the state of the box
    if np.abs(reported - sent).max() <= _AGREES:
        return False
    unchanged = np.abs(reported - before).max() <= _SAME
    accelerates = np.abs(acceleration).max() * CYCLE > _AGREES
    return not (unchanged and accelerates)


def _explained(error: Exception) -> str:
    """Explanation of a driver's error, with what to do."""
    kind = type(error).__name__
    advice = {
        "ControlException": "Make sure that nothing touches the arm, then call recover().",
        "CommandException": "Release the stop button and the brakes in Desk, activate FCI, "
        "then call recover().",
        "NetworkException": "The connection is lost: check cable and power, then call "
        "recover(), which connects again.",
    }.get(kind, "Call recover() to try again.")
    return f"{kind}: {error} The arm is stopped by its control box. {advice}"
