import math

import pytest
import torch

from hrc_learn.regions import PostureRegion

GOAL = torch.tensor([0.3, -1.0, 0.5, 2.0], dtype=torch.float64)


@pytest.mark.parametrize("distance", [0.0, 0.2, 0.5, 3.0])
def test_region_and_potential_follow_the_distance_to_the_posture(distance):
    region = PostureRegion(goal=GOAL, tolerance=0.25, stiffness=2.0, saturation=0.75)
    x = GOAL + distance * torch.tensor([0.6, 0.0, -0.8, 0.0], dtype=torch.float64)
    assert region.value(x).item() == pytest.approx(distance / 0.25 - 1)
    P = 2.0 * 0.75**2 * (math.sqrt(1 + (distance / 0.75) ** 2) - 1)
    assert region.potential(x).item() == pytest.approx(P)
    pull = 2.0 * distance / math.sqrt(1 + (distance / 0.75) ** 2)
    assert region.gradient(x).norm().item() == pytest.approx(pull)
