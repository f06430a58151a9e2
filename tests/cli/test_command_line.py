"""Promises of every command: quick help, choices checked before any work, one-line errors."""

import ast
import dataclasses
import inspect
import json
import subprocess
import sys
import typing
from dataclasses import dataclass, field
from fractions import Fraction
from importlib import metadata
from itertools import pairwise
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
from clean_sets import SETS, write_set
from commands import done, hrc

from hrc_learn import cli
from hrc_learn.cli import arguments
from hrc_learn.cli._commands import COMMANDS
from hrc_learn.cli._run import gathered_settings, parse, with_settings
from hrc_learn.cli.arguments import Serve
from hrc_learn.dmp.forcing_scale import SCALINGS
from hrc_learn.kinematics import MissingModelError
from hrc_learn.learning.primitive_fitting import CHANNELS
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
MOST_COMMANDS, MOST_OPTIONS = 20, 180
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


def test_the_command_line_keeps_its_budget():
    options = cli.commands()
    assert len(options) <= MOST_COMMANDS
    assert sum(map(len, options.values())) <= MOST_OPTIONS


def test_the_page_of_commands_lists_every_command():
    page = Path(__file__).parents[2] / "docs" / "howto" / "commands.md"
    text = page.read_text(encoding="utf-8")
    assert not [name for name in COMMANDS if f"`hrc {name}" not in text]


def test_the_version_is_that_of_the_package():
    status, output, error = hrc("--version")
    assert (status, output, error) == (0, f"{metadata.version('hrc-learn')}\n", "")


