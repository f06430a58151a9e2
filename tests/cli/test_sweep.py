"""The sweep, a few trials of it."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from commands import hrc
from unchecked import shapes_unchecked

from hrc_learn.cli.commands import sweep as command
from hrc_learn.experiments.controller import sweep as experiments
from hrc_learn.experiments.controller.sweep import EXPERIMENTS
from hrc_learn.sim.closed_loop import Imperfections


@pytest.fixture(autouse=True)
def _unchecked():
    """Batches of control steps take many times as long with every shape checked."""
    with shapes_unchecked():
        yield


@pytest.fixture
def coarse(monkeypatch):
    """Experiments with fewer and longer steps; `tests/experiments` has them as they are."""
    near, late = EXPERIMENTS["near"], EXPERIMENTS["stress_late"]
    images = Imperfections(frame_steps=2, noise=0.5)
    coarse = replace(near.config, dt=0.02, duration=6.0, imperfections=images)
    short = replace(late.config, duration=0.5)
    known = {**EXPERIMENTS, "near": replace(near, config=coarse)}
    known["stress_late"] = replace(late, config=short)
    for module in (experiments, command):
        monkeypatch.setattr(module, "EXPERIMENTS", known)


def test_it_writes_one_flat_object_of_figures(tmp_path: Path, coarse):
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


def test_a_sweep_without_grasps_has_figures_but_no_picture(tmp_path: Path, coarse):
    one = ("sweep", "--only", "stress_late", "--trials", "2")
    outcome = hrc(*one, "--out", str(tmp_path / "stress"))
    assert outcome.status == 0, outcome.error
    names = {path.name for path in (tmp_path / "stress").iterdir()}
    assert "metrics.json" in names
    assert not names & {"times.png", "sweep.rrd"}
    outcome = hrc(*one, "--recording", str(tmp_path / "sweep.rrd"))
    assert outcome.status == 2
    assert "--recording shows grasps, but stress_late are none" in outcome.error


def test_another_arm_servoes_and_what_is_about_a_panda_refuses_it(coarse):
    three = ("sweep", "--only", "near", "--trials", "3", "--robot", "fr3")
    outcome = hrc(*three)
    assert outcome.status == 0, outcome.error
    outcome = hrc("sweep", "--only", "near", "stress_late", "--robot", "fr3")
    assert outcome.status == 2
    assert "--robot fr3: stress_late are about a Panda" in outcome.error


def test_an_unknown_experiment_ends_in_one_line():
    outcome = hrc("sweep", "--only", "far")
    assert outcome.status == 2
    assert outcome.error.startswith("error: invalid choice 'far' for argument '--only'")
    assert outcome.error.count("\n") == 1


def test_a_figure_that_is_broken_off_leaves_the_older_one(tmp_path, monkeypatch):
    path = tmp_path / "times.png"
    path.write_text("older")

    def break_off(figure, place, **options):
        Path(place).write_text("half")
        raise KeyboardInterrupt

    monkeypatch.setattr("matplotlib.figure.Figure.savefig", break_off)
    trials = SimpleNamespace(
        time=torch.tensor([1.0, 2.0]),
        success=torch.tensor([True, False]),
        roll_class=torch.tensor([0, 4]),
    )
    with pytest.raises(KeyboardInterrupt):
        command._draw(path, {"near": trials})
    assert path.read_text() == "older"
    assert list(tmp_path.iterdir()) == [path]
