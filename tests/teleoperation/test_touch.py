"""A person who pushes the arm itself, felt in its external torques.

Forces are those that the simulator applies to its bodies: they are the oracle.
"""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.stats import multivariate_normal

from hrc_learn.kinematics import panda
from hrc_learn.protocols import ArmState, Feedback, Human, HumanInput
from hrc_learn.sim import Imperfections, World
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills import StoppedByPersonError, WorkCell, WorkCellConfig, joint_line
from hrc_learn.teleoperation import CombinedInput, Touch, TouchConfig
from hrc_learn.teleoperation.touch import TorqueBias, explain, log_density

pytestmark = [pytest.mark.simulation, pytest.mark.long]

WORKPLACE = Workplace()
NOMINAL = Imperfections.nominal()


def samples(seed=0):
    rng = np.random.default_rng(seed)
    q = torch.from_numpy(panda.ready.numpy() + 0.2 * rng.standard_normal(7))
    return rng, q, panda.jacobian(q).numpy(), panda.joint_jacobian(q, 4).numpy()[:3]


def test_the_evidence_of_loads_is_a_normal_density():
    rng, _, J, elbow = samples()
    noise = rng.standard_normal((7, 7))
    unknown = noise @ noise.T + np.eye(7)
    torque = rng.standard_normal(7)
    for rows, spread in ((elbow.T, np.full(3, 20.0)), (J.T, np.array([20.0] * 3 + [2.0] * 3))):
        covariance = rows @ np.diag(spread**2) @ rows.T + unknown
        expected = multivariate_normal.logpdf(torque, cov=covariance)  # pyright: ignore[reportArgumentType]
        found = explain(torque, rows, spread, unknown)
        assert found.evidence - 3.5 * np.log(2 * np.pi) == pytest.approx(expected)
        # The most likely load: the minimum of what it costs, by its normal equations.
        weight = np.linalg.inv(unknown)
        system = rows.T @ weight @ rows + np.diag(1 / spread**2)
        load = np.linalg.solve(system, rows.T @ weight @ torque)
        np.testing.assert_allclose(found.force, load[:3])
        assert found.size == pytest.approx(np.linalg.norm(load[:3]))
    none = multivariate_normal.logpdf(torque, cov=unknown)  # pyright: ignore[reportArgumentType]
    assert log_density(torque, unknown) - 3.5 * np.log(2 * np.pi) == pytest.approx(none)


def test_a_bias_learns_load_offsets_and_friction():
    rng, q, _, _ = samples()
    bias = TorqueBias(7, 0.3)
    weight, offset = 4.0, 0.4 * rng.standard_normal(7)
    friction = rng.uniform(0.3, 1.3, 7)
    rest = []
    for k in range(3000):
        phase = 0.01 * k * np.linspace(0.6, 1.4, 7)
        J = panda.jacobian(q + torch.from_numpy(0.4 * np.sin(phase))).numpy()
        velocity = 0.4 * np.linspace(0.6, 1.4, 7) * np.cos(phase)
        torque = -weight * J[2] + offset - friction * np.sign(velocity)
        expected, covariance = bias.expected(J, velocity)
        slides = np.abs(velocity) > 0.1
        rest.append(np.abs(np.where(slides, torque - expected, 0.0)).max())
        deviation = np.sqrt(np.diag(covariance))
        bias.follow(J, velocity, torque + 0.2 * rng.standard_normal(7), 0.01)
    assert np.percentile(rest[-600:], 95) < 0.2
    assert rest[0] > 0.5
    # It knows that friction of a joint at rest is unknown, and what that may be.
    _, moving = bias.expected(J, np.full(7, 0.5))
    _, still = bias.expected(J, np.zeros(7))
    unknown = np.sqrt(np.diag(still) - np.diag(moving))
    np.testing.assert_allclose(bias.state[8:], friction, atol=0.2)
    np.testing.assert_allclose(unknown, 0.7 * bias.state[8:], atol=0.04)
    assert deviation.min() >= 0.3


