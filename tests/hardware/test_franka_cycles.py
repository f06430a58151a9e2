"""Cycles of a Franka arm's loop with a control box whose clock, faults and losses tests decide.

The box keeps what Franka documents: each cycle takes one velocity; without one it goes on with
a constant acceleration; it reports single precision; an exception ends the motion.
"""

import os
import signal
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from unchecked import shapes_unchecked

from hrc_learn.controller import SafetyConfig
from hrc_learn.hardware import CollisionConfig, FrankaConfig, Load, franka_loop
from hrc_learn.hardware.franka_arm import step_of
from hrc_learn.hardware.franka_memory import Orders, Phase, Shared
from hrc_learn.hardware.franka_settings import CYCLE, RealtimeError
from hrc_learn.kinematics import fr3, panda

pytestmark = pytest.mark.simulation

CONFIG = FrankaConfig(realtime=False, compiled=False)
LIMITS = fr3.limits
WANTED = 0.1 * np.array([1, -1, 1, -1, 1, 1, -1])
TIMEOUT = round(CONFIG.timeout / CYCLE)
"""Cycles for which a velocity holds."""


# Named as those of pylibfranka, by which the loop knows them.
KINDS = ("Control", "Command", "Network", "Realtime")
ControlError, CommandError, NetworkError, RealtimeMissing = (
    type(f"{kind}Exception", (RuntimeError,), {}) for kind in KINDS
)


class JointVelocities:
    def __init__(self, velocity):
        self.velocity, self.motion_finished = np.array(velocity), False


class Box:
    """Control box, its driver, and the clock of the machine.

    Attributes:
        at: What happens as a cycle begins, by its number.
        skipped, late, slow: Cycles lost before one, how late it is read [s], and how long its
            answer takes [s], by its number.
    """

    RealtimeConfig = SimpleNamespace(kEnforce="enforce", kIgnore="ignore")
    ControllerMode = SimpleNamespace(JointImpedance="impedance")
    JointVelocities = JointVelocities
    NetworkException, RealtimeException = NetworkError, RealtimeMissing

    def __init__(self):
        self.at, self.skipped, self.late, self.slow = {}, {}, {}, {}
        self.cycle, self.now, self.calls, self.answers, self.course = 0, 0.0, [], [], []
        self.q, self.v, self.a = fr3.ready.numpy().copy(), np.zeros(7), np.zeros(7)
        self.moves, self.answered, self.failure, self.shared = False, True, None, Shared()

    def schedule(self, thread, policy, parameters):
        assert (thread, policy) == (0, os.SCHED_FIFO)
        assert parameters.sched_priority == os.sched_get_priority_max(os.SCHED_FIFO)

    def order(self, **orders):
        self.shared.orders.write(Orders(**orders))

    def command(self, cycles, velocity=WANTED):
        """Set a velocity in each of these cycles."""
        for k in cycles:
            self.at[k] = lambda: self.order(stamp=self.now, joint_velocity=velocity)

    @property
    def report(self):
        return self.shared.report.read()

    # As pylibfranka's robot.

    def Robot(self, ip, mode):
        self.calls.append(("Robot", ip, mode))
        self.failure = None if isinstance(self.failure, NetworkError) else self.failure
        return self

    def __getattr__(self, name):
        return lambda *values: self.calls.append((name, *values))

    def automatic_error_recovery(self):
        if isinstance(self.failure, NetworkError | CommandError):
            raise self.failure
        self.failure = None
        self.calls.append(("automatic_error_recovery",))

    def start_joint_velocity_control(self, mode):
        assert mode == "impedance"
        self.calls.append(("motion",))
        self.moves = self.answered = True
        self.v, self.a = np.zeros(7), np.zeros(7)
        return self

    def read_once(self):
        self._advance()
        if isinstance(self.failure, NetworkError):
            raise self.failure
        number = np.nan if self.cycle == 1 else 0.0
        return SimpleNamespace(
            time=SimpleNamespace(to_sec=lambda now=self.cycle * CYCLE: now),
            q=self.q.tolist(),
            dq=self.v.tolist(),
            dq_d=self.v.astype(np.float32).astype(float).tolist(),
            ddq_d=(self.a.astype(np.float32) + number).tolist(),
            tau_ext_hat_filtered=(self.q + 1).tolist(),
        )

    def readOnce(self):
        before = self.cycle
        state = self.read_once()
        if self.failure is not None:
            self.moves = False
            raise self.failure
        passed = (self.cycle - before) * CYCLE
        return state, SimpleNamespace(to_sec=lambda: passed)

    def writeOnce(self, answer):
        self.a, self.v = (answer.velocity - self.v) / CYCLE, answer.velocity
        self.answered = True
        self.answers.append((self.cycle, answer.velocity, answer.motion_finished))
        self.moves = not answer.motion_finished

    def _advance(self):
        for _ in range(1 + self.skipped.get(self.cycle + 1, 0)):
            if self.moves and not self.answered:
                self.v = self.v + self.a * CYCLE
            self.course.append(self.v)
            self.q = self.q + self.v * CYCLE
            self.cycle, self.answered = self.cycle + 1, False
        self.now = max(self.now, self.cycle * CYCLE) + self.late.get(self.cycle, 0.0)
        self.at.get(self.cycle, lambda: None)()

    # As the clock of the machine.

    def monotonic(self):
        return self.now

    def perf_counter(self):
        self.now += self.slow.get(self.cycle, 1e-4)
        return self.now

    def sleep(self, duration):
        for _ in range(round(duration / CYCLE)):
            self._advance()


