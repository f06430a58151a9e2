"""A motion seen from several frames: of the object that is left, of the place that is reached.

Demonstrations are looked at from each frame, in which they agree where that frame matters. For
frames elsewhere the Gaussians of all of them are brought there and multiplied, as in
task-parameterised models (Calinon 2016, "A tutorial on task-parameterized movement learning
and retrieval", eqs. 5 and 6), here over the coordinates of a primitive, that is over whole
motions, instead of moment by moment: what deviates at the start goes on to deviate. What comes
out is a primitive like any other.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Unpack

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.dmp._arguments import Mask, Points, Times, check_samples, padded
from hrc_learn.dmp._fitting import REGULARIZATION, FitOptions, fit_samples
from hrc_learn.dmp.joint_dmp import JointDMP
from hrc_learn.dmp.motion_primitive import FINE
from hrc_learn.dmp.probabilistic_dmp import ProbabilisticDMP, mean_primitive
from hrc_learn.geometry import Pose, quaternion

PERSISTENCE = 0.3
"""Share of a motion along which deviations that no demonstration showed persist; of made-up
ones (see docs/dmp.md) 0.1 leads to more than twice the error."""
MODES = 12
"""Of such deviations: the next one has 1e-6 of the variance."""
FREEDOM = 1e-3
"""Of each coordinate, independent of all others, in its standard deviations over all frames: so
that whatever frames agree on can be inverted. Weights that free move nothing visibly."""


@dataclass(frozen=True, eq=False)
class Frames:
    """F frames that a motion may belong to: y = A y_in_frame + b.

    A may be any invertible matrix. Columns that belong to no place, such as an opening, have a
    one on its diagonal and zero in b.
    """

    A: Float[Tensor, "*batch F D D"]
    b: Float[Tensor, "*batch F D"]

    def __post_init__(self):
        if self.A.shape != (*self.b.shape, self.b.shape[-1]) or self.b.ndim < 2:
            raise ValueError(
                f"frames must have A (..., F, D, D) and b (..., F, D), got "
                f"{tuple(self.A.shape)} and {tuple(self.b.shape)}"
            )

    @staticmethod
    def of(*poses: Pose) -> "Frames":
        """Frames of positions in space, from poses of (*batch) each."""
        A = torch.stack([quaternion.to_matrix(pose.orientation) for pose in poses], dim=-3)
        return Frames(A, torch.stack([pose.position for pose in poses], dim=-2))

    def inwards(self, x: Float[Tensor, "*batch D M"]) -> Float[Tensor, "*batch F D M"]:
        """Coordinates of primitives as seen from each frame."""
        x = x[..., None, :, :].to(self.A)
        return torch.linalg.solve(self.A, x - self._placed(x.shape[-1]))

    def outwards(self, x: Float[Tensor, "F D M"]) -> Float[Tensor, "*batch F D M"]:
        """The inverse: those of a primitive in each frame, where the frames are."""
        return self.A @ x + self._placed(x.shape[-1])

    def _placed(self, M: int) -> Float[Tensor, "*batch F D M"]:
        """What b adds to: start and goal, the last two coordinates."""
        return torch.nn.functional.pad(self.b[..., None].expand(*self.b.shape, 2), (M - 2, 0))


@dataclass(frozen=True, kw_only=True, eq=False)
class FramedDMP:
    """A Gaussian over the coordinates of a primitive as seen from each of F frames (float64).

    x = (weights, start velocity, start, goal) as in `ProbabilisticDMP`. Its covariance is that
    of n demonstrations, and that of smooth deviations in any direction, as large as those seen,
    which counts for one more.
    """

    primitive: JointDMP
    """Its spring, basis, duration and names serve all."""
    mean: Float[Tensor, "F D M"]
    precision: Float[Tensor, "F DM DM"]
    """Inverse covariance."""

    @classmethod
    def fit(
        cls,
        time: Times | Sequence[Times],
        position: Points | Sequence[Points],
        frames: Frames,
        n_basis: int | None = None,
        mask: Mask | None = None,
        *,
        tolerance: float | None = None,
        joint_names: Sequence[str] | None = None,
        units: str = "m",
        **options: Unpack[FitOptions],
    ) -> "FramedDMP":
        """Learn from demonstrations between frames that are elsewhere in each.

        Args:
            time: [s], (T,), (n, T) or a list of (T_i,).
            position: (n, T, D) or a list of (T_i, D).
            frames: Of each demonstration, (n, F).
            n_basis: As in `JointDMP.fit`, like all that is not told here.
            mask: (n, T).
            tolerance: Standard deviation, in the units of the motion, that demonstrations are
                taken to have at least in every frame. None: 0.1 % of the largest range.
            joint_names: D names.
            units: Of the coordinates.
            options: How to fit; see `FitOptions`.

        Raises:
            ValueError: Fewer than two demonstrations, or frames of another number or size.
        """
        time, mask, (position,) = padded(time, mask, position)
        dmps = JointDMP.fit(
            time, position, n_basis, mask=mask, joint_names=joint_names, units=units, **options
        )
        x = dmps.coordinates().detach().double()
        if x.ndim != 3 or len(x) < 2:
            raise ValueError("frames need a batch of 2 demonstrations or more")
        if dmps.basis.periodic:
            raise ValueError("a rhythm leads from no place to another: frames are for motions")
        n, D, _ = x.shape
        if frames.b.ndim != 3 or frames.b.shape[::2] != (n, D):
            raise ValueError(
                f"{n} demonstrations of {D} coordinates need frames ({n}, F) of {D}, got "
                f"{tuple(frames.b.shape[:-1])} of {frames.b.shape[-1]}"
            )
        seen = Frames(frames.A.detach().double(), frames.b.detach().double()).inwards(x)
        mean = seen.mean(0)
        off = seen - mean
        least = dmps.amplitude.max().item() / 1000 if tolerance is None else tolerance
        smooth = _smooth_deviations(dmps, off, least)
        # The smooth ones count for one more demonstration.
        shown = off.permute(1, 2, 3, 0) * math.sqrt(n / (n + 1) / (n - 1))
        root = torch.cat([shown, smooth], dim=-1)
        # In units of each weight and end, alike for all columns: turned, they stay so.
        unit = root.square().sum(-1).mean((0, 1)).sqrt()
        root = (root / unit[:, None]).flatten(1, 2)
        eye = torch.eye(root.shape[1]).to(root)
        unit = unit.repeat(D)
        precision = torch.linalg.inv(root @ root.mT + FREEDOM**2 * eye)
        precision = precision / unit / unit[:, None]
        return cls(primitive=mean_primitive(dmps), mean=mean, precision=precision)

    def at(self, frames: Frames) -> JointDMP:
        """The most likely primitive between frames, (*batch, F); gradients flow to them.

        Raises:
            ValueError: Frames of another number or size.
        """
        mean, _ = self._product(frames)
        return self.primitive.with_coordinates(mean)

    def distribution(self, frames: Frames) -> ProbabilisticDMP[JointDMP]:
        """What is known of the motion between frames, (F,): to condition and to sample.

        Raises:
            ValueError: Frames of another number or size, or of a batch.
        """
        mean, factor = self._product(frames)
        if mean.ndim != 2:
            raise ValueError(f"a distribution is of one place, got {tuple(mean.shape[:-2])}")
        # (L L')^-1 = L^-T L^-1: L^-T is a square root of the covariance.
        eye = torch.eye(len(factor)).to(factor)
        spread = torch.linalg.solve_triangular(factor.mT, eye, upper=True)
        middle = self.primitive.with_coordinates(mean.detach())
        return ProbabilisticDMP(primitive=middle, mean=mean, spread=spread)

    def _product(
        self, frames: Frames
    ) -> tuple[Float[Tensor, "*batch D M"], Float[Tensor, "*batch DM DM"]]:
        """Mean, and the precision's Cholesky factor: precisions add up, means count by them."""
        F, D, M = self.mean.shape
        if frames.b.shape[-2:] != (F, D):
            raise ValueError(
                f"the motion has {F} frames of {D} coordinates, got "
                f"{frames.b.shape[-2]} of {frames.b.shape[-1]}"
            )
        frames = Frames(frames.A.to(self.mean), frames.b.to(self.mean))
        back = torch.linalg.inv(frames.A)
        precision = self.precision.view(F, D, M, D, M)
        precision = torch.einsum("...fba,fbmcn,...fcd->...famdn", back, precision, back)
        precision = precision.flatten(-4, -3).flatten(-2)
        x = frames.outwards(self.mean).flatten(-2)[..., None]
        factor = torch.linalg.cholesky(precision.sum(-3))
        mean = torch.cholesky_solve((precision @ x).sum(-3), factor)
        return mean[..., 0].unflatten(-1, (D, M)), factor


