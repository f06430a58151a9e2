"""Which model predicts demonstrations it has not seen best: their mean, a function of start and
goal, or the nearest of them.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import cast

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.demos import DemonstrationSet
from hrc_learn.dmp import ContextualDMP, JointDMP, fit_ridge
from hrc_learn.learning.channels import (
    Motions,
    Reproduction,
    load_primitive,
    reproduction_error,
)
from hrc_learn.learning.primitive_fitting import (
    CONTEXTUAL,
    EACH,
    FittedPrimitives,
    contexts,
    fit_contextual,
)
from hrc_learn.store import write_text

CHOICE = "prediction.json"
"""Says in the folder of a model what predicts each channel."""
MODELS = ("mean", "contextual", "nearest")
"""The simplest first."""
LINEAR = ("joint", "position")
"""Channels of which models are compared."""
FEWEST = 4
"""Demonstrations from which held-out errors tell models apart."""
_WORTH = 0.9
"""A model that is less simple has to bring the error down to this share."""
_REGULARIZATIONS = (1e-6, 1e-3, 1e-1, 1.0)
"""Of a function of the context, from hardly any to nearly the mean."""


@dataclass(frozen=True, kw_only=True)
class HeldOutErrors:
    """Errors of each demonstration, told its start, goal and duration and predicted from the
    others.
    """

    nrmse: Mapping[str, Float[Tensor, " demos"]]
    """By model: root mean square error over the range of the motion."""
    regularization: float
    """Of the function of the context. It is chosen by these very errors, from so few that they
    stay honest."""

    @property
    def median(self) -> dict[str, float]:
        """Of each model."""
        return {model: float(error.median()) for model, error in self.nrmse.items()}

    @property
    def best(self) -> str:
        """The simplest model that no other beats clearly."""
        best, *others = (model for model in MODELS if model in self.nrmse)
        for model in others:
            if self.median[model] < _WORTH * self.median[best]:
                best = model
        return best


def held_out_errors(
    fitted: FittedPrimitives, channel: str, context: Float[Tensor, "demos C"]
) -> HeldOutErrors:
    """Predict each demonstration from all others by every model.

    Nothing is fitted anew: the mean of the others and the ridge regression on them (PRESS)
    follow from the primitives of all in closed form.

    Args:
        fitted: With a primitive of every demonstration.
        channel: One of `LINEAR`.
        context: What each demonstration was about.
    """
    each = cast(JointDMP, fitted.each[channel])
    x, n = each.coordinates().detach().double(), len(context)

    def error(coordinates: Tensor) -> Tensor:
        made = fitted.motions.adapted(channel, each.with_coordinates(coordinates))
        measured = reproduction_error(channel, fitted.motions, made).columns()
        return measured["nrmse"].double()

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
    """Which known context is nearest, in spreads of each number.

    Args:
        asked: Contexts.
        known: Those of demonstrations.
        others: The two are the same, and none is its own neighbour.
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
    """Compare models, and save beside the mean what predicts better, where that is the case.

    Args:
        fitted: To the demonstrations.
        demos: The demonstrations.
        columns: Whose first row is the context; none: start and goal.
        folder: Of the model.

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
            # Saved demonstrations know their start and goal, but none of these columns.
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
        content = json.dumps({"models": chosen, "context": list(columns)}, indent=2)
        write_text(folder / CHOICE, f"{content}\n")
    return metrics


def best_models(folder: Path) -> dict[str, str]:
    """What predicts each channel, of the folder of a model; empty where that is the mean.

    Raises:
        ValueError: The file is damaged.
    """
    return {k: v for k, v in _choice(folder)[0].items() if v != "mean"}


def _choice(folder: Path) -> tuple[dict[str, str], tuple[str, ...]]:
    path = folder / CHOICE
    if not path.is_file():
        return {}, ()
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        models, columns = dict(content["models"]), tuple(content["context"])
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path}: damaged ({error!r}); fit again") from error
    unknown = sorted({*models.values()} - {*MODELS})
    if unknown:
        raise ValueError(f"{path}: unknown model {unknown[0]!r}; there are {', '.join(MODELS)}")
    return models, columns


def predict(
    folder: Path, channel: str, motions: Motions, demos: DemonstrationSet
) -> Reproduction:
    """Motions as the best model of a folder predicts them from start, goal and duration.

    Args:
        folder: Of a model, as `hrc fit` leaves it.
        channel: What is to be predicted.
        motions: Those of the demonstrations.
        demos: Which tell the context.

    Raises:
        FileNotFoundError: No saved model there.
        ValueError: It is damaged, or a demonstration lacks a column of the context.
    """
    models, columns = _choice(folder)
    model = models.get(channel, "mean")
    if model == "mean":
        return motions.adapted(channel, load_primitive(folder / channel, channel))
    context = contexts(demos, columns, motions, channel)
    if model == "contextual":
        primitives = ContextualDMP.load(folder / CONTEXTUAL / channel).at(context)
        return motions.adapted(channel, primitives)
    each = cast(JointDMP, load_primitive(folder / EACH / channel, channel))
    x = each.coordinates().detach()
    known = torch.cat([x[..., -2], x[..., -1]], dim=-1)  # start and goal
    chosen = _nearest(context.to(known), known)
    like = cast(JointDMP, load_primitive(folder / channel, channel))
    nearest = like.with_coordinates(x[chosen], each.duration[chosen])
    return motions.adapted(channel, nearest)
