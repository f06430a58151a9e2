"""Divide work over processes.

Most functions combine results of the processes that `torchrun` starts. In a single process they
do nothing, so the same code runs with and without `torchrun`. `worker_pool` and `ByValue` are
for processes that a program starts itself.
"""

import multiprocessing
import os
import pickle
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor, nn


class ByValue:
    """Argument for another process, which receives a copy.

    Without this class, `multiprocessing` moves each tensor of an argument to shared memory and
    frees the old memory, although NumPy views of the tensor still use it.
    """

    def __init__(self, value: object):
        """Copy the argument."""
        self._content = pickle.dumps(value)

    def __reduce__(self) -> tuple[object, ...]:
        return pickle.loads, (self._content,)


@contextmanager
def worker_pool(
    number: int, begin: Callable[..., object], *given: object
) -> Iterator[ProcessPoolExecutor]:
    """Pool of new processes, initialised by `begin(*given)`; the end of the block cancels
    pending work.

    The processes are spawned: a forked process would inherit the locks, but not the threads
    that hold them.
    """
    context, sent = multiprocessing.get_context("spawn"), tuple(map(ByValue, given))
    with ProcessPoolExecutor(number, context, initializer=begin, initargs=sent) as pool:
        try:
            yield pool
        finally:
            pool.shutdown(cancel_futures=True)


@contextmanager
def processes() -> Iterator[int]:
    """Join the processes that `torchrun` started, and yield the rank of this process.

    A single process, without a rank in the environment, has rank 0. The backend is gloo,
    because the statistics of a fit are small and on the CPU.
    """
    if "RANK" not in os.environ or dist.is_initialized():
        yield rank()
        return
    dist.init_process_group("gloo")
    try:
        yield rank()
        dist.barrier()  # gloo may abort this process if another one has left the group
    finally:
        dist.destroy_process_group()


def rank() -> int:
    """Number of this process, from 0."""
    return dist.get_rank() if dist.is_initialized() else 0


def count() -> int:
    """Number of processes."""
    return dist.get_world_size() if dist.is_initialized() else 1


def local_items[T](items: Sequence[T]) -> Iterator[tuple[int, T]]:
    """Items of this process with their indices: of n processes, each gets every n-th item.

    A sequence that loads items on demand loads only the items of this process.
    """
    mine = slice(rank(), None, count())
    return zip(range(len(items))[mine], items[mine], strict=True)


def sum_over_processes(tensor: Tensor) -> Tensor:
    """Sum of the tensors of all processes, identical in each of them."""
    if count() == 1:
        return tensor
    total = tensor.detach().clone()
    dist.all_reduce(total)
    return total


def gather(tensor: Tensor) -> list[Tensor]:
    """Tensors of all processes, of equal shape, in the order of their ranks."""
    if count() == 1:
        return [tensor]
    tensors = [torch.empty_like(tensor) for _ in range(count())]
    dist.all_gather(tensors, tensor.detach().contiguous())
    return tensors


def differentiable_sum(tensor: Tensor) -> Tensor:
    """Sum over processes, differentiable for modules inside `data_parallel`.

    The backward pass sums the gradients of all processes. `data_parallel` then divides by the
    number of processes, which leaves the gradient of the sum.
    """
    if count() == 1:
        return tensor
    from torch.distributed.nn.functional import all_reduce

    return all_reduce(tensor)


def data_parallel(module: nn.Module) -> nn.Module:
    """Wrap a module so that its gradients are averaged over processes."""
    return module if count() == 1 else nn.parallel.DistributedDataParallel(module)


class LazyMap[S, T](Sequence[T]):
    """Function applied to the items of a sequence, such as episodes of a dataset, on access."""

    def __init__(self, items: Sequence[S], function: Callable[[S], T]):
        self._items, self._function = items, function

    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, slice):
            return LazyMap(self._items[index], self._function)
        return self._function(self._items[index])

    def __len__(self) -> int:
        return len(self._items)

    def __iter__(self) -> Iterator[T]:
        return map(self._function, self._items)
