"""The control step compiled ahead of time into one file."""

from __future__ import annotations

import hashlib
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest import mock

import torch
from torch.fx import Graph, Node
from torch.utils import _pytree
from torch.utils._pytree import tree_map_only

from hrc_learn.controller import AdaptiveController, Observation
from hrc_learn.deploy.io_layout import FlatStep
from hrc_learn.deploy.package import UnknownCodeError, describe, fingerprint, machine
from hrc_learn.store import Claim, new_file

# Has inductor keep the batch last in memory, whatever comes first in a tensor.

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


# The control step compiled ahead of time into one file.

# Memory that a step may take from the stack [bytes]: allocations there are free, those of
# torch cost more than the arithmetic. Threads commonly have 8 MB.
_STACK = 2**20


class NoCompilerError(RuntimeError):
    """There is no C++ compiler to build a package with."""


def export_step(
    controller: AdaptiveController, observation: Observation, folder: Path | None = None
) -> Path:
    """Compile a controller's step, unless an equal one was compiled before.

    A package fits the machine it was built on. Its name in the folder is a hash of torch's
    version, of the processor, of the source of this library, and of all settings and weights
    of the controller. With parts of your own, whose source it cannot know, it is one of the
    traced step, which takes seconds more.

    Args:
        controller: Whose step.
        observation: An example with exactly the fields that later ones will have. Fields
            left out, and a `dt` that is a number, become constants; so do the controller's
            own goals where it brings none. Its batch dimensions and dtype are those of the
            package; float32 counts interventions to 16 million only.
        folder: Where packages are kept; default: the user's cache.

    Returns:
        The `.pt2` package.

    Raises:
        NoCompilerError: No C++ compiler was found, and no package either.
        ValueError: dt is not in (0, 1/rate] of the safety filter.
    """
    folder = folder or _default_folder()
    step = FlatStep(controller, observation)
    program = None
    try:
        key = fingerprint(machine(), controller, _structure(observation))
    except UnknownCodeError:
        program = trace(step, observation)
        key = _digest(step, program)
    package = folder / f"step-{key[:24]}.pt2"
    if package.is_file():
        return package
    _require_compiler()
    folder.mkdir(parents=True, exist_ok=True)
    # Who else compiles the same step is waited for: that is quicker than to compile it too.
    with Claim(package, wait=True) as claim:
        if package.is_file():
            return package
        with new_file(claim) as part:
            program = program or trace(step, observation)
            with batch_last(step.layouts.state.batch) as options:
                says = {"aot_inductor.metadata": describe(step, observation)}
                _compile(program, part, options | says)
    return package


def trace(step: FlatStep, observation: Observation) -> torch.export.ExportedProgram:
    """One graph of a step, as AOTInductor takes it."""
    with torch.no_grad():
        program = torch.export.export(step, tuple(step.example(observation)), strict=False)
    aten = torch.ops.aten
    for node in program.graph.nodes:
        # Inductor of torch 2.11 cannot raise a constant number to a power.
        if node.target is aten.square.default:
            node.target, node.args = aten.mul.Tensor, (node.args[0], node.args[0])
    return program


def _compile(
    program: torch.export.ExportedProgram, package: Path, options: dict[str, Any]
) -> None:
    from torch._inductor.codegen import cpp_wrapper_cpu_array_ref

    options = {"aot_inductor.allow_stack_allocation": True} | options
    stack = mock.patch.object(
        cpp_wrapper_cpu_array_ref, "MAX_STACK_ALLOCATION_SIZE", _STACK, create=True
    )
    with torch.no_grad(), stack:
        torch._inductor.aoti_compile_and_package(
            program, package_path=str(package), inductor_configs=options
        )


def _structure(observation: Observation) -> list[tuple[str, str]]:
    """What of an example makes a difference to the step: all but the values of tensors."""
    leaves, _ = _pytree.tree_flatten_with_path(observation)
    return [
        (
            _pytree.keystr(path),
            f"{x.dtype} {tuple(x.shape)}" if isinstance(x, torch.Tensor) else repr(x),
        )
        for path, x in leaves
    ]


def _digest(step: FlatStep, program: torch.export.ExportedProgram) -> str:
    """Hash of all that decides what a package computes and where it runs."""
    digest = hashlib.sha256()
    fields = [field for layout in step.layouts for field in layout.fields]
    for text in (machine(), program.graph, program.graph_signature, fields):
        digest.update(str(text).encode())
    digest.update(step.first_state.numpy().tobytes())
    for name, value in sorted((program.state_dict | program.constants).items()):
        assert isinstance(value, torch.Tensor)
        digest.update(name.encode() + value.detach().cpu().numpy().tobytes())
    return digest.hexdigest()


def _require_compiler() -> None:
    from torch._inductor import cpp_builder, exc

    try:
        cpp_builder.get_cpp_compiler()
    except exc.InvalidCxxCompiler as error:
        raise NoCompilerError(
            "no C++ compiler found: install g++, or name one in CXX"
        ) from error


def _default_folder() -> Path:
    home = Path.home()
    if sys.platform == "win32":
        base = Path(os.environ.get("LOCALAPPDATA", home / "AppData" / "Local"))
    elif sys.platform == "darwin":
        base = home / "Library" / "Caches"
    else:
        base = Path(os.environ.get("XDG_CACHE_HOME", home / ".cache"))
    return base / "hrc_learn"
