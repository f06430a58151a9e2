"""Metrics of a collaboration, of runs whose measures are known, and the parts of its stage."""

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from unchecked import shapes_unchecked

from hrc_learn.experiments import (
    collaboration_experiment,
    collaboration_metrics,
    run_measures,
)
from hrc_learn.experiments.collaboration_experiment import CollaborationExperiment
from hrc_learn.experiments.collaboration_trial import (
    DRAGS_NEAR_WORKER,
    NULL_SPACE_FORCES,
    CollaborationScenario,
    Disturbances,
    _Stage,
)
from hrc_learn.experiments.metric_table import evaluate
from hrc_learn.experiments.simulated_cell import SIMULATED, ArmAccess, access_by
from hrc_learn.geometry import Pose
from hrc_learn.kinematics import ArmChoice
from hrc_learn.kinematics.registry import arm
from hrc_learn.log import StepLog
from hrc_learn.sim import (
    Imperfections,
    OcclusionInterval,
    Worker,
    WorkerConfig,
    random_visit,
)
from hrc_learn.sim.scene import UnmarkedLook
from hrc_learn.sim.worker import PARTS
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills.pick_and_place import RELEASE, PickAndPlaceConfig
from hrc_learn.skills.work_cell import WorkCellConfig
from hrc_learn.teleoperation.page import PageConfig

pytestmark = pytest.mark.simulation

WORKPLACE = Workplace()
TRIAL = "hrc_learn.experiments.collaboration_trial"


@pytest.fixture(autouse=True)
def _unchecked():
    """Stand-ins are not of the annotated types."""
    with shapes_unchecked():
        yield


def pick(name, shelf, span, release, goal=(0.0, 0.0, 0.0), **more):
    """Record of one object."""
    given = {
        "item": SimpleNamespace(name=name),
        "shelf": shelf,
        "span": span,
        "release": release,
        "goal": Pose(WORKPLACE.home().position.new_tensor(goal), WORKPLACE.home().orientation),
        "receipt": None,
        "recoveries": (),
        "servo_time": 9.0,
        "pixel_error": 1.0,
    } | more
    return SimpleNamespace(**given)


def note(mishap):
    return SimpleNamespace(mishap=mishap)


@pytest.fixture
def run(monkeypatch):
    """Two objects placed, a third one given up; measures of the parts are simple."""
    log = StepLog()
    for time, phase in (
        (0.0, "home"),
        (2.0, "grasp"),
        (3.0, "home"),
        (4.0, "grasp"),
        (5.0, RELEASE),
        (12.0, "grasp"),
        (15.0, RELEASE),
        (21.0, "grasp"),
    ):
        log.event(time, phase)
    for k in range(4):
        log.append(time=0.1 * k, nullspace_input=np.zeros(7), pace=[1.0, 0.5, 0.0, 0.75][k])
    offsets = {("a", 4.0): 0.002, ("b", 12.0): 0.003}
    monkeypatch.setattr(
        run_measures,
        "grasp_offset",
        lambda log, motion, world, name, time: offsets[name, time],
    )
    angles = {"a": 0.01, "b": 0.02, "c": 9.0}
    monkeypatch.setattr(run_measures, "place_angle", lambda pose, goal: angles[pose.name])
    monkeypatch.setattr(
        run_measures,
        "place_pitch_and_yaw",
        lambda pose, goal: (angles[pose.name], 2 * angles[pose.name]),
    )
    monkeypatch.setattr(
        run_measures,
        "unwanted_contacts",
        lambda world, log, released: world.contacts(released),
    )
    monkeypatch.setattr(run_measures, "limit_violations", lambda cell: 0)
    monkeypatch.setattr(run_measures, "worker_distance", lambda motion, steps: motion[:steps])
    monkeypatch.setattr(
        collaboration_metrics, "worker_contacts", lambda world, log, motion: ("x", "y")
    )

    class Placed(np.ndarray):
        name = ""

    def object_pose(name):
        pose = np.eye(4).view(Placed)
        pose.name = name
        pose[:3, 3] = {"a": (0.003, 0.004, 9.0), "b": (0.0, 0.001, 9.0), "c": (5, 5, 5)}[name]
        return pose

    released = []

    def contacts(times):
        released.append(times)
        return {"cabinet": (), "table": (), "arm itself": ()}

    world = SimpleNamespace(
        object_pose=object_pose,
        contacts=contacts,
        released=released,
        rests_on=lambda name, place: (
            (name, place) in {("a", "board_upper"), ("b", "board_lower")}
        ),
        config=SimpleNamespace(worker=None),
    )
    items = [SimpleNamespace(name=name) for name in "abc"]
    safety = SimpleNamespace(separation=SimpleNamespace(mode="ssm"))
    cell = SimpleNamespace(log=log, time=70.0, config=SimpleNamespace(dt=0.1, safety=safety))
    return SimpleNamespace(
        picks=[
            pick("a", "upper", (0.0, 10.0), "released", servo_time=8.0, pixel_error=2.0),
            pick("b", "lower", (10.0, 20.0), "released", recoveries=(note("missed grasp"),)),
            pick("c", "middle", (20.0, math.inf), None, servo_time=99.0, pixel_error=99.0),
        ],
        world=world,
        cell=cell,
        motion=np.zeros(0),
        workplace=SimpleNamespace(
            robot=SimpleNamespace(task="pose"), scene=SimpleNamespace(objects=items)
        ),
        held_flat=frozenset({"a", "b"}),
        near_worker=None,
        visit=None,
        hand_over=None,
        pulls=(),
        pull_effects=[],
    )


