"""Command lines as dataclasses that cost nothing to import.

Each field is an option, its docstring the help. `More[...]` marks what only `--help-all` shows.
A field with a `Detail` for default stands for the configuration of a package that is slow to
import: its options, such as --config.speed, are known as soon as one of them is given.
"""

import ast
import dataclasses
import inspect
import textwrap
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Annotated, Any, Protocol, TypeVar, cast

T = TypeVar("T")

_MORE = "shown by --help-all alone"
More = Annotated[T, _MORE]
"""Type of an option that the short help leaves out."""


class Dataclass(Protocol):
    """An instance of any dataclass."""

    __dataclass_fields__: dict[str, dataclasses.Field]


@dataclass(frozen=True)
class Detail:
    """In place of a configuration until a command runs."""

    load: Callable[[], Any]
    """Imports what the configuration is defined in, and returns its default."""


def details(arguments: type) -> dict[str, Detail]:
    """The configurations that a command line stands in for, by name of their field."""
    return {
        field.name: field.default
        for field in dataclasses.fields(arguments)
        if isinstance(field.default, Detail)
    }


def mentions_details(arguments: type, words: Sequence[str]) -> bool:
    """Whether one of the words is an option of such a configuration."""
    prefixes = tuple(f"--{name}." for name in details(arguments))
    return any(word.replace("_", "-").startswith(_dashed(prefixes)) for word in words)


def _dashed(names: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(name.replace("_", "-") for name in names)


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
    stand_ins = {
        field.name: value.load()
        for field in dataclasses.fields(given)
        if isinstance(value := getattr(given, field.name), Detail)
    }
    return dataclasses.replace(given, **stand_ins)


def is_more(hint: Any) -> bool:
    """Whether the type of an option is marked with `More`."""
    return _MORE in getattr(hint, "__metadata__", ())


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
