"""Calls of the driver franky in order: its state and errors are the test's."""

import os
import threading
from enum import Enum
from types import SimpleNamespace

import numpy as np
import pytest

from hrc_learn.hardware import ArmFaultError, FrankyArm, FrankyConfig, GripperError, franky_arm
from hrc_learn.hardware.franka_settings import RealtimeError

# Stand-ins are not of the annotated types.
pytestmark = pytest.mark.simulation

CONFIG = FrankyConfig(realtime=False)
VELOCITY = 0.1 * np.arange(7)
FIFO = (os.SCHED_FIFO, 99)


class Franky:
    """The package and its robot.

    Attributes:
        error: Raised by the next look at the motion, once.
        refusal: Raised by connecting.
        scheduling: Of the thread that calls.
        moved: Scheduling in which motions began.
    """

    class RobotMode(Enum):
        Idle, Move, Guiding, Reflex, UserStopped = range(5)

    RealtimeConfig = SimpleNamespace(Enforce="enforce", Ignore="ignore")
    Exception = type("Exception", (RuntimeError,), {})
    NetworkException = type("NetworkException", (Exception,), {})
    RealtimeException = type("RealtimeException", (Exception,), {})
    IncompatibleVersionException = type("IncompatibleVersionException", (Exception,), {})

    def __init__(self):
        self.calls, self.moved, self.error, self.refusal = [], [], None, None
        self.scheduling, self.is_in_control, self.heals = (os.SCHED_OTHER, 0), False, True
        self.mode, self.errors, self.milliseconds = self.RobotMode.Idle, {}, 1000
        self.joint_velocity_limit = SimpleNamespace(get=lambda: [2.0] * 6 + [0.5])
        self.joint_acceleration_limit = SimpleNamespace(get=lambda: [10.0] * 7)
        self.joint_jerk_limit = SimpleNamespace(get=lambda: [5000.0] * 7)
        self.width = 0.06

    def __getattr__(self, name):
        if name.startswith("__"):
            raise AttributeError(name)
        return lambda *values, **named: self.calls.append((name, *values, *named.values()))

    def Duration(self, milliseconds):
        return milliseconds

    def JointVelocityMotion(self, velocity, *, duration):
        return (*velocity, duration)

    def JointVelocityStopMotion(self):
        return "stop"

    def RelativeDynamicsFactor(self, *factors):
        return factors

    def Robot(self, ip, *, realtime_config):
        self.calls.append(("Robot", ip, realtime_config))
        self.scheduling = FIFO
        if self.refusal is not None:
            raise self.refusal
        return self

    def Gripper(self, ip):
        if self.width is None:
            raise self.NetworkException("refused")
        return self

    def poll_motion(self):
        self._raise()

    def _raise(self):
        error, self.error = self.error, None
        if error is not None:
            raise error

    def recover_from_errors(self):
        self.calls.append(("recover",))
        self._raise()
        return self.heals

    def move(self, motion, *, asynchronous):
        assert asynchronous
        self.moved.append(self.scheduling)
        self.calls.append(("move", motion))

    def move_async(self, *values):
        self.calls.append(("fingers", *values))
        return SimpleNamespace(get=lambda: True)

    grasp_async = lambda self, *values, **named: self.move_async(*values, named)  # noqa: E731

    @property
    def state(self):
        now = self.milliseconds
        return SimpleNamespace(
            time=SimpleNamespace(to_sec=lambda: now / 1000, to_msec=lambda: now),
            q=[now] * 7,
            dq=[0.5] * 7,
            tau_ext_hat_filtered=[3] * 7,
            robot_mode=self.mode,
            current_errors=SimpleNamespace(**self.errors),
        )


@pytest.fixture
def franky(monkeypatch):
    franky = Franky()
    monkeypatch.setattr(franky_arm, "imported", lambda *_: franky)

    def schedule(thread, policy, parameters):
        assert thread == 0  # the one that calls
        franky.scheduling = (policy, parameters)

    monkeypatch.setattr(os, "sched_setscheduler", schedule)
    monkeypatch.setattr(os, "sched_getscheduler", lambda thread: franky.scheduling[thread])
    monkeypatch.setattr(os, "sched_getparam", lambda thread: franky.scheduling[1 + thread])
    yield franky
    franky.scheduling = (os.SCHED_OTHER, 0)


@pytest.fixture
def arm(franky):
    with FrankyArm("arm", CONFIG) as arm:
        franky.calls.clear()
        yield arm


