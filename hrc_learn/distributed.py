"""One answer from several processes, as `torchrun` starts them.

In a process that stands alone every function here does nothing, so that code written for
many is the code for one.
"""

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import torch
import torch.distributed as dist
from torch import Tensor, nn


@contextmanager
def processes() -> Iterator[int]:
    """Joins the processes that `torchrun` started, and yields the rank of this one.

    Alone, which is when the environment names no rank, the rank is 0. Over gloo, as the
    statistics of a fit are small and live on the CPU.
    """
    if "RANK" not in os.environ or dist.is_initialized():
        yield rank()
        return
    dist.init_process_group("gloo")
    try:
        yield rank()
    finally:
        dist.destroy_process_group()


def rank() -> int:
    """Number of this process, from 0."""
    return dist.get_rank() if dist.is_initialized() else 0


def count() -> int:
    """How many processes there are."""
    return dist.get_world_size() if dist.is_initialized() else 1


def share[T](items: Sequence[T]) -> Iterator[tuple[int, T]]:
    """Every n-th of the items, which this process works on, with its index among all.

    A sequence that reads its items when asked is sliced, not read as a whole.
    """
    mine = slice(rank(), None, count())
    return zip(range(len(items))[mine], items[mine], strict=True)


def sum_over_processes(tensor: Tensor) -> Tensor:
    """Sum of the tensors of all processes; the same in each of them."""
    if count() == 1:
        return tensor
    total = tensor.detach().clone()
    dist.all_reduce(total)
    return total


def gather(tensor: Tensor) -> list[Tensor]:
    """The tensors of all processes, of one shape, in the order of their ranks."""
    if count() == 1:
        return [tensor]
    tensors = [torch.empty_like(tensor) for _ in range(count())]
    dist.all_gather(tensors, tensor.detach().contiguous())
    return tensors


def differentiable_sum(tensor: Tensor) -> Tensor:
    """As `sum_over_processes`, with gradients for modules inside `data_parallel`.

    Its backward sums the gradients of all processes, the mean that `data_parallel` takes
    afterwards divides by their number again: what is left is the gradient of the sum.
    """
    if count() == 1:
        return tensor
    from torch.distributed.nn.functional import all_reduce

    return all_reduce(tensor)


def data_parallel(module: nn.Module) -> nn.Module:
    """The module with its gradients averaged over processes."""
    return module if count() == 1 else nn.parallel.DistributedDataParallel(module)
