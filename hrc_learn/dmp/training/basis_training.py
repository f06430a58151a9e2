"""Learning where the functions of a basis stand, how wide they are, and the gain.

Weights and start velocity are always those that fit best, in closed form, and gradients flow
through that fit (variable projection; Golub and Pereyra 1973). What is left to learn is of
the size of the basis, and no step has to keep weights and places in tune.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from hrc_learn.dmp._arguments import Mask, Points, Times, check_samples
from hrc_learn.dmp._system.bases import LearnedGaussianBasis, placed_activation
from hrc_learn.dmp._system.closed_forms import (
    ExponentialPhase,
    Phase,
    SpringDamper,
    approach_state,
    transition,
)
from hrc_learn.dmp._system.response import accumulate, impulse
from hrc_learn.dmp.joint_dmp import JointDMP
from hrc_learn.dmp.training.weight_training import (
    DescentConfig,
    Progress,
    TrainingResult,
    check_learnable,
    descend,
)

LEARNABLE = ("centres", "widths", "gain")
POINTS = 6
"""Of quadrature between two samples, which lie closer than the table's pieces."""
NARROWEST, WIDEST = 0.3, 1.5
"""Widths as shares of the distance to the neighbours: between spikes and all alike."""
SMALLEST_GAP = 0.1
"""Of two centres, as a share of the mean one."""
GAIN_RANGE = 4.0
"""Factor by which alpha may grow or fall."""
USUAL_WIDTH = 0.6
"""Where widths begin: that of a `GaussianBasis`."""


def learn_basis(
    time: Times,
    position: Points,
    n_basis: int = 20,
    *,
    learn: Sequence[str] = ("centres", "widths"),
    mask: Mask | None = None,
    held_out: int = 5,
    spring: SpringDamper | None = None,
    phase: Phase | None = None,
    approach: float = 0.0,
    regularization: float = 1e-7,
    config: DescentConfig | None = None,
    progress: Progress | None = None,
    **fit_arguments: Any,
) -> TrainingResult[JointDMP]:
    """Fit a primitive whose basis, or gain, is learned along with its weights.

    A batch of demonstrations shares one basis. Equally spaced functions are the beginning.
    Learning the gain keeps the ratio beta / alpha, so that the damping stays as it is and
    the spring stable whatever is learned.

    Args:
        time: Timestamps [s], (T,) or (*B, T).
        position: (T, D) or (*B, T, D).
        n_basis: N.
        learn: Some of `"centres"`, `"widths"`, `"gain"`.
        mask: (*B, T), false where a sample does not count.
        held_out: Every so many-th sample is not fitted while learning, and decides what is
            best and when to stop; 0: none, the fitted ones do.
        spring: Gains at first.
        phase: Canonical system.
        approach: As for `JointDMP.fit`.
        regularization: Ridge, relative to the largest singular value.
        config: How far and how long.
        progress: Called after each step with its number and the best criterion.
        fit_arguments: More of `JointDMP.fit`, which makes the primitive in the end.

    Raises:
        ValueError: Bad samples (says which) or unknown names.
    """
    check_learnable(learn, LEARNABLE)
    samples = check_samples(time, position, mask=mask)
    placement = Placement(n_basis, spring or SpringDamper(), phase or ExponentialPhase())
    # Relative to what the motions cover, so that tolerances mean the same for all.
    scale = samples.span.amax().double()
    demos = [
        Demo.of(s[valid], (y[:, valid].mT / scale).double(), held_out)
        for s, y, valid in zip(samples.s, samples.position.double(), samples.mask, strict=True)
    ]

    def objective() -> tuple[Tensor, Tensor]:
        errors = [
            projection_error(placement.design(d.s, approach), d, regularization) for d in demos
        ]
        fitted, held = (torch.stack(x).mean() for x in zip(*errors, strict=True))
        return fitted.log(), held.detach().sqrt()

    parameters = [placement.get_parameter(name) for name in learn]
    history = descend(parameters, objective, config or DescentConfig(), progress)
    dmp = JointDMP.fit(
        time,
        position,
        mask=mask,
        basis=placement.basis(),
        spring=placement.spring(),
        approach=approach,
        regularization=regularization,
        **fit_arguments,
    )
    return TrainingResult(dmp=dmp, history=history)


