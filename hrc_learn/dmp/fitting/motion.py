"""The fit of a linear primitive, from checked samples to its numbers."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from hrc_learn.dmp.fitting.methods import fit_samples
from hrc_learn.dmp.fitting.robust import tame_outliers
from hrc_learn.dmp.fitting.samples import Samples
from hrc_learn.dmp.system.basis import Basis, GaussianBasis
from hrc_learn.dmp.system.response import Response, response_of
from hrc_learn.dmp.system.spring import SpringDamper


@dataclass(frozen=True, kw_only=True, eq=False)
class MotionFit:
    """What was fitted to a flat batch of demonstrations, in float64."""

    response: Response
    """Of the spring and the basis."""
    samples: Samples
    """Those fitted: as recorded, but for outliers of a robust fit."""
    trust: Float[Tensor, "B D T"] | None
    """In each recorded sample, 0 to 1; None: whole in all."""
    weights: Float[Tensor, "B D N"]
    """Of the unscaled forcing term."""
    rate: Float[Tensor, "B D"]
    """Start velocity dy/ds."""


def fit_motion(
    samples: Samples,
    n_basis: int,
    *,
    method: str = "trajectory",
    robust: str | None = None,
    approach: float | int = 0.0,
    basis: Basis | None = None,
    spring: SpringDamper | None = None,
    regularization: float = 1e-7,
) -> MotionFit:
    """Fit weights and start velocity; arguments as in `FitOptions`.

    Raises:
        ValueError: An option that there is not.
    """
    basis, spring = basis or GaussianBasis(count=n_basis), spring or SpringDamper()
    response = response_of(spring, basis, float(approach))
    trust = None
    if robust is not None:
        samples, trust = tame_outliers(robust, response, samples, regularization)
    weights, rate = fit_samples(method, response, samples, regularization)
    return MotionFit(
        response=response, samples=samples, trust=trust, weights=weights, rate=rate
    )
