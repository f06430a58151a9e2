import pytest
import torch

from hrc_learn.regions import JointRegion

LIMITS = {
    "lower": torch.tensor([-1.0], dtype=torch.float64),
    "upper": torch.tensor([2.0], dtype=torch.float64),
}


def column(*values: float) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)[:, None]


def test_values_of_table_one():
    """k_q = 10 within 0.1 rad and k_r = 1 within 0.3 rad of a limit."""
    region = JointRegion.from_limits(**LIMITS)
    # 0.05 rad from the upper limit: both push; 0.2 rad: the reference region alone.
    expected = column(10 * 0.05 + 1 * 0.25, 1 * 0.1, 0.0)
    torch.testing.assert_close(region.gradient(column(1.95, 1.8, 1.0)), expected)


def test_the_push_grows_all_the_way_past_the_limit():
    region = JointRegion.from_limits(**LIMITS)
    push = region.gradient(torch.linspace(1.75, 2.5, 50, dtype=torch.float64)[:, None])
    assert (push.diff(dim=0) > 0).all()
    assert (push > 0).all()  # the arm moves against the gradient: back inside


def test_the_printed_form_fails_at_the_limit():
    """Why it is not the default: no push at the limit, and outwards beyond it."""
    region = JointRegion.from_limits(**LIMITS, formulation="paper")
    inside, at, past = region.gradient(column(1.95, 2.0, 2.05)).squeeze(-1)
    assert inside > 0
    assert at == 0
    assert past < 0


def test_the_value_is_negative_near_either_limit():
    value = JointRegion.from_limits(**LIMITS).value(column(-0.95, 0.0, 1.95))
    assert (value < 0).squeeze(-1).tolist() == [True, False, True]


@pytest.mark.parametrize("distance", [0.05, 0.2, 0.35])
@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_the_printed_functions_are_differences_of_squares(distance, side):
    """f = d^2 - 0.1^2 and f_r = d^2 - 0.3^2, with the gains 10 and 1."""
    region = JointRegion.from_limits(**LIMITS, formulation="paper")
    x = torch.tensor([0.5 + side * (1.5 - distance)]).double()
    f, f_reference = distance**2 - 0.01, distance**2 - 0.09
    assert region.value(x).item() == pytest.approx(f)
    expected = (10 * min(f, 0) ** 2 + min(f_reference, 0) ** 2) / 2
    assert region.potential(x).item() == pytest.approx(expected)
