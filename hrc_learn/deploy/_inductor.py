"""What is changed inside inductor while a step is compiled, and the check that it still fits.

Inductor has no public switch for how results lie in memory. So three of its private functions
are replaced for the time of a compilation, as long as they look as expected; where they do not,
as in a later torch, the step is compiled without the change: right, but several times slower
for a batch of arms. `tests/deploy/test_inductor.py` fails on the day that happens.
"""

from __future__ import annotations

import inspect
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from functools import cache
from typing import Any

import torch
from torch.fx import Graph, Node
from torch.utils._pytree import tree_map_only

# Memory that a step may take from the stack [bytes]: allocations there are free, those of
# torch cost more than the arithmetic. Threads commonly have 8 MB.
_STACK = 2**20

_SIGNATURES = {
    ("FlexibleLayout", "__init__"): (
        "self", "device", "dtype", "size", "stride_order", "is_pinned",
    ),
    ("ComputedBuffer", "get_fill_order"): ("self",),
    ("View", "create"): ("x", "new_size"),
}  # fmt: skip
"""Functions of `torch._inductor.ir` that are replaced, with the names of their parameters."""

_CAT, _PERMUTE = torch.ops.aten.cat.default, torch.ops.aten.permute.default


@contextmanager
def tuned_for(batch: Sequence[int]) -> Iterator[dict[str, Any]]:
    """Compiles what is compiled within for a step of a batch, as fast as inductor lets us.

    Args:
        batch: Sizes of the batch, which tensors have as their leading axes; none for one arm.

    Yields:
        Options to compile with.
    """
    unexpected = unexpected_names()
    if unexpected:
        _warn_of(", ".join(unexpected))
    with ExitStack() as stack:
        if "MAX_STACK_ALLOCATION_SIZE" not in unexpected:
            from torch._inductor.codegen import cpp_wrapper_cpu_array_ref as wrapper

            stack.enter_context(_replaced(wrapper, "MAX_STACK_ALLOCATION_SIZE", _STACK))
        options: dict[str, Any] = {"aot_inductor.allow_stack_allocation": True}
        if batch and not unexpected:
            stack.enter_context(_batch_last(list(batch)))
            options["post_grad_custom_post_pass"] = cat_batch_last(list(batch))
        yield options


def unexpected_names() -> list[str]:
    """Private names of inductor that are missing, or whose parameters are not as expected."""
    unexpected = []
    try:
        from torch._inductor import ir
        from torch._inductor.codegen import cpp_wrapper_cpu_array_ref as wrapper
    except ImportError as error:
        return [error.name or "torch._inductor", "MAX_STACK_ALLOCATION_SIZE"]
    for (owner, name), expected in _SIGNATURES.items():
        function = getattr(getattr(ir, owner, None), name, None)
        if function is None or tuple(inspect.signature(function).parameters) != expected:
            unexpected.append(f"{owner}.{name}")
    if not hasattr(ir, "is_storage_and_layout"):
        unexpected.append("is_storage_and_layout")
    if not hasattr(wrapper, "MAX_STACK_ALLOCATION_SIZE"):
        unexpected.append("MAX_STACK_ALLOCATION_SIZE")
    return unexpected


@cache  # once a process, not once a compilation
def _warn_of(names: str) -> None:
    warnings.warn(
        f"torch {torch.__version__} has changed {names} of inductor: control steps are "
        "compiled without our layout of memory, right but slower",
        stacklevel=5,
    )


@contextmanager
def _replaced(owner: Any, name: str, value: Any) -> Iterator[None]:
    """One attribute of a class or module, replaced for a while."""
    # Not getattr, which would bind a classmethod: what is put back is what was there.
    before = vars(owner)[name]
    setattr(owner, name, value)
    try:
        yield
    finally:
        setattr(owner, name, before)


@contextmanager
def _batch_last(batch: list[int]) -> Iterator[None]:
    """Lays out what has the batch first with the batch last in memory.

    So loops run over the batch innermost, a vector register of elements at a time. Left alone,
    inductor keeps results with the batch first, and transposes them all along.
    """
    from torch._inductor import ir

    view = ir.View.create
    plain, preferred = ir.FlexibleLayout.__init__, ir.ComputedBuffer.get_fill_order

    def lay_out(
        self: Any,
        device: torch.device,
        dtype: torch.dtype,
        size: Sequence[Any],
        stride_order: Sequence[Any] | None = None,
        is_pinned: bool = False,
    ) -> None:
        if not stride_order and _leads(batch, size):
            stride_order = _fill_order(len(batch), len(size))
        plain(self, device, dtype, size, stride_order, is_pinned)

    def fill_order(self: Any) -> Any:
        # Inductor would take that of what a buffer is computed from, and transpose.
        size = self.get_size()
        if isinstance(self.layout, ir.FlexibleLayout) and _leads(batch, size):
            return _fill_order(len(batch), len(size))
        return preferred(self)

    def decided_view(x: Any, new_size: Sequence[Any]) -> Any:
        # Inductor copies the strides of what it looks at, and may yet change those of the
        # latter: to it only what has the last axis last is still undecided.
        if ir.is_storage_and_layout(x):
            x.freeze_layout()
        return view(x, new_size)

    with (
        _replaced(ir.FlexibleLayout, "__init__", lay_out),
        _replaced(ir.ComputedBuffer, "get_fill_order", fill_order),
        _replaced(ir.View, "create", staticmethod(decided_view)),
    ):
        yield


def _leads(batch: Sequence[int], size: Sequence[Any]) -> bool:
    """Whether a size has the batch first, and not last already."""
    n = len(batch)
    return list(size[:n]) == batch and list(size[-n:]) != batch


def _fill_order(first: int, axes: int) -> list[int]:
    """Axes from the fastest running one: the first few, then the others."""
    return [*reversed(range(first)), *reversed(range(first, axes))]


def cat_batch_last(batch: list[int]) -> Callable[[Graph], None]:
    """A pass over a graph that permutes tensors before they are joined, and the whole back.

    Inductor writes parts straight into the whole, which it lays out without asking.
    """

    def permute(graph: Graph) -> None:
        for node in graph.find_nodes(op="call_function", target=_CAT):
            args: Any = node.args
            parts, dim, *_ = *args, 0  # aten.cat leaves out a dim of zero
            axes = range(node.meta["val"].ndim)
            dim = axes[dim]
            # Joined along the batch, or with the batch last already: nothing to gain.
            if dim < len(batch) or not _leads(batch, node.meta["val"].shape):
                continue
            first, last = axes[: len(batch)], axes[len(batch) :]
            with graph.inserting_before(node):
                permuted = [_call(graph, _PERMUTE, x, [*last, *first]) for x in parts]
                whole = _call(graph, _CAT, permuted, dim - len(batch))
                back = _call(graph, _PERMUTE, whole, [*axes[len(last) :], *axes[: len(last)]])
            node.replace_all_uses_with(back)
            graph.erase_node(node)

    return permute


def _call(graph: Graph, function: Any, *args: Any) -> Node:
    """A new node, with what inductor has to know of its result."""
    node = graph.call_function(function, args)
    node.meta["val"] = function(*tree_map_only(Node, lambda x: x.meta["val"], args))
    return node
