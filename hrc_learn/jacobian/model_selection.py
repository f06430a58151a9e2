"""How well held-out image motion is predicted, and the neurons, noise and prior to do it best.

Neurons, noise and prior are chosen by evidence maximisation. For given neurons the weights have
a closed form, and so has the probability of the demonstrated image motion with the weights
integrated out (type-II maximum likelihood; MacKay 1992, "Bayesian interpolation"). L-BFGS
maximises it over everything else. The error on demonstrations held out says when to stop.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.utils._pytree import tree_map

from hrc_learn import distributed
from hrc_learn.geometry import Pose
from hrc_learn.jacobian.fitting import (
    ImageJacobianFitConfig,
    RBFCenters,
    prior_precision,
    solve,
    weight_covariance,
    weights_without_each,
)
from hrc_learn.jacobian.network import RBFImageJacobian
from hrc_learn.jacobian.samples import (
    ImageDemonstration,
    MotionSamples,
    RegressionStatistics,
    component_scale,
    samples_by_fold,
    statistics_by_fold,
)
from hrc_learn.pytree import pytree


@dataclass(frozen=True, kw_only=True)
class EvidenceConfig:
    """How long to maximise the evidence, and over what."""

    rounds: int = 15
    """Rounds of L-BFGS at most."""
    iterations: int = 5
    """Iterations of a round."""
    patience: int = 3
    """Rounds without a better held-out error after which to stop."""
    min_improvement: float = 1e-3
    """Fraction by which the held-out error has to fall to count as better."""
    hold_out: int = 4
    """Every n-th demonstration is held out to decide when to stop."""
    max_samples: int = 20_000
    """Pairs that each process learns from, evenly chosen among its own."""
    learn_centers: bool = True
    """Whether the centres move; widths, noise and prior are always learned."""


@dataclass(frozen=True, kw_only=True)
class EvidenceRound:
    """Neurons, noise and prior after a round, and how good they are."""

    evidence: float
    """Negative logarithm of the probability of the image motion, per pair."""
    held_out_error: float
    """Root mean square over the pairs of demonstrations held out [px]."""
    neurons: RBFCenters
    """As they were then."""
    config: ImageJacobianFitConfig
    """With noise and prior as they were then."""


@dataclass(frozen=True, kw_only=True)
class EvidenceResult:
    """All rounds, of which the best is the result."""

    rounds: tuple[EvidenceRound, ...]
    """The first before anything was learned."""
    best: int
    """Which round the result is of."""

    @property
    def neurons(self) -> RBFCenters:
        """As learned."""
        return self.rounds[self.best].neurons

    @property
    def config(self) -> ImageJacobianFitConfig:
        """With noise and prior as learned."""
        return self.rounds[self.best].config


def maximize_evidence(
    demonstrations: Sequence[ImageDemonstration],
    neurons: RBFCenters,
    config: ImageJacobianFitConfig | None = None,
    learning: EvidenceConfig | None = None,
    on_round: Callable[[int, EvidenceRound], None] = lambda number, state: None,
) -> EvidenceResult:
    """Improve neurons, noise and prior for the fit that follows.

    Of several processes each learns from its share of the demonstrations; all end with the
    same result.

    Args:
        demonstrations: At least as many as `hold_out`; read one by one.
        neurons: To start from.
        config: To start from.
        learning: How long.
        on_round: Told of every round.

    Raises:
        ValueError: Too few demonstrations, or no pair of key frames in one of the two sets.
    """
    config, learning = config or ImageJacobianFitConfig(), learning or EvidenceConfig()
    training, held_out = _motions(demonstrations, config, learning)
    model = NegativeLogEvidence(neurons, config, learning.learn_centers)
    parallel = distributed.data_parallel(model)
    optimiser = torch.optim.LBFGS(
        parallel.parameters(), max_iter=learning.iterations, line_search_fn="strong_wolfe"
    )

    def loss() -> Tensor:
        optimiser.zero_grad()
        value = parallel(training)
        value.backward()
        return value

    rounds = [model.evaluate(training, held_out)]
    on_round(0, rounds[0])
    best = 0
    while len(rounds) <= learning.rounds and len(rounds) - 1 - best < learning.patience:
        try:
            optimiser.step(loss)
        except torch.linalg.LinAlgError:
            break  # a step so long that nothing could be solved: the best so far is kept
        rounds.append(model.evaluate(training, held_out))
        on_round(len(rounds) - 1, rounds[-1])
        limit = (1 - learning.min_improvement) * rounds[best].held_out_error
        if rounds[-1].held_out_error < limit:
            best = len(rounds) - 1
    return EvidenceResult(rounds=tuple(rounds), best=best)


class NegativeLogEvidence(nn.Module):
    """Negative log probability of image motion, per pair, weights integrated out.

    Parameters are logarithms where no optimiser step may make a number negative.
    """

    def __init__(
        self, neurons: RBFCenters, config: ImageJacobianFitConfig, learn_centers: bool
    ):
        super().__init__()
        self._neurons, self._config = neurons, config

        def logarithm(value: float) -> nn.Parameter:
            return nn.Parameter(torch.tensor(math.log(value), dtype=torch.float64))

        self.centers = nn.Parameter(neurons.centers.detach().double(), learn_centers)
        self.log_width = logarithm(float(neurons.width))
        self.log_noise = logarithm(config.pixel_noise)
        self.log_bias = logarithm(config.bias_std)
        self.log_weight = logarithm(config.weight_std)

    def forward(self, motion: MotionSamples) -> Float[Tensor, ""]:
        """Of the pairs of all processes, each given its own."""
        total = self.statistics(motion)
        # Variance of a difference of two measurements, each with this deviation.
        noise = 2 * (2 * self.log_noise).exp()
        # In weights that the prior makes independent and of size one, all is well scaled.
        root = torch.block_diag(*[torch.linalg.cholesky(self._prior())] * 6)
        cross = root.mT @ total.cross / noise
        eye = torch.eye(len(root), dtype=root.dtype)
        factor = torch.linalg.cholesky(root.mT @ total.gram @ root / noise + eye)
        mean = torch.cholesky_solve(cross, factor)
        misfit = (total.energy / noise - (cross * mean).sum()) / 2
        # Two image rows: each has one determinant, and each pair two coordinates.
        volume = 2 * factor.diagonal().log().sum() + total.count * (2 * math.pi * noise).log()
        return (misfit + volume) / total.count

    def statistics(self, motion: MotionSamples) -> RegressionStatistics:
        """Sums over the pairs of all processes, for the neurons as they are."""
        phi = motion.regressors(self.neurons(attached=True).basis())
        return RegressionStatistics.of(phi, motion.dx).over_processes()

    def neurons(self, *, attached: bool = False) -> RBFCenters:
        """As they are; attached: so that gradients reach them."""
        centers, width = self.centers, self.log_width.exp()
        if not attached:
            centers, width = centers.detach().clone(), float(width.detach())
        return replace(self._neurons, centers=centers, width=width)

    def fit_config(self) -> ImageJacobianFitConfig:
        """Noise and prior as they are, with the choice of key frames."""
        return replace(
            self._config,
            pixel_noise=float(self.log_noise.detach().exp()),
            bias_std=float(self.log_bias.detach().exp()),
            weight_std=float(self.log_weight.detach().exp()),
        )

    @torch.no_grad()
    def evaluate(self, training: MotionSamples, held_out: MotionSamples) -> EvidenceRound:
        """Evidence of the training pairs, and the error on pairs held out."""
        config = self.fit_config()
        precision = prior_precision(self.centers, config)
        noise = 2 * config.pixel_noise**2
        weights = solve(self.statistics(training), precision, noise).mean
        # Weights of the training pairs alone predict the others.
        unseen = self.statistics(held_out)
        error = (unseen.squared_error(weights) / unseen.count) ** 0.5
        return EvidenceRound(
            evidence=float(self(training)),
            held_out_error=error,
            neurons=self.neurons(),
            config=config,
        )

    def _prior(self) -> Float[Tensor, "K K"]:
        return weight_covariance(self.centers, self.log_bias.exp(), self.log_weight.exp())


def _motions(
    demonstrations: Sequence[ImageDemonstration],
    config: ImageJacobianFitConfig,
    learning: EvidenceConfig,
) -> tuple[MotionSamples, MotionSamples]:
    """Pairs of this process to learn from, and those held out."""
    if len(demonstrations) < learning.hold_out:
        raise ValueError(
            f"learning holds out every {learning.hold_out}th demonstration, but there are only "
            f"{len(demonstrations)}: record more, or fit with the neurons as they are."
        )
    sets: tuple[list[MotionSamples], list[MotionSamples]] = ([], [])
    for i, demonstration in distributed.share(demonstrations):
        # By the number among all demonstrations, the same however many processes there are.
        is_held_out = (i + 1) % learning.hold_out == 0
        sets[is_held_out].append(demonstration.motion(config))
    for motions in sets:
        pairs = torch.tensor(sum(len(motion.dx) for motion in motions))
        if not distributed.sum_over_processes(pairs):
            raise ValueError(
                "no two visible key frames are within reach of each other in "
                f"{'every ' if motions is sets[1] else 'those but every '}"
                f"{learning.hold_out}th demonstration: there is nothing to "
                f"{'judge' if motions is sets[1] else 'learn'} from."
            )
    training, held_out = (MotionSamples.joined(motions) for motions in sets)
    return training.thinned(learning.max_samples), held_out.thinned(learning.max_samples)


@pytree
@dataclass(frozen=True, kw_only=True, eq=False)
class HeldOutSamples:
    """Pairs of key frames, each predicted without its fold of the data."""

    position: Float[Tensor, "pairs 3"]
    """Of the tool half-way [m]."""
    motion: Float[Tensor, "pairs 2"]
    """Of the image [px]."""
    error: Float[Tensor, "pairs 2"]
    """Motion less its prediction [px]."""
    uncertainty: Float[Tensor, " pairs"]
    """Posterior deviation of the Jacobian there over its size, rotation counted in metres."""

    def by_cell(self, cells: int = 3) -> CellErrors:
        """Errors over a grid on the horizontal plane.

        Args:
            cells: Along each of x and y, equally wide over the range of the pairs.
        """
        place = self.position[:, :2]
        low, high = place.amin(dim=0), place.amax(dim=0)
        edges = torch.stack([torch.linspace(0, 1, cells + 1).double()] * 2, dim=1)
        edges = low + (high - low) * edges
        # Points on the upper edge, and all where nothing moves along an axis, stay inside.
        cell = ((place - low) / (high - low).clamp_min(1e-9) * cells).long().clamp(0, cells - 1)
        flat = cell[:, 0] * cells + cell[:, 1]

        def total(values: Tensor) -> Tensor:
            return torch.zeros(cells**2, dtype=values.dtype).index_add(0, flat, values)

        error, motion = total(self.error.square().sum(-1)), total(self.motion.square().sum(-1))
        pairs = total(torch.ones_like(flat))
        return CellErrors(
            edges=edges,
            pairs=pairs.view(cells, cells),
            relative=(error / motion).sqrt().view(cells, cells),
            uncertainty=(total(self.uncertainty) / pairs).view(cells, cells),
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class CellErrors:
    """Held-out error in cells of the horizontal plane."""

    edges: Float[Tensor, "cells_and_1 2"]
    """Of the cells along x and y [m]."""
    pairs: Int[Tensor, "cells cells"]
    """In each cell, x first."""
    relative: Float[Tensor, "cells cells"]
    """Root mean square of the error over that of the motion; NaN in an empty cell."""
    uncertainty: Float[Tensor, "cells cells"]
    """Mean of the posterior deviation over the Jacobian's size; NaN in an empty cell."""


