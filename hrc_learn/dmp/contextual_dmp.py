"""Primitives as a function of a task parameter, by ridge regression."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Unpack

import torch
from jaxtyping import Float
from torch import Tensor, nn

from hrc_learn.dmp._arguments import Mask, Points, Times, Vectors, checked_vector, to_tensor
from hrc_learn.dmp.joint_dmp import FitOptions, JointDMP
from hrc_learn.dmp.probabilistic_dmp import mean_primitive
from hrc_learn.dmp.samples import FitReport, check_samples
from hrc_learn.model_files import SavedModel, write_model

CONSTANT = 1e-12
"""Standard deviation relative to the size below which a feature counts as constant: what is
left after the mean is subtracted is rounding."""


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


OWN_TENSORS = ("coefficients", "feature_mean", "feature_scale", "held_out_duration")


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
    held_out_duration: Tensor
    """Ratio of the duration of each demonstration to its prediction from the others, (n)."""
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
        held_out_duration: Float[Tensor, "n"],
    ):
        """Assemble a primitive; `fit` is the usual way to make one.

        Args:
            mean: Single primitive with the common basis, gains and names.
            coefficients: a and B transposed; K = D (N + 3) + 1.
            feature_mean: Mean context of the demonstrations.
            feature_scale: Scale of the contexts.
            held_out: Residuals of leave-one-out predictions.
            held_out_duration: Ratios of durations to leave-one-out predictions.

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
        self.register_buffer("held_out_duration", held_out_duration)
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
            held_out_duration=ridge.held_out[:, -1].exp().to(dtype),
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