class Person:
    """Pushes a body of the simulated arm with a force that comes and goes within 0.3 s."""

    def __init__(self, world, where, force, start, duration, rise=0.3):
        self._data, self._where, self._force = world.data, where, force
        self._body = world.model.body({"elbow": "link4", "hand": "hand"}[where]).id
        self._start, self._end, self._rise = start, start + duration, rise

    def apply(self):
        data, body = self._data, self._body
        edge = min(data.time - self._start, self._end - data.time) / self._rise
        force = np.clip(edge, 0.0, 1.0) * np.asarray(self._force)
        at = data.xpos[body] if self._where == "elbow" else data.site("tcp").xpos
        data.xfrc_applied[body, :3] = force
        data.xfrc_applied[body, 3:] = np.cross(at - data.xipos[body], force)


class Noting(Human):
    """Passes touch on, and keeps what it said."""

    def __init__(self, config=None):
        self._touch, self.rows = Touch(panda, config), []

    def read(self, state):
        asked = self._touch.read(state)
        self.rows.append((state.time, self._touch.place, asked.pause, asked.stop))
        return asked

    def tell(self, feedback):
        self._touch.tell(feedback)

    def moments(self, place):
        return np.array([row[0] for row in self.rows if row[1] == place])

    def pauses(self):
        return np.array([row[0] for row in self.rows if row[2]])


class OverError(Exception):
    """The run has shown what it is for."""


def at_work(seed, pushes=(), end=math.inf):
    """A cell with an arm that nobody but the person touches, at home, until a time [s]."""
    world = World(WORKPLACE.scene, NOMINAL.draw(np.random.default_rng(seed)))
    home = WORKPLACE.home_joints().numpy()
    world.hold(WORKPLACE.scene.objects[0].name, home)
    people, human = [Person(world, *push) for push in pushes], Noting()

    def advance(duration):
        if world.time > end:
            raise OverError
        for person in people:
            person.apply()
        world.advance(duration)

    cell = WorkCell(
        chain=panda,
        arm=world.arm,
        gripper=world.arm,
        human=human,
        advance=advance,
        config=WorkCellConfig(
            safety=NOMINAL.plant(WorkCellConfig().safety), command_delay=NOMINAL.following_delay
        ),
        clearance=WORKPLACE.arm_clearance,
    )
    return world, cell, human


def along_a_path(cell, duration=3.0):
    """Along a path of the joints, as tasks have them."""
    far = cell.joints + torch.tensor([0.3, 0.1, -0.1, 0.2, 0.1, 0.1, 0.2]).double()
    speed = 1.875 * 0.3 / duration
    cell.follow_path(joint_line(cell.joints, far, speed=speed, dt=0.01).numpy())


def off_path(cell):
    """Of elbow and hand at each step on a path, and its time [m, m, s]."""
    log = cell.log
    on = np.isfinite(log["path_joints"][:, 0])
    q, goal = (torch.from_numpy(log[k][on]) for k in ("joint_position", "path_joints"))
    elbow = (panda.joint_origins(q) - panda.joint_origins(goal))[:, 3].norm(dim=-1)
    hand = (panda.forward(q).position - panda.forward(goal).position).norm(dim=-1)
    return elbow.numpy(), hand.numpy(), log["time"][on]


def beside_path(cell):
    """Of the hand at each step from the nearest point of its path [m]."""
    log = cell.log
    on = np.isfinite(log["path_joints"][:, 0])
    hand, path = (
        panda.forward(torch.from_numpy(log[k][on])).position
        for k in ("joint_position", "path_joints")
    )
    return torch.cdist(hand, path).amin(-1).numpy()


def aside(q, size):
    """A force on the elbow along the way that the null space lets it go [N]."""
    way = (
        panda.joint_jacobian(q, 4).numpy()[:3] @ np.linalg.svd(panda.jacobian(q).numpy())[2][6]
    )
    return size * way / np.linalg.norm(way) * np.sign(way[np.abs(way).argmax()])


