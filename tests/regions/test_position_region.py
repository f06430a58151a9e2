import pytest
import torch

from hrc_learn.regions import PositionRegion

BOX = {
    "centre": torch.tensor([0.4, 0.1, 0.3], dtype=torch.float64),
    "half_size": torch.tensor([0.12, 0.10, 0.08], dtype=torch.float64),
}


def test_inside_it_is_still():
    region = PositionRegion(**BOX)
    x = BOX["centre"] + 0.99 * BOX["half_size"]
    assert (region.value(x) < 0).all()
    assert region.potential(x) == 0
    assert (region.gradient(x) == 0).all()
    corner = BOX["centre"] + torch.tensor([1.0, -1.0, 2.0]) * BOX["half_size"]
    assert region.value(corner).tolist() == pytest.approx([0.0, 0.0, 3.0], abs=1e-12)


def test_printed_gradient():
    """(trans_diff_potential): 2 k max(0, f) (r - c) / h^2."""
    region = PositionRegion(**BOX)
    x = BOX["centre"] + torch.tensor([0.24, 0.05, -0.16], dtype=torch.float64)
    expected = [2 * 4e-3 * 3 * 0.24 / 0.12**2, 0, -2 * 4e-3 * 3 * 0.16 / 0.08**2]
    assert region.gradient(x).tolist() == pytest.approx(expected)


def test_the_rate_near_a_wall_is_the_documented_one():
    """4 k_c/h^2 [1/s]: what decides how long the last millimetres take."""
    region = PositionRegion(**BOX)
    excess = 1e-6
    x = BOX["centre"] + torch.tensor([0.12 + excess, 0, 0], dtype=torch.float64)
    assert region.gradient(x)[0].item() / excess == pytest.approx(4 * 4e-3 / 0.12**2, rel=1e-4)