class Placement(nn.Module):
    """Centres, widths and gain that no step of an optimiser can make impossible."""

    def __init__(self, count: int, spring: SpringDamper, phase: Phase):
        """Begin with equally spaced functions.

        Args:
            count: N, at least 2.
            spring: Gains at first.
            phase: Fades the forcing term.
        """
        super().__init__()
        self.count, self.initial, self.phase = count, spring, phase
        self.centres = nn.Parameter(torch.zeros(count - 1, dtype=torch.float64))
        """Logits of the gaps between centres."""
        share = math.log(USUAL_WIDTH / NARROWEST) / math.log(WIDEST / NARROWEST)
        logit = math.log(share / (1 - share))
        self.widths = nn.Parameter(torch.full((count,), logit, dtype=torch.float64))
        """Logits of widths between the narrowest and the widest."""
        self.gain = nn.Parameter(torch.zeros((), dtype=torch.float64))
        """Of alpha, likewise."""

    def placed(self) -> tuple[Float[Tensor, "N"], Float[Tensor, "N"]]:
        """Centres from 0 to 1, and widths."""
        # The gaps sum to one whatever the logits are.
        floor = SMALLEST_GAP / (self.count - 1)
        gaps = floor + (1 - SMALLEST_GAP) * torch.softmax(self.centres, dim=0)
        centres = torch.cat([gaps.new_zeros(1), gaps.cumsum(0)])
        around = torch.cat([gaps[:1], (gaps[1:] + gaps[:-1]) / 2, gaps[-1:]])
        ratio = NARROWEST * (WIDEST / NARROWEST) ** torch.sigmoid(self.widths)
        return centres, ratio * around

    def alpha(self) -> Float[Tensor, ""]:
        """Positive, so that the spring is stable."""
        # Bounded both ways, and unchanged at zero.
        return self.initial.alpha * GAIN_RANGE ** torch.tanh(self.gain)

    def basis(self) -> LearnedGaussianBasis:
        """As learned."""
        centres, widths = (tuple(x.tolist()) for x in self.placed())
        return LearnedGaussianBasis(centres=centres, widths=widths, phase=self.phase)

    def spring(self) -> SpringDamper:
        """As learned, the damping as at first."""
        alpha = self.alpha().item()
        return SpringDamper(alpha=alpha, beta=alpha * self.initial.beta / self.initial.alpha)

    def design(self, s: Float[Tensor, "T"], approach: float) -> Float[Tensor, "T M"]:
        """`Response` of positions at increasing times from 0, differentiable in all learned."""
        centres, widths = self.placed()
        alpha, ratio = self.alpha(), self.initial.beta / self.initial.alpha

        def propagate(s: Tensor) -> Tensor:
            return transition(s, alpha, ratio)

        def forcing(s: Tensor) -> Tensor:
            return placed_activation(s, centres, widths) * self.phase(s)[..., None]

        shares = impulse(propagate, forcing, s[:-1], s.diff(), POINTS)
        forced = accumulate(propagate, s, shares)[:, 0]
        E = propagate(s)[:, 0]
        start = -approach_state(s, approach)[:, :1] if approach else E[:, :1]
        return torch.cat([forced, E[:, 1:], start, 1 - start], dim=1)


@dataclass(frozen=True, eq=False)
class Demo:
    """A demonstration in normalised time, relative to what all cover."""

    s: Float[Tensor, "T"]
    y: Float[Tensor, "T D"]
    fitted: Bool[Tensor, "T"]

    @classmethod
    def of(cls, s: Float[Tensor, "T"], y: Float[Tensor, "T D"], held_out: int) -> "Demo":
        """Hold every so many-th sample out; none if `held_out` is 0."""
        index = torch.arange(len(s))
        held = (index % held_out == held_out // 2) if held_out else torch.zeros_like(index)
        return cls(s, y, ~held.bool())


def projection_error(
    H: Float[Tensor, "T M"], demo: Demo, regularization: float
) -> tuple[Float[Tensor, ""], Float[Tensor, ""]]:
    """Mean squared error of the best fit, on fitted samples and on those held out.

    Start and goal are the first and the last sample; weights and start velocity are those of
    least squares with a ridge in units in which all act alike, as in `JointDMP.fit`.
    """
    wanted = demo.y - H[:, -2:-1] * demo.y[0] - H[:, -1:] * demo.y[-1]
    A = H[:, :-2] / H[:, :-2].detach().norm(dim=0)
    ridge = (
        regularization * torch.linalg.matrix_norm(A.detach(), 2) * torch.eye(A.shape[1]).to(A)
    )
    # QR of the stacked system: A'A would square its condition number.
    Q, R = torch.linalg.qr(torch.cat([A[demo.fitted], ridge]))
    target = Q[: -len(ridge)].mT @ wanted[demo.fitted]
    error = wanted - A @ torch.linalg.solve_triangular(R, target, upper=True)
    square = error.square().sum(1)
    fitted = square[demo.fitted].mean()
    return fitted, fitted if demo.fitted.all() else square[~demo.fitted].mean()
