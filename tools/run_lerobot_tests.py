"""Run LeRobot's own tests, of the version that is installed, with what is ours put in.

    .venv/bin/python tools/run_lerobot_tests.py --source path/to/lerobot

The tests come from a clone of LeRobot's repository, at the tag of the installed version, and
are kept outside of this one; `lerobot_put_in.py` says where ours are put in. Printed are counts
by file, each test that does not pass with what it says, and which of those fail without ours as
well. Tests that need a network, hardware or packages that are not installed skip themselves or
fail either way.
"""

import argparse
import os
import re
import subprocess
import sys
import tarfile
import tempfile
from collections import Counter
from importlib import metadata
from pathlib import Path
from xml.etree import ElementTree

ROOT = Path(__file__).parents[1]
PATHS = (
    "tests/policies/test_policies.py",
    "tests/policies/test_relative_actions.py",
    "tests/policies/rtc",
    "tests/envs",
    "tests/processor",
    "tests/robots",
    "tests/teleoperators",
    "tests/configs",
    "tests/async_inference",
    "tests/test_control_robot.py",
    "tests/test_rollout.py",
    "tests/test_available.py",
)
"""Policies, robots, teleoperators, processors, environments, and the ways to roll out."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--source", type=Path, required=True, help="clone of LeRobot")
    parser.add_argument("--out", type=Path, help="folder for the tests and results")
    parser.add_argument("--timeout", type=float, default=1800, help="of each run [s]")
    parser.add_argument("paths", nargs="*", default=PATHS, help="tests to run")
    options = parser.parse_args()
    out = options.out or Path(tempfile.mkdtemp(prefix="lerobot_tests_"))
    _check_out(options.source, out)
    ours = _run(out, options.paths, options.timeout, put_in=True)
    broken = [name for name, (outcome, _) in ours.items() if outcome == "failed"]
    theirs = _run(out, options.paths, options.timeout, put_in=False) if broken else {}
    print(f"\nLeRobot {metadata.version('lerobot')}, tests in {out}\n")
    files = sorted({name.split("::")[0] for name in ours})
    for file in files:
        counts = Counter(v[0] for k, v in ours.items() if k.split("::")[0] == file)
        print(f"{file:55}", ", ".join(f"{n} {outcome}" for outcome, n in counts.items()))
    total = Counter(outcome for outcome, _ in ours.values())
    print(f"{'together':55}", ", ".join(f"{n} {outcome}" for outcome, n in total.items()))
    put_in = [name for name in ours if _OURS.search(name)]
    for name in put_in:
        print(f"ours: {name} {ours[name][0]}")
    for name in broken:
        without = theirs.get(name, ("not there",))[0]
        print(f"\n{name}\n    {ours[name][1]}\n    without ours: {without}")
    sys.exit(any(theirs.get(name, ("",))[0] != "failed" for name in broken))


_OURS = re.compile("(?<![a-z])(dmp|motion_chunk|mujoco_arm|panda|smooth)")
"""In names of tests; not LeRobot's own tdmpc."""


def _check_out(source: Path, out: Path) -> None:
    """Unpack the tests of the installed version."""
    tag = f"v{metadata.version('lerobot')}"
    archive = subprocess.run(
        ["git", "archive", tag, "tests", "pyproject.toml"],
        cwd=source,
        capture_output=True,
        check=False,
    )
    if archive.returncode:
        raise SystemExit(f"{source} has no tag {tag}: {archive.stderr.decode().strip()}")
    out.mkdir(parents=True, exist_ok=True)
    file = out / "tests.tar"
    file.write_bytes(archive.stdout)
    with tarfile.open(file) as tar:
        tar.extractall(out, filter="data")
    # A test opens modules by their place in the repository.
    package = out / "src" / "lerobot"
    package.parent.mkdir(exist_ok=True)
    if not package.exists():
        package.symlink_to(str(metadata.distribution("lerobot").locate_file("lerobot")))


def _run(
    out: Path, paths: list[str], timeout: float, *, put_in: bool
) -> dict[str, tuple[str, str]]:
    """Outcome and message of every test."""
    results = out / ("ours.xml" if put_in else "theirs.xml")
    results.unlink(missing_ok=True)
    command = [sys.executable, "-m", "pytest", "-q", "-o", "addopts=", f"--junitxml={results}"]
    command += ["--continue-on-collection-errors", "-p", "no:cacheprovider"]
    command += [*(["-p", "lerobot_put_in"] if put_in else []), *paths]
    folders = [str(ROOT / "tools"), str(ROOT), str(out)]
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join(folders),
        "HF_HUB_OFFLINE": "1",
        "MUJOCO_GL": os.environ.get("MUJOCO_GL", "egl"),
    }
    subprocess.run(command, cwd=out, env=environment, check=False, timeout=timeout)
    if not results.is_file():
        raise SystemExit("pytest ended without results: see what it printed above")
    found = {}
    for case in ElementTree.parse(results).iter("testcase"):
        name = f"{case.get('classname', '').replace('.', '/')}::{case.get('name')}"
        outcome, message = "passed", ""
        for child in case:
            if child.tag in ("failure", "error", "skipped"):
                outcome = "skipped" if child.tag == "skipped" else "failed"
                message = (child.get("message") or "").splitlines()[0:1]
                message = message[0] if message else ""
        found[name] = (outcome, message)
    return found


if __name__ == "__main__":
    main()
