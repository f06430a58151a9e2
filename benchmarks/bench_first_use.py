"""Waiting times of a newcomer: the commands of a documentation page, one after another.

The commands run in an empty folder and in a terminal, so that progress is shown as to a person.
For each command, the table lists wall time, CPU time, and the longest time without new output.
On a busy machine only the CPU time is meaningful. A command that serves a page is ended as soon
as it has printed its address. With an empty folder as XDG_CACHE_HOME, the first of two equal
commands fills the user's cache.

    python benchmarks/bench_first_use.py docs/tutorial.md
    python benchmarks/bench_first_use.py --commands "hrc demo --out new" "hrc demo --out new"
    python benchmarks/bench_first_use.py --commands "hrc page --out one" "hrc page --out two"
"""

import os
import pty
import re
import shlex
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from hrc_learn import cli
from hrc_learn.cli._run import write_values

ROOT = Path(__file__).parents[1]
BLOCK = re.compile(r"^```sh\n(.*?)^```", re.MULTILINE | re.DOTALL)
CONTROL = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]")
WIDTH, HEIGHT = "100", "40"
"""Size of the terminal [characters]."""
SERVES = ("hrc page", "hrc serve", "hrc curate")
"""Commands that run until a person ends them."""
ADDRESS = re.compile(rb"https?://\S+\s")


@dataclass(frozen=True, kw_only=True)
class Args:
    page: Annotated[Path, tyro.conf.Positional] = ROOT / "docs" / "tutorial.md"
    """Markdown file whose shell blocks are run."""
    commands: tuple[str, ...] = ()
    """Commands to run instead of those of a page."""
    keep: Path | None = None
    """Folder to run in and keep. None: a temporary folder."""
    json: Path | None = None
    """File for the measured values, one flat JSON object of numbers."""


@dataclass(frozen=True)
class Waited:
    """Times of a command [s]."""

    command: str
    wall: float
    cpu: float
    silence: float
    """Longest time without new output."""
    before: str
    """Last line of output before that time."""
    output: str
    status: int


def commands_of(page: str) -> list[str]:
    """Commands in a page's shell blocks, without those that a person has to end."""
    lines = [line for block in BLOCK.findall(page) for line in block.splitlines()]
    commands = [line.split(" #")[0].strip() for line in lines]
    return [command for command in commands if command and not command.startswith(SERVES)]


def wait_for(command: str, folder: Path) -> Waited:
    """Run a command in its own terminal.

    Raises:
        FileNotFoundError: There is no such program.
    """
    words = shlex.split(command)
    if words[:2] == ["hrc", "show"] and "--out" not in words:
        words += ["--out", "shown.rrd"]  # no person is there to close a viewer
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    size = {"COLUMNS": WIDTH, "LINES": HEIGHT, "TERM": "xterm-256color"}
    ours, theirs = pty.openpty()
    begin = last = time.monotonic()
    process = subprocess.Popen(
        words,
        cwd=folder,
        env={**os.environ, **size, "PATH": path},
        stdin=subprocess.DEVNULL,
        stdout=theirs,
        stderr=theirs,
    )
    os.close(theirs)
    silence, before, output = 0.0, 0, b""
    serves = served = command.startswith(SERVES)
    while True:
        try:
            new = os.read(ours, 65536)
        except OSError:  # Linux raises this when the last process has closed the terminal
            new = b""
        now = time.monotonic()
        if now - last > silence:
            silence, before = now - last, len(output)
        last = now
        if not new:
            break
        output += new
        if serves and ADDRESS.search(output):
            process.send_signal(signal.SIGINT)
            serves = False
    os.close(ours)
    _, status, used = os.wait4(process.pid, 0)  # includes the time of its child processes
    process.returncode = os.waitstatus_to_exitcode(status)
    return Waited(
        command=command,
        wall=time.monotonic() - begin,
        cpu=used.ru_utime + used.ru_stime,
        silence=silence,
        before=_last_line(output[:before].decode("utf-8", "replace")),
        output=output.decode("utf-8", "replace"),
        # A served page may be interrupted before its loop has begun.
        status=0 if served and not serves else process.returncode,
    )


def _last_line(output: str) -> str:
    """Last line of a terminal's output, without control sequences for cursor and colour."""
    lines = [line.strip() for line in re.split(r"[\r\n]+", CONTROL.sub("", output))]
    return next((line for line in reversed(lines) if line), "")


def main(args: Args) -> None:
    """Run the commands, print a table and write the values; end at the first failure."""
    commands = args.commands or tuple(commands_of(args.page.read_text("utf-8")))
    console = Console()
    table = Table("command", r"wall \[s]", r"CPU \[s]", r"longest silence \[s]")
    waited: list[Waited] = []
    with tempfile.TemporaryDirectory() as name:
        folder = args.keep or Path(name)
        folder.mkdir(parents=True, exist_ok=True)
        for command in commands:
            console.print(f"[dim]$ {command}")
            one = wait_for(command, folder)
            waited.append(one)
            table.add_row(command, f"{one.wall:.0f}", f"{one.cpu:.0f}", f"{one.silence:.1f}")
            console.print(f"[dim]silent for {one.silence:.1f} s after: {escape(one.before)}")
            if one.status:
                console.print(one.output)
                break
    wall, cpu = (sum(getattr(one, name) for one in waited) for name in ("wall", "cpu"))
    silence = max(one.silence for one in waited)
    table.add_section()
    table.add_row(f"{len(waited)} commands", f"{wall:.0f}", f"{cpu:.0f}", f"{silence:.1f}")
    console.print(table)
    figures = {"commands": len(waited), "wall_s": wall, "cpu_s": cpu, "silence_s": silence}
    write_values(args.json, figures)
    if waited[-1].status:
        raise SystemExit(waited[-1].status)


if __name__ == "__main__":
    cli.run(main, Args)