def _smooth_deviations(
    dmps: JointDMP, off: Float[Tensor, "n F D M"], least: float
) -> Float[Tensor, "F D M columns"]:
    """Square root of the covariance of deviations in any direction, of the size of those seen.

    Args:
        dmps: Of the demonstrations.
        off: Deviations of their coordinates from the mean in each frame.
        least: Standard deviation of a motion at any time.
    """
    n, F, D, _ = off.shape
    s = torch.linspace(0, 1, FINE * dmps.basis.count + 1).to(off)
    rows = dmps.response.evaluate(s)[:, 0]
    # Along the motion, over all directions.
    variance = (off @ rows.mT).square().sum(0).mean(-2) / (n - 1)
    size = (variance / (n + 1) + least**2).sqrt()
    # Modes of a Gaussian process with squared exponential covariance.
    kernel = torch.exp(-((s[:, None] - s) / PERSISTENCE).square() / 2)
    values, vectors = torch.linalg.eigh(kernel)
    modes = vectors[:, -MODES:] * values[-MODES:].clamp(min=0).sqrt()
    motions = (size[:, :, None] * modes).mT.reshape(-1, len(s), 1)
    samples = check_samples(s, motions)
    weights, rate = fit_samples("trajectory", dmps.response, samples, REGULARIZATION)
    ends = torch.stack([rate, samples.first, samples.last], dim=-1)
    x = torch.cat([weights, ends], dim=-1).view(F, MODES, -1)
    eye = torch.eye(D).to(x)
    return torch.einsum("frm,de->fdmre", x, eye).flatten(-2)
