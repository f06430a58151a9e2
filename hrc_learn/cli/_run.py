"""Common frame of all commands: command line, settings, exit status, error messages, JSON
values.

Exit status: 0 done, 1 the work failed, 2 bad input, 143 ended by SIGTERM. Bad input is reported
in one line on stderr. Settings without an option of their own are fields of configuration
dataclasses, given as TOML: `--config site.speed=0.1 cell.toml` sets a field and reads a file;
the last value counts.
"""

import dataclasses
import inspect
import io
import os
import re
import shlex
import signal
import sys
import threading
import tomllib
import typing
import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stderr
from dataclasses import asdict
from difflib import get_close_matches
from pathlib import Path
from shutil import get_terminal_size
from textwrap import TextWrapper
from types import FrameType
from typing import Any, NoReturn

import msgspec

from hrc_learn.store import DISK_ERRORS, json_text, parse_json, read_toml, write_json

_LIBRARIES = read_toml(Path(__file__).with_name("extras.toml"))
_DEVICES = {"--robot": "site.device", "--teleop": "site.leader"}
"""Settings that hold LeRobot's options for a device."""
EXTRAS = {library: extra for extra, names in _LIBRARIES.items() for library in names}
"""Extra of the package that installs a library."""


def run[Args](main: Callable[[Args], int | None], args: type[Args]) -> NoReturn:
    """Parse the command line into the dataclass `args`, call `main` with it, and exit.

    `main` returns the exit status, None for 0. A ValueError is the caller's mistake, and so is
    a file that is missing, already exists or may not be used: one line is printed on stderr,
    and the status is 2. If a library is not installed, the line names the extra that installs
    it, and the status is 1. Other exceptions show their traceback.
    """
    words, program = sys.argv[1:], Path(sys.argv[0]).name
    description = (sys.modules[main.__module__].__doc__ or main.__doc__ or "").strip() or None
    sys.exit(status_of(lambda: main(parse(args, words, program, description)) or 0))


def status_of(work: Callable[[], int]) -> int:
    """Run the work and return its exit status; errors are one line on stderr.

    SIGTERM is raised as an exception, so that arms are stopped and files closed, with status
    143. A closed output, as with `hrc ... | head`, ends quietly with status 1.
    """
    # Users do not need the source line of a warning.
    warnings.formatwarning = lambda message, *_place, **_line: f"warning: {message}\n"
    try:
        with _ended_by_sigterm():
            status = work()
        sys.stdout.flush()
        return status
    except (ValueError, FileNotFoundError, FileExistsError, NotADirectoryError) as error:
        print(f"error: {one_line(error)}", file=sys.stderr)
        return 2
    except ModuleNotFoundError as error:
        library = (error.name or "").split(".")[0]
        if library in EXTRAS:
            extra = f"pip install 'hrc-learn[{EXTRAS[library]}]'"
            missing = f"{library} is not installed; install it with: {extra}"
        elif not str(error).startswith("No module named"):
            missing = one_line(error)  # our own message, which says what to do
        else:
            raise
        print(f"error: {missing}", file=sys.stderr)
        return 1
    except BrokenPipeError:
        if not _output_closed():
            raise
        return 1
    except ConnectionError as error:  # a device that cannot be reached
        print(f"failed: {one_line(error)}", file=sys.stderr)
        return 1
    except OSError as error:
        if error.filename is None and error.errno not in DISK_ERRORS:
            raise
        print(f"error: {one_line(error)}", file=sys.stderr)
        return 2
    except (MemoryError, RuntimeError) as error:
        if not isinstance(error, MemoryError) and "allocate memory" not in str(error):
            raise
        print(f"failed: not enough memory: {one_line(error)}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 1


def _output_closed() -> bool:
    """True if the reader of stdout is gone; the rest of the output is then discarded."""
    try:
        print(flush=True)
    except BrokenPipeError:
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, sys.stdout.fileno())
        os.close(null)
        return True
    return False


@contextmanager
def _ended_by_sigterm() -> Iterator[None]:
    """Raise `SystemExit` on SIGTERM, unless another handler is installed."""
    is_main = threading.current_thread() is threading.main_thread()
    if not is_main or signal.getsignal(signal.SIGTERM) is not signal.SIG_DFL:
        yield
        return

    def end(number: int, frame: FrameType | None) -> None:
        signal.signal(number, signal.SIG_DFL)  # a second SIGTERM kills at once
        raise SystemExit(128 + number)

    signal.signal(signal.SIGTERM, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)


