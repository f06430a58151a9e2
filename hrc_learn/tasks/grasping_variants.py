"""Image Jacobians that a grasp can start from, learned or guessed, and laws to adapt them."""

import copy
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from ..jacobian import (
    CompositeEstimator,
    FixedEstimator,
    ImageJacobianEstimator,
    KalmanEstimator,
    PaperEstimator,
    RBFImageJacobian,
)
from .initial_jacobian import from_learned, guessed_network


@dataclass(frozen=True, kw_only=True)
class GraspingVariant:
    """One way to know the image Jacobian."""

    says: str
    estimator: Callable[[RBFImageJacobian], ImageJacobianEstimator]
    """From the learned image Jacobian."""
    claim: str = ""
    """What the paper states about it."""


DEFAULT = "learned"

VARIANTS: Mapping[str, GraspingVariant] = {
    DEFAULT: GraspingVariant(
        says="Kalman filter from the learned Jacobian", estimator=from_learned
    ),
    "kalman": GraspingVariant(
        says="Kalman filter from the paper's guess",
        estimator=lambda _: KalmanEstimator(guessed_network()),
    ),
    "composite": GraspingVariant(
        says="composite law from the paper's guess",
        estimator=lambda _: CompositeEstimator(guessed_network()),
    ),
    "paper": GraspingVariant(
        says="the paper's law from its guess",
        claim="reaches the target, faster than without adaptation (Experiment 2)",
        estimator=lambda _: PaperEstimator(guessed_network()),
    ),
    "fixed": GraspingVariant(
        says="the paper's guess, not adapted",
        claim="reaches the target, slower (Experiment 2)",
        estimator=lambda _: FixedEstimator(guessed_network()),
    ),
    "unadapted": GraspingVariant(
        says="the learned Jacobian, not adapted",
        estimator=lambda learned: FixedEstimator(copy.deepcopy(learned).double()),
    ),
}
"""What can be compared, the default first."""
