"""From demonstrations to movement primitives: one for each channel, functions of a
context, or streamed from disk.
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
    ContextualDMP,
    DMPDistribution,
    JointDMP,
    PoseDMP,
    SharedFit,
    fit_shared,
    mean_primitive,
    select_basis_count,
)
from hrc_learn.dmp.batching import concatenate
from hrc_learn.kinematics import panda
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
from hrc_learn.log import JointRanges
from hrc_learn.viz import FitRecording
from hrc_learn.viz.recordings import Seen

EACH = "each"
"""Folder of the primitives of single demonstrations, where they are kept."""


@dataclass(frozen=True, kw_only=True)
class FittedPrimitives:
    """Primitives of one motion, one for each demonstration and what they have in common."""

    motions: Motions
    each: Mapping[str, Primitive]
    """By channel: one for each demonstration, as a batch."""
    common: Mapping[str, Primitive]
    """By channel: their mean, without batch dimensions."""
    n_basis: int
    selection: BasisSelection | None = None
    """How the number of basis functions was chosen, if it was."""
    options: Mapping[str, Any] = field(default_factory=dict)
    """Of the fit."""
    every: Mapping[str, Primitive] = field(default_factory=dict)
    """By channel: one for each demonstration of a dataset of which `motions` and `each` are a
    sample (see `fit_all`); empty where they are all."""
    every_error: Mapping[str, ReproductionError] = field(default_factory=dict)
    """By channel: how close those come to their demonstrations."""

    @property
    def demonstrations(self) -> PaddedDemonstrations:
        """What they were fitted to."""
        return self.motions.demos

    @property
    def joint(self) -> JointDMP | None:
        """One for each demonstration; None if joints were not learned."""
        return cast(JointDMP | None, self.each.get("joint"))

    @property
    def pose(self) -> PoseDMP | None:
        """The same for the end effector; of a Panda with the arm angle."""
        return cast(PoseDMP | None, self.each.get("pose"))

    def save(self, folder: Path, each: bool = False) -> None:
        """Write the common primitives into `folder/KIND`.

        Args:
            folder: Where.
            each: Keep those of single demonstrations too, in `folder/each/KIND`: what a
                `DMPDistribution` is made of.
        """
        for channel, primitive in self.common.items():
            primitive.save(folder / channel)
        for channel, primitives in {**self.each, **self.every}.items() if each else ():
            primitives.save(folder / EACH / channel)

    def distribution(self, channel: str) -> DMPDistribution:
        """Gaussian over the primitives of one channel.

        Raises:
            ValueError: Of fewer than two demonstrations, or scaled primitives.
        """
        return DMPDistribution.fit({**self.each, **self.every}[channel])

    def metrics(self) -> dict[str, float]:
        """How close the primitives come to their demonstrations.

        `mean_` is the common primitive, given start, goal and duration of each; of a sample
        where there is one.
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

    Joints are learned from any robot. The pose of the end effector is learned where it was
    recorded, or where nothing of it was and the joints are those of a Panda; of a Panda with
    its arm angle.

    Args:
        demos: Demonstrations of one motion.
        n_basis: Number of basis functions; None: the smallest of the candidates that
            predicts samples held out as well as the best (see `select_basis_count`).
        method: See `JointDMP.fit`.
        channels: To learn; none: joints and pose, or what there is of them.
        candidates: Numbers of basis functions to choose from.
        options: Further options of the fit, such as `robust` or `scaling`. Noise is taken off
            unless `smooth` says otherwise.

    Raises:
        ValueError: If the demonstrations hold no motion, or not what a channel needs.
    """
    motions = Motions.of(demos)
    channels = select_channels(motions, channels)
    # Recordings of arms and of people hold noise, which a fit would follow.
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


# More demonstrations than memory holds: all are fitted, some at a time, and a sample of them
# tells what needs many at once.

HELD_AT_ONCE = 700_000
"""Numbers of a channel (frames, padding included, times joints or 7 of a pose) that are held at
once: their fit and the comparison of models take up to 300 MB."""
FITTED_AT_ONCE = 140_000
"""Numbers fitted at a time where all are: enough for the speed of one matrix product."""
LONGEST = 5_000
"""Frames of one demonstration that are fitted where there are many, or more for more than 100
basis functions: `_SAMPLES` for each function tell all that these can follow."""
_SAMPLES = 50


def sampled(source: DemonstrationSource) -> DemonstrationSet:
    """All demonstrations, or some spread over them where all are too many to hold.

    A note says which. Of the longest, as many frames are kept as twice the usual ones have.

    Args:
        source: On disk.
    """
    lengths = source.lengths
    if len(lengths) * max(lengths) * _width(source) <= HELD_AT_ONCE:
        return source.load()
    longest = min(LONGEST, 2 * int(np.median(lengths)), max(lengths))
    count = min(len(lengths), max(1, HELD_AT_ONCE // (longest * _width(source))))
    demos = [_thinned(demo, longest) for demo in source.spread(count)]
    note = "all demonstrations are too long to hold"
    if count < len(lengths):
        note = f"{count} of {len(lengths)} demonstrations, spread over them, are a sample"
    if max(lengths) > longest:
        note += f"; of those longer than that, {longest} frames are taken"
    return DemonstrationSet(demos, notes=(*source.notes, note), source=source.source)


def fit_all(fitted: FittedPrimitives, source: DemonstrationSource) -> FittedPrimitives:
    """Fit every demonstration as a sample of them was fitted, some in memory at a time.

    What they have in common, their own primitives and their errors are then of all; what is
    else worked out from `motions` and `each` is of the sample.

    Args:
        fitted: To a sample, as `sampled` gives it.
        source: All demonstrations, on disk.

    Raises:
        ValueError: One of them cannot be read, or holds no motion; says which.
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
    """Primitives of all demonstrations, and their errors."""
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
    """Demonstrations one after another, as many at a time as may be fitted at once."""
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
    """Columns of the widest channel there may be."""
    return max(7, len(source.joint_names))


