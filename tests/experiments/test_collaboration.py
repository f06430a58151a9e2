"""The whole job in simulation, from demonstrations on disk to objects on shelves.

One run is shared by most tests; what may go wrong is provoked in MuJoCo.
"""

import json
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest
import torch
from commands import done, hrc
from taught_models import teach
from unchecked import shapes_unchecked

from hrc_learn.experiments import collaboration_experiment as experiment
from hrc_learn.experiments.collaboration_metrics import collaboration_metrics
from hrc_learn.experiments.collaboration_trial import (
    NULL_SPACE_FORCES,
    CollaborationScenario,
    Disturbances,
    simulate_collaboration,
)
from hrc_learn.experiments.metric_table import evaluate
from hrc_learn.experiments.run_measures import (
    Deviation,
    span,
    true_image_jacobian,
    worker_distance,
)
from hrc_learn.experiments.run_recorder import record
from hrc_learn.experiments.run_report import run_sections
from hrc_learn.experiments.simulated_cell import Observer
from hrc_learn.experiments.surroundings import THREE_OBJECTS, with_objects
from hrc_learn.geometry import Box, quaternion
from hrc_learn.sim import CameraChange, Imperfections, OcclusionInterval
from hrc_learn.sim.scene import NOWHERE
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills.grasping import GraspingConfig
from hrc_learn.skills.marker_sensor import LatencyConfig
from hrc_learn.skills.pick_and_place import PickAndPlaceConfig
from hrc_learn.skills.visual_servoing import VisualServoConfig
from hrc_learn.skills.work_cell import WorkCellConfig
from hrc_learn.teleoperation import ScriptedForce

pytestmark = [pytest.mark.simulation, pytest.mark.long]

FORCE = (ScriptedForce(start=0.3, duration=2.0, towards=(0.4, 0.0, 0.5), max_force=60.0),)
BRIEF = PickAndPlaceConfig(interaction=0.0)
HASTY = replace(
    BRIEF,
    grasping=GraspingConfig(
        servo=VisualServoConfig(occlusion_timeout=2.5), detection_timeout=0.1, attempts=1
    ),
)
"""Gives up as soon as the arm has come to where it should see its marker."""
OCCLUDED = (OcclusionInterval(start=0.0, duration=1.5),)
LATE = LatencyConfig(delay=0.04, frame_loss=0.1)
SHELVES = ("lower", "middle", "upper")
WORKPLACE = Workplace()
SLOW = 0.02
"""Time step of loops in this file [s]: half as many steps as by default."""


RUN_OPTIONS = ("workplace", "access", "seed", "observer")


@shapes_unchecked()  # thousands of steps of the controller: twice as long checked
def simulate(aiming, placing, shelves, **options):
    """Run a scenario with the given settings."""
    run = {name: options.pop(name) for name in RUN_OPTIONS if name in options}
    scenario = CollaborationScenario(camera=options.pop("camera", "synthetic"), **options)
    return simulate_collaboration(aiming, placing, shelves, scenario, **run)


@pytest.fixture(scope="module")
def models(tmp_path_factory):
    """Folder of the models `placing` and `aiming`."""
    return tmp_path_factory.mktemp("models")


@pytest.fixture(scope="module")
def skills(models):
    """The learned servoing and placing."""
    return teach(models)


@pytest.fixture(scope="module")
def job(skills):
    return simulate(
        *skills,
        ("upper",),
        camera="synthetic",
        forces=FORCE,
        disturbances=Disturbances(occlusions=OCCLUDED),
        config=PickAndPlaceConfig(interaction=2.5, speed=2.0),
        cell=WorkCellConfig(dt=SLOW),
        imperfections=Imperfections.nominal(),
        seed=3,
    )


def evaluated(job):
    return evaluate(collaboration_metrics(len(job.workplace.scene.objects), 0.0), job)


def verdict(job):
    """Why a run counts as no success."""
    return "; ".join(filter(None, (job.failure, *evaluated(job).faults)))


