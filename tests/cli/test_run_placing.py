"""The experiment on placing, as a user runs it."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


def run(program, *arguments, status=0):
    done = subprocess.run(
        [sys.executable, program, *map(str, arguments)],
        cwd=ROOT,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        timeout=1200,
        check=False,
    )
    assert done.returncode == status, done.stdout + done.stderr
    return done


@pytest.fixture(scope="module")
def work(tmp_path_factory):
    """A demonstration and the motion learned from it."""
    work = tmp_path_factory.mktemp("placing")
    run("datasets/record_placing.py", "--out", work / "demos", "--episodes", 1)
    run("training/fit_dmp.py", "--dataset", work / "demos", "--out", work / "placing")
    return work


@pytest.mark.slow
def test_three_shelves_are_reached_free_of_contact_and_everything_is_written(work):
    out = work / "run"
    done = run(
        *("control/run_placing.py", "--placing", work / "placing", "--out", out),
        *("--trials", 1, "--json", work / "measured.json"),
    )
    assert "missed" not in done.stdout
    measured = json.loads((work / "measured.json").read_text())
    for shelf in ("lower", "middle", "upper"):
        assert measured[f"{shelf}_shelf_placed"] == 1
        assert measured[f"{shelf}_shelf_contacts"] == 0
        assert measured[f"{shelf}_shelf_approach_path_deviation_mm"] < 12
    # The paper's way: far off on the shelves that were not demonstrated.
    assert measured["joint_space_lower_shelf_approach_path_deviation_mm"] > 60
    assert measured["joint_space_upper_shelf_approach_path_deviation_mm"] > 60
    assert measured["successes"] == measured["trials"] == 1
    assert measured["contacts"] == 0
    files = {path.name for path in out.iterdir()}
    assert {"report.html", "report.json", "trials.jsonl", "run_upper.rrd"} <= files
    pictures = {path.name for path in (out / "figures").iterdir()}
    assert {
        "paths.png",
        "joints_joint_space.png",
        "approach.png",
        "random_starts.png",
    } <= pictures
    assert not list(work.glob("*.jsonl"))


@pytest.mark.slow
def test_bad_input_is_told_in_a_line(work):
    for arguments, reason in (
        (("--placing", work / "nowhere"), "nowhere"),
        (("--placing", work / "placing", "--speed", 0), "--speed must be positive"),
    ):
        out = work / "refused"
        done = run("control/run_placing.py", *arguments, "--out", out, status=2)
        assert reason in done.stderr
        assert len(done.stderr.strip().splitlines()) == 1
        assert not out.exists()
