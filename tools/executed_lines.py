"""Pytest plugin: which lines of `hrc_learn` each test executes, and how long the test takes.

    python -m pytest -m "not slow" -p executed_lines --executed lines.json  # PYTHONPATH=tools

`mutation_sample.py --executed lines.json` then runs, for each mutant, the tests that execute
its line. Lines are seen by `sys.monitoring`, which stops reporting a line after its first time
in a test. What a shared fixture executes counts for the test that makes it first.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from types import CodeType

import pytest

_PACKAGE = str(Path(__file__).resolve().parents[1] / "hrc_learn") + "/"
_TOOL = 4  # sys.monitoring: 0 debugger, 1 coverage, 2 profiler, 5 optimizer
_MONITORED = sys.monitoring

_lines: set[tuple[str, int]] = set()
_tests: dict[str, tuple[float, list[tuple[str, int]]]] = {}


def _line(code: CodeType, number: int) -> object:
    if code.co_filename.startswith(_PACKAGE):
        _lines.add((code.co_filename[len(_PACKAGE) :], number))
    return _MONITORED.DISABLE


def pytest_addoption(parser):
    parser.addoption("--executed", help="JSON file that receives tests, lines and durations")


def pytest_configure(config):
    if not config.getoption("--executed"):
        return
    _MONITORED.use_tool_id(_TOOL, "executed_lines")
    _MONITORED.register_callback(_TOOL, _MONITORED.events.LINE, _line)
    _MONITORED.set_events(_TOOL, _MONITORED.events.LINE)


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_protocol(item):
    if not item.config.getoption("--executed"):
        return (yield)
    _lines.clear()
    _MONITORED.restart_events()
    start = time.process_time()
    try:
        return (yield)
    finally:
        _tests[item.nodeid] = (time.process_time() - start, sorted(_lines))


def pytest_sessionfinish(session):
    file = session.config.getoption("--executed")
    if file:  # lines of the interpreter's end would meet a module that is cleared already
        _MONITORED.set_events(_TOOL, _MONITORED.events.NO_EVENTS)
    worker = getattr(session.config, "workerinput", None)
    if not file or not _tests:
        return
    path = Path(file)
    if worker is not None:
        path = path.with_suffix(f".{worker['workerid']}.json")
    path.write_text(json.dumps(_tests), encoding="utf-8")