def evaluated(run, objects=3, nrmse=1e-3):
    return evaluate(collaboration_metrics.collaboration_metrics(objects, nrmse), run)


def test_the_worst_object_that_was_released_counts(run):
    found = evaluated(run)
    expected = {
        "reproduction_of_the_demonstrations_nrmse": 1e-3,
        "servoing_time_s": 9.0,
        "pixel_error_at_descent_px": 2.0,
        "grasp_offset_mm": 3.0,
        "objects_held_flat_between_both_pads": 2,
        "place_error_mm": 5.0,
        "place_tilt_deg": math.degrees(0.02),
        "joint_limit_violations": 0,
        "contacts": 0,
        "cycle_time_s": 70.0,
        "objects_that_stand_on_their_shelf": 2,
    }
    for key, value in expected.items():
        assert found.values[key] == pytest.approx(value), key
    # Without worker, push, five joints or hand-over those rows are left out.
    for part in ("worker", "pitch", "yaw", "deviation", "elbow", "pulls", "handed", "distance"):
        assert not [key for key in found.values if part in key], part
    assert run.world.released[0] == {"a": 5.0, "b": 15.0}
    faults = "; ".join(found.faults)
    assert faults.count("not c") == 2
    assert "not a" not in faults


def test_an_object_that_was_lowered_but_not_released_is_still_carried(run):
    run.picks[0] = replace_pick(run.picks[0], release=None)
    evaluated(run)
    assert run.world.released[0] == {"b": 15.0}


def test_nothing_that_was_released_has_no_errors(run):
    run.picks = [replace_pick(p, release=None) for p in run.picks]
    run.cell.log.events[:] = []
    found = evaluated(run)
    for key in ("place_error_mm", "place_tilt_deg", "grasp_offset_mm", "servoing_time_s"):
        assert key not in found.values


def replace_pick(pick, **changes):
    return SimpleNamespace(**(vars(pick) | changes))


@pytest.mark.parametrize(("error", "ok"), [(1.5e-3, True), (1.6e-3, False)])
def test_a_reproduction_leaves_no_more_than_a_hands_tremor(run, error, ok):
    (row,) = [r for r in evaluated(run, nrmse=error).table if "NRMSE" in r.name]
    assert row.ok is ok


def test_an_object_that_was_handed_over_has_no_servoing(run):
    run.picks[1].receipt = SimpleNamespace(predicted=None)
    values = evaluated(run).values
    assert (values["servoing_time_s"], values["pixel_error_at_descent_px"]) == (8.0, 2.0)


def test_five_joints_are_measured_by_pitch_and_yaw(run):
    run.workplace.robot.task = "nearest pose"
    values = evaluated(run).values
    assert values["place_pitch_deg"] == pytest.approx(math.degrees(0.02))
    assert values["place_yaw_deg"] == pytest.approx(math.degrees(0.04))
    run.picks = run.picks[2:]
    run.cell.log.events[:] = []
    assert "place_yaw_deg" not in evaluated(run).values