def test_connecting_recovers_and_sends_the_settings_in_ordinary_priority(franky):
    torque, force = list(CONFIG.collision.torque), list(CONFIG.collision.force)
    with FrankyArm("arm", CONFIG):
        assert franky.calls == [
            ("Robot", "arm", "ignore"),
            ("recover",),
            ("set_collision_behavior", torque, torque, force, force),
        ]
        assert franky.relative_dynamics_factor == (1.0, 0.3, 0.3)
        assert franky.scheduling == (os.SCHED_OTHER, 0)
    assert franky.calls[3:] == [("join_motion", 3.0)]  # nothing moved


@pytest.mark.parametrize("kernel", ["1\n", "0\n", None])
def test_a_real_arm_needs_a_realtime_kernel(franky, tmp_path, monkeypatch, kernel):
    monkeypatch.setattr(franky_arm, "_REALTIME_KERNEL", tmp_path / "realtime")
    if kernel is not None:
        (tmp_path / "realtime").write_text(kernel)
    if kernel == "1\n":
        with FrankyArm("arm"):
            assert franky.calls[0] == ("Robot", "arm", "enforce")
    else:
        with pytest.raises(RealtimeError, match=r"PREEMPT_RT.*rtprio 99.*realtime=False"):
            FrankyArm("arm")


def test_an_arm_that_cannot_be_opened_says_why_and_leaves_the_priority(franky):
    for kind in ("NetworkException", "IncompatibleVersionException"):
        franky.refusal = getattr(Franky, kind)("no route")
        with pytest.raises(ConnectionError, match=r"arm at arm \(no route\).*cable.*FCI"):
            FrankyArm("arm", CONFIG)
        assert franky.scheduling == (os.SCHED_OTHER, 0)
    franky.refusal = Franky.RealtimeException("no kernel for it")
    with pytest.raises(RealtimeError, match="no kernel for it: boot"):
        FrankyArm("arm", CONFIG)
    franky.refusal, franky.width = None, None
    with pytest.raises(GripperError, match=r"\(refused\).*its end effector"):
        FrankyArm("arm", CONFIG)


def test_the_state_is_the_drivers_and_never_goes_back_in_time(franky, arm):
    state = arm.read()
    assert (state.time, state.gripper_width) == (1.0, 0.06)
    np.testing.assert_array_equal(state.joint_position, np.full(7, 1000.0))
    np.testing.assert_array_equal(state.joint_velocity, np.full(7, 0.5))
    np.testing.assert_array_equal(state.external_torque, np.full(7, 3.0))
    for milliseconds, shown in ((999, 1.0), (1001, 1.001), (1000, 1.001)):
        franky.milliseconds = milliseconds
        assert arm.read().time == shown


def test_a_velocity_is_a_motion_begun_in_the_priority_of_the_driver(franky, arm):
    arm.command(VELOCITY * 0.5)
    assert franky.calls == [("move", (*(VELOCITY * 0.5).tolist(), 150))]
    assert franky.moved == [FIFO]
    assert franky.scheduling == (os.SCHED_OTHER, 0)
    with pytest.raises(ValueError, match=r"joint 7: 0\.600 rad/s is beyond its limit of 0\.5"):
        arm.command(VELOCITY)
    arm.stop()  # nothing moves
    assert len(franky.calls) == 1
    franky.is_in_control = True
    arm.stop()
    assert franky.calls[1:] == [("move", "stop")]
    # A mode is looked at where nothing moves only: the driver ends a motion by itself.
    franky.mode = Franky.RobotMode.Reflex
    arm.command(np.zeros(7))


CURES = {
    "UserStopped": "release the user stop",
    "Guiding": "let go of the guiding buttons",
    "Reflex": "make room around the arm",
}


@pytest.mark.parametrize("mode", CURES)
def test_an_arm_that_takes_no_commands_names_its_mode_errors_and_cure(franky, arm, mode):
    franky.mode = Franky.RobotMode[mode]
    franky.errors = {"joint_velocity_violation": True, "power_limit_violation": False}
    cure = f"{CURES[mode]}, then call recover\\(\\)\\."
    text = rf"at arm is in mode {mode} \(joint_velocity_violation\), and it takes no commands: "
    for _ in range(2):
        with pytest.raises(ArmFaultError, match=text + cure):
            arm.command(np.zeros(7))
        franky.mode = Franky.RobotMode.Idle  # the fault stays until it is recovered
    franky.mode, franky.errors, franky.heals = Franky.RobotMode[mode], {}, False
    with pytest.raises(
        ArmFaultError, match=r"\(no error is reported\), and its error recovery"
    ):
        arm.recover()
    franky.heals = True
    with pytest.raises(ArmFaultError, match="it takes no commands"):
        arm.recover()
    franky.mode = Franky.RobotMode.Move
    arm.recover()
    arm.command(np.zeros(7))
    assert not [call for call in franky.calls if call[0] == "Robot"]


