"""Several processes give the answer of one; started as a user starts them."""

import os
import pickle
import runpy
import subprocess
import sys
import textwrap
from multiprocessing.reduction import ForkingPickler

import pytest
import torch
from safetensors.torch import load_file
from torch.testing import assert_close

from hrc_learn import distributed
from hrc_learn.distributed import ByValue

PROGRAM = """
import sys

import torch
from safetensors.torch import save_file

from hrc_learn import distributed
from hrc_learn.dmp import fit_shared
from hrc_learn.geometry import Pose, quaternion
from hrc_learn.jacobian import (
    EvidenceConfig,
    ImageDemonstration,
    RBFCenters,
    RBFImageJacobian,
    cross_validate,
    maximize_evidence,
)

rng = torch.Generator().manual_seed(0)


def normal(*shape):
    return torch.randn(*shape, generator=rng, dtype=torch.float64)


def motion(frames):
    time = torch.linspace(0, 2, frames, dtype=torch.float64)
    return time, (normal(4, 1, 3) * (time[:, None] * (1 + normal(4, 1, 3).abs())).sin()).sum(0)


def view(frames):
    _, turn = motion(frames)
    _, place = motion(frames)
    orientation = quaternion.exp(0.1 * turn)
    pose = Pose(torch.tensor([0.2, 0.5, 0.2]) + 0.05 * place, orientation)
    marker = pose.apply(torch.tensor([0.1, 0.0, 0.0], dtype=torch.float64))
    pixel = 1500 * marker[:, :2] / (1.5 - marker[:, 2:]) + 0.1 * normal(frames, 2)
    return pose, pixel


motions = [motion(100 + 7 * i) for i in range(5)]
views = [view(80 + 3 * i) for i in range(5)]
with distributed.processes() as rank:
    shared, rmse = fit_shared(motions, 20)
    poses, features = [pose for pose, _ in views], [pixel for _, pixel in views]
    demonstrations = [
        ImageDemonstration(pose=pose, feature=x, visible=torch.ones(len(x), dtype=torch.bool))
        for pose, x in zip(poses, features, strict=True)
    ]
    around = RBFCenters.around(demonstrations)
    few = EvidenceConfig(rounds=2, iterations=3)
    learned = maximize_evidence(demonstrations, around, learning=few)
    network = RBFImageJacobian.fit(
        demonstrations, learned.kept.neurons, learned.kept.config
    )
    result = {
        "processes": torch.tensor(distributed.count()),
        "primitive": shared.rollout().position,
        "rmse": rmse,
        "around": around.centers,
        "centers": network.centers,
        "weight": network.weight,
        "covariance": network.covariance,
        "held_out": torch.tensor([state.held_out_error for state in learned.rounds]),
        "pairs": cross_validate(demonstrations, network, learned.kept.config).error,
    }
    if rank == 0:
        save_file({name: x.detach().contiguous() for name, x in result.items()}, sys.argv[1])
"""


@pytest.fixture
def program(tmp_path):
    path = tmp_path / "program.py"
    path.write_text(textwrap.dedent(PROGRAM))
    return path


@pytest.mark.long
def test_two_processes_give_the_answer_of_one(program, tmp_path, monkeypatch):
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone"]
    done = subprocess.run(
        [*command, "--nproc-per-node=2", program, tmp_path / "two.safetensors"],
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    monkeypatch.setattr(sys, "argv", [str(program), str(tmp_path / "one.safetensors")])
    runpy.run_path(str(program), run_name="__main__")
    one, two = (load_file(tmp_path / f"{name}.safetensors") for name in ("one", "two"))
    assert (one.pop("processes"), two.pop("processes")) == (1, 2)
    for name, expected in one.items():
        assert_close(two[name], expected, rtol=1e-10, atol=1e-10 * float(expected.abs().max()))


def test_alone_everything_is_as_without():
    x = torch.arange(6.0).view(2, 3)
    assert (distributed.rank(), distributed.count()) == (0, 1)
    assert distributed.sum_over_processes(x) is x
    assert distributed.differentiable_sum(x) is x
    assert list(distributed.local_items("abc")) == [(0, "a"), (1, "b"), (2, "c")]
    with distributed.processes() as rank:
        assert rank == 0
        assert not torch.distributed.is_initialized()


def test_an_argument_by_value_leaves_the_memory_of_its_tensors():
    tensor = torch.arange(7.0)
    view, address = tensor.numpy(), tensor.data_ptr()
    received = pickle.loads(ForkingPickler.dumps(ByValue({"limits": tensor})))
    assert_close(received["limits"], tensor, rtol=0, atol=0)
    assert tensor.data_ptr() == address == view.ctypes.data
    ForkingPickler.dumps(tensor)
    assert tensor.data_ptr() != address  # or `ByValue` would not be needed any more
