"""Gaussian mixtures over time and position in several frames, and kernelized primitives.

Task-parameterized mixtures follow Calinon (2016), "A tutorial on task-parameterized movement
learning and retrieval"; kernelized movement primitives follow Huang et al. (2019), "Kernelized
movement primitives", for positions. Both are short implementations for comparison: no package
in a registry provides them.
"""

from dataclasses import dataclass

import numpy as np

type Array = np.ndarray

EM_STEPS = 100
"""Largest number of steps of expectation maximization."""
SETTLED = 1e-4
"""Increase of the mean log-likelihood below which expectation maximization ends."""


@dataclass(frozen=True)
class TaskMixture:
    """Mixture of K Gaussians over V = 1 + D variables, time and position, in P frames."""

    prior: Array
    """(K,)."""
    mean: Array
    """(K, P, V)."""
    covariance: Array
    """(K, P, V, V)."""

    @classmethod
    def fit(cls, samples: Array, count: int, ridge: float) -> "TaskMixture":
        """Expectation maximization, from components that divide the time evenly.

        Args:
            samples: Time and position of each sample in each frame, (N, P, V).
            count: Number K of components.
            ridge: Added to the variances, in the units of the samples squared.
        """
        time = samples[:, 0, 0]
        edges = np.linspace(time.min(), time.max(), count + 1)[1:-1]
        share = np.eye(count)[np.digitize(time, edges)]
        mixture, before = cls._weighted(samples, share, ridge), -np.inf
        for _ in range(EM_STEPS):
            joint = np.log(mixture.prior) + mixture._log_density(samples).sum(2)
            total = np.logaddexp.reduce(joint, axis=1)
            mixture = cls._weighted(samples, np.exp(joint - total[:, None]), ridge)
            if total.mean() - before < SETTLED:
                break
            before = total.mean()
        return mixture

    @classmethod
    def _weighted(cls, samples: Array, share: Array, ridge: float) -> "TaskMixture":
        """Moments of the samples, of which component k has the fraction share[:, k]."""
        sums = share.sum(0) + 1e-12  # a component may lose all of its samples
        mean = np.einsum("nk,npv->kpv", share, samples) / sums[:, None, None]
        off = samples[:, None] - mean
        covariance = np.einsum("nk,nkpv,nkpw->kpvw", share, off, off)
        covariance /= sums[:, None, None, None]
        return cls(sums / sums.sum(), mean, covariance + ridge * np.eye(samples.shape[-1]))

    def _log_density(self, samples: Array) -> Array:
        """Log-density of each sample, component and frame, (N, K, P)."""
        root = np.linalg.cholesky(self.covariance)
        off = np.moveaxis(samples[:, None] - self.mean, 0, -1)
        white = np.linalg.solve(root, off)
        scale = np.log(np.diagonal(root, axis1=-2, axis2=-1)).sum(-1)
        constant = samples.shape[-1] * np.log(2 * np.pi) / 2
        return np.moveaxis(-(white**2).sum(-2) / 2 - scale[..., None] - constant, -1, 0)

    def at(self, origins: Array) -> "TaskMixture":
        """Mixture in the world, one frame, for frames with the axes of the world.

        Each component is the product of its Gaussians in all frames (Calinon 2016, eq. 6).

        Args:
            origins: Origin of each frame, (P, D).
        """
        mean = self.mean + np.pad(origins, ((0, 0), (1, 0)))
        precision = np.linalg.inv(self.covariance)
        covariance = np.linalg.inv(precision.sum(1))
        product = np.einsum("kvw,kpwu,kpu->kv", covariance, precision, mean)
        return TaskMixture(self.prior, product[:, None], covariance[:, None])

    def regress(self, time: Array) -> tuple[Array, Array]:
        """Position given the time: means (T, D) and covariances (T, D, D); one frame."""
        mean, covariance = self.mean[:, 0], self.covariance[:, 0]
        variance, gain = covariance[:, 0, 0], covariance[:, 1:, 0] / covariance[:, :1, 0]
        off = time[:, None] - mean[:, 0]
        share = np.log(self.prior) - (off**2 / variance + np.log(variance)) / 2
        share = np.exp(share - np.logaddexp.reduce(share, axis=1, keepdims=True))
        each = mean[:, 1:] + off[..., None] * gain  # (T, K, D)
        found = np.einsum("tk,tkd->td", share, each)
        inner = covariance[:, 1:, 1:] - gain[..., None] * covariance[:, None, 0, 1:]
        around = each - found[:, None]
        spread = np.einsum("tk,tkd,tke->tde", share, around, around)
        return found, spread + np.einsum("tk,kde->tde", share, inner)


@dataclass(frozen=True)
class KernelPrimitive:
    """Kernelized movement primitive: a Gaussian process around reference points.

    xi(t) = k(t) (K + lambda Sigma)^-1 mu    (Huang et al. 2019, eq. 20)
    """

    time: Array
    """Times of the reference, (N,)."""
    mean: Array
    """(N, D)."""
    covariance: Array
    """(N, D, D)."""
    width: float
    """Width of the Gaussian kernel, in the unit of the time."""
    penalty: float
    """lambda."""

    def through(self, time: Array, position: Array, variance: float) -> "KernelPrimitive":
        """The same primitive with the reference `position` (M, D) at these times (M,)."""
        index = np.abs(self.time[:, None] - time).argmin(0)
        times, mean, covariance = self.time.copy(), self.mean.copy(), self.covariance.copy()
        times[index], mean[index] = time, position
        covariance[index] = variance * np.eye(mean.shape[1])
        return KernelPrimitive(times, mean, covariance, self.width, self.penalty)

    def position(self, time: Array) -> Array:
        """Mean at these times, (T, D)."""
        n, D = self.mean.shape
        system = np.einsum("ij,de->idje", self._kernel(self.time), np.eye(D))
        system[range(n), :, range(n)] += self.penalty * self.covariance
        weights = np.linalg.solve(system.reshape(n * D, n * D), self.mean.ravel())
        return self._kernel(time) @ weights.reshape(n, D)

    def _kernel(self, time: Array) -> Array:
        """Kernel of these times and the reference, (T, N)."""
        return np.exp(-(((time[:, None] - self.time) / self.width) ** 2) / 2)
