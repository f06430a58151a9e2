"""Commands that read a whole dataset show that they work."""

import pytest
from clean_sets import write_set
from commands import done
from rich.console import Console

COMMANDS = {
    "check": ("Checking", ("check", "set")),
    "push": ("Checking", ("push", "set", "someone/set", "--dry-run")),
    "merge": ("Merging 2 datasets", ("merge", "set", "other", "--out", "both")),
    "show": ("Reading", ("show", "set", "--out", "set.rrd")),
    "smooth": ("Importing LeRobot", ("smooth", "--dataset", "set", "--limits", "limits.json")),
    "tokens": ("Fitting a tokenizer", ("tokens", "fit", "--dataset", "set", "--out", "t")),
    "evaluate": ("Predicting joint", ("evaluate", "--dataset", "set")),
}
"""Command -> beginning of a status, and words."""


@pytest.fixture
def shown(monkeypatch):
    """Statuses shown so far."""
    texts, status = [], Console.status

    def noted(console, text, **more):
        texts.append(text)
        return status(console, text, **more)

    monkeypatch.setattr(Console, "status", noted)
    return texts


@pytest.mark.parametrize(
    "command",
    # LeRobot takes long to import.
    [pytest.param(c, marks=pytest.mark.long if c == "smooth" else ()) for c in COMMANDS],
)
def test_a_command_says_what_it_does_meanwhile(command, shown, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    text, words = COMMANDS[command]
    write_set(tmp_path / "set", "v3.0")
    write_set(tmp_path / "other", "v3.0")
    done(*words)
    assert any(one.startswith(text) for one in shown), shown


def test_import_says_that_it_reads_and_writes(shown, tmp_path):
    table = tmp_path / "table.csv"
    rows = (f"{k / 50},{k / 100},{k / 200}" for k in range(100))
    table.write_text("\n".join(["time,q1,q2", *rows]), "utf-8")
    done("import", table, "--out", tmp_path / "set", "--joints", "q1", "q2")
    assert [text.split()[0] for text in shown] == ["Reading", "Writing"]
