"""`--arm`: which combinations of options there are, and commands through a real driver."""

import json
from dataclasses import replace

import numpy as np
import pytest
from commands import hrc
from unchecked import shapes_unchecked

from hrc_learn.cli.arguments.run import RunCollaboration, RunGrasping, RunPlacing
from hrc_learn.cli.commands import run as commands
from hrc_learn.demos import load_demos

COMMANDS = [
    (commands.run_placing, RunPlacing),
    (commands.run_grasping, RunGrasping),
    (commands.run_collaboration, RunCollaboration),
]


@pytest.fixture
def models(tmp_path):
    """Folders that are there, which is all that is looked at before the arm."""
    folders = {name: tmp_path / name for name in ("placing", "aiming")}
    for folder in folders.values():
        folder.mkdir()
    return folders


def arguments(kind, models, tmp_path, **options):
    own = {name: path for name, path in models.items() if name in kind.__dataclass_fields__}
    return replace(kind(out=tmp_path / "out"), **own, **options)


@pytest.mark.parametrize(("command", "kind"), COMMANDS)
@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"arm": "franky"}, "--ip"),
        ({"ip": "172.16.0.2"}, "--arm franky"),
        ({"arm": "franka", "ip": "172.16.0.2", "trials": 3}, "--trials is for simulated"),
        ({"arm": "franky", "ip": "172.16.0.2", "serve": True}, "--serve is for simulated"),
    ],
)
def test_options_that_exclude_each_other_are_refused(
    command, kind, options, message, models, tmp_path
):
    with pytest.raises(ValueError, match=message):
        command(arguments(kind, models, tmp_path, **options))
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("command", "kind"), COMMANDS[1:])
def test_a_real_camera_needs_a_real_arm(command, kind, models, tmp_path):
    with pytest.raises(ValueError, match=r"--camera /dev/video0: the simulated work cell has"):
        command(arguments(kind, models, tmp_path, camera="/dev/video0"))


@pytest.mark.parametrize(
    "command",
    [
        ("record", "placing", "--out", "{out}"),
        ("record", "servoing", "--out", "{out}"),
        ("page", "--out", "{out}"),
        ("serve",),
    ],
)
def test_a_driver_needs_an_address_in_every_command(command, tmp_path):
    words = [word.format(out=tmp_path / "out") for word in command]
    outcome = hrc(*words, "--arm", "franky")
    assert outcome.status == 2
    assert "--arm franky needs --ip" in outcome.error
    assert not (tmp_path / "out").exists()


def test_a_script_demonstrates_on_no_real_arm(tmp_path):
    words = ("record", "placing", "--out", tmp_path / "out")
    outcome = hrc(*words, "--arm", "franka", "--ip", "172.16.0.2")
    assert outcome.status == 2
    assert "hrc page --arm franka --ip 172.16.0.2" in outcome.error
    assert not (tmp_path / "out").exists()


@pytest.mark.realtime
@shapes_unchecked()
def test_the_loop_of_the_controller_leads_an_arm_through_its_driver(tmp_path):
    pytest.importorskip("franky")
    words = ("serve", "--arm", "franky", "--ip", "sim", "--step", "eager", "--rate", "50")
    outcome = hrc(*words, "--duration", "2", "--json", tmp_path / "figures")
    assert outcome.status == 0, outcome.error
    figures = json.loads((tmp_path / "figures").read_text())
    assert figures["steps"] == 100
    assert figures["safety_acceleration"] > 0  # it has moved
    assert figures["safety_invalid"] == figures["safety_stopped"] == 0


@pytest.mark.realtime
@pytest.mark.slow
@shapes_unchecked()
def test_a_demonstration_is_recorded_through_the_driver(tmp_path):
    pytest.importorskip("franky")
    words = ("record", "placing", "--episodes", "1", "--seed", "3")
    for name, driver in (("direct", ()), ("driven", ("--arm", "franky", "--ip", "sim"))):
        outcome = hrc(*words, *driver, "--out", tmp_path / name)
        assert outcome.status == 0, outcome.error
    (direct,), (driven,) = (load_demos(tmp_path / name) for name in ("direct", "driven"))
    offset = driven.joint_position[-1] - direct.joint_position[-1]
    # The same motion, a few milliseconds behind, ends at the same place.
    assert np.abs(offset).max() < 5e-3
