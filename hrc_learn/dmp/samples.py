"""Recorded samples of demonstrations, checked, batched and smoothed, and residuals of a fit.

Noise is removed by penalised splines (Eilers and Marx 1996, "Flexible smoothing with B-splines
and penalties"). The samples are y = B c + noise, with splines B and control points c. A penalty
applies to the third differences of c, which stand for the jerk. The strength of the penalty
maximises the restricted likelihood of the samples (Wood 2011) for Gaussian jerks, in each
column separately. The same likelihood gives the standard deviation of the noise, whether it
comes from encoders, a tracker or a trembling hand.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial, reduce
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from hrc_learn.dmp._arguments import Mask, Points, Times, to_tensor
from hrc_learn.dmp.dynamics import DEGREE, cubic_spline
from hrc_learn.geometry.numerics import cached_tensors

MINIMUM_SAMPLES = 3
"""Start, goal and one sample between them; two leave nothing to fit."""

MAXIMUM_KNOTS = 120
"""Largest number of spline intervals: more than any reasonable number of basis functions."""
STRENGTHS = -10, 6, 81
"""Decimal exponents of the first and the last penalty compared, relative to the samples, and
the number of penalties. A step of 0.2 decades changes the error by less than 1 %."""
LIKELIHOOD_MARGIN = 1.0
"""Twice the logarithm of the largest likelihood ratio that is not significant. A margin of two
standard deviations would be 4."""
CLEAN = 2e-5
"""Samples with less noise than this, relative to the range, stay unchanged. The bound is the
accuracy of a fit with fifty functions."""
ORDER = 3
"""Order of the penalised differences; third differences are zero for motions without jerk."""
SAMPLES_EACH = 1.5
"""Samples per basis function that a fit needs to determine the motion between samples. With
fewer, accelerations are several times too large."""
DENSE = 4
"""Samples per basis function on the grids of `densified`: enough to resolve its cubics."""


@dataclass(frozen=True, kw_only=True, eq=False)
class FitReport:
    """Residuals of a reproduction, in the units of the demonstration."""

    rmse: Float[Tensor, "*batch D"]
    """Root mean square error of each coordinate."""
    peak: Float[Tensor, "*batch D"]
    """Largest absolute error of each coordinate."""
    span: Float[Tensor, "*batch D"]
    """Range of each coordinate in the demonstration."""
    noise: Float[Tensor, "*batch D"] | None = None
    """Estimated standard deviation of the noise removed by smoothing."""

    @property
    def nrmse(self) -> Float[Tensor, "*batch"]:
        """RMSE over all samples and coordinates, relative to the largest range."""
        return self.rmse.square().mean(-1).sqrt() / self.span.amax(-1)

    def tensors(self) -> dict[str, Tensor]:
        """Fields that are present, by name."""
        return {name: values for name, values in vars(self).items() if values is not None}


@dataclass(frozen=True, kw_only=True, eq=False)
class Samples:
    """Sampled demonstrations on a flat batch, time last, padded where `mask` is false."""

    batch: tuple[int, ...]
    """Batch shape that was flattened to B."""
    s: Float[Tensor, "B T"]
    """Normalised time since the first sample, 0 to 1, non-decreasing (float64)."""
    duration: Float[Tensor, "B"]
    """Time from the first to the last sample [s] (float64)."""
    position: Float[Tensor, "B D T"]
    velocity: Float[Tensor, "B D T"] | None
    mask: Bool[Tensor, "B T"]
    complete: bool
    """True if the mask is true everywhere."""

    @property
    def columns(self) -> Float[Tensor, "*batch T D"]:
        """Position in the layout of the caller, time before coordinates."""
        return self.position.mT.reshape(*self.batch, -1, self.position.shape[-2])

    @cached_property
    def shared_grid(self) -> bool:
        """True if all demonstrations have the same normalised times; one fit serves all."""
        if len(self.s) == 1 or not self.complete:
            return self.complete
        # Timestamps with different origins differ by rounding, below 1e-12 of the duration.
        return bool(((self.s - self.s[:1]).abs() < 1e-12).all())

    @property
    def timestamps(self) -> Float[Tensor, "*#batch T"]:
        """Normalised times, one grid or one for each demonstration."""
        return self.s[0] if self.shared_grid else self.s.view(*self.batch, -1)

    @cached_property
    def first(self) -> Float[Tensor, "B D"]:
        """Position at the first valid sample."""
        if self.complete:
            return self.position[..., 0]
        return self._at(self.mask.long().argmax(-1))

    @cached_property
    def last(self) -> Float[Tensor, "B D"]:
        """Position at the last valid sample."""
        if self.complete:
            return self.position[..., -1]
        return self._at(self.mask.shape[-1] - 1 - self.mask.flip(-1).long().argmax(-1))

    @cached_property
    def span(self) -> Float[Tensor, "B D"]:
        """Range of each coordinate."""
        # Masked samples are replaced by the first one, which leaves the range unchanged.
        position = self._filled(self.position, self.first[..., None])
        # Two reductions, because `aminmax` takes ten times as long.
        return position.amax(-1) - position.amin(-1)

    @cached_property
    def amplitude(self) -> Float[Tensor, "B D"]:
        """Range of each coordinate, as a divisor: 1 for a coordinate that never moves."""
        return self.span.masked_fill(self.span == 0, 1.0)

    def compare(
        self,
        reproduction: Float[Tensor, "*batch T D"],
        noise: Float[Tensor, "B D"] | None = None,
    ) -> FitReport:
        """Residuals of a reproduction at the valid samples; `noise` is stored with them."""
        made = reproduction.mT.reshape(self.position.shape)
        error = self._filled(made - self.position, 0.0)
        valid = error.shape[-1] if self.complete else self.mask.sum(-1, keepdim=True)
        return FitReport(
            rmse=self.batched(error.norm(dim=-1) / valid**0.5),
            peak=self.batched(error.abs().amax(-1)),
            span=self.batched(self.span),
            noise=None if noise is None else self.batched(noise),
        )

    def batched(self, values: Float[Tensor, "B *rest"]) -> Float[Tensor, "*batch_and_rest"]:
        """Values in the batch shape and dtype of the demonstrations."""
        values = values.to(self.position.dtype)
        return values.reshape(self.batch + values.shape[1:]) if self.batch else values[0]

    def _at(self, index: Tensor) -> Tensor:
        return torch.take_along_dim(self.position, index[:, None, None], dim=-1)[..., 0]

    def _filled(self, values: Tensor, filling: Tensor | float) -> Tensor:
        return values if self.complete else torch.where(self.mask[:, None], values, filling)


def padded(time: Any, mask: Mask | None, *columns: Any) -> tuple[Any, Mask | None, list[Any]]:
    """Pad lists of demonstrations to one batch; other arguments are returned unchanged.

    Args:
        time: List of timestamps (T_i,), or one grid for all demonstrations.
        mask: List of masks (T_i,), true at valid samples, or None.
        columns: Lists of values, (T_i,) or (T_i, D); a column may be None.

    Raises:
        ValueError: The lists disagree about the number of demonstrations or samples.
    """
    first = columns[0]
    listed = isinstance(first, list | tuple) and all(hasattr(x, "shape") for x in first)
    if not listed or not first or not first[0].ndim:
        return time, mask, list(columns)
    parts = [None if x is None else [to_tensor(row) for row in x] for x in columns]
    lengths = [len(x) for x in first]
    if not isinstance(time, list | tuple) or not any(map(np.ndim, time)):
        time = [time] * len(first)
    parts.append([to_tensor(row, torch.float64) for row in time])
    valid = [torch.ones(n, dtype=torch.bool) for n in lengths]
    if mask is not None:
        valid = [to_tensor(row).bool() for row in mask]
    parts.append(valid)
    for part in parts:
        if part is not None and [len(row) for row in part] != lengths:
            raise ValueError(
                f"demonstrations have {lengths} samples, but time, mask or another column has "
                f"{[len(row) for row in part]}"
            )
    joined = [
        None if part is None else torch.nn.utils.rnn.pad_sequence(part, batch_first=True)
        for part in parts
    ]
    complete = mask is None and len(set(lengths)) == 1
    return joined[-2], None if complete else joined[-1], joined[:-2]


def check_samples(
    time: Times,
    position: Points,
    velocity: Points | None = None,
    mask: Mask | None = None,
    *,
    name: str = "position",
) -> Samples:
    """Check recorded samples and flatten their batch.

    Args:
        time: Timestamps [s], (T,) or (*B, T), with any origin and spacing.
        position: Positions, (T,), (T, D) or (*B, T, D); D = 1 if they have the shape of `time`.
        velocity: Recorded velocities, shaped like `position`, or None.
        mask: Mask shaped like `time`, true at valid samples. Invalid samples may have any
            value, NaN included. None: all samples are valid.
        name: Name of `position` in error messages.

    Raises:
        ValueError: Shapes that do not fit, values that are not finite, time that does not
            increase, or fewer than 3 samples. The message names the sample or the shape.
    """
    position = _floating(position)
    time = to_tensor(time, torch.float64, position.device)
    if position.shape == time.shape:
        position = position[..., None]
        velocity = None if velocity is None else to_tensor(velocity)[..., None]
    if position.ndim < 2 or time.ndim == 0:
        raise ValueError(
            f"time has shape {tuple(time.shape)}, position {tuple(position.shape)}: expected "
            "(T,) and (T, D)"
        )
    *batch, T, D = position.shape
    time = expanded("time", time, (*batch, T), position)
    complete = mask is None
    if mask is None:
        mask = torch.ones_like(time, dtype=torch.bool)
    else:
        mask = to_tensor(mask, device=time.device).bool()
        mask = expanded("mask", mask, (*batch, T), position)
        complete = bool(mask.all())
    if position.numel() == 0:
        raise ValueError(f"{name} has shape {(*batch, T, D)}: there is nothing to fit")
    time, mask = time.reshape(-1, T), mask.reshape(-1, T)
    _check_count(mask, batch)
    _check_finite("time", time[:, None], mask, batch)
    # Time comes last from here on, because all computations run along it.
    position = _check_finite(name, position.reshape(-1, T, D).mT.contiguous(), mask, batch)
    if velocity is not None:
        velocity = to_tensor(velocity, position.dtype, position.device)
        velocity = expanded("velocity", velocity, (*batch, T, D), position)
        velocity = velocity.reshape(-1, T, D).mT.contiguous()
        velocity = _check_finite("velocity", velocity, mask, batch)
    s, duration = _normalised(time, mask, complete, batch)
    return Samples(
        batch=tuple(batch),
        s=s,
        duration=duration,
        position=position,
        velocity=velocity,
        mask=mask,
        complete=complete,
    )


def check_precision(dtype: torch.dtype) -> None:
    """Raise ValueError unless the dtype is float32 or float64.

    Weights reach several thousand: rounding them to half precision moves the path by more than
    a radian.
    """
    if dtype not in (torch.float32, torch.float64):
        raise ValueError(
            f"a primitive needs float32 or float64, got {dtype}: cast its rollouts instead"
        )


def demo_label(index: int, batch: Sequence[int]) -> str:
    """Prefix of an error message that names a demonstration by its index in the batch."""
    if not batch:
        return ""
    place = tuple(int(k) for k in np.unravel_index(index, batch))
    return f"demonstration {place[0] if len(place) == 1 else place}: "


def _floating(values: Points) -> Tensor:
    tensor = to_tensor(values)
    dtype = tensor.dtype if tensor.is_floating_point() else torch.get_default_dtype()
    check_precision(dtype)
    return to_tensor(tensor, dtype)  # refuses booleans, which are no positions


def expanded(name: str, values: Tensor, shape: tuple[int, ...], position: Tensor) -> Tensor:
    """Values expanded to this shape.

    Raises:
        ValueError: The values do not fit; the message names the shape of `position` too.
    """
    try:
        return values.expand(shape)
    except RuntimeError:
        raise ValueError(
            f"{name} has shape {tuple(values.shape)}, position {tuple(position.shape)}: "
            f"{name} must be {tuple(shape)}, where leading axes may be left out"
        ) from None


def _check_count(mask: Bool[Tensor, "B T"], batch: Sequence[int]) -> None:
    few = mask.sum(-1) < MINIMUM_SAMPLES
    if few.any():
        i = int(few.nonzero()[0])
        raise ValueError(
            f"{demo_label(i, batch)}a motion needs at least {MINIMUM_SAMPLES} samples, "
            f"got {int(mask[i].sum())}"
        )


def _check_finite(
    name: str, values: Float[Tensor, "B D T"], mask: Bool[Tensor, "B T"], batch: Sequence[int]
) -> Tensor:
    """Values with zeros at masked samples that are not finite.

    Raises:
        ValueError: A valid sample is not finite.
    """
    # A finite sum proves that all values are finite. Finite values may overflow in a sum, so a
    # sum that is not finite proves nothing yet.
    if math.isfinite(values.sum().item()):
        return values
    bad = ~values.isfinite() & mask[:, None]
    if bad.any():
        i, column, k = bad.nonzero()[0].tolist()
        where = f"sample {k}" if name == "time" else f"sample {k}, column {column}"
        value = values[i, column, k].item()
        raise ValueError(f"{demo_label(i, batch)}{name} is {value} at {where}")
    return values.masked_fill(~mask[:, None], 0)


def _normalised(
    time: Tensor, mask: Tensor, complete: bool, batch: Sequence[int]
) -> tuple[Float[Tensor, "B T"], Float[Tensor, "B"]]:
    """Normalised times and durations [s]; ValueError if time does not increase."""
    if complete:
        elapsed = time - time[:, :1]
        if (elapsed[:, 1:] > elapsed[:, :-1]).all():
            duration = elapsed[:, -1:]
            return elapsed / duration, duration[..., 0]
    first = time.masked_fill(~mask, torch.inf).amin(-1, keepdim=True)
    last = time.masked_fill(~mask, -torch.inf).amax(-1, keepdim=True)
    # Masked samples repeat the time before them, so that times never decrease.
    elapsed = (time - first).masked_fill(~mask, 0)
    latest = torch.cat([torch.full_like(first, -1.0), elapsed.cummax(-1).values], dim=-1)
    stalled = mask & (elapsed <= latest[..., :-1])
    # The first valid sample has elapsed time zero, like the masked ones before it.
    stalled &= mask.long().cumsum(-1) > 1
    if stalled.any():
        i, k = stalled.nonzero()[0].tolist()
        raise ValueError(
            f"{demo_label(i, batch)}time must increase, but is {time[i, k].item():.6f} s "
            f"at sample {k} after {(latest[i, k] + first[i, 0]).item():.6f} s: remove repeated "
            "samples, or give large times in float64"
        )
    duration = last - first
    return elapsed.cummax(-1).values / duration, duration[..., 0]


def smoothed(samples: Samples) -> tuple[Samples, Float[Tensor, "B D"]]:
    """Samples without noise, and the standard deviation of the noise in each column.

    Columns with less noise than `CLEAN`, and columns that never move, stay unchanged.
    """
    position = samples.position.double()
    smooth, noise = position.clone(), torch.zeros_like(position[..., 0])
    if samples.shared_grid:
        smooth, noise = _smooth(samples.s[0], position)
    else:
        for i, valid in enumerate(samples.mask):
            smooth[i, :, valid], noise[i] = _smooth(samples.s[i, valid], position[i, :, valid])
    noisy = (noise > CLEAN * samples.span)[..., None]
    smooth = torch.where(noisy, smooth, position)
    return replace(samples, position=smooth.to(samples.position)), noise


def _smooth(s: Float[Tensor, "T"], y: Float[Tensor, "*batch T"]) -> tuple[Tensor, Tensor]:
    return _spline(s.cpu().numpy().tobytes(), s.device).smooth(y)


def densified(samples: Samples, n_basis: int) -> Samples:
    """Samples that are dense enough to determine all basis functions in each demonstration.

    New samples between the recorded ones lie on cubics with the recorded velocities, or with
    slopes from second-order differences, which are exact for parabolas.
    """
    few = samples.mask.sum(-1) <= SAMPLES_EACH * n_basis
    if not few.any():
        return samples
    grid = torch.linspace(0, 1, DENSE * n_basis + 1, dtype=torch.float64).to(samples.s)
    recorded, rows = samples.velocity, []
    for i, sparse in enumerate(few.tolist()):
        valid, tau = samples.mask[i], samples.duration[i]
        s, y = samples.s[i, valid], samples.position[i][:, valid].double()
        rate = torch.zeros_like(y) if recorded is None else recorded[i][:, valid].double() * tau
        if sparse:
            if recorded is None:
                (rate,) = torch.gradient(y, spacing=(s,), dim=-1, edge_order=2)
            s, (y, rate) = grid, _cubic(s, y, rate, grid)
        rows.append((s, y.mT, rate.mT / tau, torch.ones_like(s)))
    pad = partial(torch.nn.utils.rnn.pad_sequence, batch_first=True)
    s, position, velocity, mask = (pad(list(column)) for column in zip(*rows, strict=True))
    return replace(
        samples,
        # Padding repeats the last time, so that times do not decrease.
        s=s.cummax(-1).values,
        position=position.mT,
        velocity=None if recorded is None else velocity.mT,
        mask=mask.bool(),
        complete=bool(mask.all()),
    )


def _cubic(
    knots: Float[Tensor, "T"],
    y: Float[Tensor, "C T"],
    rate: Float[Tensor, "C T"],
    s: Float[Tensor, "G"],
) -> tuple[Float[Tensor, "C G"], Float[Tensor, "C G"]]:
    """Value and derivative of the Hermite cubics between samples with these rates."""
    k = torch.searchsorted(knots, s, right=True).clamp(1, len(knots) - 1) - 1
    h = knots.diff()[k]
    u, chord = (s - knots[k]) / h, y.diff()[:, k] / h
    r0, r1 = rate[:, k], rate[:, k + 1]
    b, c = 3 * chord - 2 * r0 - r1, r0 + r1 - 2 * chord
    return y[:, k] + h * u * (r0 + u * (b + u * c)), r0 + u * (2 * b + 3 * u * c)


@dataclass(frozen=True, eq=False)
class _Spline:
    """Splines on a time grid, in coordinates that diagonalise both samples and penalty."""

    first: Int[Tensor, "T"]
    """Index of the first of the four splines that are not zero at each sample."""
    values: Float[Tensor, "T 4"]
    """Values of these four splines."""
    V: Float[Tensor, "K K"]
    """Maps coordinates to control points."""
    data: Float[Tensor, "K"]
    """Precision of each coordinate from the samples, 0 to 1; the penalty adds the rest."""

    def at_samples(self, points: Float[Tensor, "*batch K"]) -> Float[Tensor, "*batch T"]:
        """Values of the splines with these control points, at the samples."""
        parts = (points[..., self.first + k] * self.values[:, k] for k in range(4))
        return reduce(torch.add, parts)

    def projected(self, y: Float[Tensor, "*batch T"]) -> Float[Tensor, "*batch K"]:
        """Scalar products of samples and each spline; the transpose of `at_samples`."""
        total = y.new_zeros(*y.shape[:-1], len(self.V))
        for k in range(4):
            total.index_add_(-1, self.first + k, y * self.values[:, k])
        return total

    def smooth(self, y: Float[Tensor, "*batch T"]) -> tuple[Float[Tensor, "*batch T"], Tensor]:
        """Most likely motion and the standard deviation of the noise, for each column."""
        T = y.shape[-1]
        middle = y.mean(-1, keepdim=True)
        y = y - middle
        c = self.projected(y) @ self.V
        e, r = self.data, 1 - self.data
        strengths = torch.logspace(*STRENGTHS)[:, None].to(y)
        # Precisions of coordinate k: strength * r_k from the prior, e_k from the samples.
        total = e + strengths * r
        free = r < 1e-9
        n = T - int(free.sum())
        # Minimum of the penalty plus the squared distance to the samples.
        misfit = y.square().sum(-1, keepdim=True) - c.square() @ (1 / total).mT
        misfit = misfit.clamp(min=torch.finfo(y.dtype).tiny)
        prior = torch.where(free, 1.0, strengths * r)
        known = torch.where(free, 1.0, total)
        score = n * misfit.log() + (known.log() - prior.log()).sum(-1)
        # The strongest penalty that is not significantly less likely than the best.
        likely = score <= score.amin(-1, keepdim=True) + LIKELIHOOD_MARGIN
        best = (likely * torch.arange(1, len(strengths) + 1, device=y.device)).argmax(-1)
        fitted = self.at_samples((c / total[best]) @ self.V.mT)
        noise = (misfit.gather(-1, best[..., None])[..., 0] / n).sqrt()
        return fitted + middle, noise


# Demonstrations on one grid use one spline.
@cached_tensors(maxsize=16)
def _spline(timestamps: bytes, device: torch.device) -> _Spline:
    s = torch.frombuffer(bytearray(timestamps), dtype=torch.float64).to(device)
    knots = max(4, min(MAXIMUM_KNOTS, len(s) // 2))
    K = knots + DEGREE
    x = s * knots
    first = x.long().clamp(max=knots - 1)
    values = cubic_spline((x - first)[:, None] - torch.arange(-1, DEGREE).to(s))
    D = torch.diff(torch.eye(K, dtype=s.dtype, device=s.device), n=ORDER, dim=0)
    # Scale the penalty to the same total weight as the samples.
    data, penalty = torch.zeros(K, K).to(s), D.mT @ D
    for k in range(DEGREE + 1):
        for m in range(DEGREE + 1):
            place, value = (first + k, first + m), values[:, k] * values[:, m]
            data.index_put_(place, value, accumulate=True)
    penalty = penalty * (data.trace() / penalty.trace())
    # Splines without samples only have a penalty; the small diagonal keeps the sum invertible.
    L = torch.linalg.cholesky(data + penalty + 1e-13 * torch.eye(K).to(s))
    half = torch.linalg.solve_triangular(L, data, upper=False)
    e, V = torch.linalg.eigh(torch.linalg.solve_triangular(L, half.mT, upper=False))
    points = torch.linalg.solve_triangular(L.mT, V, upper=True)
    return _Spline(first, values, points, e.clamp(0, 1))
