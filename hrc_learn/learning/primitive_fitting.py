"""Movement primitives of demonstrations by channel: of each, and their mean.

Datasets larger than memory are fitted from a sample, in batches, or streamed.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.demos import (
    Demonstration,
    DemonstrationSet,
    DemonstrationSource,
    PaddedDemonstrations,
)
from hrc_learn.dmp import (
    BasisSelection,
    ProbabilisticDMP,
    SharedFit,
    fit_shared,
    mean_primitive,
    select_basis_count,
)
from hrc_learn.dmp.motion_primitive import concatenate
from hrc_learn.learning.channels import (
    CHANNELS,
    LazyMap,
    Motions,
    Primitive,
    ReproductionError,
    reproduction_error,
    require_motion,
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
        count = float(len(self.demonstrations.length))
        values = {"demonstrations": count, "basis_functions": float(self.n_basis)}
        if self.every:
            values["demonstrations_sampled"] = count
        for channel, primitives in self.each.items():
            own, mean = (
                reproduction_error(channel, self.motions, made)
                for made in (
                    self.motions.own(primitives),
                    self.motions.adapted(channel, self.common[channel]),
                )
            )
            if self.every:
                own = self.every_error[channel]
                values["demonstrations"] = float(len(next(iter(own.columns().values()))))
            values |= own.summary(channel) | mean.summary(f"mean_{channel}")
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


HELD_AT_ONCE = 700_000
"""Values of a channel (padded frames times joints, or 7 of a pose) that are held at once. Their
fit and the comparison of models take up to 300 MB."""
FITTED_AT_ONCE = 140_000
"""Values per batch in `fit_all`, large enough for fast matrix products."""
LONGEST = 5_000
"""Largest number of frames of one demonstration, up to 100 basis functions."""
_SAMPLES = 50
"""Frames for each basis function of more than 100: more add nothing that they can follow."""


def sampled(source: DemonstrationSource) -> DemonstrationSet:
    """All demonstrations, or an evenly spread sample of a dataset that is too large.

    Demonstrations of more than twice the median length are thinned. A note describes this.

    Args:
        source: Demonstrations on disk.
    """
    lengths = source.lengths
    if len(lengths) * max(lengths) * _width(source) <= HELD_AT_ONCE:
        return source.load()
    longest = min(LONGEST, 2 * int(np.median(lengths)), max(lengths))
    count = min(len(lengths), max(1, HELD_AT_ONCE // (longest * _width(source))))
    demos = [_thinned(demo, longest) for demo in source.spread(count)]
    note = "the demonstrations are too long for memory"
    if count < len(lengths):
        note = f"{count} of {len(lengths)} demonstrations, evenly spread, are a sample"
    if max(lengths) > longest:
        note += f"; of longer ones {longest} frames are used"
    return DemonstrationSet(demos, notes=(*source.notes, note), source=source.source)


def fit_all(fitted: FittedPrimitives, source: DemonstrationSource) -> FittedPrimitives:
    """Fit every demonstration with the options of a sample's fit, batch by batch.

    The mean, `every` and `every_error` of the result cover all demonstrations; `motions` and
    `each` stay those of the sample.

    Args:
        fitted: Fit of the sample that `sampled` returns.
        source: All demonstrations on disk.

    Raises:
        ValueError: A demonstration cannot be read or holds no motion; the message names it.
    """
    found = {channel: _fit_channel(fitted, source, channel) for channel in fitted.each}
    every = {channel: primitives for channel, (primitives, _) in found.items()}
    return replace(
        fitted,
        every=every,
        every_error={channel: error for channel, (_, error) in found.items()},
        common={k: mean_primitive(cast(Any, primitives)) for k, primitives in every.items()},
    )


def _fit_channel(
    fitted: FittedPrimitives, source: DemonstrationSource, channel: str
) -> tuple[Primitive, ReproductionError]:
    """Primitives of all demonstrations with their errors."""
    errors: list[dict[str, Tensor]] = []

    def batches() -> Iterator[Primitive]:
        for demos in _batches(source, max(LONGEST, _SAMPLES * fitted.n_basis)):
            motions = Motions.of(demos)
            primitives = motions.fit(channel, fitted.n_basis, **fitted.options)
            error = reproduction_error(channel, motions, motions.own(primitives))
            errors.append(error.columns())
            yield primitives

    primitives = concatenate(batches(), fitted.motions.demos.mask.shape[1])
    columns = {name: torch.cat([e[name] for e in errors]) for name in errors[0]}
    return primitives, ReproductionError(**columns)


def _batches(source: DemonstrationSource, longest: int) -> Iterator[DemonstrationSet]:
    """Batches of demonstrations within `FITTED_AT_ONCE`."""
    batch: list[Demonstration] = []
    for demo in source:
        demo = _thinned(demo, longest)
        padded = max(len(one) for one in (*batch, demo)) * (len(batch) + 1)
        if batch and padded * _width(source) > FITTED_AT_ONCE:
            yield DemonstrationSet(batch, source=source.source)
            batch = []
        batch.append(demo)
    if batch:
        yield DemonstrationSet(batch, source=source.source)


def _width(source: DemonstrationSource) -> int:
    """Number of columns of the widest channel."""
    return max(7, len(source.joint_names))


def _thinned(demo: Demonstration, longest: int) -> Demonstration:
    """Demonstration with at most that many frames, including the first and the last."""
    if len(demo) <= longest:
        return demo
    kept = np.linspace(0, len(demo) - 1, longest).round().astype(int)
    return replace(
        demo,
        **{name: getattr(demo, name)[kept] for name in demo.recorded},
        fps=demo.fps * (longest - 1) / (len(demo) - 1),
        extra={key: values[kept] for key, values in demo.extra.items()},
    )


def fit_streamed(
    demos: DemonstrationSource, n_basis: int, *, channels: Sequence[str] = ()
) -> tuple[dict[str, SharedFit], dict[str, float]]:
    """Fit one primitive to all demonstrations in a single pass, one in memory at a time.

    Args:
        demos: Demonstrations on disk.
        n_basis: Number of basis functions.
        channels: "joint", "position" or both. Default: joint.

    Returns:
        Fits by channel, and measured values by name.

    Raises:
        ValueError: Another channel, whose coordinates depend on the goal of a demonstration.
    """
    fits, metrics = {}, {"demonstrations": float(len(demos)), "frames": float(demos.frames)}
    for channel in channels or ("joint",):
        if channel not in ("joint", "position"):
            raise ValueError(
                f"channel {channel!r} cannot be streamed, only joint and position."
            )
        names = demos.joint_names if channel == "joint" else ("x", "y", "z")
        column = partial(_stamped_column, name=CHANNELS[channel][0], source=demos.source)
        fit = fit_shared(
            LazyMap(demos, column),
            n_basis,
            joint_names=names,
            units="rad" if channel == "joint" else "m",
        )
        fits[channel] = fit
        metrics[f"mean_{channel}_rmse"] = float(fit.rmse.square().mean().sqrt())
    return fits, metrics


def _stamped_column(
    demo: Demonstration, name: str, source: str
) -> tuple[Float[np.ndarray, " T"], Float[np.ndarray, "T D"]]:
    """Time stamps [s] and one column of a demonstration."""
    require_motion(demo, source)
    values = getattr(demo, name)
    if values is None:
        raise ValueError(f"{source}, episode {demo.episode}: no {name}.")
    return demo.time, values
