"""Memory layout of compiled steps: patches of inductor during a compilation.

Inductor has no public option for the memory layout of results. So three of its private
functions are replaced during a compilation, if they have the expected signatures. In a later
torch without them, the step is compiled without the patches: correct, but several times slower
for a batch of arms. `tests/deploy/test_inductor.py` then fails.
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

# Stack memory that a step may use [bytes]: allocations there are free, while those of torch
# cost more than the arithmetic. Threads commonly have 8 MB.
_STACK = 2**20

_SIGNATURES = {
    ("FlexibleLayout", "__init__"): (
        "self", "device", "dtype", "size", "stride_order", "is_pinned",
    ),
    ("ComputedBuffer", "get_fill_order"): ("self",),
    ("View", "create"): ("x", "new_size"),
}  # fmt: skip
"""Replaced functions of `torch._inductor.ir`, with the names of their parameters."""

_CAT, _PERMUTE = torch.ops.aten.cat.default, torch.ops.aten.permute.default


@contextmanager
def tuned_for(batch: Sequence[int]) -> Iterator[dict[str, Any]]:
    """Context in which inductor compiles fast code for a step of a batch.

    Args:
        batch: Sizes of the batch, the leading axes of tensors; empty for one arm.

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
    """Private names of inductor that are missing or have unexpected parameters."""
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
        "compiled without the batch-last memory layout, correct but slower",
        stacklevel=5,
    )


@contextmanager
def _replaced(owner: Any, name: str, value: Any) -> Iterator[None]:
    """Context in which one attribute of a class or module is replaced."""
    # Not getattr, which would bind a classmethod: the original object has to be restored.
    before = vars(owner)[name]
    setattr(owner, name, value)
    try:
        yield
    finally:
        setattr(owner, name, before)


@contextmanager
def _batch_last(batch: list[int]) -> Iterator[None]:
    """Context in which tensors with leading batch axes have the batch last in memory.

    Then the innermost loops run over the batch, a vector register of elements at a time. By
    default inductor keeps the batch first in memory, and transposes again and again.
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
        # Inductor would take the order of the buffer's inputs, and transpose.
        size = self.get_size()
        if isinstance(self.layout, ir.FlexibleLayout) and _leads(batch, size):
            return _fill_order(len(batch), len(size))
        return preferred(self)

    def decided_view(x: Any, new_size: Sequence[Any]) -> Any:
        # Inductor copies the strides of the viewed buffer, and may change those later: it
        # treats every layout as undecided that does not have the last axis last.
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
    """True if a size begins with the batch and does not end with it already."""
    n = len(batch)
    return list(size[:n]) == batch and list(size[-n:]) != batch


def _fill_order(first: int, axes: int) -> list[int]:
    """Axes from the fastest one: the first ones, then the others."""
    return [*reversed(range(first)), *reversed(range(first, axes))]


def cat_batch_last(batch: list[int]) -> Callable[[Graph], None]:
    """Graph pass that permutes tensors before a concatenation, and its result back.

    Inductor writes the parts directly into the result, whose layout cannot be set otherwise.
    """

    def permute(graph: Graph) -> None:
        for node in graph.find_nodes(op="call_function", target=_CAT):
            args: Any = node.args
            parts, dim, *_ = *args, 0  # aten.cat leaves out a dim of zero
            axes = range(node.meta["val"].ndim)
            dim = axes[dim]
            # Concatenation along the batch, or with the batch last already: nothing to gain.
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
    """New node, with the metadata of its result that inductor needs."""
    node = graph.call_function(function, args)
    node.meta["val"] = function(*tree_map_only(Node, lambda x: x.meta["val"], args))
    return node
