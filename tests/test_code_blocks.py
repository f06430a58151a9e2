"""The Python blocks of README and docs/ run, pasted page by page from top to bottom."""

import functools
import importlib
import importlib.util
import json
import re
import shlex
from pathlib import Path

import numpy as np
import pytest
import torch
from commands import hrc
from lerobot_folders import joint_path, write_folder
from unchecked import shapes_unchecked
from urdf_text import to_urdf

from hrc_learn.dmp import PoseDMP
from hrc_learn.kinematics import panda
from hrc_learn.kinematics.registry import arm_of_robot
from hrc_learn.teleoperation import dashboard_page

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
BLOCK = re.compile(
    r"^(?:<!-- not run: (?P<reason>[^>]+) -->\n)?```(?P<language>\w*)\n(?P<body>.*?)^```",
    re.MULTILINE | re.DOTALL,
)
NAME = re.compile(r"`(hrc_learn(?:\.\w+)+)`")
SHORT_NAME = re.compile(r"`((?!hrc_learn)[a-z_]+\.\w+)`")
"""Names in docs/concepts/paper.md, a table of them: `regions.Region` without the package."""
MOST_NOT_RUN = 3
"""Blocks that only say what cannot be tried here; a new one has to be worth it."""


def python_blocks(page: Path) -> list[re.Match[str]]:
    return [m for m in BLOCK.finditer(page.read_text("utf-8")) if m["language"] == "python"]


def pasted(page: Path) -> str:
    """What is run of a page, each line at its number there, so that errors name it."""
    text = page.read_text("utf-8")
    lines = [""] * text.count("\n")
    for block in python_blocks(page):
        if block["reason"] is None:
            first = text.count("\n", 0, block.start("body"))
            body = block["body"].splitlines()
            lines[first : first + len(body)] = body
    return "\n".join(lines)


def recorded_dataset(root: Path) -> None:
    """The reader's own dataset: three motions of seven joints, with poses of the tool."""
    episodes = []
    for seed in range(3):
        joints = joint_path(120, 7, seed)
        position = 0.3 + 0.1 * joints[:, :3]
        upright = np.tile([0.0, 0.0, 0.0, 1.0], (len(joints), 1))
        episodes.append(
            {
                "observation.state": joints,
                "observation.tool_quaternion": upright,
                "observation.tool_position": position,
            }
        )
    names = {
        "observation.state": [f"joint{i}.pos" for i in range(1, 8)],
        "observation.tool_quaternion": ["qx", "qy", "qz", "qw"],
        "observation.tool_position": ["tool_x", "tool_y", "tool_z"],
    }
    write_folder(root, episodes, names)


def fitted_pose(folder: Path) -> None:
    """What `hrc fit` leaves of the hand's motion, of a small one."""
    time = torch.linspace(0, 1, 60, dtype=torch.float64)
    position = 0.4 + 0.1 * torch.from_numpy(joint_path(60, 3))
    upright = torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=torch.float64).repeat(60, 1)
    folder.parent.mkdir(parents=True)
    PoseDMP.fit(time, position, upright, n_basis=20).save(folder)


@pytest.fixture
def reader(tmp_path, monkeypatch):
    """A reader's session: an empty folder but for a dataset, the port usual for us free."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "agg")
    # Other programs on this machine may use the usual port. The viewer's files take seconds.
    monkeypatch.setattr(dashboard_page, "_viewer_contents", dict)
    serve = functools.partial(dashboard_page.serve_stream, 0)
    monkeypatch.setattr(dashboard_page, "serve_stream", serve)
    recorded_dataset(tmp_path / "path/to/dataset")
    fitted_pose(tmp_path / "models/place/pose")
    (tmp_path / "my.urdf").write_text(to_urdf(panda))
    dtype = torch.get_default_dtype()
    yield
    torch.set_default_dtype(dtype)


RUN = [page for page in PAGES if pasted(page).strip()]


@pytest.mark.long
@pytest.mark.parametrize("page", RUN, ids=lambda page: page.stem)
@pytest.mark.usefixtures("reader")
def test_a_page_can_be_pasted_from_top_to_bottom(page):
    code = compile(pasted(page), str(page), "exec")
    with shapes_unchecked():
        exec(code, {"__name__": "__main__"})


def so101_dataset(root: Path) -> None:
    """What `lerobot-record` leaves of an SO-101 in degrees, without its images."""
    joints = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll")
    names = [f"{name}.pos" for name in (*joints, "gripper")]
    episodes = []
    for seed in range(4):
        moved = np.array([-20.0, -40, 40, 30, 0]) + 25 * joint_path(90, 5, seed)
        state = np.column_stack([moved, np.where(np.arange(90) < 50, 70.0, 10.0)])
        episodes.append({"observation.state": state, "action": np.roll(state, -2, axis=0)})
        episodes[-1]["action"][-2:] = state[-1]
    write_folder(root, episodes, {"observation.state": names, "action": names}, fps=30)
    info = json.loads((root / "meta/info.json").read_text())
    (root / "meta/info.json").write_text(json.dumps(info | {"robot_type": "so101_follower"}))
    statistics = {}
    for key in episodes[0]:
        values = np.concatenate([episode[key] for episode in episodes])
        statistics[key] = {
            name: getattr(values, name)(axis=0).tolist()
            for name in ("min", "max", "mean", "std")
        } | {"count": [len(values)]}
    (root / "meta/stats.json").write_text(json.dumps(statistics))


SHELL_PAGES = {"so101.md": ("so101_pick", so101_dataset)}
"""Pages whose commands are run in turn, with the name of the dataset that they begin with."""


@pytest.mark.slow
@pytest.mark.usefixtures("reader")
@pytest.mark.parametrize("name", SHELL_PAGES)
def test_the_commands_of_a_page_run_in_turn(name):
    """Word for word. Targets may be missed: the dataset is small."""
    if arm_of_robot("so101") is None:
        pytest.skip("example-robot-data is not installed")
    folder, make = SHELL_PAGES[name]
    make(Path(folder))
    page = (ROOT / "docs/howto" / name).read_text("utf-8")
    (block,) = (m["body"] for m in BLOCK.finditer(page) if m["language"] == "sh")
    for line in block.splitlines():
        program, *words = shlex.split(line, comments=True)
        assert program == "hrc"
        ended = hrc(*words)
        assert ended.status == 0, f"{line}: {ended.error or ended.output}"
        if "--out" in words:
            assert Path(words[words.index("--out") + 1]).exists(), line


def test_few_blocks_are_not_run():
    reasons = [m["reason"] for page in PAGES for m in python_blocks(page) if m["reason"]]
    assert len(reasons) <= MOST_NOT_RUN, reasons


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_names_of_the_package_can_be_imported(page):
    text, wrong = page.read_text("utf-8"), []
    names = set(NAME.findall(text))
    if page.name == "paper.md":
        names |= {f"hrc_learn.{name}" for name in SHORT_NAME.findall(text)}
    for name in sorted(names):
        module, rest = name, []
        while module and not _is_module(module):
            module, _, last = module.rpartition(".")
            rest.insert(0, last)
        value = importlib.import_module(module)
        for part in rest:
            value = getattr(value, part, None)
        if value is None:
            wrong.append(name)
    assert not wrong


def _is_module(name: str) -> bool:
    try:
        return importlib.util.find_spec(name) is not None
    except ModuleNotFoundError:
        return False
