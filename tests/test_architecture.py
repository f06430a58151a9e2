"""The house as it is meant to stand: who imports whom, and what stays out of the repository."""

import ast
import os
import re
import subprocess
import sys
import tomllib
import zipfile
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import NamedTuple

import pytest
from programs_as_modules import load_program

ROOT = Path(__file__).parents[1]
SOURCES = sorted((ROOT / "hrc_learn").rglob("*.py"))
FOLDERS_OF_PROGRAMS = ("datasets", "training", "control", "tests", "benchmarks")
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]

CORE: dict[str, set[str]] = {
    "pytree": set(),
    "store": set(),
    "model_files": {"store"},
    "distributed": set(),
    "protocols": set(),
    "watchdog": set(),
    "geometry": set(),
    "vision": set(),
    "log": {"store", "geometry", "vision"},
    "kinematics": {"store", "geometry"},
    "dmp": {"store", "model_files", "distributed", "geometry"},
    "regions": {"pytree", "geometry"},
    "jacobian": {"pytree", "model_files", "distributed", "geometry"},
    "controller": {
        "pytree",
        "protocols",
        "geometry",
        "kinematics",
        "regions",
        "jacobian",
    },
    "deploy": {
        "pytree",
        "store",
        "geometry",
        "kinematics",
        "regions",
        "jacobian",
        "controller",
    },
}
"""Core packages in the order they build on each other, with what each may import."""

EDGES: dict[str, set[str]] = {
    "demos": {*CORE},
    "viz": {*CORE},
    "sim": {*CORE},
}
"""Edges likewise: where the package meets files, screens and simulators."""

WORK: dict[str, set[str]] = {
    "skills": {*CORE, *EDGES} - {"sim"},
    "learning": {*CORE, *EDGES, "skills"},
    "hardware": {*CORE, *EDGES},
    "teleoperation": {*CORE, *EDGES, "skills"},
}
"""What puts them to work: skills, learning, people and real devices."""

LAYERS = (
    CORE
    | EDGES
    | WORK
    | {
        "experiments": {*CORE, *EDGES, *WORK},
        "lerobot": {*CORE, *EDGES, *WORK},
        "cli": {*CORE, *EDGES, *WORK, "experiments", "lerobot"},
    }
)

LIBRARIES: dict[str, set[str]] = {
    **{package: {"torch", "jaxtyping", "numpy", "safetensors"} for package in CORE},
    # Of its modules for commands, each imported when its command runs.
    "cli": {"torch", "jaxtyping", "numpy", "tyro", "rich", "msgspec"},
    "store": {"msgspec"},
    "log": {"jaxtyping", "numpy"},
    "demos": {"torch", "jaxtyping", "numpy", "pyarrow"},
    "vision": {"jaxtyping", "numpy"},
    "viz": {
        "torch",
        "jaxtyping",
        "numpy",
        "rerun",
        "matplotlib",
        "mpl_toolkits",
        "cycler",
        "PIL",
    },
    "sim": {"torch", "jaxtyping", "numpy", "mujoco"},
    "deploy": {"torch", "jaxtyping", "numpy", "llvmlite"},
    "skills": {"torch", "jaxtyping", "numpy"},
    "learning": {"torch", "jaxtyping", "numpy", "rerun", "matplotlib"},
    # Of franky-sim one module makes a robot, imported when one is served.
    "hardware": {"torch", "jaxtyping", "numpy", "franky_sim"},
    "teleoperation": {"torch", "jaxtyping", "numpy", "scipy", "msgspec"},
    # Of its modules one judges motions in MuJoCo scenes that users bring.
    "experiments": {"torch", "jaxtyping", "numpy", "matplotlib", "mujoco"},
    "lerobot": {
        *("torch", "jaxtyping", "numpy", "safetensors"),
        *("lerobot", "gymnasium", "draccus"),
    },
}
"""Libraries that modules of a package may import as soon as they are imported."""

ROS2 = {
    f"{name}_msgs"
    for name in ("sensor", "std", "trajectory", "diagnostic", "visualization", "geometry")
} | {"rclpy", "rcl_interfaces"}
"""Packages of ROS 2, from the registry or the system."""

