"""Learn neurons, noise and prior of an image Jacobian, and measure its held-out errors.

For given neurons, weights and evidence have closed forms. The evidence is the probability of
the demonstrated image motion with the weights integrated out (type-II maximum likelihood;
MacKay 1992, "Bayesian interpolation"). L-BFGS maximises the evidence over neurons, noise and
prior. The error on held-out demonstrations decides when to stop. In this module, a pair
consists of two successive key frames and the motion between them.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from operator import add

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.utils._pytree import tree_map

from hrc_learn import distributed
from hrc_learn.geometry import Pose
from hrc_learn.geometry.numerics import check_settings
from hrc_learn.jacobian.fitting import (
    FOLDS,
    ImageDemonstration,
    ImageJacobianFitConfig,
    MotionSamples,
    RBFCenters,
    RegressionStatistics,
    prior_precision,
    recorded_parts,
    solve,
    statistics_by_fold,
    weight_covariance,
)
from hrc_learn.jacobian.network import RBFImageJacobian
from hrc_learn.jacobian.perspective import fit_camera, unexplained
from hrc_learn.pytree import registered


@dataclass(frozen=True, kw_only=True)
class EvidenceConfig:
    """Stopping rules and scope of the evidence maximisation."""

    rounds: int = 15
    """Largest number of rounds of L-BFGS."""
    iterations: int = 5
    """Number of iterations of L-BFGS in a round."""
    patience: int = 3
    """Number of rounds without a better held-out error after which the learning stops."""
    min_improvement: float = 1e-3
    """Fraction by which the held-out error must fall to count as better."""
    hold_out: int = 4
    """Every n-th demonstration is held out to decide when to stop."""
    max_samples: int = 20_000
    """Largest number of pairs used by a process; they are evenly chosen."""
    learn_centers: bool = True
    """True if the centres are learned; width, noise and prior are always learned."""

    def __post_init__(self) -> None:
        counts = "rounds", "iterations", "patience", "hold_out", "max_samples"
        check_settings(self, positive=counts, not_negative=["min_improvement"])


@dataclass(frozen=True, kw_only=True)
class EvidenceRound:
    """Neurons, noise and prior after a round, and their errors."""

    evidence: float
    """Negative log probability of the image motion in the training pairs, per pair."""
    held_out_error: float
    """Root mean square error over the pairs of held-out demonstrations [px]."""
    neurons: RBFCenters
    """Neurons after the round."""
    config: ImageJacobianFitConfig
    """Noise and prior after the round."""


@dataclass(frozen=True, kw_only=True)
class EvidenceResult:
    """All rounds of an evidence maximisation, and the index of the best round."""

    rounds: tuple[EvidenceRound, ...]
    """State after each round; the first entry is the state before any round."""
    best: int
    """Index of the best round."""

    @property
    def kept(self) -> EvidenceRound:
        """The best round, with the learned neurons, noise and prior."""
        return self.rounds[self.best]


def maximize_evidence(
    demonstrations: Sequence[ImageDemonstration],
    neurons: RBFCenters,
    config: ImageJacobianFitConfig | None = None,
    learning: EvidenceConfig | None = None,
    on_round: Callable[[int, EvidenceRound], None] = lambda number, state: None,
) -> EvidenceResult:
    """Learn neurons, noise and prior for a fit.

    In a distributed run, each process learns from a part of the demonstrations, and all
    processes return the same result.

    Args:
        demonstrations: At least `hold_out` demonstrations, read one by one.
        neurons: Initial neurons.
        config: Initial noise and prior.
        learning: Stopping rules.
        on_round: Called with the number and result of each round.

    Raises:
        ValueError: There are too few demonstrations, or the training or held-out demonstrations
            have no pair of key frames.
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
            break  # a step was too long to evaluate; the best round so far is the result
        rounds.append(model.evaluate(training, held_out))
        on_round(len(rounds) - 1, rounds[-1])
        limit = (1 - learning.min_improvement) * rounds[best].held_out_error
        if rounds[-1].held_out_error < limit:
            best = len(rounds) - 1
    return EvidenceResult(rounds=tuple(rounds), best=best)


