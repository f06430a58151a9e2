"""Our scene behind the arm's protocol: clock, motion, gripper, and a whole job through it."""

import threading
from contextlib import ExitStack
from dataclasses import replace

import numpy as np
import pytest
from franky_servers import READY, served_world
from programs_as_modules import load_program

from hrc_learn.experiments.simulated_cell import PROTOCOL_DELAY, SIMULATED, access_by
from hrc_learn.hardware import FrankyConfig
from hrc_learn.hardware.protocol_server import CYCLE, serve_world
from hrc_learn.kinematics import panda
from hrc_learn.sim import Imperfections, World
from hrc_learn.sim.workplace import Workplace

pytest.importorskip("franky")
pytest.importorskip("franky_sim")

pytestmark = pytest.mark.realtime

served_cycles = load_program("benchmarks/served_cycles.py")

DT = 0.01


@pytest.fixture
def served():
    with served_world() as served:
        yield served


def follow(served, velocity_of, steps):
    """Command joint 1 in steps of DT; times, positions, velocities and commands."""
    log = []
    for k in range(steps):
        state = served.arm.read()
        velocity = velocity_of(k)
        served.arm.command(velocity * np.eye(7)[0])
        log.append((state.time, state.joint_position[0], state.joint_velocity[0], velocity))
        served.server.advance(DT)
    return np.array(log).T


def test_the_clock_is_the_worlds_and_steps_keep_their_length(served):
    before = served.world.time
    times, *_ = follow(served, lambda k: 0.1, 50)
    assert served.world.time - before == pytest.approx(50 * DT, abs=5 * CYCLE)
    np.testing.assert_allclose(np.diff(times)[1:], DT, atol=2 * CYCLE)
    now = served.arm.read().time
    assert now == pytest.approx(served.world.time, abs=2 * CYCLE)


def test_time_that_nobody_lets_pass_hardly_does(served):
    follow(served, lambda k: 0.2, 5)
    before, cycles = served.world.time, served.server.cycles
    threading.Event().wait(1.3)  # longer than libfranka waits for a state
    assert served.world.time - before < 0.1  # signs of life
    assert served.server.cycles > cycles
    follow(served, lambda k: 0.2, 5)  # the motion has gone on


def test_a_velocity_is_followed_within_the_delay_told():
    """By the best shift of the commands as they were held; beside it the shape must fit."""
    with served_world() as served:
        times, _, actual, commands = follow(
            served, lambda k: 0.3 * np.sin(2 * np.pi * 0.8 * k * DT), 125
        )

        def held(at):
            return commands[np.clip(np.searchsorted(times, at, side="right") - 1, 0, None)]

        shifts = np.arange(0, 0.03, 0.001)
        misfit = [np.sqrt(np.mean((held(times - s) - actual)[10:] ** 2)) for s in shifts]
        assert shifts[np.argmin(misfit)] <= PROTOCOL_DELAY
        assert min(misfit) < 0.01
        # All cycles but the first of the motion are answered, unless the machine is too busy.
        assert served.server.missed <= 0.05 * served.server.cycles


def test_the_arm_moves_as_the_one_that_is_led_directly(served):
    direct = World(served.world.config)
    direct.reset(READY)
    start, velocities = served.arm.read().joint_position, [0.2] * 30 + [0.0] * 20
    for velocity in velocities:
        direct.arm.command(velocity * np.eye(7)[0])
        direct.advance(DT)
    follow(served, lambda k: velocities[k], len(velocities))
    moved = served.arm.read().joint_position - start
    # Ramps of franky's begin late and end late, and leave the way as long as it is.
    np.testing.assert_allclose(moved, direct.arm.read().joint_position - READY, atol=2e-3)


def test_an_arm_that_rests_stays_where_it_is(served):
    follow(served, lambda k: 0.2, 10)
    served.server.advance(0.5)  # the velocity has run out
    rest = served.arm.read()
    served.server.advance(0.5)
    np.testing.assert_allclose(served.arm.read().joint_position, rest.joint_position, atol=1e-4)
    assert not served.driver._robot.is_in_control


def test_the_gripper_closes_at_its_speed_on_what_is_there():
    workplace = Workplace()
    world, item = World(workplace.scene), workplace.scene.objects[0]
    world.hold(item.name, workplace.home_joints().numpy())
    config = FrankyConfig(realtime=False, grip_speed=0.02, grip_force=15.0)
    with served_world(world, config) as served:
        assert world.holds(item.name)  # as it did before
        served.arm.move(0.08)
        start, widths = served.arm.read(), []
        for _ in range(20):
            served.server.advance(0.02)
            widths.append(served.arm.read().gripper_width)
        # Both fingers at 0.02 m/s.
        assert np.diff(widths[5:15]).mean() / 0.02 == pytest.approx(0.04, rel=0.2)
        assert widths[-1] > start.gripper_width
        assert not world.holds(item.name)
        served.arm.move(0.0)
        served.server.advance(2.0)
        np.testing.assert_allclose(np.abs(world.model.actuator("finger_left").forcerange), 15.0)
        assert served.driver.gripper.failure is None