LAZY_LIBRARIES: dict[str, set[str]] = {
    "geometry": {"trimesh", "collada"},
    "kinematics": {"frankik", "mujoco", "scipy"},
    "jacobian": {"scipy"},
    "dmp": {"threadpoolctl"},
    "cli": {"huggingface_hub", "httpx", "lerobot"},
    "demos": {
        "av",
        "scipy",
        "h5py",
        "zarr",
        "tfrecord",
        "rosbags",
        "mcap",
        "mcap_protobuf",
    },
    "vision": {"cv2"},
    "viz": {"av", "jinja2", "rich"},
    "hardware": {"franky", "pylibfranka", "cv2", *ROS2},
    "teleoperation": {
        "viser",
        "pygame",
        "forcedimension_core",
        "websockets",
        "trimesh",
        "cv2",
        "rerun",
    },
    "experiments": {"rich"},
    "lerobot": {"torchvision", "pyarrow", *ROS2},
}
"""Libraries that they may import in the functions that need them, and nowhere else."""

DISTRIBUTIONS = {
    "mcap_protobuf": "mcap-protobuf-support",
    **{name: f"ros-{name.replace('_', '-')}" for name in ROS2},
    "forcedimension_core": "forcedimension-core",
    "collada": "pycollada",
    "cv2": "opencv-python-headless",
    "rerun": "rerun-sdk",
    "franky_sim": "franky-sim",
    # Parts and requirements of matplotlib's own.
    "mpl_toolkits": "matplotlib",
    "cycler": "matplotlib",
    "PIL": "matplotlib",
    "trimesh": "viser",
    # Requirements of lerobot's own.
    "torchvision": "lerobot",
    "huggingface_hub": "lerobot",
    "httpx": "lerobot",
    "gymnasium": "lerobot",
    "draccus": "lerobot",
}
"""What a library is called in pyproject.toml where that is not its name in code."""


class Import(NamedTuple):
    """One imported module; lazy: only in a function that is called, or for type checkers."""

    source: Path
    line: int
    module: str
    lazy: bool

    @property
    def package(self) -> str:
        """Package of ours that imports."""
        return self.source.relative_to(ROOT / "hrc_learn").parts[0].removesuffix(".py")

    @property
    def top(self) -> str:
        """First part of the module's name."""
        return self.module.split(".")[0]

    def __str__(self) -> str:
        return f"{self.source.relative_to(ROOT)}:{self.line} imports {self.module}"


measure_code = load_program("tools/measure_code.py")


@cache
def package() -> list:
    """Files of the package, parsed once for all tests."""
    return measure_code.read_package(ROOT / "hrc_learn")


@cache
def parse(source: Path) -> ast.Module:
    for file in package():
        if file.path == source:
            return file.tree
    return ast.parse(source.read_text(encoding="utf-8"), filename=str(source))


def imports_of(source: Path) -> Iterator[Import]:
    """Every import of a file, relative ones made absolute."""

    rest: list[tuple[ast.AST, bool]] = [(parse(source), False)]
    while rest:
        node, lazy = rest.pop()
        for child in ast.iter_child_nodes(node):
            # Expressions hold no imports.
            if isinstance(child, (ast.stmt, ast.excepthandler, ast.match_case)):
                for module in modules_named(child, source):
                    yield Import(source, getattr(child, "lineno", 0), module, lazy)
                rest.append((child, lazy or waits(child)))


def waits(node: ast.AST) -> bool:
    """Whether what stands inside does not run when the module is imported."""
    if isinstance(node, ast.If):
        return isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING"
    return isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef))


def modules_named(node: ast.AST, source: Path) -> list[str]:
    if isinstance(node, ast.Import):
        return [alias.name for alias in node.names]
    if not isinstance(node, ast.ImportFrom):
        return []
    base = imported_from(node, source)
    # `from hrc_learn import demos` names a module, not a value.
    if base == "hrc_learn":
        return [f"hrc_learn.{alias.name}" for alias in node.names]
    return [base]


def imported_from(node: ast.ImportFrom, source: Path) -> str:
    """The module or package named after `from`, made absolute."""
    parents = (
        source.relative_to(ROOT).with_suffix("").parts[: -node.level] if node.level else ()
    )
    return ".".join([*parents, *([node.module] if node.module else [])])


@cache
def all_imports() -> list[Import]:
    return [i for source in SOURCES for i in imports_of(source)]


@cache
def ours() -> list[Import]:
    return [i for i in all_imports() if i.top == "hrc_learn"]


@cache
def others() -> list[Import]:
    return [i for i in all_imports() if i.top not in {"hrc_learn", *sys.stdlib_module_names}]


