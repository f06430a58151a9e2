"""The driver franky against a simulator of the arm's network protocol."""

import os
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from franky_servers import READY, served_world, simulated_arm

from hrc_learn.hardware import (
    ArmFaultError,
    CollisionConfig,
    FrankyArm,
    FrankyConfig,
    GripperError,
    Load,
)
from hrc_learn.sim import Imperfections, SceneConfig, World

pytest.importorskip("franky")
pytest.importorskip("franky_sim")

pytestmark = pytest.mark.realtime

CONFIG = FrankyConfig(realtime=False, dynamics=1.0)


def pause(seconds=0.01):
    threading.Event().wait(seconds)


def keep_going(arm):
    """Command a velocity for as long as it takes the arm to tell of a fault."""
    for _ in range(2000):
        arm.command(0.1 * np.eye(7)[0])
        pause()


@pytest.fixture(scope="module")
def simulator():
    with simulated_arm() as simulator:
        yield simulator


@pytest.fixture
def arm(simulator):
    with FrankyArm(simulator.ip, CONFIG) as arm:
        yield arm


def test_seven_joints_reach_their_goal_while_the_gripper_moves(arm, simulator):
    start, goal = (
        arm.read(),
        arm.read().joint_position + 0.1 * np.array([1, -1, 1, -1, 1, 1, -1]),
    )
    arm.move(0.08)
    state, widths = start, []
    while state.time < start.time + 2.0:
        arm.command(np.clip(8 * (goal - state.joint_position), -0.5, 0.5))
        pause()
        state = arm.read()
        widths.append(state.gripper_width)
    np.testing.assert_allclose(state.joint_position, goal, atol=3e-3)
    np.testing.assert_allclose(simulator.robot.inner_state.q, goal, atol=3e-3)
    # Told all along the way, not only where it began and ended.
    assert len({round(width, 3) for width in widths}) > 10
    assert widths[-1] == pytest.approx(0.08, abs=2e-3)
    arm.gripper.check()


def scheduling(thread=0):
    return os.sched_getscheduler(thread), os.sched_getparam(thread).sched_priority


def test_only_the_drivers_own_thread_has_realtime_priority(simulator):
    before = scheduling()
    assert before[0] == os.SCHED_OTHER
    known = set(os.listdir("/proc/self/task"))
    with FrankyArm(simulator.ip, CONFIG) as arm:
        assert scheduling() == before
        started = set(os.listdir("/proc/self/task")) - known
        assert {scheduling(int(thread)) for thread in started} <= {before}
        arm.command(0.1 * np.eye(7)[0])
        assert scheduling() == before
        pause(0.05)
        started = set(os.listdir("/proc/self/task")) - known
        priorities = [scheduling(int(thread))[0] for thread in started]
        if _may_take_priority():
            assert priorities.count(os.SCHED_FIFO) == 1
        arm.stop()
        assert scheduling() == before


def _may_take_priority() -> bool:
    try:
        highest = os.sched_get_priority_max(os.SCHED_FIFO)
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(highest))
    except PermissionError:
        return False
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    return True


def test_a_velocity_that_nobody_renews_brings_the_arm_to_rest(simulator):
    config = FrankyConfig(realtime=False, dynamics=1.0, timeout=0.1)
    with FrankyArm(simulator.ip, config) as arm:
        start = state = arm.read()
        arm.command(0.4 * np.eye(7)[0])
        fastest = 0.0
        while state.time < start.time + 0.6:
            state = arm.read()
            fastest = max(fastest, state.joint_velocity[0])
            pause(0.001)
    assert fastest == pytest.approx(0.4, rel=0.05)
    assert abs(state.joint_velocity[0]) < 5e-3
    # It held for the time, which began with the ramp to it and is followed by the one to rest.
    assert state.joint_position[0] - start.joint_position[0] == pytest.approx(0.04, abs=0.004)


def test_a_closed_arm_says_so_and_leaves_its_place_to_the_next(simulator):
    with FrankyArm(simulator.ip, CONFIG) as arm:
        arm.command(np.zeros(7))
    with FrankyArm(simulator.ip, CONFIG) as following:
        for call in (arm.read, arm.recover, lambda: arm.command(np.zeros(7))):
            with pytest.raises(ArmFaultError, match="is closed: open it again"):
                call()
        arm.stop()
        arm.close()
        following.command(np.zeros(7))


def test_a_stop_ends_a_velocity_before_its_time(arm):
    start = state = arm.read()
    arm.command(0.3 * np.eye(7)[0])
    while state.joint_velocity[0] < 0.2:
        state = arm.read()
        pause(0.001)
        assert state.time < start.time + 1
    stopped = state.time
    arm.stop()
    while abs(state.joint_velocity[0]) > 5e-3:
        state = arm.read()
        pause(0.001)
        assert state.time < stopped + 0.1  # the velocity would have held longer
    arm.stop()  # at rest already


