"""Score of a dataset check: defects found in broken copies, messages on sound sets."""

import re
import resource
import shutil
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path

from broken_copies import Copy
from file_defects import FILES, VIDEOS
from value_defects import STAMPS, VALUES, Kind, NotHereError

KINDS: dict[str, Kind] = VALUES | STAMPS | FILES | VIDEOS

Line = tuple[str, str]
"""A finding: its level, and the whole of its text."""

Examine = Callable[[str], list[Line]]
"""Check of the dataset in a folder; it raises if it fails."""


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """Result of a check of one broken copy."""

    dataset: str
    kind: str
    severe: bool
    noticed: bool
    """True if there is a message that the sound set does not give."""
    found: bool
    """True if such a message names the place of the defect."""
    error: bool
    """True if such a message is an error."""
    crash: str
    """Reason for a missing report: an exception, or the time limit."""
    seconds: float
    megabytes: float
    """Most memory the process held."""
    said: tuple[str, ...]


def examine(root: str) -> list[Line]:
    """Messages of `check_dataset`.

    Raises:
        RuntimeError: A step of the check failed unexpectedly, which is a fault of the check.
    """
    from hrc_learn.demos import check_dataset

    report = check_dataset(root)
    lines = [("error", str(i)) for i in report.errors]
    lines += [("warning", str(i)) for i in report.warnings]
    "\n".join(report.lines())
    for _, text in lines:
        if "cannot be examined further (" in text:
            raise RuntimeError(text)
    return lines


def _run(examine: Examine, root: str, pipe) -> None:
    """Run a check in its own process, and send its findings or the reason of its failure."""
    start = time.monotonic()
    lines: list[Line] = []
    crash = ""
    try:
        lines = examine(root)
    except BaseException as error:
        crash = f"{type(error).__name__}: {error}"[:300]
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    pipe.send((lines, crash, time.monotonic() - start, memory))


class Checker:
    """Checks datasets in processes of their own, bounded in time."""

    def __init__(
        self,
        limit: float = 60.0,
        examine: Examine = examine,
        modules: Sequence[str] = ("hrc_learn.demos.quality.check",),
    ):
        """
        Args:
            limit: Time limit of a check [s].
            examine: The check.
            modules: Modules imported once for all processes.
        """
        self.limit, self._examine = limit, examine
        self._context = get_context("forkserver")
        self._context.set_forkserver_preload([*modules])

    def __call__(self, root: Path) -> tuple[list[Line], str, float, float]:
        """Findings, reason of a failure, seconds and megabytes."""
        ours, theirs = self._context.Pipe(duplex=False)
        arguments = (self._examine, str(root), theirs)
        process = self._context.Process(target=_run, args=arguments)
        process.start()
        theirs.close()
        try:
            answer = ours.recv() if ours.poll(self.limit) else None
        except EOFError:
            answer = ([], "the process died", 0.0, 0.0)
        if answer is None:
            process.kill()
            answer = ([], f"no answer within {self.limit:g} s", self.limit, 0.0)
        process.join()
        return answer


def check_here(root: Path) -> tuple[list[Line], str, float, float]:
    """What a `Checker` gives, without a process of its own: fast, but not bounded in time."""
    return examine(str(root)), "", 0.0, 0.0


def broken_copy(clean: Path, kind: Kind, folder: Path) -> Copy | None:
    """A copy with the defect; None if the defect does not apply to the set."""
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(clean, folder)
    copy = Copy(folder)
    try:
        kind.damage(copy)
    except NotHereError:
        return None
    return copy


def outcomes(
    clean: Path,
    name: str,
    kinds: Iterable[str],
    work: Path,
    check: Callable[[Path], tuple[list[Line], str, float, float]],
) -> Iterator[Outcome]:
    """Check copies of a set with each kind of damage.

    Args:
        clean: The sound set.
        name: Name of the set in the outcomes.
        kinds: Names in `KINDS`.
        work: Folder for the copies.
        check: Check of one copy.
    """
    before = {_plain(line, clean) for line in check(clean)[0]}
    for kind_name in kinds:
        kind = KINDS[kind_name]
        copy = broken_copy(clean, kind, work / "broken")
        if copy is None:
            continue
        lines, crash, seconds, megabytes = check(copy.root)
        new = [line for line in lines if _plain(line, copy.root) not in before]
        if "statistics" not in kind_name:  # those are off after almost any damage
            new = [line for line in new if "statistics are" not in line[1]]
        noticed = bool(new)
        if kind.local:
            new = [line for line in new if _names(line[1], copy)]
        yield Outcome(
            dataset=name,
            kind=kind_name,
            severe=kind.severe,
            noticed=noticed,
            found=bool(new),
            error=any(level == "error" for level, _ in new),
            crash=crash,
            seconds=seconds,
            megabytes=megabytes,
            said=tuple(f"{level}: {text}" for level, text in new),
        )
        shutil.rmtree(copy.root, ignore_errors=True)


def _plain(line: Line, root: Path) -> Line:
    return line[0], line[1].replace(str(root), "")


def _names(text: str, copy: Copy) -> bool:
    """True if a finding names the second episode or its file."""
    number = rf"(?i)episodes?(?:\(s\))?[ a-z:]*[\[(]*(?:\d+, )*{copy.episode}\b"
    if re.search(number, text) or copy.data in text:
        return True
    return bool(re.search(r"(episode_000001|file-000)\.mp4", text))