@pytest.fixture
def box(monkeypatch):
    box = Box()
    monkeypatch.setattr(franka_loop, "time", box)
    monkeypatch.setattr(franka_loop, "import_pylibfranka", lambda: box)
    monkeypatch.setattr(os, "sched_setscheduler", box.schedule)
    return box


def run(box, cycles, config=CONFIG):
    """Run the loop for so many cycles, then end it."""
    before = box.at.get(cycles, lambda: None)
    box.at[cycles] = lambda: (before(), box.order(end=True))
    loop(box, config).run()
    assert box.report.phase == Phase.ENDED


def loop(box, config=CONFIG):
    with shapes_unchecked():
        runner = step_of(fr3, config)()
    return franka_loop.ControlLoop(box.shared, "arm", config, runner, os.getppid())


def within_limits(box, share=1.0):
    """True if what the box commanded keeps a share of the limits, by finite differences."""
    v = np.array(box.course)
    a, j = np.diff(v, axis=0) / CYCLE, np.diff(v, 2, axis=0) / CYCLE**2
    return (
        bool((np.abs(v) <= LIMITS.velocity.numpy()).all())
        and bool((np.abs(a) <= 1.001 * share * LIMITS.acceleration.numpy()).all())
        and bool((np.abs(j) <= 1.001 * share * LIMITS.jerk.numpy()).all())
    )


def test_a_velocity_is_followed_until_it_runs_out_and_the_motion_ends_at_rest(box):
    seen = {}
    box.command(range(10, 300, 20))
    held = 290 + TIMEOUT
    for k in (5, 200, held + 300):
        box.at[k] = lambda k=k: seen.update({k: (box.report, box.q)})
    run(box, held + 301)
    course = np.array(box.course)
    np.testing.assert_allclose(course[200:held], np.tile(WANTED, (held - 200, 1)), atol=1e-9)
    assert (np.abs(course[held + 5]) < np.abs(WANTED)).all()
    assert within_limits(box, CONFIG.dynamics)
    cycles, velocities, finished = zip(*box.answers, strict=True)
    assert cycles == tuple(range(cycles[0], cycles[-1] + 1))
    assert 11 <= cycles[0] <= 12
    # Rest is sent twice, so that the acceleration ends at zero, and the second time ends it.
    rests = np.abs(velocities).max(axis=1) < 1e-6
    assert finished == (False,) * (len(finished) - 1) + (True,)
    assert rests[-2:].all()
    assert not rests[1:-2].any()
    assert box.calls.count(("motion",)) == 1
    before, moving, after = (seen[k][0] for k in (5, 200, held + 300))
    assert [r.phase for r in (before, moving, after)] == [Phase.IDLE, Phase.MOVING, Phase.IDLE]
    assert [r.resting for r in (before, moving, after)] == [True, False, True]
    assert after.cycles == len(cycles)
    assert after.lost == after.faults == 0
    assert after.cost == pytest.approx(2e-4)  # two looks at the clock since the reading
    assert moving.time == pytest.approx(0.199)
    assert moving.stamp == pytest.approx(0.199, abs=1e-3)
    np.testing.assert_allclose(moving.joint_velocity, WANTED, atol=1e-9)
    np.testing.assert_allclose(moving.external_torque, moving.joint_position + 1)
    np.testing.assert_allclose(moving.joint_position, seen[200][1], atol=2e-4)


