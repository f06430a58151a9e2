"""Random configurations of the Panda for tests."""

import torch
from sampling import within
from torch import Tensor

from hrc_learn.kinematics import panda


def joint_positions(*batch: int, rng: torch.Generator, margin: float = 0.05) -> Tensor:
    """Joint positions uniform within limits, at least `margin` inside [rad]."""
    return within(panda.limits.lower, panda.limits.upper, *batch, rng=rng, margin=margin)
