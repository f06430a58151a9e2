"""The experiment on placing, as a user runs it."""

import json

import pytest
from commands import done


@pytest.fixture(scope="module")
def work(tmp_path_factory):
    """A demonstration and the motion learned from it."""
    work = tmp_path_factory.mktemp("placing")
    done("record", "placing", "--out", work / "demos", "--episodes", 1)
    done("fit", "--dataset", work / "demos", "--out", work / "placing")
    return work


@pytest.mark.slow
def test_three_shelves_are_reached_free_of_contact_and_everything_is_written(work):
    out = work / "run"
    outcome = done(
        *("run", "placing", "--placing", work / "placing", "--out", out),
        *("--trials", 1, "--json", work / "measured.json"),
    )
    assert "missed" not in outcome.output
    measured = json.loads((work / "measured.json").read_text())
    for shelf in ("lower", "middle", "upper"):
        assert measured[f"pose_{shelf}_placed"] == 1
        assert measured[f"pose_{shelf}_contacts"] == 0
        assert measured[f"pose_{shelf}_bend_mm"] < 12
    # The paper's way: bent on the shelves that were not shown.
    assert measured["joint_lower_bend_mm"] > 60
    assert measured["joint_upper_bend_mm"] > 60
    assert measured["random_starts_successes"] == 1
    files = {path.name for path in out.iterdir()}
    assert {"report.html", "report.json", "starts.jsonl", "run_upper.rrd"} <= files
    pictures = {path.name for path in (out / "figures").iterdir()}
    assert {"paths.png", "joints_joint_space.png", "bend.png", "random_starts.png"} <= pictures
    assert not list(work.glob("*.jsonl"))


@pytest.mark.slow
def test_bad_input_is_told_in_a_line(work):
    for arguments, reason in (
        (("--placing", work / "nowhere"), "nowhere"),
        (("--placing", work / "placing", "--speed", 0), "--speed must be positive"),
    ):
        out = work / "refused"
        outcome = done("run", "placing", *arguments, "--out", out, status=2)
        assert reason in outcome.error
        assert len(outcome.error.strip().splitlines()) == 1
        assert not out.exists()
