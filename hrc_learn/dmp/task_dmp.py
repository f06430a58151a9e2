"""Motions as functions of a task: of the frames of objects, or of a context.

Frames: each demonstration is seen from every frame; the demonstrations agree in a frame where
it determines the motion. For frames at new places, the Gaussians of all frames are transformed
there and multiplied, as in task-parameterised models (Calinon 2016, "A tutorial on
task-parameterized movement learning and retrieval", eqs. 5 and 6). Here the Gaussians are over
the coordinates of a primitive, that is over whole motions instead of single moments: a motion
that deviates at its start keeps deviating. The result is an ordinary primitive.

Context: the coordinates of primitives by ridge regression on a task parameter.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Unpack

import torch
from jaxtyping import Float
from torch import Tensor, nn

from hrc_learn.dmp._arguments import Mask, Points, Times, Vectors, checked_vector, to_tensor
from hrc_learn.dmp.joint_dmp import FitOptions, JointDMP
from hrc_learn.dmp.motion_primitive import REFIT_SAMPLES
from hrc_learn.dmp.probabilistic_dmp import ProbabilisticDMP, mean_primitive
from hrc_learn.dmp.samples import FitReport, check_samples, padded
from hrc_learn.dmp.solvers import REGULARIZATION, fit_samples
from hrc_learn.geometry import Pose, quaternion
from hrc_learn.model_files import SavedModel, write_model

PERSISTENCE = 0.3
"""Fraction of a motion over which deviations persist that no demonstration showed; with 0.1 the
error on synthetic motions is twice as large (benchmarks/bench_frames.py)."""
MODES = 12
"""Modes of such deviations: the next one has 1e-6 of the variance."""
FREEDOM = 1e-3
"""Independent standard deviation of each coordinate, relative to that over all frames. It makes
the covariance invertible where frames agree; motions do not visibly change."""
CONSTANT = 1e-12
"""Standard deviation relative to the size below which a feature counts as constant: what is
left after the mean is subtracted is rounding."""
OWN_TENSORS = ("coefficients", "feature_mean", "feature_scale")


@dataclass(frozen=True, eq=False)
class Frames:
    """F frames of a motion, y = A y_in_frame + b.

    A is any invertible matrix. A column that belongs to no place, such as a gripper opening,
    has a one on the diagonal of A and zero in b.
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
        """Frames for positions in space, from poses of (*batch) each."""
        A = torch.stack([quaternion.to_matrix(pose.orientation) for pose in poses], dim=-3)
        return Frames(A, torch.stack([pose.position for pose in poses], dim=-2))

    def inwards(self, x: Float[Tensor, "*batch D M"]) -> Float[Tensor, "*batch F D M"]:
        """Coordinates of primitives relative to each frame."""
        x = x[..., None, :, :].to(self.A)
        return torch.linalg.solve(self.A, x - self._offset(x.shape[-1]))

    def outwards(self, x: Float[Tensor, "F D M"]) -> Float[Tensor, "*batch F D M"]:
        """Coordinates in the base frame of primitives relative to each frame."""
        return self.A @ x + self._offset(x.shape[-1])

    def _offset(self, M: int) -> Float[Tensor, "*batch F D M"]:
        """Offset b for start and goal, the last two coordinates; zero for the others."""
        return torch.nn.functional.pad(self.b[..., None].expand(*self.b.shape, 2), (M - 2, 0))


