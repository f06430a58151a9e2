"""How many small faults would the tests notice? A random sample of mutants answers.

Each mutant is the package with one expression changed: a comparison, a sign, a constant, a
clamp left out. The tests of its package (tests/X for hrc_learn/X) run against it in a copy of
the checkout, the test file named like the module first; a mutant under which all pass has
survived. Survivors are a missing test or an equivalent program: read each. Numbers at
the top of a module or as defaults of settings are choices, not logic, and are left alone.

    python tools/mutation_sample.py controller jacobian --number 25 --seed 1 --json out.json
    python tools/mutation_sample.py dmp/joint.py --list

With `--executed` (files that `executed_lines.py` wrote) only tests that execute the changed
line run, the quickest first and at most `--cap` seconds of them, in a process forked from one
that has loaded the libraries: a few seconds a mutant. `.` stands for all packages.
"""

from __future__ import annotations

import argparse
import ast
import contextlib
import copy
import importlib
import itertools
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]

# One replacement an operator: the one that a slip of the hand makes, and for comparisons both
# the slip at the limit (< for <=) and the wrong way round.
COMPARISONS: dict[type[ast.cmpop], tuple[type[ast.cmpop], ...]] = {
    ast.Lt: (ast.LtE, ast.Gt),
    ast.LtE: (ast.Lt, ast.Gt),
    ast.Gt: (ast.GtE, ast.Lt),
    ast.GtE: (ast.Gt, ast.Lt),
    ast.Eq: (ast.NotEq,),
    ast.NotEq: (ast.Eq,),
    ast.Is: (ast.IsNot,),
    ast.IsNot: (ast.Is,),
    ast.In: (ast.NotIn,),
    ast.NotIn: (ast.In,),
}
ARITHMETIC: dict[type[ast.operator], type[ast.operator]] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.FloorDiv: ast.Mult,
    ast.Mod: ast.Mult,
    ast.Pow: ast.Mult,
    ast.BitAnd: ast.BitOr,
    ast.BitOr: ast.BitAnd,
}
OPPOSITES = {
    "minimum": "maximum",
    "min": "max",
    "amin": "amax",
    "argmin": "argmax",
    "any": "all",
    "floor": "ceil",
    "cumsum": "cumprod",
}
OPPOSITES |= {new: old for old, new in OPPOSITES.items()}
# Methods that may be forgotten: x.clamp(0, 1) -> x.
DROPPED = {"clamp", "clamp_min", "clamp_max", "clip", "abs", "sqrt", "square", "masked_fill"}
DROPPED |= {"nan_to_num", "strip", "lower"}
MODULES = {"torch", "np", "math", "F"}


@dataclass(frozen=True)
class Mutant:
    """One change of one file."""

    path: Path
    """Relative to the checkout."""
    line: int
    kind: str
    before: str
    after: str
    source: str
    """The whole file after the change."""

    def __str__(self) -> str:
        return f"{self.path}:{self.line}  {self.before}  ->  {self.after}"


@dataclass(frozen=True, eq=False)
class Change:
    """One expression that may change, and how."""

    path: Path
    """Relative to the checkout."""
    node: ast.expr
    kind: str
    edit: Callable[[ast.expr], ast.expr | None]

    def mutant(self) -> Mutant | None:
        """The file with the change; None at a place where no parenthesis may stand."""
        raw = (ROOT / self.path).read_bytes()
        node, changed = self.node, copy.deepcopy(self.node)
        changed = self.edit(changed) or changed
        starts = list(itertools.accumulate(map(len, raw.splitlines(keepends=True)), initial=0))
        first = starts[node.lineno - 1] + node.col_offset
        last = starts[(node.end_lineno or 0) - 1] + (node.end_col_offset or 0)
        before, after = raw[first:last].decode(), ast.unparse(changed)
        source = (raw[:first] + f"({after})".encode() + raw[last:]).decode()
        try:
            ast.parse(source)
        except SyntaxError:
            return None
        return Mutant(self.path, node.lineno, self.kind, _short(before), _short(after), source)


def changes_of(path: Path) -> Iterator[Change]:
    """Every change of a file, in the order of the source."""
    for node in _code(ast.parse((ROOT / path).read_bytes())):
        for kind, edit in _edits(node):
            yield Change(path, node, kind, edit)


