"""Placings that were carried out: true paths, outcomes, metrics of a run, and its trials."""

import json
import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from unchecked import shapes_unchecked

from hrc_learn.experiments import placing_experiment, placing_trial
from hrc_learn.experiments.metric_table import evaluate
from hrc_learn.experiments.placing_experiment import PlacingExperiment, RandomStart, dataset_of
from hrc_learn.experiments.placing_metrics import (
    PlacingOutcome,
    placing_metrics,
    run_metrics,
)
from hrc_learn.experiments.placing_trial import (
    PlacingScene,
    SimulatedPlacing,
    demonstrated_path,
)
from hrc_learn.geometry import Pose
from hrc_learn.kinematics import panda
from hrc_learn.log import StepLog
from hrc_learn.sim import Imperfections
from hrc_learn.sim.workplace import Workplace

pytestmark = pytest.mark.simulation

WORKPLACE = Workplace()
GOAL = WORKPLACE.shelf("middle")
STEPS, PLANNED, DT = 90, 60, 0.05
OFFSET = np.linspace(-0.02, 0.03, 7)


@pytest.fixture(autouse=True)
def _unchecked():
    """Stand-ins are not of the annotated types."""
    with shapes_unchecked():
        yield


def smooth(count):
    """A motion from rest to rest, 0 to 1."""
    s = np.linspace(0, 1, count)
    return s**3 * (10 - 15 * s + 6 * s**2)


@pytest.fixture
def placed():
    """A placing: the plan takes 60 of 90 steps; the object is 3 and 4 mm off, turned by 0.1."""
    start, end = (
        WORKPLACE.home_joints().numpy(),
        panda.inverse(GOAL, near=WORKPLACE.home_joints()),
    )
    q = start + smooth(PLANNED)[:, None] * (end.numpy() - start)
    q = np.concatenate([q, np.tile(q[-1:], (STEPS - PLANNED, 1))])
    velocity = np.gradient(q, DT, axis=0)
    log = StepLog()
    for k in range(STEPS):
        log.append(time=3.0 + DT * k, joint_position=q[k] + OFFSET, joint_velocity=velocity[k])
    tool = panda.forward(torch.from_numpy(q))
    hand = SimpleNamespace(
        name="hand",
        position=tool.position.numpy(),
        orientation=tool.orientation.numpy(),
    )
    motion = SimpleNamespace(
        bodies=lambda steps: [
            SimpleNamespace(
                name="hand",
                position=hand.position[:steps],
                orientation=hand.orientation[:steps],
            )
        ]
    )
    world = SimpleNamespace(
        arm=SimpleNamespace(tool_offset=np.zeros(3)),
        imperfections=SimpleNamespace(encoder_offset=OFFSET),
    )
    box = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("z", 0.1).as_matrix() @ box
    pose[:3, 3] = GOAL.position.numpy() + np.array([0.003, -0.004, 0.5])
    given: Any = {
        "goal": GOAL,
        "plan": SimpleNamespace(path=q[:PLANNED], duration=DT * (PLANNED - 1)),
        "world": world,
        "cell": SimpleNamespace(log=log, chain=panda),
        "motion": motion,
        "object_pose": pose,
        "contacts": ("a", "b"),
        "placed": True,
    }
    return SimulatedPlacing(**given), q, velocity


def demonstration(count=121, duration=9.0):
    """The same motion, shown slowly."""
    start = WORKPLACE.home_joints().numpy()
    end = panda.inverse(GOAL, near=WORKPLACE.home_joints()).numpy()
    return SimpleNamespace(
        time=2.0 + np.linspace(0, duration, count),
        duration=duration,
        joint_position=start + smooth(count)[:, None] * (end - start),
        joint_names=panda.joint_names,
    )


def test_a_transfer_has_the_true_joints_and_path_of_the_plan(placed):
    run, q, _ = placed
    np.testing.assert_allclose(run.joint_position, q[:PLANNED], atol=1e-12)
    np.testing.assert_allclose(run.time, DT * np.arange(PLANNED), atol=1e-12)
    expected = panda.forward(torch.from_numpy(q[:PLANNED])).position
    np.testing.assert_allclose(run.path, expected)


