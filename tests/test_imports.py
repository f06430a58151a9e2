"""What importing the package pulls in, each time in a fresh interpreter."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
EDGES = ("lerobot", "rerun", "mujoco", "cv2", "matplotlib", "pyarrow", "datasets", "viser")
CORE = ("dmp", "controller", "jacobian", "regions", "kinematics", "geometry", "protocols")


def run(code: str) -> str:
    """What a program prints that is started in the root of the checkout."""
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


@pytest.mark.parametrize(
    "modules",
    [["hrc_learn"], [f"hrc_learn.{name}" for name in CORE]],
    ids=["the package", "the core"],
)
def test_the_core_pulls_in_no_edge(modules):
    loaded = f"[name for name in {EDGES} if name in sys.modules]"
    assert run(f"import sys, {', '.join(modules)}; print({loaded})") == "[]"


def test_the_core_works_where_no_edge_is_installed():
    """None in `sys.modules` makes an import fail as if the library were missing."""
    code = f"""
import sys
sys.modules.update(dict.fromkeys({EDGES}))
import torch
from hrc_learn.dmp import JointDMP
from hrc_learn.kinematics import panda
time = torch.linspace(0, 1, 50)
JointDMP.fit(time, time[:, None].expand(-1, 7), n_basis=5).rollout().position
print(tuple(panda.forward_and_jacobian(torch.zeros(7, dtype=torch.float64))[1].shape))
"""
    assert run(code) == "(6, 7)"


def test_the_person_needs_no_screen_until_a_page_is_opened():
    code = """
import sys
import hrc_learn.teleoperation.page, hrc_learn.teleoperation.devices
print([name for name in ("viser", "pygame", "rerun", "mujoco") if name in sys.modules])
"""
    assert run(code) == "[]"


def test_datasets_is_hugging_faces_even_in_our_checkout():
    """Our folder of that name loses to an installed package while it is none itself."""
    code = "import importlib.util; print(importlib.util.find_spec('datasets').origin)"
    origin = Path(run(code))
    assert origin.name == "__init__.py"
    assert ROOT / "datasets" not in origin.parents
    assert origin.parent.parent.name in {"site-packages", "dist-packages"}


def test_learning_from_a_dataset_needs_no_simulator():
    """A user with demonstrations of their own installs neither MuJoCo nor OpenCV."""
    program = """
import sys
for name in ("mujoco", "cv2", "lerobot"):
    sys.modules[name] = None
import hrc_learn.learning, hrc_learn.demos
"""
    subprocess.run([sys.executable, "-c", program], check=True, timeout=600)
