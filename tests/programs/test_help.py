"""What every program promises on the command line: help that reads well, one-line errors."""

import ast
import dataclasses
import importlib.util
import inspect
import re
import sys
import textwrap
import typing
from collections.abc import Iterator
from functools import cache
from itertools import pairwise
from pathlib import Path

import pytest
import tyro

ROOT = Path(__file__).parents[2]
PROGRAMS = sorted(
    path
    for folder in ("datasets", "training", "control", "benchmarks")
    for path in (ROOT / folder).glob("*.py")
    if "cli.run(" in path.read_text()
)
every_program = pytest.mark.parametrize("program", PROGRAMS, ids=lambda path: path.stem)


@cache
def arguments_of(program: Path) -> type:
    """The dataclass that is a program's command line."""
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


def options(config: type, prefix: str = "") -> Iterator[tuple[str, str]]:
    """Each option as it is typed and its docstring, nested configurations included.

    Of a positional argument, which has no name on the command line, the docstring alone.
    """
    texts = docstrings(config)
    hints = typing.get_type_hints(config, include_extras=True)
    for field in dataclasses.fields(config):
        hint, name = hints[field.name], f"{prefix}{field.name.replace('_', '-')}"
        markers = getattr(hint, "__metadata__", ())
        kind = getattr(hint, "__origin__", hint) if markers else hint
        if isinstance(kind, type) and dataclasses.is_dataclass(kind):
            unnamed = any(getattr(marker, "name", None) == "" for marker in markers)
            yield from options(kind, prefix if unnamed else f"{name}.")
        else:
            positional = tyro.conf.Positional in markers
            yield "" if positional else f"--{name}", texts.get(field.name, "")


def docstrings(config: type) -> dict[str, str]:
    """Strings that follow the fields of a dataclass and of what it inherits from."""
    texts: dict[str, str] = {}
    for cls in reversed(config.__mro__):
        if not dataclasses.is_dataclass(cls):
            continue
        (definition,) = ast.parse(textwrap.dedent(inspect.getsource(cls))).body
        assert isinstance(definition, ast.ClassDef)
        for field, after in pairwise(definition.body):
            if isinstance(field, ast.AnnAssign) and isinstance(after, ast.Expr):
                texts[ast.unparse(field.target)] = ast.literal_eval(after.value)
    return texts


def words(text: str) -> str:
    """Text without the frames and line breaks of a terminal."""
    return " ".join(re.sub(r"[│╭╮╰╯─]", " ", text).split())


@every_program
def test_help_explains_every_option(program, run_here):
    status, output, error = run_here(program, "--help")
    assert status == 0
    assert error == ""
    shown = words(output)
    summary = ast.get_docstring(ast.parse(program.read_text()))
    assert summary is not None
    assert words(summary.splitlines()[0]) in shown
    unexplained = [
        option or text
        for option, text in options(arguments_of(program))
        if not (text and words(text) in shown and re.search(rf"{option}[ ,]", shown))
    ]
    assert not unexplained


@every_program
def test_every_program_writes_its_figures_as_json(program):
    assert "json" in {field.name for field in dataclasses.fields(arguments_of(program))}


@pytest.mark.parametrize(
    ("program", "arguments", "message"),
    [
        ("datasets/check_dataset.py", ["none"], "no dataset at none"),
        ("datasets/import_arrays.py", ["none.npz", "--out", "new"], "none.npz"),
        (
            "datasets/record_placing.py",
            ["--shelf", "attic", "--out", "new", "--episodes", "1"],
            "no shelf named 'attic': this cabinet has lower, middle, upper",
        ),
        ("training/fit_dmp.py", ["--dataset", "none", "--out", "new"], "none"),
        ("training/fit_image_jacobian.py", ["--dataset", "none", "--out", "new"], "none"),
        ("training/evaluate.py", ["none", "none"], "none"),
        ("training/evaluate_image_jacobian.py", ["none", "none"], "none"),
        ("training/tune_controller.py", ["--out", "new", "--resume"], "new.search.json"),
        (
            "control/run_collaboration.py",
            ["--placing", "none", "--aiming", "none", "--out", "new"],
            "none",
        ),
        ("benchmarks/bench_dmp.py", ["--compare", "none.json"], "none.json"),
    ],
)
def test_bad_input_is_one_line_and_leaves_nothing(
    run_here, tmp_path, program, arguments, message
):
    status, _, error = run_here(program, *arguments)
    assert status == 2
    assert message in error
    assert error.startswith("error: ")
    assert error.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_an_unknown_option_is_told_apart_from_the_work_failing(run_here):
    status, _, error = run_here("training/fit_dmp.py", "--datset", "demos", "--out", "new")
    assert status == 2
    assert "--datset" in error
