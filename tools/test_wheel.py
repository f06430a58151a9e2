"""Test the built wheel with the lowest and the newest versions that `pyproject.toml` allows.

Each environment is made anew outside the checkout, with uv, and tests a copy of the tests in
an otherwise empty folder, so that nothing but the wheel can be imported:

- `lowest`: every extra of `all`, with exactly the version that its lower bound names. A bound
  that cannot be installed fails here.
- `newest`: every extra of `all`, at the newest versions that fit together.
- `edges`: the same without LeRobot, whose own bounds keep other libraries back.

A first run fetches some GB of PyTorch for each.
"""

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
import tomllib
import venv
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
# What meets other libraries, PyTorch's tracers among them; the rest is `make test`'s.
TESTED = (
    *(
        "geometry",
        "kinematics",
        "regions",
        "jacobian",
        "demos",
        "vision",
        "sim",
        "viz",
        "lerobot",
    ),
    *("dmp/test_contract.py", "dmp/test_exported_dmp.py", "deploy/test_batch_export.py"),
)
# Not with a lowest version of their own: no user installs them with us.
TOOLS = (
    *("pytest>=8.3", "hypothesis>=6.100", "beartype>=0.19", "playwright>=1.49"),
    *("pytorch-kinematics>=0.7.6", "franky-sim>=1.0.4"),
)
# Descriptions of arms, whose package asks for much more than them.
DESCRIPTIONS = ("robosuite==1.5.2",)
REQUIREMENT = re.compile(r"(?P<name>[\w.-]+)(\[(?P<extras>[^]]*)\])?(?P<bounds>[^;]*)")
ENVIRONMENTS = ("lowest", "newest", "edges")


def extras(environment: str) -> list[str]:
    """Our extras that an environment installs."""
    (every,) = PROJECT["optional-dependencies"]["all"]
    named = REQUIREMENT.match(every)
    assert named is not None
    chosen = named["extras"].split(",")
    return [extra for extra in chosen if environment != "edges" or extra != "lerobot"]


def lower_bounds(chosen: list[str]) -> list[str]:
    """Constraints that hold each requirement at its lower bound, such as `numpy==2.1.*`."""
    optional = PROJECT["optional-dependencies"]
    texts = [*PROJECT["dependencies"], *(text for extra in chosen for text in optional[extra])]
    held = set()
    for text in texts:
        found = REQUIREMENT.match(text)
        assert found is not None
        bound = re.search(r">=\s*([\d.]+)", found["bounds"])
        if bound is None:
            raise SystemExit(f"pyproject.toml gives no lower bound of {found['name']}")
        held.add(f"{found['name']}=={bound[1]}.*")
    return sorted(held)


def find_uv(work: Path) -> str:
    """The installed uv, else one of its own environment."""
    if installed := shutil.which("uv"):
        return installed
    venv.create(work / "uv", with_pip=True)
    python = work / "uv" / "bin" / "python"
    run(str(python), "-m", "pip", "install", "--quiet", "uv")
    return str(python.with_name("uv"))


def run(*command: str, cwd: Path | None = None, env: dict[str, str] | None = None) -> None:
    subprocess.run(command, cwd=cwd, env=env, check=True)


def install(uv: str, wheel: Path, environment: str, python: str, folder: Path) -> Path:
    """Make an environment with the wheel, its requirements and the test tools.

    Returns:
        Its Python.
    """
    chosen = extras(environment)
    bounds, resolved = folder / "bounds.txt", folder / "resolved.txt"
    bounds.write_text(
        "\n".join(lower_bounds(chosen)) if environment == "lowest" else "", encoding="utf-8"
    )
    run(
        *(uv, "pip", "compile", "--quiet", "--no-annotate", "--no-header"),
        *("--python-version", python, "--constraint", str(bounds)),
        *("--resolution", "lowest-direct" if environment == "lowest" else "highest"),
        *(option for extra in chosen for option in ("--extra", extra)),
        *("--output-file", str(resolved), str(ROOT / "pyproject.toml")),
    )
    run(uv, "venv", "--quiet", "--python", python, str(folder / "venv"))
    inside = folder / "venv" / "bin" / "python"
    into = (uv, "pip", "install", "--quiet", "--python", str(inside))
    run(*into, "--requirement", str(resolved), "--constraint", str(resolved), *TOOLS)
    run(*into, "--no-deps", str(wheel))
    # The wheel's own metadata has the last word on what it needs.
    run(uv, "pip", "check", "--quiet", "--python", str(inside))
    run(*into, "--no-deps", *DESCRIPTIONS)
    names = {
        found["name"] for text in lower_bounds(chosen) if (found := REQUIREMENT.match(text))
    }
    ours = [
        line
        for line in resolved.read_text(encoding="utf-8").split()
        if line.split("==")[0] in names
    ]
    print(f"{environment}, Python {python}: {' '.join(ours)}", flush=True)
    return inside


