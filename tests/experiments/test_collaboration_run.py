"""A collaboration around a task that a stand-in does: people, cameras, phases, result."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from unchecked import shapes_unchecked

from hrc_learn.experiments import collaboration_trial
from hrc_learn.experiments.collaboration_trial import (
    CollaborationScenario,
    Disturbances,
    simulate_collaboration,
)
from hrc_learn.experiments.simulated_cell import Observer
from hrc_learn.experiments.surroundings import THREE_OBJECTS, with_objects
from hrc_learn.sim import CameraChange, World
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills.grasping import INTERACT
from hrc_learn.skills.pick_and_place import HOME, RECEIVE, RELEASE, PickAndPlaceConfig
from hrc_learn.teleoperation import ScriptedForce, random_pulls

pytestmark = pytest.mark.simulation

ONE = Workplace()
THREE = with_objects(ONE, THREE_OBJECTS)
SHELVES = ("lower", "middle", "upper")
PULL = ScriptedForce(start=0.0, duration=2.0, towards=(0.4, 0.0, 0.5), max_force=60.0)
SYNTHETIC = CollaborationScenario(camera="synthetic", forces=(PULL,))


@pytest.fixture
def run(monkeypatch):
    """Runs a scenario whose task is a function of cell, orders and what comes before each."""
    made: Any = SimpleNamespace()

    def simulated(task, scenario=SYNTHETIC, workplace=ONE, shelves=("upper",), **options):
        class Task:
            def __init__(self, cell, workplace, aiming, placing, check, config, receiving):
                made.cell, made.config, made.receiving = cell, config, receiving

            def run(self, orders, before):
                made.orders = orders
                return task(made.cell, orders, before) or []

        monkeypatch.setattr(collaboration_trial, "PickAndPlace", Task)
        aiming: Any = SimpleNamespace(approach=None, landmarks=None)
        placing: Any = SimpleNamespace()
        with shapes_unchecked():
            made.run = simulate_collaboration(
                aiming, placing, shelves, scenario, workplace=workplace, **options
            )
        return made

    return simulated


def done(name, failure=""):
    return SimpleNamespace(item=SimpleNamespace(name=name), failure=failure)


def pushes(cell, time):
    """Whether the scripted person would push the arm at a time [s]."""
    return bool(cell.human.read(replace(cell.state, time=time)).nullspace_input.any())


@pytest.mark.parametrize("change", [None, CameraChange(distance=0.02, angle=0.01)])
def test_the_camera_moves_before_each_object_but_the_first(run, change):
    def task(cell, orders, before):
        assert [(item.name, shelf) for item, shelf in orders] == [
            (item.name, shelf) for item, shelf in zip(THREE_OBJECTS, SHELVES, strict=True)
        ]
        for number in range(3):
            before(number)
            if change:
                cell.step(cell.joints * 0)
        return [done("box"), done("carton", "it fell"), done("tin", "it is gone")]

    scenario = replace(SYNTHETIC, disturbances=Disturbances(camera_change=change))
    made = run(task, scenario, THREE, SHELVES)
    assert made.run.failure == "it fell; it is gone"
    times, models = zip(*made.run.cameras, strict=True)
    dt = made.cell.config.dt
    np.testing.assert_allclose(times[1:], ([dt, 2 * dt] if change else []), atol=1e-9)
    assert times[0] == -np.inf
    moved = [np.linalg.norm(m.pose[:3, 3] - models[0].pose[:3, 3]) for m in models[1:2]]
    assert moved == pytest.approx([0.02] if change else [])


def test_objects_that_were_not_started_are_counted_with_the_failures(run):
    made = run(
        lambda *_: [done("box", "it fell"), done("carton")], workplace=THREE, shelves=SHELVES
    )
    assert made.run.failure == "it fell; 1 objects were not started"
    assert len(made.run.picks) == 2
    assert made.run.visit is made.run.hand_over is made.run.near_worker is None
    assert made.run.pull_effects == []
    assert made.receiving == {}


def test_scripted_forces_begin_when_the_robot_waits_for_them(run):
    told = []

    def task(cell, orders, before):
        cell.begin_phase("servo")
        assert not pushes(cell, cell.time + 1.0)
        cell.step(cell.joints * 0)
        cell.begin_phase(INTERACT)
        assert pushes(cell, cell.time + 1.0)
        assert not pushes(cell, cell.time + 2.001)
        return [done("box")]

    config = PickAndPlaceConfig(interactions=3)
    made = run(task, replace(SYNTHETIC, config=config), observer=Observer(tell=told.append))
    assert made.run.failure == ""
    assert made.config.interactions == 3
    assert [line.split()[-1] for line in told] == ["servo", INTERACT]
    assert made.run.pulls == ()


def test_random_forces_begin_with_the_run_and_are_not_waited_for(run):
    expected = random_pulls(np.random.default_rng([7, 1]))
    middle = expected[0].start + 0.5 * expected[0].duration

    def task(cell, orders, before):
        assert pushes(cell, middle)
        cell.step(cell.joints * 0)
        cell.begin_phase(INTERACT)
        assert pushes(cell, middle)
        assert not pushes(cell, expected[0].start - 1e-3)

    scenario = replace(SYNTHETIC, forces="random", config=PickAndPlaceConfig(interactions=3))
    made = run(task, scenario, seed=7)
    assert made.config.interactions == 0
    assert tuple(made.run.pulls) == tuple(expected)


def test_an_object_is_held_flat_if_it_is_at_home_and_at_the_release(run, monkeypatch):
    flat = {"": set()}
    monkeypatch.setattr(World, "holds_flat", lambda self, name: name in flat["now"])

    def task(cell, orders, before):
        for phase, names in (
            ("lift", {"tin"}),
            (HOME, {"box", "carton"}),
            (RELEASE, {"carton", "tin"}),
            ("retreat", {"box"}),
        ):
            flat["now"] = names
            cell.begin_phase(phase)

    assert run(task, workplace=THREE, shelves=SHELVES).run.held_flat == {"carton"}


def test_a_person_sets_out_when_the_robot_is_ready_to_receive(run, monkeypatch):
    monkeypatch.setattr(collaboration_trial, "shown_hand_overs", lambda *_: "model")
    monkeypatch.setattr(collaboration_trial, "Receiving", lambda *given: given[2])
    begun = []
    giving = collaboration_trial.GivingPerson
    monkeypatch.setattr(giving, "begin", lambda self, time: begun.append(time))

    def task(cell, orders, before):
        cell.begin_phase("servo")
        cell.step(cell.joints * 0)
        cell.begin_phase(RECEIVE)

    made = run(task, replace(SYNTHETIC, handover=True))
    assert begun == [pytest.approx(made.cell.config.dt)]
    assert made.receiving == {ONE.scene.objects[0].name: "model"}
    assert made.run.hand_over is not None
    assert made.run.visit is made.run.hand_over.visit


@pytest.mark.parametrize(
    "shelves", [("lower",), ("lower", "lower", "upper"), (*SHELVES, "top")]
)
def test_shelves_that_are_not_one_for_each_object_are_refused(run, shelves):
    with pytest.raises(ValueError, match="each of the 3 objects needs a shelf of its own"):
        run(None, workplace=THREE, shelves=shelves)


def test_a_worker_and_a_hand_over_at_once_are_refused(run):
    with pytest.raises(ValueError, match="give --worker or --handover, not both"):
        run(None, replace(SYNTHETIC, worker=True, handover=True))
