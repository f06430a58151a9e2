"""Fits of datasets larger than memory: from a sample, or streamed."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from jaxtyping import Float

from hrc_learn.demos import Demonstration, DemonstrationSet, DemonstrationSource
from hrc_learn.distributed import LazyMap
from hrc_learn.dmp import JointDMP, fit_shared
from hrc_learn.learning.primitive_fitting import CHANNELS, require_motion

HELD_AT_ONCE = 700_000
"""Values of a channel (padded frames times joints, or 7 of a pose) that are held at once. Their
fit and the comparison of models take up to 300 MB."""
LONGEST = 5_000
"""Largest number of frames of one demonstration, up to 100 basis functions."""


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
    note = f"{count} of {len(lengths)} demonstrations, evenly spread, stand for all of them"
    if max(lengths) > longest:
        note += f"; {longest} frames of longer ones are used"
    note += "; --several streamed uses everything"
    notes, unit = (*source.notes, note), source.joint_unit
    return DemonstrationSet(demos, notes=notes, source=source.source, joint_unit=unit)


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
) -> tuple[dict[str, JointDMP], dict[str, float]]:
    """Fit one primitive to all demonstrations in a single pass, one in memory at a time.

    Args:
        demos: Demonstrations on disk.
        n_basis: Number of basis functions.
        channels: "joint", "position" or both. Default: joint.

    Returns:
        Primitives by channel, and measured values by name.

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
        fits[channel], rmse = fit_shared(
            LazyMap(demos, column),
            n_basis,
            joint_names=names,
            units=demos.joint_unit if channel == "joint" else "m",
        )
        metrics[f"mean_{channel}_rmse"] = float(rmse.square().mean().sqrt())
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
