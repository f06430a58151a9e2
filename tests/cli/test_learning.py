"""The commands that learn, once, small."""

import json
import math
from contextlib import nullcontext

import numpy as np
import pytest
from commands import done
from lerobot_folders import joint_path, write_folder

from hrc_learn import distributed
from hrc_learn.cli import fit_command
from hrc_learn.cli.fit_command import open_moving
from hrc_learn.learning.reproduction_error import ReproductionError
from hrc_learn.viz.report import read_report


@pytest.fixture(scope="module")
def poses(tmp_path_factory):
    """A dataset of poses that move to different places, imported from an array."""
    folder = tmp_path_factory.mktemp("poses")
    s = np.linspace(0, 1, 80)[None, :, None]
    way = s**3 * (10 - 15 * s + 6 * s**2)
    goals = np.random.default_rng(0).uniform(0.2, 0.5, (4, 1, 3))
    turn = np.concatenate([np.cos(0.3 * way), np.sin(0.3 * way), 0 * way, 0 * way], axis=-1)
    array = np.concatenate([way * goals, np.broadcast_to(turn, (4, 80, 4))], axis=-1)
    np.save(folder / "poses.npy", array)
    columns = ("--columns", "px,py,pz,qw,qx,qy,qz", "--duration", 2)
    done("import", folder / "poses.npy", "--out", folder / "set", *columns)
    return folder / "set"


@pytest.fixture(scope="module")
def fitted(poses):
    """Model of positions and orientations of all demonstrations, and the output of its fit."""
    out = poses.with_name("fitted")
    fit = ("fit", "--dataset", poses, "--n-basis", 20, "--channels", "position", "orientation")
    return out, done(*fit, "--out", out).output


@pytest.mark.long
def test_fit_and_evaluate_on_demonstrations_held_out(poses, tmp_path):
    model = tmp_path / "model"
    done(
        *("fit", "--dataset", poses, "--out", model, "--n-basis", 20),
        *("--episodes", 0, 1, 2, "--channels", "position", "pose"),
    )
    assert {"position", "pose", "report.html"} <= {p.name for p in model.iterdir()}
    assert [p.name for p in read_report(model).pictures] == ["position"]
    outcome = done(
        *("evaluate", "--model", model, "--dataset", poses, "--out", tmp_path / "evaluation"),
        *("--most-nrmse", 0.2, "--json", tmp_path / "figures.json"),
    )
    assert "1 episodes that were not learned from" in outcome.output
    assert "[rad" in outcome.output  # of a heading that may be broken into lines
    figures = json.loads((tmp_path / "figures.json").read_text())
    assert figures["demonstrations"] == 1
    assert figures["position_goal_error_max"] < 0.01
    assert (tmp_path / "evaluation" / "pose.png").stat().st_size > 1000
    # The same demonstrations fail a demand that none can meet.
    done("evaluate", "--model", model, "--dataset", poses, "--most-nrmse", 1e-9, status=1)


def test_a_model_is_not_evaluated_on_other_joints_nor_against_an_impossible_limit(tmp_path):
    episodes = [{"observation.state": joint_path(40, seed=k)} for k in range(3)]
    sets = []
    for names, order in (("abc", [0, 1, 2]), ("cab", [2, 0, 1]), ("abd", [0, 1, 2])):
        moved = [{key: values[:, order] for key, values in one.items()} for one in episodes]
        sets.append(write_folder(tmp_path / names, moved, {"observation.state": [*names]}))
    fit = (
        "fit",
        "--dataset",
        sets[0],
        "--n-basis",
        10,
        "--episodes",
        0,
        1,
        "--channels",
        "joint",
    )
    done(*fit, "--units", "joint_position", "rad", "--out", tmp_path / "model")
    evaluate = ("evaluate", "--model", tmp_path / "model", "--dataset")
    figures = tmp_path / "figures.json"
    done(*evaluate, sets[0], "--episodes", 2, "--json", figures)
    first = json.loads(figures.read_text())
    assert done(*evaluate, sets[2], status=2).error.startswith("error: no joint named c")
    for limit in ("nan", "-1"):
        refused = done(*evaluate, sets[0], "--most-nrmse", limit, status=2).error
        assert refused == f"error: --most-nrmse must not be negative, but is {float(limit)}\n"
    # The same motions with their joints in another order.
    done(*evaluate, sets[1], "--episodes", 2, "--json", figures)
    assert json.loads(figures.read_text()) == pytest.approx(first)


