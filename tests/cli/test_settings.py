"""Command lines, settings and errors of commands, without starting a process."""

import json
import sys
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from hrc_learn.cli import _run as run


@pytest.mark.parametrize(
    ("words", "gathered"),
    [
        (["--seed", "1"], ["--seed", "1"]),
        (["--config", "a=1", "b=2"], ["--config", "a=1", "b=2"]),
        (["--config", "a=1", "--seed", "1", "--config", "b=2"],
         ["--seed", "1", "--config", "a=1", "b=2"]),
        (["record", "--robot.port=/dev/x", "--seed", "1"],
         ["record", "--seed", "1", "--config", "site.device.port=/dev/x"]),
        (["--robot.port", "/dev/x", "--teleop.id", "me"],
         ["--config", "site.device.port=/dev/x", "site.leader.id=me"]),
        (["--robot", "panda"], ["--robot", "panda"]),
        (["--robot.id="], ["--config", "site.device.id="]),
        (["--config=a=1", "b=2", "--seed", "1", "--config", "c=3"],
         ["--seed", "1", "--config", "a=1", "b=2", "c=3"]),
    ],
)  # fmt: skip
def test_settings_are_gathered_behind_one_option(words, gathered):
    assert run.gathered_settings(words) == gathered


@pytest.mark.parametrize("more", [[], ["--robot.port=/dev/x"]])
def test_a_setting_of_a_device_does_not_take_the_next_option_for_its_value(more):
    with pytest.raises(ValueError, match=r"--robot\.id needs a value"):
        run.gathered_settings(["--robot.id", *more])


@dataclass(frozen=True, kw_only=True)
class Place:
    x: float = 0.0
    y: float = 0.0


@dataclass(frozen=True, kw_only=True)
class Inner:
    speed: float = 1.0
    count: int = 3
    path: Path | None = None
    names: tuple[str, ...] = ()
    table: dict[str, dict] = field(default_factory=dict)
    places: dict[str, Place] = field(default_factory=dict)
    extra: Place | None = None

    def __post_init__(self):
        if self.speed < 0:
            raise ValueError("speed must not be negative")


@dataclass(frozen=True, kw_only=True)
class Outer:
    site: Inner = field(default_factory=Inner)
    shown: bool = False


@pytest.mark.parametrize(
    ("texts", "expected"),
    [
        (["site.speed=2.5"], Outer(site=Inner(speed=2.5))),
        (["site.speed=2.5", "site.speed=3"], Outer(site=Inner(speed=3.0))),
        (["shown=true"], Outer(shown=True)),
        (["site.path=a/b c"], Outer(site=Inner(path=Path("a/b c")))),
        (['site.path=a"b\\c'], Outer(site=Inner(path=Path('a"b\\c')))),
        (["site.path=none"], Outer()),
        (['site.names=["a", "b"]'], Outer(site=Inner(names=("a", "b")))),
        (["site.table.a.x=1", "site.table.a.y=2", "site.table.b.x=3"],
         Outer(site=Inner(table={"a": {"x": 1, "y": 2}, "b": {"x": 3}}))),
        (["site.places.a.x=1", "site.places.a.y=2", "site.places.b.y=3", "site.places.a.x=4"],
         Outer(site=Inner(places={"a": Place(x=4.0, y=2.0), "b": Place(y=3.0)}))),
        (["site.extra.x=1", "site.extra.y=2"], Outer(site=Inner(extra=Place(x=1.0, y=2.0)))),
    ],
)  # fmt: skip
def test_the_last_value_of_a_setting_counts(texts, expected):
    assert run.with_settings(texts, Outer()) == expected


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("site.sped=2", "--config site.sped: no such setting; did you mean speed?"),
        ("site.zzz=2", "there are speed, count, path, names, table, places, extra"),
        ("site.count=x", "--config site.count must be int, got 'x'"),
        ("site.speed=-1", "speed must not be negative"),
        ("a\nb=2", "not NAME=VALUE"),
    ],
)
def test_settings_that_do_not_exist_or_fit(text, message):
    with pytest.raises(ValueError, match=r"\w") as error:
        run.with_settings([text], Outer())
    assert message in run.one_line(error.value)


def test_help_lists_every_setting(capsys):
    with pytest.raises(SystemExit) as ended:
        run.with_settings(["help"], Outer())
    assert ended.value.code == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "site.speed = 1.0"
    assert lines[-1] == "shown = False"
    assert len(lines) == 8


