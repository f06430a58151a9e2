"""Features of a task parameter: what primitives are regressed on."""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import combinations_with_replacement
from pathlib import Path
from types import NoneType
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from hrc_learn.dmp._arguments import (
    FitReport,
    Mask,
    Points,
    Times,
    Vectors,
    check_samples,
    to_tensor,
)
from hrc_learn.dmp.joint_dmp import JointDMP
from hrc_learn.dmp.probabilistic_dmp import mean_primitive
from hrc_learn.model_files import SavedModel, write_model

type FeatureMap = Callable[[Tensor], Tensor]
"""Maps contexts (*batch, C) to features (*batch, F); a constant one is not needed."""


@dataclass(frozen=True, kw_only=True)
class PolynomialFeatures:
    """All products of up to `degree` coordinates of the context; 1: the context itself."""

    degree: int = 1

    def __post_init__(self):
        if self.degree < 1:
            raise ValueError(f"degree must be at least 1, got {self.degree}")

    def __call__(self, context: Float[Tensor, "*batch C"]) -> Float[Tensor, "*batch F"]:
        """Features of a context."""
        columns = context.unbind(-1)
        products = [
            torch.stack(factors).prod(0)
            for degree in range(1, self.degree + 1)
            for factors in combinations_with_replacement(columns, degree)
        ]
        return torch.stack(products, dim=-1)


CONSTANT = 1e-12
"""Features that vary by less than this share of their size do not vary: it is rounding of the
mean that was taken off."""


@dataclass(frozen=True, kw_only=True, eq=False)
class RidgeFit:
    """y = a + B (x - mean) / scale, fitted to n samples."""

    mean: Float[Tensor, "F"]
    scale: Float[Tensor, "F"]
    """Standard deviation of each feature; one where it never changes, or by request."""
    coefficients: Float[Tensor, "F_and_1 K"]
    """First row a, the others B transposed."""
    held_out: Float[Tensor, "n K"]
    """What each sample differs by from its prediction by a fit to all others."""