def test_times_never_go_back_as_motions_begin_and_end(arm):
    times = []
    for _ in range(6):
        arm.command(0.05 * np.eye(7)[1])
        for _ in range(60):  # past the hold time and the end of the motion
            times.append(arm.read().time)
            pause(0.004)
    assert (np.diff(times) >= 0).all()
    assert times[-1] > times[0] + 0.5


@pytest.mark.parametrize(
    ("velocity", "message"),
    [
        ([0, 0, np.nan, 0, 0, 0, 0], "7 finite numbers"),
        ([0, 0, 0, -9.0, 0, 0, 0], r"joint 4: -9\.000 rad/s is beyond its limit of 2\.175"),
    ],
)
def test_velocities_that_the_driver_would_refuse_later_are_refused_now(arm, velocity, message):
    with pytest.raises(ValueError, match=message):
        arm.command(np.array(velocity, dtype=float))
    arm.command(np.zeros(7))  # no fault


def test_a_velocity_at_the_limit_may_be_rounded_beyond_it(arm):
    arm.command(arm._fastest * (1 + 1e-9) * np.eye(7)[6])
    pause(0.05)
    arm.command(np.zeros(7))  # would raise what the driver refused


def test_load_and_collision_thresholds_reach_the_arm(simulator, monkeypatch):
    from franky_sim.franka_robot_protocol import SetCollisionBehaviorCommand

    heard = []
    handle = SetCollisionBehaviorCommand.handle
    monkeypatch.setattr(
        SetCollisionBehaviorCommand,
        "handle",
        lambda command, server: (heard.append(command), handle(command, server)),
    )
    load = Load(
        mass=0.4,
        centre=(0.01, -0.02, 0.05),
        inertia=((2e-3, 1e-4, 0.0), (1e-4, 3e-3, 0.0), (0.0, 0.0, 4e-3)),
    )
    collision = CollisionConfig(
        torque=(21.0, 22.0, 23.0, 24.0, 25.0, 26.0, 27.0),
        force=(31.0, 32.0, 33.0, 34.0, 35.0, 36.0),
    )
    config = FrankyConfig(realtime=False, load=load, collision=collision)
    with FrankyArm(simulator.ip, config):
        robot = simulator.robot
        assert (robot.m_load, robot.F_x_Cload) == (load.mass, load.centre)
        np.testing.assert_array_equal(np.reshape(robot.I_load, (3, 3)), load.inertia)
        command = heard[-1]
        assert tuple(command.upper_torque_thresholds_nominal) == collision.torque
        assert tuple(command.lower_torque_thresholds_acceleration) == collision.torque
        assert tuple(command.upper_force_thresholds_nominal) == collision.force
        assert tuple(command.lower_force_thresholds_acceleration) == collision.force


def test_a_lost_connection_is_a_fault_until_it_is_recovered(simulator, capfd):
    with FrankyArm(simulator.ip, CONFIG) as arm:
        arm.command(0.1 * np.eye(7)[0])
        pause(0.05)
        simulator.pull_out()
        try:
            with pytest.raises(
                ArmFaultError, match=r"NetworkException.*Timeout.*call recover\(\)"
            ):
                keep_going(arm)
            for _ in range(3):  # the driver itself would begin a new motion each second time
                with pytest.raises(ArmFaultError, match=r"NetworkException.*call recover\(\)"):
                    arm.command(np.zeros(7))
            with pytest.raises(ArmFaultError):
                arm.stop()
            # The gripper has a connection of its own, which waits for longer.
            until = time.monotonic() + 20.0
            while arm.gripper.failure is None and time.monotonic() < until:
                time.sleep(0.05)
        finally:
            simulator.plug_in()
        arm.recover()
        before = arm.read()
        while arm.read().time < before.time + 0.3:
            arm.command(0.2 * np.eye(7)[0])
            pause()
        assert arm.read().joint_position[0] > before.joint_position[0] + 0.02
    assert "gripper: the gripper cannot be reached" in capfd.readouterr().err