@pytest.mark.long
@pytest.mark.parametrize("order", ["stop", "end", "parent"])
def test_a_motion_is_braked_to_rest_by_an_order_and_by_the_death_of_the_commander(
    box, order, monkeypatch
):
    box.command(range(10, 600))
    if order == "parent":
        box.at[200] = lambda: monkeypatch.setattr(os, "getppid", lambda: -1)
    else:
        for k in range(200, 600):  # though the velocity is a fresh one
            box.at[k] = lambda: box.order(stamp=box.now, joint_velocity=WANTED, **{order: True})
    run(box, 600)
    last, velocity, finished = box.answers[-1]
    # From 0.1 rad/s with 3 rad/s^2 and its ramps; the parent is looked for each 50 cycles.
    assert 220 < last < 320
    assert finished
    assert np.abs(velocity).max() < 1e-6
    assert within_limits(box, CONFIG.dynamics)
    assert box.calls.count(("motion",)) == 1
    assert box.cycle == (601 if order == "stop" else last)


def test_a_loop_at_rest_ends_with_its_commander(box, monkeypatch):
    box.at[20] = lambda: monkeypatch.setattr(os, "getppid", lambda: -1)
    run(box, 600)
    assert box.cycle == 20


@pytest.mark.long
def test_after_lost_cycles_the_answers_go_on_from_what_the_box_has(box):
    box.command(range(10, 400, 20))
    # In the first ramp, at constant velocity, and as it turns round.
    box.command(range(210, 400, 20), -WANTED)
    box.skipped = {40: 2, 150: 5, 230: 3}
    run(box, 400)
    assert within_limits(box)
    assert box.report.lost == 2 + 5 + 3
    assert box.report.cycles == len(box.answers)


@pytest.mark.long
@pytest.mark.parametrize("lockstep", [False, True])
def test_an_answer_that_would_come_too_late_is_not_given_but_to_a_simulator(box, lockstep):
    box.command(range(10, 300))
    box.late, box.slow = {150: 4e-3}, {200: 1.2e-3}
    run(box, 300, replace(CONFIG, lockstep=lockstep))
    answered = {cycle for cycle, *_ in box.answers}
    assert ({150, 200} <= answered) == lockstep
    assert {149, 151, 199, 201} <= answered
    assert box.report.lost == (0 if lockstep else 2)
    assert within_limits(box)


ADVICE = {
    ControlError: "nothing touches the arm, then call recover()",
    CommandError: "activate FCI, then call recover()",
    NetworkError: "recover(), which connects again",
    ValueError: "Call recover() to try again",
}


@pytest.mark.parametrize("kind", ADVICE)
def test_a_fault_is_explained_and_the_arm_moves_again_once_recovered(box, kind):
    seen = {}
    box.command([*range(10, 101), 300])

    def fails():
        box.order(stamp=box.now, joint_velocity=WANTED)
        box.failure = kind("reflex.")

    def heals():
        """A connection that was lost stays lost; a stop button is released."""
        box.failure = box.failure if kind is NetworkError else None
        box.order(recoveries=1, stamp=0.1, joint_velocity=WANTED)

    box.at |= {100: fails, 140: lambda: seen.update({140: box.report})}
    box.at |= {150: heals, 200: lambda: seen.update({200: box.report})}
    run(box, 320)
    faulted, recovered = seen[140], seen[200]
    assert faulted.phase == Phase.FAULTED
    assert (faulted.resting, faulted.faults, faulted.recoveries) == (True, 1, 0)
    # It is read on where there is a connection.
    assert faulted.time == pytest.approx(0.099 if kind is NetworkError else 0.139)
    text = box.shared.message
    assert text.startswith(f"{kind.__name__}: reflex. The arm is stopped by its control box. ")
    assert text.endswith(f"{ADVICE[kind]}.")
    assert (recovered.phase, recovered.recoveries) == (Phase.IDLE, 1)
    assert recovered.faults == 1
    connections = box.calls.count(("Robot", "arm", "ignore"))
    assert connections == (2 if kind is NetworkError else 1)
    # What was wanted before the fault is forgotten; the settings are sent again.
    assert not [cycle for cycle, *_ in box.answers if 100 <= cycle <= 300]
    assert [cycle for cycle, *_ in box.answers if cycle > 300]
    sent = [call for call in box.calls if call[0] == "set_collision_behavior"]
    assert len(sent) == 2


