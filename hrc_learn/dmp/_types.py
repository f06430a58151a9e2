"""What callers may pass, and the same as checked tensors."""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

type ArrayLike = Tensor | np.ndarray | list | tuple | float


def to_tensor(
    values: ArrayLike, dtype: torch.dtype | None = None, device: torch.device | None = None
) -> Tensor:
    """As `torch.as_tensor`, also of arrays that are read-only or run backwards."""
    if isinstance(values, Tensor) and values.dtype == dtype and values.device == device:
        return values  # as `as_tensor` does, which takes longer to find out
    if isinstance(values, np.ndarray):
        values = np.require(values, requirements=["C", "W"])
    return torch.as_tensor(values, dtype=dtype, device=device)


def vector(
    name: str, value: ArrayLike, like: Float[Tensor, "*batch D"]
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


def positive(name: str, value: ArrayLike, like: Tensor) -> Float[Tensor, "*batch"]:
    """Numbers above zero, with dtype and device of `like`.

    Raises:
        ValueError: One is not.
    """
    tensor = to_tensor(value, dtype=like.dtype, device=like.device)
    if not (tensor > 0).all():
        raise ValueError(f"{name} must be positive, got {tensor.min().item()}")
    return tensor


def normalised_time(
    time: ArrayLike, duration: Float[Tensor, "*#batch"]
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
