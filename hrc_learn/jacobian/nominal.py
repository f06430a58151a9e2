"""Prior that knows depth and rotation: a network that starts as the model of a rough camera."""

from collections.abc import Callable, Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.geometry import Pose
from hrc_learn.jacobian.network import RBFImageJacobian


def nominal_network(
    model: Callable[[Pose], Tensor],
    around: Pose,
    centers: Float[Tensor, "K n"],
    width: float,
    *,
    input_indices: Sequence[int] = (0, 1, 2),
) -> RBFImageJacobian:
    """A network that agrees with a model of the image Jacobian at its neurons.

    A rough guess of where the camera stands tells how the Jacobian shrinks with the depth of
    the marker and how it turns with the tool; one Jacobian for the whole workspace cannot.
    Online estimators start from it as from any other network.

    Args:
        model: From poses (K,) to image Jacobians (K, rows, 6), such as
            `PinholeCamera.image_jacobian`.
        around: Pose of the tool in the middle of the workspace; supplies the components of r
            that the neurons do not see.
        centers: Of the neurons.
        width: Of the neurons.
        input_indices: Components of r = (x, y, z, three of the rotation vector) that the
            neurons see; depth needs z.
    """
    network = RBFImageJacobian(centers, width, input_indices=input_indices)
    r = around.vector().to(centers).expand(len(centers), 6).clone()
    r[:, list(network.input_indices)] = centers
    with torch.no_grad():
        J = model(Pose.from_vector(r))
    network.weight.data = J.flatten(1).mT.contiguous()
    return network
