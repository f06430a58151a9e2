"""Programs of the repository: help of benchmarks, and that others are commands of `hrc`."""

import ast
import dataclasses
import importlib.util
import json
import re
import sys
from functools import cache
from pathlib import Path

import pytest

from hrc_learn import cli

ROOT = Path(__file__).parents[2]
PROGRAMS = sorted(
    path
    for folder in ("datasets", "training", "control")
    for path in (ROOT / folder).glob("*.py")
    if path.stem != "export_mcap"
)
BENCHMARKS = sorted(
    path for path in (ROOT / "benchmarks").glob("*.py") if "cli.run(" in path.read_text()
)
BENCHMARKS.append(ROOT / "datasets/export_mcap.py")
every_benchmark = pytest.mark.parametrize("program", BENCHMARKS, ids=lambda path: path.stem)


def command_of(program: Path) -> str:
    """What a program passes to `cli.main`."""
    words = re.search(r"cli\.main\((.*)\)", program.read_text())
    assert words is not None
    return " ".join(ast.literal_eval(f"({words[1]},)"))


@cache
def arguments_of(program: Path) -> type:
    """The dataclass that is a benchmark's command line."""
    name = f"{program.parent.name}_{program.stem}"
    spec = importlib.util.spec_from_file_location(name, program)
    assert spec is not None
    assert spec.loader is not None
    # Dataclasses and their source are looked up by the module's name.
    module = sys.modules[name] = importlib.util.module_from_spec(spec)
    sys.path.insert(0, str(program.parent))
    try:
        spec.loader.exec_module(module)
    finally:
        sys.path.remove(str(program.parent))
    return module.Args


def words(text: str) -> str:
    """Text without the frames and line breaks of a terminal."""
    return " ".join(re.sub(r"[│╭╮╰╯─]", " ", text).split())


@pytest.mark.parametrize("program", PROGRAMS, ids=lambda path: path.stem)
def test_a_program_is_a_command(program, run_here):
    """The same help, from a few lines."""
    command = command_of(program)
    name = command if command in cli.commands() else command.split()[0]
    status, output, error = run_here(program, "--help")
    assert (status, error) == (0, "")
    assert output.startswith(f"usage: hrc {name}")
    summary = ast.get_docstring(ast.parse(program.read_text()))
    assert summary is not None
    assert f"`hrc {command}`" in summary
    assert len(program.read_text().splitlines()) < 15


def test_every_command_but_demo_is_a_program():
    found = {command_of(program) for program in PROGRAMS}
    found |= {name.split()[0] for name in found}
    assert cli.commands().keys() - found == {"demo"}


@every_benchmark
def test_help_explains_a_benchmark(program, run_here):
    status, output, error = run_here(program, "--help")
    assert (status, error) == (0, "")
    summary = ast.get_docstring(ast.parse(program.read_text()))
    assert summary is not None
    assert words(summary.splitlines()[0]) in words(output)


@every_benchmark
def test_every_benchmark_writes_its_figures_as_json(program):
    assert "json" in {field.name for field in dataclasses.fields(arguments_of(program))}


def test_bad_input_of_a_benchmark_is_one_line(run_here, tmp_path):
    status, _, error = run_here("benchmarks/bench_dmp.py", "--compare", "none.json")
    assert status == 2
    assert "none.json" in error
    assert error.startswith("error: ")
    assert error.count("\n") == 1
    assert not list(tmp_path.iterdir())


@pytest.mark.long
def test_a_benchmark_writes_its_figures(run_here, tmp_path):
    sizes = ("--episodes", 2, "--frames", 50, "--repeats", 1)
    out = tmp_path / "figures.json"
    assert run_here("benchmarks/bench_demos.py", *sizes, "--json", out).status in (0, None)
    figures = json.loads(out.read_text())
    assert figures["load_demos_samples_per_s"] > 0
    assert all(isinstance(value, float) for value in figures.values())