@pytest.mark.parametrize(
    ("kind", "cure"),
    [
        ("NetworkException", r"Check the cable, then call recover\(\)"),
        ("RealtimeException", "no permission to schedule in real time: boot"),
        ("Exception", r"it is at rest\. Make room around it, then call recover\(\)"),
    ],
)
def test_a_motion_that_ended_by_an_error_is_a_fault_until_recovered(franky, arm, kind, cure):
    error = getattr(Franky, kind)
    franky.error = error("an\n  error.")
    text = f"the motion of the arm at arm ended by {kind}: an error; .*{cure}"
    lost = kind == "NetworkException"
    for _ in range(2):
        with pytest.raises(ArmFaultError, match=text):
            arm.command(np.zeros(7))
    if lost:
        with pytest.raises(ArmFaultError, match=text):
            arm.stop()
    else:
        arm.stop()
    assert arm.read().time == 1.0  # it can still be looked at
    franky.calls.clear()
    if lost:
        # What ended the motion, and then the connection itself.
        franky.poll_motion = lambda: None
        franky.error = error("gone")
    arm.recover()
    names = [call[0] for call in franky.calls]
    assert names[0] == "recover"
    assert ("Robot" in names) == lost
    arm.stop()
    arm.command(np.zeros(7))


def test_an_error_that_ends_a_stop_is_told_by_the_next_command(franky, arm):
    franky.error = Franky.Exception("aborted")
    arm.stop()
    with pytest.raises(ArmFaultError, match="aborted"):
        arm.command(np.zeros(7))


def test_a_closed_arm_says_so_and_closes_once(franky):
    arm = FrankyArm("arm", CONFIG)
    franky.is_in_control = True
    franky.calls.clear()
    arm.close()
    arm.close()
    assert franky.calls == [("move", "stop"), ("join_motion", 3.0)]
    for call in (arm.read, arm.recover, lambda: arm.command(np.zeros(7))):
        with pytest.raises(ArmFaultError, match="the arm at arm is closed: open it again"):
            call()
    arm.stop()


def test_a_gentle_arm_has_the_time_to_brake_before_it_is_disconnected(franky):
    arm = FrankyArm("arm", FrankyConfig(realtime=False, dynamics=0.05))
    franky.calls.clear()
    arm.close()
    ((name, patience),) = franky.calls
    assert name == "join_motion"
    assert 4.0 < patience < 8.0  # 2 rad/s at 0.5 rad/s^2


def test_the_gripper_moves_and_squeezes_with_the_settings(franky, arm):
    moved = ("fingers", 0.03, 0.1)
    squeezed = ("fingers", 0.0, 0.1, 20.0, {"epsilon_outer": 1.0})
    for width, call in ((0.03, moved), (0.0, squeezed)):
        arm.move(width)
        for _ in range(1000):  # its threads come to it in their time
            if call in franky.calls:
                break
            threading.Event().wait(0.01)
        assert call in franky.calls


@pytest.mark.parametrize("mode", ["Idle", "Move"])
def test_an_arm_that_is_ready_is_connected_to(franky, mode):
    franky.mode = Franky.RobotMode[mode]
    with FrankyArm("arm", FrankyConfig(realtime=False, timeout=0.0625)) as arm:
        arm.command(np.zeros(7))
        assert ("move", (*[0.0] * 7, 62)) in franky.calls  # milliseconds


def test_the_gripper_moves_at_its_speed_and_squeezes_whatever_is_there(franky):
    config = FrankyConfig(realtime=False, grip_speed=0.05, grip_force=17.0)
    gripper = franky_arm._FrankyGripper(franky, "arm", config)
    assert gripper.read_width() == 0.06
    assert gripper.move(0.03)
    assert gripper.squeeze()
    assert franky.calls == [
        ("fingers", 0.03, 0.05),
        ("fingers", 0.0, 0.05, 17.0, {"epsilon_outer": 1.0}),
    ]