def test_contacts_are_counted_by_what_was_hit_and_the_first_one_is_named(run):
    run.world.contacts = lambda released: {
        "cabinet": ("c1", "c2"),
        "table": ("t1",),
        "arm itself": ("s1", "s2", "s3"),
    }
    found = evaluated(run)
    assert found.values["contacts_with_the_cabinet"] == 2
    assert found.values["contacts_with_the_table"] == 1
    assert found.values["contacts_of_the_arm_with_itself"] == 3
    assert found.values["contacts"] == 6
    assert "contacts" not in [row.name for row in found.table]
    faults = "; ".join(found.faults)
    for first in ("first c1", "first t1", "first s1"):
        assert first in faults


@pytest.mark.parametrize("mode", ["ssm", "ssm+pfl"])
def test_a_worker_is_measured_by_margin_force_distance_and_wait(run, mode):
    run.world.config.worker = run.visit = "somebody"
    run.motion = np.array([0.5, 0.2, 0.3, 0.4])
    run.near_worker = SimpleNamespace(
        margin=np.array([0.0, -1e-9, -0.1, np.inf]), force=np.array([0.0, 1.0, 1.01, 0.3])
    )
    run.cell.config.safety.separation.mode = mode
    values = evaluated(run).values
    assert values["contacts_with_the_worker"] == 2
    assert values["min_distance_mm"] == pytest.approx(200.0)
    assert values["separation_violations"] == 2
    assert values["contact_force_relative_to_its_limit"] == pytest.approx(1.01)
    assert values.get("contacts_over_the_limit") == (None if mode == "ssm" else 1)
    # 0, 0.5, 1 and 0.25 of four steps.
    assert values["waited_for_the_worker_s"] == pytest.approx(0.175)


def test_recoveries_are_counted_by_what_went_wrong(run):
    run.picks[0].recoveries = (note("missed grasp"), note("marker occluded"))
    values = evaluated(run).values
    counts = {k: v for k, v in values.items() if k.startswith("recovered")}
    assert sorted(counts.values()) == [1, 2]
    assert counts["recovered_from_missed_grasp"] == 2


class Pushes:
    """Deviations in the steps of a run; NaN without a push."""

    @staticmethod
    def of(log, motion, world):
        nan = np.nan
        return SimpleNamespace(
            position=np.array([nan, 0.001, 0.002, nan]),
            rotation=np.array([nan, 0.01, 0.005, nan]),
            elbow=np.array([nan, 0.15, 0.05, nan]),
        )


def test_scripted_pushes_are_measured_by_their_largest_deviation(run, monkeypatch):
    monkeypatch.setattr(run_measures, "Deviation", Pushes)
    log = StepLog()
    for event in run.cell.log.events:
        log.event(event.time, event.text)
    log.append(time=0.0, nullspace_input=np.eye(7)[2], pace=1.0)
    run.cell.log = log
    values = evaluated(run).values
    assert values["end_effector_deviation_mm"] == pytest.approx(2.0)
    assert values["end_effector_rotation_deg"] == pytest.approx(math.degrees(0.01))
    assert values["elbow_moved_mm"] == pytest.approx(150.0)
    assert "pulls" not in values


def test_random_pulls_are_measured_by_worst_tool_and_median_elbow(run):
    run.pulls = ("a pull",)
    run.pull_effects = [
        SimpleNamespace(tool=tool, elbow=elbow)
        for tool, elbow in ((0.001, 0.10), (np.nan, 0.20), (0.0015, 0.30), (0.0, 0.4))
    ]
    values = evaluated(run).values
    assert values["end_effector_deviation_mm"] == pytest.approx(1.5)
    assert values["elbow_moved_mm"] == pytest.approx(250.0)
    assert values["pulls"] == 4
    assert "end_effector_rotation_deg" not in values


