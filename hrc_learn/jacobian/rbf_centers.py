"""Radial basis functions: where their centres stand, and what of the tool's pose they see.

The paper calls each of them a neuron, and so do we.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn import distributed
from hrc_learn.geometry import Pose, quaternion
from hrc_learn.jacobian.samples import ImageDemonstration

# Least distance of outer neurons from the middle [m, rad]: where hardly any motion was
# demonstrated along a component, closer ones could not be told apart.
_LEAST_REACH = 0.05
# Width of the neurons over the largest distance from the middle: wide enough to blend from one
# end of the workspace to the other, narrow enough to tell them apart.
_WIDTH_OVER_REACH = 1.5


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


@dataclass(frozen=True, kw_only=True, eq=False)
class RBFCenters:
    """Normalised Gaussians of some components of the tool's pose."""

    centers: Float[Tensor, "K n"]
    """One row a neuron, one column an input [m, rad]."""
    width: float | Float[Tensor, ""]
    """Standard deviation of the Gaussians, one number in the same units."""
    input_indices: tuple[int, ...] = (0, 1)
    """Components of (x, y, z, three of a rotation vector) that the neurons see."""
    reference: Float[Tensor, "4"] | None = None
    """Orientation that the rotation vector starts from; None: that of the base."""

    @staticmethod
    def paper() -> RBFCenters:
        """Nine over the paper's table, which see x and y (Table I)."""
        return RBFCenters(centers=paper_grid(), width=0.1)

    @staticmethod
    def around(demonstrations: Sequence[ImageDemonstration]) -> RBFCenters:
        """Thirteen about the demonstrated poses: the middle, and both ways along all six.

        The image Jacobian of a small workspace is nearly linear in position and rotation,
        which takes these; a grid over six inputs would take hundreds.

        Args:
            demonstrations: Read one by one, twice; of several processes, each its share.
        """
        reference = _mean_orientation(demonstrations)
        low, high = _range(demonstrations, reference)
        middle, reach = (low + high) / 2, ((high - low) / 2).clamp_min(_LEAST_REACH)
        return RBFCenters(
            centers=torch.cat([middle[None], middle + reach.diag(), middle - reach.diag()]),
            width=_WIDTH_OVER_REACH * float(reach.max()),
            input_indices=tuple(range(6)),
            reference=reference,
        )

    def basis(self) -> Callable[[Pose], Tensor]:
        """Activation (time, K) of the neurons at poses (time,).

        Gradients reach centres and width.
        """

        def activation(pose: Pose) -> Tensor:
            inputs = pose_inputs(pose, self.reference)[..., self.input_indices]
            width = torch.as_tensor(self.width, dtype=inputs.dtype)
            return radial_basis(inputs, self.centers.to(inputs), width, normalized=True)

        return activation


def pose_inputs(pose: Pose, reference: Float[Tensor, "4"] | None) -> Float[Tensor, "*batch 6"]:
    """Position [m] and rotation vector from the reference to the orientation [rad].

    A rotation vector jumps at half turns: choose the reference in the middle of what the
    tool does.
    """
    if reference is None:
        return pose.vector()
    back = quaternion.conjugate(reference)
    turn = quaternion.log(quaternion.multiply(pose.orientation, back))
    return torch.cat([pose.position, turn], dim=-1)


def _mean_orientation(demonstrations: Sequence[ImageDemonstration]) -> Float[Tensor, "4"]:
    """Largest eigenvector of the summed outer products (Markley et al. 2007); either sign."""
    total = torch.zeros(4, 4, dtype=torch.float64)
    for _, demonstration in distributed.share(demonstrations):
        orientation = demonstration.pose.orientation.double()
        total += orientation.mT @ orientation
    return torch.linalg.eigh(distributed.sum_over_processes(total)).eigenvectors[:, -1]


def _range(
    demonstrations: Sequence[ImageDemonstration], reference: Float[Tensor, "4"]
) -> tuple[Float[Tensor, "6"], Float[Tensor, "6"]]:
    """Smallest and largest value of every input."""
    low = torch.full((6,), torch.inf, dtype=torch.float64)
    high = -low
    for _, demonstration in distributed.share(demonstrations):
        pose = demonstration.pose
        pose = Pose(pose.position.double(), pose.orientation.double())
        inputs = pose_inputs(pose, reference)
        low = torch.minimum(low, inputs.amin(dim=0))
        high = torch.maximum(high, inputs.amax(dim=0))
    lows, highs = (torch.stack(distributed.gather(end)) for end in (low, high))
    return lows.amin(dim=0), highs.amax(dim=0)
