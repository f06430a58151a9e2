"""What callers may pass, and the same checked: numbers, arrays and demonstrations.

Tensors, arrays and nested lists of integers or floats alike. `...` stands for any number of
leading batch axes. Axes are named for the reader (`_T`, `_D`) and not bound, as arguments of
one call broadcast and demonstrations of one list differ in length; where sizes have to agree,
they are compared where the values are used.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Real
from torch import Tensor, nn
from torch.autograd import forward_ad
from torch.autograd.forward_ad import unpack_dual

type Nested = Sequence
"""Lists or tuples, of numbers or of more of them."""
type Number = float | int | np.number
type ArrayLike = Real[Tensor, "..."] | Real[np.ndarray, "..."] | Nested | Number
"""Any array of numbers."""
type Scalars = ArrayLike
"""One number for each primitive, (*batch): durations [s], gains, steps [s]."""
type Times = Real[Tensor, "... _T"] | Real[np.ndarray, "... _T"] | Nested
"""Times [s], (T,) for all of a batch or (*batch, T)."""
type Row = Real[Tensor, "_T"] | Real[np.ndarray, "_T"]
"""Of one coordinate, (T,)."""
type Points = Real[Tensor, "... _T _D"] | Real[np.ndarray, "... _T _D"] | Row | Nested
"""Values along time, (*batch, T, D); (T,) where D = 1."""
type Vectors = Real[Tensor, "... _D"] | Real[np.ndarray, "... _D"] | Nested
"""A value for each primitive, (*batch, D)."""
type Quaternions = Real[Tensor, "... 4"] | Real[np.ndarray, "... 4"] | Nested
"""Unit quaternions (w, x, y, z), (*batch, 4) or along time (*batch, T, 4)."""
type Mask = Bool[Tensor, "... _T"] | Bool[np.ndarray, "... _T"] | Times
"""False (or zero) where a sample does not count, (T,) or (*batch, T)."""


def to_tensor(
    values: ArrayLike | Mask,
    dtype: torch.dtype | None = None,
    device: torch.device | None = None,
) -> Tensor:
    """As `torch.as_tensor`, also of arrays that are read-only or run backwards."""
    if isinstance(values, Tensor) and values.dtype == dtype and values.device == device:
        return values  # as `as_tensor` does, which takes longer to find out
    if isinstance(values, np.ndarray):
        values = np.require(values, requirements=["C", "W"])
    return torch.as_tensor(values, dtype=dtype, device=device)


def readable(*tensors: Tensor) -> bool:
    """Whether values may decide what is done: nothing traces, maps or derives them."""
    if torch.compiler.is_compiling():
        return False
    functorch = torch._C._functorch  # pyright: ignore[reportAttributeAccessIssue]
    # In comprehensions this takes as long as a short rollout's product.
    for x in tensors:
        if functorch.is_functorch_wrapped_tensor(x):
            return False
        if forward_ad._current_level >= 0 and unpack_dual(x).tangent is not None:
            return False
    return True


_transform_level = getattr(
    torch._C._functorch,  # pyright: ignore[reportAttributeAccessIssue]
    "maybe_current_level",
    lambda: 0,
)
"""None where `torch.func` neither maps nor derives; a PyTorch that does not tell may always."""


def fits_numpy(detached: Tensor, *others: Any) -> bool:
    """Whether tensors may be worked on in NumPy: nothing traces, maps or derives them.

    Of a few numbers that takes a third of the time: PyTorch takes far longer to find out what
    to do than to do it. To ask each tensor for transforms would as well.

    Args:
        detached: May require gradients, which are not asked for: `detach` it.
        others: Of the same dtype; what is no tensor does not fit.
    """
    if torch.is_grad_enabled() or torch.compiler.is_compiling():
        return False
    if _transform_level() is not None or forward_ad._current_level >= 0:
        return False
    dtype = detached.dtype
    if type(detached) not in (Tensor, nn.Parameter) or not detached.is_cpu:
        return False
    for x in others:  # in a comprehension this takes twice as long
        if type(x) is not Tensor or x.dtype is not dtype or x.requires_grad or not x.is_cpu:
            return False
    return True


def vector(
    name: str, value: Vectors, like: Float[Tensor, "*batch D"]
) -> Float[Tensor, "*other D"]:
    """One number for each coordinate that `like` has, with its dtype and device.

    Raises:
        ValueError: Another number of them.
    """
    tensor = to_tensor(value, dtype=like.dtype, device=like.device)
    D = like.shape[-1]
    if tensor.ndim == 0 or tensor.shape[-1] != D:
        raise ValueError(f"{name} must have shape (..., {D}), got {tuple(tensor.shape)}")
    return finite(name, tensor)


def finite(name: str, values: Tensor) -> Tensor:
    """The values, as they are.

    Raises:
        ValueError: One is NaN or infinite.
    """
    # Of another device, looking would wait for all that was asked of it.
    if not values.is_cpu or not readable(values):
        return values
    # Of a few numbers Python's sum takes half as long.
    few = values.ndim == 1 and values.numel() <= 32
    if not math.isfinite(sum(values.tolist()) if few else values.detach().sum().item()):
        wrong = values[~values.isfinite()]
        if len(wrong):  # a sum overflows too
            raise ValueError(f"{name} must be finite, but holds {wrong[0].item()}")
    return values


def positive(name: str, value: Scalars, like: Tensor) -> Float[Tensor, "*batch"]:
    """Numbers above zero, with dtype and device of `like`.

    Raises:
        ValueError: One is not.
    """
    tensor = to_tensor(value, dtype=like.dtype, device=like.device)
    if readable(tensor) and not ((tensor > 0) & (tensor < math.inf)).all():
        wrong = tensor[~((tensor > 0) & (tensor < math.inf))].reshape(-1)
        raise ValueError(f"{name} must be positive and finite, got {wrong[0].item()}")
    return tensor


def normalised_time(
    time: Times, duration: Float[Tensor, "*#batch"]
) -> Float[Tensor, "*#batch T"]:
    """Times [s] since the start of a motion over its duration (float64).

    Raises:
        ValueError: A single number, or times before the start.
    """
    time = to_tensor(time, dtype=torch.float64, device=duration.device)
    if time.ndim == 0 or (readable(time) and not ((time >= 0) & (time < math.inf)).all()):
        raise ValueError("time must be an array of seconds since the start, none negative")
    if time.ndim > 1 and duration.ndim and not _broadcast(time.shape[:-1], duration.shape):
        raise ValueError(
            f"time has shape {tuple(time.shape)}, but there are {tuple(duration.shape)} "
            f"durations: time must be (T,) or {(*duration.shape, time.shape[-1])}"
        )
    # Motions that are all alike need one response matrix, not one each.
    if readable(time, duration) and not (time.requires_grad or duration.requires_grad):
        time, duration = _first_if_alike(time, 1), _first_if_alike(duration, 0)
    return time / duration.double()[..., None]


def regular_times(dt: float | int, duration: Float[Tensor, "*batch"]) -> Float[Tensor, "T"]:
    """Times [s] every `dt`, from zero to the first that is not before the longest duration.

    Raises:
        ValueError: The interval is not positive.
    """
    if not (math.isfinite(dt) and dt > 0):
        raise ValueError(f"dt must be positive, got {dt}")
    # Rounding must not add one past the end.
    last = math.ceil(duration.max().item() / dt * (1 - 1e-7))
    return dt * torch.arange(last + 1, dtype=torch.float64, device=duration.device)


def _broadcast(one: tuple[int, ...], other: tuple[int, ...]) -> bool:
    """Whether two shapes go together."""
    sizes = zip(reversed(one), reversed(other), strict=False)
    return all(a == b or 1 in (a, b) for a, b in sizes)


def _first_if_alike(values: Tensor, ndim: int) -> Tensor:
    """The first of a batch of tensors of `ndim` axes, if the others are the same."""
    if values.ndim == ndim:
        return values
    first = values[(0,) * (values.ndim - ndim)]
    return first if bool((values == first).all()) else values


@dataclass(frozen=True, kw_only=True, eq=False)
class FitReport:
    """Residuals of a reproduction, in the units of the demonstration.

    Those of a robust fit count by the trust in each sample.
    """

    rmse: Float[Tensor, "*batch D"]
    """Root mean square error of each coordinate."""
    peak: Float[Tensor, "*batch D"]
    """Largest absolute error of each coordinate."""
    span: Float[Tensor, "*batch D"]
    """Range that the demonstration covers in each coordinate."""
    trust: Float[Tensor, "*batch T D"] | None = None
    """In each sample, 0 to 1, that a robust fit came to."""
    noise: Float[Tensor, "*batch D"] | None = None
    """Standard deviation of what a fit took for noise."""
    peak_acceleration: Float[Tensor, "*batch D"] | None = None
    """Largest of the reproduction, per s^2: NRMSE says nothing of how rough a motion is."""
    peak_jerk: Float[Tensor, "*batch D"] | None = None
    """Likewise, per s^3."""

    @property
    def nrmse(self) -> Float[Tensor, "*batch"]:
        """RMSE over all samples and coordinates, relative to the largest range."""
        return self.rmse.square().mean(-1).sqrt() / self.span.amax(-1)

    def select(self, columns: slice) -> "FitReport":
        """Report of some of the coordinates."""
        return FitReport(**{k: values[..., columns] for k, values in self.tensors().items()})

    def tensors(self) -> dict[str, Tensor]:
        """What there is, by name."""
        return {name: values for name, values in vars(self).items() if values is not None}


MINIMUM_SAMPLES = 3
"""Start, goal and one on the way: with two, nothing is left to fit."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Samples:
    """Sampled demonstrations on a flat batch, time last, padded where `mask` is false."""

    batch: tuple[int, ...]
    """The batch shape that was flattened to B."""
    s: Float[Tensor, "B T"]
    """Time since the first sample over the duration, 0 to 1, never falling (float64)."""
    duration: Float[Tensor, "B"]
    """First to last sample [s] (float64)."""
    position: Float[Tensor, "B D T"]
    velocity: Float[Tensor, "B D T"] | None
    mask: Bool[Tensor, "B T"]
    complete: bool
    """Whether all samples count."""

    @property
    def columns(self) -> Float[Tensor, "*batch T D"]:
        """Position as it was given, time before coordinates."""
        return self.position.mT.reshape(*self.batch, -1, self.position.shape[-2])

    @cached_property
    def shared(self) -> bool:
        """Whether all demonstrations are sampled alike, so that one solve serves all."""
        if len(self.s) == 1 or not self.complete:
            return self.complete
        # 1e-12 of the motion: timestamps that differ by the rounding of a start time are alike.
        return bool(((self.s - self.s[:1]).abs() < 1e-12).all())

    @cached_property
    def first(self) -> Float[Tensor, "B D"]:
        """Position at the first sample that counts."""
        if self.complete:
            return self.position[..., 0]
        return self._at(self.mask.long().argmax(-1))

    @cached_property
    def last(self) -> Float[Tensor, "B D"]:
        """Position at the last sample that counts."""
        if self.complete:
            return self.position[..., -1]
        return self._at(self.mask.shape[-1] - 1 - self.mask.flip(-1).long().argmax(-1))

    @cached_property
    def span(self) -> Float[Tensor, "B D"]:
        """Range that each coordinate covers."""
        # Samples that do not count repeat the first: they widen nothing.
        position = self._filled(self.position, self.first[..., None])
        # `aminmax` takes ten times as long.
        return position.amax(-1) - position.amin(-1)

    def compare(
        self,
        reproduction: Float[Tensor, "B D T"],
        trust: Float[Tensor, "*batch T D"] | None = None,
    ) -> FitReport:
        """Residuals of a reproduction, on the samples that count; `trust` is passed on."""
        error = self._filled(reproduction - self.position, 0.0)
        counted = error.shape[-1] if self.complete else self.mask.sum(-1, keepdim=True)
        residuals = {
            "rmse": error.norm(dim=-1) / counted**0.5,
            "peak": error.abs().amax(-1),
            "span": self.span,
        }
        batch = self.batch
        residuals = {k: v.reshape(*batch, -1) if batch else v[0] for k, v in residuals.items()}
        return FitReport(**residuals, trust=trust)

    def _at(self, index: Tensor) -> Tensor:
        return torch.take_along_dim(self.position, index[:, None, None], dim=-1)[..., 0]

    def _filled(self, values: Tensor, filling: Tensor | float) -> Tensor:
        return values if self.complete else torch.where(self.mask[:, None], values, filling)


