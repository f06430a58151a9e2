"""Each program of the main job once, small, as a user runs them."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


def run(program, *arguments):
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, program, *map(str, arguments)],
        cwd=ROOT,
        env=environment,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done


@pytest.fixture(scope="module")
def work(tmp_path_factory):
    """Demonstrations and models of a small main job."""
    work = tmp_path_factory.mktemp("job")
    run("datasets/record_placing.py", "--out", work / "placing_demos", "--episodes", 1)
    run(
        *("datasets/record_servoing.py", "--out", work / "aiming_demos", "--episodes", 4),
        *("--lesson.duration", 5, "--json", work / "aiming.json"),
    )
    run("training/fit_dmp.py", "--dataset", work / "placing_demos", "--out", work / "placing")
    run(
        *("training/fit_image_jacobian.py", "--dataset", work / "aiming_demos"),
        *("--out", work / "aiming"),
    )
    return work


def test_the_job_is_done_and_every_target_met(work):
    out = work / "run"
    done = run(
        *("control/run_collaboration.py", "--placing", work / "placing"),
        *("--aiming", work / "aiming", "--out", out, "--shelf", "lower"),
        *("--camera", "synthetic", "--seed", 3, "--json", work / "measured.json"),
        *(
            "--config.interaction",
            5,
            "--occlusion",
            0,
            3,
            "--latency",
            0.04,
            "--frame-loss",
            0.1,
        ),
    )
    assert "missed" not in done.stdout
    measured = json.loads((work / "measured.json").read_text())
    assert measured["objects_that_stand_on_their_shelf"] == 1
    assert measured["recovered_from_marker_out_of_sight"] == 1
    assert measured["contacts_with_the_cabinet"] == 0
    assert measured["contacts"] == measured["joint_limit_violations"] == 0
    assert measured["trials"] == measured["success_rate"] == 1
    assert {path.name for path in out.iterdir()} == {
        "figures",
        "log.npz",
        "made_by.json",
        "measured.json",
        "report.html",
        "report.json",
        "run.rrd",
    }


def test_an_unknown_shelf_and_a_missing_model_are_bad_input(work, run_here):
    models = ("--placing", work / "placing", "--aiming", work / "aiming")
    for arguments, reason in (
        ((*models, "--shelf", "attic"), "lower, middle, upper"),
        ((*models, "--shelves", "lower", "lower"), "a shelf of its own"),
        (("--placing", work / "nowhere", "--aiming", work / "aiming"), "nowhere"),
    ):
        out = work / "refused"
        done = run_here("control/run_collaboration.py", *arguments, "--out", out)
        assert done.status == 2
        assert reason in done.error
        assert len(done.error.strip().splitlines()) == 1
        assert not out.exists()


def test_nothing_is_overwritten_unasked(work, run_here):
    arguments = ("--dataset", work / "placing_demos", "--out", work / "placing")
    before = (work / "placing" / "made_by.json").read_text()
    done = run_here("training/fit_dmp.py", *arguments)
    assert done.status == 2
    assert "exists" in done.error
    assert (work / "placing" / "made_by.json").read_text() == before
    assert run_here("training/fit_dmp.py", *arguments, "--overwrite").status == 0


def test_a_missing_dataset_and_unknown_joints_are_bad_input(work, run_here):
    out = work / "none"
    done = run_here("training/fit_dmp.py", "--dataset", work / "absent", "--out", out)
    assert done.status == 2
    assert "absent" in done.error
    done = run_here(
        *("training/fit_dmp.py", "--dataset", work / "placing_demos", "--out", out),
        *("--joint-names", "elbow"),
    )
    assert done.status == 2
    assert "elbow" in done.error
    assert "panda_joint1" in done.error
    assert not out.exists()