@dataclass(frozen=True, kw_only=True, eq=False)
class FramedDMP:
    """Gaussians over the coordinates of a primitive relative to each of F frames (float64).

    x = (weights, start velocity, start, goal) as in `ProbabilisticDMP`. The covariance is that
    of n demonstrations plus that of smooth deviations in any direction, as large as those
    observed, with the weight of one more demonstration.
    """

    primitive: JointDMP
    """Primitive with the common spring, basis, duration and names."""
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
        """Learn from demonstrations whose frames differ.

        Args:
            time: [s], (T,), (n, T) or a list of (T_i,).
            position: (n, T, D) or a list of (T_i, D).
            frames: Frames of each demonstration, (n, F).
            n_basis: N, as in `JointDMP.fit`.
            mask: (n, T), false at samples to ignore.
            tolerance: Smallest standard deviation of the demonstrations in every frame, in the
                units of the motion. None: 0.1 % of the largest range.
            joint_names: D names.
            units: Units of the coordinates.
            options: Options of the fit; see `FitOptions`.

        Raises:
            ValueError: Fewer than two demonstrations, or frames of another number or size.
        """
        time, mask, (position,) = padded(time, mask, position)
        dmps = JointDMP.fit(
            time, position, n_basis, mask=mask, joint_names=joint_names, units=units, **options
        )
        return cls.of(dmps, frames, tolerance)

    @classmethod
    def of(cls, dmps: JointDMP, frames: Frames, tolerance: float | None = None) -> "FramedDMP":
        """Learn from primitives (n) of demonstrations; arguments as for `fit`."""
        x = dmps.coordinates().detach().double()
        if x.ndim != 3 or len(x) < 2:
            raise ValueError("frames need a batch of 2 demonstrations or more")
        if dmps.basis.periodic:
            raise ValueError("a rhythm has no start and goal: frames are for discrete motions")
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
        # The smooth deviations have the weight of one more demonstration.
        shown = off.permute(1, 2, 3, 0) * math.sqrt(n / (n + 1) / (n - 1))
        precision = _precision(torch.cat([shown, smooth], dim=-1))
        return cls(primitive=mean_primitive(dmps), mean=mean, precision=precision)

    def at(self, frames: Frames) -> JointDMP:
        """Most likely primitive for frames, (*batch, F); gradients flow to them.

        Raises:
            ValueError: Frames of another number or size.
        """
        mean, _ = self._product(frames)
        return self.primitive.with_coordinates(mean)

    def distribution(self, frames: Frames) -> ProbabilisticDMP[JointDMP]:
        """Gaussian over the motion for frames, (F,), to condition and to sample.

        Raises:
            ValueError: Frames of another number or size, or a batch.
        """
        mean, factor = self._product(frames)
        if mean.ndim != 2:
            raise ValueError(f"frames must be (F,), without a batch {tuple(mean.shape[:-2])}")
        # (L L')^-1 = L^-T L^-1: L^-T is a square root of the covariance.
        eye = torch.eye(len(factor)).to(factor)
        spread = torch.linalg.solve_triangular(factor.mT, eye, upper=True)
        middle = self.primitive.with_coordinates(mean.detach())
        return ProbabilisticDMP(primitive=middle, mean=mean, spread=spread)

    def _product(
        self, frames: Frames
    ) -> tuple[Float[Tensor, "*batch D M"], Float[Tensor, "*batch DM DM"]]:
        """Mean, and Cholesky factor of the precision, of the product of all Gaussians."""
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


def _precision(root: Float[Tensor, "F D M columns"]) -> Float[Tensor, "F DM DM"]:
    """Inverse covariance from a square root of the covariance, with some freedom added."""
    D = root.shape[1]
    # One unit per weight and end for all columns: it is invariant to rotations.
    unit = root.square().sum(-1).mean((0, 1)).sqrt()
    root = (root / unit[:, None]).flatten(1, 2)
    eye = torch.eye(root.shape[1]).to(root)
    unit = unit.repeat(D)
    return torch.linalg.inv(root @ root.mT + FREEDOM**2 * eye) / unit / unit[:, None]


def _smooth_deviations(
    dmps: JointDMP, off: Float[Tensor, "n F D M"], least: float
) -> Float[Tensor, "F D M columns"]:
    """Square root of the covariance of smooth deviations in any direction.

    Args:
        dmps: Primitives of the demonstrations.
        off: Deviations of their coordinates from the mean in each frame.
        least: Smallest standard deviation of a motion at any time.
    """
    n, F, D, _ = off.shape
    s = torch.linspace(0, 1, REFIT_SAMPLES * dmps.basis.count + 1).to(off)
    rows = dmps.response.evaluate(s)[:, 0]
    # Variance along the motion, the mean over all directions.
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


@dataclass(frozen=True, kw_only=True, eq=False)
class RidgeFit:
    """Linear map y = a + B (x - mean) / scale, fitted to n samples."""

    mean: Float[Tensor, "F"]
    scale: Float[Tensor, "F"]
    """Standard deviation of each feature; one if it is constant or not standardised."""
    coefficients: Float[Tensor, "F_and_1 K"]
    """a in the first row, B transposed in the others."""
    held_out: Float[Tensor, "n K"]
    """Difference of each sample to its prediction from all others."""


