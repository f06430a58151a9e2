"""Programs run in the process of the tests, which has their imports already."""

import runpy
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).parents[2]


class Outcome(NamedTuple):
    """How a program ended."""

    status: object
    output: str
    error: str


@pytest.fixture
def run_here(monkeypatch, capsys, tmp_path) -> Callable[..., Outcome]:
    """Runs a program in this process, in an empty folder."""
    monkeypatch.chdir(tmp_path)
    # Programs change how warnings look; that must not outlive the test.
    monkeypatch.setattr(warnings, "formatwarning", warnings.formatwarning)

    def run(program: str | Path, *arguments: object) -> Outcome:
        path = ROOT / program
        monkeypatch.setattr(sys, "argv", [str(program), *map(str, arguments)])
        monkeypatch.syspath_prepend(path.parent)
        with pytest.raises(SystemExit) as ended:
            runpy.run_path(str(path), run_name="__main__")
        return Outcome(ended.value.code, *capsys.readouterr())

    return run