def test_an_outcome_is_measured_in_the_plane_of_the_board(placed):
    run, _, velocity = placed
    scene: Any = SimpleNamespace(workplace=WORKPLACE, demonstration=demonstration())
    found = PlacingOutcome.of(run, scene)
    assert found.place_error == pytest.approx(0.005)
    assert found.place_tilt == pytest.approx(0.1)
    assert found.contacts == ("a", "b")
    assert found.placed
    assert found.violations == 0
    fastest = np.abs(velocity) / panda.limits.velocity.numpy()
    assert found.peak_speed == pytest.approx(fastest.max())
    # The same path as shown: no deviation, and as smooth, whatever the speed.
    assert found.deviation < 2e-3
    assert found.jerk == pytest.approx(1.0, rel=0.1)


def test_demonstrations_of_another_arm_are_refused():
    shown: Any = demonstration()
    np.testing.assert_allclose(demonstrated_path(shown, panda)[-1], GOAL.position, atol=1e-6)
    shown.joint_names = ("a", "b")
    with pytest.raises(ValueError, match="but the arm has"):
        demonstrated_path(shown, panda)
    shown = demonstration()
    shown.joint_position = None
    with pytest.raises(ValueError, match="give demonstrations of this arm"):
        demonstrated_path(shown, panda)


def outcome(**changes):
    given = {
        "deviation": 0.001,
        "place_error": 0.002,
        "place_tilt": 0.01,
        "violations": 1,
        "contacts": (),
        "peak_speed": 0.5,
        "jerk": 0.001,
        "placed": True,
    }
    return PlacingOutcome(**(given | changes))


def test_the_worst_shelf_counts_and_numbers_add_up():
    outcomes = {
        "lower": outcome(place_error=0.001, peak_speed=0.7, contacts=("x",), violations=2),
        "upper": outcome(place_tilt=0.02, jerk=0.002, deviation=0.004, placed=False),
    }
    values = evaluate(placing_metrics(("lower", "upper")), outcomes).values
    assert values["place_error_mm"] == pytest.approx(2.0)
    assert values["place_tilt_deg"] == pytest.approx(math.degrees(0.02))
    assert values["joint_limit_violations"] == 3
    assert values["contacts"] == 1
    assert values["upper_shelf_approach_path_deviation_mm"] == pytest.approx(4.0)
    assert values["lower_shelf_contacts"] == 1
    assert values["objects_that_stand_on_their_shelf"] == 1
    assert max(v for k, v in values.items() if "peak" in k) == pytest.approx(0.7)
    assert max(v for k, v in values.items() if "jerk" in k) == pytest.approx(0.002)


def test_a_run_is_measured_in_both_spaces_and_against_its_demonstration(placed):
    reproduction, _, _ = placed
    shelves = ("lower", "middle")
    shown = demonstration()
    shown.joint_position = shown.joint_position + np.deg2rad(1.5)
    run: Any = SimpleNamespace(
        scene=SimpleNamespace(demonstration=shown),
        reproduction=reproduction,
        outcomes={
            "pose": dict.fromkeys(shelves, outcome(violations=0)),
            "joint": dict.fromkeys(shelves, outcome(deviation=0.1, place_error=0.05)),
        },
    )
    found = evaluate(run_metrics(shelves), run)
    assert found.values["demonstration_duration_s"] == pytest.approx(9.0)
    assert found.values["reproduction_duration_s"] == pytest.approx(DT * (PLANNED - 1))
    assert found.values["reproduction_joint_rmse_deg"] == pytest.approx(1.5, rel=2e-2)
    assert found.values["place_error_mm"] == pytest.approx(2.0)
    assert found.values["joint_space_place_error_mm"] == pytest.approx(50.0)
    # The joint-space rows have no bound, and only those of shelves are listed.
    assert not found.faults
    compared = [row for row in found.table if row.name.startswith("joint space")]
    assert all(row.target is None for row in compared)
    assert {row.name.split(", ")[1] for row in compared} == {"lower shelf", "middle shelf"}