def test_the_object_ends_on_the_shelf_and_every_target_is_met(job, models):
    assert job.failure == ""
    nrmse = json.loads((models / "placing" / "metrics.json").read_text())["joint_nrmse_median"]
    evaluation = evaluate(collaboration_metrics(1, nrmse), job)
    missed = [str(m) for m in evaluation.table if m.ok is False]
    assert missed == []
    assert evaluation.faults == ()
    assert evaluation.values["reproduction_of_the_demonstrations_nrmse"] == nrmse
    assert evaluation.values["contacts"] == 0
    # The simulator's own error, so not exactly zero; the fingers leave 18 mm on either side.
    assert 0 < evaluation.values["grasp_offset_mm"] < 15
    assert job.world.rests_on("box", "board_upper")


def test_the_command_asks_for_the_job_and_reports_it(models, job, monkeypatch, tmp_path):
    asked, out, figures = [], tmp_path / "run", tmp_path / "measured.json"

    def already_done(aiming, placing, shelves, scenario, **options):
        asked.append((shelves, scenario, options))
        return job

    monkeypatch.setattr(experiment, "simulate_collaboration", already_done)
    outcome = done(
        *("run", "collaboration", "--placing", models / "placing"),
        *("--aiming", models / "aiming", "--out", out, "--shelf", "upper"),
        *("--camera", "synthetic", "--seed", 3, "--json", figures),
        *("--config", "film=false", "experiment.config.interaction=2.5"),
        "experiment.disturbances.occlusions=[{start=0, duration=1.5}]",
        "experiment.cell.latency={delay=0.04, frame_loss=0.1}",
        *("--imperfections", 0.5, "--worker"),
    )
    ((shelves, scenario, options),) = asked
    assert (shelves, scenario.camera, options["seed"]) == (("upper",), "synthetic", 3)
    # Twice forward and back, with the time that takes: longer than asked for.
    assert scenario.forces[:2] == NULL_SPACE_FORCES
    assert [force.towards for force in scenario.forces] == 2 * [
        force.towards for force in NULL_SPACE_FORCES
    ]
    assert scenario.config.interaction > scenario.forces[-1].end
    assert scenario.worker
    assert not scenario.handover
    assert scenario.disturbances == Disturbances(occlusions=OCCLUDED)
    assert scenario.cell.latency == LATE
    assert scenario.imperfections == Imperfections.nominal().scaled(0.5)
    assert experiment.CollaborationExperiment(
        aiming=models, placing=models, config=PickAndPlaceConfig(interaction=2.5)
    )._job() == PickAndPlaceConfig(interaction=2.5)
    assert "missed" not in outcome.output
    # Nobody was there in the run that was reported.
    assert "worker" not in outcome.output
    measured = json.loads(figures.read_text())
    assert measured["objects_that_stand_on_their_shelf"] == 1
    assert measured["recovered_from_marker_occluded"] == 1
    assert measured["contacts_with_the_cabinet"] == 0
    # What others read by these names.
    assert measured["trials"] == measured["success_rate"] == 1
    assert measured["joint_limit_violations"] == measured["contacts"] == 0
    # Of one run, statistics over the trials are its own values.
    for name, unit in (("place_error_p95", "mm"), ("grasp_offset_p95", "mm")):
        single = measured[f"{name.removesuffix('_p95')}_{unit}"]
        assert measured[f"{name}_{unit}"] == pytest.approx(single)
    assert measured["cycle_time_median_s"] == pytest.approx(measured["cycle_time_s"])
    deviation = measured["end_effector_deviation_mm"]
    assert 0 < deviation == pytest.approx(measured["end_effector_deviation_p95_mm"])
    assert 0 < measured["elbow_moved_median_mm"] == pytest.approx(measured["elbow_moved_mm"])
    assert {path.name for path in out.iterdir()} == {
        "figures",
        "log.npz",
        ".manifest.json",
        "made_by.json",
        "measured.json",
        "report.html",
        "report.json",
        "run.rrd",
    }
    # The whole configuration lies beside the results.
    made_by = json.loads((out / "made_by.json").read_text())
    assert made_by["config"]["interaction"] == 2.5
    assert made_by["config"]["grasping"]["attempts"] >= 1
    assert made_by["placing"] == str(models / "placing")


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (("--shelf", "attic"), "'lower', 'middle', 'upper'"),
        (("--shelf", "lower", "lower"), "a shelf of its own"),
        (("--placing", "nowhere"), "nowhere"),
        (("--imperfections", -1), "--imperfections"),
    ],
)
def test_what_the_command_cannot_do_is_one_line(models, skills, tmp_path, arguments, reason):
    found = ("--placing", models / "placing", "--aiming", models / "aiming")
    out = tmp_path / "refused"
    outcome = hrc("run", "collaboration", *found, *arguments, "--out", out)
    assert outcome.status == 2
    assert reason in outcome.error
    assert len(outcome.error.strip().splitlines()) == 1
    assert not out.exists()


