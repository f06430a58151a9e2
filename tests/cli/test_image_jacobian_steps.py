"""Decisions of `hrc fit image-jacobian` around its fit, which a stand-in does."""

import json
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from unchecked import shapes_unchecked

from hrc_learn.cli import image_jacobian_commands as commands
from hrc_learn.cli.arguments import Evaluate, FitImageJacobian
from hrc_learn.jacobian import RBFCenters


@pytest.fixture(autouse=True)
def _unchecked():
    """Stand-ins are not of the annotated types."""
    with shapes_unchecked():
        yield


class Demos(list):
    """Demonstrations with the notes of their reader."""

    notes = ("a guess",)


@pytest.fixture
def fit(monkeypatch, tmp_path, capsys):
    """Runs the command on a number of demonstrations; returns what its stages were given."""

    def run(number=9, rank=0, unmarked=None, **options):
        done = SimpleNamespace(written=None)

        def fitted(*given):
            done.fit = given
            return "skill"

        monkeypatch.setattr(commands.distributed, "processes", lambda: nullcontext(rank))
        monkeypatch.setattr(
            commands, "_demonstrations", lambda *_: (Demos(range(number)), {}, unmarked)
        )
        monkeypatch.setattr(commands, "fit_visual_servo", fitted)
        monkeypatch.setattr(commands, "_write", lambda *given: setattr(done, "written", given))
        args = FitImageJacobian(dataset=tmp_path / "set", out=tmp_path / "model", **options)
        commands.fit_image_jacobian(args)
        done.printed = " ".join(capsys.readouterr().out.split())
        return done

    return run


@pytest.mark.parametrize(
    ("number", "learn", "warned"), [(3, True, True), (4, True, False), (3, False, False)]
)
def test_too_few_demonstrations_to_learn_from_are_noted(fit, number, learn, warned):
    done = fit(number, learn=learn, config=("learning.hold_out=4",))
    note = f"{number} demonstrations are too few to learn the neurons"
    assert (note in done.printed) == warned
    assert "note: a guess" in done.printed
    settings = done.fit[3]
    assert (settings is not None) == learn
    assert not learn or settings.hold_out == 4


@pytest.mark.parametrize("neurons", ["around", "grid"])
def test_neurons_are_on_the_grid_of_the_paper_only_if_asked(fit, neurons):
    found = fit(neurons=neurons).fit[1]
    if neurons == "around":
        assert found is None
    else:
        torch.testing.assert_close(found.centers, RBFCenters.paper().centers)


@pytest.mark.parametrize("unmarked", [None, SimpleNamespace(landmarks="landmarks")])
def test_landmarks_are_those_of_the_search_without_markers(fit, unmarked):
    assert fit(unmarked=unmarked).fit[5] == (unmarked and "landmarks")


@pytest.mark.parametrize("rank", [0, 1])
def test_the_first_of_several_processes_writes_and_prints(fit, rank):
    done = fit(rank=rank)
    assert (done.written is not None) == (rank == 0)
    assert ("a guess" in done.printed) == (rank == 0)
    if rank == 0:
        assert done.written[1] == "skill"


@pytest.mark.parametrize("rank", [0, 1])
def test_other_processes_read_the_pixels_after_the_first_has_found_them(monkeypatch, rank):
    order = []
    found = SimpleNamespace(
        name="marker_3",
        episodes=2,
        known=1,
        left_out={4: "no video"},
        frames=50,
        without_image=5,
        seen=30,
    )
    demos = SimpleNamespace(load=lambda: "loaded")
    monkeypatch.setattr(commands, "open_demos", lambda *given, **more: demos)
    monkeypatch.setattr(
        commands.distributed, "sum_over_processes", lambda tensor: order.append("met")
    )
    monkeypatch.setattr(
        commands, "_find_marker", lambda *given: order.append("searched") or found
    )
    monkeypatch.setattr(commands, "attach_features", lambda *given: given)
    args = FitImageJacobian(dataset=Path("set"), marker=3)
    attached, figures, unmarked = commands._demonstrations(args, None, rank)
    assert order == (["met", "searched"] if rank else ["searched", "met"])
    assert attached == ("loaded", "marker_3")
    assert unmarked is None
    assert figures == {
        "episodes_searched": 2,
        "episodes_known_before": 1,
        "episodes_left_out": 1,
        "frames_searched": 50,
        "frames_without_image": 5,
        "frames_with_marker": 30,
    }


@pytest.mark.parametrize("marker", [-1, 50])
def test_a_marker_that_the_dictionary_lacks_is_refused(marker):
    args = FitImageJacobian(dataset=Path("set"), marker=marker)
    with pytest.raises(ValueError, match=f"--marker must be from 0 to 49, got {marker}"):
        commands._find_marker(args, marker, None)


