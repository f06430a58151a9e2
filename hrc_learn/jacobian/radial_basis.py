"""Radial basis functions, where to put them, and what is assumed about their weights."""

import torch
from jaxtyping import Float
from torch import Tensor

# Radial basis functions and where to put them.


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


# What is believed about the weights before any image motion was seen.


def component_scale(like: Tensor, rotation_scale: float) -> Float[Tensor, "6"]:
    """Metres that each component of a twist counts for: 1 a metre, `rotation_scale` a radian.

    dr times the scale is in metres throughout; a Jacobian divided by it is in px/m throughout.
    """
    return like.new_tensor([1.0] * 3 + [rotation_scale] * 3)


def weight_covariance(
    centers: Float[Tensor, "K _"],
    bias_std: float | Float[Tensor, ""],
    weight_std: float | Float[Tensor, ""],
) -> Float[Tensor, "K K"]:
    """Prior covariance between neurons, for each entry of the Jacobian alone.

    The entry is a bias, common to all neurons, plus a departure of each. With normalised
    neurons, which sum to one, that is a constant Jacobian plus a network: what is learned in
    one place holds everywhere until a place says otherwise.

    Args:
        centers: Of the neurons; gives their number, dtype and device.
        bias_std: Standard deviation of the bias [px/m].
        weight_std: Standard deviation of the departures [px/m].
    """
    K = len(centers)
    eye = torch.eye(K, dtype=centers.dtype, device=centers.device)
    return bias_std**2 * torch.ones_like(eye) + weight_std**2 * eye