@pytest.mark.parametrize("correction", [True, False])
def test_a_scene_plans_to_the_measured_goal_and_judges_by_the_true_one(monkeypatch, correction):
    calls: dict[str, Any] = {}
    measured = Pose(GOAL.position + 0.01, GOAL.orientation)
    item = WORKPLACE.scene.objects[0]

    class Cell:
        def __init__(self, world, **more):
            self.cell = SimpleNamespace(
                joints="joints", config=SimpleNamespace(dt=0.01), log="log"
            )

        def __enter__(self):
            return self.cell, "motion"

        def __exit__(self, *error):
            pass

    def plan(joints, goal, **more):
        calls["plan"] = joints, goal, more
        return "plan"

    def place_along(cell, plan, goal, lowering, size):
        calls["placed"] = plan, goal, lowering, size
        return 12.5

    def unwanted(world, log, released):
        calls["released"] = released
        return {"cabinet": ("a",), "table": ("b", "c")}

    world = SimpleNamespace(
        hold=lambda name, q: calls.update(held=(name, q)),
        object_pose=lambda name: f"pose of {name}",
        rests_on=lambda name, board: (name, board) == (item.name, "board_middle"),
    )
    monkeypatch.setattr(placing_trial, "simulated_cell", Cell)
    monkeypatch.setattr(placing_trial, "place_along", place_along)
    monkeypatch.setattr(placing_trial, "unwanted_contacts", unwanted)
    scene: Any = PlacingScene(
        skill=SimpleNamespace(plan=plan),
        workplace=WORKPLACE,
        world=world,
        demonstration=None,
        demonstrated_shelf="middle",
        correction=SimpleNamespace(apply=lambda goal: measured) if correction else None,
    )
    start = panda.ready + 0.1
    done = scene.place("middle", start, space="joint", speed=2.0)
    assert calls["held"][0] == item.name
    np.testing.assert_array_equal(calls["held"][1], start)
    _, goal, more = calls["plan"]
    wanted = measured if correction else GOAL
    torch.testing.assert_close(goal.position, wanted.position)
    assert more == {"space": "joint", "dt": 0.01, "speed": 2.0}
    torch.testing.assert_close(calls["placed"][1].position, wanted.position)
    torch.testing.assert_close(done.goal.position, GOAL.position)
    assert calls["released"] == {item.name: 12.5}
    assert done.contacts == ("a", "b", "c")
    assert done.placed
    assert done.object_pose == f"pose of {item.name}"


class Scene:
    """Places at once, and keeps what was asked for."""

    demonstrated_shelf = "middle"

    def __init__(self):
        self.workplace, self.placed = WORKPLACE, []
        self.skill = SimpleNamespace(robot=None)
        self.demonstration = demonstration()
        self.world = "world"

    def place(self, shelf, start, **more):
        self.placed.append((shelf, start, more))
        return f"placing on {shelf}"


def opened(monkeypatch, **given):
    """An experiment whose scene is a stand-in."""
    scene = Scene()
    seeds = []

    def open_scene(self, rng):
        seeds.append(rng.uniform())
        return scene

    monkeypatch.setattr(PlacingExperiment, "open_scene", open_scene)
    made = PlacingExperiment(placing=Path("p"), demonstrations=Path("d"), **given)
    return made, scene, seeds


def test_a_run_places_on_every_shelf_in_both_spaces_and_shows_the_reproduction(monkeypatch):
    made, scene, seeds = opened(monkeypatch, speed=1.25)
    monkeypatch.setattr(placing_experiment, "access_by", lambda arm, robot: f"access {arm}")
    outcomes = SimpleNamespace(of=lambda placed, scene: f"outcome of {placed}")
    monkeypatch.setattr(placing_experiment, "PlacingOutcome", outcomes)
    told: list[str] = []
    observer: Any = SimpleNamespace(tell=told.append)
    run = made.run(9, observer)
    assert seeds == [np.random.default_rng(9).uniform()]
    shelves = WORKPLACE.shelf_names()
    assert list(run.placings) == [(space, s) for space in ("pose", "joint") for s in shelves]
    for (planned, shelf), (on, start, more) in zip(run.placings, scene.placed, strict=True):
        assert on == shelf
        np.testing.assert_array_equal(start, scene.demonstration.joint_position[0])
        assert (more["space"], more["speed"]) == (planned, 1.25)
        assert more["access"] == "access sim"
        assert (more["observer"] is observer) == ((planned, shelf) == ("joint", "middle"))
        assert run.outcomes[planned][shelf] == f"outcome of placing on {shelf}"
    assert len(told) == 6
    assert "middle shelf, planned in joint space" in told[-2]