def test_help_waits_for_no_library():
    """Help of all commands, one after another in a fresh interpreter."""
    program = f"""
import contextlib, io, sys
from hrc_learn import cli
for name in ["", *cli.commands()]:
    sys.argv = ["hrc", *name.split(), "--help"]
    with contextlib.redirect_stdout(io.StringIO()), contextlib.suppress(SystemExit):
        cli.main()
print([name for name in {HEAVY} if name in sys.modules])
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.stdout.strip() == "[]", done.stderr


def test_the_first_screen_lists_every_command(monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    status, listed, error = hrc("--help")
    assert (status, error) == (0, "")
    assert not [name for name in COMMANDS if name not in listed]
    assert max(map(len, listed.splitlines())) <= 86
    assert hrc().status == 2


@every_command
def test_help_lists_every_option(name):
    status, output, _ = hrc(*name.split(), "--help")
    assert status == 0
    assert not [option for option in cli.commands()[name] if f"--{option}" not in output]


@every_command
def test_help_fits_a_terminal_of_80_columns(monkeypatch, name):
    monkeypatch.setenv("COLUMNS", "80")
    _, output, _ = hrc(*name.split(), "--help")
    # Commands to paste keep their lines.
    prose = [line for line in output.splitlines() if not line.startswith("    ")]
    assert not [line for line in prose if len(line) > 80]


def test_every_option_is_explained():
    for cls in ast.walk(ast.parse(inspect.getsource(arguments))):
        if isinstance(cls, ast.ClassDef):
            for field_, after in pairwise([*cls.body, None]):
                assert not isinstance(field_, ast.AnnAssign) or isinstance(after, ast.Expr)


@every_command
def test_the_same_option_has_the_same_name_and_type(name):
    hints = typing.get_type_hints(COMMANDS[name].arguments)
    assert "json" in hints
    assert not hints.keys() & {"seeds", "output", "data"}
    for option, kind in SAME_EVERYWHERE.items():
        if option in hints:
            assert kind in str(hints[option])


@pytest.mark.parametrize(
    ("alias", "known"),
    [
        (arguments.Shelf, Workplace().shelf_names()),
        (arguments.Channel, CHANNELS),
        (arguments.Scaling, SCALINGS),
    ],
    ids=["shelf", "channel", "scaling"],
)
def test_choices_are_those_of_the_package(alias, known):
    assert set(typing.get_args(alias)) == set(known)


@pytest.mark.parametrize(
    ("typed", "message"),
    [
        (("demo", "--shelf", "top"), "'lower', 'middle', 'upper'"),
        (("run", "collaboration", "--shelf", "top"), "'lower', 'middle', 'upper'"),
        (("demo", "--robot", "ur99"), "no arm 'ur99': there are panda, fr3"),
        (("fit", "--datset", "demos", "--dataset", "x"), "did you mean --dataset?"),
        (("fit", "--datset", "demos"), "--datset demos"),
        (("fit",), "missing: --dataset (see hrc fit --help)"),
        (("record", "placing", "--out", "x", "--episodes", "few"), "--episodes"),
        (("record", "placing", "--out", "x", "--episodes", 0), "must be at least 1"),
        (("evalute", "x"), "hrc has no command 'evalute'; did you mean evaluate?"),
        (("dance",), "hrc has no command 'dance'; it has demo, run"),
        (("run", "dance"), "'placing', 'grasping', 'collaboration'"),
        (("run", "placing", "--worker"), "--worker is an option of hrc run collaboration"),
        (
            ("run", "grasping", "--placing", "x"),
            "--placing is an option of hrc run placing",
        ),
        (
            ("run", "grasping", "--shelf", "upper"),
            "--shelf is an option of hrc run",
        ),
        (("run", "placing", "--shelf", "upper"), "--shelf of placing is for a real arm"),
        (
            ("record", "leader", "--out", "new", "--overwrite"),
            "hrc record placing, servoing",
        ),
        (("record", "servoing", "--out", "new", "--shelf", "upper"), "--shelf is an option of"),
        (("run", "placing", "--arm", "franky"), "--arm franky needs --ip"),
        (("run", "grasping", "--ip", "172.16.0.2"), "needs a driver: --arm franky"),
        (
            ("run", "placing", "--arm", "franka", "--ip", "172.16.0.2", "--trials", 3),
            "--trials is for simulated",
        ),
        (
            ("run", "grasping", "--arm", "ros2", "--robot", "ur5e"),
            "--robot is for simulated arms",
        ),
        (
            ("run", "placing", "--arm", "ros2", "--shelf", "lower", "upper"),
            "hrc run placing places one object: give one --shelf",
        ),
        (("run", "placing", "--arm", "ros2", "--shelf"), "places one object: give one --shelf"),
        (("page", "--out", "x", "--arm", "franky"), "--arm franky needs --ip"),
        (("serve", "--arm", "franky"), "--arm franky needs --ip"),
        (("serve", "--config", "site.speeed=1"), "site.speeed: no such setting; did you mean"),
        (("check", "none"), "there is no dataset"),
        (("import", "none.npz", "--out", "new"), "none.npz"),
        (("import", "--out", "new"), "missing: --files (see hrc import --help)"),
        (("import", "none.npz"), "name the folder of the new dataset (--out)"),
        (("report", "--out", "new.html"), "missing: --runs (see hrc report --help)"),
        (("smooth",), "give --checkpoint, or --limits to write only a file"),
        (
            ("smooth", "--limits", "new.json"),
            "give --dataset: the limits are taken from its demonstrations",
        ),
        (
            ("play", "none", "--goal", 0.4, 0, 0.4, "--out", "new"),
            "there is no model at none",
        ),
        (
            ("multiply", "none", "--episodes", -1, "--out", "new"),
            "--episodes must not be negative, but is -1",
        ),
        (("fit", "--dataset", "none", "--out", "new"), "none"),
        (("fit", "image-jacobian", "--dataset", "none", "--out", "new"), "none"),
        (("evaluate", "none", "none"), "no model at none"),
        (("evaluate", "--dataset", "none"), "there is no dataset"),
        (("repair", "none"), "there is no dataset"),
        (("smooth", "--checkpoint", "none"), "no folder none"),
        (
            ("run", "collaboration", "--placing", "none", "--aiming", "none", "--out", "new"),
            "none",
        ),
        (
            ("run", "grasping", "--aiming", "none", "--camera", "/dev/video0"),
            "the simulated work cell has the cameras",
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


@dataclass(frozen=True, kw_only=True)
class Stop:
    after: float
    reason: str = ""


type Gait = Literal["trot", "walk"]


@dataclass(frozen=True, kw_only=True)
class Motion:
    speed: float = 1.0
    gait: Gait = "walk"
    share: Fraction = Fraction(1, 2)
    mode: Literal["fast", "slow"] = "slow"
    corner: tuple[float, float] = (0.0, 0.0)
    stops: tuple[Stop, ...] = ()
    log: Path | None = None

    def __post_init__(self) -> None:
        if self.speed <= 0:
            raise ValueError(f"speed must be positive, but is {self.speed}")


@dataclass(frozen=True, kw_only=True)
class Settings:
    motion: Motion = field(default_factory=Motion)
    most_tries: int = 3


def test_settings_are_read_from_words_and_files_the_last_one_counts(tmp_path):
    file = tmp_path / "cell.toml"
    file.write_text("[motion]\nspeed = 2\ncorner = [1, 0.5]\n")
    texts = (
        "motion.speed=3",
        str(file),
        "motion.mode=fast",
        "most-tries=5",
        "motion.gait=trot",
    )
    stops = "motion.stops=[{after=1}, {after=2.5, reason='door'}]"
    settings = with_settings([*texts, stops, "motion.log=a/b"], Settings())
    assert settings == Settings(
        motion=Motion(
            speed=2.0,
            mode="fast",
            gait="trot",
            corner=(1.0, 0.5),
            stops=(Stop(after=1.0), Stop(after=2.5, reason="door")),
            log=Path("a/b"),
        ),
        most_tries=5,
    )
    assert with_settings(["motion.log=none"], settings).motion.log is None


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("moton.speed=1", "--config moton: no such setting; did you mean motion?"),
        ("motion.sped=1", "--config motion.sped: no such setting; did you mean speed?"),
        ("motion.speed=fast", "--config motion.speed must be float, got 'fast'"),
        ("most_tries=2.5", "--config most_tries must be int, got 2.5"),
        ("motion.mode=idle", "--config motion.mode must be"),
        ("motion.corner=[1]", "--config motion.corner must be"),
        ("motion.stops=[{after=1, why=2}]", "motion.stops.why: no such setting"),
        ("motion.speed=0", "speed must be positive"),
        ("motion.gait=gallop", "--config motion.gait must be"),
        ("motion.share=2", "Fraction cannot be given here"),
        ("motion.two words=2", "--config motion.two words=2: not NAME=VALUE"),
    ],
)
def test_a_wrong_setting_is_named(text, message):
    with pytest.raises(ValueError, match=r".") as error:
        with_settings([text], Settings())
    assert message in str(error.value)


def test_settings_are_listed_on_request(capsys):
    with pytest.raises(SystemExit) as ended:
        with_settings(["help"], Settings())
    assert ended.value.code == 0
    assert "motion.speed = 1.0" in capsys.readouterr().out


@dataclasses.dataclass(frozen=True, kw_only=True)
class Nothing:
    """A command line without options."""


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
        (ConnectionRefusedError("no arm\nthere"), 1, "failed: no arm there\n"),
        (OSError(28, "No space left on device"), 2, "error: [Errno 28] No space"),
        (
            ModuleNotFoundError("no mujoco", name="mujoco.viewer"),
            1,
            "error: mujoco is not",
        ),
        (ModuleNotFoundError("no tyro", name="tyro"), 1, "error: tyro is not installed"),
        (ModuleNotFoundError("none", name="httpx"), 1, "error: httpx is not installed; inst"),
        (MissingModelError("get it", name="robosuite"), 1, "error: get it\n"),
    ],
)
def test_the_users_mistakes_end_in_one_line(monkeypatch, capsys, error, status, line):
    def main(_):
        raise error

    monkeypatch.setattr("warnings.formatwarning", None)
    assert run(monkeypatch, main) == status
    assert capsys.readouterr().err.startswith(line)


def test_an_unknown_missing_module_shows_its_traceback(monkeypatch):
    def main(_):
        raise ModuleNotFoundError("No module named 'ours'", name="ours")

    with pytest.raises(ModuleNotFoundError):
        run(monkeypatch, main)


@pytest.mark.parametrize("error", [KeyError("ours"), OSError("of no file"), BrokenPipeError()])
def test_our_own_mistakes_show_their_traceback(monkeypatch, error):
    def main(_):
        raise error

    monkeypatch.setattr("warnings.formatwarning", None)
    with pytest.raises(type(error)):
        run(monkeypatch, main)


def test_measured_values_are_written_as_numbers(tmp_path):
    path = tmp_path / "new" / "values.json"
    cli.write_json(path, {"a": 1, "b": np.float32(0.5), "c": float("nan"), "d": np.int64(3)})
    assert json.loads(path.read_text()) == {"a": 1, "b": 0.5, "c": None, "d": 3}


@pytest.mark.long
def test_the_dataset_may_be_the_working_folder(monkeypatch, tmp_path):
    write_set(tmp_path / "set", **SETS["v2.0"])
    monkeypatch.chdir(tmp_path / "set")
    done("show", ".", "--out", tmp_path / "shown.rrd")
    done("fit", "--dataset", ".", "--n-basis", 10)
    assert (tmp_path / "set_model" / "metrics.json").is_file()
    done("repair", ".")
    assert (tmp_path / "set_repaired" / "meta" / "info.json").is_file()


def test_options_of_a_lerobot_device_become_settings():
    typed = [
        "--out",
        "o",
        "--robot",
        "so101",
        "--robot.type=so101_follower",
        "--robot.port",
        "/p",
    ]
    settings = ["site.device.type=so101_follower", "site.device.port=/p"]
    expected = ["--out", "o", "--robot", "so101", "--config", *settings]
    assert gathered_settings(typed) == expected
    given = [*typed, "--config", "site.speed=0.1", "--arm", "lerobot"]
    robot = ["--out", "o", "--robot", "so101", "--arm", "lerobot"]
    assert gathered_settings(given) == [*robot, "--config", *settings, "site.speed=0.1"]


def test_a_lerobot_arm_needs_its_type_and_no_address(tmp_path):
    out = str(tmp_path / "set")
    asked = done("page", "--arm", "lerobot", "--ip", "sim", "--out", out, status=2)
    assert "--ip is for Franka arms: use --robot.port for LeRobot" in asked.error
    asked = done("run", "placing", "--arm", "lerobot", "--out", out, status=2)
    assert "hrc run does not support --arm lerobot" in asked.error


@pytest.mark.parametrize(
    ("option", "value"), [("--out", "new.rrd"), ("--episodes", 1), ("--robot", "ur5e")]
)
def test_a_recording_is_shown_as_it_is(tmp_path, option, value):
    (tmp_path / "run.rrd").write_bytes(b"")
    asked = done("show", tmp_path, option, value, status=2)
    assert (
        f"{option} is for datasets, but {tmp_path} holds recordings: {tmp_path}" in asked.error
    )


def test_settings_of_several_config_options_count_together():
    words = [
        "--config",
        "site.speed=0.1",
        "--rate",
        "100",
        "--config",
        "step=eager",
        "film=false",
    ]
    args = parse(Serve, words, "hrc serve")
    assert list(args.config) == ["site.speed=0.1", "step=eager", "film=false"]
    assert args.rate == 100
    assert list(parse(Serve, ["--rate", "50"], "hrc serve").config) == []