@pytest.mark.parametrize(("seen", "early"), [(9.9, 1.0), (10.0, 0.0)])
def test_a_hand_over_is_measured_from_the_beginning_of_the_reach(run, seen, early):
    receipt = SimpleNamespace(
        seen=seen,
        passed_over=2,
        recognised=10.5,
        predicted=np.array([0.1, 0.2, 0.3]),
        taken=14.0,
    )
    run.picks[1].receipt = receipt
    reaches = [SimpleNamespace(begin=0.0, end=1.0), SimpleNamespace(begin=10.0, end=12.0)]
    run.hand_over = SimpleNamespace(reaches=reaches, place=np.array([0.1, 0.2, 0.33]))
    found = evaluated(run)
    values = found.values
    assert values["hand_over_recognised_before_it_began"] == early
    (row,) = [r for r in found.table if r.name.endswith("before it began")]
    assert row.ok is (not early)
    assert values["other_movements_passed_over"] == 2
    assert values["hand_over_recognised_at_this_fraction_of_the_movement_%"] == pytest.approx(
        25
    )
    assert values["hand_over_place_error_when_recognised_mm"] == pytest.approx(30.0)
    assert values["time_until_the_object_was_held_s"] == pytest.approx(4.0)
    receipt.taken = math.nan
    assert "time_until_the_object_was_held_s" not in evaluated(run).values
    receipt.predicted = None
    assert "other_movements_passed_over" not in evaluated(run).values


def experiment(**given):
    return CollaborationExperiment(aiming=Path("aiming"), placing=Path("placing"), **given)


@pytest.mark.parametrize(
    ("pulls", "worker", "forces"),
    [
        ("none", False, ()),
        ("none", True, ()),
        ("random", True, "random"),
        ("scripted", False, NULL_SPACE_FORCES),
        ("scripted", True, DRAGS_NEAR_WORKER),
    ],
)
def test_forces_follow_from_pulls_and_worker(pulls, worker, forces):
    assert experiment(pulls=pulls, worker=worker)._forces() == forces


def test_drags_near_a_worker_go_forward_and_back_twice():
    assert len(DRAGS_NEAR_WORKER) == 4
    for first, again in zip(NULL_SPACE_FORCES, DRAGS_NEAR_WORKER[2:], strict=True):
        assert again == replace(first, start=first.start + 10.0)
    assert DRAGS_NEAR_WORKER[:2] == NULL_SPACE_FORCES


@pytest.mark.parametrize(("interaction", "with_worker"), [(0.0, 21.0), (30.0, 30.0)])
def test_a_worker_gets_the_time_of_all_drags(interaction, with_worker):
    config = PickAndPlaceConfig(interaction=interaction)
    assert experiment(config=config)._job() == config
    # The last drag ends 20 s after the first interaction began, and the elbow rests for 1 s.
    job = experiment(config=config, worker=True, pulls="none")._job()
    assert job == replace(config, interaction=with_worker)


@pytest.mark.parametrize("look", [None, UnmarkedLook()])
@pytest.mark.parametrize("shelves", [("middle",), ("upper", "lower")])
def test_a_run_keeps_as_many_images_of_several_objects(monkeypatch, look, shelves):
    calls = []
    for name in ("VisualServoSkill", "PlacingSkill"):
        loader = SimpleNamespace(load=lambda folder, *robot, name=name: (name, folder))
        monkeypatch.setattr(collaboration_experiment, name, loader)
    monkeypatch.setattr(
        collaboration_experiment,
        "simulate_collaboration",
        lambda *given, **more: calls.append((given, more)),
    )
    monkeypatch.setattr(
        collaboration_experiment, "unmarked_for", lambda *given: ("unmarked", given[2:])
    )
    monkeypatch.setattr(
        collaboration_experiment, "workplace_for", lambda shelves, robot: "workplace"
    )
    cell = WorkCellConfig(keep_image_every=5)
    made = experiment(shelves=shelves, look=look, cell=cell, camera="synthetic", pulls="random")
    made.run(4)
    (((aiming, placing, on, scenario), more),) = calls
    assert aiming == ("VisualServoSkill", Path("aiming"))
    assert placing == ("PlacingSkill", Path("placing"))
    assert on == shelves
    assert scenario.cell.keep_image_every == 5 * len(shelves)
    assert scenario.forces == "random"
    assert scenario.camera == ("synthetic" if look is None else "egl")
    assert more["workplace"] == ("workplace" if look is None else ("unmarked", (look, 4)))
    assert more["seed"] == 4
    assert more["access"] is SIMULATED


def test_trials_keep_no_images_and_serve_no_page():
    made = experiment(cell=WorkCellConfig(keep_image_every=5), page=PageConfig())
    trial = made.study().trial.experiment
    assert trial.cell == replace(made.cell, keep_image_every=0)
    assert trial.page is None


