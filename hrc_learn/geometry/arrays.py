"""Arrays as users have them: tensors, NumPy arrays, and nested lists of numbers."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Real
from torch import Tensor

type ArrayLike = Real[Tensor, "..."] | Real[np.ndarray, "..."] | Sequence | float
"""A tensor, a NumPy array, or a nested list of numbers."""


def as_tensor(values: ArrayLike, like: Tensor | None = None) -> Tensor:
    """Turn an array into a floating-point tensor; tensors of floats pass unchanged.

    Args:
        values: Tensor, NumPy array, or nested list. Integers and lists become float64.
        like: Tensor whose dtype and device the result takes; None keeps those of `values`.

    Returns:
        Tensor of the same shape.
    """
    if not isinstance(values, Tensor):
        values = torch.as_tensor(np.asarray(values))
    if not values.is_floating_point():
        values = values.double()
    return values if like is None else values.to(like)
