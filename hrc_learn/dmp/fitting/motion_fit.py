"""The fit of a primitive: options, steps, and arguments of the resulting linear primitive."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, TypedDict

from jaxtyping import Float
from torch import Tensor

from hrc_learn.dmp._system.bases import Basis, GaussianBasis
from hrc_learn.dmp._system.response import Response, response_of
from hrc_learn.dmp._system.spring import SpringDamper
from hrc_learn.dmp._system.trajectory import Trajectory
from hrc_learn.dmp.fitting.noise import smoothed, warn_of_few_samples, without_outliers
from hrc_learn.dmp.fitting.samples import FitReport, Samples
from hrc_learn.dmp.fitting.solvers import REGULARIZATION, fit_samples
from hrc_learn.dmp.forcing_scale import Demonstrated, NoScaling, Scaling

DEFAULT_COUNT = 50
"""Default number of basis functions: they follow recordings of arms to 5e-5 of the range, and
fewer would not make a motion without noise smoother."""


class FitOptions(TypedDict, total=False):
    """Options that `fit` of every kind of primitive accepts; see `fit_motion`."""

    method: str
    """`"trajectory"` (default), least squares on the positions, the closest reproduction;
    `"ridge"`, regression on the force; `"lwr"`, the paper's method."""
    robust: str | None
    """Loss that reduces the weight of outliers, `"huber"` or `"tukey"`; None (default): all
    samples have equal weight."""
    approach: float | int
    """Fraction of the motion, 0 to 1, over which it moves smoothly to a new start and goal;
    0 (default): at once, as in the paper."""
    basis: Basis | None
    """Basis of the forcing term; `n_basis` Gaussians by default."""
    spring: SpringDamper | None
    """Gains; alpha = 25, critically damped, by default."""
    regularization: float
    """Ridge, relative to the largest singular value; 1e-7 by default."""
    smooth: bool | None
    """True to remove noise from the samples first, as much as they give evidence of; see
    `fitting/noise.py`. None (default): unless the number of basis functions is given."""


@dataclass(frozen=True, kw_only=True, eq=False)
class MotionFit:
    """Fit to a flat batch of demonstrations, in float64."""

    response: Response
    """Response of the spring and the basis."""
    samples: Samples
    """Fitted samples: without noise and outliers, if these were removed."""
    noisy: Samples
    """Samples before noise was removed."""
    noise: Float[Tensor, "B D"] | None
    """Standard deviation of the noise; None without smoothing."""
    trust: Float[Tensor, "B D T"] | None
    """Weight of each recorded sample, 0 to 1; None without a robust loss."""
    weights: Float[Tensor, "B D N"]
    """Weights of the unscaled forcing term."""
    rate: Float[Tensor, "B D"]
    """Start velocity dy/ds."""

    def arguments(self, scaling: Scaling, names: Sequence[str] | None) -> dict[str, Any]:
        """Arguments of a `LinearPrimitive`, in the shape and dtype of the demonstrations.

        Args:
            scaling: Scaling of the forcing term.
            names: Names of the coordinates, for error messages.

        Raises:
            ValueError: A motion for which the scaling is singular.
        """
        samples = self.samples
        s = samples.s[0] if samples.shared_grid else samples.s.view(*samples.batch, -1)
        return {
            "weights": self._batched(self._unscaled(scaling, names)),
            "start": self._batched(samples.first),
            "goal": self._batched(samples.last),
            "start_velocity": self._batched(self.rate / samples.duration[:, None]),
            "duration": self._batched(samples.duration),
            "amplitude": self._batched(samples.amplitude),
            "timestamps": s,
            "basis": self.response.basis,
            "spring": self.response.spring,
            "scaling": scaling,
            "approach": self.response.approach,
        }

    def _unscaled(
        self, scaling: Scaling, names: Sequence[str] | None
    ) -> Float[Tensor, "B D N"]:
        if isinstance(scaling, NoScaling):
            return self.weights
        samples, noisy = self.samples, self.noisy
        ends = (samples.first, samples.last, samples.amplitude)
        shown = Demonstrated(*(x.double() for x in ends))
        scaling.check(shown, samples.batch, names)
        if noisy is not samples:
            # Noise, or its removal, may separate a start and a goal that agree.
            first, last = noisy.first.double(), noisy.last.double()
            scaling.check(Demonstrated(first, last, shown.amplitude), samples.batch, names)
        return scaling.unscale(self.weights.mT, shown).mT

    def report(self, motion: Trajectory) -> FitReport:
        """Residuals of a motion at all samples, noise included, and its peaks."""
        trust = None if self.trust is None else self._batched(self.trust).mT
        report = self.noisy.compare(motion.position, trust)
        if self.noise is None:
            return report
        return replace(
            report,
            noise=self._batched(self.noise),
            peak_acceleration=motion.acceleration.abs().amax(-2),
            peak_jerk=motion.jerk.abs().amax(-2),
        )

    def _batched(self, values: Tensor) -> Tensor:
        samples = self.samples
        values = values.to(samples.position.dtype)
        return values.reshape(samples.batch + values.shape[1:]) if samples.batch else values[0]


def fit_motion(
    samples: Samples,
    n_basis: int | None,
    *,
    method: str = "trajectory",
    robust: str | None = None,
    approach: float | int = 0.0,
    basis: Basis | None = None,
    spring: SpringDamper | None = None,
    regularization: float = REGULARIZATION,
    smooth: bool | None = None,
) -> MotionFit:
    """Fit weights and start velocity; arguments as in `FitOptions`.

    Raises:
        ValueError: Unknown option.
    """
    chosen = n_basis is not None or basis is not None
    if smooth is None:
        smooth = not chosen
    if basis is None:
        basis = GaussianBasis(count=DEFAULT_COUNT if n_basis is None else n_basis)
    if chosen:
        warn_of_few_samples(samples, basis.count)
    response = response_of(spring or SpringDamper(), basis, float(approach))
    trust = noise = None
    if robust is not None:
        samples, trust = without_outliers(robust, response, samples, regularization)
    noisy = samples
    if smooth:
        samples, noise = smoothed(samples)
    weights, rate = fit_samples(method, response, samples, regularization)
    return MotionFit(
        response=response,
        samples=samples,
        noisy=noisy,
        noise=noise,
        trust=trust,
        weights=weights,
        rate=rate,
    )