def mutants_of(path: Path) -> Iterator[Mutant]:
    """Every mutant of a file, in the order of the source."""
    return filter(None, (change.mutant() for change in changes_of(path)))


def _code(node: ast.AST) -> Iterator[ast.expr]:
    """Expressions that compute: no annotations, messages of errors, decorators or texts."""
    settings = isinstance(node, ast.Module | ast.ClassDef)
    for name, value in ast.iter_fields(node):
        if name in {"annotation", "returns", "decorator_list", "type_params", "bases"}:
            continue
        for child in value if isinstance(value, list) else [value]:
            if isinstance(child, (ast.Raise, ast.Assert, ast.JoinedStr, ast.Import)):
                continue
            if isinstance(child, ast.keyword) and child.arg == "strict":
                continue  # zip(strict=True) is an assertion
            if isinstance(child, ast.Expr) and isinstance(child.value, ast.Constant):
                continue  # a docstring
            if settings and isinstance(child, ast.Assign | ast.AnnAssign):
                continue
            if isinstance(child, ast.expr):
                yield child
            if isinstance(child, ast.AST):
                yield from _code(child)


def _edits(node: ast.expr) -> Iterator[tuple[str, Callable[[ast.expr], ast.expr | None]]]:
    """What may be done to one expression; an edit changes its copy or returns another."""
    match node:
        case ast.Compare(ops=[op]):
            for new in COMPARISONS[type(op)]:
                yield "comparison", _setter("ops", [new()])
        case ast.BinOp(op=op) if type(op) in ARITHMETIC and not _is_type(node):
            yield "arithmetic", _setter("op", ARITHMETIC[type(op)]())
        case ast.BoolOp(op=op):
            yield "logic", _setter("op", ast.Or() if isinstance(op, ast.And) else ast.And())
        case ast.UnaryOp(op=ast.USub() | ast.Not() | ast.Invert(), operand=operand):
            if not isinstance(operand, ast.Constant):
                yield "sign", lambda changed: changed.operand  # type: ignore[attr-defined]
        case ast.Constant(value=bool()):
            yield "constant", _setter("value", not node.value)
        case ast.Constant(value=int()):
            yield "constant", _setter("value", node.value + 1)
        case ast.Constant(value=float()):
            yield "constant", _setter("value", node.value * 1.5 if node.value else 0.5)
        case ast.Call(func=ast.Name(id=name)) if name in OPPOSITES:
            yield "opposite", _setter("func", ast.Name(id=OPPOSITES[name]))
        case ast.Call(func=ast.Attribute(value=value, attr=name)):
            if name in OPPOSITES:
                yield "opposite", _setter("func", ast.Attribute(value, OPPOSITES[name]))
            if name in DROPPED and ast.unparse(value) not in MODULES:
                yield "dropped", lambda changed: changed.func.value  # type: ignore[attr-defined]
            if name == "where" and len(node.args) == 3:
                condition, yes, no = node.args
                yield "where", _setter("args", [condition, no, yes])
        case ast.IfExp(test=test, body=body, orelse=orelse):
            yield "branch", lambda _: ast.IfExp(test=test, body=orelse, orelse=body)


def _setter(name: str, value: object) -> Callable[[ast.expr], None]:
    return lambda changed: setattr(changed, name, value)


def _is_type(node: ast.BinOp) -> bool:
    """Whether `a | b` joins types, as in `int | None`."""
    sides = (node.left, node.right)
    return any(isinstance(x, ast.Constant) and x.value is None for x in sides)


def _short(text: str, most: int = 70) -> str:
    text = " ".join(text.split())
    return text if len(text) <= most else text[: most - 3] + "..."


def sources(target: str) -> list[Path]:
    """Files of a package or module, as `controller`, `dmp/joint.py`, `cli.py`."""
    path = ROOT / "hrc_learn" / target
    if not path.exists():
        sys.exit(f"there is no hrc_learn/{target}")
    files = [path] if path.is_file() else sorted(path.rglob("*.py"))
    return [file.relative_to(ROOT) for file in files if file.name != "__init__.py"]


def tests_of(path: Path) -> list[str]:
    """Test files and folders for a source file, the nearest first."""
    parts = path.with_suffix("").parts[1:]
    folder = ROOT / "tests" / parts[0]
    if not folder.is_dir():
        return [str(f.relative_to(ROOT)) for f in (ROOT / "tests").rglob(f"test_{parts[0]}.py")]
    stem = parts[-1].removeprefix("_")
    near = sorted(folder.rglob(f"test_*{stem}*.py"))
    rest = [file for file in sorted(folder.rglob("test_*.py")) if file not in near]
    return [str(file.relative_to(ROOT)) for file in near + rest]