def padded(time: Any, mask: Mask | None, *columns: Any) -> tuple[Any, Mask | None, list[Any]]:
    """Lists of demonstrations, of any lengths, as one batch; anything else as it is.

    Args:
        time: Timestamps of each, (T_i,), or those of all.
        mask: True where a sample counts, likewise, or None.
        columns: Values of each, (T_i,) or (T_i, D), or None.

    Raises:
        ValueError: Lists of which one names another number of samples or demonstrations.
    """
    first = columns[0]
    listed = isinstance(first, list | tuple) and all(hasattr(x, "shape") for x in first)
    if not listed or not first or not first[0].ndim:
        return time, mask, list(columns)
    parts = [None if x is None else [to_tensor(row) for row in x] for x in columns]
    lengths = [len(x) for x in first]
    if not isinstance(time, list | tuple) or not hasattr(time[0], "shape"):
        time = [time] * len(first)
    parts.append([to_tensor(row) for row in time])
    for part in parts:
        if part is not None and [len(row) for row in part] != lengths:
            raise ValueError(
                f"demonstrations have {lengths} samples, but time or another column has "
                f"{[len(row) for row in part]}"
            )
    marked = [torch.ones(n, dtype=torch.bool) for n in lengths]
    if mask is not None:
        marked = [to_tensor(row).bool() for row in mask]
    joined = [
        None if part is None else torch.nn.utils.rnn.pad_sequence(part, batch_first=True)
        for part in (*parts, marked)
    ]
    whole = mask is None and len(set(lengths)) == 1
    return joined[-2], None if whole else joined[-1], joined[:-2]