def parse[Args](
    arguments: type[Args], words: Sequence[str], program: str, description: str | None = None
) -> Args:
    """Parse a command line into its dataclass.

    Args:
        arguments: Dataclass of the command line.
        words: Words typed after the command.
        program: Name of the command.
        description: Text above the options. Default: the docstring of the dataclass.

    Raises:
        SystemExit: After help, with status 0; after one line about bad input, with status 2.
    """
    import tyro  # takes 0.1 s, which a mistyped command avoids

    said = io.StringIO()
    try:
        with redirect_stderr(said):
            return tyro.cli(
                arguments,
                args=gathered_settings(words),
                prog=program,
                description=_wrapped(description or inspect.getdoc(arguments) or "") or None,
            )
    except SystemExit:
        if text := said.getvalue():
            print(f"error: {_complaint(text)} (see {program} --help)", file=sys.stderr)
        raise


def _wrapped(text: str) -> str:
    """Paragraphs wrapped for the terminal; tyro would join lines without an indent."""
    width = get_terminal_size().columns
    parts = text.split("\n\n")
    plain = [part[:1].isalpha() and "\n " not in part for part in parts]
    wrap = TextWrapper(width, subsequent_indent="  ", break_on_hyphens=False).fill
    return "\n\n".join(wrap(p) if q else p for p, q in zip(parts, plain, strict=True))


def gathered_settings(words: Sequence[str]) -> list[str]:
    """Command line with all settings after one `--config`, in their order.

    Settings are the values of every `--config` (the parser would keep only the last one) and
    LeRobot's options for a device. Both `--robot.port=/dev/ttyACM0` and `--robot.port
    /dev/ttyACM0` become `site.device.port=/dev/ttyACM0`.
    """
    rest, settings, in_settings, remaining = [], [], False, iter(words)
    for word in remaining:
        option, assigned, value = word.partition("=")
        device, _, name = option.partition(".")
        if device in _DEVICES and name:
            value = value if assigned else next(remaining, "--")
            if value.startswith("--"):
                raise ValueError(f"{option} needs a value, such as {option}=VALUE")
            settings.append(f"{_DEVICES[device]}.{name}={value}")
            continue
        if word.startswith("--"):
            in_settings = option == "--config"
            word = value if in_settings else word  # the value of --config=VALUE
        if not in_settings:
            rest.append(word)
        elif word:
            settings.append(word)
    return [*rest, "--config", *settings] if settings else rest


def _complaint(box: str) -> str:
    """One-line message made from the box in which tyro reports an error."""
    plain = re.sub(r"\x1b\[[0-9;]*m", "", box)  # colours
    # Inside the frame: a title, then sections separated by rules.
    rows = [re.sub("[│╭╮╰╯]", " ", row).rstrip() for row in plain.splitlines()]
    _, *rows = [row[2:] for row in rows if row.strip()]
    sections = re.split(r"^ *[─-]{3,}$", "\n".join(rows), flags=re.MULTILINE)
    said, *others = [section for section in sections if section.strip()]
    for part in (said, *others):
        if "Unrecognized options:" in part:
            names = " ".join(part.split("Unrecognized options:")[1].replace(",", " ").split())
            meant = next((other for other in others if "Perhaps" in other), "")
            similar = " or ".join(re.findall(r"^ {4}(--[\w.-]+)", meant, re.MULTILINE))
            hint = f"; did you mean {similar}?" if similar else ""
            return f"unknown options: {names}{hint}"
    if missing := re.findall(r"^ {4}(\S+)", said, re.MULTILINE):
        return f"missing: {', '.join(missing)}"
    # The reasons why each member of a union type failed are of use to programmers only.
    return " ".join(said.split()).split(" Got errors")[0].rstrip(".")


def write_values(path: Path | None, values: Mapping[str, float | int]) -> None:
    """Write measured values as one flat JSON object if a file is given."""
    if path is not None:
        write_json(path, values)