def fit_ridge(
    features: Float[Tensor, "n F"],
    targets: Float[Tensor, "n K"],
    regularization: float,
    *,
    standardize: bool = True,
) -> RidgeFit:
    """Minimise |Y - A X|^2 + n regularization |B|^2, A = [1, (features - mean) / scale].

    The constant is free, so that a strong penalty leads to the mean of the targets. With
    the hat matrix H = A (A'A + P)^-1 A', the residual of a fit without sample i, at the same
    penalty P, is e_i / (1 - H_ii) (PRESS; Allen 1974, "The relationship between variable
    selection and data augmentation").

    Args:
        features: n >= 2.
        targets: Fitted alike, column by column.
        regularization: Positive; 1 weighs the penalty as much as the data.
        standardize: Divide features by their standard deviation; False: scale is one, for
            features in one scale, of which those that hardly vary are to stay small.

    Raises:
        ValueError: Fewer than 2 samples, or a regularization that is not positive.
    """
    n, F = features.shape
    if n < 2:
        raise ValueError(f"a regression needs at least 2 samples, got {n}")
    if not 0 < regularization < torch.inf:
        raise ValueError(f"regularization must be positive, got {regularization}")
    mean, deviation = features.mean(0), features.std(0, correction=0)
    # What is left of a constant in rounding is no deviation.
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
    primitives", here global instead of local). As the constant is free, x(c) mixes those of
    the demonstrations in shares that sum to one, and so does the motion, which is linear in
    all but the duration.
    """

    feature_mean: Tensor
    feature_scale: Tensor
    held_out_duration: Tensor
    """Duration of each demonstration over its prediction by the others (n)."""
    held_out: FitReport
    """Each demonstration, (n), against its prediction by the others, at the same s."""

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
        """Put one together; `fit` is the usual way.

        Args:
            mean: Primitive without batch dimensions, whose basis, gains and names all have.
            coefficients: a and B transposed; K = D (N + 3) + 1.
            feature_mean: Of the demonstrations.
            feature_scale: Of the demonstrations.
            held_out: Kept for the reader.
            held_out_duration: Kept for the reader.
            features: phi.

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

    @classmethod
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
        **fit_arguments: Any,
    ) -> "ContextualDMP":
        """Learn from one demonstration for each of several contexts.

        Args:
            time: Timestamps [s], (T,) or (n, T).
            position: (n, T, D), n >= 2.
            context: (n, C), or (n,) for C = 1.
            n_basis: N.
            mask: (n, T), false where a sample does not count.
            features: phi; affine in the context unless given.
            regularization: Ridge over standardised features, positive. The default hardly
                smoothes; `held_out` tells what suits noisy demonstrations.
            fit_arguments: Others of `JointDMP.fit`, such as `approach` or `joint_names`.

        Raises:
            ValueError: Bad samples (says which), contexts that do not fit them, or a
                scaling other than `"none"`, in which motions are not linear.
        """
        each = JointDMP.fit(time, position, n_basis, mask=mask, **fit_arguments)
        if each.scaling != "none":
            raise ValueError(f"scaling {each.scaling!r} is not linear: fit with 'none'")
        if each.weights.ndim != 3:
            raise ValueError(f"position must be (n, T, D), got {_shape(position)}")
        samples = check_samples(time, position, mask=mask)
        features = features or PolynomialFeatures()
        phi = features(_contexts(context, each)).double()
        x = _coordinates(each)
        ridge = fit_ridge(phi, x, regularization)
        predicted = _primitive(each, x - ridge.held_out)
        with torch.no_grad():
            motion = predicted.rollout().position.mT.reshape(samples.position.shape)
        dtype = each.weights.dtype
        return cls(
            mean=mean_primitive(each),
            coefficients=ridge.coefficients.to(dtype),
            feature_mean=ridge.mean.to(dtype),
            feature_scale=ridge.scale.to(dtype),
            held_out=samples.compare(motion),
            held_out_duration=ridge.held_out[:, -1].exp().to(dtype),
            features=features,
        )

    def at(self, context: Vectors) -> JointDMP:
        """Primitives for contexts (*batch, C); gradients flow to them and to the coefficients.

        What is learned here are the coefficients: the weights of the result are a buffer.
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

        A feature map other than `PolynomialFeatures` is code, which is not written: `load`
        has to be given the same one.
        """
        phi = self.features
        features = {"degree": phi.degree} if isinstance(phi, PolynomialFeatures) else None
        config = self.mean.config() | {"features": features}
        own = {name: getattr(self, name) for name in OWN_TENSORS}
        report = {f"held_out.{k}": v for k, v in self.held_out.tensors().items()}
        write_model(folder, type(self).__name__, config, self.mean.tensors() | own | report)

    @classmethod
    def load(cls, folder: str | Path, features: FeatureMap | None = None) -> "ContextualDMP":
        """Read what `save` wrote.

        Args:
            folder: Where.
            features: The feature map it was fitted with, unless that was a polynomial.

        Raises:
            FileNotFoundError: No saved primitive there.
            ValueError: Names the file and the field that is wrong.
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
    """X of each (float64)."""
    x = primitives.coordinates().detach().flatten(1)
    return torch.cat([x, primitives.duration.log()[:, None]], dim=-1).double()


def _primitive(like: JointDMP, x: Float[Tensor, "*batch K"]) -> JointDMP:
    """The primitives with these coordinates, else like `like`."""
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
        raise saved.invalid_field("features", "fitted with a map of its own, give it to load")
    try:
        return PolynomialFeatures(**fields)
    except (TypeError, ValueError) as error:
        raise saved.invalid_field("features", error) from None


def _shape(values: Points | Vectors) -> tuple[int, ...]:
    return tuple(to_tensor(values).shape)