def _thinned(demo: Demonstration, longest: int) -> Demonstration:
    """A demonstration by that many of its frames at most, the first and the last among them."""
    if len(demo) <= longest:
        return demo
    kept = np.linspace(0, len(demo) - 1, longest).round().astype(int)
    return replace(
        demo,
        **{name: getattr(demo, name)[kept] for name in demo.recorded},
        fps=demo.fps * (longest - 1) / (len(demo) - 1),
        extra={key: values[kept] for key, values in demo.extra.items()},
    )


def _select(
    motions: Motions, channel: str, candidates: Sequence[int], options: Mapping[str, Any]
) -> BasisSelection:
    """By the linear coordinates of a channel; orientations alone give none to choose by."""
    if channel == "orientation":
        raise ValueError(
            "the number of basis functions is chosen by joints or positions: name it for "
            "orientations alone."
        )
    shortest = int(motions.demos.length.min())
    possible = [count for count in candidates if 2 * count <= shortest]
    if not possible:
        raise ValueError(
            f"the shortest demonstration has {shortest} samples, too few to choose the number "
            f"of basis functions from {', '.join(map(str, candidates))}: name it."
        )
    return select_basis_count(
        motions.demos.time,
        motions.position(channel),
        possible,
        mask=motions.demos.mask,
        **options,
    )