def test_the_phases_come_in_order(job):
    phases = [event.text for event in job.cell.log.events]
    assert phases == [
        "detect",
        "servo",
        "interact",
        "grasp",
        "lift",
        "home",
        "transfer",
        "release",
        "retreat",
        "done",
    ]


def test_the_estimated_image_jacobian_is_close_to_the_true_one(job):
    estimate = job.cell.log["image_jacobian"]
    true = true_image_jacobian(job.cell.log, job.world, job.cameras)
    start, end = span(job.cell.log, "interact")
    time = job.cell.log["time"]
    rows = (time >= start) & (time < end)
    difference = (estimate - true)[rows, :, :2]
    assert np.abs(difference).max() < 0.1 * np.abs(true[rows]).max()


def test_deviations_count_from_the_first_pull(job):
    deviation = Deviation.of(job.cell.log, job.motion, job.world)
    start, end = span(job.cell.log, "interact")
    time = job.cell.log["time"]
    outside = (time < start) | (time >= end)
    assert np.isnan(deviation.position[outside]).all()
    first = int(np.flatnonzero(np.isfinite(deviation.position))[0])
    assert deviation.position[first] == 0.0
    assert time[first] == pytest.approx(start + FORCE[0].start, abs=0.05)
    assert np.nanmax(deviation.elbow) > 0.1
    assert np.nanmax(deviation.position) < 2e-3


def test_the_recording_holds_what_the_run_did(job):
    plans = [pick.plan for pick in job.picks]
    run = record("test", job.cell, job.world, job.motion, plans=plans, cameras=job.cameras)
    assert len(run.bodies) == len({body.name for body in run.bodies})
    hand = next(body for body in run.bodies if body.name == "hand")
    tool = hand.position + 0.1034 * _axis_z(hand.orientation)
    np.testing.assert_allclose(tool, run.position, atol=1e-6)
    assert {box.name for box in run.boxes} >= {"table", "board_upper", "cabinet_door"}
    assert run.camera is not None
    assert len(run.camera.images) > 10


def _axis_z(orientation):
    from hrc_learn.geometry import quaternion

    return quaternion.to_matrix(torch.from_numpy(orientation))[..., :, 2].numpy()


@pytest.mark.slow
def test_a_person_who_keeps_away_changes_nothing(skills):
    config = PickAndPlaceConfig(interaction=0.5)
    job = simulate(*skills, ("middle",), camera="synthetic", forces=(), config=config, seed=5)
    assert job.failure == ""
    assert np.isnan(Deviation.of(job.cell.log, job.motion, job.world).elbow).all()
    assert job.world.rests_on("box", "board_middle")


def spans(job):
    return {pick.item.name: pick.span for pick in job.picks}


def moved_camera(dx, dy):
    scene = WORKPLACE.scene
    pose = scene.camera.pose.copy()
    pose[:2, 3] += [dx, dy]
    return replace(WORKPLACE, scene=replace(scene, camera=replace(scene.camera, pose=pose)))


@pytest.fixture(scope="module")
def unseen(skills):
    """A job near a worker, whose camera does not see the object."""
    return provoked(skills, moved_camera(1.5, 0.0), HASTY, worker=True)


def test_an_object_out_of_view_is_reported(unseen):
    assert "does not see marker 11" in unseen.failure


