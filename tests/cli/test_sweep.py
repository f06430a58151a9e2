"""The sweep, a few trials of it."""

import json
from pathlib import Path

import pytest
from commands import hrc
from unchecked import shapes_unchecked


@pytest.fixture(autouse=True)
def _unchecked():
    """Batches of control steps take many times as long with every shape checked."""
    with shapes_unchecked():
        yield


def test_it_writes_one_flat_object_of_figures(tmp_path: Path):
    outcome = hrc(
        "sweep",
        *("--only", "near", "stress_late", "--trials", "5"),
        *("--json", str(tmp_path / "figures.json"), "--figure", str(tmp_path / "times.png")),
    )
    assert outcome.status == 0, outcome.error
    figures = json.loads((tmp_path / "figures.json").read_text())
    assert figures["near_success"] == 1.0
    assert figures["near_violations"] == 0
    assert figures["near_t95"] < 8
    assert figures["stress_late_rollouts"] == 5
    assert figures["stress_late_beyond_position"] == 0
    assert "met" in outcome.output
    assert (tmp_path / "times.png").stat().st_size > 1000


def test_an_unknown_experiment_ends_in_one_line():
    outcome = hrc("sweep", "--only", "far")
    assert outcome.status == 2
    assert outcome.error.startswith("error: invalid choice 'far' for argument '--only'")
    assert outcome.error.count("\n") == 1
