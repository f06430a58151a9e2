"""Number of operations in one step without a compiler, which determines its time."""

from collections import Counter

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode
from unchecked import shapes_unchecked

from hrc_learn.controller import (
    GRIPPER_DOWN,
    INITIAL_IMAGE_JACOBIAN,
    AdaptiveController,
    Goals,
    Observation,
)
from hrc_learn.deploy import EagerRunner
from hrc_learn.jacobian import KalmanEstimator, RBFImageJacobian, paper_grid
from hrc_learn.kinematics import panda


class Operations(TorchDispatchMode):
    """Counts the operations of PyTorch."""

    def __init__(self):
        super().__init__()
        self.count = Counter()

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        self.count[str(function)] += 1
        return function(*args, **(kwargs or {}))


def everything() -> EagerRunner:
    """The step with all features: images with a delay, a person, capped points."""
    J = torch.tensor(INITIAL_IMAGE_JACOBIAN, dtype=torch.float64)
    network = RBFImageJacobian.from_jacobian(J, paper_grid(), 0.1)
    at = torch.tensor((0.4, 0.1, 0.4, 700.0, 500.0), dtype=torch.float64)
    goals = Goals.at(at[:3], torch.tensor(GRIPPER_DOWN, dtype=torch.float64), at[3:])
    observation = Observation(
        joint_position=panda.ready,
        feature=torch.full((2,), 600.0, dtype=torch.float64),
        feature_visible=torch.tensor(True),
        feature_new=torch.tensor(True),
        image_joint_position=panda.ready.clone(),
        nullspace_input=torch.full_like(panda.ready, 0.1),
        dt=0.001,
    )
    return EagerRunner(AdaptiveController(panda, KalmanEstimator(network), goals), observation)


@pytest.mark.simulation
def test_a_step_takes_few_operations():
    with shapes_unchecked():
        runner = everything()
        for _ in range(400):  # until vision feedback has faded in
            runner.step()
        with Operations() as operations:
            runner.step()
    assert operations.count.total() <= 665, operations.count.most_common(20)
