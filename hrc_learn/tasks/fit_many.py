"""What several demonstrations teach beyond their mean: a function of a context, or one
primitive from more of them than memory holds.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import overload

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ..demos import Demonstration, DemonstrationSet, DemonstrationSource
from ..dmp import ContextualDMP, SharedFit, fit_shared
from .fit_primitives import FittedPrimitives
from .kinds import KINDS

CONTEXTUAL = "contextual"
"""Folder of the primitives that are functions of a context."""


def contexts(
    demos: DemonstrationSet, columns: Sequence[str], fitted: FittedPrimitives, kind: str
) -> Float[Tensor, "demos C"]:
    """What each demonstration was about.

    Args:
        demos: The demonstrations.
        columns: Whose first row it is; none: start and goal of the motion.
        fitted: To them.
        kind: Whose start and goal.

    Raises:
        ValueError: A demonstration lacks a column.
    """
    if not columns:
        motions = fitted.motions
        position = motions.position(kind)
        last = (motions.demos.length - 1)[:, None, None]
        goal = position.take_along_dim(last, dim=1)[:, 0]
        return torch.cat([position[:, 0], goal], dim=-1)
    rows = []
    for demo in demos:
        missing = [name for name in columns if name not in demo.extra]
        if missing:
            raise ValueError(
                f"{demos.source}, episode {demo.episode}: no column {missing[0]!r} to take a "
                f"context from; there are {', '.join(demo.extra) or 'none'}."
            )
        rows.append(np.concatenate([np.atleast_1d(demo.extra[name][0]) for name in columns]))
    return torch.from_numpy(np.stack(rows)).double()


def fit_contextual(
    fitted: FittedPrimitives, demos: DemonstrationSet, columns: Sequence[str], folder: Path
) -> dict[str, float]:
    """Fit a primitive for every context, of joints and of positions; save into the folder.

    Returns:
        Error of each demonstration predicted from the others: median and largest.

    Raises:
        ValueError: Fewer than two demonstrations, no such kind, or a context that is missing.
    """
    linear = [kind for kind in ("joint", "position") if kind in fitted.each]
    if not linear:
        raise ValueError("a function of a context is learned of joints or of positions.")
    metrics = {}
    for kind in linear:
        motions = fitted.motions
        model = ContextualDMP.fit(
            motions.demos.time,
            motions.position(kind),
            contexts(demos, columns, fitted, kind),
            fitted.n_basis,
            mask=motions.demos.mask,
            **motions.naming(kind),
            **fitted.options,
        )
        model.save(folder / CONTEXTUAL / kind)
        error = model.held_out.nrmse
        metrics[f"contextual_{kind}_held_out_nrmse_median"] = float(error.median())
        metrics[f"contextual_{kind}_held_out_nrmse_max"] = float(error.max())
    return metrics


class _Columns(Sequence[tuple[np.ndarray, np.ndarray]]):
    """Stamps and one column of demonstrations, read when asked for."""

    def __init__(self, demos: Sequence[Demonstration], name: str, source: str):
        self._demos, self._name, self._source = demos, name, source

    @overload
    def __getitem__(self, index: int) -> tuple[np.ndarray, np.ndarray]: ...
    @overload
    def __getitem__(self, index: slice) -> "_Columns": ...
    def __getitem__(self, index):
        if isinstance(index, slice):
            return _Columns(self._demos[index], self._name, self._source)
        return self._column(self._demos[index])

    def __len__(self) -> int:
        return len(self._demos)

    def __iter__(self) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        return map(self._column, self._demos)

    def _column(self, demo: Demonstration) -> tuple[np.ndarray, np.ndarray]:
        values = getattr(demo, self._name)
        if values is None:
            raise ValueError(f"{self._source}, episode {demo.episode}: no {self._name}.")
        return demo.time, values


def fit_streamed(
    demos: DemonstrationSource, n_basis: int, *, kinds: Sequence[str] = ()
) -> tuple[dict[str, SharedFit], dict[str, float]]:
    """Fit one primitive to all demonstrations, one of them in memory at a time.

    Args:
        demos: On disk.
        n_basis: Number of basis functions.
        kinds: Joint, position, or both; none: joint.

    Returns:
        The fits by kind, and what is to be said about them.

    Raises:
        ValueError: Another kind, whose coordinates depend on where demonstrations end.
    """
    fits, metrics = {}, {"demonstrations": float(len(demos)), "frames": float(demos.frames)}
    for kind in kinds or ("joint",):
        if kind not in ("joint", "position"):
            raise ValueError(f"kind {kind!r} is not streamed: joint and position are.")
        names = demos.joint_names if kind == "joint" else ("x", "y", "z")
        fit = fit_shared(
            _Columns(demos, KINDS[kind][0], demos.source),
            n_basis,
            joint_names=names,
            units="rad" if kind == "joint" else "m",
        )
        fits[kind] = fit
        metrics[f"mean_{kind}_rmse"] = float(fit.rmse.square().mean().sqrt())
    return fits, metrics
