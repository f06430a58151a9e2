"""Command lines as dataclasses that cost nothing to import, and their first screen of help.

Each field is an option, its docstring the help. `More[...]` marks what only `--help-all` shows.
A field with a `Detail` for default stands for the configuration of a package that is slow to
import: its options, such as --config.speed, are known as soon as one of them is given.
"""

import ast
import dataclasses
import inspect
import shutil
import textwrap
import types
import typing
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, cast

T = TypeVar("T")

_MORE = "shown by --help-all alone"
More = Annotated[T, _MORE]
"""Type of an option that the short help leaves out."""

_NAMES = 26
"""Columns that option names take; a longer one has its text below."""
_WIDEST = 100
"""Lines longer than this read badly."""
_LAST = (
    *("camera", "trials", "processes", "seed", "robot"),
    *("film", "verbose", "serve", "overwrite", "json"),
)
"""Options that many commands share come after those that are a command's own."""


@dataclass(frozen=True)
class Detail:
    """In place of a configuration until a command runs."""

    module: str
    """Where the configuration is defined."""
    name: str
    """Of its dataclass."""
    changes: Mapping[str, Any] = dataclasses.field(default_factory=dict, hash=False)
    """Of its defaults."""

    def load(self) -> Any:
        """Import it; the configuration as it is by default."""
        return getattr(import_module(self.module), self.name)(**self.changes)


def details(arguments: type) -> dict[str, Detail]:
    """The configurations that a command line stands in for, by name of their field."""
    defaults = {field.name: field.default for field in dataclasses.fields(arguments)}
    return {name: value for name, value in defaults.items() if isinstance(value, Detail)}


def mentions_details(arguments: type, words: Sequence[str]) -> bool:
    """Whether one of the words is an option of such a configuration."""
    prefixes = tuple(f"--{name}.".replace("_", "-") for name in details(arguments))
    return any(word.replace("_", "-").startswith(prefixes) for word in words)


def complete[Args](arguments: type[Args]) -> type[Args]:
    """The same command line with every option of its configurations."""
    from tyro.conf import arg

    help_texts = docstrings(arguments)
    fields = []
    for name, stand_in in details(arguments).items():
        default = stand_in.load()
        hint = Annotated[type(default), arg(help=help_texts[name])]
        fields.append((name, hint, dataclasses.field(default=default)))
    made = dataclasses.make_dataclass(
        arguments.__name__, fields, bases=(arguments,), frozen=True, kw_only=True
    )
    return cast("type[Args]", made)


def resolved[Args](args: Args) -> Args:
    """The arguments with every configuration in its place, the default where none was given."""
    given = cast("Any", args)
    loaded = {name: v.load() for name, v in vars(given).items() if isinstance(v, Detail)}
    return dataclasses.replace(given, **loaded)


def docstrings(arguments: type) -> dict[str, str]:
    """Strings that follow the fields of a dataclass and of what it inherits from."""
    return {name: text for cls in reversed(arguments.__mro__) for name, text in _texts(cls)}


def _texts(cls: type) -> Iterator[tuple[str, str]]:
    if not dataclasses.is_dataclass(cls):
        return
    (definition,) = ast.parse(textwrap.dedent(inspect.getsource(cls))).body
    assert isinstance(definition, ast.ClassDef)
    for field, after in pairwise(definition.body):
        if isinstance(field, ast.AnnAssign) and isinstance(after, ast.Expr):
            yield ast.unparse(field.target), " ".join(ast.literal_eval(after.value).split())


def short_help(program: str, arguments: type) -> str:
    """Usage, first paragraph, main options with the first sentence about each."""
    width = _width()
    rows = list(_rows(arguments))
    positional = "".join(f" {name}" for name, _ in rows if not name.startswith("-"))
    about = " ".join((arguments.__doc__ or "").strip().split("\n\n")[0].split())
    lines = [f"usage: {program}{positional} [OPTIONS]", "", *textwrap.wrap(about, width), ""]
    rows += [("-h, --help", "Show this and exit.")]
    rows += [("--help-all", "Show every option, and all there is to say about it.")]
    return "\n".join([*lines, *table(rows)])


def table(rows: Iterable[tuple[str, str]]) -> list[str]:
    """Names, and beside each what it is."""
    lines, indent = [], " " * (_NAMES + 2)
    for name, text in rows:
        wrapped = textwrap.wrap(text, _width(), initial_indent=indent, subsequent_indent=indent)
        if len(name) < _NAMES and wrapped:
            first, *wrapped = wrapped
            name = f"{name:{_NAMES}}{first[len(indent) :]}"
        lines += [f"  {name}", *wrapped]
    return lines


def _width() -> int:
    return min(shutil.get_terminal_size().columns, _WIDEST)


def _rows(arguments: type) -> Iterator[tuple[str, str]]:
    hints = typing.get_type_hints(arguments, include_extras=True)
    texts = docstrings(arguments)
    fields = {field.name: field for field in dataclasses.fields(arguments)}
    order = [name for name in fields if name not in _LAST]
    order += [name for name in _LAST if name in fields]
    for field in map(fields.__getitem__, order):
        hint = hints[field.name]
        more = _MORE in getattr(hint, "__metadata__", ())
        if isinstance(field.default, Detail) or more:
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
