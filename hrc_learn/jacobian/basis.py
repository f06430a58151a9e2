"""Radial basis functions and where to put them."""

import torch
from jaxtyping import Float
from torch import Tensor


def radial_basis(
    inputs: Float[Tensor, "*batch n"],
    centers: Float[Tensor, "K n"],
    width: Float[Tensor, ""],
    *,
    normalized: bool,
) -> Float[Tensor, "*batch K"]:
    """Gaussian neurons theta_k = exp(-|x - c_k|^2 / (2 width^2)), the paper's (eq_rbf).

    Args:
        inputs: Where to evaluate.
        centers: One row a neuron.
        width: Standard deviation of the Gaussians, in the unit of `inputs`.
        normalized: Divide by the sum over neurons. The neurons then sum to one everywhere: a
            weight that is the same for all of them is reproduced everywhere, and far from all
            centres the nearest neuron speaks instead of none.
    """
    square = (inputs.unsqueeze(-2) - centers).square().sum(-1)
    exponent = -square / (2 * width.square())
    return torch.softmax(exponent, dim=-1) if normalized else torch.exp(exponent)


def grid(*axes: tuple[float, float, int]) -> Float[Tensor, "K n"]:
    """Centres on a regular grid.

    Args:
        axes: First value, last value and number of centres along each input.
    """
    lines = [torch.linspace(*axis, dtype=torch.float64) for axis in axes]
    return torch.cartesian_prod(*lines).reshape(-1, len(axes))


def paper_grid() -> Float[Tensor, "9 2"]:
    """Table I: (0.05, 0.35) + (0.15 i, 0.15 j) for i, j = 0, 1, 2, in x and y [m]."""
    return grid((0.05, 0.35, 3), (0.35, 0.65, 3))