def fit_recording(
    fitted: FittedPrimitives,
    title: str,
    episodes: Sequence[int] = (),
    images: Mapping[int, Seen] | None = None,
) -> FitRecording:
    """Demonstrations beside their reproductions, to be looked at.

    Of the joints, or else of the position.

    Args:
        fitted: Them.
        title: What they are.
        episodes: Of a dataset that the demonstrations are, in their order.
        images: What cameras saw, by episode.

    Raises:
        ValueError: If neither was learned.
    """
    channel = next((k for k in ("joint", "position", "pose") if k in fitted.each), None)
    if channel is None:
        raise ValueError("orientations alone have no figure: learn the pose, or positions.")
    motions, lengths = fitted.motions, fitted.demonstrations.length.tolist()
    shown, made = motions.position(channel), motions.own(fitted.each[channel]).position
    assert made is not None

    def cut(padded: Tensor) -> tuple[np.ndarray, ...]:
        return tuple(
            values[:n].double().numpy() for values, n in zip(padded, lengths, strict=True)
        )

    limits, paths, reproduced = None, (), ()
    if channel != "joint":
        paths, reproduced = cut(shown), cut(made)
    elif motions.joint_names == panda.joint_names:
        limits = JointRanges(lower=panda.limits.lower.numpy(), upper=panda.limits.upper.numpy())
        paths = cut(panda.forward(shown.double()).position)
        reproduced = cut(panda.forward(made.double()).position)
    residual = {}
    if (selection := fitted.selection) is not None:
        residual = dict(zip(selection.candidates, selection.error.tolist(), strict=True))
    return FitRecording(
        title=title,
        joint_names=motions.joint_names if channel == "joint" else ("x", "y", "z"),
        time=cut(motions.demos.time),
        demos=cut(shown),
        reproductions=cut(made),
        joint_limits=limits,
        n_basis=fitted.n_basis,
        demo_paths=paths,
        reproduction_paths=reproduced,
        residual=residual,
        unit="rad" if channel == "joint" else "m",
        episodes=tuple(episodes),
        images=images or {},
    )


# What several demonstrations teach beyond their mean: a function of a context, or one
# primitive from more of them than memory holds.

CONTEXTUAL = "contextual"
"""Folder of the primitives that are functions of a context."""


def contexts(
    demos: DemonstrationSet, columns: Sequence[str], motions: Motions, channel: str
) -> Float[Tensor, "demos C"]:
    """What each demonstration was about.

    Args:
        demos: The demonstrations.
        columns: Whose first row it is; none: start and goal of the motion.
        motions: Those of the demonstrations.
        channel: Whose start and goal.

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
                f"{demos.source}, episode {demo.episode}: no column {missing[0]!r} to take a "
                f"context from; there are {', '.join(demo.extra) or 'none'}."
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
    """Fit a primitive for every context, of joints and of positions; save into the folder.

    Args:
        fitted: To the demonstrations.
        demos: The demonstrations.
        columns: Whose first row is the context; none: start and goal.
        folder: Of the model.
        channels: Those wanted of them.
        regularization: See `ContextualDMP.fit`.

    Returns:
        Error of each demonstration predicted from the others: median and largest.

    Raises:
        ValueError: Fewer than two demonstrations, no such channel, or a missing context.
    """
    linear = [channel for channel in channels if channel in fitted.each]
    if not linear:
        raise ValueError("a function of a context is learned of joints or of positions.")
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


def fit_streamed(
    demos: DemonstrationSource, n_basis: int, *, channels: Sequence[str] = ()
) -> tuple[dict[str, SharedFit], dict[str, float]]:
    """Fit one primitive to all demonstrations, one of them in memory at a time.

    Args:
        demos: On disk.
        n_basis: Number of basis functions.
        channels: Joint, position, or both; none: joint.

    Returns:
        The fits by channel, and what is to be said about them.

    Raises:
        ValueError: Another channel, whose coordinates depend on where demonstrations end.
    """
    fits, metrics = {}, {"demonstrations": float(len(demos)), "frames": float(demos.frames)}
    for channel in channels or ("joint",):
        if channel not in ("joint", "position"):
            raise ValueError(f"channel {channel!r} is not streamed: joint and position are.")
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
    """Stamps [s] and one column of a demonstration."""
    require_motion(demo, source)
    values = getattr(demo, name)
    if values is None:
        raise ValueError(f"{source}, episode {demo.episode}: no {name}.")
    return demo.time, values