def test_a_recovery_that_fails_says_why_and_may_be_asked_for_again(box):
    box.at = {
        20: lambda: (box.command([21]), setattr(box, "failure", CommandError("pressed."))),
        40: lambda: box.order(recoveries=1),
        60: lambda: (setattr(box, "failure", None), box.order(recoveries=2)),
    }
    seen = {}
    box.at[50] = lambda: seen.update(report=box.report, text=box.shared.message)
    run(box, 80)
    assert seen["report"].phase == Phase.FAULTED
    assert (seen["report"].faults, seen["report"].recoveries) == (2, 1)
    assert seen["text"].startswith("CommandException: pressed. The arm is stopped")
    assert (box.report.faults, box.report.recoveries) == (2, 2)


def test_the_settings_that_connecting_sends_are_those_of_the_configuration(box):
    load = Load(mass=0.4, centre=(0.0, 0.1, 0.2), inertia=((5, 1, 2), (1, 8, 3), (2, 3, 9)))
    collision = CollisionConfig(torque=(1, 2, 3, 4, 5, 6, 7), force=(1, 2, 3, 4, 5, 6))
    franka_loop.connect("arm", replace(CONFIG, realtime=True, load=load, collision=collision))
    torque, force = [1, 2, 3, 4, 5, 6, 7], [1, 2, 3, 4, 5, 6]
    assert box.calls == [
        ("Robot", "arm", "enforce"),
        ("automatic_error_recovery",),
        ("set_collision_behavior", torque, torque, force, force),
        ("set_load", 0.4, [0.0, 0.1, 0.2], [5, 1, 2, 1, 8, 3, 2, 3, 9]),
    ]


def test_realtime_that_is_missing_is_an_error_only_where_it_is_needed(box, monkeypatch):
    def forbidden(*_):
        raise PermissionError

    def without(*_):
        raise RealtimeMissing("no kernel for it.")

    needed = replace(CONFIG, realtime=True)
    with monkeypatch.context() as patch:
        patch.setattr(os, "sched_setscheduler", forbidden)
        franka_loop.connect("arm", CONFIG)
        with pytest.raises(RealtimeError, match="this user may not have realtime priority: "):
            franka_loop.connect("arm", needed)
    monkeypatch.setattr(box, "Robot", without)
    with pytest.raises(RealtimeError, match="no kernel for it: boot a kernel"):
        franka_loop.connect("arm", needed)


def test_the_process_ends_on_a_signal_and_says_why_it_cannot_begin(box, monkeypatch):
    handlers, collector = {}, []
    monkeypatch.setattr(signal, "signal", handlers.__setitem__)
    names = ("collect", "freeze", "disable")
    quiet = {name: lambda name=name: collector.append(name) for name in names}
    monkeypatch.setattr(franka_loop, "gc", SimpleNamespace(**quiet))

    def cannot():
        raise OSError("no such step")

    franka_loop.serve(box.shared, "arm", CONFIG, cannot, os.getppid())
    assert box.shared.message == "OSError: no such step"
    assert (box.report.phase, box.report.faults) == (Phase.ENDED, 1)
    assert handlers == {signal.SIGINT: signal.SIG_IGN}
    box.command(range(10, 400))
    box.at[200] = lambda: handlers[signal.SIGTERM](signal.SIGTERM, None)
    franka_loop.serve(box.shared, "arm", CONFIG, step_of(fr3, CONFIG), os.getppid())
    assert box.report.phase == Phase.ENDED
    assert box.answers[-1][2]
    assert 220 < box.cycle < 300
    assert collector == list(names)