def test_a_trial_starts_anew_for_each_shelf(monkeypatch):
    made, scene, seeds = opened(monkeypatch, noise=0.25, speed=2.0)
    starts = iter("abc")
    monkeypatch.setattr(
        placing_experiment,
        "random_start",
        lambda world, workplace, noise, rng: (next(starts), noise),
    )
    monkeypatch.setattr(
        placing_experiment,
        "PlacingOutcome",
        SimpleNamespace(of=lambda placed, scene: outcome(violations=0)),
    )
    values = RandomStart(made)(5)
    assert seeds == [np.random.default_rng(5).uniform()]
    assert [start for _, start, _ in scene.placed] == [("a", 0.25), ("b", 0.25), ("c", 0.25)]
    for _, _, more in scene.placed:
        assert (more["space"], more["speed"]) == ("pose", 2.0)
    assert values["failure"] == ""
    assert values["place_error_mm"] == pytest.approx(2.0)


@pytest.mark.parametrize(
    ("given", "refused"), [({"speed": 0.0}, 1), ({"noise": -0.1}, 1), ({}, 0)]
)
def test_speed_is_positive_and_noise_not_negative(given, refused):
    if refused:
        with pytest.raises(ValueError, match=next(iter(given))):
            PlacingExperiment(placing=Path(), demonstrations=Path(), **given)
    else:
        PlacingExperiment(placing=Path(), demonstrations=Path(), noise=0.0)


def test_recordings_are_named_by_their_shelf_and_show_neither_camera_nor_person(monkeypatch):
    made, scene, _ = opened(monkeypatch)
    recorded = []

    def record(title, cell, world, motion, *, plans, demonstration):
        recorded.append((title, plans))
        return SimpleNamespace(title=title, camera="camera", nullspace_input="input")

    def replaced(recording, **changes):
        return SimpleNamespace(**(vars(recording) | changes))

    monkeypatch.setattr(placing_experiment, "record", record)
    monkeypatch.setattr(placing_experiment, "replace", replaced)
    placings = {
        (space, shelf): SimpleNamespace(cell=0, world=0, motion=0, plan=f"{space} {shelf}")
        for space in ("pose", "joint")
        for shelf in WORKPLACE.shelf_names()
    }
    run: Any = SimpleNamespace(scene=scene, placings=placings)
    found = made.recordings(run)
    assert set(found) == {"run_lower", "run", "run_upper"}
    assert found["run"].title == "Placing on the middle shelf"
    assert all(r.camera is r.nullspace_input is None for r in found.values())
    assert [plans for _, plans in recorded] == [[f"pose {s}"] for s in WORKPLACE.shelf_names()]


@pytest.mark.parametrize("taught", [True, False])
def test_a_scene_is_opened_with_the_shelf_that_was_shown(monkeypatch, taught):
    shown = demonstration()
    loaded = SimpleNamespace(
        load=lambda folder, robot: SimpleNamespace(
            robot=WORKPLACE.robot, joint=SimpleNamespace(goal=WORKPLACE.home_joints())
        )
    )
    monkeypatch.setattr(placing_experiment, "PlacingSkill", loaded)
    monkeypatch.setattr(
        placing_experiment,
        "load_demos",
        lambda folder, episodes: [shown] if episodes == [0] else 0,
    )
    monkeypatch.setattr(
        placing_experiment, "taught_correction", lambda world, goal, near, rng: ("taught", goal)
    )
    made = PlacingExperiment(
        placing=Path(),
        demonstrations=Path(),
        taught=taught,
        imperfections=Imperfections.ideal(),
    )
    scene = made.open_scene(np.random.default_rng(0))
    assert scene.demonstrated_shelf == "middle"
    assert scene.demonstration is shown
    if taught:
        kind, goal = scene.correction
        assert kind == "taught"
        torch.testing.assert_close(goal.position, GOAL.position)
    else:
        assert scene.correction is None


def test_the_dataset_of_a_skill_has_to_exist_when_it_is_used(tmp_path):
    (tmp_path / "model").mkdir()
    (tmp_path / "model/made_by.json").write_text(json.dumps({"dataset": str(tmp_path / "set")}))
    assert dataset_of(tmp_path / "model") == tmp_path / "set"
    made = PlacingExperiment(placing=tmp_path / "model", demonstrations=tmp_path / "set")
    with pytest.raises(FileNotFoundError, match="no longer exists: restore it, or name"):
        made.open_scene(np.random.default_rng(0))
