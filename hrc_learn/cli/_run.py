"""A command run: its command line, its exit status, and what it writes and prints.

Exit status: 0 done, 1 the work failed, 2 bad input, 143 ended by SIGTERM. Bad input ends in one
line on stderr.
"""

import io
import json
import os
import re
import shlex
import signal
import sys
import threading
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stderr
from dataclasses import asdict, fields
from pathlib import Path
from types import FrameType
from typing import Any, NoReturn

from hrc_learn.cli._options import complete, mentions_details, short_help
from hrc_learn.cli.arguments import Led
from hrc_learn.store import write_json

EXTRAS = {
    "tyro": "programs",
    "rich": "programs",
    "mujoco": "sim",
    "cv2": "sim",
    "pyarrow": "demos",
    "av": "demos",
    "scipy": "demos",
    "rerun": "viz",
    "matplotlib": "viz",
    "viser": "ui",
    "pygame": "gamepad",
    "forcedimension_core": "haptic",
    "lerobot": "lerobot",
    "gymnasium": "lerobot",
    "franky": "hardware",
    "pylibfranka": "hardware",
    "franky_sim": "hardware",
    "example_robot_data": "meshes",
    "ray": "sweep",
    "huggingface_hub": "hub",
    "httpx": "hub",
}
"""Extra of the package that brings a library."""


def run[Args](main: Callable[[Args], int | None], args: type[Args]) -> NoReturn:
    """Parse the command line into the dataclass `args`, call `main` with it, and exit.

    `main` returns the exit status, None for 0. A ValueError or a file that is missing, exists
    or may not be used is the user's doing and ends with status 2 and one line; a library that
    is not installed ends with status 1 and the extra that brings it; anything else is ours and
    shows its traceback with status 1.
    """
    words, program = sys.argv[1:], Path(sys.argv[0]).name
    # The program's own docstring says what it does.
    description = (sys.modules[main.__module__].__doc__ or main.__doc__ or "").strip() or None
    sys.exit(status_of(lambda: main(parse(args, words, program, description)) or 0))


def status_of(work: Callable[[], int]) -> int:
    """Do the work; its exit status, what went wrong told in one line on stderr.

    SIGTERM ends it as an exception, so that arms are stopped and files are closed on the way
    out, with status 143. Whoever reads the output may leave, as `head` does: nothing is said
    then, and the status is 1.
    """
    # As a user reads it: without the place in our code that warned.
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
            missing = f"{library} is not installed, which this needs: {extra}"
        elif not str(error).startswith("No module named"):
            missing = one_line(error)  # of a package without an extra: says itself what to do
        else:
            raise
        print(f"error: {missing}", file=sys.stderr)
        return 1
    except BrokenPipeError:
        if not _reader_left():
            raise
        return 1
    except OSError as error:
        if error.filename is None:
            raise
        print(f"error: {one_line(error)}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 1


def _reader_left() -> bool:
    """Whether nobody reads the output any more; what is left of it then goes nowhere."""
    try:
        print(flush=True)
    except BrokenPipeError:
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, sys.stdout.fileno())
        os.close(nowhere)
        return True
    return False


@contextmanager
def _ended_by_sigterm() -> Iterator[None]:
    """SIGTERM becomes `SystemExit` where it would have killed the process."""
    mine = threading.current_thread() is threading.main_thread()
    if not mine or signal.getsignal(signal.SIGTERM) is not signal.SIG_DFL:
        yield
        return

    def end(number: int, frame: FrameType | None) -> None:
        signal.signal(number, signal.SIG_DFL)  # a second one does not wait for what follows
        raise SystemExit(128 + number)

    signal.signal(signal.SIGTERM, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)


def parse[Args](
    arguments: type[Args], words: Sequence[str], program: str, description: str | None = None
) -> Args:
    """The command line as an instance of its dataclass.

    Args:
        arguments: The dataclass.
        words: What was typed after the command.
        program: The command.
        description: What it does; the docstring of the dataclass when None.

    Raises:
        SystemExit: After help, with status 0; of bad input, told in one line, with status 2.
    """
    if description is None and ("-h" in words or "--help" in words):
        print(short_help(program, arguments))
        sys.exit(0)

    import tyro  # a tenth of a second, which the short help does not need

    everything = "--help-all" in words
    words = ["--help" if word == "--help-all" else word for word in words]
    said = io.StringIO()
    try:
        with redirect_stderr(said):
            return tyro.cli(
                complete(arguments)
                if everything or mentions_details(arguments, words)
                else arguments,
                args=words,
                prog=program,
                description=description or (arguments.__doc__ or "").strip(),
            )
    except SystemExit:
        if text := said.getvalue():
            print(f"error: {_complaint(text)} (see {program} --help)", file=sys.stderr)
        raise


