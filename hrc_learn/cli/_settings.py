"""Settings beyond the options of a command: fields of configuration dataclasses, given as TOML.

`--config site.speed=0.1 cell.toml` sets a field and reads a file; the last value counts.
"""

import dataclasses
import sys
import tomllib
import typing
from collections.abc import Iterable, Iterator, Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import msgspec

from hrc_learn.store import read_toml


def with_settings[Settings](texts: Sequence[str], default: Settings) -> Settings:
    """Settings with the given values in place of their defaults.

    Args:
        texts: `NAME.FIELD=VALUE`, the value as in TOML or a plain word, or paths of TOML files.
            "help" prints all settings and exits.
        default: Dataclass of configuration dataclasses.

    Raises:
        ValueError: A setting is unknown or has a value of another type.
        FileNotFoundError: There is no such file.
    """
    if "help" in texts:
        print("\n".join(_listed("", default)))
        sys.exit(0)
    for text in texts:
        default = _updated(default, _parsed(text), "--config ")
    return default


def _parsed(text: str) -> dict[str, Any]:
    name, assigned, value = text.partition("=")
    if not assigned:
        return read_toml(text)
    name = name.strip().replace("-", "_")
    try:
        return tomllib.loads(f"{name} = {value}")
    except tomllib.TOMLDecodeError:
        quoted = value.replace("\\", "\\\\").replace('"', '\\"')
    try:
        return tomllib.loads(f'{name} = "{quoted}"')
    except tomllib.TOMLDecodeError as error:
        raise ValueError(f"--config {text}: not NAME=VALUE ({error})") from None


def _unknown(place: str, name: str, known: Iterable[str]) -> str:
    close = get_close_matches(name, known, 1)
    hint = f"did you mean {close[0]}?" if close else f"there are {', '.join(known)}"
    return f"{place}{name}: no such setting; {hint}"


def _updated(config: Any, given: Mapping[str, Any], place: str) -> Any:
    """Dataclass with the given fields replaced. `place` precedes their names in errors."""
    hints = typing.get_type_hints(type(config))
    known = [field.name for field in dataclasses.fields(config)]
    values = {}
    for name, value in given.items():
        if name not in known:
            raise ValueError(_unknown(place, name, known))
        current = getattr(config, name)
        if dataclasses.is_dataclass(current) and isinstance(value, Mapping):
            values[name] = _updated(current, value, f"{place}{name}.")
        else:
            values[name] = _converted(value, hints[name], f"{place}{name}")
    try:
        return dataclasses.replace(config, **values)
    except ValueError as error:
        error.add_note(f"({place}{', '.join(values)})")
        raise


def _converted(value: Any, hint: Any, place: str) -> Any:
    """A TOML value as its annotated type."""
    if isinstance(hint, typing.TypeAliasType):
        hint = hint.__value__
    if value in ("none", "None") and type(None) in typing.get_args(hint):  # TOML has no null
        return None
    try:
        made = msgspec.convert(value, hint, dec_hook=_custom)
    except (ValueError, TypeError, NotImplementedError) as error:
        expected = getattr(hint, "__name__", str(hint))
        raise ValueError(f"{place} must be {expected}, got {value!r} ({error})") from None
    _refuse_unknown(value, made, place)
    return made


def _custom(kind: type, value: Any) -> Any:
    """Value of a type that TOML does not know."""
    if kind is Path and isinstance(value, str):
        return Path(value)
    raise ValueError(f"{kind.__name__} cannot be given here")


def _refuse_unknown(value: Any, made: Any, place: str) -> None:
    """Refuse fields that a dataclass does not have, which msgspec ignores."""
    if isinstance(value, list):
        for part, item in zip(value, made, strict=True):
            _refuse_unknown(part, item, place)
    elif isinstance(value, dict) and dataclasses.is_dataclass(made):
        known = [field.name for field in dataclasses.fields(made)]
        for name, part in value.items():
            if name not in known:
                raise ValueError(_unknown(f"{place}.", name, known))
            _refuse_unknown(part, getattr(made, name), f"{place}.{name}")


def _listed(name: str, value: Any) -> Iterator[str]:
    """Every setting below a name with its value, one a line."""
    if not dataclasses.is_dataclass(value):
        yield f"{name} = {value}"
        return
    for field in dataclasses.fields(value):
        yield from _listed(f"{name}.{field.name}".lstrip("."), getattr(value, field.name))