def fit_ridge(
    features: Float[Tensor, "n F"],
    targets: Float[Tensor, "n K"],
    regularization: float,
    *,
    standardize: bool = True,
) -> RidgeFit:
    """Minimise |Y - A X|^2 + n regularization |B|^2, A = [1, (features - mean) / scale].

    The constant is not penalised, so that a strong penalty leads to the mean of the targets.
    With the hat matrix H = A (A'A + P)^-1 A', the residual of sample i in a fit without it, at
    the same penalty P, is e_i / (1 - H_ii) (PRESS; Allen 1974, "The relationship between
    variable selection and data augmentation").

    Args:
        features: Features of n >= 2 samples.
        targets: Targets of the samples.
        regularization: Positive; 1 gives penalty and data equal weight.
        standardize: True to divide features by their standard deviation. False suits
            features on one scale, where those that hardly vary should have little effect.

    Raises:
        ValueError: Fewer than 2 samples, or a regularization that is not positive.
    """
    n, F = features.shape
    if n < 2:
        raise ValueError(f"a regression needs at least 2 samples, got {n}")
    if not 0 < regularization < torch.inf:
        raise ValueError(f"regularization must be positive, got {regularization}")
    mean, deviation = features.mean(0), features.std(0, correction=0)
    # A constant feature has a deviation by rounding only.
    varies = standardize & (deviation > CONSTANT * features.abs().amax(0))
    scale = torch.where(varies, deviation, 1.0)
    A = torch.cat([torch.ones_like(features[:, :1]), (features - mean) / scale], dim=1)
    penalty = torch.zeros(F, F + 1).to(A)
    # The constant is not penalised.
    penalty[:, 1:].fill_diagonal_((n * regularization) ** 0.5)
    # QR of the stacked system: A'A would square its condition number.
    Q, R = torch.linalg.qr(torch.cat([A, penalty]))
    Q = Q[:n]
    coefficients = torch.linalg.solve_triangular(R, Q.mT @ targets, upper=True)
    leverage = Q.square().sum(1, keepdim=True)
    return RidgeFit(
        mean=mean,
        scale=scale,
        coefficients=coefficients,
        held_out=(targets - A @ coefficients) / (1 - leverage),
    )


