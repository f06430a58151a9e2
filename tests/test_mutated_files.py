"""Damaged files are refused in one line by documented errors: no traceback of ours, no hang."""

import random
import re
import shutil
import signal
import warnings
from collections.abc import Callable
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import torch
from clean_sets import write_set
from unchecked import shapes_unchecked

from hrc_learn.demos import check_dataset, load_demos
from hrc_learn.dmp import JointDMP
from hrc_learn.geometry import Pose
from hrc_learn.kinematics import arm
from hrc_learn.kinematics.limits import read_limits
from hrc_learn.kinematics.tool_orientation import Approach
from hrc_learn.learning.model_choice import CHOICE, best_models
from hrc_learn.skills.visual_skill import MarkerAngle
from hrc_learn.skills.visual_target import VisualTarget
from hrc_learn.store import MANIFEST, changed_files, new_folder, read_made_by, write_json
from hrc_learn.viz.report import Measurement, Report, read_report, write_report

PATIENCE = 20.0
"""Time after which a load hangs [s]; the slowest takes one."""
MJCF = """<mujoco><compiler angle="radian"/><worldbody><body name="base">
<geom type="box" size="0.1 0.1 0.1"/><body name="link1" pos="0 0 0.2">
<inertial mass="1" pos="0 0 0" diaginertia="0.1 0.1 0.1"/>
<joint name="joint1" axis="0 0 1" range="-2 2"/><geom type="capsule" size="0.05 0.1"/>
<body name="link2" pos="0 0 0.3"><inertial mass="1" pos="0 0 0" diaginertia="0.1 0.1 0.1"/>
<joint name="joint2" axis="0 1 0" range="-1 2"/><body name="tip" pos="0 0 0.1"/>
</body></body></body></worldbody></mujoco>
"""
LINK = """<link name="{0}"><inertial><mass value="1"/><inertia ixx="0.1" ixy="0" ixz="0"
iyy="0.1" iyz="0" izz="0.1"/></inertial><collision><geometry><cylinder radius="0.05"
length="0.2"/></geometry></collision></link>"""
JOINT = """<joint name="joint{1}" type="revolute"><parent link="link{0}"/>
<child link="link{1}"/><origin xyz="0 0 0.2" rpy="0 {1} 0"/><axis xyz="0 0 1"/>
<limit lower="-2" upper="2" velocity="1.5" effort="50"/></joint>"""
URDF = (
    '<robot name="arm">'
    + "".join(LINK.format(f"link{i}") for i in range(7))
    + "".join(JOINT.format(i, i + 1) for i in range(6))
    + "</robot>"
)
VALUES = (
    *("NaN", "Infinity", "-Infinity", "null", "true", "[]", "{}", '""', '"x"', "-1", "0"),
    *("3e9", "1e999", "1e-320", str(10**30), "-3.5", "[" * 5000, '{"a":' * 5000),
)
"""Texts that take the place of a number or of a word between quotes."""


class Target(NamedTuple):
    """A sound file and the function that reads it from its folder."""

    file: str
    write: Callable[[Path], object]
    load: Callable[[Path], object]
    checksum: bool = False
    """True if every change of a byte has to be noticed."""


def write_model(folder: Path, manifest: bool = True) -> None:
    time = torch.linspace(0, 1, 20, dtype=torch.float64)
    JointDMP.fit(time, torch.stack([time, time**2], dim=-1), n_basis=5).save(folder / "model")
    if not manifest:
        (folder / "model" / MANIFEST).unlink()


def write_approach(folder: Path) -> None:
    position = torch.linspace(0, 0.1, 9, dtype=torch.float64)[:, None].expand(9, 3)
    down = torch.tensor([0.0, 1.0, 0.0, 0.0], dtype=torch.float64).expand(9, 4)
    Approach.fit([Pose(position, down)]).save(folder / "approach.json")


def write_angle(folder: Path) -> None:
    MarkerAngle(offset_rad=0.3, spread_rad=0.01).save(folder / "angle.json")


def write_results(folder: Path) -> None:
    row = Measurement(name="error", value=1.5, unit="mm", target=2.0)
    with new_folder(folder / "run", {"seed": 1, "dataset": "demos"}) as run:
        write_report(run, Report(title="Run", summary="All went well.", table=[row]))


def load_dataset(folder: Path) -> None:
    check_dataset(folder / "set")
    load_demos(folder / "set")


TARGETS = {
    "target": Target(
        "visual_target.json",
        lambda f: VisualTarget(offset=np.ones(3) / 9, error=0.5).save(f / "visual_target.json"),
        lambda f: VisualTarget.load(f / "visual_target.json"),
    ),
    "angle": Target("angle.json", write_angle, lambda f: MarkerAngle.load(f / "angle.json")),
    "approach": Target(
        "approach.json", write_approach, lambda f: Approach.load(f / "approach.json")
    ),
    "choice": Target(
        CHOICE,
        lambda f: write_json(f / CHOICE, {"models": {"joint": "mean"}, "context": ["size"]}),
        best_models,
    ),
    "report": Target("run/report.json", write_results, lambda f: read_report(f / "run")),
    "inputs": Target("run/made_by.json", write_results, lambda f: read_made_by(f / "run")),
    "manifest": Target(f"run/{MANIFEST}", write_results, lambda f: changed_files(f / "run")),
    "limits": Target(
        "limits.toml",
        lambda f: (f / "limits.toml").write_text("[default]\nacceleration = 5.0\n"),
        lambda f: read_limits(f / "limits.toml"),
    ),
    "config": Target(
        "model/config.json",
        lambda f: write_model(f, manifest=False),
        lambda f: JointDMP.load(f / "model"),
    ),
    "model": Target(
        "model/model.safetensors", write_model, lambda f: JointDMP.load(f / "model"), True
    ),
    "checked config": Target(
        "model/config.json", write_model, lambda f: JointDMP.load(f / "model"), True
    ),
    "urdf": Target(
        "arm.urdf",
        lambda f: (f / "arm.urdf").write_text(URDF),
        lambda f: arm(f / "arm.urdf"),
    ),
    "mjcf": Target(
        "arm.xml", lambda f: (f / "arm.xml").write_text(MJCF), lambda f: arm(f / "arm.xml")
    ),
    "info": Target("set/meta/info.json", lambda f: write_set(f / "set", "v3.0"), load_dataset),
    "data": Target(
        "set/data/chunk-000/file-000.parquet",
        lambda f: write_set(f / "set", "v3.0"),
        load_dataset,
    ),
}


