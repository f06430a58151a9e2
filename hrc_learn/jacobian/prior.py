"""What is believed about the weights before any image motion was seen."""

import torch
from jaxtyping import Float
from torch import Tensor


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