def test_pushed_elbow_moves_and_hand_goes_on():
    push = aside(WORKPLACE.home_joints(), 20.0)
    _, cell, human = at_work(1, [("elbow", push, 0.5, 1.5)])
    along_a_path(cell, 3.5)
    elbow, hand, _ = off_path(cell)
    assert elbow.max() > 0.1
    assert np.percentile(hand, 95) < 2e-3
    felt = human.moments("elbow")
    assert 0.5 < felt.min() < 1.0
    assert felt.max() < 2.6
    assert not len(human.moments("hand"))
    assert not len(human.pauses())
    assert elbow[-1] < 0.01  # and it comes back


def test_task_waits_while_hand_is_held():
    _, cell, human = at_work(2, [("hand", (14.0, 14.0, 0.0), 1.0, 1.6)])
    along_a_path(cell, 3.0)
    paused = human.pauses()
    assert 1.0 < paused.min() < 1.4
    assert 2.5 < paused.max() < 3.3
    assert not len(human.moments("elbow"))
    # It stands while it is held, and keeps to the path before, meanwhile and after. Along it
    # the arm, which follows 30 ms late, goes on by as much when the task stops.
    time, speed = cell.log["time"], np.abs(cell.log["command_velocity"]).max(axis=1)
    assert speed[(time > 1.8) & (time < 2.5)].max() < 0.02
    assert speed[time > paused.max() + 0.3].max() > 0.1
    assert beside_path(cell).max() < 2.5e-3
    assert off_path(cell)[1].max() < 8e-3
    waited = cell.time - cell.task_time
    assert waited == pytest.approx(paused.max() - paused.min(), abs=0.05)
    assert [remark.text for remark in cell.remarks] == ["The task waits.", "The task goes on."]


def test_a_push_that_begins_like_one_at_the_elbow_turns_out_as_one_at_the_hand():
    _, cell, human = at_work(202, [("hand", (16.2, -6.5, -9.7), 1.3, 1.6)], end=2.9)
    with pytest.raises(OverError):
        along_a_path(cell, 4.0)
    felt = [place for time, place, *_ in human.rows if 1.3 < time < 2.9]
    assert "elbow" in felt  # what it begins like: else this test shows nothing
    first = felt.index("hand")
    assert set(felt[first : first + 100]) == {"hand"}
    assert 1.3 < human.pauses().min() < 1.9
    elbow, _, _ = off_path(cell)
    assert elbow.max() < 0.01


def test_a_collision_stops_the_arm_for_good():
    world, cell, _ = at_work(3, [("hand", (0.0, 70.0, 0.0), 1.0, 5.0, 0.02)])
    with pytest.raises(StoppedByPersonError, match=r"something has hit the arm, with \d+ N"):
        along_a_path(cell)
    assert 1.0 < cell.time < 1.6
    assert np.abs(world.data.qvel[:7]).max() < 0.01


def test_what_the_gripper_meets_is_no_person():
    """It feels for the table with an object between its fingers, presses it there, lets go."""
    world, cell, human = at_work(4)
    world.hold(WORKPLACE.scene.objects[0].name, WORKPLACE.hover_joints().numpy())
    cell.hold_pose(0.3)
    low = replace(cell.pose, position=cell.pose.position.clone())
    low.position[2] = world.table_top + 0.06
    cell.move_straight(low, speed=0.5)
    low.position[2] -= 0.08
    met = cell.move_until_contact(low, speed=0.04)
    assert met is not None
    world.arm.move(0.08)
    cell.hold_pose(0.5)
    low.position[2] += 0.1
    cell.move_straight(low, speed=0.15)
    assert not len(human.pauses())
    assert not any(row[3] for row in human.rows)
    assert not len(human.moments("elbow"))


def reading(time, torque, width=0.08):
    return ArmState(
        time=time,
        joint_position=panda.ready.numpy(),
        joint_velocity=np.zeros(7),
        gripper_width=width,
        external_torque=torque,
    )


