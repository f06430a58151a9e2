"""Links, paths, make targets, commands and options in the documentation exist."""

import ast
import re
import shlex
from pathlib import Path

import pytest

from hrc_learn import cli
from hrc_learn.cli._commands import COMMANDS, find, name_leading
from hrc_learn.cli._run import parse

ROOT = Path(__file__).parents[1]
PAGES = [
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")),
    *sorted((ROOT / "docs").rglob("*.md")),
]
FOLDERS = (
    "hrc_learn",
    "datasets",
    "training",
    "control",
    "tests",
    "benchmarks",
    "docs",
    "tools",
)

BLOCK = re.compile(r"^```(\w*)[^\n]*\n(.*?)^```", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"!?\[[^\]]*\]\(([^)\s#]+)[^)]*\)|<img[^>]*src=\"([^\"]+)\"")
PROGRAM_PATH = re.compile(rf"(?<![\w/.])(?:{'|'.join(FOLDERS)})/[\w./-]*\w")
MAKE_TARGET = re.compile(r"\bmake ([a-z][\w-]*)")
COMMAND = re.compile(r"\b((?:datasets|training|control|benchmarks)/\w+\.py)([^\n|;&]*)")
HRC = re.compile(r"\bhrc ([a-z-][^\n|;&`]*)")
OPTION = re.compile(r"(?<!\S)--(?!(?:robot|teleop)\.)([a-z][\w-]*)")
"""Option of a command; those of LeRobot's robots and leader arms are handed on."""

by_page = pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)


def code(page: Path) -> str:
    """All code of a page: fenced blocks, and spans within lines."""
    text = page.read_text()
    fenced = [body.replace("\\\n", " ") for _, body in BLOCK.findall(text)]
    return "\n".join([*fenced, *re.findall(r"`([^`\n]+)`", BLOCK.sub("", text))])


@by_page
def test_what_is_linked_exists(page):
    names = {a or b for a, b in LINK.findall(page.read_text())}
    local = {name for name in names if not re.match(r"\w+:", name)}
    assert not [name for name in local if not (page.parent / name).exists()]


@by_page
def test_what_is_named_exists(page):
    named = set(PROGRAM_PATH.findall(code(page)))
    assert not [name for name in named if not (ROOT / name).exists()]


@by_page
def test_make_knows_its_targets(page):
    makefile = (ROOT / "Makefile").read_text()
    targets = set(re.findall(r"^([a-z][\w-]*):", makefile, re.MULTILINE))
    assert set(MAKE_TARGET.findall(code(page))) <= targets


@by_page
def test_commands_are_known_with_their_options(page):
    text, unknown = code(page), []
    typed = [(("hrc", line), line.split()) for line in HRC.findall(text)]
    for program, rest in COMMAND.findall(text):
        if command := command_of(ROOT / program):
            typed.append(((program, rest), [*command.split(), *rest.split()]))
        elif set(OPTION.findall(rest)) - options(ROOT / program):
            unknown.append((program, rest))
    for said, words in typed:
        name, rest = find(words)
        known = command_options(name) if name else HELP
        if not name or {*OPTION.findall(" ".join(rest))} - known:
            unknown.append(said)
    assert not unknown


WHOLE = re.compile(r"^(?:\$ )?hrc ([a-z].*)$", re.MULTILINE)
"""A command in a block of a shell."""


@by_page
def test_whole_commands_are_accepted_by_their_parsers(page):
    blocks = [body for kind, body in BLOCK.findall(page.read_text()) if kind in SHELLS]
    refused = []
    for line in WHOLE.findall("\n".join(blocks).replace("\\\n", " ")):
        words = shlex.split(line, comments=True)
        stops = [i for i, word in enumerate(words) if word in {"|", "&&", ">", "&"}]
        name, rest = find(words[: min(stops, default=None)])
        if not name or "..." in rest:  # the other test knows its name and options
            continue
        command = COMMANDS[name]
        try:
            parse(command.arguments, name_leading(command.leading, rest), f"hrc {name}")
        except SystemExit:  # with the reason on standard error
            refused.append(line)
    assert not refused


SHELLS = {"console", "sh", "bash"}
HELP = {"help", "version", "json"}


def command_of(program: Path) -> str:
    """Command that a program passes to `cli.main`; "" if it has options of its own."""
    words = re.search(r"cli\.main\((.*)\)", program.read_text())
    return "" if words is None else " ".join(ast.literal_eval(f"({words[1]},)"))


def command_options(name: str) -> set[str]:
    """Options of a command."""
    names = cli.commands()[name]
    return {*HELP, *names, *(f"no-{name}" for name in names)}


def options(program: Path) -> set[str]:
    """Options of a program, the fields of its dataclass `Args`."""
    classes = [
        node
        for node in ast.parse(program.read_text()).body
        if isinstance(node, ast.ClassDef) and node.name == "Args"
    ]
    if not classes:  # a module that programs import
        return set()
    (args,) = classes
    fields = [
        node.target.id.replace("_", "-")
        for node in args.body
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name)
    ]
    return {"help", *fields, *(f"no-{name}" for name in fields)}