class Checkout:
    """A copy of what the tests need, in which sources may be broken."""

    def __init__(self, folder: Path):
        self.folder = folder
        listed = subprocess.run(
            ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
            cwd=ROOT,
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        for name in filter(None, listed.split("\0")):
            if (ROOT / name).is_file():
                (folder / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(ROOT / name, folder / name)

    def is_imported(self) -> bool:
        """Whether the copy is what a program imports, not an installed package."""
        command = [sys.executable, "-c", "import hrc_learn; print(hrc_learn.__file__)"]
        environment = os.environ | {"PYTHONPATH": str(self.folder)}
        shown = subprocess.run(
            command, cwd=self.folder, env=environment, capture_output=True, text=True
        ).stdout
        return Path(shown.strip()).is_relative_to(self.folder)

    def passes(self, tests: list[str], timeout: float | None) -> bool | None:
        """Whether the tests pass; None: they ran out of time."""
        # The copy comes before the installed checkout on the path of every process.
        env = os.environ | {
            "PYTHONPATH": str(self.folder),
            "PYTHONDONTWRITEBYTECODE": "1",
            "OMP_NUM_THREADS": "1",
        }
        options = ["-x", "-q", "-m", "not slow", "-p", "no:cacheprovider", "-p", "no:randomly"]
        with subprocess.Popen(
            [sys.executable, "-m", "pytest", *options, *tests],
            cwd=self.folder,
            env=env,
            start_new_session=True,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        ) as process:
            try:
                return process.wait(timeout) == 0
            except subprocess.TimeoutExpired:
                os.killpg(process.pid, signal.SIGKILL)
                return None

    def passes_forked(self, tests: list[str], timeout: float) -> bool | None:
        """As `passes`, in a fork of this process, which has imported the libraries."""
        child = os.fork()
        if child == 0:
            os.setpgrp()
            os.chdir(self.folder)
            sys.path.insert(0, str(self.folder))
            os.environ |= {"PYTHONPATH": str(self.folder), "PYTHONDONTWRITEBYTECODE": "1"}
            nothing = os.open(os.devnull, os.O_RDWR)
            for descriptor in (0, 1, 2):
                os.dup2(nothing, descriptor)
            import pytest

            status = 3
            try:
                options = ["-x", "-q", "-m", "not slow", "-p", "no:cacheprovider"]
                status = int(pytest.main([*options, *tests]))
            finally:
                os._exit(status)
        end = time.monotonic() + timeout
        while time.monotonic() < end:
            ended, status = os.waitpid(child, os.WNOHANG)
            if ended:
                return os.waitstatus_to_exitcode(status) == 0
            time.sleep(0.05)
        os.killpg(child, signal.SIGKILL)
        os.waitpid(child, 0)
        return None

    def judge(self, mutant: Mutant, tests: list[str], timeout: float, forked: bool) -> str:
        """`killed`, `timeout` (which also counts as killed) or `survived`."""
        file = self.folder / mutant.path
        whole = file.read_text(encoding="utf-8")
        file.write_text(mutant.source, encoding="utf-8")
        try:
            result = (self.passes_forked if forked else self.passes)(tests, timeout)
        finally:
            file.write_text(whole, encoding="utf-8")
        return {True: "survived", False: "killed", None: "timeout"}[result]


class Executed:
    """Which tests execute a line, and how long each takes."""

    def __init__(self, files: list[Path]):
        self.seconds: dict[str, float] = {}
        self.tests: dict[tuple[str, int], list[str]] = {}
        for file in files:
            for test, (seconds, lines) in json.loads(file.read_text(encoding="utf-8")).items():
                self.seconds[test] = seconds
                for name, line in lines:
                    self.tests.setdefault((name, line), []).append(test)

    def of(self, mutant: Mutant, cap: float, most: int = 400) -> list[str]:
        """The quickest tests of the line, `cap` seconds of them."""
        name = str(mutant.path.relative_to("hrc_learn"))
        found = sorted(self.tests.get((name, mutant.line), ()), key=self.seconds.__getitem__)
        chosen, used = [], 0.0
        for test in found[:most]:
            used += self.seconds[test]
            if chosen and used > cap:
                break
            chosen.append(test)
        return sorted(chosen)


def preload() -> None:
    """Import the libraries that tests use, but nothing of the package."""
    os.environ["OMP_NUM_THREADS"] = "1"
    for name in (
        "torch",
        "scipy.optimize",
        "mujoco",
        "cv2",
        "pyarrow.parquet",
        "pandas",
        "rerun",
        "matplotlib.pyplot",
        "pytorch_kinematics",
        "beartype",
        "jaxtyping",
        "lerobot",
        "datasets",
        "torch._dynamo",
        "av",
        "PIL.Image",
        "numpy.testing",
        "hypothesis",
    ):
        with contextlib.suppress(ImportError):
            importlib.import_module(name)
    sys.modules["torch"].set_num_threads(1)


def main() -> int:
    """Sample, run, report; exit status 1 if the share killed is below `--least`."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("targets", nargs="+", help="packages or modules below hrc_learn/")
    parser.add_argument(
        "--number", type=int, default=25, help="mutants to sample, of all targets"
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--tests", nargs="*", help="run these instead of the mapped ones")
    parser.add_argument(
        "--timeout", type=float, default=600.0, help="for the tests of a mutant [s]"
    )
    parser.add_argument("--least", type=float, default=0.0, help="share to be killed")
    parser.add_argument("--json", type=Path, help="receives counts and every mutant's fate")
    parser.add_argument(
        "--check", action="store_true", help="first see that the tests pass without mutants"
    )
    parser.add_argument("--executed", type=Path, nargs="+", help="files of executed_lines.py")
    parser.add_argument(
        "--cap", type=float, default=40.0, help="tests of a mutant, with it [s]"
    )
    parser.add_argument("--list", action="store_true", help="show the sample, run nothing")
    args = parser.parse_args()

    files = [file for target in args.targets for file in sources(target)]
    everything = [change for file in files for change in changes_of(file)]
    random.Random(args.seed).shuffle(everything)
    mutants = filter(None, (change.mutant() for change in everything))
    sample = list(itertools.islice(mutants, args.number))
    print(f"{len(sample)} of {len(everything)} changes of {len(files)} modules", flush=True)
    if args.list:
        print(*sample, sep="\n")
        return 0

    executed = Executed(args.executed) if args.executed else None
    if executed:
        preload()
    fates: list[dict[str, object]] = []
    with tempfile.TemporaryDirectory(prefix="mutants-") as folder:
        checkout = Checkout(Path(folder))
        if not checkout.is_imported():
            print("Python imports an installed hrc_learn instead of the broken copy")
            return 2
        # A test that fails anyway would count every mutant as killed.
        if args.check:
            tests = {test for mutant in sample for test in args.tests or tests_of(mutant.path)}
            if not checkout.passes(sorted(tests), None):
                print("the tests fail without any mutant")
                return 2
        for mutant in sample:
            tests, start = args.tests or tests_of(mutant.path), time.monotonic()
            found = executed.of(mutant, args.cap) if executed else []
            # What runs in another process or at import only is not seen: the nearest file.
            tests = found or (tests[:1] if executed else tests)
            timeout = 60 + 5 * args.cap if executed else args.timeout
            fate = "survived"
            if tests:
                fate = checkout.judge(mutant, tests, timeout, executed is not None)
            seconds = time.monotonic() - start
            print(f"{fate:9}{seconds:6.0f} s  {mutant}", flush=True)
            fates.append(
                {
                    "path": str(mutant.path),
                    "line": mutant.line,
                    "kind": mutant.kind,
                    "before": mutant.before,
                    "after": mutant.after,
                    "fate": fate,
                }
            )
    survived = sum(fate["fate"] == "survived" for fate in fates)
    killed = len(fates) - survived
    share = killed / max(len(fates), 1)
    print(f"\nkilled {killed} of {len(fates)} ({share:.0%}), survived {survived}")
    if args.json:
        figures = {"mutants": len(fates), "killed": killed, "survived": survived}
        content = figures | {"killed_share": share, "seed": args.seed, "fates": fates}
        args.json.write_text(json.dumps(content, indent=2), encoding="utf-8")
    return int(share < args.least)


if __name__ == "__main__":
    sys.exit(main())
