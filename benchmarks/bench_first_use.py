"""How long a newcomer waits: the commands of a page of the documentation, one after the other.

They run in an empty folder and at a terminal, so that progress is shown as a person sees it.
Of each: time on the wall and of the CPU, and the longest time in which the terminal showed
nothing new. On a machine that does something else only CPU time means much.

    python benchmarks/bench_first_use.py docs/tutorial.md
    python benchmarks/bench_first_use.py --commands "hrc demo --out new" "hrc demo --out new"
"""

import os
import pty
import re
import shlex
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
"""Of the terminal [characters]."""
SERVES = ("hrc page", "hrc serve", "hrc curate")
"""What goes on until somebody ends it."""


@dataclass(frozen=True, kw_only=True)
class Args:
    page: Annotated[Path, tyro.conf.Positional] = ROOT / "docs" / "tutorial.md"
    """Markdown file whose shell blocks are run."""
    commands: tuple[str, ...] = ()
    """Run instead of those of a page."""
    keep: Path | None = None
    """Folder to run in and keep; a temporary one when None."""
    json: Path | None = None
    """Receives the figures as one flat object."""


@dataclass(frozen=True)
class Waited:
    """What a command took [s]."""

    command: str
    wall: float
    cpu: float
    silence: float
    """Longest time without anything new."""
    before: str
    """Last line before it."""
    output: str
    status: int


def commands_of(page: str) -> list[str]:
    """The commands of a page's shell blocks, without those that somebody has to end."""
    lines = [line for block in BLOCK.findall(page) for line in block.splitlines()]
    commands = [line.split(" #")[0].strip() for line in lines]
    return [command for command in commands if command and not command.startswith(SERVES)]


def wait_for(command: str, folder: Path) -> Waited:
    """Run a command at a terminal of its own.

    Raises:
        FileNotFoundError: There is no such program.
    """
    words = shlex.split(command)
    if words[:2] == ["hrc", "show"] and "--out" not in words:
        words += ["--out", "shown.rrd"]  # there is nobody to close a viewer
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
    while True:
        try:
            new = os.read(ours, 65536)
        except OSError:  # Linux says so when nobody has the terminal any more
            new = b""
        now = time.monotonic()
        if now - last > silence:
            silence, before = now - last, len(output)
        last = now
        if not new:
            break
        output += new
    os.close(ours)
    _, status, used = os.wait4(process.pid, 0)  # its children's time is in it
    process.returncode = os.waitstatus_to_exitcode(status)
    return Waited(
        command=command,
        wall=time.monotonic() - begin,
        cpu=used.ru_utime + used.ru_stime,
        silence=silence,
        before=_last_line(output[:before].decode("utf-8", "replace")),
        output=output.decode("utf-8", "replace"),
        status=process.returncode,
    )


def _last_line(output: str) -> str:
    """Of a terminal's output, without what moves its cursor and colours it."""
    lines = [line.strip() for line in re.split(r"[\r\n]+", CONTROL.sub("", output))]
    return next((line for line in reversed(lines) if line), "")


def main(args: Args) -> None:
    """Run, print a table, write the figures; ends at the first command that fails."""
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