def test_what_the_camera_cannot_see_is_reported(skills):
    job = provoked(skills, moved_camera(-0.46, 0.0), HASTY)
    assert "nearer to the middle" in job.failure
    evaluation = evaluated(job)
    assert "place_error_mm" not in evaluation.values
    assert [fault.split(",")[0] for fault in evaluation.faults] == [
        "objects held flat between both pads: 0",
        "objects that stand on their shelf: 0",
    ]
    assert all("(not box)" in fault for fault in evaluation.faults)
    # No worker comes without the option.
    assert job.visit is None
    assert job.near_worker is None
    assert "separation_violations" not in evaluation.values
    # There is a report of it all the same.
    recording = record("failed", job.cell, job.world, job.motion, cameras=job.cameras)
    figures = [f for s in run_sections(recording, spans(job)) for f in s.figures]
    names = {figure.name for figure in figures}
    assert {"timeline", "marker", "trajectories", "joints"} <= names
    assert names.isdisjoint({"person", "worker"})


def test_a_worker_is_measured_logged_and_shown(unseen):
    job = unseen
    steps = len(job.cell.log)
    distance = worker_distance(job.motion, steps)
    values = evaluated(job).values
    assert values["min_distance_mm"] == pytest.approx(1e3 * distance.min())
    assert values["contacts_with_the_worker"] == 0
    assert 0.3 < distance.min() < 3.0
    assert values["separation_violations"] == 0
    log = job.cell.log
    assert np.isfinite(log["person_distance"]).all()
    assert (log["person_age"] >= 0).all()
    assert job.near_worker.margin.shape == (steps,)
    run = record("test", job.cell, job.world, job.motion)
    assert {"worker_head", "worker_hand_left", "worker_item"} <= {b.name for b in run.bodies}
    np.testing.assert_array_equal(run.worker_distance["true"], distance)
    gap = np.linalg.norm(run.worker_nearest[:, 1] - run.worker_nearest[:, 0], axis=-1)
    np.testing.assert_allclose(gap, distance, atol=1e-6)
    figures = [f.name for section in run_sections(run, spans(job)) for f in section.figures]
    assert "worker" in figures


@pytest.mark.slow
def test_a_job_beside_a_worker_keeps_its_distance_and_is_done(skills):
    """He makes no way: the arm slows down, waits, and goes on."""
    config = PickAndPlaceConfig(interaction=6.0)
    job = provoked(
        skills, config=config, imperfections=Imperfections.nominal(), worker=True, seed=0
    )
    assert verdict(job) == ""
    distance = worker_distance(job.motion, len(job.cell.log))
    assert distance.max() > 1.0
    assert job.near_worker.margin.min() > 0
    assert job.cell.log["pace"].min() < 0.5
    assert job.cell.time > job.cell.task_time + 0.5
    seen = job.cell.log["person_distance"]
    error = seen[np.isfinite(seen)] - distance[np.isfinite(seen)]
    assert np.abs(np.median(error)) < 0.03
    # 80 ms late and then some, of a person who walks at up to 1.6 m/s.
    assert np.abs(error).max() < 0.4


def test_an_unknown_shelf_is_refused_before_anything_moves(skills):
    with pytest.raises(ValueError, match="attic"):
        simulate(*skills, ("attic",), camera="synthetic")


def test_a_hidden_marker_is_waited_for_and_the_wait_noted(job):
    (note,) = [note for pick in job.picks for note in pick.recoveries]
    assert note.mishap == "marker occluded"
    feature = job.cell.log["feature"][:, 0]
    assert np.isnan(feature[job.cell.log["time"] < 1.5]).all()
    assert verdict(job) == ""
    assert evaluated(job).values["recovered_from_marker_occluded"] == 1


def provoked(skills, workplace=WORKPLACE, config=BRIEF, **options):
    """A job without a person, disturbed in its course."""
    return simulate(
        *skills,
        ("middle",),
        workplace=workplace,
        camera="synthetic",
        forces=(),
        config=config,
        cell=WorkCellConfig(keep_image_every=0, dt=SLOW),
        **options,
    )


