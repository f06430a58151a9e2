"""Choose the model that predicts held-out demonstrations best (see `dmp.learned_motion`).

A model predicts a motion from its context: values known before the motion, by default its
start and goal. The simplest model is the mean primitive. Models are chosen by channel: for the
joints and for the position of the end effector.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.demos import DemonstrationSet
from hrc_learn.dmp import JointDMP, LearnedMotion
from hrc_learn.dmp.learned_motion import FEWEST, Kind, choose
from hrc_learn.learning.primitive_fitting import FittedPrimitives, Motions, load_primitive
from hrc_learn.store import read_json, write_json

CHOICE = "prediction.json"
"""File in a model's folder that names the best kind of model for each channel."""
LEARNED = "learned"
"""Subfolder of the best models."""
LINEAR = ("joint", "position")
"""Channels whose models are compared."""


@dataclass(frozen=True, kw_only=True)
class _Choice:
    """Content of the file `CHOICE`."""

    models: dict[str, Kind]
    """Kind of the best model, by channel."""
    context: tuple[str, ...]
    """Columns whose first row is the context; empty: start and goal are the context."""


def contexts(
    demos: DemonstrationSet, columns: Sequence[str], motions: Motions, channel: str
) -> Float[Tensor, "demos C"]:
    """Context of each demonstration.

    Args:
        demos: Demonstrations.
        columns: Columns whose first row is the context. If empty: start and goal.
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
        if missing := [name for name in columns if name not in demo.extra]:
            raise ValueError(
                f"{demos.source}, episode {demo.episode}: no column {missing[0]!r} for the "
                f"context; there are {', '.join(demo.extra) or 'none'}."
            )
        rows.append(np.concatenate([np.atleast_1d(demo.extra[name][0]) for name in columns]))
    return torch.from_numpy(np.stack(rows)).double()


def keep_best(
    fitted: FittedPrimitives,
    demos: DemonstrationSet,
    columns: tuple[str, ...],
    folder: str | Path,
    *,
    regression_only: bool = False,
) -> dict[str, float]:
    """Compare models, and save the best one for each channel.

    Args:
        fitted: Primitives of the demonstrations.
        demos: Demonstrations.
        columns: Columns whose first row is the context. If empty: start and goal.
        folder: Folder of the model.
        regression_only: True to choose only among regressions on the context.

    Returns:
        Median held-out error of the best model of each kind, by the name
        `held_out_CHANNEL_KIND_nrmse_median`.

    Raises:
        ValueError: A demonstration lacks a column. With `regression_only`: no channel can be
            regressed, or there are too few demonstrations.
    """
    metrics: dict[str, float] = {}
    chosen: dict[str, str] = {}
    for channel in LINEAR:
        if channel not in fitted.each or (len(demos) < FEWEST and not regression_only):
            continue
        context = contexts(demos, columns, fitted.motions, channel) if columns else None
        best = choose([fitted.each[channel]], context, regression_only=regression_only)
        best.save(Path(folder, LEARNED, channel))
        chosen[channel] = best.chosen.kind
        for candidate in (*best.candidates, best.chosen):
            name = f"held_out_{channel}_{candidate.kind}_nrmse_median"
            error = float(candidate.error.median())
            known = metrics.get(name, error)
            metrics[name] = error if candidate is best.chosen else min(known, error)
    if regression_only and not chosen:
        raise ValueError("a regression on a context needs joint positions or tool positions.")
    if chosen:
        write_json(Path(folder, CHOICE), {"models": chosen, "context": columns})
    return metrics


def best_models(folder: str | Path) -> dict[str, str]:
    """Kind of the best model by channel, without channels for which the mean primitive is best.

    Raises:
        ValueError: The file is damaged.
    """
    return {k: v for k, v in _choice(folder).models.items() if v != "mean"}


def _choice(folder: str | Path) -> _Choice:
    path = Path(folder, CHOICE)
    if not path.is_file():
        return _Choice(models={}, context=())
    return read_json(path, _Choice, "fit again")


def predict(folder: str | Path, channel: str, motions: Motions, demos: DemonstrationSet) -> Any:
    """Motions that the best model predicts from context, start, goal and duration.

    Args:
        folder: Folder written by `hrc fit`.
        channel: Channel to predict.
        motions: Padded demonstrations.
        demos: The same demonstrations, with the columns of the context.

    Raises:
        FileNotFoundError: The folder holds no model.
        ValueError: The model is damaged, or a demonstration lacks a column of the context.
    """
    choice = _choice(folder)
    if channel not in choice.models:
        return motions.adapted(channel, load_primitive(Path(folder, channel), channel))
    context = contexts(demos, choice.context, motions, channel)
    model = LearnedMotion.load(Path(folder, LEARNED, channel))
    return motions.adapted(channel, cast(JointDMP, model.at_contexts(context)))


def predicted_primitive(
    folder: str | Path, channel: str, start: Float[Tensor, " D"], goal: Float[Tensor, " D"]
) -> JointDMP:
    """Primitive that the best model predicts for one start and goal.

    If no model was chosen, or its context is not start and goal, the result is the mean
    primitive.

    Raises:
        FileNotFoundError: The folder holds no model.
        ValueError: The model is damaged.
    """
    choice = _choice(folder)
    if channel not in choice.models or choice.context:
        return cast(JointDMP, load_primitive(Path(folder, channel), channel))
    return LearnedMotion.load(Path(folder, LEARNED, channel)).at(start, goal)