@pytest.mark.long
def test_the_far_end_of_a_load_keeps_the_cap_on_the_tool():
    """By finite differences of the point, 0.5 m beyond the flange, as the wrist turns."""
    far_end = torch.tensor([0.1, 0.0, 0.5, 1.0], dtype=torch.float64)

    def fastest(load):
        safety = SafetyConfig(tcp_speed=0.25)
        runner = step_of(fr3, replace(CONFIG, safety=safety, load=load))()
        q, points = fr3.ready.clone(), []
        runner.start(q.numpy())
        runner.observation["stop"][...] = False
        runner.observation["joint_velocity"][:] = 2.0 * np.eye(7)[5]
        for _ in range(400):
            runner.observation["joint_position"][:] = q.numpy()
            q = q + CYCLE * torch.from_numpy(np.array(runner.step()))
            flange = fr3.forward(q).matrix() @ fr3.tcp.inverse()
            points.append((flange @ far_end)[:3])
        return float(torch.stack(points).diff(dim=0).norm(dim=-1).max()) / CYCLE

    assert fastest(Load(far_end=tuple(far_end[:3].tolist()))) == pytest.approx(0.25, rel=0.02)
    assert fastest(Load()) > 0.4


def test_a_velocity_holds_to_just_before_its_time_and_not_from_before_a_recovery(box):
    """In binary fractions of a second, so that the clock is exact."""
    cycles = loop(box, replace(CONFIG, timeout=0.25))
    box.now = 10.0
    for stamp, recovered, holds in (
        (9.75, -np.inf, False),
        (9.75 + 2**-20, -np.inf, True),
        (10.0, 10.0, False),
        (10.0, 10.0 - 2**-20, True),
    ):
        box.order(stamp=stamp, joint_velocity=WANTED)
        cycles._read_orders()
        cycles._recovered = recovered
        np.testing.assert_array_equal(cycles._wanted(), WANTED if holds else np.zeros(7))


def test_the_step_is_warm_before_the_arm_waits_for_it(box):
    steps = []
    with shapes_unchecked():
        runner = step_of(fr3, CONFIG)()
    step = runner.step

    def counted():
        assert not box.calls, "the arm is connected already"
        steps.append(bool(runner.observation["stop"]))
        return step()

    runner.step = counted
    franka_loop.ControlLoop(box.shared, "arm", CONFIG, runner, os.getppid())
    assert steps == [True] * 20
    assert box.calls


def test_a_stopped_arm_without_a_connection_is_asked_a_hundred_times_a_second(box):
    box.command([10])
    box.at[20] = lambda: (box.command([21]), setattr(box, "failure", NetworkError("gone.")))
    slept, sleep = [], box.sleep

    def counted(duration):
        slept.append(duration)
        sleep(duration)

    box.sleep = counted
    run(box, 60)
    assert slept == [0.01] * len(slept)
    assert len(slept) >= 3


def test_an_arm_of_which_one_joint_moves_does_not_rest(box):
    seen = {}
    box.command(range(10, 80, 20), 0.1 * np.eye(7)[3])
    box.at[75] = lambda: seen.update(report=box.report)
    run(box, 80)
    assert not seen["report"].resting
    assert seen["report"].phase == Phase.MOVING
    assert box.calls.count(("motion",)) == 1
    assert not any(end for _, velocity, end in box.answers if np.abs(velocity).max() > 1e-6)


@pytest.mark.parametrize("far_end", [None, (0.05, -0.02, 0.2)])
def test_the_far_end_of_a_load_is_given_to_the_filter_in_the_frame_of_the_tool(far_end):
    """Configured in the frame of the flange: both describe one point of the gripper."""
    load = None if far_end is None else Load(far_end=far_end)
    runner = step_of(panda, FrankaConfig(compiled=False, load=load))()
    if far_end is None:
        assert "load" not in runner.observation
    else:
        tool = np.append(runner.observation["load"], 1.0)
        np.testing.assert_allclose((panda.tcp.numpy() @ tool)[:3], far_end, atol=1e-12)
