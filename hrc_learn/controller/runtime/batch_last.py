"""Has inductor keep the batch last in memory, whatever comes first in a tensor."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any
from unittest import mock

import torch
from torch.fx import Graph, Node
from torch.utils._pytree import tree_map_only

_JOIN, _TURN = torch.ops.aten.cat.default, torch.ops.aten.permute.default


@contextmanager
def batch_last(batch: Sequence[int]) -> Iterator[dict[str, Any]]:
    """Lays out whatever is compiled within, and has the batch first, with the batch last.

    So loops run over the batch innermost, a vector register of elements at a time. Left alone,
    inductor keeps results with the batch first, and transposes them all along.

    Yields:
        Options to compile with.
    """
    if not batch:
        yield {}
        return
    from torch._inductor import ir

    order, view = list(batch), ir.View.create
    plain, preferred = ir.FlexibleLayout.__init__, ir.ComputedBuffer.get_fill_order

    def lay_out(
        self: Any,
        device: torch.device,
        dtype: torch.dtype,
        size: Sequence[Any],
        stride_order: Sequence[Any] | None = None,
        is_pinned: bool = False,
    ) -> None:
        if not stride_order and _leads(order, size):
            stride_order = _fill_order(len(order), len(size))
        plain(self, device, dtype, size, stride_order, is_pinned)

    def fill_order(self: Any) -> Any:
        # Inductor would take that of what a buffer is computed from, and transpose.
        size = self.get_size()
        if isinstance(self.layout, ir.FlexibleLayout) and _leads(order, size):
            return _fill_order(len(order), len(size))
        return preferred(self)

    def decided_view(x: Any, new_size: Sequence[Any]) -> Any:
        # Inductor copies the strides of what it looks at, and may yet change those of the
        # latter: by its own lights only what has the last axis last is still undecided.
        if ir.is_storage_and_layout(x):
            x.freeze_layout()
        return view(x, new_size)

    with (
        mock.patch.object(ir.FlexibleLayout, "__init__", lay_out),
        mock.patch.object(ir.ComputedBuffer, "get_fill_order", fill_order),
        mock.patch.object(ir.View, "create", staticmethod(decided_view)),
    ):
        yield {"post_grad_custom_post_pass": joining_batch_last(order)}


def _leads(batch: Sequence[int], size: Sequence[Any]) -> bool:
    """Whether a size has the batch first, and not last already."""
    n = len(batch)
    return list(size[:n]) == batch and list(size[-n:]) != batch


def _fill_order(first: int, axes: int) -> list[int]:
    """Axes from the fastest running one: the first few, then the others."""
    return [*reversed(range(first)), *reversed(range(first, axes))]


def joining_batch_last(batch: list[int]) -> Callable[[Graph], None]:
    """A pass over a graph that turns tensors before they are joined, and the whole back.

    Inductor writes parts straight into the whole, which it lays out without asking.
    """

    def turn(graph: Graph) -> None:
        for node in graph.find_nodes(op="call_function", target=_JOIN):
            args: Any = node.args
            parts, dim, *_ = *args, 0
            axes = range(node.meta["val"].ndim)
            dim = axes[dim]
            if dim < len(batch) or not _leads(batch, node.meta["val"].shape):
                continue
            first, last = axes[: len(batch)], axes[len(batch) :]
            with graph.inserting_before(node):
                turned = [_call(graph, _TURN, x, [*last, *first]) for x in parts]
                whole = _call(graph, _JOIN, turned, dim - len(batch))
                back = _call(graph, _TURN, whole, [*axes[len(last) :], *axes[: len(last)]])
            node.replace_all_uses_with(back)
            graph.erase_node(node)

    return turn


def _call(graph: Graph, function: Any, *args: Any) -> Node:
    """A new node, with what inductor has to know of its result."""
    node = graph.call_function(function, args)
    node.meta["val"] = function(*tree_map_only(Node, lambda x: x.meta["val"], args))
    return node
