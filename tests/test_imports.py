"""What importing the package pulls in, part after part in one fresh interpreter."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
EDGES = ("lerobot", "rerun", "mujoco", "cv2", "matplotlib", "pyarrow", "datasets", "viser")
CORE = ("dmp", "controller", "jacobian", "regions", "kinematics", "geometry", "protocols")
SIMULATOR = ("mujoco", "cv2", "lerobot")

PROGRAM = f"""
import json, sys
from contextlib import contextmanager
from importlib import import_module, util

def loaded(names):
    return [name for name in names if name in sys.modules]

@contextmanager
def missing(names):
    # None in `sys.modules` makes an import fail as if the library were not installed.
    kept = {{name: sys.modules.get(name) for name in names}}
    sys.modules.update(dict.fromkeys(names))
    yield
    for name, module in kept.items():
        sys.modules.pop(name)
        if module is not None:
            sys.modules[name] = module

found = {{}}
found["datasets"] = util.find_spec("datasets").origin
import hrc_learn
found["package"] = loaded({EDGES})
for name in {CORE}:
    import_module(f"hrc_learn.{{name}}")
found["core"] = loaded({EDGES})

with missing({EDGES}):
    import torch
    from hrc_learn.dmp import JointDMP
    from hrc_learn.kinematics import panda
    time = torch.linspace(0, 1, 50)
    JointDMP.fit(time, time[:, None].expand(-1, 7), n_basis=5).rollout().position
    q = torch.zeros(7, dtype=torch.float64)
    found["jacobian"] = list(panda.forward_and_jacobian(q)[1].shape)

import hrc_learn.teleoperation.page, hrc_learn.teleoperation.devices
found["person"] = loaded(("viser", "pygame", "rerun", *{SIMULATOR}))

with missing({SIMULATOR}):
    import hrc_learn.learning, hrc_learn.demos
print(json.dumps(found))
"""


@pytest.fixture(scope="module")
def found():
    """What is in `sys.modules` after each part, started in the root of the checkout."""
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM], cwd=ROOT, capture_output=True, text=True
    )
    # Learning, last, needs no simulator: who has demonstrations installs none.
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.mark.parametrize("part", ["package", "core"])
def test_the_core_pulls_in_no_edge(found, part):
    assert found[part] == []


def test_the_core_works_where_no_edge_is_installed(found):
    assert found["jacobian"] == [6, 7]


def test_person_needs_no_screen_until_a_page_is_opened(found):
    assert found["person"] == []


def test_datasets_is_hugging_faces_even_in_our_checkout(found):
    """Our folder of that name loses to an installed package while it is none itself."""
    origin = Path(found["datasets"])
    assert origin.name == "__init__.py"
    assert ROOT / "datasets" not in origin.parents
    assert origin.parent.parent.name in {"site-packages", "dist-packages"}
