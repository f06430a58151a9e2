"""The first screen of help: what a command does, its main options, a line or two each."""

import dataclasses
import shutil
import textwrap
import types
import typing
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, Literal

from hrc_learn.cli._options import Detail, docstrings, is_more

_NAMES = 26
"""Columns that option names take; a longer one has its text below."""
_WIDEST = 100
"""Lines longer than this read badly."""


def short_help(program: str, arguments: type) -> str:
    """Usage, first paragraph, main options with the first sentence about each."""
    width = min(shutil.get_terminal_size().columns, _WIDEST)
    rows = list(_rows(arguments))
    positional = "".join(f" {name}" for name, _ in rows if not name.startswith("-"))
    about = " ".join((arguments.__doc__ or "").strip().split("\n\n")[0].split())
    lines = [f"usage: {program}{positional} [OPTIONS]", "", *textwrap.wrap(about, width), ""]
    rows += [("-h, --help", "Show this and exit.")]
    rows += [("--help-all", "Show every option, and all there is to say about it.")]
    for name, text in rows:
        lines += _row(name, text, width)
    return "\n".join(lines)


def table(rows: Iterable[tuple[str, str]], width: int | None = None) -> list[str]:
    """Names, and beside each what it is."""
    width = width or min(shutil.get_terminal_size().columns, _WIDEST)
    return [line for name, text in rows for line in _row(name, text, width)]


def _row(name: str, text: str, width: int) -> list[str]:
    indent = " " * (_NAMES + 2)
    wrapped = textwrap.wrap(text, width, initial_indent=indent, subsequent_indent=indent)
    if len(name) >= _NAMES or not wrapped:
        return [f"  {name}", *wrapped]
    first, *others = wrapped
    return [f"  {name:{_NAMES}}{first[len(indent) :]}", *others]


def _rows(arguments: type) -> Iterator[tuple[str, str]]:
    hints = typing.get_type_hints(arguments, include_extras=True)
    texts = docstrings(arguments)
    for field in dataclasses.fields(arguments):
        hint = hints[field.name]
        if isinstance(field.default, Detail) or is_more(hint):
            continue
        # The first sentence; what follows is for --help-all.
        text = texts[field.name].split(". ")[0].rstrip(".:;")
        yield _invocation(field.name, hint), f"{text}.{_default(field)}"


def _invocation(name: str, hint: Any) -> str:
    option, values = name.replace("_", "-"), _values(hint)
    if getattr(hint, "__metadata__", ()):  # what is not marked `More` is positional
        return f"{option.upper()} ..."
    return f"--{option} {values}".rstrip()


def _values(hint: Any) -> str:
    """What is typed after the name of an option."""
    origin, parts = typing.get_origin(hint), typing.get_args(hint)
    if isinstance(hint, typing.TypeAliasType):
        return _values(hint.__value__)
    if origin is Literal:
        return "{" + ",".join(map(str, parts)) + "}"
    if origin in (types.UnionType, typing.Union):
        return _values(next(part for part in parts if part is not type(None)))
    if origin is tuple:
        return f"{_values(parts[0])} ..."
    if origin is dict:
        return "NAME VALUE ..."
    if hint is bool:
        return ""
    return {Path: "PATH", str: "TEXT"}.get(hint) or hint.__name__.upper()


def _default(field: dataclasses.Field) -> str:
    default = field.default
    if default is dataclasses.MISSING:
        return "" if field.default_factory is not dataclasses.MISSING else " Required."
    if default is None or default is False or default == ():
        return ""
    if default is True:
        return f" On; --no-{field.name.replace('_', '-')} for off."
    return f" [{' '.join(map(str, default)) if isinstance(default, tuple) else default}]"
