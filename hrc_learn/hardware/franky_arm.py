"""Drive a Franka arm as an `Arm` and a `Gripper`, through the package `franky`.

Tested with franky 2.0 (PyPI: franky-control) against simulators of the arm's network protocol;
NOT RUN ON HARDWARE.
"""

import atexit
import os
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from hrc_learn.hardware.driver_process import (
    ArmFaultError,
    Connected,
    checked_velocity,
    imported,
)
from hrc_learn.hardware.franka_settings import FrankyConfig, RealtimeError
from hrc_learn.hardware.gripper import GripperError, GripperThread
from hrc_learn.protocols import ArmState

_REALTIME_KERNEL = Path("/sys/kernel/realtime")
"""File that contains 1 under a kernel with PREEMPT_RT."""
_MISSING = (
    "a real Panda needs the driver package franky: pip install franky-control, in the build "
    "for the server version of its control box, on a machine with a real-time kernel"
)
_JOINTS = tuple(f"joint {k}" for k in range(1, 8))


class FrankyArm(Connected):
    """A Franka arm and its gripper.

    A velocity holds for at most the config's `timeout`. Then the driver brakes the arm to rest;
    a command during the braking starts from the velocity that remains. If this process dies,
    its connection drops, which ends the motion immediately.

    After a reflex, a user stop or a lost connection every command raises `ArmFaultError` until
    `recover` has succeeded. The gripper has its own threads (`GripperThread`): the arm never
    waits for it; its failures appear on stderr and are raised by `gripper.check`.

    Attributes:
        gripper: The gripper, driven by its threads.
    """

    def __init__(self, ip: str, config: FrankyConfig | None = None):
        """Connect.

        Args:
            ip: Address of the control box.
            config: Settings of the driver.

        Raises:
            ImportError: The driver is not installed.
            RealtimeError: Real-time scheduling is required and missing.
            ConnectionError: The arm cannot be reached.
            ArmFaultError: The arm takes no commands, because of its user stop, its guiding
                buttons or an error that cannot be cleared.
            GripperError: The gripper cannot be reached.
        """
        self._ip, self.config = ip, config or FrankyConfig()
        if self.config.realtime:
            require_realtime()
        self._franky = imported("franky", _MISSING)
        self._hold = self._franky.Duration(round(1e3 * self.config.timeout))
        self._fault, self._lost = "", False
        self._robot: Any = None
        self._closed = False
        self._scheduling = _scheduling()
        self._connect()
        self.gripper = GripperThread(partial(_FrankyGripper, self._franky, ip, self.config))
        # The driver's destructor ends the process by a signal while a motion is under way.
        atexit.register(self.close)

    def read(self) -> ArmState:
        """Return the newest state; `time` is the clock of the control box [s].

        While the arm is at rest, this waits a millisecond for the next state. Reading also
        works after a reflex.

        Raises:
            ArmFaultError: The connection is lost.
        """
        state = self._read()
        return ArmState(
            time=state.time.to_sec(),
            joint_position=np.array(state.q, dtype=float),
            joint_velocity=np.array(state.dq, dtype=float),
            gripper_width=self.gripper.width,
            external_torque=np.array(state.tau_ext_hat_filtered, dtype=float),
        )

    def command(self, joint_velocity: Float[np.ndarray, "7"]) -> None:
        """Set the joint velocities to hold [rad/s].

        Raises:
            ValueError: The velocities are not finite, or beyond the driver's limits.
            ArmFaultError: The arm has stopped, or the motion of an earlier command has failed.
        """
        velocity = checked_velocity(joint_velocity, _JOINTS, self._fastest)
        self._raise_fault()
        motion = self._franky.JointVelocityMotion(velocity.tolist(), duration=self._hold)
        try:
            if not self._is_moving():
                self._require_ready(self._read())
            self._move(motion)
        except ArmFaultError:
            raise
        except Exception as error:
            raise self._failed(error) from error

    def stop(self) -> None:
        """Bring the arm to rest.

        Raises:
            ArmFaultError: The connection is lost. The control box then brings the arm to rest.
        """
        if not self._fault:
            try:
                if self._is_moving():
                    self._move(self._franky.JointVelocityStopMotion())
            except Exception as error:
                # The error ended the motion: the arm is at rest. The next command raises it.
                self._failed(error)
        if self._lost and not self._closed:
            self._raise_fault()

    def recover(self) -> None:
        """Make the arm ready again after a fault, once its cause is gone.

        Reconnects if the connection was lost.

        Raises:
            ArmFaultError: The arm stays stopped; the message says why.
            ConnectionError: The arm cannot be reached.
        """
        if self._closed:
            self._raise_fault()
        try:
            if self._robot is not None:
                self._recover()
        except self._franky.NetworkException:
            self._robot = None  # a control box takes one connection at a time
        if self._robot is None:
            self._connect()
        self._fault, self._lost = "", False

    def move(self, width: float) -> None:
        """Open the gripper to a width [m], or squeeze what is between its fingers (below 5 mm).

        Does not wait. Failures appear on stderr and are raised by `gripper.check`.
        """
        self.gripper.move(width)

    def close(self) -> None:
        """Bring the arm to rest and disconnect.

        Raises:
            ArmFaultError: The connection is lost.
        """
        atexit.unregister(self.close)
        if self._closed:
            return
        try:
            self.stop()
            with suppress(Exception):  # the error ended the motion: the arm is at rest
                self._robot.join_motion(timeout=self._rest)
        finally:
            self.gripper.close()
            # The control box accepts one connection at a time, so end this one.
            self._robot, self._closed = None, True
            self._fault = f"the arm at {self._ip} is closed: open it again."

    def _connect(self) -> None:
        franky, config = self._franky, self.config
        modes = franky.RealtimeConfig
        mode = modes.Enforce if config.realtime else modes.Ignore
        before = _scheduling()
        try:
            # This gives real-time priority to the calling thread and all threads that it
            # starts later. Only the driver's own thread should have it (see `_move`).
            self._robot = franky.Robot(self._ip, realtime_config=mode)
            self._scheduling = _scheduling()
        except franky.RealtimeException as error:
            raise RealtimeError(str(error)) from error
        except (franky.NetworkException, franky.IncompatibleVersionException) as error:
            raise ConnectionError(
                f"cannot connect to an arm at {self._ip} ({error}): check the cable and the "
                "address, switch on the arm, unlock its joints and activate FCI in Desk, and "
                "install the build of franky-control for its server version."
            ) from error
        finally:
            os.sched_setscheduler(0, *before)
        self._newest: Any = None
        self._recover()
        self._robot.relative_dynamics_factor = franky.RelativeDynamicsFactor(
            1.0, config.dynamics, config.dynamics
        )
        config.send_to(self._robot)
        kinds = ("velocity", "acceleration", "jerk")
        limits = [getattr(self._robot, f"joint_{kind}_limit").get() for kind in kinds]
        self._fastest, self._rest = np.array(limits[0], float), config.rest_timeout(*limits)

    def _recover(self) -> None:
        with suppress(Exception):  # the last motion's error, cleared below
            self._robot.poll_motion()
        if not self._robot.recover_from_errors():
            raise self._stopped(self._robot.state, "its error recovery failed")
        self._require_ready(self._robot.state)

    def _move(self, motion: Any) -> None:
        """Begin a motion.

        The driver then starts the thread that communicates with the control box. This thread
        inherits the priority of the calling thread.
        """
        before = _scheduling()
        os.sched_setscheduler(0, *self._scheduling)
        try:
            self._robot.move(motion, asynchronous=True)
        finally:
            os.sched_setscheduler(0, *before)

    def _is_moving(self) -> bool:
        """True during a motion. If an error ended the last motion, raises this error once."""
        # The result of poll_motion is not usable: contrary to its documentation, it is True
        # at rest (franky 2.0).
        self._robot.poll_motion()
        return self._robot.is_in_control

    def _read(self) -> Any:
        """Newest state of the driver."""
        if self._robot is None:
            raise ArmFaultError(self._fault)
        try:
            state = self._robot.state
        except Exception as error:
            raise self._failed(error) from error
        # When a motion begins, the driver returns the last state of the previous motion for a
        # cycle.
        if self._newest is None or state.time.to_msec() >= self._newest.time.to_msec():
            self._newest = state
        return self._newest

    def _require_ready(self, state: Any) -> None:
        mode = self._franky.RobotMode
        if state.robot_mode not in (mode.Idle, mode.Move):
            raise self._stopped(state, "it takes no commands")

    def _stopped(self, state: Any, what: str) -> ArmFaultError:
        mode = self._franky.RobotMode
        cure = {
            mode.UserStopped: "release the user stop, then call recover()",
            mode.Guiding: "let go of the guiding buttons, then call recover()",
        }.get(state.robot_mode, "make room around the arm, then call recover()")
        errors = ", ".join(map(str, _names(state.current_errors))) or "no error is reported"
        self._fault = (
            f"the arm at {self._ip} is in mode {state.robot_mode.name} ({errors}), and {what}: "
            f"{cure}."
        )
        return ArmFaultError(self._fault)

    def _failed(self, error: Exception) -> ArmFaultError:
        if self._fault:  # later errors are consequences of the first
            return ArmFaultError(self._fault)
        self._lost = isinstance(error, self._franky.NetworkException)
        if self._lost:
            cure = "the control box brings it to rest. Check the cable, then call recover()"
        elif isinstance(error, self._franky.RealtimeException):
            cure = str(RealtimeError("no permission to schedule in real time"))
        else:
            cure = "it is at rest. Make room around it, then call recover()"
        self._fault = (
            f"the motion of the arm at {self._ip} ended by {type(error).__name__}: "
            f"{' '.join(str(error).split()).rstrip('.')}; {cure}."
        )
        return ArmFaultError(self._fault)

    def _raise_fault(self) -> None:
        if self._fault:
            raise ArmFaultError(self._fault)