@pytest.mark.parametrize(("robot", "words"), [("panda", 0), ("ur5e", 1), ("so101", 2)])
def test_a_report_explains_a_missing_null_space(monkeypatch, robot, words):
    monkeypatch.setattr(
        collaboration_experiment, "run_sections", lambda *given: [("sections", given)]
    )
    noted = SimpleNamespace(time=12.34, mishap="missed grasp", what="tried again")
    picks = [pick("a", "upper", (1.0, 2.0), None, recoveries=(noted,))]
    run: Any = SimpleNamespace(
        picks=picks, workplace=SimpleNamespace(robot=ArmChoice(robot).work_arm())
    )
    sections = experiment().sections(run, {"run": "recording"})
    kind, (recording, spans, notes) = sections[0]
    assert (kind, recording, spans) == ("sections", "recording", {"a": (1.0, 2.0)})
    assert notes == ["At 12.3 s (a), missed grasp: tried again."]
    assert len(sections) == 1 + bool(words)
    if words:
        section: Any = sections[1]
        assert section.heading == "No null space"
        joints = {"ur5e": 6, "so101": 5}[robot]
        assert f"The {run.workplace.robot.name} has {joints} joints." in section.text
        assert ("its yaw" in section.text) == (words == 2)


@pytest.mark.parametrize(
    ("sizes", "access", "declared"),
    [((0.01, 0.2), (0.02, 0.5), (0.03, 0.5)), ((0.0, 0.6), (0.0, 0.9), (0.0, 0.6))],
)
def test_a_controller_allows_for_the_delays_and_the_slower_of_arm_and_driver(
    sizes, access, declared
):
    given = replace(Imperfections.ideal(), command_delay=sizes[0], slowness=sizes[1])
    made = ArmAccess(open=SIMULATED.open, delay=access[0], dynamics=access[1]).declared(given)
    assert (made.command_delay, made.slowness) == pytest.approx(declared)
    assert SIMULATED.declared(given) == given


def test_drivers_are_for_franka_arms():
    assert access_by("sim", arm("ur5e")) is SIMULATED
    with pytest.raises(ValueError, match="--arm franky drives Franka arms only, not the ur5e"):
        access_by("franky", arm("ur5e"))
    access = access_by("franka", arm("panda"), dynamics=0.25)
    assert access.dynamics == 0.25
    assert access.delay > 0


def staged(seed=0, **given):
    scenario = CollaborationScenario(**given)
    return _Stage(WORKPLACE, scenario, SIMULATED, seed, np.random.default_rng(seed))


def test_a_stage_without_people_watches_nobody():
    stage = staged(
        disturbances=Disturbances(occlusions=(OcclusionInterval(start=0.0, duration=1.0),))
    )
    assert stage.watch is stage.giving is stage.visit is None
    assert stage.receiving("cell") == {}
    assert stage.world.config.worker is None


@pytest.mark.parametrize("kind", ["worker", "handover"])
def test_people_come_by_the_seed_and_are_watched(kind, monkeypatch):
    def draw_visit(workplace, rng):
        worker, table = Worker(WorkerConfig.draw(rng)), workplace.scene.table
        return random_visit(worker, rng, bench=table, under=workplace.table_centre)

    monkeypatch.setattr(f"{TRIAL}.draw_visit", draw_visit)
    stage, same, other = (staged(seed=s, **{kind: True}) for s in (3, 3, 4))
    assert stage.world.config.worker == same.world.config.worker
    assert stage.world.config.worker != other.world.config.worker
    assert stage.watch is not None
    expected = 3.0 if kind == "handover" else None
    if expected is not None:
        assert stage.watch._config.acceleration == expected
        assert stage.visit is stage.giving.hand_over.visit
        monkeypatch.setattr(
            f"{TRIAL}.shown_hand_overs",
            lambda workplace, sizes, item: ("model", item.name),
        )
        monkeypatch.setattr(f"{TRIAL}.Receiving", lambda *given: given)
        ((name, skill),) = stage.receiving("cell").items()
        assert name == WORKPLACE.scene.objects[-1].name
        assert skill[0] == "cell"
        assert skill[2:4] == (("model", name), PARTS)
    else:
        assert stage.giving is None
        assert stage.receiving("cell") == {}
        assert stage.visit.worker.config == stage.world.config.worker
        moved = []
        monkeypatch.setattr(stage.world, "move_worker", lambda *given: moved.append(given))
        stage.update()
        ((ends, item),) = moved
        np.testing.assert_array_equal(ends, stage.visit.ends_at(stage.world.time))
        assert item is None or len(item)
