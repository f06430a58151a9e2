"""Whatever holds numbers, as tensors."""

import numpy as np
import torch
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