@pytest.mark.parametrize("marker", [0, 49])
def test_every_marker_of_the_dictionary_is_searched(monkeypatch, marker):
    told = []
    found = SimpleNamespace(
        name="m", episodes=2, known=1, seen=3, frames=4, without_image=1, left_out={0: "late"}
    )
    monkeypatch.setattr(commands, "extract_features", lambda *given, **more: found)
    console: Any = SimpleNamespace(print=told.append)
    args = FitImageJacobian(dataset=Path("set"), marker=marker)
    assert commands._find_marker(args, marker, console) is found
    assert told[1:] == ["left out: late"]


@pytest.mark.parametrize("unmarked", [False, True])
def test_a_model_is_written_with_its_figures_and_the_picture_of_a_search(
    monkeypatch, tmp_path, capsys, unmarked
):
    metrics = {"held_out_relative": 0.25, "pairs": 12.0}
    skill: Any = SimpleNamespace(
        metrics=lambda: metrics,
        save=lambda folder: (folder / "saved").touch(),
        jacobian=SimpleNamespace(camera_fit="CAMERA"),
    )
    monkeypatch.setattr(
        commands, "record_learning", lambda file, *given: file.write_text(given[-1])
    )
    picture: Any = SimpleNamespace(save_picture=lambda path: path.touch())
    rows = []
    monkeypatch.setattr(
        commands, "show_measurements", lambda shown, **more: rows.append((shown, more))
    )
    model = tmp_path / "model"
    args = FitImageJacobian(
        dataset=tmp_path / "grasping", out=model, json=tmp_path / "values.json"
    )
    searched = {"frames_with_marker": 30}
    commands._write(args, skill, Demos(), searched, picture if unmarked else None)
    assert json.loads((model / "metrics.json").read_text()) == metrics
    assert json.loads((tmp_path / "values.json").read_text()) == metrics | searched
    assert (model / "fit.rrd").read_text() == "Image Jacobian from grasping"
    assert (model / "saved").exists()
    assert (model / commands.FOUND).exists() == unmarked
    ((shown, more),) = rows
    assert len(shown) + more["more"] == 3
    out = " ".join(capsys.readouterr().out.split())
    assert "Found: CAMERA." in out
    assert ("Found in the video: " in out) == unmarked


def test_an_evaluation_needs_the_positions_of_the_demonstrations(monkeypatch):
    demos = [SimpleNamespace(position=None)]
    monkeypatch.setattr(commands, "load_demos", lambda *given, **more: demos)
    args = Evaluate(dataset=Path("set"))
    with pytest.raises(ValueError, match="set: no end-effector positions to place a grid"):
        commands._image_jacobian_figures(args, None)


def test_an_image_jacobian_is_compared_upright_and_tilted(monkeypatch):
    """The grids lie around the demonstrated positions of all chosen episodes."""
    from hrc_learn.experiments import grasping_experiment

    grids, chosen = [], []
    demos = [SimpleNamespace(position=np.full((2, 3), 0.1 * k)) for k in (3, 4)]
    monkeypatch.setattr(
        commands, "load_demos", lambda path, episodes: chosen.append(episodes) or demos
    )
    monkeypatch.setattr(
        grasping_experiment, "held_out_grid", lambda shown, tilt: grids.append((shown, tilt))
    )
    monkeypatch.setattr(
        grasping_experiment,
        "compare_with_truth",
        lambda *given: {"relative_error_median": float(len(grids))},
    )
    args = Evaluate(dataset=Path("set"), episodes=(1, 2))
    assert commands._image_jacobian_figures(args, None) == {
        "upright_relative_error_median": 1.0,
        "tilted_relative_error_median": 2.0,
    }
    assert [tilt for _, tilt in grids] == [0.0, 0.1]
    np.testing.assert_allclose(grids[0][0][:, 0], [0.3, 0.3, 0.4, 0.4])
    commands._image_jacobian_figures(Evaluate(dataset=Path("set")), None)
    assert chosen == [(1, 2), None]


@pytest.mark.parametrize(("error", "status"), [(0.05, 0), (0.0501, 1)])
def test_an_image_jacobian_may_be_five_percent_off(monkeypatch, error, status):
    figures = {"upright_relative_error_median": error, "tilted_relative_error_median": 0.9}
    monkeypatch.setattr(commands, "_image_jacobian_figures", lambda *_: figures)
    skill = SimpleNamespace(load=lambda model: SimpleNamespace(jacobian=None))
    monkeypatch.setattr(commands, "VisualServoSkill", skill)
    assert commands.evaluate_image_jacobian(Evaluate(dataset=Path("set")), Path("m")) == status
