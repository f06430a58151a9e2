"""Primitives as a function of a task parameter, by ridge regression."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations_with_replacement
from pathlib import Path
from types import NoneType
from typing import Unpack

import torch
from jaxtyping import Float
from torch import Tensor, nn

from hrc_learn.dmp._arguments import Mask, Points, Times, Vectors, to_tensor
from hrc_learn.dmp.fitting.motion_fit import FitOptions
from hrc_learn.dmp.fitting.samples import FitReport, check_samples
from hrc_learn.dmp.joint_dmp import JointDMP
from hrc_learn.dmp.probabilistic_dmp import mean_primitive
from hrc_learn.model_files import SavedModel, write_model

type FeatureMap = Callable[[Tensor], Tensor]
"""Map from contexts (*batch, C) to features (*batch, F), without a constant."""


@dataclass(frozen=True, kw_only=True)
class PolynomialFeatures:
    """Products of up to `degree` coordinates of the context; 1: the context itself."""

    degree: int = 1

    def __post_init__(self):
        if self.degree < 1:
            raise ValueError(f"degree must be at least 1, got {self.degree}")

    def __call__(self, context: Float[Tensor, "*batch C"]) -> Float[Tensor, "*batch F"]:
        """Features of contexts (*batch, C)."""
        columns = context.unbind(-1)
        products = [
            torch.stack(factors).prod(0)
            for degree in range(1, self.degree + 1)
            for factors in combinations_with_replacement(columns, degree)
        ]
        return torch.stack(products, dim=-1)


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

    x(c) = a + B (phi(c) - mean) / scale,   x = (weights, y_0', y_0, g, log tau)

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
        features: FeatureMap,
    ):
        """Assemble a primitive; `fit` is the usual way to make one.

        Args:
            mean: Single primitive with the common basis, gains and names.
            coefficients: a and B transposed; K = D (N + 3) + 1.
            feature_mean: Mean features of the demonstrations.
            feature_scale: Scale of the features.
            held_out: Residuals of leave-one-out predictions.
            held_out_duration: Ratios of durations to leave-one-out predictions.
            features: Feature map phi.

        Raises:
            ValueError: Coefficients that do not fit the primitive or the features.
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
        self.features = features

    @classmethod  # pyright: ignore[reportArgumentType]
    def fit(
        cls,
        time: Times,
        position: Points,
        context: Vectors,
        n_basis: int = 50,
        mask: Mask | None = None,
        *,
        features: FeatureMap | None = None,
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
            features: Feature map phi; by default the context itself.
            regularization: Ridge over standardised features, positive. The default hardly
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
        features = features or PolynomialFeatures()
        phi = features(_contexts(context, each)).double()
        x = _coordinates(each)
        ridge = fit_ridge(phi, x, regularization)
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
            features=features,
        )

    def at(self, context: Vectors) -> JointDMP:
        """Primitives for contexts (*batch, C); gradients flow to contexts and coefficients.

        The weights of the result are a buffer, because the coefficients are the parameters.
        """
        like = self.coefficients
        phi = self.features(to_tensor(context, dtype=like.dtype, device=like.device))
        F = len(self.feature_mean)
        if phi.ndim == 0 or phi.shape[-1] != F:
            raise ValueError(
                f"context of shape {_shape(context)} gives features {tuple(phi.shape)}, "
                f"fitted were (..., {F})"
            )
        standard = (phi - self.feature_mean) / self.feature_scale
        return _primitive(self.mean, like[0] + standard @ like[1:])

    def save(self, folder: str | Path) -> None:
        """Write config.json and model.safetensors into `folder`, replacing an older save.

        A feature map other than `PolynomialFeatures` is code and is not saved: pass the same
        one to `load`.
        """
        phi = self.features
        features = {"degree": phi.degree} if isinstance(phi, PolynomialFeatures) else None
        config = self.mean.config() | {"features": features}
        own = {name: getattr(self, name) for name in OWN_TENSORS}
        report = {f"held_out.{k}": v for k, v in self.held_out.tensors().items()}
        write_model(folder, type(self).__name__, config, self.mean.tensors() | own | report)

    @classmethod
    def load(cls, folder: str | Path, features: FeatureMap | None = None) -> "ContextualDMP":
        """Read a primitive that `save` wrote.

        Args:
            folder: Folder of the saved primitive.
            features: Feature map of the fit, unless it was a polynomial.

        Raises:
            FileNotFoundError: The folder holds no saved primitive.
            ValueError: A wrong field; the message names the file and the field.
        """
        saved = SavedModel(folder, cls.__name__)
        own = {name: saved.tensor(name) for name in OWN_TENSORS}
        report = {k: saved.tensor(f"held_out.{k}") for k in ("rmse", "peak", "span")}
        features = _saved_features(saved, features)
        try:
            return cls(
                mean=JointDMP.restore(saved),
                features=features,
                held_out=FitReport(**report),
                **own,
            )
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
    if not tensor.isfinite().all():
        raise ValueError(f"context of demonstration {_first_bad(tensor)} is not finite")
    return tensor


def _first_bad(rows: Tensor) -> int:
    return int((~rows.isfinite()).nonzero()[0, 0])


def _saved_features(saved: SavedModel, given: FeatureMap | None) -> FeatureMap:
    fields = saved.get("features", dict, NoneType)
    if given is not None:
        return given
    if fields is None:
        raise saved.invalid_field("features", "fitted with a custom map: pass it to load")
    try:
        return PolynomialFeatures(**fields)
    except (TypeError, ValueError) as error:
        raise saved.invalid_field("features", error) from None


def _shape(values: Points | Vectors) -> tuple[int, ...]:
    return tuple(to_tensor(values).shape)
