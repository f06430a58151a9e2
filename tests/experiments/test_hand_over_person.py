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
