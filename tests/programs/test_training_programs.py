"""The training programs once, small, as a user runs them."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[2]


def run(program, *arguments, status=0):
    done = subprocess.run(
        [sys.executable, program, *map(str, arguments)],
        cwd=ROOT,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode == status, done.stdout + done.stderr
    return done


@pytest.fixture(scope="module")
def poses(tmp_path_factory):
    """A dataset of hands that move to different places, imported from an array."""
    folder = tmp_path_factory.mktemp("poses")
    s = np.linspace(0, 1, 80)[None, :, None]
    way = s**3 * (10 - 15 * s + 6 * s**2)
    goals = np.random.default_rng(0).uniform(0.2, 0.5, (4, 1, 3))
    turn = np.concatenate([np.cos(0.3 * way), np.sin(0.3 * way), 0 * way, 0 * way], axis=-1)
    array = np.concatenate([way * goals, np.broadcast_to(turn, (4, 80, 4))], axis=-1)
    np.save(folder / "poses.npy", array)
    columns = ("--columns", "px,py,pz,qw,qx,qy,qz", "--duration", 2)
    run("datasets/import_arrays.py", folder / "poses.npy", "--out", folder / "set", *columns)
    return folder / "set"


def test_fit_and_evaluate_on_demonstrations_held_out(poses, tmp_path):
    model = tmp_path / "model"
    run(
        *("training/fit_dmp.py", "--dataset", poses, "--out", model, "--n-basis", 20),
        *("--episodes", 0, 1, 2, "--channels", "position", "pose", "--several", "contextual"),
    )
    assert {"position", "pose", "contextual", "position.png"} <= {
        p.name for p in model.iterdir()
    }
    done = run(
        *("training/evaluate.py", model, poses, "--out", tmp_path / "evaluation"),
        *("--most-nrmse", 0.2, "--json", tmp_path / "figures.json"),
    )
    assert "1 episodes that were not learned from" in done.stdout
    figures = json.loads((tmp_path / "figures.json").read_text())
    assert figures["demonstrations"] == 1
    assert figures["position_goal_error_max"] < 0.01
    assert (tmp_path / "evaluation" / "pose.png").stat().st_size > 1000
    # The same demonstrations fail a demand that none can meet.
    run("training/evaluate.py", model, poses, "--most-nrmse", 1e-9, status=1)


def test_a_streamed_fit(poses, tmp_path):
    run(
        *("training/fit_dmp.py", "--dataset", poses, "--out", tmp_path / "model"),
        *("--several", "streamed", "--channels", "position", "--n-basis", 15),
    )
    metrics = json.loads((tmp_path / "model" / "metrics.json").read_text())
    assert metrics["frames"] == 320
    assert metrics["mean_position_rmse"] < 0.05


@pytest.mark.slow
def test_a_search_for_gains_is_taken_up_again(tmp_path):
    few = ("--population", 3, "--starts.count", 4, "--starts.duration", 0.3)
    out, place = tmp_path / "gains", tmp_path / "gains.search.json"
    run("training/tune_controller.py", "--out", out, "--generations", 2, *few)
    gains = json.loads((out / "gains.json").read_text())
    assert set(gains) == {"vision_rate", "linear_speed", "angular_speed"}
    assert not place.exists()
    run("training/tune_controller.py", "--out", out, "--resume", *few, status=2)