@pytest.mark.long
def test_an_episode_of_one_frame_is_left_out_of_a_fit_with_a_note(tmp_path):
    lengths = (60, 1, 50, 1)
    episodes = [{"observation.state": joint_path(n, seed=n)} for n in lengths]
    root = write_folder(tmp_path / "set", episodes, {"observation.state": ["a", "b", "c"]})
    fit = ("fit", "--dataset", root, "--units", "joint_position", "rad", "--n-basis", 10)
    output = done(*fit, "--out", tmp_path / "model").output
    assert "episodes of a single frame are left out: 1, 3" in " ".join(output.split())
    assert "demonstrations │ 2" in " ".join(output.replace("│", " │ ").split())
    # The evaluation leaves them out as well, with and without that model.
    for model in ((), ("--model", tmp_path / "model")):
        done("evaluate", "--dataset", root, *model, "--json", tmp_path / "f.json")
        figures = json.loads((tmp_path / "f.json").read_text())
        assert figures["demonstrations"] == (2 if model else 1)


def test_episodes_of_a_single_frame_are_read_only_if_they_are_named(tmp_path):
    episodes = [{"observation.state": joint_path(n, seed=n)} for n in (1, 2, 3, 1)]
    root = write_folder(tmp_path, episodes, {"observation.state": ["a", "b", "c"]})
    units = {"joint_position": "rad"}
    source, notes = open_moving(root, (), units=units)
    assert [demo.episode for demo in source] == [1, 2]
    assert notes == ["episodes of a single frame are left out: 0, 3"]
    for chosen in ([1], [0, 2]):
        source, notes = open_moving(root, chosen, units=units)
        assert ([demo.episode for demo in source], notes) == (chosen, [])


def test_an_evaluation_reads_the_dataset_as_its_fit_did(poses, tmp_path):
    model = tmp_path / "model"
    done(
        *("fit", "--dataset", poses, "--out", model, "--episodes", 0, 1, "--n-basis", 20),
        *("--channels", "position", "--units", "position", "mm"),
    )
    evaluate = ("evaluate", "--model", model, "--dataset", poses, "--json", tmp_path / "f.json")
    done(*evaluate)
    # A motion of half a metre, read as half a millimetre.
    figures = json.loads((tmp_path / "f.json").read_text())
    assert figures["position_largest_max"] < 1e-3


@pytest.mark.parametrize("rank", [0, 1])
def test_one_of_several_processes_prints_and_writes(poses, tmp_path, monkeypatch, rank):
    """The others fit their part of the demonstrations in silence."""
    demos, _ = open_moving(poses, ())
    demos.notes = ("a guess",)
    monkeypatch.setattr(fit_command, "_open", lambda args: (demos, ["one is left out"]))
    monkeypatch.setattr(distributed, "processes", lambda: nullcontext(rank))
    model = tmp_path / "model"
    fit = ("fit", "--dataset", poses, "--n-basis", 10, "--several", "streamed")
    output = done(*fit, "--channels", "position", "--out", model).output
    notes = [line for line in output.splitlines() if line.startswith("note: ")]
    assert notes == ([] if rank else ["note: one is left out", "note: a guess"])
    assert model.exists() == (rank == 0)
    assert ("Model" in output) == (rank == 0)


def test_an_evaluation_on_what_was_learned_from_says_so(poses, tmp_path):
    model = tmp_path / "model"
    fit = ("fit", "--dataset", poses, "--out", model, "--n-basis", 10, "--several", "streamed")
    done(*fit, "--channels", "position", "--episodes", 0, 1, 2, 3)
    output = done("evaluate", "--model", model, "--dataset", poses).output
    assert "all of these demonstrations were learned from" in output
    assert "not learned from" not in output
    every = ("evaluate", "--dataset", poses, "--episodes", 0, 1, 2, 3)
    assert "leaves none to fit" in done(*every, status=2).error


@pytest.mark.parametrize("content", ["{}", '{"dataset": 3}', "{"])
def test_a_model_that_names_no_dataset_is_refused(poses, tmp_path, content):
    model = tmp_path / "model"
    (model / "position").mkdir(parents=True)
    (model / "made_by.json").write_text(content)
    error = done("evaluate", "--model", model, "--dataset", poses, status=2).error
    assert str(model / "made_by.json") in error


def test_an_error_of_nan_meets_no_limit(poses, fitted, monkeypatch):
    model, _ = fitted
    monkeypatch.setattr(
        ReproductionError, "summary", lambda *_: {"position_nrmse_median": math.nan}
    )
    command = ("evaluate", "--model", model, "--dataset", poses)
    done(*command)
    done(*command, "--most-nrmse", 0.5, status=1)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--several", "streamed", "--method", "ridge"), "--method is not used by"),
        (("--several", "streamed", "--scaling", "amplitude"), "--scaling is not used by"),
        (("--several", "streamed", "--context", "size"), "--context is not used by"),
        (("--several", "streamed", "--n-basis", "None"), "--n-basis 60"),
        (("--several", "streamed", "--n-basis", 0), "at least 2 functions, got 0"),
        (("--several", "mean", "--context", "size"), "--context is not used by"),
        (("--scaling", "amplitude", "--context", "size"), "--context is not used by"),
        (("--episodes", 0, 1, 0), "--episodes names 0 more than once"),
    ],
)
def test_options_that_would_be_ignored_are_refused(poses, tmp_path, options, message):
    out = tmp_path / "model"
    fit = ("fit", "--dataset", poses, "--out", out, "--channels", "position")
    assert message in done(*fit, *options, status=2).error
    assert not out.exists()


