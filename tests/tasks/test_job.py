"""The whole job in simulation, from demonstrations on disk to an object on a shelf."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from taught_skills import WORKPLACE, taught_aiming, taught_placing

from hrc_learn.human import PullSpell
from hrc_learn.tasks.collaboration import CollaborationConfig
from hrc_learn.tasks.evaluation import evaluate
from hrc_learn.tasks.recording import Deviation, record, span, true_image_jacobian
from hrc_learn.tasks.simulated_job import simulate_collaboration

PULL = (PullSpell(start=0.3, duration=3.5, towards=(0.4, 0.0, 0.5), strongest=60.0),)


@pytest.fixture(scope="module")
def placing(tmp_path_factory):
    return taught_placing(tmp_path_factory.mktemp("placing"))


@pytest.fixture(scope="module")
def aiming(tmp_path_factory):
    return taught_aiming(tmp_path_factory.mktemp("aiming"))


@pytest.fixture(scope="module")
def job(aiming, placing):
    return simulate_collaboration(
        aiming,
        placing[0],
        "upper",
        camera="synthetic",
        pulls=PULL,
        config=CollaborationConfig(interaction=4.5),
        seed=3,
    )


def test_the_object_ends_on_the_shelf_and_every_target_is_met(job, placing):
    assert job.failure == ""
    missed = [str(m) for m in evaluate(job, placing[1]) if m.ok is False]
    assert missed == []
    assert job.world.rests_on("box", "board_upper")


def test_the_phases_come_in_order(job):
    phases = [event.text for event in job.station.log.events]
    assert phases == [
        "look",
        "aim",
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
    estimate = job.station.log["image_jacobian"]
    true = true_image_jacobian(job.station.log, job.world)
    start, end = span(job.station.log, "interact")
    time = job.station.log["time"]
    rows = (time >= start) & (time < end)
    difference = (estimate - true)[rows, :, :2]
    assert np.abs(difference).max() < 0.1 * np.abs(true[rows]).max()


def test_deviations_count_from_the_first_pull(job):
    deviation = Deviation.of(job.station.log)
    start, end = span(job.station.log, "interact")
    time = job.station.log["time"]
    outside = (time < start) | (time >= end)
    assert np.isnan(deviation.position[outside]).all()
    first = int(np.flatnonzero(np.isfinite(deviation.position))[0])
    assert deviation.position[first] == 0.0
    assert time[first] == pytest.approx(start + PULL[0].start, abs=0.05)
    assert deviation.elbow_most_moved > 0.1
    assert deviation.most_moved < 1e-3


def test_the_recording_holds_what_the_run_did(job):
    run = record("test", job.station, job.world, job.motion, plan=job.result.plan)
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
def test_a_person_who_keeps_away_changes_nothing(aiming, placing):
    config = CollaborationConfig(interaction=0.5)
    job = simulate_collaboration(
        aiming, placing[0], "middle", camera="synthetic", pulls=(), config=config, seed=5
    )
    assert job.failure == ""
    assert Deviation.of(job.station.log).elbow_most_moved == 0.0
    assert job.world.rests_on("box", "board_middle")


def moved_camera(dx, dy):
    scene = WORKPLACE.scene
    pose = scene.camera.pose.copy()
    pose[:2, 3] += [dx, dy]
    return replace(WORKPLACE, scene=replace(scene, camera=replace(scene.camera, pose=pose)))


@pytest.mark.parametrize(
    ("shift", "reason"),
    [((1.5, 0.0), "does not see marker 11"), ((-0.46, 0.0), "nearer to the middle")],
)
def test_what_the_camera_cannot_see_is_reported(aiming, placing, shift, reason):
    workplace = moved_camera(*shift)
    job = simulate_collaboration(
        aiming, placing[0], "middle", workplace=workplace, camera="synthetic", pulls=()
    )
    assert job.result is None
    assert reason in job.failure
    with pytest.raises(ValueError, match="nothing to measure"):
        evaluate(job, placing[1])


def test_an_unknown_shelf_is_refused_before_anything_moves(aiming, placing):
    with pytest.raises(ValueError, match="attic"):
        simulate_collaboration(aiming, placing[0], "attic", camera="synthetic")