def tracked_files() -> list[Path]:
    """Files in git's index; skips the test where the sources came without their history."""
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True)
    if listed.returncode or not listed.stdout:
        pytest.skip("not a git checkout")
    paths = [ROOT / name for name in listed.stdout.rstrip("\0").split("\0")]
    return [path for path in paths if path.is_file()]


def test_every_package_has_its_place():
    found = {
        path.relative_to(ROOT / "hrc_learn").parts[0].removesuffix(".py") for path in SOURCES
    }
    assert found - {"__init__"} == LAYERS.keys()


@pytest.mark.parametrize("package", LAYERS)
def test_imports_run_one_way(package):
    wrong = [
        str(i)
        for i in ours()
        if i.package == package and i.module.split(".")[1] not in {package, *LAYERS[package]}
    ]
    assert not wrong


def test_no_package_builds_on_itself():
    """The table has an order in which each package comes after all that it may import."""
    placed: set[str] = set()
    for package, below in LAYERS.items():
        assert below <= placed, package
        placed.add(package)


def test_no_module_imports_itself_around_others():
    """Imports in functions and for type checkers count: they only hide a circle."""
    assert not measure_code.circles(package())


def test_the_package_itself_imports_its_parts_only():
    assert not [str(i) for i in others() if i.package == "__init__"]


@pytest.mark.parametrize("package", LAYERS)
def test_libraries_stay_where_they_belong(package):
    eager, lazy = LIBRARIES[package], LAZY_LIBRARIES.get(package, set())
    wrong = [
        str(i)
        for i in others()
        if i.package == package and i.top not in (eager | lazy if i.lazy else eager)
    ]
    assert not wrong


def required(requirements: list[str]) -> set[str]:
    """Names of the distributions in a list of requirements, extras of ours left out."""
    names = {re.split(r"[\[<>=!~; ]", requirement)[0] for requirement in requirements}
    return names - {PROJECT["name"]}


@pytest.mark.parametrize("package", LAYERS)
def test_every_library_is_declared(package):
    """What a user's machine lacks is an error that no developer's machine shows."""
    declared = required(PROJECT["dependencies"])
    for extra, requirements in PROJECT["optional-dependencies"].items():
        declared |= required(requirements) if extra != "dev" else set()
    missing = [
        str(i)
        for i in others()
        if i.package == package and DISTRIBUTIONS.get(i.top, i.top) not in declared
    ]
    assert not missing


@pytest.mark.parametrize("folder", FOLDERS_OF_PROGRAMS)
def test_folders_of_programs_are_no_packages(folder):
    """A package named `datasets` would shadow Hugging Face's, which lerobot imports."""
    assert (ROOT / folder).is_dir()
    assert not list((ROOT / folder).rglob("__init__.py"))


UNSAFE_MODULES = {"pickle", "cPickle", "cloudpickle", "dill", "joblib", "shelve", "marshal"}
# Arguments for processes that a program of ours starts: never a file, nor another's message.
PICKLED_ON_PURPOSE = {
    ROOT / "hrc_learn/distributed.py",
    ROOT / "tests/dmp/test_conveniences.py",
    ROOT / "tests/test_processes.py",
}
UNSAFE_CALLS = {("torch", "load"), ("torch", "save")}
# Only files with these words are parsed.
SUSPICIOUS = re.compile("|".join([*UNSAFE_MODULES, "allow_pickle", r"torch\.(?:load|save)"]))


def test_nothing_reads_or_writes_pickles():
    """A pickle runs code when it is read; models and logs travel between people."""
    found = []
    for path in (path for path in tracked_files() if path.suffix == ".py"):
        suspicious = SUSPICIOUS.search(path.read_text(encoding="utf-8"))
        if not suspicious or path in PICKLED_ON_PURPOSE:
            continue
        found += [str(i) for i in imports_of(path) if i.top in UNSAFE_MODULES]
        found += [
            f"{path.relative_to(ROOT)}:{call.lineno} pickles"
            for call in ast.walk(parse(path))
            if isinstance(call, ast.Call) and pickles(call)
        ]
    assert not found


def pickles(call: ast.Call) -> bool:
    if any(k.arg == "allow_pickle" and not is_false(k.value) for k in call.keywords):
        return True
    f = call.func
    if not isinstance(f, ast.Attribute) or not isinstance(f.value, ast.Name):
        return False
    return (f.value.id, f.attr) in UNSAFE_CALLS


def is_false(node: ast.expr) -> bool:
    return isinstance(node, ast.Constant) and node.value is False