def _complaint(box: str) -> str:
    """What tyro says in a box of many lines, in one."""
    plain = re.sub(r"\x1b\[[0-9;]*m", "", box)  # colours
    # A frame, of blanks on a terminal without its characters; first the title, then sections
    # with rules between them.
    rows = [re.sub("[│╭╮╰╯]", " ", row).rstrip() for row in plain.splitlines()]
    _, *rows = [row[2:] for row in rows if row.strip()]
    sections = re.split(r"^ *[─-]{3,}$", "\n".join(rows), flags=re.MULTILINE)
    said, *others = [section for section in sections if section.strip()]
    for part in (said, *others):
        if "Unrecognized options:" in part:
            names = " ".join(part.split("Unrecognized options:")[1].replace(",", " ").split())
            meant = next((other for other in others if "Perhaps" in other), "")
            similar = " or ".join(re.findall(r"^ {4}(--[\w.-]+)", meant, re.MULTILINE))
            return f"unknown options: {names}" + (f"; perhaps {similar}" if similar else "")
    if missing := re.findall(r"^ {4}(\S+)", said, re.MULTILINE):
        return f"missing: {', '.join(missing)}"
    # Why each of several types did not fit is for programmers.
    text = " ".join(said.split()).split(" Got errors")[0].rstrip(".")
    # A configuration names its field, and who typed the command an option.
    if refused := re.match(r"Error parsing ([\w.-]+): (\w+) must be ", text):
        option = f"--{refused[1]}.{refused[2].replace('_', '-')}"
        return f"{option} must be {text[refused.end() :]}"
    return text


def write_values(path: Path | None, values: Mapping[str, float | int]) -> None:
    """Write measured values as one flat object, where a file is asked for."""
    if path is not None:
        write_json(path, values)


def one_line(error: BaseException) -> str:
    """What an exception says, with the notes added to it, on one line."""
    if isinstance(error, OSError) and error.strerror and error.filename:
        text = f"{error.filename}: {error.strerror}"
    else:
        text = str(error) or type(error).__name__
    return " ".join(" ".join([text, *getattr(error, "__notes__", ())]).split())


def refuse_existing(path: Path, overwrite: bool) -> None:
    """Say before any work that its result would find something in its place.

    Raises:
        FileExistsError: If there is something that may not be replaced.
    """
    if path.exists() and not overwrite:
        raise FileExistsError(f"{path} exists: give another --out, or --overwrite it")


def refuse_repeats(episodes: Sequence[int]) -> None:
    """Say that an episode is named twice, which would count it twice.

    Raises:
        ValueError: It is; says which.
    """
    repeated = [episode for episode, count in Counter(episodes).items() if count > 1]
    if repeated:
        raise ValueError(f"--episodes names {repeated[0]} more than once: name each once")


def leads_real_arm(args: Led, simulated_only: Sequence[str] = ()) -> bool:
    """Whether a command leads a real arm, not a simulated one.

    Args:
        args: Of the command.
        simulated_only: Names of its options that only the simulated work cell has.

    Raises:
        ValueError: An address without a driver, a driver without an address, or an option of
            the simulated work cell.
    """
    if args.arm == "sim":
        if args.ip:
            raise ValueError(f"--ip {args.ip} needs a driver: --arm franky or --arm franka.")
        return False
    if args.ip == "sim":
        return False
    if not args.ip:
        raise ValueError(
            f"--arm {args.arm} needs --ip with the address of the arm's control box; --ip sim "
            "serves the simulated arm there."
        )
    given = {field.name: getattr(args, field.name) != field.default for field in fields(args)}
    if simulated := [name for name in simulated_only if given.get(name)]:
        option = simulated[0].replace("_", "-")
        raise ValueError(f"--{option} is for simulated arms, not for a real one (--ip).")
    return True


def configuration(args: Any) -> dict[str, Any]:
    """The arguments of a command as they are kept with its results: plain JSON."""
    return json.loads(json.dumps(asdict(args), default=str))


def command_line() -> str:
    """What was typed to start this process, to be typed again."""
    program, *arguments = sys.argv
    # The installed command is found by its name; a program needs Python before it.
    start = ["python", program] if program.endswith(".py") else [Path(program).name]
    return shlex.join([*start, *arguments])
