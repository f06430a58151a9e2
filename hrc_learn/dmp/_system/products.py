"""Products of coordinates and the matrices of a response, as fast as the processor has them."""

from functools import cache

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.dmp._arguments import fits_numpy

WITH_SMALL_KERNELS = {"SkylakeX", "Cooperlake", "SapphireRapids"}
"""Processors, as OpenBLAS 0.3.29 calls them, for which it multiplies small matrices without
packing them first: those with AVX-512, AMD's among them."""
FEWEST = 4
"""Rows for which these kernels are faster than a flat product of all motions."""


@cache
def most_in_numpy() -> int:
    """Multiplications up to which NumPy is faster than PyTorch, on one thread.

    For one motion of 7 x 1000 and 50 functions (371,000) OpenBLAS takes 5 us with kernels for
    small matrices and 25 us without (Haswell's), PyTorch's MKL 15 us (AMD EPYC with AVX-512).
    """
    from threadpoolctl import threadpool_info

    small = any(
        library.get("architecture") in WITH_SMALL_KERNELS
        for library in threadpool_info()
        if library["internal_api"] == "openblas"
    )
    return 10**6 if small else 10**5


def product(
    X: Float[Tensor, "*batch D M"], H: Float[Tensor, "M T"]
) -> Float[Tensor, "*batch D T"]:
    """X H; where nothing derives it, in the library that is faster and in large pages.

    For batches, motion by motion with OpenBLAS's kernels for small matrices takes less than
    half the time of a flat product, without them four times as long.
    """
    D, alone = X.shape[-2], X.ndim == 2
    if fits_numpy(X):
        small = D * H.numel() <= most_in_numpy()
        if alone:
            return torch.from_numpy(X.numpy().dot(H.numpy())) if small else X @ H
        if small and D >= FEWEST and torch.get_num_threads() == 1:
            return torch.from_numpy(np.matmul(X.numpy(), H.numpy()))
        y = in_large_pages(X, *X.shape[:-1], H.shape[-1])
        torch.mm(X.flatten(0, -2), H, out=y.view(-1, H.shape[-1]))
        return y
    if alone:
        return X @ H
    # One flat product: batched ones of PyTorch against a shared matrix are ten times slower.
    return (X.flatten(0, -2) @ H).view(*X.shape[:-1], -1)


def in_large_pages(like: Tensor, *shape: int) -> Tensor:
    """Memory for a result, of NumPy on a CPU: it asks for large pages, and for hundreds of
    megabytes the system takes as long to find small ones as a motion to fill them.
    """
    if not like.is_cpu:
        return like.new_empty(shape)
    return torch.from_numpy(np.empty(shape, str(like.dtype).removeprefix("torch.")))


def without_subnormals(values: Tensor) -> Tensor:
    """Zeros for what is lost beside one, but makes every product take several times as long."""
    limits = torch.finfo(values.dtype)
    return torch.where(values.abs() < limits.tiny / limits.eps, 0.0, values)
