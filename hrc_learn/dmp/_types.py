"""What callers may pass, and the same as checked tensors.

Tensors, arrays and nested lists of integers or floats alike. `...` stands for any number of
leading batch axes. Axes are named for the reader (`_T`, `_D`) and not bound, as arguments of
one call broadcast and demonstrations of one list differ in length; where sizes have to agree,
they are compared where the values are used.
"""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float, Real
from torch import Tensor

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
    return tensor


def positive(name: str, value: Scalars, like: Tensor) -> Float[Tensor, "*batch"]:
    """Numbers above zero, with dtype and device of `like`.

    Raises:
        ValueError: One is not.
    """
    tensor = to_tensor(value, dtype=like.dtype, device=like.device)
    if not (tensor > 0).all():
        raise ValueError(f"{name} must be positive, got {tensor.min().item()}")
    return tensor


def normalised_time(
    time: Times, duration: Float[Tensor, "*#batch"]
) -> Float[Tensor, "*#batch T"]:
    """Times [s] since the start of a motion over its duration (float64).

    Raises:
        ValueError: A single number, or times before the start.
    """
    time = to_tensor(time, dtype=torch.float64, device=duration.device)
    if time.ndim == 0 or not (time >= 0).all():
        raise ValueError("time must be an array of seconds since the start, none negative")
    s = time / duration.double()[..., None]
    # Rows that are all alike need one response matrix, not one each.
    if s.ndim > 1 and not s.requires_grad and (s == s.reshape(-1, s.shape[-1])[0]).all():
        return s.reshape(-1, s.shape[-1])[0]
    return s
