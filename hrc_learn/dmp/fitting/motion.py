"""The fit of a linear primitive, from checked samples to its numbers."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.dmp.fitting.methods import fit_samples
from hrc_learn.dmp.fitting.report import FitReport
from hrc_learn.dmp.fitting.robust import tame_outliers
from hrc_learn.dmp.fitting.samples import Samples
from hrc_learn.dmp.scaling import Demonstrated, Scaling
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

    def arguments(self, scaling: Scaling, names: Sequence[str] | None) -> dict[str, Any]:
        """What a `JointDMP` is put together from, in the demonstrations' shape and dtype.

        Raises:
            ValueError: A scaling that a motion forbids; `names` are those of its coordinates.
        """
        samples = self.samples
        # One where a coordinate never moves: nothing to scale, and nothing to divide by.
        amplitude = torch.where(samples.span > 0, samples.span, 1.0)
        shown = Demonstrated(*(x.double() for x in (samples.first, samples.last, amplitude)))
        scaling.check(shown, samples.batch, names)
        return {
            "weights": self._batched(scaling.unscale(self.weights.mT, shown).mT),
            "start": self._batched(samples.first),
            "goal": self._batched(samples.last),
            "start_velocity": self._batched(self.rate / samples.duration[:, None]),
            "duration": self._batched(samples.duration),
            "amplitude": self._batched(amplitude),
            "stamps": samples.s[0] if samples.shared else samples.s.view(*samples.batch, -1),
            "basis": self.response.basis,
            "spring": self.response.spring,
            "scaling": scaling,
            "approach": self.response.approach,
        }

    def report(self, reproduction: Float[Tensor, "*batch T D"]) -> FitReport:
        """Residuals of a motion, at all samples."""
        trust = None if self.trust is None else self._batched(self.trust).mT
        return self.samples.compare(reproduction.mT.reshape(self.samples.position.shape), trust)

    def _batched(self, values: Tensor) -> Tensor:
        samples = self.samples
        return values.to(samples.position.dtype).reshape(samples.batch + values.shape[1:])


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