def mutated(content: bytes, rng: random.Random) -> bytes:
    """The content with one to three random changes."""
    for _ in range(rng.randint(1, 3)):
        kind = rng.choice(("flip", "cut", "drop", "repeat", "insert", "value", "value"))
        at = rng.randrange(max(len(content), 1))
        end = min(len(content), at + rng.randint(1, 40))
        if kind == "flip" and content:
            flipped = content[at] ^ (1 << rng.randrange(8))
            content = content[:at] + bytes([flipped]) + content[at + 1 :]
        elif kind == "cut":
            content = content[:at]
        elif kind == "drop":
            content = content[:at] + content[end:]
        elif kind == "repeat":
            content = content[:end] + content[at:]
        elif kind == "insert":
            content = content[:at] + rng.randbytes(rng.randint(1, 9)) + content[at:]
        elif tokens := [*re.finditer(rb'-?\d+(?:\.\d+)?(?:e[+-]?\d+)?|"[^"]*"', content)]:
            start, stop = rng.choice(tokens).span()
            content = content[:start] + rng.choice(VALUES).encode() + content[stop:]
    return content


@contextmanager
def time_limit():
    def end(*_):
        raise TimeoutError("the load hangs")

    before = signal.signal(signal.SIGALRM, end)
    signal.setitimer(signal.ITIMER_REAL, PATIENCE)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def refused(target: Target, folder: Path) -> bool:
    """True if the file is refused; fails at any other end."""
    try:
        with time_limit(), shapes_unchecked(), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            target.load(folder)
    except TimeoutError:
        raise
    except (ValueError, OSError) as error:
        message = str(error)
        assert message
        assert "\n" not in message.strip(), message
        assert len(message) < 1000, message
        return True
    return False


def run_mutants(name: str, folder: Path, count: int, seed: int) -> None:
    target, rng = TARGETS[name], random.Random(f"{name} {seed}")
    sound = folder / "sound"
    sound.mkdir()
    target.write(sound)
    assert not refused(target, sound)
    content = (sound / target.file).read_bytes()
    work = folder / "mutant"
    shutil.copytree(sound, work)
    for number in range(count):
        mutant = mutated(content, rng)
        (work / target.file).write_bytes(mutant)
        try:
            noticed = refused(target, work)
        except Exception as error:
            error.add_note(f"mutant {number} of {name}: {mutant[:3000]!r}")
            raise
        if target.checksum and mutant != content:
            assert noticed, f"mutant {number} of {name} was not noticed: {mutant[:3000]!r}"


COSTLY = {"urdf", "mjcf", "info", "data"}
"""Targets whose loads take tens of milliseconds."""


@pytest.mark.parametrize("name", TARGETS)
def test_mutants_are_refused_or_read(name, tmp_path):
    run_mutants(name, tmp_path, 7 if name in COSTLY else 16, seed=0)


@pytest.mark.slow
@pytest.mark.parametrize("name", TARGETS)
def test_many_mutants_are_refused_or_read(name, tmp_path):
    run_mutants(name, tmp_path, 140, seed=1)


SEEDS = (
    ("angle", '{"version": 1, "offset_rad": null, "spread_rad": 0.1}'),
    ("angle", '{"version": 1, "offset_rad": NaN, "spread_rad": 0.1}'),
    ("angle", '{"version": 1, "offset_rad": "0.1", "spread_rad": 0.1}'),
    ("angle", "[" * 100_000),
    (
        "approach",
        '{"version": 1, "orientation_wxyz": [0,0,0,0],"spread_rad":0,"turned_rad":0}',
    ),
    ("approach", '{"version": 1, "orientation_wxyz": [], "spread_rad": 0, "turned_rad": 0}'),
    ("target", '{"version": 2, "offset_m": [3e9, 0, 0], "error_px": null}'),
    ("target", '{"version": 2, "offset_m": [0, 0, 0], "error_px": null, "focal_px": -600}'),
    ("inputs", "[]"),
    ("report", '{"format": "hrc_learn report", "version": 1}'),
    ("limits", "[default]\nacceleration = nan\n"),
    ("limits", "[default]\nacceleration = true\n"),
    ("config", '{"format": "hrc_learn", "version": true, "kind": "JointDMP"}'),
    ("config", '{"format": ' + "[" * 100_000),
)
"""Files that once were read, or ended in a traceback."""


@pytest.mark.parametrize(("name", "content"), SEEDS)
def test_what_once_was_read_is_refused(name, content, tmp_path):
    target = TARGETS[name]
    target.write(tmp_path)
    (tmp_path / target.file).write_text(content)
    assert refused(target, tmp_path)
