"""Image Jacobians to start from, learned or guessed."""

import copy

import torch

from ..controller.table1 import INITIAL_IMAGE_JACOBIAN
from ..jacobian import KalmanEstimator, RBFImageJacobian, paper_grid


def from_learned(learned: RBFImageJacobian) -> KalmanEstimator:
    """A Kalman filter that starts from the learned Jacobian, but does not rely on it.

    The camera may have been moved since it was learned, about which the covariance of the fit
    knows nothing; the wide prior of a guess takes its place.
    """
    network = copy.deepcopy(learned).double()
    network.covariance = None
    return KalmanEstimator(network)


def guessed_network() -> RBFImageJacobian:
    """The paper's initial image Jacobian, the same everywhere."""
    guess = torch.tensor(INITIAL_IMAGE_JACOBIAN, dtype=torch.float64)
    return RBFImageJacobian.from_jacobian(guess, paper_grid(), 0.1)
