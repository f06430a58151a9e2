"""Fits of datasets larger than memory: from a sample, in batches, or streamed."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, cast

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.demos import Demonstration, DemonstrationSet, DemonstrationSource
from hrc_learn.dmp import SharedFit, fit_shared, mean_primitive
from hrc_learn.dmp.motion_primitive import concatenate
from hrc_learn.learning.primitive_fitting import (
    CHANNELS,
    FittedPrimitives,
    Motions,
    Primitive,
    require_motion,
)
from hrc_learn.learning.reproduction_error import ReproductionError

HELD_AT_ONCE = 700_000
"""Values of a channel (padded frames times joints, or 7 of a pose) that are held at once. Their
fit and the comparison of models take up to 300 MB."""
FITTED_AT_ONCE = 140_000
"""Values per batch in `fit_all`, large enough for fast matrix products."""
LONGEST = 5_000
"""Largest number of frames of one demonstration, up to 100 basis functions."""
_SAMPLES = 50
"""Frames for each basis function of more than 100: more add nothing that they can follow."""


class LazyMap[S, T](Sequence[T]):
    """Lazy map of a sequence: an item is computed when it is accessed."""

    def __init__(self, items: Sequence[S], function: Callable[[S], T]):
        self._items, self._function = items, function

    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, slice):
            return LazyMap(self._items[index], self._function)
        return self._function(self._items[index])

    def __len__(self) -> int:
        return len(self._items)

    def __iter__(self) -> Iterator[T]:
        return map(self._function, self._items)


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
    notes, unit = (*source.notes, note), source.joint_unit
    return DemonstrationSet(demos, notes=notes, source=source.source, joint_unit=unit)


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
            errors.append(motions.error(channel, motions.own(primitives)).columns())
            yield primitives

    primitives = concatenate(batches(), fitted.motions.demos.mask.shape[1])
    columns = {name: torch.cat([e[name] for e in errors]) for name in errors[0]}
    return primitives, ReproductionError(**columns)


def _batches(source: DemonstrationSource, longest: int) -> Iterator[DemonstrationSet]:
    """Batches of demonstrations within `FITTED_AT_ONCE`."""
    batch: list[Demonstration] = []
    made = partial(DemonstrationSet, source=source.source, joint_unit=source.joint_unit)
    for demo in source:
        demo = _thinned(demo, longest)
        padded = max(len(one) for one in (*batch, demo)) * (len(batch) + 1)
        if batch and padded * _width(source) > FITTED_AT_ONCE:
            yield made(batch)
            batch = []
        batch.append(demo)
    if batch:
        yield made(batch)


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
            units=demos.joint_unit if channel == "joint" else "m",
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
