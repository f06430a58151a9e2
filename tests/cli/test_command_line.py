"""What every command promises on the command line: quick help that fits a screen, choices and
options checked before any work, errors of one line.
"""

import dataclasses
import json
import subprocess
import sys
import typing
from pathlib import Path

import numpy as np
import pytest
from clean_sets import SETS, write_set
from commands import done, hrc

from hrc_learn import cli
from hrc_learn.cli import _options
from hrc_learn.cli import arguments as choices
from hrc_learn.cli._commands import COMMANDS
from hrc_learn.cli._options import short_help
from hrc_learn.cli.arguments.dataset import Repair
from hrc_learn.demos import RepairOptions
from hrc_learn.dmp.forcing_scale import SCALINGS
from hrc_learn.experiments.grasping.experiment import VARIANTS
from hrc_learn.kinematics import MissingModelError
from hrc_learn.learning.channels import CHANNELS
from hrc_learn.sim import CameraKind
from hrc_learn.sim.workplace import Workplace

HEAVY = (
    "torch",
    "numpy",
    "mujoco",
    "rerun",
    "lerobot",
    "matplotlib",
    "scipy",
    "pyarrow",
    "cv2",
)
SCREEN = 40
"""Lines."""
SAME_EVERYWHERE = {
    "dataset": "Path",
    "out": "Path",
    "port": "int",
    "trials": "int",
    "seed": "int",
    "json": "Path",
    "overwrite": "bool",
}
every_command = pytest.mark.parametrize("name", COMMANDS)


def words(text: str) -> str:
    """Text without the frames and line breaks of a terminal."""
    for character in "│╭╮╰╯─":
        text = text.replace(character, " ")
    return " ".join(text.split())