def cross_validate(
    demonstrations: Sequence[ImageDemonstration],
    network: RBFImageJacobian,
    config: ImageJacobianFitConfig,
) -> HeldOutSamples:
    """Predict every pair with the weights fitted to the other folds of the data.

    Of several processes, each predicts the pairs of its share.

    Args:
        demonstrations: That the network was fitted to.
        network: Just fitted.
        config: Of that fit.

    Raises:
        ValueError: The network was loaded, or there is one fold only.
    """
    report = network.report
    if report is None:
        raise ValueError("only a network just fitted knows what it was fitted with.")
    network = network.double()
    K = len(network.centers)
    folds = statistics_by_fold(network.basis, K, demonstrations, config)
    if sum(fold.count > 0 for fold in folds) < 2:
        raise ValueError("held-out errors need pairs in at least two folds of the data.")
    precision = prior_precision(network.centers, config)
    without = weights_without_each(folds, precision, report.noise**2)
    pairs: list[HeldOutSamples] = []
    with torch.no_grad():
        for fold, motion in samples_by_fold(demonstrations, config):
            pairs.append(
                HeldOutSamples(
                    position=(motion.before.position + motion.after.position) / 2,
                    motion=motion.dx,
                    error=motion.dx - motion.regressors(network.basis) @ without[fold],
                    uncertainty=relative_uncertainty(network, motion.before, config),
                )
            )
    return tree_map(lambda *parts: torch.cat(parts), *pairs)


def relative_uncertainty(
    network: RBFImageJacobian, pose: Pose, config: ImageJacobianFitConfig
) -> Float[Tensor, " pairs"]:
    """Posterior deviation of the Jacobian over its size, rotation counted in metres."""
    scale = component_scale(pose.position, config.rotation_scale)
    size = (network(pose) / scale).flatten(-2).norm(dim=-1)
    # Both image rows have the same deviation, which makes the norm over both sqrt(2) times it.
    deviation = network.uncertainty(pose, config.rotation_scale) / scale
    return 2**0.5 * deviation.norm(dim=-1) / size
