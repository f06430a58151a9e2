"""One network for a feature of several points."""

from collections.abc import Sequence

import torch

from hrc_learn.jacobian.network import RBFImageJacobian


def stacked(networks: Sequence[RBFImageJacobian]) -> RBFImageJacobian:
    """One network for all points of a feature, from one for each of them.

    Points fitted to the same demonstrations have the same regressors, so their image rows share
    one covariance: here that of the least certain point.

    Raises:
        ValueError: Their neurons differ.
    """
    first = networks[0]
    for i, other in enumerate(networks[1:], start=1):
        if not _same_neurons(first, other):
            raise ValueError(
                f"network {i} has other neurons than network 0: fit all points with the same "
                "centers, width and input_indices"
            )
    stack = RBFImageJacobian(
        first.centers,
        float(first.width),
        weight=torch.cat([network.weight.detach() for network in networks]),
        input_indices=first.input_indices,
        reference=first.reference,
        normalized=first.normalized,
    )
    known = [network.covariance for network in networks if network.covariance is not None]
    if len(known) == len(networks):
        stack.covariance = max(known, key=lambda covariance: float(covariance.trace()))
    return stack


def _same_neurons(a: RBFImageJacobian, b: RBFImageJacobian) -> bool:
    references = [network.reference for network in (a, b) if network.reference is not None]
    return (
        torch.equal(a.centers, b.centers)
        and torch.equal(a.width, b.width)
        and (a.input_indices, a.normalized) == (b.input_indices, b.normalized)
        and (not references or (len(references) == 2 and torch.equal(*references)))
    )
