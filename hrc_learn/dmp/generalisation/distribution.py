"""A Gaussian over primitives, learned from several demonstrations of one motion."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.dmp.arrays import ArrayLike, to_tensor
from hrc_learn.dmp.fitting.mean import mean_primitive
from hrc_learn.dmp.joint import JointDMP


@dataclass(frozen=True, kw_only=True, eq=False)
class DMPDistribution:
    """Gaussian over the coordinates x = (weights, start velocity, start, goal) of a primitive.

    A motion is linear in its coordinates, y(s) = H(s) x, so it is Gaussian too: means,
    likelihoods and conditioning on via points are closed form. Coordinates of all joints
    vary together, in float64.
    """

    primitive: JointDMP
    """The mean primitive: its spring, basis, duration and names serve all."""
    mean: Float[Tensor, "D M"]
    spread: Float[Tensor, "DM rank"]
    """Square root of the covariance, which has the rank of the demonstrations."""

    @classmethod
    def fit(cls, primitives: JointDMP, slack: float = 0.0) -> "DMPDistribution":
        """Mean and covariance of a batch of primitives.

        Args:
            primitives: Of one motion, fitted with `scaling="none"`.
            slack: Freedom beyond what the demonstrations vary, as in `around`. Without, a via
                point that none of their mixtures passes is approached, not reached.

        Raises:
            ValueError: Fewer than two, or scaled primitives, whose motion is not linear.
        """
        batch = primitives.weights.shape[:-2]
        if batch.numel() < 2 or not batch:
            raise ValueError("a distribution needs a batch of at least 2 primitives")
        x = _coordinates(primitives).flatten(0, -3)
        mean, primitive = x.mean(0), mean_primitive(primitives)
        spread = (x - mean).flatten(1).mT / (len(x) - 1) ** 0.5
        if slack:
            spread = torch.cat([spread, _free_forcing(primitive, slack)], dim=1)
        return cls(primitive=primitive, mean=mean, spread=spread)

    @classmethod
    def around(cls, primitive: JointDMP, slack: float = 1.0) -> "DMPDistribution":
        """One primitive whose forcing may change, for via points without other examples.

        Start, start velocity and goal are certain.

        Args:
            primitive: Without batch dimensions, fitted with `scaling="none"`.
            slack: Standard deviation of the forcing term, alike at all times, in units of the
                force that holds a coordinate away from its goal by the range it covers.
        """
        certain = _coordinates(primitive)
        if certain.ndim != 2:
            raise ValueError(f"needs one primitive, got a batch {tuple(certain.shape[:-2])}")
        return cls(primitive=primitive, mean=certain, spread=_free_forcing(primitive, slack))

    def mean_primitive(self) -> JointDMP:
        """The most likely primitive."""
        return self.primitive.with_coordinates(self.mean)

    def sample(self, n: int, generator: torch.Generator | None = None) -> JointDMP:
        """A batch of n primitives drawn at random."""
        rank = self.spread.shape[1]
        z = torch.randn(n, rank, generator=generator, dtype=torch.float64).to(self.spread)
        return self.primitive.with_coordinates(
            self.mean + (z @ self.spread.mT).unflatten(-1, self.mean.shape)
        )

    def position(self, time: ArrayLike) -> tuple[Float[Tensor, "T D"], Float[Tensor, "T D"]]:
        """Mean and standard deviation of the motion at times [s]."""
        rows, shape = self._rows(time, order=0)
        mean, root = self._observe(rows)
        return mean.view(shape), root.norm(dim=-1).view(shape)

    def condition(
        self, time: ArrayLike, value: ArrayLike, *, noise: float = 1e-6, order: int = 0
    ) -> "DMPDistribution":
        """The distribution, given where the motion passes at some times.

        Args:
            time: Of the via points [s], (n,).
            value: Position there, or velocity for `order` 1, (n, D). NaN leaves a coordinate
                free.
            noise: Standard deviation of each value, in its units.
            order: 0 for via positions, 1 for via velocities, per second.
        """
        rows, shape = self._rows(time, order)
        mean, root = self._observe(rows)
        value = to_tensor(value, dtype=mean.dtype, device=mean.device)
        if value.shape != shape:
            raise ValueError(f"value must have shape {tuple(shape)}, got {tuple(value.shape)}")
        given = ~value.isnan().reshape(-1)
        mean, root = mean[given], root[given]
        # In the coordinates z of the spread, where the Gaussian is a unit one beforehand.
        precision = root.mT @ root / noise**2 + torch.eye(root.shape[1]).to(root)
        factor = torch.linalg.cholesky(precision)
        residual = (value.reshape(-1)[given] - mean) / noise**2
        z = torch.cholesky_solve((root.mT @ residual)[:, None], factor)[:, 0]
        # precision^-1 = L^-T L^-1: L^-T is a square root of what variance is left.
        left = torch.linalg.solve_triangular(factor, self.spread.mT, upper=False).mT
        moved = self.mean + (self.spread @ z).view(self.mean.shape)
        return replace(self, mean=moved, spread=left)

    def log_prob(
        self, time: ArrayLike, position: ArrayLike, *, noise: float
    ) -> Float[Tensor, ""]:
        """Log density of observed positions (n, D) at times (n,), with that sensor noise."""
        rows, shape = self._rows(time, order=0)
        mean, root = self._observe(rows)
        value = to_tensor(position, dtype=mean.dtype, device=mean.device)
        if value.shape != shape:
            raise ValueError(f"position must be {tuple(shape)}, got {tuple(value.shape)}")
        diagonal = torch.full_like(mean, noise**2)
        observed = torch.distributions.LowRankMultivariateNormal(mean, root, diagonal)
        return observed.log_prob(value.reshape(-1))

    def _rows(self, time: ArrayLike, order: int) -> tuple[Tensor, torch.Size]:
        """H at the times, per second if its derivative, and the shape of what it gives."""
        duration = self.primitive.duration.double()
        s = to_tensor(time, dtype=torch.float64, device=duration.device) / duration
        if s.ndim != 1 or not (s >= 0).all() or order not in (0, 1):
            raise ValueError("time must be (n,), none negative, and order 0 or 1")
        H = self.primitive.response.evaluate(s)[:, order] / duration**order
        return H, torch.Size((len(s), self.mean.shape[0]))

    def _observe(self, rows: Float[Tensor, "T M"]) -> tuple[Tensor, Tensor]:
        """Mean (T D) of all joints at all times, and a square root of their covariance."""
        spread = self.spread.view(*self.mean.shape, -1)
        root = torch.einsum("tm,dmr->tdr", rows, spread)
        return (rows @ self.mean.mT).reshape(-1), root.flatten(0, 1)


def _coordinates(primitives: JointDMP) -> Float[Tensor, "*batch D M"]:
    if primitives.scaling != "none":
        raise ValueError(f"scaling {primitives.scaling!r} is not linear: fit with 'none'")
    return primitives.coordinates().detach().double()


def _free_forcing(primitive: JointDMP, slack: float) -> Float[Tensor, "DM DN"]:
    """Spread of weights that are independent and make the forcing vary alike at all times."""
    basis, amplitude = primitive.basis, primitive.amplitude.detach().double()
    D, N = len(amplitude), basis.count
    share = 1 / basis.phase(basis.centre_times().to(amplitude))
    deviation = slack * primitive.spring.stiffness * amplitude[:, None] * share
    spread = torch.zeros(D, N + 3, D, N).to(amplitude)
    spread[:, :N] = torch.diag_embed(deviation.flatten()).view(D, N, D, N)
    return spread.flatten(0, 1).flatten(1)
