"""Matrix products of rollouts, by whichever library is faster on the processor."""

from functools import cache

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.dmp._arguments import fits_numpy

SMALL_MATRIX_CORES = {"SkylakeX", "Cooperlake", "SapphireRapids"}
"""OpenBLAS core types (version 0.3.29) with kernels for small matrices, which skip packing: all
processors with AVX-512, including AMD's."""
MINIMUM_ROWS = 4
"""Rows from which those kernels beat one flat product of all motions."""


@cache
def numpy_limit() -> int:
    """Number of multiplications up to which NumPy beats PyTorch on one thread.

    One motion of 7 x 1000 samples and 50 functions (371,000 multiplications) takes OpenBLAS
    5 us with kernels for small matrices and 25 us without (Haswell), and PyTorch's MKL 15 us
    (AMD EPYC with AVX-512).
    """
    from threadpoolctl import threadpool_info

    small = any(
        library.get("architecture") in SMALL_MATRIX_CORES
        for library in threadpool_info()
        if library["internal_api"] == "openblas"
    )
    return 10**6 if small else 10**5


def product(
    X: Float[Tensor, "*batch D M"], H: Float[Tensor, "M T"]
) -> Float[Tensor, "*batch D T"]:
    """Product X H of a batch of coordinates with one matrix.

    With OpenBLAS's kernels for small matrices, a batch takes less than half the time of a flat
    product if multiplied motion by motion; without them, four times as long.
    """
    D, single = X.shape[-2], X.ndim == 2
    if fits_numpy(X):
        small = D * H.numel() <= numpy_limit()
        if single:
            return torch.from_numpy(X.numpy().dot(H.numpy())) if small else X @ H
        if small and D >= MINIMUM_ROWS and torch.get_num_threads() == 1:
            return torch.from_numpy(np.matmul(X.numpy(), H.numpy()))
        y = empty_in_large_pages(X, *X.shape[:-1], H.shape[-1])
        torch.mm(X.flatten(0, -2), H, out=y.view(-1, H.shape[-1]))
        return y
    if single:
        return X @ H
    # One flat product: a batched one of PyTorch against a shared matrix is ten times slower.
    return (X.flatten(0, -2) @ H).view(*X.shape[:-1], -1)


def empty_in_large_pages(like: Tensor, *shape: int) -> Tensor:
    """Uninitialised tensor, on a CPU in memory that NumPy requested in large pages.

    With small pages, the system takes as long to map hundreds of megabytes as the product.
    """
    if not like.is_cpu:
        return like.new_empty(shape)
    return torch.from_numpy(np.empty(shape, str(like.dtype).removeprefix("torch.")))


def without_subnormals(values: Tensor) -> Tensor:
    """Values with tiny entries set to zero: subnormal numbers slow products several times."""
    limits = torch.finfo(values.dtype)
    return torch.where(values.abs() < limits.tiny / limits.eps, 0.0, values)
