from dataclasses import replace

import pytest
import torch

from hrc_learn.regions import VisionRegion

IMAGE = (1440, 1080)
TARGET = torch.tensor([900.0, 400.0], dtype=torch.float64)


def test_the_ellipse_lies_inside_the_image():
    region = VisionRegion.inside_image(TARGET, IMAGE)
    assert region.half_size.tolist() == [539, 400]
    turn = torch.linspace(0, 6.3, 100, dtype=torch.float64)
    edge = region.target + region.half_size * torch.stack([turn.cos(), turn.sin()], -1)
    torch.testing.assert_close(region.value(edge), torch.zeros(100, dtype=torch.float64))
    assert (edge >= -1e-9).all()
    assert (edge <= torch.tensor([1439, 1079]) + 1e-9).all()


def test_a_target_outside_the_image_is_refused():
    with pytest.raises(ValueError, match="inside the image"):
        VisionRegion.inside_image(torch.tensor([1500.0, 20.0]), IMAGE)


def test_the_printed_pull_vanishes_at_the_edge_and_is_zero_beyond():
    region = VisionRegion.inside_image(TARGET, IMAGE)
    steps = torch.tensor([0.0, 3**-0.5, 1.0, 1.2], dtype=torch.float64)
    x = region.target + steps[:, None] * region.half_size * torch.tensor([1.0, 0.0])
    centre, strongest, edge, outside = region.gradient(x)[:, 0].tolist()
    assert centre == 0
    # Largest at f = -2/3, where it is 2 k_v (2/3) rho/b.
    assert strongest == pytest.approx(2 * 0.3 * (2 / 3) * 3**-0.5 / region.half_size[0])
    assert edge == pytest.approx(0, abs=1e-15)
    assert outside == 0


def test_the_printed_potential_rises_from_the_target_to_the_edge():
    region = VisionRegion.inside_image(TARGET, IMAGE)
    steps = torch.tensor([0.0, 1.0, 1.2], dtype=torch.float64)
    x = region.target + steps[:, None] * region.half_size * torch.tensor([1.0, 0.0])
    # (eq_vision_p): k_v (1 - min(0, f)^2)/2, with f = -1 at the target and k_v = 0.3.
    assert region.potential(x).tolist() == pytest.approx([0.0, 0.15, 0.15], abs=1e-12)


def test_the_saturated_form_agrees_near_the_target_and_never_lets_go():
    paper = VisionRegion.inside_image(TARGET, IMAGE)
    saturated = replace(VisionRegion.inside_image(TARGET, IMAGE), formulation="saturated")
    near = TARGET + torch.tensor([0.5, -0.5])
    # The two differ by terms of second order in the distance, here 1e-6.
    torch.testing.assert_close(
        saturated.gradient(near), paper.gradient(near), rtol=1e-5, atol=0
    )
    along = torch.tensor([0.1, 0.3, 1.0, 2.0], dtype=torch.float64)
    x = TARGET + along[:, None] * saturated.half_size * torch.tensor([1.0, 0.0])
    assert (saturated.gradient(x)[:, 0].diff() > 0).all()


@pytest.mark.parametrize("formulation", ["paper", "saturated"])
def test_several_points_have_the_mean_of_their_potentials(formulation):
    targets = torch.tensor([[900.0, 400.0], [500.0, 600.0], [700.0, 300.0]]).double()
    x = targets + torch.tensor([[30.0, -80.0], [700.0, 10.0], [-5.0, 60.0]])
    whole = VisionRegion.inside_image(targets.flatten(), IMAGE)
    together = replace(whole, formulation=formulation)
    apart = replace(VisionRegion.inside_image(targets, IMAGE), formulation=formulation)
    P, gradient = apart.feedback(x)
    torch.testing.assert_close(together.potential(x.flatten()), P.mean())
    torch.testing.assert_close(together.gradient(x.flatten()), gradient.flatten() / 3)
    assert together.value(x.flatten()) == apart.value(x).max()
    assert together.value(x.flatten()) > 0  # the second point is out of its ellipse