def reflexing_server():
    """A server whose arm stops by a reflex once `reflex` is set, as the real one does."""
    from franky_sim.franka_robot_protocol import MoveStatus, RobotCommand, RobotMode
    from franky_sim.franka_robot_server import FrankaRobotServer
    from franky_sim.franka_server import BaseCommand

    class Server(FrankaRobotServer):
        mode = None

        def reflex(self, mode):
            self.mode = RobotMode[mode]

        @property
        def robot_state(self):
            state = super().robot_state
            if self.mode is None:
                return state
            # The 4th of libfranka's errors: joint_velocity_violation.
            errors = tuple(k == 3 for k in range(41))
            return state.replace(robot_mode=self.mode, errors=errors, reflex_reason=errors)

        def process_commands(self):
            super().process_commands()
            if self.mode is not None and self.current_motion_id:
                motion = self.current_motion_id
                self.reset_current_motion_id()
                self.stop_motion(send_preemption_signal=False)
                BaseCommand.send_response(
                    self._tcp_socket, RobotCommand.kMove, motion, MoveStatus.kReflexAborted
                )

    return Server


@pytest.fixture
def reflexing(monkeypatch):
    monkeypatch.setattr("franky_sim.simulation_server.FrankaRobotServer", reflexing_server())
    with simulated_arm() as simulator, FrankyArm(simulator.ip, CONFIG) as arm:
        yield arm, simulator.server.robot_servers[0]


def test_a_reflex_ends_all_commands_until_it_is_recovered(reflexing):
    arm, server = reflexing
    for _ in range(10):
        arm.command(0.1 * np.eye(7)[0])
        pause()
    server.reflex("kReflex")
    # A busy machine may see the mode before the end of the motion.
    with pytest.raises(
        ArmFaultError,
        match=r"(aborted by reflex|in mode Reflex).*joint_velocity_violation.*call recover\(\)",
    ):
        keep_going(arm)
    for _ in range(3):
        with pytest.raises(ArmFaultError):
            arm.command(np.zeros(7))
    arm.stop()
    aborted = rest = arm.read()  # it can still be looked at
    while abs(rest.joint_velocity[0]) > 0.01:
        pause()
        rest = arm.read()
        assert rest.time < aborted.time + 0.3
    with pytest.raises(
        ArmFaultError, match=r"mode Reflex \(.*joint_velocity_violation.*make room"
    ):
        arm.recover()
    with pytest.raises(ArmFaultError):
        arm.command(np.zeros(7))
    server.mode = None
    arm.recover()
    while arm.read().time < rest.time + 1.0:
        arm.command(0.1 * np.eye(7)[0])
        pause()
    assert arm.read().joint_position[0] > rest.joint_position[0] + 0.02


def test_a_pressed_user_stop_says_what_to_release(reflexing):
    arm, server = reflexing
    server.reflex("kUserStopped")
    pause(0.1)
    arm.read()
    with pytest.raises(ArmFaultError, match=r"mode UserStopped.*release the user stop"):
        arm.command(np.zeros(7))  # of an arm at rest: the first one knows


def test_external_torques_are_the_arms_own_estimate():
    # Dry friction acts on the simulated joints as a load from outside does.
    sizes = replace(Imperfections.ideal(), joint_friction=2.0)
    drawn = sizes.draw(np.random.default_rng(0))
    world = World(SceneConfig(objects=()), drawn)
    world.reset(READY)
    with served_world(world) as served:
        for _ in range(20):
            served.arm.command(0.2 * np.eye(7)[0])
            served.server.advance(0.01)
        torque = served.arm.read().external_torque
        assert torque[0] == pytest.approx(-2.0, abs=0.02)
        np.testing.assert_allclose(torque, world.arm.read().external_torque, atol=0.02)


def test_where_no_arm_answers_the_address_is_named():
    with pytest.raises(ConnectionError, match=r"arm at 127\.255\.0\.1.*cable.*FCI"):
        FrankyArm("127.255.0.1", CONFIG)


def test_an_arm_without_its_gripper_says_so(simulator, monkeypatch):
    import franky

    def refuse(ip):
        raise franky.NetworkException("libfranka gripper: Connection refused")

    monkeypatch.setattr(franky, "Gripper", refuse)
    with pytest.raises(GripperError, match=r"Connection refused.*end effector"):
        FrankyArm(simulator.ip, CONFIG)


@pytest.mark.slow
def test_a_program_that_forgets_its_arm_ends_all_the_same(simulator):
    """Threads that the driver's own code holds would end the process by a signal."""
    forgets = (
        "import sys, time, numpy as np\n"
        "from hrc_learn.hardware import FrankyArm, FrankyConfig\n"
        "arm = FrankyArm(sys.argv[1], FrankyConfig(realtime=False))\n"
        "arm.command(0.1 * np.eye(7)[0])\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", forgets, simulator.ip],
        cwd=Path(__file__).parents[2],
        capture_output=True,
        text=True,
        timeout=100,
    )
    assert (done.returncode, done.stderr) == (0, "")