class Meddler:
    """Somebody who does something to the world once, so long after a phase has begun."""

    def __init__(self, phase, deed, after=0.0):
        self._phase, self._deed, self._after = phase, deed, after
        self._done = False

    def hooks(self):
        return {"observer": Observer(view=self.watch)}

    @contextmanager
    def watch(self, cell, world, motion):
        advance = motion.advance

        def meddled(duration):
            begun = [event.time for event in cell.log.events if event.text == self._phase]
            if begun and world.time >= begun[0] + self._after and not self._done:
                self._done = True
                self._deed(world)
            advance(duration)

        motion.advance = meddled
        yield


def shifted(dx, dy, dz=0.0):
    def shift(world):
        world.data.joint("box").qpos[:3] += [dx, dy, dz]

    return shift


def mishaps(job):
    return [note.mishap for pick in job.picks for note in pick.recoveries]


@pytest.mark.slow
def test_an_object_moved_away_under_the_gripper_is_grasped_at_the_second_attempt(skills):
    meddler = Meddler("grasp", shifted(0.0, 0.09))
    job = provoked(skills, **meddler.hooks(), seed=5)
    assert mishaps(job) == ["missed grasp"]
    assert job.picks[0].attempts == 2
    assert verdict(job) == ""


@pytest.mark.slow
def test_an_object_lost_on_the_way_up_is_looked_for_again(skills):
    meddler = Meddler("lift", shifted(0.0, 0.08, 0.0), after=0.4)
    job = provoked(skills, **meddler.hooks(), seed=5)
    assert mishaps(job)[0] == "dropped object"
    assert verdict(job) == ""


@pytest.mark.slow
def test_an_object_lost_for_good_is_given_up_and_the_arm_goes_home(skills):
    """Half-way to the shelf it falls where the camera does not see it."""
    meddler = Meddler("transfer", shifted(0.0, 0.0, -0.3), after=3.0)
    job = provoked(skills, **meddler.hooks(), seed=5)
    assert mishaps(job) == ["dropped object"]
    assert "does not see marker 11" in job.failure
    home = torch.from_numpy(job.cell.state.joint_position)
    assert float((home - WORKPLACE.home_joints()).abs().max()) < 0.02
    assert not job.world.cabinet_contacts.touches


def with_obstacle(centre, half_size):
    box = Box(name="crate", centre=centre, half_size=half_size)
    return replace(WORKPLACE, scene=replace(WORKPLACE.scene, obstacles=(box,)))


@pytest.mark.slow
def test_a_blocked_way_is_gone_round(skills):
    workplace = with_obstacle((0.55, -0.10, 0.305), (0.05, 0.02, 0.04))
    job = provoked(skills, workplace, seed=5)
    assert set(mishaps(job)) == {"blocked path"}
    assert verdict(job) == ""


@pytest.mark.slow
def test_what_blocks_every_way_is_waited_for(skills):
    workplace = with_obstacle((0.40, -0.40, 0.40), (0.15, 0.03, 0.15))
    meddler = Meddler(
        "transfer", lambda world: world.move_obstacle("crate", NOWHERE), after=1.0
    )
    job = provoked(skills, workplace, **meddler.hooks(), seed=5)
    assert mishaps(job) == ["blocked path"]
    assert verdict(job) == ""


@pytest.mark.slow
def test_where_no_way_gets_free_the_object_is_put_back(skills):
    workplace = with_obstacle((0.40, -0.40, 0.40), (0.15, 0.03, 0.15))
    config = replace(BRIEF, waits=1, wait=0.5)
    job = provoked(skills, workplace, config, seed=5)
    assert mishaps(job) == ["blocked path", "blocked path"]
    assert "stayed blocked" in job.failure
    assert job.world.rests_on("box", "table")
    place = job.world.object_pose("box")[:2, 3]
    np.testing.assert_allclose(place, job.picks[0].picked_up.position[:2], atol=0.01)
    assert not job.world.cabinet_contacts.touches
    home = torch.from_numpy(job.cell.state.joint_position)
    assert float((home - WORKPLACE.home_joints()).abs().max()) < 0.02