def test_settings_from_a_file(tmp_path):
    path = tmp_path / "cell.toml"
    path.write_text("shown = true\n[site]\ncount = 7\n")
    assert run.with_settings([str(path)], Outer()) == Outer(shown=True, site=Inner(count=7))
    with pytest.raises(FileNotFoundError):
        run.with_settings([str(tmp_path / "none.toml")], Outer())


def raising(error):
    def work():
        raise error

    return work


@pytest.mark.parametrize(
    ("error", "status", "text"),
    [
        (ValueError("bad\n value"), 2, "error: bad value"),
        (FileNotFoundError(2, "No such file", "a.csv"), 2, "error: a.csv: No such file"),
        (FileExistsError("x exists"), 2, "error: x exists"),
        (ModuleNotFoundError("No module named 'h5py'", name="h5py.x"), 1,
         "error: h5py is not installed; install it with: pip install 'hrc-learn[import]'"),
        (ModuleNotFoundError("install the SDK", name="sdk"), 1, "error: install the SDK"),
        (ConnectionError("no arm"), 1, "failed: no arm"),
        (OSError(28, "No space left", "out"), 2, "error: out: No space left"),
        (OSError(28, "No space left"), 2, "error: [Errno 28] No space left"),
        (KeyboardInterrupt(), 1, "interrupted"),
        (MemoryError("9 TiB"), 1, "failed: not enough memory: 9 TiB"),
        (RuntimeError("can't allocate memory"), 1,
         "failed: not enough memory: can't allocate memory"),
    ],
)  # fmt: skip
def test_errors_are_one_line_and_a_status(error, status, text, capsys):
    assert run.status_of(raising(error)) == status
    assert capsys.readouterr().err == f"{text}\n"


@pytest.mark.parametrize(
    "error",
    [
        OSError(22, "odd"),
        ModuleNotFoundError("No module named 'q'", name="q"),
        RuntimeError("x"),
    ],
)
def test_faults_of_ours_keep_their_traceback(error):
    with pytest.raises(type(error)):
        run.status_of(raising(error))


@pytest.mark.parametrize("status", [0, 1, 7])
def test_the_status_of_the_work_is_that_of_the_command(status):
    assert run.status_of(lambda: status) == status


def test_results_are_refused_values_written_and_episodes_named_once(tmp_path):
    run.refuse_existing(tmp_path / "new", False)
    run.refuse_existing(tmp_path, True)
    with pytest.raises(FileExistsError, match="exists: give another --out, or --overwrite"):
        run.refuse_existing(tmp_path, False)
    run.refuse_repeats([1, 2, 3])
    with pytest.raises(ValueError, match="--episodes names 2 more than once"):
        run.refuse_repeats([1, 2, 2, 2])
    run.write_values(tmp_path / "v.json", {"a": 1, "b": 2.5})
    assert json.loads((tmp_path / "v.json").read_text()) == {"a": 1, "b": 2.5}
    run.write_values(None, {"a": 1})
    assert [path.name for path in tmp_path.iterdir()] == ["v.json"]


@pytest.mark.parametrize(
    ("name", "value", "screen"),
    [
        (None, "", False),
        ("DISPLAY", ":0", True),
        ("WAYLAND_DISPLAY", "w", True),
        ("DISPLAY", "", False),
    ],
)
def test_a_machine_with_a_screen(monkeypatch, name, value, screen):
    monkeypatch.setattr(sys, "platform", "linux")
    for each in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(each, raising=False)
    if name:
        monkeypatch.setenv(name, value)
    assert run.has_screen() == screen
    monkeypatch.setattr(sys, "platform", "darwin")
    assert run.has_screen()


@pytest.mark.parametrize(
    ("argv", "line"),
    [
        (["/x/hrc_learn/cli/__main__.py", "fit", "a b"], "hrc fit 'a b'"),
        (["/usr/bin/hrc", "check", "x"], "hrc check x"),
        (["training/fit.py", "--seed", "1"], "python training/fit.py --seed 1"),
    ],
)
def test_a_command_line_repeats_the_process(monkeypatch, argv, line):
    monkeypatch.setattr(sys, "argv", argv)
    assert run.command_line() == line


def test_notes_of_an_error_are_on_its_line():
    error = ValueError("speed is wrong")
    error.add_note("(--config site.speed)")
    assert run.one_line(error) == "speed is wrong (--config site.speed)"
    assert run.one_line(KeyError()) == "KeyError"
