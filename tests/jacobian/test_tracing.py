"""The estimators as one graph: compiled without breaks, and exported for any batch size."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from graphs import library_calls
from pinhole import Pinhole, wander
from sampling import generator
from torch.testing import assert_close
from unchecked import shapes_unchecked

from hrc_learn.geometry import Pose
from hrc_learn.jacobian import (
    BroydenEstimator,
    CompositeEstimator,
    FixedEstimator,
    KalmanEstimator,
    Measurement,
    PaperEstimator,
    RBFImageJacobian,
    paper_grid,
)

ALL = [
    FixedEstimator,
    PaperEstimator,
    BroydenEstimator,
    CompositeEstimator,
    KalmanEstimator,
]
CAMERA = Pinhole.overhead()


class Step(torch.nn.Module):
    """Two updates on tensors alone, as a control loop would chain them."""

    def __init__(self, estimator, batch):
        super().__init__()
        self.estimator, self.batch = estimator, batch

    def forward(self, position, orientation, feature, xi_x, xi_r):
        state = self.estimator.initial_state(*self.batch)
        for t in range(2):
            state = self.estimator.update(
                state,
                Measurement(
                    pose=Pose(position[..., t, :], orientation[..., t, :]),
                    feature=feature[..., t, :],
                    valid=feature[..., t, 0] > 0,
                    dt=1 / 30,
                    xi_x=xi_x,
                    xi_r=xi_r,
                ),
            )
        return self.estimator.jacobian(state, Pose(position[..., 1, :], orientation[..., 1, :]))


def step_and_inputs(Estimator, *batch):
    rng = generator(1)
    J0 = 1000 * torch.randn(2, 6, generator=rng, dtype=torch.float64)
    estimator = Estimator(RBFImageJacobian.from_jacobian(J0, paper_grid(), 0.1))
    pose = wander(2, *batch, rng=rng)
    xi_x = torch.randn(*batch, 2, generator=rng, dtype=torch.float64)
    xi_r = torch.randn(*batch, 6, generator=rng, dtype=torch.float64)
    inputs = (pose.position, pose.orientation, CAMERA.project(pose), xi_x, xi_r)
    return Step(estimator, batch), inputs


@pytest.mark.parametrize("Estimator", ALL)
def test_exports(Estimator):
    step, inputs = step_and_inputs(Estimator, 3)
    with shapes_unchecked():
        program = torch.export.export(step, inputs)
        assert not library_calls(program)
        assert_close(program.module()(*inputs), step(*inputs))


def compile_all():
    # One law of each family: gradients, recursions.
    for Estimator in (CompositeEstimator, KalmanEstimator):
        step, inputs = step_and_inputs(Estimator)
        compiled = torch.compile(step, fullgraph=True, backend="eager")
        assert_close(compiled(*inputs), step(*inputs))
        torch.compiler.reset()


def test_compiles_without_graph_breaks():
    """In a process of its own: dynamo cannot trace the shape checks of this one."""
    tests = Path(__file__).parents[1]
    result = subprocess.run(
        [sys.executable, __file__],
        env=os.environ | {"PYTHONPATH": str(tests)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 0, result.stderr[-3000:]


if __name__ == "__main__":
    compile_all()