def check_samples(
    time: Times,
    position: Points,
    velocity: Points | None = None,
    mask: Mask | None = None,
    *,
    name: str = "position",
) -> Samples:
    """Check and batch what the caller recorded.

    Args:
        time: Timestamps [s], (T,) or (*B, T); any origin, any spacing.
        position: (T,), (T, D) or (*B, T, D). Of the same shape as `time`: D = 1.
        velocity: Like `position`, or None.
        mask: Like `time`, true where a sample counts; None: all do. The others may hold
            anything, NaN included.
        name: What complaints call `position`.

    Raises:
        ValueError: Shapes that do not fit, values that are not finite, time that does not
            increase, fewer than 3 samples; says where.
    """
    position = _floating(position)
    time = to_tensor(time, torch.float64, position.device)
    if position.ndim == 0 or time.ndim == 0:
        raise ValueError("time and position need a sample axis, got a single number")
    if position.shape == time.shape:
        position = position[..., None]
        velocity = None if velocity is None else to_tensor(velocity)[..., None]
    if position.ndim < 2:
        raise ValueError(f"{_shapes(time, position)}: expected (T,) and (T, D)")
    *batch, T, D = position.shape
    time = _fit_shape("time", time, (*batch, T), position)
    complete = mask is None
    if mask is None:
        mask = torch.ones_like(time, dtype=torch.bool)
    else:
        mask = to_tensor(mask, device=time.device).bool()
        mask = _fit_shape("mask", mask, (*batch, T), position)
        complete = bool(mask.all())
    if position.numel() == 0:
        raise ValueError(f"position has shape {(*batch, T, D)}: there is nothing to fit")
    time, mask = time.reshape(-1, T), mask.reshape(-1, T)
    # Time last from here on: everything that reads the samples runs along it.
    position = position.reshape(-1, T, D).mT.contiguous()

    few = mask.sum(-1) < MINIMUM_SAMPLES if T < MINIMUM_SAMPLES or not complete else None
    if few is not None and few.any():
        i = int(few.nonzero()[0])
        raise ValueError(
            f"{demo_label(i, batch)}a motion needs at least {MINIMUM_SAMPLES} samples, "
            f"got {int(mask[i].sum())}"
        )
    _check_finite("time", time[:, None], mask, batch)
    position = _check_finite(name, position, mask, batch)
    if velocity is not None:
        velocity = to_tensor(velocity, position.dtype, position.device)
        velocity = _fit_shape("velocity", velocity, (*batch, T, D), position)
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
    """Raise ValueError for what a motion cannot be told in.

    With half the digits, weights of some thousands leave a path by more than a radian.
    """
    if dtype not in (torch.float32, torch.float64):
        raise ValueError(
            f"a primitive needs float32 or float64, got {dtype}: cast its rollouts instead"
        )


