"""Why the limits need a filter: what the paper's avoidance in the null space can and cannot do.

N has rank 1. The component of the task's joint velocity along the null direction is all that a
push through N can change; what drives a joint into its limit in the other six stays.
"""

import pytest
import torch
from projections import null_space_projector
from torch import Tensor
from unchecked import shapes_unchecked

from hrc_learn.controller import SafetyFilter
from hrc_learn.kinematics import panda
from hrc_learn.regions import JointRegion

LIMITS = panda.limits
DT = 0.004


def drive(twist: Tensor, stiffness: float, *, filtered: bool) -> Tensor:
    """How far the joints come past their limits while a task pushes on for 4 s [rad]."""
    region = JointRegion.from_limits(
        LIMITS.lower, LIMITS.upper, stiffness=stiffness, reference_stiffness=stiffness
    )
    safety = SafetyFilter(LIMITS)
    q = panda.ready.expand(len(twist), 7)
    state = safety.initial_state(q)
    worst = torch.full((len(twist),), -torch.inf, dtype=torch.float64)
    for _ in range(1000):
        J = panda.jacobian(q)
        task = J.mT @ torch.linalg.solve(
            J @ J.mT + 0.05**2 * torch.eye(6, dtype=J.dtype), twist[..., None]
        )
        u = (task - null_space_projector(J) @ region.gradient(q)[..., None])[..., 0]
        if filtered:
            u, state, _ = safety.step(state, q, u, DT)
        else:  # the velocity limit alone, as the arm itself would keep it
            u = u / (u.abs() / LIMITS.velocity).amax(-1, keepdim=True).clamp(min=1)
        q = q + DT * u
        worst = torch.maximum(worst, torch.maximum(q - LIMITS.upper, LIMITS.lower - q).amax(-1))
    return worst


@pytest.mark.long
@pytest.mark.parametrize("stiffness", [10.0, 1000.0])
def test_the_null_space_cannot_keep_limits_and_the_filter_does(stiffness: float):
    """Whatever its gain: back and up, a tilt, and a turn of the tool about its axis."""
    twist = torch.tensor(
        [
            [-0.2, 0.0, 0.1, 0.0, 0.0, 0.0],
            [0.0, 0.0, 0.0, 0.0, 1.5, 0.0],
            [0.0, 0.0, 0.0, 0.0, 0.0, 1.5],
        ],
        dtype=torch.float64,
    )
    with shapes_unchecked():  # for speed
        assert (drive(twist, stiffness, filtered=False) > 0.05).all()
        assert (drive(twist, stiffness, filtered=True) < 0).all()
