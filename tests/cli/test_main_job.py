"""Each command of the main job once, small."""

import json

import pytest
from commands import done, hrc
from unchecked import shapes_unchecked


@pytest.fixture(scope="module", autouse=True)
def _unchecked():
    """Minutes of simulation are twice as many with every shape checked; other tests do that."""
    with shapes_unchecked():
        yield


@pytest.fixture(scope="module")
def work(tmp_path_factory):
    """Demonstrations and models of a small main job."""
    work = tmp_path_factory.mktemp("job")
    done("record", "placing", "--out", work / "placing_demos", "--episodes", 1)
    done(
        *("record", "servoing", "--out", work / "aiming_demos", "--episodes", 4),
        *("--demonstration.duration", 5, "--json", work / "aiming.json"),
    )
    done("fit", "--dataset", work / "placing_demos", "--out", work / "placing")
    done(
        *("fit", "image-jacobian", "--dataset", work / "aiming_demos"),
        *("--out", work / "aiming"),
    )
    return work


def test_the_job_is_done_and_every_target_met(work):
    out = work / "run"
    outcome = done(
        *("run", "collaboration", "--placing", work / "placing"),
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
    assert "missed" not in outcome.output
    measured = json.loads((work / "measured.json").read_text())
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
    assert made_by["config"]["interaction"] == 5
    assert made_by["config"]["grasping"]["attempts"] >= 1
    assert made_by["placing"] == str(work / "placing")


def test_an_unknown_shelf_and_a_missing_model_are_bad_input(work):
    models = ("--placing", work / "placing", "--aiming", work / "aiming")
    for arguments, reason in (
        ((*models, "--shelf", "attic"), "'lower', 'middle', 'upper'"),
        ((*models, "--shelves", "lower", "lower"), "a shelf of its own"),
        (("--placing", work / "nowhere", "--aiming", work / "aiming"), "nowhere"),
    ):
        out = work / "refused"
        outcome = hrc("run", "collaboration", *arguments, "--out", out)
        assert outcome.status == 2
        assert reason in outcome.error
        assert len(outcome.error.strip().splitlines()) == 1
        assert not out.exists()


def test_nothing_is_overwritten_unasked(work):
    arguments = ("--dataset", work / "placing_demos", "--out", work / "placing")
    before = (work / "placing" / "made_by.json").read_text()
    outcome = hrc("fit", *arguments)
    assert outcome.status == 2
    assert "exists" in outcome.error
    assert (work / "placing" / "made_by.json").read_text() == before
    assert hrc("fit", *arguments, "--overwrite").status == 0


def test_a_missing_dataset_and_unknown_joints_are_bad_input(work):
    out = work / "none"
    outcome = hrc("fit", "--dataset", work / "absent", "--out", out)
    assert outcome.status == 2
    assert "absent" in outcome.error
    outcome = hrc(
        *("fit", "--dataset", work / "placing_demos", "--out", out),
        *("--joint-names", "elbow"),
    )
    assert outcome.status == 2
    assert "elbow" in outcome.error
    assert "panda_joint1" in outcome.error
    assert not out.exists()