def test_physics_that_fails_is_told_to_whoever_lets_time_pass():
    from hrc_learn.sim import PhysicsError

    stack = ExitStack()
    served = stack.enter_context(served_world())
    served.world.data.qvel[0] = 1e6
    with pytest.raises(PhysicsError):
        served.server.advance(DT)
    with pytest.raises(PhysicsError):  # as closing the arm wants time to pass
        stack.close()


def test_without_answers_the_arm_goes_on_with_its_acceleration():
    """Lost packets of both ways; the motion hardly differs from the one without."""
    with served_world() as served:
        cycles = served_cycles.CycleLog(served.server)
        link = served_cycles.LossyLink(served.server, 0.1)
        times, _, actual, commands = follow(
            served, lambda k: 0.3 * np.sin(2 * np.pi * 0.8 * k * DT), 125
        )
        server = served.server
        # States that are lost count: the driver's clock does not fall behind.
        assert np.ptp(times) == pytest.approx(124 * DT, abs=5 * CYCLE)
        assert link.lost <= server.missed
        # The log notes a cycle as the next one begins.
        assert server.missed - sum(not cycle.answered for cycle in cycles) in (0, 1)
        # Of a state or of the answer to it.
        assert link.lost / len(cycles) == pytest.approx(1 - 0.9**2, rel=0.15)
    velocities = np.array([cycle.velocity for cycle in cycles])
    (silent,) = np.nonzero([not cycle.answered for cycle in cycles])
    silent = silent[silent > 1]
    went_on = 2 * velocities[silent - 1] - velocities[silent - 2]
    np.testing.assert_allclose(velocities[silent], went_on, atol=1e-9)
    assert np.abs(velocities[silent, 0]).max() > 0.1
    late = round(PROTOCOL_DELAY / DT) + 1
    np.testing.assert_allclose(actual[late:], commands[:-late], atol=0.05)


def test_the_acceleration_told_is_that_of_the_commands():
    told = []

    class Log(served_cycles.CycleLog):
        def append(self, cycle):
            super().append(cycle)
            told.append(self._robot.state.ddq_d[0])

    with served_world() as served:
        served_cycles.LossyLink(served.server, 0.05)
        cycles = Log(served.server)
        follow(served, lambda k: 0.3 * np.sin(2 * np.pi * 0.8 * k * DT), 60)
    velocity = np.array([cycle.velocity[0] for cycle in cycles])
    # A state tells of the commands before it.
    np.testing.assert_allclose(told[2:], np.diff(velocity)[:-1] / CYCLE, atol=1e-6)
    assert np.abs(told).max() > 1.0


def test_a_box_without_any_answer_holds_the_velocity_in_the_end():
    with served_world() as served:
        cycles = served_cycles.CycleLog(served.server)
        follow(served, lambda k: 0.02 * k, 8)
        link = served_cycles.LossyLink(served.server, 1.0)
        served.server.advance(0.04)
        last_answer = max(k for k, cycle in enumerate(cycles) if cycle.answered)
        velocity = np.array([cycle.velocity[0] for cycle in cycles[last_answer:]])
        assert len(velocity) > 30
        slopes = np.diff(velocity)
        assert slopes[0] > 1e-5
        np.testing.assert_allclose(slopes[:20], slopes[0], atol=1e-9)
        np.testing.assert_allclose(slopes[20:], 0.0, atol=1e-12)
        link.loss = 0.0


def test_servers_beside_each_other_take_addresses_of_their_own():
    first, second = World(), World()
    step = first.model.opt.timestep
    with serve_world(first) as one, serve_world(second) as other:
        assert one.address != other.address
        assert first.model.opt.timestep == CYCLE
    assert first.model.opt.timestep == step


def test_a_controller_is_told_of_the_drivers_delay_and_acceleration():
    access = access_by("franky", panda, dynamics=0.4)
    sizes = replace(Imperfections.ideal(), command_delay=0.02, slowness=0.3)
    told = access.declared(sizes)
    assert told.command_delay == pytest.approx(0.02 + PROTOCOL_DELAY)
    assert told.slowness == pytest.approx(0.6)
    assert access.declared(replace(sizes, slowness=0.8)).slowness == 0.8
    assert SIMULATED.declared(sizes) == sizes


def test_without_the_simulator_its_extra_is_named(monkeypatch):
    import sys

    monkeypatch.setitem(sys.modules, "franky_sim.base_simulator", None)
    monkeypatch.delitem(sys.modules, "hrc_learn.hardware.served_robot", raising=False)
    with pytest.raises(ImportError, match=r"hrc-learn\[hardware\]"), serve_world(World()):
        pass
