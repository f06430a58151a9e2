"""Choice of the model that predicts held-out demonstrations best.

Candidates are the mean, a function of start and goal, and the nearest demonstration.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, cast

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.demos import DemonstrationSet
from hrc_learn.dmp import ContextualDMP, JointDMP, fit_ridge
from hrc_learn.learning.primitive_fitting import (
    EACH,
    FittedPrimitives,
    Motions,
    load_primitive,
)
from hrc_learn.learning.reproduction_error import Reproduction
from hrc_learn.store import read_json, write_json

CONTEXTUAL = "contextual"
"""Folder of contextual primitives."""
CHOICE = "prediction.json"
"""File in a model's folder that names the model of each channel."""
MODELS = ("mean", "contextual", "nearest")
"""Candidates, the simplest first."""
FEWEST = 4
"""Smallest number of demonstrations whose held-out errors distinguish models."""
LINEAR = ("joint", "position")
"""Channels whose models are compared."""
_WORTH = 0.9
"""Largest error, relative to a simpler model, that justifies a less simple one."""
_REGULARIZATIONS = (1e-6, 1e-3, 1e-1, 1.0)
"""Candidates for the regularisation of the contextual model; the largest is nearly the mean."""


@dataclass(frozen=True, kw_only=True)
class _Choice:
    """Content of the file `CHOICE`."""

    models: dict[str, Literal["mean", "contextual", "nearest"]]
    """Best model by channel."""
    context: tuple[str, ...]
    """Columns whose first row is the context."""


def contexts(
    demos: DemonstrationSet, columns: Sequence[str], motions: Motions, channel: str
) -> Float[Tensor, "demos C"]:
    """Context of each demonstration.

    Args:
        demos: Demonstrations.
        columns: Columns whose first row is the context. Default: start and goal.
        motions: The same demonstrations, padded.
        channel: Channel of start and goal.

    Raises:
        ValueError: A demonstration lacks a column.
    """
    if not columns:
        position = motions.position(channel)
        last = (motions.demos.length - 1)[:, None, None]
        goal = position.take_along_dim(last, dim=1)[:, 0]
        return torch.cat([position[:, 0], goal], dim=-1)
    rows = []
    for demo in demos:
        missing = [name for name in columns if name not in demo.extra]
        if missing:
            raise ValueError(
                f"{demos.source}, episode {demo.episode}: no column {missing[0]!r} for the "
                f"context; there are {', '.join(demo.extra) or 'none'}."
            )
        rows.append(np.concatenate([np.atleast_1d(demo.extra[name][0]) for name in columns]))
    return torch.from_numpy(np.stack(rows)).double()


def fit_contextual(
    fitted: FittedPrimitives,
    demos: DemonstrationSet,
    columns: Sequence[str],
    folder: Path,
    channels: Sequence[str] = ("joint", "position"),
    regularization: float = 1e-6,
) -> dict[str, float]:
    """Fit joints and positions as functions of a context, and save them.

    Args:
        fitted: Primitives of the demonstrations.
        demos: Demonstrations.
        columns: Columns whose first row is the context. Default: start and goal.
        folder: Folder of the model.
        channels: Channels to fit, if they were learned.
        regularization: See `ContextualDMP.fit`.

    Returns:
        Median and largest error of demonstrations predicted from all others.

    Raises:
        ValueError: There are fewer than two demonstrations, no such channel, or no context.
    """
    linear = [channel for channel in channels if channel in fitted.each]
    if not linear:
        raise ValueError("a function of a context needs the channel joint or position.")
    metrics = {}
    for channel in linear:
        motions = fitted.motions
        model = ContextualDMP.fit(
            motions.demos.time,
            motions.position(channel),
            contexts(demos, columns, motions, channel),
            fitted.n_basis,
            regularization=regularization,
            mask=motions.demos.mask,
            **motions.naming(channel),
            **fitted.options,
        )
        model.save(folder / CONTEXTUAL / channel)
        error = model.held_out.nrmse
        metrics[f"contextual_{channel}_held_out_nrmse_median"] = float(error.median())
        metrics[f"contextual_{channel}_held_out_nrmse_max"] = float(error.max())
    return metrics


@dataclass(frozen=True, kw_only=True)
class HeldOutErrors:
    """Errors of each demonstration when it is predicted from all others."""

    nrmse: Mapping[str, Float[Tensor, " demos"]]
    """Root mean square error divided by the range of motion, by model."""
    regularization: float
    """Regularisation of the contextual model. It is chosen by these errors among so few
    candidates that their bias is negligible."""

    @property
    def median(self) -> dict[str, float]:
        """Median error by model."""
        return {model: float(error.median()) for model, error in self.nrmse.items()}

    @property
    def best(self) -> str:
        """Simplest model that no other improves on clearly."""
        best, *others = (model for model in MODELS if model in self.nrmse)
        for model in others:
            if self.median[model] < _WORTH * self.median[best]:
                best = model
        return best