def test_an_episode_counts_once_wherever_episodes_are_named(poses, tmp_path):
    for command in (("fit", "image-jacobian"), ("evaluate",)):
        error = done(*command, "--dataset", poses, "--episodes", 1, 1, status=2).error
        assert "--episodes names 1 more than once" in error


def test_a_streamed_fit(poses, tmp_path):
    done(
        *("fit", "--dataset", poses, "--out", tmp_path / "model"),
        *("--several", "streamed", "--channels", "position", "--n-basis", 15),
    )
    metrics = json.loads((tmp_path / "model" / "metrics.json").read_text())
    assert metrics["frames"] == 320
    assert metrics["mean_position_rmse"] < 0.05


def test_nothing_is_overwritten_unasked(poses, tmp_path):
    arguments = ("fit", "--dataset", poses, "--out", tmp_path / "model", "--n-basis", 5)
    arguments += ("--several", "streamed", "--channels", "position")
    done(*arguments)
    made_by = tmp_path / "model" / "made_by.json"
    before = made_by.read_text()
    assert "exists" in done(*arguments, status=2).error
    assert made_by.read_text() == before
    done(*arguments, "--episodes", 0, 1, "--overwrite")
    assert made_by.read_text() != before


def test_a_missing_dataset_and_unknown_joints_are_bad_input(tmp_path):
    joints, out = tmp_path / "joints", tmp_path / "none"
    np.savez(tmp_path / "joints.npz", t=0.01 * np.arange(20), q=np.zeros((20, 2)))
    done("import", tmp_path / "joints.npz", "--out", joints, "--joints", "q", "--time", "t")
    outcome = done("fit", "--dataset", tmp_path / "absent", "--out", out, status=2)
    assert "absent" in outcome.error
    outcome = done("fit", "--dataset", joints, "--out", out, "--joint-names", "elbow", status=2)
    assert "elbow" in outcome.error
    assert "joint1" in outcome.error
    assert not out.exists()


def test_an_evaluation_without_a_model_holds_demonstrations_out(poses, tmp_path):
    outcome = done("evaluate", "--dataset", poses, "--json", tmp_path / "figures.json")
    assert "1 episodes that were not learned from" in outcome.output
    assert json.loads((tmp_path / "figures.json").read_text())["demonstrations"] == 1
    # The model was for this once.
    assert [path.name for path in tmp_path.iterdir()] == ["figures.json"]


def test_a_fit_shows_few_rows_with_units(fitted):
    model, output = fitted
    metrics = json.loads((model / "metrics.json").read_text())
    (row,) = [line for line in output.splitlines() if "worst NRMSE" in line]
    assert "< 0.01 %" in row
    assert "ok" in row
    (row,) = [line for line in output.splitlines() if "median NRMSE" in line]
    assert f"{100 * metrics['mean_position_nrmse_median']:.3g} %" in row
    rows = [line for line in output.splitlines() if line.startswith("│")]
    assert 4 <= len(rows) <= 8
    assert f"{len(metrics) - len(rows)} more" in output


def test_an_evaluation_uses_the_model_that_predicts_best(poses, fitted):
    model, output = fitted
    assert "held-out NRMSE, by a regression" in output
    metrics = json.loads((model / "metrics.json").read_text())
    kind = json.loads((model / "prediction.json").read_text())["models"]["position"]
    errors = [metrics[f"held_out_position_{m}_nrmse_median"] for m in ("mean", kind)]
    assert errors[1] <= errors[0]
    if kind != "mean":
        assert "position: " in output
        assert f"{kind} model" in done("evaluate", model, poses).output


def test_a_policy_of_a_dataset_without_actions_names_the_cure(poses, tmp_path):
    np.savez(
        tmp_path / "q.npz", t=0.01 * np.arange(50), q=np.linspace(0, 1, 100).reshape(50, 2)
    )
    bare = tmp_path / "bare"
    arguments = ("--joints", "q", "--time", "t", "--no-actions")
    done("import", tmp_path / "q.npz", "--out", bare, *arguments)
    out = tmp_path / "policy"
    outcome = done("fit", "--dataset", bare, "--out", out, "--as-lerobot-policy", status=2)
    assert "no actions" in outcome.error
    assert "hrc import --actions" in outcome.error
    done("fit", "--dataset", poses, "--out", out, "--as-lerobot-policy", "--n-basis", 20)
    assert (out / "model.safetensors").is_file()