@pytest.mark.slow
def test_turn_near_image_edge_keeps_marker_in_view(skills):
    """80 degrees, for an object whose grasp has the marker 80 px above the lower edge."""
    servo = VisualServoConfig(timeout=5.0)
    job = simulate(
        *skills,
        ("middle",),
        camera="synthetic",
        config=replace(BRIEF, grasping=GraspingConfig(servo=servo, attempts=1)),
        cell=WorkCellConfig(dt=SLOW),
        imperfections=Imperfections.nominal(),
        seed=113,
    )
    time, feature = np.array(job.cell.log["time"]), np.array(job.cell.log["feature"])
    pose = WORKPLACE.robot.chain.forward(
        torch.from_numpy(np.array(job.cell.log["joint_position"]))
    )
    assert "after 5 s" in job.failure
    seen = np.isfinite(feature[:, 0])
    first = np.flatnonzero(seen)[0]
    servoing = slice(first, np.searchsorted(time, time[first] + 4.0))
    turned = quaternion.angle(pose.orientation[servoing], pose.orientation[first])
    assert seen[servoing].all()
    assert turned.max() > 1.2
    assert feature[servoing, 1].max() > 900


@pytest.mark.slow
def test_a_marker_that_stays_hidden_ends_the_attempts_cleanly(skills):
    config = replace(BRIEF, grasping=replace(HASTY.grasping, attempts=2))
    hidden = Disturbances(occlusions=(OcclusionInterval(start=0.0, duration=1e3),))
    job = provoked(skills, config=config, disturbances=hidden, seed=5)
    assert mishaps(job) == ["marker occluded", "marker occluded"]
    assert "marker" in job.failure
    assert job.world.rests_on("box", "table")


@pytest.mark.slow
@pytest.mark.parametrize(
    "change", [CameraChange(), CameraChange(distance=0.0, angle=0.0, focus=1.06)]
)
def test_three_objects_are_placed_though_the_camera_is_changed_between_them(skills, change):
    workplace = with_objects(WORKPLACE, THREE_OBJECTS)
    job = simulate(
        *skills,
        SHELVES,
        workplace=workplace,
        camera="synthetic",
        forces=FORCE,
        disturbances=Disturbances(
            occlusions=(
                OcclusionInterval(start=0.0, duration=3.0),
                OcclusionInterval(start=50.0, duration=3.0),
            ),
            camera_change=change,
        ),
        config=PickAndPlaceConfig(interaction=2.5),
        cell=WorkCellConfig(keep_image_every=0),
        seed=1,
    )
    assert verdict(job) == ""
    assert len(job.cameras) == 3
    assert evaluated(job).values["objects_that_stand_on_their_shelf"] == 3


def test_every_object_needs_a_shelf_of_its_own(skills):
    workplace = with_objects(WORKPLACE, THREE_OBJECTS[:2])
    for shelves in (("lower",), ("lower", "lower")):
        with pytest.raises(ValueError, match="a shelf of its own"):
            simulate(*skills, shelves, workplace=workplace)


def test_one_person_comes_at_a_time(skills):
    with pytest.raises(ValueError, match="one person can come"):
        simulate(*skills, ("upper",), worker=True, handover=True)


@pytest.mark.slow
def test_an_object_is_handed_over_and_placed(skills):
    job = simulate(
        *skills,
        ("middle",),
        camera="synthetic",
        forces=(),
        config=PickAndPlaceConfig(interactions=0, speed=2.0),
        imperfections=Imperfections.nominal(),
        handover=True,
    )
    assert verdict(job) == ""
    values = evaluated(job).values
    assert values["hand_over_recognised_before_it_began"] == 0
    assert values["other_movements_passed_over"] >= 4
    assert values["separation_violations"] == 0
    assert values["hand_over_recognised_at_this_fraction_of_the_movement_%"] < 100
    (pick,) = job.picks
    assert job.hand_over is not None
    assert pick.receipt is not None
    assert pick.receipt.recognised > job.hand_over.reaches[-1].begin
    assert pick.receipt.taken < job.hand_over.carried[-1][1]