@pytest.mark.parametrize(
    ("code", "unsafe"),
    [
        ("np.load(path)", False),
        ("np.load(path, allow_pickle=False)", False),
        ("np.load(path, allow_pickle=True)", True),
        ("np.load(path, allow_pickle=trusted)", True),
        ("torch.load(path)", True),
        ("torch.tensor(path)", False),
    ],
)
def test_pickles_are_recognised(code, unsafe):
    call = ast.parse(code, mode="eval").body
    assert isinstance(call, ast.Call)
    assert pickles(call) == unsafe


PROGRAMS = [
    p
    for folder in ("tools", *set(FOLDERS_OF_PROGRAMS) - {"tests"})
    for p in (ROOT / folder).glob("*.py")
]


def test_text_files_are_opened_with_an_encoding():
    """Without one they are read and written as the machine's settings say, and differ."""
    found = [
        f"{path.relative_to(ROOT)}:{call.lineno}"
        for path in (*SOURCES, *PROGRAMS)
        for call in ast.walk(parse(path))
        if isinstance(call, ast.Call) and lacks_encoding(call)
    ]
    assert not found


def lacks_encoding(call: ast.Call) -> bool:
    """Whether a call opens a file as text without saying how it is encoded."""
    f = call.func
    name = f.attr if isinstance(f, ast.Attribute) else getattr(f, "id", "")
    if any(keyword.arg in ("encoding", None) for keyword in call.keywords):
        return False
    arguments = call.args[1:] if isinstance(f, ast.Name) else call.args
    if name in ("read_text", "write_text"):
        # A function of that name, such as cli.write_text, takes a path and the text.
        return isinstance(f, ast.Attribute) and len(arguments) < (2 if "w" in name else 1)
    mode = next((k.value for k in call.keywords if k.arg == "mode"), None)
    mode = arguments[0] if arguments and mode is None else mode
    if name != "open" or (mode is None and isinstance(f, ast.Attribute) and call.keywords):
        return False
    if mode is None:
        return True
    text = mode.value if isinstance(mode, ast.Constant) else None
    return isinstance(text, str) and set(text) <= set("rwax+t")


@pytest.mark.parametrize(
    ("code", "lacks"),
    [
        ("path.read_text()", True),
        ("path.read_text('utf-8')", False),
        ("path.read_text(encoding='utf-8')", False),
        ("path.write_text(text)", True),
        ("path.write_text(text, 'utf-8')", False),
        ("cli.write_text(path, text)", False),
        ("open(path)", True),
        ("open(path, 'w')", True),
        ("open(path, 'rb')", False),
        ("open(path, 'a', encoding='utf-8')", False),
        ("path.open()", True),
        ("path.open('a')", True),
        ("path.open(mode='a')", True),
        ("path.open('rb')", False),
        ("av.open(path)", False),
        ("Gamepad.open(chain)", False),
    ],
)
def test_a_missing_encoding_is_recognised(code, lacks):
    call = ast.parse(code, mode="eval").body
    assert isinstance(call, ast.Call)
    assert lacks_encoding(call) == lacks


def test_no_large_file_is_tracked():
    large = [path for path in tracked_files() if path.stat().st_size > 2**20]
    assert not large, "recordings stay out of the repository: programs take their path"


def test_the_wheel_holds_the_package_alone(tmp_path):
    pytest.importorskip("hatchling", reason="the build backend is not installed")
    subprocess.run(
        [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", tmp_path],
        cwd=ROOT,
        check=True,
        capture_output=True,
        env={**os.environ, "PYTHONDONTWRITEBYTECODE": "1"},
    )
    (wheel,) = tmp_path.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
    roots = {name.split("/")[0] for name in names}
    information = f"hrc_learn-{PROJECT['version']}.dist-info"
    assert roots == {"hrc_learn", information}
    packed = {name for name in names if name.startswith("hrc_learn/")}
    # What is built of the client's sources is shipped, what it was built from is not.
    built = (ROOT / "hrc_learn/teleoperation/xr_client/built").glob("*")
    ours = {*SOURCES, *built, *(ROOT / "hrc_learn" / path for path in tracked_data())}
    assert packed == {str(path.relative_to(ROOT)) for path in ours}


def tracked_data() -> list[str]:
    """Files of the package in the repository that are no Python."""
    listed = subprocess.check_output(["git", "ls-files"], cwd=ROOT / "hrc_learn", text=True)
    return [name for name in listed.splitlines() if not name.endswith(".py")]