class NegativeLogEvidence(nn.Module):
    """Negative log probability of image motion per pair, with the weights integrated out.

    Positive parameters are represented by their logarithms.
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
        """Value for the pairs of all processes together; each process passes its own pairs."""
        total = self.statistics(motion)
        # Variance of a difference of two measurements, each with the same standard deviation.
        noise = 2 * (2 * self.log_noise).exp()
        # Whitened weights, independent with unit variance under the prior, are well scaled.
        prior = weight_covariance(self.centers, self.log_bias.exp(), self.log_weight.exp())
        root = torch.block_diag(*[torch.linalg.cholesky(prior)] * 6)
        cross = root.mT @ total.cross / noise
        eye = torch.eye(len(root), dtype=root.dtype)
        factor = torch.linalg.cholesky(root.mT @ total.gram @ root / noise + eye)
        mean = torch.cholesky_solve(cross, factor)
        misfit = (total.energy / noise - (cross * mean).sum()) / 2
        # There are two image rows with one determinant each, and two coordinates in each pair.
        volume = 2 * factor.diagonal().log().sum() + total.count * (2 * math.pi * noise).log()
        return (misfit + volume) / total.count

    def statistics(self, motion: MotionSamples) -> RegressionStatistics:
        """Statistics of the pairs of all processes, for the present neurons."""
        phi = motion.regressors(self.neurons(attached=True).basis())
        return RegressionStatistics.of(phi, motion.dx).over_processes()

    def neurons(self, *, attached: bool = False) -> RBFCenters:
        """The present neurons; `attached` keeps them in the graph of gradients."""
        centers, width = self.centers, self.log_width.exp()
        if not attached:
            centers, width = centers.detach().clone(), float(width.detach())
        return replace(self._neurons, centers=centers, width=width)

    def fit_config(self) -> ImageJacobianFitConfig:
        """Configuration with the present noise and prior."""
        return replace(
            self._config,
            pixel_noise=float(self.log_noise.detach().exp()),
            bias_std=float(self.log_bias.detach().exp()),
            weight_std=float(self.log_weight.detach().exp()),
        )

    @torch.no_grad()
    def evaluate(self, training: MotionSamples, held_out: MotionSamples) -> EvidenceRound:
        """Evidence of the training pairs, and the error on held-out pairs."""
        config = self.fit_config()
        precision = prior_precision(self.centers, config)
        noise = 2 * config.pixel_noise**2
        weights, _ = solve(self.statistics(training), precision, noise)
        # The weights are fitted to the training pairs alone.
        unseen = self.statistics(held_out)
        error = (unseen.squared_error(weights) / unseen.count) ** 0.5
        return EvidenceRound(
            evidence=float(self(training)),
            held_out_error=error,
            neurons=self.neurons(),
            config=config,
        )


def _motions(
    demonstrations: Sequence[ImageDemonstration],
    config: ImageJacobianFitConfig,
    learning: EvidenceConfig,
) -> tuple[MotionSamples, MotionSamples]:
    """Training pairs and held-out pairs of this process."""
    if len(demonstrations) < learning.hold_out:
        raise ValueError(
            f"every {learning.hold_out}th demonstration is held out, but there are only "
            f"{len(demonstrations)}: record more, or fit without learning the neurons."
        )
    sets: tuple[list[MotionSamples], list[MotionSamples]] = ([], [])
    for i, demonstration in distributed.local_items(demonstrations):
        # i counts all demonstrations, so the choice does not depend on the number of processes.
        is_held_out = (i + 1) % learning.hold_out == 0
        sets[is_held_out].append(demonstration.motion(config))
    training, held_out = (MotionSamples.joined(motions) for motions in sets)
    judged = (training, "training", "learn"), (held_out, "held-out", "judge")
    for motion, name, use in judged:
        if not distributed.sum_over_processes(torch.tensor(len(motion.dx))):
            raise ValueError(
                f"no two visible key frames form a pair in the {name} demonstrations "
                f"(every {learning.hold_out}th is held out): there is nothing to {use} from."
            )
    return training.thinned(learning.max_samples), held_out.thinned(learning.max_samples)


@registered
@dataclass(frozen=True, kw_only=True, eq=False)
class HeldOutSamples:
    """Pairs of key frames; each pair's motion is predicted from other folds of the data."""

    position: Float[Tensor, "pairs 3"]
    """Position of the tool half-way between the two frames [m]."""
    motion: Float[Tensor, "pairs 2"]
    """Motion of the feature [px]."""
    error: Float[Tensor, "pairs 2"]
    """Measured minus predicted motion [px]."""

    def by_cell(self, cells: int = 3) -> CellErrors:
        """Errors over a grid on the horizontal plane.

        Args:
            cells: Number of cells along x and along y, equally wide over the range of the
                pairs.
        """
        x, y = self.position[:, :2].mT.numpy()
        pairs, *edges = np.histogram2d(x, y, cells)

        def total(values: Tensor) -> Tensor:
            return torch.from_numpy(np.histogram2d(x, y, edges, weights=values.numpy())[0])

        error, motion = total(self.error.square().sum(-1)), total(self.motion.square().sum(-1))
        return CellErrors(
            edges=torch.from_numpy(np.stack(edges, axis=-1)),
            pairs=torch.from_numpy(pairs).long(),
            relative=(error / motion).sqrt(),
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class CellErrors:
    """Held-out error in cells of the horizontal plane."""

    edges: Float[Tensor, "cells_and_1 2"]
    """Edges of the cells along x and y [m]."""
    pairs: Int[Tensor, "cells cells"]
    """Number of pairs in each cell, x first."""
    relative: Float[Tensor, "cells cells"]
    """Root mean square error relative to the root mean square motion; NaN in an empty cell."""


def cross_validate(
    demonstrations: Sequence[ImageDemonstration],
    network: RBFImageJacobian,
    config: ImageJacobianFitConfig,
    image_size: tuple[int, int] | None = None,
) -> HeldOutSamples:
    """Predict the motion of every pair by a camera and weights fitted to the other folds.

    In a distributed run, each process predicts all pairs.

    Args:
        demonstrations: Demonstrations to which the network was fitted.
        network: Network as returned by `RBFImageJacobian.fit`, not loaded from a file.
        config: Settings with which the network was fitted.
        image_size: Width and height of the image [px]; needed for a network with a camera.

    Raises:
        ValueError: The network was loaded, fewer than two folds have pairs, or `image_size` is
            missing.
    """
    report = network.report
    if report is None:
        raise ValueError("a loaded network has no fit report: pass the network just fitted.")
    network = copy.deepcopy(network).double()
    basis, precision = network.basis, prior_precision(network.centers, config)
    K, parts = len(network.centers), recorded_parts(demonstrations)
    seen = {i % FOLDS for i in range(len(parts)) if len(parts[i].motion(config).dx)}
    if len(seen) < 2:
        raise ValueError("held-out errors need pairs in at least two folds of the data.")
    pairs: list[HeldOutSamples] = []
    for fold in sorted(seen):
        others, left = [parts[i] for i in range(len(parts)) if i % FOLDS != fold], parts
        if network.camera is not None:
            if image_size is None:
                raise ValueError("image_size is missing: cross-validation fits cameras.")
            camera = fit_camera(others, image_size).camera
            others, left = unexplained(others, camera), unexplained(parts, camera)
        total = reduce(add, statistics_by_fold(basis, K, others, config))
        weights, _ = solve(total, precision, report.noise**2)
        for part, rest in zip(parts[fold::FOLDS], left[fold::FOLDS], strict=True):
            pairs.append(_predicted(part, rest, basis, weights, config))
    return tree_map(lambda *columns: torch.cat(columns), *pairs)


@torch.no_grad()
def _predicted(
    part: ImageDemonstration,
    left: ImageDemonstration,
    basis: Callable[[Pose], Tensor],
    weights: Float[Tensor, "P 2"],
    config: ImageJacobianFitConfig,
) -> HeldOutSamples:
    """Predicted pairs of one demonstration.

    Args:
        part: The demonstration.
        left: The same demonstration; its feature is the pixel minus the camera's prediction.
        basis: Function from poses to activations of the neurons.
        weights: Weights fitted to the other folds.
        config: Choice of key frames.
    """
    motion = left.motion(config)
    return HeldOutSamples(
        position=(motion.before.position + motion.after.position) / 2,
        motion=part.motion(config).dx,
        error=motion.dx - motion.regressors(basis) @ weights,
    )