def _floating(values: Points) -> Tensor:
    tensor = to_tensor(values)
    if tensor.is_floating_point():
        check_precision(tensor.dtype)
    return tensor if tensor.is_floating_point() else tensor.to(torch.get_default_dtype())


def _fit_shape(name: str, values: Tensor, shape: tuple[int, ...], position: Tensor) -> Tensor:
    try:
        return values.expand(shape)
    except RuntimeError:
        raise ValueError(
            f"{name} has shape {tuple(values.shape)}, position {tuple(position.shape)}: "
            f"{name} must be {shape}, without any leading axes it shares with all"
        ) from None


def _shapes(time: Tensor, position: Tensor) -> str:
    return f"time has shape {tuple(time.shape)}, position {tuple(position.shape)}"


def _check_finite(
    name: str,
    values: Float[Tensor, "B D T"],
    mask: Bool[Tensor, "B T"],
    batch: Sequence[int],
) -> Tensor:
    """The values, none of them NaN or infinite; where the mask is true none may be."""
    # A sum is finite unless a summand is not or it overflows: the second look sorts that out.
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
) -> tuple[Tensor, Tensor]:
    """Time since the first sample over the duration, which comes with it."""
    if complete:
        first, last = time[:, :1], time[:, -1:]
        elapsed = time - first
        stalled = elapsed[:, 1:] <= elapsed[:, :-1]
        if not stalled.any():
            duration = last - first
            return elapsed / duration, duration[..., 0]
    first = time.masked_fill(~mask, torch.inf).amin(-1, keepdim=True)
    last = time.masked_fill(~mask, -torch.inf).amax(-1, keepdim=True)
    elapsed = (time - first).masked_fill(~mask, 0)
    # Samples that do not count repeat the time before them, so that times never fall.
    latest = torch.cat([torch.full_like(first, -1.0), elapsed.cummax(-1).values], dim=-1)
    stalled = mask & (elapsed <= latest[..., :-1])
    # The first sample that counts has zero elapsed time, as have the filled ones before it.
    stalled &= mask.long().cumsum(-1) > 1
    if stalled.any():
        i, k = stalled.nonzero()[0].tolist()
        raise ValueError(
            f"{demo_label(i, batch)}time must increase, but is {time[i, k].item():.6f} s "
            f"at sample {k} after {(latest[i, k] + first[i, 0]).item():.6f} s"
        )
    duration = last - first
    return elapsed.cummax(-1).values / duration, duration[..., 0]


def demo_label(index: int, batch: Sequence[int]) -> str:
    """Prefix of a message that says which of a flat batch of demonstrations it is about."""
    if not batch:
        return ""
    place = tuple(int(k) for k in np.unravel_index(index, batch))
    return f"demonstration {place[0] if len(place) == 1 else place}: "
