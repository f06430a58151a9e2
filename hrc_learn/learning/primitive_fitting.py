"""Movement primitives of demonstrations by channel: each, their mean, and contextual ones."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.demos import DemonstrationSet, PaddedDemonstrations
from hrc_learn.dmp import (
    BasisSelection,
    ContextualDMP,
    JointDMP,
    PoseDMP,
    ProbabilisticDMP,
    mean_primitive,
    select_basis_count,
)
from hrc_learn.learning.channels import (
    Motions,
    Primitive,
    ReproductionError,
    reproduction_error,
    select_channels,
)

EACH = "each"
"""Folder of the primitives of single demonstrations."""


@dataclass(frozen=True, kw_only=True)
class FittedPrimitives:
    """Primitives of one motion: one for each demonstration, and their mean."""

    motions: Motions
    each: Mapping[str, Primitive]
    """Primitives of all demonstrations as a batch, by channel."""
    common: Mapping[str, Primitive]
    """Mean primitive without batch dimensions, by channel."""
    n_basis: int
    """Number of basis functions."""
    selection: BasisSelection | None = None
    """Selection of the number of basis functions; None if it was given."""
    options: Mapping[str, Any] = field(default_factory=dict)
    """Options of the fit."""
    every: Mapping[str, Primitive] = field(default_factory=dict)
    """Primitives of a dataset that `motions` and `each` are a sample of, by channel (see
    `fit_all`). Empty without a sample."""
    every_error: Mapping[str, ReproductionError] = field(default_factory=dict)
    """Errors of the primitives in `every`, by channel."""

    @property
    def demonstrations(self) -> PaddedDemonstrations:
        """Padded demonstrations."""
        return self.motions.demos

    @property
    def joint(self) -> JointDMP | None:
        """Joint primitives of the demonstrations; None if joints were not learned."""
        return cast(JointDMP | None, self.each.get("joint"))

    @property
    def pose(self) -> PoseDMP | None:
        """Pose primitives of the demonstrations, with the arm angle of a Panda."""
        return cast(PoseDMP | None, self.each.get("pose"))

    def save(self, folder: Path, each: bool = False) -> None:
        """Write the mean primitives to `folder/CHANNEL`.

        Args:
            folder: Folder of the model.
            each: Also write the primitives of single demonstrations, from which
                `ProbabilisticDMP` is fitted, to `folder/each/CHANNEL`.
        """
        for channel, primitive in self.common.items():
            primitive.save(folder / channel)
        for channel, primitives in {**self.each, **self.every}.items() if each else ():
            primitives.save(folder / EACH / channel)

    def distribution(self, channel: str) -> ProbabilisticDMP:
        """Gaussian distribution over the primitives of one channel.

        Raises:
            ValueError: There are fewer than two demonstrations, or the primitives are scaled.
        """
        return ProbabilisticDMP.fit({**self.each, **self.every}[channel])

    def metrics(self) -> dict[str, float]:
        """Errors of the primitives, by name.

        `mean_` marks the mean primitive, given start, goal and duration of each demonstration
        (of the sample, if there is one).
        """
        count = len(self.demonstrations.length)
        values = {"demonstrations": float(count), "basis_functions": float(self.n_basis)}
        if self.every:
            values["demonstrations_sampled"] = float(count)
        for channel in self.each:
            adapted = self.motions.adapted(channel, self.common[channel])
            own = self.every_error.get(channel)
            if own is None:
                made = self.motions.own(self.each[channel])
                own = reproduction_error(channel, self.motions, made)
            else:
                values["demonstrations"] = float(len(next(iter(own.columns().values()))))
            values |= own.summary(channel)
            values |= reproduction_error(channel, self.motions, adapted).summary(
                f"mean_{channel}"
            )
        return values


def fit_primitives(
    demos: DemonstrationSet,
    n_basis: int | None = 60,
    method: str = "trajectory",
    *,
    channels: Sequence[str] = (),
    candidates: Sequence[int] = (10, 15, 20, 30, 40, 60, 80, 100),
    **options: Any,
) -> FittedPrimitives:
    """Fit one primitive to each demonstration, and their mean.

    Args:
        demos: Demonstrations of one motion.
        n_basis: Number of basis functions. None: the smallest candidate that predicts held-out
            samples as well as the best one (see `select_basis_count`).
        method: See `JointDMP.fit`.
        channels: Channels to learn. Default: joints and pose, as far as they were recorded. A
            Panda's pose is computed from its joints, and its arm angle is learned too.
        candidates: Numbers of basis functions to choose from.
        options: Further fields of `FitOptions`, such as `robust` or `scaling`. `smooth` is True
            by default.

    Raises:
        ValueError: The demonstrations hold no motion, or lack a column of a channel.
    """
    motions = Motions.of(demos)
    channels = select_channels(motions, channels)
    # Without smoothing the fit would follow the noise of encoders and trackers.
    options = {"method": method, "smooth": True, **options}
    selection = None
    if n_basis is None:
        selection = _select(motions, channels[0], candidates, options)
        n_basis = selection.count
    each = {channel: motions.fit(channel, n_basis, **options) for channel in channels}
    return FittedPrimitives(
        motions=motions,
        each=each,
        common={channel: mean_primitive(cast(Any, each[channel])) for channel in channels},
        n_basis=n_basis,
        selection=selection,
        options=options,
    )


def _select(
    motions: Motions, channel: str, candidates: Sequence[int], options: Mapping[str, Any]
) -> BasisSelection:
    """Number of basis functions by the linear coordinates of a channel."""
    if channel == "orientation":
        raise ValueError(
            "the number of basis functions is chosen by joints or positions: give n_basis for "
            "orientations alone."
        )
    shortest = int(motions.demos.length.min())
    possible = [count for count in candidates if 2 * count <= shortest]
    if not possible:
        raise ValueError(
            f"the shortest demonstration has {shortest} samples, too few to choose the number "
            f"of basis functions from {', '.join(map(str, candidates))}: give n_basis."
        )
    return select_basis_count(
        motions.demos.time,
        motions.position(channel),
        possible,
        mask=motions.demos.mask,
        **options,
    )


CONTEXTUAL = "contextual"
"""Folder of contextual primitives."""


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
