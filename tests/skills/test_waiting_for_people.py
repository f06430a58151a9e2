"""Motions that slow down before people, wait for them, and go on where they were."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from obedient_arm import ObedientArm
from unchecked import shapes_unchecked

from hrc_learn.controller import SafetyConfig, SeparationConfig, WayMakingConfig
from hrc_learn.geometry import Pose
from hrc_learn.kinematics import panda, separation
from hrc_learn.protocols import HumanInput, PersonObservation
from hrc_learn.sim import whole_arm
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills import TaskFailedError, WorkCell, WorkCellConfig, joint_line
from hrc_learn.skills.person_watch import PersonWatch
from hrc_learn.teleoperation import ScriptedPerturbation

pytestmark = pytest.mark.simulation

ARM = whole_arm(Workplace().scene.arm)
SEPARATION = SeparationConfig(reaction_time=0.03, clearance=0.08)
START = Workplace().hover_joints()
RADIUS = 0.10


class Visitor:
    """A ball of the size of a head that stands somewhere for a while [m, s]."""

    def __init__(self, place, begin, end):
        self._place, self._begin, self._end = np.asarray(place), begin, end
        self.clock = lambda: 0.0

    def at(self, time):
        here = self._begin <= time < self._end
        return np.broadcast_to(self._place if here else self._place + 9.0, (1, 2, 3)).copy()

    def read(self):
        ends = self.at(self.clock())
        return PersonObservation(
            time=self.clock(),
            ends=ends,
            radius=np.array([RADIUS]),
            velocity=np.zeros_like(ends),
        )


@pytest.fixture(autouse=True)
def quick():
    """A step has hundreds of shapes, and other tests check them."""
    with shapes_unchecked():
        yield


def cell_beside(tracker, start=START, **config):
    arm = ObedientArm(start.numpy())
    tracker.clock = lambda: arm.time
    return WorkCell(
        chain=panda,
        arm=arm,
        gripper=arm,
        human=ScriptedPerturbation(panda, ()),
        advance=arm.advance,
        config=WorkCellConfig(safety=SafetyConfig(separation=SEPARATION), **config),
        watch=PersonWatch(tracker, ARM, SEPARATION),
    )


def distances(cell, visitor):
    """At each step, of the arm as it was [m]."""
    found = []
    for time, q in zip(cell.log["time"], cell.log["joint_position"], strict=True):
        ends = torch.from_numpy(visitor.at(time))
        radius = torch.tensor([RADIUS], dtype=torch.float64)
        found.append(float(separation(ARM, torch.from_numpy(q), ends, radius).distance.min()))
    return np.array(found)


def sideways(by):
    """Of the arm's first pose."""
    here = panda.forward(panda.ready)
    return Pose(here.position + torch.tensor([0.0, by, 0.0]).double(), here.orientation)


def follow(cell):
    """A path that turns the arm about its base."""
    goal = panda.ready.clone()
    goal[0] += 0.8
    cell.follow_path(joint_line(panda.ready, goal, speed=0.8, dt=0.01).numpy())


def straight(cell):
    cell.move_straight(sideways(0.25), speed=0.2)


def beside(tracker, **config):
    return cell_beside(tracker, panda.ready, **config)


IN_THE_WAY = sideways(0.35).position.numpy()


@pytest.mark.long
@pytest.mark.parametrize("move", [follow, straight])
def test_the_arm_waits_before_who_stands_in_its_way_and_goes_on_when_they_have_left(move):
    free = beside(Visitor(IN_THE_WAY, 0.0, 0.0))
    move(free)
    visitor = Visitor(IN_THE_WAY, 0.0, 3.0)
    cell = beside(visitor)
    move(cell)
    # It came near, kept its distance while it did, and rested.
    time, apart = cell.log["time"], distances(cell, visitor)
    there = time < 3.0
    assert SEPARATION.clearance - 1e-4 <= apart[there].min() < SEPARATION.clearance + 0.05
    speed = np.linalg.norm(cell.log["joint_velocity"], axis=1)
    assert speed[(time > 2.5) & there].max() < 0.02
    # Then it went on where it was, and did nothing else than it does with nobody there.
    torch.testing.assert_close(cell.joints, free.joints, rtol=0, atol=5e-3)
    ways = [torch.from_numpy(c.log["joint_position"]) for c in (free, cell)]
    tips = [panda.forward(q).position for q in ways]
    assert torch.cdist(tips[1], tips[0]).amin(-1).max() < 5e-3
    assert cell.task_time == pytest.approx(free.task_time, abs=0.15)
    assert free.task_time == pytest.approx(free.time, abs=1e-9)
    assert cell.time > 3.0
    assert cell.log["pace"].min() < 0.01
    assert (free.log["pace"] == 1.0).all()
    # It gets under way within 0.2 s, not at once.
    assert np.diff(cell.log["pace"]).max() == pytest.approx(0.01 / 0.2)
    # Nobody was closed in on faster than the protective distance allows: people may set out
    # at any time, so fast within the time of reaction.
    closing = -np.diff(apart) / np.diff(time)
    near = there[1:] & (closing > 0.02)
    assert near.sum() > 20
    v, a, T = closing[near], SEPARATION.deceleration, SEPARATION.reaction_time
    needed = 3.0 * T * (T + v / a) + v * T + v**2 / (2 * a) + SEPARATION.clearance
    assert (apart[:-1][near] - needed).min() > -2e-3
    assert (cell.log["separation_margin"][:-1][near] > -2e-3).all()
    np.testing.assert_allclose(cell.log["person_distance"], apart, atol=1e-9)


