"""A primitive that goes on learning while samples come in.

Recursive least squares with exponential forgetting (Ljung 1999, "System identification",
section 11.2), as a square root: what is known of the weights is a triangular factor, and a
sample is one more row of it, so that no covariance has to stay positive (Golub and Van Loan
2013, section 6.5). The weights are those of a batch fit to all samples, weighted by their age.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.dmp._arguments import Points, Times, finite, to_tensor
from hrc_learn.dmp._fitting import REGULARIZATION
from hrc_learn.dmp._shared_fit import LeastSquares
from hrc_learn.dmp._system.bases import balanced_units
from hrc_learn.dmp.forcing_scale import Demonstrated
from hrc_learn.dmp.joint_dmp import JointDMP
from hrc_learn.dmp.motion_primitive import FINE


@dataclass(frozen=True, eq=False)
class OnlineFit:
    """Weights that follow samples of a motion; start, goal and duration stay as they are.

    minimise over w  sum_k forgetting^(n - k) |y_k - y(s_k; w)|^2
                     + forgetting^n prior mean over s of |y(s; w) - y(s; w_0)|^2

    with y(s; w) the motion of the primitive that it began with and weights w. So that motion
    counts as `prior` samples, evenly spread over it, which are forgotten as the others are.
    """

    base: JointDMP
    """What it began with."""
    problem: LeastSquares
    """Of the change of the weights, those of the scaled forcing term."""

    @classmethod
    def begin(cls, dmp: JointDMP, prior: float | int = 10.0) -> "OnlineFit":
        """Know what a primitive knows.

        Args:
            dmp: A single primitive.
            prior: How many samples its motion counts for; more keep it the longer.

        Raises:
            ValueError: A batch, or a prior that is not positive.
        """
        if dmp.weights.ndim != 2:
            raise ValueError(
                f"samples change one primitive, got a batch {tuple(dmp.weights.shape[:-2])}"
            )
        if not prior > 0:
            raise ValueError(f"prior must be positive, but is {prior}")
        D, N = dmp.weights.shape
        s = _even(dmp)
        rows = dmp.response.evaluate(s)[:, 0, :N] * (prior / len(s)) ** 0.5
        nothing = LeastSquares.empty(N, D)
        return cls(dmp, nothing.with_rows(rows, rows.new_zeros(len(s), D)))

    def with_samples(
        self, time: Times, position: Points, forgetting: float | int = 1.0
    ) -> "OnlineFit":
        """What is known after some samples more.

        Args:
            time: Since the start of the motion [s], (n,), in the order in which samples came.
            position: (n, D).
            forgetting: Factor on all that was known, at each sample, above 0 to 1; what
                1 / (1 - forgetting) samples say counts.

        Raises:
            ValueError: Other shapes, numbers that are not finite, negative times.
        """
        base, D = self.base, self.base.weights.shape[0]
        time = to_tensor(time, torch.float64, base.start.device)
        position = to_tensor(position, torch.float64, base.start.device)
        if time.ndim != 1 or position.shape != (len(time), D):
            raise ValueError(
                f"time and position must be (n,) and (n, {D}), got {tuple(time.shape)} and "
                f"{tuple(position.shape)}"
            )
        if not 0 < forgetting <= 1:
            raise ValueError(f"forgetting must be above 0 and at most 1, but is {forgetting}")
        finite("position", position)
        s = base.normalised_time(time, base.duration)
        with torch.no_grad():
            missed = position - base.rollout(time).position.double()
        rows = base.response.evaluate(s)[:, 0, : base.basis.count]
        age = torch.arange(len(time) - 1, -1, -1, dtype=torch.float64, device=rows.device)
        share = (forgetting**0.5) ** age[:, None]
        before = LeastSquares(
            self.problem.factor * forgetting ** (len(time) / 2),
            self.problem.unknowns,
            self.problem.rows,
        )
        return OnlineFit(base, before.with_rows(share * rows, share * missed))

    @property
    def primitive(self) -> JointDMP:
        """With the weights that follow from what is known."""
        base = self.base
        with torch.no_grad():
            ends = base.start.double(), base.goal.double()
            shown = Demonstrated(*ends, base.amplitude.double())
            weights = base.forcing_scale.scale(base.weights.double().mT, *ends, shown)
            unit = balanced_units(base.basis, self.problem.design, others=0)
            weights = weights + self.problem.solve(REGULARIZATION, unit)
            weights = base.forcing_scale.unscale(weights, shown).mT
            coordinates = base.coordinates().double()
            x = torch.cat([weights, coordinates[:, base.basis.count :]], dim=-1)
        return base.with_motion(base.with_coordinates(x))


def _even(dmp: JointDMP) -> Float[Tensor, "n"]:
    """Normalised times that stand for all of a motion."""
    count = FINE * dmp.basis.count + 1
    return torch.linspace(0, 1, count, dtype=torch.float64, device=dmp.start.device)