class ContextualDMP(nn.Module):
    """Joint primitives as a function of a task parameter, the context c.

    x(c) = a + B (c - mean) / scale,   x = (weights, y_0', y_0, g, log tau)

    a and B by ridge regression from one demonstration per context (after Forte et al. 2012,
    "On-line motion synthesis and adaptation using a trajectory database", and Ude et al.
    2010, "Task-specific generalization of discrete and periodic dynamic movement
    primitives", here global instead of local). As the constant is not penalised, x(c) is an
    affine combination of the demonstrations, and so is the motion, which is linear in all
    coordinates but the duration.
    """

    feature_mean: Tensor
    feature_scale: Tensor
    held_out: FitReport
    """Residuals of each demonstration, (n), to its prediction from the others, at equal s."""

    def __init__(
        self,
        *,
        mean: JointDMP,
        coefficients: Float[Tensor, "F_and_1 K"],
        feature_mean: Float[Tensor, "F"],
        feature_scale: Float[Tensor, "F"],
        held_out: FitReport,
    ):
        """Assemble a primitive; `fit` is the usual way to make one.

        Args:
            mean: Single primitive with the common basis, gains and names.
            coefficients: a and B transposed; K = D (N + 3) + 1.
            feature_mean: Mean context of the demonstrations.
            feature_scale: Scale of the contexts.
            held_out: Residuals of leave-one-out predictions.

        Raises:
            ValueError: Coefficients that do not fit the primitive or the contexts.
        """
        super().__init__()
        D, N = mean.weights.shape
        shape = (len(feature_mean) + 1, D * (N + 3) + 1)
        if coefficients.shape != shape:
            raise ValueError(
                f"coefficients have shape {tuple(coefficients.shape)}, must be {shape}"
            )
        self.mean = mean.requires_grad_(False)
        self.coefficients = nn.Parameter(coefficients)
        self.register_buffer("feature_mean", feature_mean)
        self.register_buffer("feature_scale", feature_scale)
        self.held_out = held_out

    @classmethod  # pyright: ignore[reportArgumentType]
    def fit(
        cls,
        time: Times,
        position: Points,
        context: Vectors,
        n_basis: int = 50,
        mask: Mask | None = None,
        *,
        regularization: float = 1e-6,
        joint_names: Sequence[str] | None = None,
        units: str = "rad",
        **options: Unpack[FitOptions],  # pyright: ignore[reportGeneralTypeIssues]
    ) -> "ContextualDMP":
        """Learn from one demonstration per context.

        Args:
            time: Timestamps [s], (T,) or (n, T).
            position: (n, T, D), n >= 2.
            context: (n, C), or (n,) for C = 1.
            n_basis: N.
            mask: (n, T), false at samples to ignore.
            regularization: Ridge over standardised contexts, positive. The default hardly
                smooths; compare `held_out` for noisy demonstrations.
            joint_names: D names, stored with the primitive.
            units: Units of the coordinates.
            options: Options of the fit; see `FitOptions`.

        Raises:
            ValueError: Bad samples (the message names them), or contexts that do not match.
        """
        names = {"joint_names": joint_names, "units": units}
        each = JointDMP.fit(time, position, n_basis, mask=mask, **names, **options)
        if each.weights.ndim != 3:
            raise ValueError(f"position must be (n, T, D), got {_shape(position)}")
        samples = check_samples(time, position, mask=mask)
        x = _coordinates(each)
        ridge = fit_ridge(_contexts(context, each), x, regularization)
        predicted = _primitive(each, x - ridge.held_out)
        with torch.no_grad():
            held_out = samples.compare(predicted.rollout().position)
        dtype = each.weights.dtype
        return cls(
            mean=mean_primitive(each),
            coefficients=ridge.coefficients.to(dtype),
            feature_mean=ridge.mean.to(dtype),
            feature_scale=ridge.scale.to(dtype),
            held_out=held_out,
        )

    def at(self, context: Vectors) -> JointDMP:
        """Primitives for contexts (*batch, C); gradients flow to contexts and coefficients.

        The weights of the result are a buffer, because the coefficients are the parameters.
        """
        like = self.coefficients
        c = checked_vector("context", context, self.feature_mean)
        standard = (c - self.feature_mean) / self.feature_scale
        return _primitive(self.mean, like[0] + standard @ like[1:])

    def save(self, folder: str | Path) -> None:
        """Write config.json and model.safetensors into `folder`, replacing an older save."""
        own = {name: getattr(self, name) for name in OWN_TENSORS}
        report = {f"held_out.{k}": v for k, v in self.held_out.tensors().items()}
        tensors = self.mean.tensors() | own | report
        write_model(folder, type(self).__name__, self.mean.config(), tensors)

    @classmethod
    def load(cls, folder: str | Path) -> "ContextualDMP":
        """Read a primitive that `save` wrote.

        Raises:
            FileNotFoundError: The folder holds no saved primitive.
            ValueError: A wrong field; the message names the file and the field.
        """
        saved = SavedModel(folder, cls.__name__)
        own = {name: saved.tensor(name) for name in OWN_TENSORS}
        report = {k: saved.tensor(f"held_out.{k}") for k in ("rmse", "peak", "span")}
        mean = JointDMP.restore(saved)
        try:
            return cls(mean=mean, held_out=FitReport(**report), **own)
        except ValueError as error:
            raise saved.invalid(error) from None


def _coordinates(primitives: JointDMP) -> Float[Tensor, "n K"]:
    """Coordinates x of each primitive (float64)."""
    x = primitives.coordinates().detach().flatten(1)
    return torch.cat([x, primitives.duration.log()[:, None]], dim=-1).double()


def _primitive(like: JointDMP, x: Float[Tensor, "*batch K"]) -> JointDMP:
    """Primitives with these coordinates, and the parts of `like`."""
    D = like.weights.shape[-2]
    return like.with_coordinates(x[..., :-1].unflatten(-1, (D, -1)), x[..., -1].exp())


def _contexts(context: Vectors, primitives: JointDMP) -> Float[Tensor, "n C"]:
    weights = primitives.weights
    tensor = to_tensor(context, dtype=torch.float64, device=weights.device)
    tensor = tensor[:, None] if tensor.ndim == 1 else tensor
    if tensor.ndim != 2 or len(tensor) != len(weights):
        raise ValueError(
            f"context has shape {_shape(context)}: expected one row for each of "
            f"{len(weights)} demonstrations"
        )
    if len(bad := (~tensor.isfinite()).nonzero()):
        raise ValueError(f"context of demonstration {int(bad[0, 0])} is not finite")
    return tensor


def _shape(values: Points | Vectors) -> tuple[int, ...]:
    return tuple(to_tensor(values).shape)