class _FrankyGripper:
    """The arm's gripper, as a `GripperDriver`."""

    def __init__(self, franky: Any, ip: str, config: FrankyConfig):
        self._config = config
        try:
            self._gripper = franky.Gripper(ip)
        except franky.Exception as error:
            raise GripperError(
                f"the gripper at {ip} cannot be reached ({error}): it must be switched on in "
                "the arm's settings as its end effector"
            ) from error

    def read_width(self) -> float:
        return float(self._gripper.width)

    def move(self, width: float) -> bool:
        return self._gripper.move_async(width, self._config.grip_speed).get()

    def squeeze(self) -> bool:
        force, speed = self._config.grip_force, self._config.grip_speed
        # An object of any width counts as grasped.
        return self._gripper.grasp_async(0.0, speed, force, epsilon_outer=1.0).get()

    def close(self) -> None:
        """Nothing to do: the connection ends with its last reference, and a call in progress
        still needs it.
        """


def require_realtime() -> None:
    """Check that this machine's kernel schedules in real time.

    Raises:
        RealtimeError: The kernel does not.
    """
    try:
        has = _REALTIME_KERNEL.read_text(encoding="utf-8").strip() == "1"
    except OSError:
        has = False
    if not has:
        raise RealtimeError("this kernel does not schedule in real time")


def _scheduling() -> tuple[int, os.sched_param]:
    """Policy and priority of this thread."""
    return os.sched_getscheduler(0), os.sched_getparam(0)


def _names(errors: Any) -> list[str]:
    """Names of the errors that are set."""
    return [name for name in dir(errors) if not name.startswith("_") and getattr(errors, name)]
