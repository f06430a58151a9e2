"""Choice of the model that predicts held-out demonstrations best; see `dmp.learned_motion`."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, cast

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.demos import DemonstrationSet
from hrc_learn.dmp import ContextualDMP, JointDMP, LearnedMotion
from hrc_learn.dmp.learned_motion import Candidate, choose
from hrc_learn.learning.primitive_fitting import FittedPrimitives, Motions, load_primitive
from hrc_learn.learning.reproduction_error import Reproduction
from hrc_learn.store import read_json, write_json

CONTEXTUAL = "contextual"
"""Folder of contextual primitives."""
CHOICE = "prediction.json"
"""File in a model's folder that names the model of each channel."""
LEARNED = "learned"
"""Folder of the best models."""
MODELS = ("mean", "kernel", "nearest", "contextual", "line")
"""Kinds of model: the mean, a mean weighted by nearness, the nearest demonstration, a
regression, and a straight line; all but the line may be shrunk towards it."""
type Model = Literal["mean", "kernel", "nearest", "contextual", "line"]
FEWEST = 4
"""Smallest number of demonstrations whose held-out errors distinguish models."""
LINEAR = ("joint", "position")
"""Channels whose models are compared."""


@dataclass(frozen=True, kw_only=True)
class _Choice:
    """Content of the file `CHOICE`."""

    models: dict[str, Model]
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


def kind_of(candidate: Candidate) -> Model:
    """Kind of a model, one of `MODELS`."""
    if candidate.shrinkage == 0:
        return "line"
    if candidate.family == "ridge":
        return "contextual"
    named: dict[float, Model] = {0.0: "nearest", float("inf"): "mean"}
    return named.get(candidate.strength, "kernel")


def keep_best(
    fitted: FittedPrimitives, demos: DemonstrationSet, columns: tuple[str, ...], folder: Path
) -> dict[str, float]:
    """Compare models, and save the best one of each channel.

    Args:
        fitted: Primitives of the demonstrations.
        demos: Demonstrations.
        columns: Columns whose first row is the context. Default: start and goal.
        folder: Folder of the model.

    Returns:
        Median held-out errors, `held_out_CHANNEL_MODEL_nrmse_median`, of the best model of each
        kind.
    """
    metrics: dict[str, float] = {}
    chosen: dict[str, str] = {}
    for channel in LINEAR:
        if channel not in fitted.each or len(demos) < FEWEST:
            continue
        context = contexts(demos, columns, fitted.motions, channel) if columns else None
        best = choose([fitted.each[channel]], context)
        best.save(folder / LEARNED / channel)
        chosen[channel] = kind_of(best.chosen)
        for candidate in (*best.candidates, best.chosen):
            name = f"held_out_{channel}_{kind_of(candidate)}_nrmse_median"
            error = float(candidate.error.median())
            known = metrics.get(name, error)
            metrics[name] = error if candidate is best.chosen else min(known, error)
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
    if channel not in choice.models:
        return motions.adapted(channel, load_primitive(folder / channel, channel))
    context = contexts(demos, choice.context, motions, channel)
    model = LearnedMotion.load(folder / LEARNED / channel)
    return motions.adapted(channel, cast(JointDMP, model.at_contexts(context)))


def predicted_primitive(
    folder: Path, channel: str, start: Float[Tensor, " D"], goal: Float[Tensor, " D"]
) -> JointDMP:
    """Primitive of the best model for one start and goal; the mean where there is none, and
    where it needs other columns than start and goal.

    Raises:
        FileNotFoundError: The folder holds no model.
        ValueError: The model is damaged.
    """
    choice = _choice(folder)
    if channel not in choice.models or choice.context:
        return cast(JointDMP, load_primitive(folder / channel, channel))
    return LearnedMotion.load(folder / LEARNED / channel).at(start, goal)
