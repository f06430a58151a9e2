"""The states that commands of `hrc` pass through on disk, and whether each can be mended.

What kill -9 leaves is what is on disk at that moment: the system itself closes files and gives
locks back. So a command need not run once for each of its deaths. It runs once, watched: before
each step that changes a name on disk, and at random moments, at which it is stopped, its folder
is copied. Each copy is then put in the place of the folder and mended by `recover_all`, a few
of them by the next start. That a copy is what a kill leaves is measured, too: one run is killed
while it is stopped.
"""

import hashlib
import itertools
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import NamedTuple

STEPS = ("mkdir", "rename", "replace", "link", "symlink", "unlink", "rmdir", "fsync")
"""Functions of `os` before which the folder is copied; Path and shutil go through them."""
# Between two random moments, on average [s]: the first while something changes on disk, growing
# to the second while nothing does, as in minutes of simulation.
SHORTEST, LONGEST = 0.004, 0.15
# For a process to stop [s]: many times over what a busy machine takes.
PATIENCE = 2.0


@dataclass(frozen=True)
class Case:
    """A command with the smallest inputs that make it write everything."""

    words: str
    """Arguments. It runs in an empty folder; {inputs} stands for the folder of inputs."""
    copies: tuple[str, ...] = ()
    """Inputs that it changes, copied to its folder."""
    datasets: tuple[str, ...] = ()
    """Datasets recorded episode by episode: saved episodes are kept."""
    grows: tuple[str, ...] = ()
    """Folders of files that are each complete."""
    resumed: tuple[str, ...] = ()
    """Files that the next start continues with; * matches anything."""
    depth: int = 1
    """Parts of a path that name one result."""
    long: bool = False
    """True if it takes minutes: run once from scratch, not killed."""


CASES = {
    "record placing": Case("--out out --episodes 2 --json j.json", datasets=("out",)),
    "record servoing": Case(
        "--out out --episodes 3 --config demonstration.duration=2 --json j.json",
        datasets=("out",),
    ),
    "record expert": Case(
        "--out out --episodes 2 --scenario grasping --json j.json", datasets=("out",)
    ),
    "import": Case(
        "{inputs}/x.npz {inputs}/x.npz --out out --joints q --time t --json j.json",
        datasets=("out",),
    ),
    "show": Case("{inputs}/placing_demos --out demos.rrd --json j.json"),
    "check": Case("{inputs}/placing_demos --out out --json j.json"),
    "repair": Case("{inputs}/placing_demos --out out --json j.json"),
    "repair .": Case(
        "--json j.json", copies=("set.recording", ".fit.writing"), datasets=("set",)
    ),
    "push": Case("{inputs}/placing_demos me/set --dry-run --json j.json"),
    "fit": Case("--dataset {inputs}/placing_demos --out out --json j.json"),
    "fit image-jacobian": Case("--dataset {inputs}/aiming_demos --out out --json j.json"),
    "fit image-jacobian marked": Case(
        "--marker 7 --out out --json j.json", copies=("marked",), grows=("marked.features",)
    ),
    "tokens": Case("fit --dataset {inputs}/placing_demos --out out --json j.json"),
    "evaluate": Case("{inputs}/placing {inputs}/placing_demos --out out --json j.json"),
    "play": Case("{inputs}/placing --goal 0.5 0 0.4 --robot panda --out out --json j.json"),
    "multiply": Case(
        "{inputs}/placing_demos --episodes 3 --out out --config judge.scene=none --json j.json",
        datasets=("out",),
    ),
    "smooth": Case(
        "--checkpoint checkpoint --dataset {inputs}/placing_demos --json j.json",
        copies=("checkpoint",),
        grows=("checkpoint",),
    ),
    "run grasping": Case(
        "--aiming {inputs}/aiming --out out --camera synthetic --trials 2 --json j.json",
        resumed=("out.*.jsonl",),
    ),
    "report": Case("{inputs}/run --out page.html --json j.json"),
    "serve": Case("--config step=eager --rate 100 --duration 1 --json j.json"),
    "run collaboration": Case(
        "--placing {inputs}/placing --aiming {inputs}/aiming --out out --camera synthetic "
        "--json j.json",
        long=True,
    ),
    "run placing": Case("--placing {inputs}/placing --out out --json j.json", long=True),
    "demo": Case(
        "--out out --json j.json",
        datasets=("out/placing_demos", "out/aiming_demos"),
        depth=2,
        long=True,
    ),
}
"""Every command that writes, but `page`, which waits for a person and writes as `record`."""


