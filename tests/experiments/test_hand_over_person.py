"""Handing an object to the robot: what was shown, and a person who answers the robot's hand."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from unchecked import shapes_unchecked

from hrc_learn.experiments import surroundings
from hrc_learn.experiments.surroundings import (
    GivingPerson,
    _movements,
    shown_hand_overs,
    waiting_pose,
)
from hrc_learn.sim import Imperfections, ObjectConfig, Worker, WorkerConfig
from hrc_learn.sim.hand_over import HAND_OVER, random_hand_over
from hrc_learn.sim.workplace import Workplace

WORKPLACE, ITEM = Workplace(), ObjectConfig()
NOMINAL = Imperfections.nominal()


@pytest.mark.long
@shapes_unchecked()
def test_what_was_shown_tells_movements_of_other_people_apart(monkeypatch):
    monkeypatch.setattr(surroundings, "_VISITS", 15)
    model = shown_hand_overs(WORKPLACE, NOMINAL, ITEM)
    rng = np.random.default_rng(5)
    wait = waiting_pose(WORKPLACE).position.numpy()
    for _ in range(2):
        worker = Worker(WorkerConfig.draw(rng))
        plan = random_hand_over(
            worker, rng, bench=WORKPLACE.scene.table, thickness=ITEM.half_size[2]
        )
        for times, hand, robot, kind in _movements(plan, wait, NOMINAL, rng):
            told = model.observe(times, hand, 0.012)
            assert (told.kind == HAND_OVER) == (kind == HAND_OVER)
            if kind == HAND_OVER:
                np.testing.assert_allclose(robot[[0, -1]], [wait, plan.place])
                end = torch.tensor([told.duration], dtype=torch.float64)
                assert np.linalg.norm(told.robot(end)[0][0].numpy() - plan.place) < 0.08
            else:
                np.testing.assert_allclose(robot, np.broadcast_to(wait, robot.shape))


class StandIn:
    """What a person needs of a world."""

    def __init__(self):
        table, config = WORKPLACE.scene.table, WorkerConfig()
        self.config = SimpleNamespace(worker=config, table=table)
        self.time, self.held, self.carried = 0.0, False, []
        self.tool = np.eye(4)
        self.tool[:3, 3] = waiting_pose(WORKPLACE).position.numpy()
        self.arm = SimpleNamespace(tcp_pose=lambda: self.tool.copy())

    def move_worker(self, ends):
        self.ends = ends

    def carry(self, name, pose):
        self.carried.append((self.time, pose[:3, 3].copy()))

    def holds(self, name):
        return self.held


def lived(world, person, until):
    while world.time < until:
        world.time += 0.05
        person.update()


@pytest.fixture
def scene():
    world: Any = StandIn()
    with shapes_unchecked():
        yield world, GivingPerson(world, ITEM, np.random.default_rng(0))


def test_comes_when_asked_and_waits_for_the_robots_hand(scene):
    world, person = scene
    entrance = world.ends.copy()
    lived(world, person, 3.0)
    np.testing.assert_allclose(world.ends, entrance)
    person.begin(3.0)
    out = person.hand_over.reaches[-1].end
    assert out > 8.0
    lived(world, person, out + 2.0)
    # The robot has not come: the thing stays where it is held out.
    np.testing.assert_allclose(world.carried[-1][1], person.hand_over.place, atol=0.02)
    world.tool[:3, 3] = person.hand_over.place + np.array([0.0, -0.1, 0.03])
    lived(world, person, out + 5.0)
    np.testing.assert_allclose(world.carried[-1][1], world.tool[:3, 3], atol=0.02)
    # Held by the robot it is let go of, and from then on nobody moves it.
    world.held, count = True, len(world.carried)
    lived(world, person, out + 5.0 + 0.6)
    assert count < len(world.carried) < count + 10
    count = len(world.carried)
    lived(world, person, out + 20.0)
    assert len(world.carried) == count
    assert person.hand_over.carried[-1][1] < out + 6.0
    left = np.linalg.norm(world.ends[..., :2].mean((0, 1)) - person.hand_over.leaving)
    assert left < 0.3


def test_gives_up_where_nobody_comes(scene):
    world, person = scene
    person.begin(0.0)
    lived(world, person, person.hand_over.visit.end + 26.0)
    assert person.hand_over.carried[-1][1] == pytest.approx(world.time, abs=1.5)


def until(world, person, condition, most=60.0):
    """Time at which something happens first [s], within 0.05 s."""
    last = world.time + most
    while world.time < last:
        lived(world, person, world.time + 0.04)
        if condition():
            return world.time
    return None


@pytest.fixture
def waiting(scene):
    """The person holds the object out, and the robot rests where it was."""
    world, person = scene
    person.begin(0.0)
    lived(world, person, person.hand_over.visit.end + 1.0)
    return world, person


@pytest.mark.parametrize(("distance", "brought"), [(0.049, False), (0.051, True)])
def test_the_object_is_brought_to_a_hand_that_came_nearer_and_rests(waiting, distance, brought):
    world, person = waiting
    shown, moved = person.hand_over, world.time
    world.tool[1, 3] += distance
    at = until(world, person, lambda: person.hand_over is not shown, 2.0)
    assert (at is not None) == brought
    if brought:
        # It was seen to rest for half a second, two steps after it moved at the earliest.
        assert 0.5 < at - moved < 0.7


@pytest.mark.parametrize(("speed", "brought"), [(0.019, True), (0.021, False)])
def test_a_hand_rests_below_20_mm_per_s(waiting, speed, brought):
    world, person = waiting
    shown, start = person.hand_over, world.tool[1, 3]
    world.tool[1, 3] = start + 0.1
    for _ in range(40):
        world.time += 0.05
        world.tool[1, 3] += 0.05 * speed
        person.update()
    assert (person.hand_over is not shown) == brought


def test_a_grip_of_0_3_s_without_interruption_releases_the_object(waiting):
    world, person = waiting
    world.tool[1, 3] += 0.1
    shown = person.hand_over
    assert until(world, person, lambda: person.hand_over is not shown, 2.0)
    held_out = person.hand_over
    lived(world, person, held_out.visit.end + 0.2)
    for _ in range(4):
        world.held = True
        lived(world, person, world.time + 0.2)
        world.held = False
        lived(world, person, world.time + 0.1)
    assert person.hand_over is held_out
    world.held, begun = True, world.time
    at = until(world, person, lambda: person.hand_over is not held_out, 1.0)
    assert 0.3 < at - begun < 0.45


def test_the_object_is_held_out_for_25_s(waiting):
    world, person = waiting
    shown, end = person.hand_over, person.hand_over.visit.end
    at = until(world, person, lambda: person.hand_over is not shown)
    assert 25.0 < at - end < 25.1


@shapes_unchecked()
def test_movements_of_one_visit_are_those_of_its_person_in_the_trackers_images():
    """An ideal tracker sees where the hand is: the plan itself is the oracle."""
    rng, home = np.random.default_rng(3), waiting_pose(WORKPLACE).position.numpy()
    worker = Worker(WorkerConfig.draw(rng))
    plan = random_hand_over(
        worker, rng, bench=WORKPLACE.scene.table, thickness=ITEM.half_size[2]
    )
    found = _movements(plan, home, Imperfections.ideal(), np.random.default_rng(0))
    kinds = [reach.kind for reach in plan.reaches]
    assert [kind for *_, kind in found] == kinds
    for (time, hand, robot, kind), reach in zip(found, plan.reaches, strict=True):
        assert time[0] == 0.0
        assert len(time) == len(hand) == len(robot) >= 8
        steps = np.diff(time) * surroundings.IMAGE_RATE
        np.testing.assert_allclose(steps, np.round(steps), atol=1e-6)
        assert steps.min() > 0.5
        # The samples end before the hand arrives, by less than the fastest part of a second.
        assert time[-1] <= reach.end - reach.begin + 0.5
        met = plan.place if kind == HAND_OVER else home
        np.testing.assert_allclose(robot[0], home, atol=1e-9)
        np.testing.assert_allclose(robot[-1], met, atol=1e-9)
        # Half of a minimum jerk motion is done after half of its time, one side mirrors the
        # other (Flash and Hogan 1985).
        along = np.interp(time[-1] * np.array([0.25, 0.5, 0.75]), time, robot @ (met - home))
        along = (along - home @ (met - home)) / max((met - home) @ (met - home), 1e-12)
        if kind == HAND_OVER:
            assert along[1] == pytest.approx(0.5, abs=0.02)
            assert along[0] + along[2] == pytest.approx(1.0, abs=0.02)
            assert along[0] == pytest.approx(0.1035, abs=0.02)