def test(python: Path, folder: Path, tests: list[str]) -> int:
    """Run tests beside nothing of the checkout but them, their helpers and configuration.

    Returns:
        pytest's exit status.
    """
    (folder / "tests").mkdir(parents=True)
    for name in tests:
        here, there = ROOT / "tests" / name, folder / "tests" / name
        there.parent.mkdir(exist_ok=True)
        shutil.copytree(here, there) if here.is_dir() else shutil.copy(here, there)
    for helper in (ROOT / "tests").glob("*.*"):
        if helper.is_file() and not helper.name.startswith("test_"):
            shutil.copy(helper, folder / "tests")
    for name in ("benchmarks", "plugins"):
        shutil.copytree(ROOT / name, folder / name)
    shutil.copy(ROOT / "pyproject.toml", folder)
    # Nothing of the caller's environment may put the checkout back on the path.
    env = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    where = "import hrc_learn, sys; print(hrc_learn.__file__)"
    found = subprocess.check_output([python, "-c", where], cwd=folder, env=env, text=True)
    if ROOT in Path(found).parents:
        raise SystemExit(f"the tests would run against the checkout: {found}")
    command = [str(python), "-m", "pytest", "-q", "-p", "no:cacheprovider"]
    return subprocess.run(command, cwd=folder, env=env, check=False).returncode


def main() -> int:
    parser = argparse.ArgumentParser(description="Test the wheel at both ends of its bounds.")
    parser.add_argument("--python", nargs="+", default=["3.12"], help="such as 3.12 3.13")
    parser.add_argument("--environments", nargs="+", default=ENVIRONMENTS, choices=ENVIRONMENTS)
    parser.add_argument("--tests", nargs="+", default=TESTED, help="below tests/")
    parser.add_argument("--work", type=Path, help="parent of the temporary folder")
    args = parser.parse_args()
    if missing := [name for name in args.tests if not (ROOT / "tests" / name).exists()]:
        print(f"no tests/{', tests/'.join(missing)}", file=sys.stderr)
        return 2

    failed = []
    with tempfile.TemporaryDirectory(prefix="hrc_learn_wheel_", dir=args.work) as name:
        work = Path(name)
        uv = find_uv(work)
        build = (uv, "build", "--quiet", "--wheel", "--python", sys.executable)
        run(*build, "--out-dir", str(work / "dist"), str(ROOT))
        (wheel,) = (work / "dist").glob("*.whl")
        for python in args.python:
            for environment in args.environments:
                folder = work / f"{environment}-{python}"
                folder.mkdir()
                try:
                    inside = install(uv, wheel, environment, python, folder)
                    without = environment == "edges"
                    tests = [name for name in args.tests if not without or name != "lerobot"]
                    passed = test(inside, folder / "empty", tests) == 0
                except subprocess.CalledProcessError as error:
                    print(f"failed: {' '.join(map(str, error.cmd))}", file=sys.stderr)
                    passed = False
                if not passed:
                    failed.append(f"{environment} on Python {python}")
                # Several GB each.
                shutil.rmtree(folder)
    print(f"failed: {', '.join(failed)}" if failed else "all passed")
    return bool(failed)


if __name__ == "__main__":
    raise SystemExit(main())