def held_out_errors(
    fitted: FittedPrimitives, channel: str, context: Float[Tensor, "demos C"]
) -> HeldOutErrors:
    """Predict each demonstration from all others with every model.

    Mean and ridge regression of the others (PRESS) follow from the primitives of all in closed
    form, without further fits.

    Args:
        fitted: Primitives of every demonstration.
        channel: One of `LINEAR`.
        context: Context of each demonstration.
    """
    each = cast(JointDMP, fitted.each[channel])
    x, n = each.coordinates().detach().double(), len(context)

    def error(coordinates: Tensor) -> Tensor:
        made = fitted.motions.adapted(channel, each.with_coordinates(coordinates))
        return fitted.motions.error(channel, made).columns()["nrmse"].double()

    others = (x.sum(0) - x) / (n - 1)
    found = {"mean": error(others), "nearest": error(x[_nearest(context, context, True)])}
    regressed = {}
    for strength in _REGULARIZATIONS:
        left = fit_ridge(context.double(), x.flatten(1), strength).held_out
        regressed[strength] = error(x - left.view_as(x))
    strength = min(regressed, key=lambda s: float(regressed[s].median()))
    return HeldOutErrors(
        nrmse=found | {"contextual": regressed[strength]}, regularization=strength
    )


def _nearest(
    asked: Float[Tensor, "asked C"], known: Float[Tensor, "known C"], others: bool = False
) -> Tensor:
    """Index of the nearest known context, each component scaled by its standard deviation.

    Args:
        asked: Contexts.
        known: Contexts of demonstrations.
        others: Both are the same, and no context is its own neighbour.
    """
    spread = known.std(0)
    varies = spread > 1e-9 * (1 + known.abs().amax(0))
    scale = torch.where(varies, spread, torch.inf)
    distance = torch.cdist((asked / scale).double(), (known / scale).double())
    if others:
        distance.fill_diagonal_(torch.inf)
    return distance.argmin(1)


def keep_best(
    fitted: FittedPrimitives, demos: DemonstrationSet, columns: tuple[str, ...], folder: Path
) -> dict[str, float]:
    """Compare models, and save the best one if it is not the mean.

    Args:
        fitted: Primitives of the demonstrations.
        demos: Demonstrations.
        columns: Columns whose first row is the context. Default: start and goal.
        folder: Folder of the model.

    Returns:
        Median held-out errors, `held_out_CHANNEL_MODEL_nrmse_median`.
    """
    metrics: dict[str, float] = {}
    chosen: dict[str, str] = {}
    for channel in LINEAR:
        if channel not in fitted.each or len(demos) < FEWEST:
            continue
        context = contexts(demos, columns, fitted.motions, channel)
        errors = held_out_errors(fitted, channel, context)
        if columns:
            # Saved primitives hold start and goal, but not these columns.
            kept = {k: v for k, v in errors.nrmse.items() if k != "nearest"}
            errors = replace(errors, nrmse=kept)
        chosen[channel] = errors.best
        metrics |= {
            f"held_out_{channel}_{model}_nrmse_median": value
            for model, value in errors.median.items()
        }
        if errors.best == "contextual":
            fit_contextual(fitted, demos, columns, folder, [channel], errors.regularization)
        elif errors.best == "nearest":
            fitted.each[channel].save(folder / EACH / channel)
    if chosen:
        write_json(folder / CHOICE, {"models": chosen, "context": columns})
    return metrics


def best_models(folder: Path) -> dict[str, str]:
    """Best model of each channel in a model's folder, without those that are the mean.

    Raises:
        ValueError: The file is damaged.
    """
    return {k: v for k, v in _choice(folder).models.items() if v != "mean"}


def _choice(folder: Path) -> _Choice:
    path = folder / CHOICE
    return (
        read_json(path, _Choice, "fit again")
        if path.is_file()
        else _Choice(models={}, context=())
    )


def predict(
    folder: Path, channel: str, motions: Motions, demos: DemonstrationSet
) -> Reproduction:
    """Motions that the best model predicts from start, goal and duration.

    Args:
        folder: Folder of `hrc fit`.
        channel: Channel to predict.
        motions: Padded demonstrations.
        demos: The same demonstrations, with the columns of the context.

    Raises:
        FileNotFoundError: The folder holds no model.
        ValueError: The model is damaged, or a demonstration lacks a column of the context.
    """
    choice = _choice(folder)
    if choice.models.get(channel, "mean") == "mean":
        return motions.adapted(channel, load_primitive(folder / channel, channel))
    context = contexts(demos, choice.context, motions, channel)
    return motions.adapted(channel, _at_context(folder, channel, choice, context))


def predicted_primitive(
    folder: Path, channel: str, start: Float[Tensor, " D"], goal: Float[Tensor, " D"]
) -> JointDMP:
    """Primitive of the best model for one start and goal; the mean where it is best, and where
    the best one needs other columns than start and goal.

    Raises:
        FileNotFoundError: The folder holds no model.
        ValueError: The model is damaged.
    """
    choice = _choice(folder)
    if choice.models.get(channel, "mean") == "mean" or choice.context:
        return cast(JointDMP, load_primitive(folder / channel, channel))
    return _at_context(folder, channel, choice, torch.cat([start, goal])[None])[0]


def _at_context(
    folder: Path, channel: str, choice: _Choice, context: Float[Tensor, "motions C"]
) -> JointDMP:
    """Primitives of a model that is not the mean."""
    if choice.models[channel] == "contextual":
        return ContextualDMP.load(folder / CONTEXTUAL / channel).at(context)
    each = cast(JointDMP, load_primitive(folder / EACH / channel, channel))
    x = each.coordinates().detach()
    known = torch.cat([x[..., -2], x[..., -1]], dim=-1)  # start and goal
    chosen = _nearest(context.to(known), known)
    like = cast(JointDMP, load_primitive(folder / channel, channel))
    return like.with_coordinates(x[chosen], each.duration[chosen])