def one_line(error: BaseException) -> str:
    """Message of an exception with its notes, on one line."""
    if isinstance(error, OSError) and error.strerror and error.filename:
        text = f"{error.filename}: {error.strerror}"
    else:
        text = str(error) or type(error).__name__
    return " ".join(" ".join([text, *getattr(error, "__notes__", ())]).split())


def refuse_existing(path: Path, overwrite: bool) -> None:
    """Refuse an existing result before any work is done.

    Raises:
        FileExistsError: The path exists and may not be replaced.
    """
    if path.exists() and not overwrite:
        raise FileExistsError(f"{path} exists: give another --out, or --overwrite")


def refuse_repeats(episodes: Sequence[int]) -> None:
    """Refuse episodes that are named twice, because they would count twice.

    Raises:
        ValueError: An episode is repeated.
    """
    repeated = [episode for episode, count in Counter(episodes).items() if count > 1]
    if repeated:
        raise ValueError(f"--episodes names {repeated[0]} more than once: name each once")


def has_screen() -> bool:
    """True if this machine can open windows."""
    return not sys.platform.startswith("linux") or any(
        os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY")
    )


def configuration(args: Any) -> dict[str, Any]:
    """Arguments of a command as plain JSON, to be stored with its results."""
    return parse_json(json_text(asdict(args)))


def command_line() -> str:
    """Command line that repeats this process, valid in the folder where it was started."""
    from hrc_learn.viz.report import shortest

    program, *arguments = sys.argv
    path = Path(program)
    start = ["python", shortest(program)] if path.suffix == ".py" else [path.name]
    # `python -m hrc_learn.cli` is `hrc`, which is on the path; other programs need Python.
    if path.name == "__main__.py":
        start = ["hrc"]
    return shlex.join([*start, *map(shortest, arguments)])


def with_settings[Settings](texts: Sequence[str], default: Settings) -> Settings:
    """Settings with the given values in place of their defaults.

    Args:
        texts: `NAME.FIELD=VALUE`, with the value in TOML or as a plain word, or paths of TOML
            files. "help" prints all settings and exits.
        default: Dataclass of configuration dataclasses.

    Raises:
        ValueError: A setting is unknown or has a value of another type.
        FileNotFoundError: There is no such file.
    """
    if "help" in texts:
        print("\n".join(_listed("", default)))
        sys.exit(0)
    given: dict[str, Any] = {}
    for text in texts:
        given = _merged(given, _parsed(text))
    return updated(default, given, "--config ")


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


def updated(config: Any, given: Mapping[str, Any], place: str) -> Any:
    """Dataclass with the given fields replaced. `place` precedes their names in errors.

    Raises:
        ValueError: There is no such field, or a value has another type.
    """
    hints = typing.get_type_hints(type(config))
    known = [field.name for field in dataclasses.fields(config)]
    values = {}
    for name, value in given.items():
        if name not in known:
            raise ValueError(_unknown(place, name, known))
        current = getattr(config, name)
        if dataclasses.is_dataclass(current) and isinstance(value, Mapping):
            values[name] = updated(current, value, f"{place}{name}.")
        elif isinstance(current, dict) and isinstance(value, dict):
            values[name] = _merged(current, _converted(value, hints[name], f"{place}{name}"))
        else:
            values[name] = _converted(value, hints[name], f"{place}{name}")
    try:
        return dataclasses.replace(config, **values)
    except ValueError as error:
        error.add_note(f"({place}{', '.join(values)})")
        raise


def _merged(old: dict[str, Any], new: dict[str, Any]) -> dict[str, Any]:
    """Nested dictionary of settings, in which `new` overrides `old`."""
    both = old.keys() & new.keys()
    inner = {k for k in both if isinstance(old[k], dict) and isinstance(new[k], dict)}
    return old | new | {k: _merged(old[k], new[k]) for k in inner}


def _converted(value: Any, hint: Any, place: str) -> Any:
    """A TOML value, converted to its annotated type."""
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
    """Value converted to a type that TOML does not have."""
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
    """Every setting below a name with its value, one per line."""
    if not dataclasses.is_dataclass(value):
        yield f"{name} = {value}"
        return
    for field in dataclasses.fields(value):
        yield from _listed(f"{name}.{field.name}".lstrip("."), getattr(value, field.name))
