"""The paced loop as a user runs it."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from bare_arm import bare
from commands import hrc
from unchecked import shapes_unchecked
from urdf_text import to_urdf

from hrc_learn.cli.arguments import Serve
from hrc_learn.cli.loop_commands import _arm_of
from hrc_learn.experiments.real_arm import ArmSite


@pytest.fixture(autouse=True)
def _unchecked():
    """What is measured is how long a step takes, not how long its checks do."""
    with shapes_unchecked():
        yield


def check(figures: dict[str, float], steps: int) -> None:
    assert figures["steps"] == steps
    for kind in ("step", "late"):
        values = [figures[f"{kind}_p{p}_us"] for p in ("50", "90", "99", "99.9", "100")]
        assert values[0] > 0
        assert values == sorted(values)
    missed = figures["missed_ticks"]
    assert figures["missed_percent"] == pytest.approx(100 * missed / (steps + missed))
    # The arm starts outside its box: it has to speed up, and nothing else may happen to it.
    assert figures["safety_acceleration"] > 0
    assert figures["safety_invalid"] == figures["safety_stopped"] == 0


def test_it_reports_latencies_and_interventions(tmp_path):
    outcome = hrc(
        "serve",
        "--config",
        "step=eager",
        "--rate",
        "100",
        "--duration",
        "1",
        "--json",
        tmp_path / "j",
    )
    assert outcome.status == 0, outcome.error
    check(json.loads((tmp_path / "j").read_text()), steps=100)
    assert "step_p99_us" in outcome.output


def test_it_controls_an_arm_of_another_description(tmp_path):
    six = bare().chain
    file = tmp_path / "cut.urdf"
    file.write_text(to_urdf(six, "cut"), encoding="utf-8")
    options = ("--config", "step=eager", "--rate", "100", "--duration", "1")
    outcome = hrc("serve", "--robot", f"{file}:flange", *options, "--json", tmp_path / "j")
    assert outcome.status == 0, outcome.error
    check(json.loads((tmp_path / "j").read_text()), steps=100)


def test_a_driver_of_another_arm_is_bad_input(tmp_path):
    file = tmp_path / "cut.urdf"
    file.write_text(to_urdf(bare().chain, "cut"), encoding="utf-8")
    outcome = hrc("serve", "--robot", f"{file}:flange", "--arm", "franky", "--ip", "sim")
    assert outcome.status == 2
    assert "--arm franky drives Franka arms only, not the cut" in outcome.error


@pytest.mark.parametrize(
    ("options", "why"),
    [
        (("--rate", "0"), "--duration and --rate must be positive"),
        (("--rate", "inf"), "--duration and --rate must be positive and finite"),
        (("--duration", "inf"), "--duration and --rate must be positive and finite"),
        (("--rate", "4"), "--rate must be at least 5"),
        (("--ros2", "--rate", "100"), "--rate is not used by --ros2"),
        (("--arm", "lerobot", "--ip", "sim"), "--ip is for Franka arms"),
        (
            ("--arm", "franky", "--ip", "192.0.2.1", "--robot", "ur5e"),
            "--arm franky drives Franka arms only, not the ur5e",
        ),
    ],
)
def test_options_that_do_not_fit_are_bad_input(options, why):
    outcome = hrc("serve", *options)
    assert outcome.status == 2
    assert why in outcome.error


def test_the_shortest_run_has_one_step(tmp_path):
    options = ("--config", "step=eager", "--duration", 1e-6, "--json", tmp_path / "j")
    assert hrc("serve", *options).status == 0
    assert json.loads((tmp_path / "j").read_text())["steps"] == 1


@pytest.mark.parametrize(
    ("robot", "site", "name"),
    [("panda", "panda", "panda"), ("fr3", "panda", "fr3"), ("panda", "fr3", "fr3")],
)
def test_a_franka_arm_may_be_named_by_option_or_setting(robot, site, name):
    assert _arm_of(Serve(robot=robot), ArmSite(robot=site)).name == name


@pytest.mark.slow
def test_it_runs_a_package_and_starts_again_in_no_time(tmp_path):
    # In a process of its own: what is compiled must not be checked for shapes.
    program = [sys.executable, Path(__file__).parents[2] / "control" / "serve_controller.py"]
    arguments = ("--rate", "500", "--duration", "8", "--json")
    for attempt in ("first", "second"):
        outcome = subprocess.run(
            [*program, *arguments, tmp_path / attempt],
            capture_output=True,
            text=True,
            env={**os.environ, "OMP_NUM_THREADS": "1", "XDG_CACHE_HOME": str(tmp_path)},
        )
        assert outcome.returncode == 0, outcome.stderr
    figures = json.loads((tmp_path / "second").read_text())
    check(figures, steps=4000)
    assert figures["open_s"] < 2  # a compilation takes a minute
    assert figures["pixel_error"] < 5