@dataclass
class Count:
    """Results of the states of a command."""

    moments: int = 0
    """Random moments at which it was stopped after it began to write."""
    states: int = 0
    """Different states, each repaired by `recover_all`."""
    interrupted: int = 0
    """States that needed a repair."""
    starts: int = 0
    """Restarts from a state."""
    refusals: int = 0
    """Restarts that asked for `recover` first, or found the result complete."""
    kills: int = 0
    """Kills."""
    differing: int = 0
    """Kills that left another state than the copy made while the command was stopped."""
    lost: int = 0
    """Acknowledged results that are missing afterwards."""
    broken: int = 0
    """Incomplete results."""
    orphans: int = 0
    """Files that belong to nothing."""
    stuck: int = 0
    """Starts that failed because of what was left."""

    @property
    def failures(self) -> int:
        return self.differing + self.lost + self.broken + self.orphans + self.stuck


Tree = dict[str, str]
"""Files of a folder by relative path -> digest of their content; folders end in /."""


class Run(NamedTuple):
    """A command from its start to its end."""

    words: list[str]
    case: Case
    before: Tree
    after: Tree
    status: int


def watch_command(name: str, inputs: Path, folder: Path, rng: random.Random) -> Count:
    """Watch a command of `CASES`, first with nothing there, then with an older result."""
    from hrc_learn import cli

    count, root, case = Count(), folder / "here", CASES[name]
    words = [*name.split(), *case.words.format(inputs=inputs.resolve()).split()]
    options = cli.commands()
    known = options.get(name) or options[name.split()[0]]
    root.mkdir(parents=True)
    for copied in case.copies:
        shutil.copytree(inputs / copied, root / copied)
    for turn in ("new",) if case.long or case.copies else ("new", "older"):
        if turn == "older" and "overwrite" in known:
            words = [*words, "--overwrite"]
        copies, before = folder / turn, folder / f"{turn} before"
        shutil.copytree(root, before, symlinks=True)
        status, changes = watch(words, root, copies, count, rng)
        if turn == "older" and status == 2:
            break  # it replaces nothing
        if status not in (0, 1):
            raise ValueError(f"hrc {' '.join(words)} fails by itself: {folder}/new.log")
        after = folder / f"{turn} after"
        shutil.copytree(root, after, symlinks=True)
        run = Run(words, case, tree(before), tree(after), status)
        episodes: dict[str, int] = {}
        states = sorted(copies.iterdir())
        for state in states:
            put_back(state, root)
            count.states += 1
            count.interrupted += tree(root) not in (run.before, run.after)
            mend_and_judge(run, root, count, episodes, state.name)
        put_back(rng.choice(states), root)
        start_again(run, root, count)
        if not case.long:
            put_back(before, root)
            change = rng.randint(1, max(1, changes // 2))  # it may be quicker this time
            watch(words, root, folder / f"{turn} killed", count, rng, change)
            mend_and_judge(run, root, count, {}, "killed", by_name=True)
        put_back(after, root)
    return count


def watch(
    words: Sequence[str],
    root: Path,
    copies: Path,
    count: Count,
    rng: random.Random,
    kill_at: int | None = None,
) -> tuple[int, int]:
    """Run a command, and copy its folder at its steps and at random moments.

    Args:
        words: After `hrc`.
        root: Where it runs.
        copies: Receives the copies, in the order of their names.
        count: Of moments and kills.
        rng: Of the moments.
        kill_at: Kill it when this many changes have been seen from outside.

    Returns:
        Its exit status, and how many changes were seen from outside.
    """
    copies.mkdir()
    recorder, pause, changes = Recorder(root, copies), SHORTEST, 0
    recorder.take()
    with copies.with_name(f"{copies.name}.log").open("wb") as log:
        process = subprocess.Popen(
            [sys.executable, os.path.abspath(__file__), str(copies.resolve()), *words],
            cwd=root,
            env=os.environ | {"OMP_NUM_THREADS": "1"},
            stdout=log,
            stderr=log,
            start_new_session=True,
        )
    while True:
        time.sleep(rng.uniform(0, 2 * pause))
        patience = time.perf_counter() + PATIENCE
        os.killpg(process.pid, signal.SIGSTOP)
        ended, status = os.waitpid(process.pid, os.WUNTRACED | os.WNOHANG)
        while not ended and time.perf_counter() < patience:
            time.sleep(1e-3)
            ended, status = os.waitpid(process.pid, os.WUNTRACED | os.WNOHANG)
        if not ended:  # it waits for a process it has just forked, which was stopped first
            os.killpg(process.pid, signal.SIGCONT)
            continue
        if not os.WIFSTOPPED(status):
            process.returncode = os.waitstatus_to_exitcode(status)
            return process.returncode, changes
        changed = recorder.take()
        changes += changed
        count.moments += bool(changes) and kill_at is None
        pause = SHORTEST if changed else min(1.2 * pause, LONGEST)
        if changes == kill_at:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            count.kills += 1
            count.differing += tree(root) != tree(recorder.last)
            return process.returncode, changes
        os.killpg(process.pid, signal.SIGCONT)


class Recorder:
    """Copies a folder when it has changed; files that have not are links to the last copy."""

    def __init__(self, root: Path, copies: Path):
        self.last = root
        self._root = root
        self._copies = copies
        self._known: dict[str, tuple] = {}

    def take(self) -> bool:
        """Copy the folder if it has changed; True if it has."""
        found: dict[str, tuple] = {}
        for place, folders, files in os.walk(self._root):
            base = os.path.relpath(place, self._root)
            for name in (*folders, *files):
                try:
                    state = os.lstat(os.path.join(place, name))
                except FileNotFoundError:  # another thread of the command goes on
                    continue
                # Sizes and times of folders change with what is in them.
                detail = () if name in folders else (state.st_size, state.st_mtime_ns)
                found[os.path.normpath(os.path.join(base, name))] = (state.st_mode, *detail)
        if found == self._known:
            return False
        copy = self._copies / f"{time.monotonic_ns():020d}-{os.getpid()}"
        copy.mkdir()
        for name, state in found.items():  # folders come before what is in them
            here, there = self._root / name, copy / name
            if here.is_dir() and not here.is_symlink():
                there.mkdir()
            elif self._known.get(name) == state and not here.is_symlink():
                os.link(self.last / name, there)
            else:
                try:
                    shutil.copy2(here, there, follow_symlinks=False)
                except FileNotFoundError:
                    continue
        self.last, self._known = copy, found
        return True


def run_watched(copies: Path, words: list[str]) -> None:
    """Be the command, which copies its folder before each of its steps."""
    from hrc_learn import cli

    recorder, busy = Recorder(Path.cwd(), copies), False

    def watched(step):
        def call(*args, **kwargs):
            nonlocal busy
            if not busy:
                busy = True
                try:
                    recorder.take()
                finally:
                    busy = False
            return step(*args, **kwargs)

        return call

    for name in STEPS:
        setattr(os, name, watched(getattr(os, name)))
    sys.argv = ["hrc", *words]
    cli.main()


def mend_and_judge(
    run: Run,
    root: Path,
    count: Count,
    episodes: dict[str, int],
    state: str,
    by_name: bool = False,
) -> None:
    """Recover the folder, and count what is wrong with it then.

    Args:
        run: The command.
        root: The folder, in a state of that run.
        count: Of faults.
        episodes: Of each dataset, how many were seen in earlier states: none may be lost.
        state: For messages.
        by_name: Leave the contents of files aside, as they are those of another run.
    """
    from hrc_learn.demos import check_dataset, load_demos, recover_all

    case = run.case
    done = recover_all(root)
    trees = (tree(root), run.before, run.after)
    for unit in sorted({_unit(name, case.depth) for files in trees for name in files}):
        here, old, new = (
            {
                name: "" if by_name else digest
                for name, digest in files.items()
                if _unit(name, case.depth) == unit
            }
            for files in trees
        )
        fault = None
        if unit in case.datasets and here not in (old, new):
            if here and check_dataset(root / unit).ok:
                saved = len(load_demos(root / unit))
                fault = "lost" if saved < episodes.get(unit, 0) else None
                episodes[unit] = saved
            else:
                fault = "broken" if here else "lost"
        elif unit in case.datasets and here == old != new and episodes.get(unit):
            fault = "lost"
        elif here in (old, new) or any(fnmatchcase(unit, name) for name in case.resumed):
            continue
        elif unit in case.grows:
            wrong = [n for n, digest in here.items() if digest not in (old.get(n), new.get(n))]
            fault = "broken" if wrong else "lost" if old.keys() - here.keys() else None
        else:
            fault = "lost" if not here else "broken" if old or new else "orphans"
        if fault is not None:
            setattr(count, fault, getattr(count, fault) + 1)
            print(f"hrc {run.words[0]}, {state}: {unit} is {fault}; {done}", file=sys.stderr)


def start_again(run: Run, root: Path, count: Count) -> None:
    """Start the command on what was left, and count what is wrong when it is done."""
    ended = subprocess.run(
        [sys.executable, "-m", "hrc_learn.cli", *run.words],
        cwd=root,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
    )
    count.starts += 1
    if ended.returncode == 2:  # such as: there is an interrupted recording, recover that
        count.refusals += 1
        mend_and_judge(run, root, count, {}, "refused")
        return
    names = tree(root).keys()
    wrong = {
        "stuck": ended.returncode != run.status,
        "broken": bool(run.after.keys() - names),
        "orphans": bool(names - run.after.keys() - run.before.keys()),
    }
    for fault in (fault for fault, found in wrong.items() if found):
        setattr(count, fault, getattr(count, fault) + 1)
        differing = sorted(names ^ run.after.keys())
        print(f"hrc {run.words[0]}, next start: {fault} {differing}", ended.stderr[-500:])


def tree(folder: Path) -> Tree:
    """Content of a folder."""
    found: Tree = {}
    for path in folder.rglob("*"):
        name = path.relative_to(folder).as_posix()
        if path.is_symlink():
            found[name] = os.readlink(path)
        elif path.is_dir():
            found[f"{name}/"] = ""
        else:
            found[name] = hashlib.sha256(path.read_bytes()).hexdigest()
    return found


def put_back(copy: Path, root: Path) -> None:
    """Let the folder be what it was."""
    shutil.rmtree(root)
    shutil.copytree(copy, root, symlinks=True)


def _unit(name: str, depth: int) -> str:
    return "/".join(name.rstrip("/").split("/")[:depth])


def make_inputs(inputs: Path) -> None:
    """Make what the commands are given, as far as it is not there yet; takes minutes."""
    import numpy as np

    inputs.mkdir(parents=True, exist_ok=True)
    hrc = [sys.executable, "-m", "hrc_learn.cli"]
    for name, words in {
        "placing_demos": "record placing --episodes 1",
        "aiming_demos": "record servoing --episodes 4 --config demonstration.duration=5",
        "placing": "fit --dataset placing_demos",
        "aiming": "fit image-jacobian --dataset aiming_demos",
        "run": "run grasping --aiming aiming --camera synthetic",
    }.items():
        if not (inputs / name).exists():
            subprocess.run([*hrc, *words.split(), "--out", name], cwd=inputs, check=True)
    time_ = np.arange(200) / 50
    np.savez(inputs / "x.npz", q=np.sin(time_[:, None] + np.arange(3)), t=time_)
    (inputs / "checkpoint").mkdir(exist_ok=True)
    for name in ("policy_preprocessor.json", "policy_postprocessor.json"):
        text = json.dumps({"name": "policy", "steps": []})
        (inputs / "checkpoint" / name).write_text(text, encoding="utf-8")
    if not (inputs / "marked").exists():
        _record_marker(inputs / "marked")
    if not (inputs / "set.recording").exists():
        _leave_interrupted(inputs)


def _record_marker(root: Path) -> None:
    """A dataset with videos in which a marker on the gripper moves."""
    import cv2
    import numpy as np

    from hrc_learn.demos import DatasetWriter

    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    marker = cv2.aruco.generateImageMarker(dictionary, 7, 60)
    with DatasetWriter(root, 50, "any", cameras={"front": (480, 640)}) as writer:
        for episode in range(3):
            writer.start_episode("look")
            for phase in np.linspace(0, 3, 30) + episode:
                x, y, z = 0.1 * np.sin([phase, 1.7 * phase + 1, 0.9 * phase]) - [0, 0, 0.7]
                u, v = round(320 + 500 * y / z), round(240 + 500 * x / z)
                image = np.full((480, 640, 3), 255, np.uint8)
                image[v - 30 : v + 30, u - 30 : u + 30] = marker[..., None]
                pose = {"position": [x, y, z], "orientation": [0.0, 1.0, 0.0, 0.0]}
                writer.add_frame(**pose, images={"front": image})
            writer.save_episode()


def _leave_interrupted(folder: Path) -> None:
    """A recording of two episodes, and a folder of results between its two renames."""
    from hrc_learn.demos import DatasetWriter
    from hrc_learn.store import new_folder

    writer = DatasetWriter(folder / "set", 50, "any", ["a"])
    for _ in range(2):
        writer.start_episode("reach")
        for k in range(20):
            writer.add_frame(joint_position=[0.1 * k])
        writer.save_episode()
    renames = itertools.count()
    rename = os.rename
    for number in (1, 2):
        child = os.fork()
        if child == 0:
            if number == 2:
                os.rename = lambda *paths: os._exit(0) if next(renames) else rename(*paths)
            with new_folder(folder / "fit", {"number": number}, overwrite=True) as new:
                (new / "result").write_text(str(number), encoding="utf-8")
            os._exit(0)
        os.waitpid(child, 0)


if __name__ == "__main__":
    run_watched(Path(sys.argv[1]), sys.argv[2:])
