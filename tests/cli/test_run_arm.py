"""`hrc run --arm`: which combinations of options there are."""

from dataclasses import replace

import pytest

from hrc_learn.cli.arguments.run import RunCollaboration, RunGrasping, RunPlacing
from hrc_learn.cli.commands import run as commands

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