class Follower(Visitor):
    """Somebody who runs after the gripper, faster than it moves away [m/s]."""

    SPEED = 1.2

    def at(self, time):
        place = self._place + np.array([0.0, self.SPEED * min(time, self._end), 0.0])
        return np.broadcast_to(place, (1, 2, 3)).copy()

    def read(self):
        velocity = np.broadcast_to([0.0, self.SPEED, 0.0], (1, 2, 3)).copy()
        return replace(super().read(), velocity=velocity)


@pytest.mark.long
def test_an_arm_that_moves_away_rests_by_the_time_that_somebody_catches_up_with_it():
    visitor = Follower(sideways(-1.3).position.numpy(), 0.0, 1.3)
    cell = beside(visitor)
    goal = panda.ready.clone()
    goal[0] += 0.8
    path = joint_line(panda.ready, goal, speed=0.8, dt=0.01).numpy()
    cell.follow_path(path, until=lambda: cell.time >= visitor._end)
    apart, speed = distances(cell, visitor), np.linalg.norm(cell.log["joint_velocity"], axis=1)
    assert speed.max() > 0.5
    assert apart[-1] < 0.05
    assert speed[apart < 0.05].max() < 0.05
    # The path waits, and does not run away from the arm.
    assert cell.log["pace"][apart < 0.2].max() < 0.9


@pytest.mark.long
def test_a_task_is_given_up_when_nobody_frees_the_way():
    cell = beside(Visitor(IN_THE_WAY, 0.0, 99.0), longest_wait=0.5)
    with pytest.raises(TaskFailedError, match="in the way"):
        follow(cell)
    assert 1.0 < cell.time < 5.0


@pytest.mark.long
def test_limits_of_the_arm_itself_are_not_waited_for():
    """Out of reach, where lines lead past what the joints can do."""
    cell = beside(Visitor(IN_THE_WAY, 0.0, 0.0))
    cell.move_straight(sideways(1.2), speed=0.4)
    assert cell.log["safety"].any()
    assert cell.task_time == pytest.approx(cell.time, abs=1e-9)


def test_an_arm_that_does_not_know_where_people_are_rests():
    cell = beside(SimpleNamespace(read=lambda: None))
    begun = cell.joints.clone()
    for _ in range(50):
        cell.step(torch.full((7,), 0.2, dtype=torch.float64))
    torch.testing.assert_close(cell.joints, begun, rtol=0, atol=1e-3)
    assert cell.task_time < 0.1


@pytest.mark.long
@pytest.mark.parametrize(("mode", "moves"), [("expert", False), ("both", True)])
def test_the_null_space_makes_way_by_itself_if_it_is_told_to(mode, moves):
    """Of somebody who stands beside the forearm, while the end effector is held."""
    elbow, wrist = panda.joint_origins(START)[3:5].numpy()
    side = np.cross([0.0, 0.0, 1.0], wrist - elbow)
    visitor = Visitor((elbow + wrist) / 2 + 0.3 * side / np.linalg.norm(side), 0.0, 9.0)
    cell = cell_beside(visitor, way_making=WayMakingConfig(mode=mode))
    here, pose = panda.joint_origins(cell.joints)[3], cell.pose
    cell.hold_pose(2.0)
    moved = float((panda.joint_origins(cell.joints)[3] - here).norm())
    assert (moved > 5e-3) == moves
    apart = distances(cell, visitor)
    assert apart[-1] > apart[0] + (4e-3 if moves else -1e-3)
    torch.testing.assert_close(cell.pose.position, pose.position, rtol=0, atol=2e-3)


@pytest.mark.parametrize("mode", ["none", "automatic"])
def test_a_mode_without_the_expert_does_not_follow_who_pushes(mode):
    cell = cell_beside(Visitor(np.zeros(3), 0.0, 0.0), way_making=WayMakingConfig(mode=mode))
    push = HumanInput(nullspace_input=np.full(7, 3.0))
    cell.human = SimpleNamespace(read=lambda state: push, tell=lambda feedback: None)
    cell.hold_pose(0.2)
    assert not cell.log["nullspace_input"].any()