def test_help_waits_for_no_library():
    """Of all commands, one after another in a fresh interpreter."""
    program = f"""
import contextlib, io, sys
from hrc_learn import cli
from hrc_learn.cli._commands import COMMANDS
for name in ["", *COMMANDS]:
    sys.argv = ["hrc", *name.split(), "--help"]
    with contextlib.redirect_stdout(io.StringIO()), contextlib.suppress(SystemExit):
        cli.main()
print([name for name in {HEAVY} if name in sys.modules])
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.stdout.strip() == "[]", done.stderr


@pytest.mark.parametrize("name", ["", "run", "record", *COMMANDS])
def test_help_fits_a_screen(name, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    status, output, error = hrc(*name.split(), "--help")
    assert (status, error) == (0, "")
    lines = output.splitlines()
    assert len(lines) <= SCREEN
    assert max(map(len, lines)) <= 82  # an option that is longer than its column ends later


def test_the_first_screen_lists_every_command():
    listed = hrc("--help").output
    assert not [name for name in COMMANDS if name not in listed]


@every_command
def test_every_option_is_explained(name):
    arguments = COMMANDS[name].arguments_type()
    texts = _options.docstrings(arguments)
    assert not [
        field.name for field in dataclasses.fields(arguments) if not texts.get(field.name)
    ]


@every_command
def test_all_options_are_shown_on_request(name):
    status, output, _ = hrc(*name.split(), "--help-all")
    assert status == 0
    shown, arguments = words(output), COMMANDS[name].arguments_type()
    texts, details = _options.docstrings(arguments), _options.details(arguments)
    for field in dataclasses.fields(arguments):
        option = field.name.replace("_", "-")
        assert texts[field.name] in shown
        assert f"--{option}{'.' if field.name in details else ''}" in shown or (
            field.name in ("files", "runs")  # positional
        )


@every_command
def test_the_same_thing_is_called_the_same(name):
    hints = typing.get_type_hints(COMMANDS[name].arguments_type())
    assert "json" in hints
    assert not hints.keys() & {"seeds", "output", "data"}
    for option, kind in SAME_EVERYWHERE.items():
        if option in hints:
            assert kind in str(hints[option])


def test_the_short_help_says_what_is_required_and_the_defaults():
    text = words(short_help("hrc extract", COMMANDS["extract"].arguments_type()))
    assert "--marker INT Number of the marker, of OpenCV's ArUco" in text
    assert "with its videos. Required." in text
    assert "[60]" in hrc("fit", "--help").output
    assert "--no-learn for off" in words(hrc("fit", "image-jacobian", "--help").output)


@pytest.mark.parametrize(
    ("alias", "known"),
    [
        (choices.Shelf, Workplace().shelf_names()),
        (choices.Camera, typing.get_args(CameraKind)),
        (choices.Channel, CHANNELS),
        (choices.Scaling, SCALINGS),
        (choices.Variant, [*VARIANTS, "none"]),
    ],
    ids=["shelf", "camera", "kind", "scaling", "variant", "experiment"],
)
def test_choices_are_those_that_there_are(alias, known):
    assert set(typing.get_args(alias)) == set(known)


def test_options_of_a_repair_are_those_of_the_package():
    here = {field.name: field.default for field in dataclasses.fields(Repair)}
    for field in dataclasses.fields(RepairOptions):
        assert here[field.name] == field.default


@pytest.mark.parametrize(
    ("typed", "message"),
    [
        (("demo", "--shelf", "top"), "'lower', 'middle', 'upper'"),
        (("run", "collaboration", "--shelf", "top"), "'lower', 'middle', 'upper'"),
        (("demo", "--robot", "ur99"), "no arm 'ur99': there are panda, fr3"),
        (("fit", "--datset", "demos", "--dataset", "x"), "--datset demos; perhaps --dataset"),
        (("fit", "--datset", "demos"), "--datset demos"),
        (("fit",), "missing: --dataset (see hrc fit primitives --help)"),
        (("run", "collaboration", "--config.speedy", 3), "--config.speedy"),
        (("record", "placing", "--out", "x", "--episodes", "few"), "--episodes"),
        (("dance",), "no command 'dance' of hrc; there are demo, record"),
        (("run", "dance"), "there are placing, grasping, collaboration"),
        (("check", "none"), "no dataset at none"),
        (("import", "none.npz", "--out", "new"), "none.npz"),
        (("fit", "--dataset", "none", "--out", "new"), "none"),
        (("fit", "image-jacobian", "--dataset", "none", "--out", "new"), "none"),
        (("evaluate", "none", "none"), "none"),
        (("evaluate", "--dataset", "none"), "no dataset at none"),
        (("evaluate", "image-jacobian", "none", "none"), "none"),
        (("recover", "none"), "none"),
        (("smooth", "--checkpoint", "none"), "no folder none"),
        (
            ("run", "collaboration", "--placing", "none", "--aiming", "none", "--out", "new"),
            "none",
        ),
    ],
    ids=lambda value: " ".join(map(str, value)) if isinstance(value, tuple) else "",
)
def test_bad_input_is_one_line_and_leaves_nothing(monkeypatch, tmp_path, typed, message):
    monkeypatch.chdir(tmp_path)
    status, _, error = hrc(*typed)
    assert status == 2
    assert message in error
    assert error.startswith("error: ")
    assert error.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_a_command_without_its_second_word_is_listed():
    status, output, _ = hrc("record")
    assert status == 2
    assert "record servoing" in output
    assert "run placing" not in output


def test_a_missing_library_names_the_extra_that_brings_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "hrc_learn.cli.commands.show", None)

    def missing(_):
        raise ModuleNotFoundError("No module named 'mujoco'", name="mujoco.viewer")

    monkeypatch.setattr(type(COMMANDS["show"]), "work", lambda *_: missing(None))
    status, _, error = hrc("show", "x", "--out", "y")
    assert status == 1
    assert error == (
        "error: mujoco is not installed, which this needs: pip install 'hrc-learn[sim]'\n"
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class Nothing:
    """No option at all."""


def run(monkeypatch, main) -> object:
    """Exit status of a program."""
    monkeypatch.setattr(sys, "argv", ["program"])
    with pytest.raises(SystemExit) as ended:
        cli.run(main, Nothing)
    return ended.value.code


@pytest.mark.parametrize(
    ("error", "status", "line"),
    [
        (ValueError("two\nlines"), 2, "error: two lines\n"),
        (FileNotFoundError(2, "No such file or directory", "/x"), 2, "error: /x: No such file"),
        (PermissionError(13, "Permission denied", "/x"), 2, "error: /x: Permission denied\n"),
        (IsADirectoryError(21, "Is a directory", "/x"), 2, "error: /x: Is a directory\n"),
        (KeyboardInterrupt(), 1, "interrupted\n"),
        (ModuleNotFoundError("no tyro", name="tyro"), 1, "error: tyro is not installed"),
        (ModuleNotFoundError("none", name="httpx"), 1, "error: httpx is not installed, which"),
        (MissingModelError("get it", name="robosuite"), 1, "error: get it\n"),
    ],
)
def test_the_users_mistakes_end_in_one_line(monkeypatch, capsys, error, status, line):
    def main(_):
        raise error

    monkeypatch.setattr("warnings.formatwarning", None)
    assert run(monkeypatch, main) == status
    assert capsys.readouterr().err.startswith(line)


def test_a_module_that_nobody_told_of_shows_where_it_was_missed(monkeypatch):
    def main(_):
        raise ModuleNotFoundError("No module named 'ours'", name="ours")

    with pytest.raises(ModuleNotFoundError):
        run(monkeypatch, main)


@pytest.mark.parametrize("error", [KeyError("ours"), OSError("of no file"), BrokenPipeError()])
def test_our_own_mistakes_are_not_taken_for_the_users(monkeypatch, error):
    def main(_):
        raise error

    monkeypatch.setattr("warnings.formatwarning", None)
    with pytest.raises(type(error)):
        run(monkeypatch, main)


def test_measured_values_are_written_whole_or_not_at_all(tmp_path):
    path = tmp_path / "new" / "values.json"
    cli.write_json(path, {"a": 1, "b": np.float32(0.5), "c": float("nan"), "d": np.int64(3)})
    assert json.loads(path.read_text()) == {"a": 1, "b": 0.5, "c": None, "d": 3}
    before = path.read_bytes()
    with pytest.raises(TypeError):
        cli.write_json(path, {"a": object()})  # pyright: ignore[reportArgumentType]
    assert path.read_bytes() == before
    assert [p.name for p in path.parent.iterdir()] == ["values.json"]


def test_configurations_are_resolved_to_their_defaults_or_to_what_was_given():
    arguments = COMMANDS["run collaboration"].arguments_type()
    from hrc_learn.cli._run import parse
    from hrc_learn.skills.pick_and_place import PickAndPlaceConfig

    plain = _options.resolved(parse(arguments, ["--seed", "3"], "hrc"))
    assert plain.config == PickAndPlaceConfig()
    typed = ["--config.grasping.attempts", "5", "--seed", "3"]
    given = _options.resolved(parse(arguments, typed, "hrc"))
    assert given.config.grasping.attempts == 5
    assert given.config.speed == plain.config.speed
    assert given.seed == 3
    # What is kept with a run has nothing left open.
    assert "Detail" not in str(dataclasses.asdict(given)) + str(dataclasses.asdict(plain))


def test_a_dataset_may_be_where_one_is(monkeypatch, tmp_path):
    write_set(tmp_path / "set", **SETS["v2.0"])
    monkeypatch.chdir(tmp_path / "set")
    done("show", ".", "--out", tmp_path / "shown.rrd")
    done("fit", "--dataset", ".", "--n-basis", 10)
    assert (tmp_path / "set_model" / "metrics.json").is_file()
    done("repair", ".", "--dry-run")
    assert Repair(dataset=Path(".")).folder == tmp_path / "set_repaired"
    assert Repair(dataset=Path("set")).folder == Path("set_repaired")
