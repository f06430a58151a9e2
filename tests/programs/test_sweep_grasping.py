import json
import subprocess
import sys
from pathlib import Path

PROGRAM = Path(__file__).parents[2] / "control" / "sweep_grasping.py"


def sweep(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, PROGRAM, *arguments], capture_output=True, text=True, timeout=300
    )


def test_it_writes_one_flat_object_of_figures(tmp_path: Path):
    done = sweep(
        *("--only", "near", "stress_late", "--trials", "5"),
        *("--json", str(tmp_path / "figures.json"), "--figure", str(tmp_path / "times.png")),
    )
    assert done.returncode == 0, done.stderr
    figures = json.loads((tmp_path / "figures.json").read_text())
    assert figures["near_success"] == 1.0
    assert figures["near_violations"] == 0
    assert figures["near_t95"] < 8
    assert figures["stress_late_rollouts"] == 5
    assert figures["stress_late_beyond_position"] == 0
    assert "met" in done.stdout
    assert (tmp_path / "times.png").stat().st_size > 1000


def test_an_unknown_experiment_ends_in_one_line():
    done = sweep("--only", "far")
    assert done.returncode == 2
    assert done.stderr.startswith("error: no experiment 'far'; there are near, global")
    assert done.stderr.count("\n") == 1