def test_an_arm_without_torques_feels_nothing():
    asked = Touch(panda).read(replace(reading(0.0, None), external_torque=None))
    assert not asked.nullspace_input.any()
    assert not asked.pause
    assert asked.stop == ""


def leaned_on(touch, force, seconds, begin=0.0, jacobian=None, told=None):
    """Readings of an arm at rest that is pushed at the end of a second; the last input."""
    J = panda.jacobian(panda.ready).numpy()[:3] if jacobian is None else jacobian
    asked = HumanInput()
    for k in range(round(100 * seconds)):
        t = begin + 0.01 * k
        if told is not None:
            touch.tell(told)
        share = min(max((t - 1.0) / 0.3, 0.0), 1.0)
        asked = touch.read(reading(t, share * (J.T @ np.asarray(force))))
    return asked


def test_who_leans_on_the_hand_for_long_is_taken_for_a_load():
    touch = Touch(panda, TouchConfig(longest_touch=3.0))
    assert leaned_on(touch, (0.0, 0.0, -20.0), 3.0).pause
    touch = Touch(panda, TouchConfig(longest_touch=3.0))
    assert not leaned_on(touch, (0.0, 0.0, -20.0), 15.0).pause


def test_a_reading_that_comes_twice_counts_once():
    """As of an arm that is read faster than it reports, or whose clock stands still."""
    once, twice, rng = Touch(panda), Touch(panda), np.random.default_rng(0)
    for k in range(60):
        here = reading(
            0.01 * k, rng.normal(size=7) + (k > 30) * np.array([0, 0, 0, 20, 0, 0, 0])
        )
        expected, _ = once.read(here), twice.read(here)
        np.testing.assert_array_equal(
            twice.read(here).nullspace_input, expected.nullspace_input
        )
    assert once.place != "nothing"
    np.testing.assert_array_equal(twice.force, once.force)


def test_a_clock_that_is_set_back_is_that_of_another_run():
    touch = Touch(panda)
    assert leaned_on(touch, (0.0, 0.0, -20.0), 2.0).pause
    assert not touch.read(reading(0.0, np.zeros(7))).pause
    assert touch.place == "nothing"


def test_while_the_task_feels_its_way_the_hand_is_not_felt_but_the_elbow_is():
    expecting = Feedback(contact_expected=True)
    touch = Touch(panda)
    assert not leaned_on(touch, (0.0, 0.0, 30.0), 2.0, told=expecting).pause
    elbow = panda.joint_jacobian(panda.ready, 4).numpy()[:3]
    touch, push = Touch(panda), aside(panda.ready, 60.0)
    asked = leaned_on(touch, push, 2.0, jacobian=elbow, told=expecting)
    assert touch.place == "elbow"
    null = np.linalg.svd(panda.jacobian(panda.ready).numpy())[2][6]
    # Twice the torque that the force has in the null space, and nothing else.
    expected = 2.0 * null * (null @ (elbow.T @ push))
    np.testing.assert_allclose(asked.nullspace_input, expected, rtol=0.15, atol=0.05)


def test_however_slowly_it_comes_a_great_force_stops():
    asked = leaned_on(Touch(panda), (0.0, 150.0, 0.0), 2.0)
    assert "holds the arm with" in asked.stop


@pytest.mark.parametrize("name", ["elbow_force", "released", "collision_rise"])
def test_sizes_that_make_no_sense_are_refused(name):
    with pytest.raises(ValueError, match=name):
        TouchConfig(**{name: 0.0})  # pyright: ignore[reportArgumentType]


class Says(Human):
    def __init__(self, **asked):
        self._asked = asked

    def read(self, state):
        return HumanInput(**self._asked)


def test_any_of_several_sources_pauses_and_stops():
    state = reading(0.0, np.zeros(7))
    joined = CombinedInput(Says(), Says(pause=True), Says(stop="here"), Says(stop="there"))
    asked = joined.read(state)
    assert asked.pause
    assert asked.stop == "here"
    calm = CombinedInput(Says(), Says()).read(state)
    assert not calm.pause
    assert calm.stop == ""
