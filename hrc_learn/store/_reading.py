"""Small JSON and TOML files, and JSON messages, validated by schemas.

A schema is a dataclass. A value that is missing, not finite, out of bounds or of a wrong type
raises a one-line `ValueError` that names the file, the field and the remedy. Fields that the
schema does not name are ignored.
"""

import math
import os
import re
import tomllib
from pathlib import Path
from typing import Annotated, Any

import msgspec
from msgspec import Meta

# Bounds far beyond any robot arm: values outside are damaged or in other units.
Metres = Annotated[float, Meta(ge=-1e3, le=1e3)]
"""Length in a file [m]."""
Radians = Annotated[float, Meta(ge=-1e3, le=1e3)]
"""Angle in a file [rad]."""
Pixels = Annotated[float, Meta(ge=-1e6, le=1e6)]
"""Image coordinate or focal length in a file [px]."""
Count = Annotated[int, Meta(ge=0, le=2**53)]
"""Count or index in a file."""
Positive = Annotated[float, Meta(gt=0, le=1e300)]
"""Positive, finite number in a file."""

MAX_SIZE = 64 * 2**20
"""Largest file that is read [bytes]. Files written by this package have a few kilobytes."""


def read_json[T](
    path: str | os.PathLike[str], schema: type[T] = dict, advice: str = "restore it"
) -> T:
    """Read a JSON file.

    Args:
        path: File to read.
        schema: Dataclass of the file's content, or `dict` for any object.
        advice: Remedy for a damaged file, the end of the error message.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: The file does not match the schema.
    """
    return parse_json(_content(Path(path), advice), schema, str(path), advice)


def read_toml[T](path: str | os.PathLike[str], schema: type[T] = dict) -> T:
    """Read a TOML file; arguments and errors as for `read_json`."""
    data = _content(Path(path), "correct it")
    try:
        content = tomllib.loads(data.decode(), parse_float=_finite)
        return msgspec.convert(content, schema)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path}: {_complaint(error)}; correct it") from None


def parse_json[T](
    data: bytes | str, schema: type[T] = dict, source: str = "message", advice: str = ""
) -> T:
    """Parse JSON from anywhere.

    Args:
        data: Text in UTF-8, whose size the caller must bound.
        schema: Dataclass of the content, or `dict` for any object.
        source: Name of the origin, the beginning of the error message.
        advice: Remedy, the end of the error message.

    Raises:
        ValueError: The text does not match the schema.
    """
    try:
        return msgspec.json.decode(data, type=schema)
    except (ValueError, RecursionError) as error:
        end = f"; {advice}" if advice else ""
        raise ValueError(f"{source}: {_complaint(error)}{end}") from None


def json_text(content: object, *, indent: bool = True) -> str:
    """JSON text of any content, on many indented lines or on one.

    Arrays and tensors become lists, non-finite numbers become null, other objects become text.
    """
    data = msgspec.json.encode(content, enc_hook=_plain)
    return (msgspec.json.format(data, indent=2) if indent else data).decode() + "\n"


def _plain(value: Any) -> object:
    return value.tolist() if hasattr(value, "tolist") else str(value)


def _content(path: Path, advice: str) -> bytes:
    if not path.exists():
        raise FileNotFoundError(f"there is no file {path}")
    if not path.is_file():  # a pipe would wait for ever
        raise ValueError(f"{path} is not a file")
    if path.stat().st_size > MAX_SIZE:
        raise ValueError(f"{path} is larger than {MAX_SIZE >> 20} MiB; {advice}")
    return path.read_bytes().removeprefix(b"\xef\xbb\xbf")  # mark of some Windows editors


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{text} is not a finite number")
    return value


def _complaint(error: Exception) -> str:
    """Text for an error of parsing: field and problem."""
    if isinstance(error, RecursionError):
        return "nested too deeply"
    if isinstance(error, UnicodeError):
        return f"not text in UTF-8 ({error})"
    if type(error) is msgspec.DecodeError:
        return f"not valid JSON ({error})"
    text, _, place = str(error).partition(" - at `$")
    text = text.replace("`", "").replace("Object missing required field", "lacks the field")
    text = re.sub(r"^Invalid enum value", "unknown value", text)
    place = place.rstrip("`").lstrip(".")
    return f"{place}: {text[0].lower()}{text[1:]}" if place else text[0].lower() + text[1:]
