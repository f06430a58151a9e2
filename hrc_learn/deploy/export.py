"""Ahead-of-time compilation of a control step into a folder named by a hash of its content."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from functools import cache
from pathlib import Path
from typing import Any, final

import torch
from torch import Tensor
from torch.fx import Graph, Node
from torch.utils import _pytree

from hrc_learn.deploy.package import PackedStep, StepObservation, Steppable, describe, machine
from hrc_learn.kinematics import SerialChain
from hrc_learn.store import EXPORT, Claim, replacing


class NoCompilerError(RuntimeError):
    """No C++ compiler was found."""


def export_step(
    controller: Steppable, observation: StepObservation, folder: Path | None = None
) -> Path:
    """Compile the step of a controller, unless an equal one has been compiled before.

    A package runs on the machine that built it. The name of its folder is a hash of torch's
    version, of the processor, of the source of this library, and of all settings and weights of
    the controller. With classes from outside this library, whose source is unknown, the hash is
    that of the traced step, which takes seconds longer.

    Args:
        controller: Controller with the step.
        observation: An example with exactly the fields of later observations. Missing fields,
            and a `dt` that is a number, become constants; so do the controller's own goals if
            it has none. It sets batch dimensions and dtype of the package; float32 counts
            interventions to 16 million only.
        folder: Folder of the packages; default: the user's cache.

    Returns:
        Path of the package, `step.pt2` in its folder.

    Raises:
        NoCompilerError: There is neither a package nor a C++ compiler.
        ValueError: dt is not in (0, 1/rate] of the safety filter.
    """
    if folder is None:
        folder = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "hrc_learn"
    step = PackedStep(controller, observation)
    program = None
    try:
        key = content_hash(machine(), controller, _structure(observation))
    except UnknownCodeError:
        program = trace(step, observation)
        key = _digest(step, program)
    target = folder / f"step-{key[:24]}"
    package = target / "step.pt2"
    if package.is_file():
        return package
    _require_compiler()
    folder.mkdir(parents=True, exist_ok=True)
    # Waiting for another process that compiles the same step is faster than compiling it again.
    with Claim(target, wait=True) as claim:
        if package.is_file():
            return package
        with replacing(claim, EXPORT, overwrite=True) as new:
            new.mkdir()
            program = program or trace(step, observation)
            metadata = {"aot_inductor.metadata": describe(step, observation)}
            with torch.no_grad(), tuned_for(step.layouts.state.batch) as options:
                torch._inductor.aoti_compile_and_package(
                    program,
                    package_path=str(new / package.name),
                    inductor_configs=options | metadata,
                )
    return package


def trace(step: PackedStep, observation: StepObservation) -> torch.export.ExportedProgram:
    """Graph of a step in the form that AOTInductor needs."""
    with torch.no_grad():
        program = torch.export.export(step, tuple(step.example(observation)), strict=False)
    aten = torch.ops.aten
    for node in program.graph.nodes:
        # The inductor of torch 2.11 cannot raise a constant to a power.
        if node.target is aten.square.default:
            node.target, node.args = aten.mul.Tensor, (node.args[0], node.args[0])
    return program


def _structure(observation: StepObservation) -> list[tuple[str, str]]:
    """Structure of an example: all fields, with shapes and dtypes in place of tensors."""
    leaves, _ = _pytree.tree_flatten_with_path(observation)
    return [
        (
            _pytree.keystr(path),
            f"{x.dtype} {tuple(x.shape)}" if isinstance(x, Tensor) else repr(x),
        )
        for path, x in leaves
    ]


def _digest(step: PackedStep, program: torch.export.ExportedProgram) -> str:
    """Hash of a traced step, its constants and the machine."""
    digest = hashlib.sha256()
    fields = [field for layout in step.layouts for field in layout.fields]
    for text in (machine(), program.graph, program.graph_signature, fields):
        digest.update(str(text).encode())
    digest.update(step.first_state.numpy().tobytes())
    for name, value in sorted((program.state_dict | program.constants).items()):
        assert isinstance(value, Tensor)
        digest.update(name.encode() + value.detach().cpu().numpy().tobytes())
    return digest.hexdigest()


def _require_compiler() -> None:
    from torch._inductor import cpp_builder, exc

    try:
        cpp_builder.get_cpp_compiler()
    except exc.InvalidCxxCompiler as error:
        raise NoCompilerError("no C++ compiler found: install g++, or set CXX") from error


# Sources of a compiled step, all hashed: equal hashes mean equal compiled code.
_ROOT = Path(__file__).parents[1]
_SOURCES = (
    "pytree.py",
    "geometry",
    "kinematics",
    "regions",
    "jacobian",
    "controller",
    "deploy",
)
# Types whose `repr` represents their whole value.
_PLAIN = (type(None), bool, int, float, str, bytes, torch.dtype, torch.device)


class UnknownCodeError(TypeError):
    """The code of an object's class, or of a function it holds, is outside this library."""


def content_hash(*objects: Any) -> str:
    """Hash of all values in some objects, and of the source of this library.

    Args:
        objects: Modules, dataclasses and their contents.

    Raises:
        UnknownCodeError: They hold an object of a class outside this library and torch.
    """
    hasher = _ObjectHasher()
    for x in objects:
        hasher.add(x)
    hasher.digest.update(_source_hash())
    return hasher.digest.hexdigest()


@final
class _ObjectHasher:
    """Hash of values in a fixed order; each object once, further references by its number."""

    def __init__(self):
        self.digest = hashlib.sha256()
        self.seen: dict[int, Any] = {}  # keeps the objects alive, so that ids stay unique

    def add(self, x: Any) -> None:
        kind = type(x)
        self._update(f"{kind.__module__}.{kind.__qualname__}")
        if isinstance(x, Tensor):
            self._update(f"{x.dtype} {tuple(x.shape)} {x.device}")
            self.digest.update(x.detach().cpu().contiguous().numpy().tobytes())
        elif isinstance(x, _PLAIN):
            self._update(repr(x))
        elif id(x) in self.seen:
            self._update(f"again {list(self.seen).index(id(x))}")
        else:
            self.seen[id(x)] = x
            self._add_parts(x)

    def _add_parts(self, x: Any) -> None:
        if isinstance(x, Mapping):
            for key, value in x.items():
                self.add(key)
                self.add(value)
        elif isinstance(x, set):
            self.add(sorted(x, key=repr))
        elif isinstance(x, list | tuple):
            for value in x:
                self.add(value)
        elif isinstance(x, SerialChain):
            # The shape of an arm, which may be a function that reads it, is no part of a step.
            self.add([x.joint_names, x.mounts, x.flange, x.tcp, x.limits, x.ready, x.kinds])
        elif type(x).__module__.split(".")[0] in ("hrc_learn", "torch") and hasattr(
            x, "__dict__"
        ):
            self.add(x.__getstate__())
        else:
            raise UnknownCodeError(f"the code of {type(x).__qualname__} is unknown")
        self._update("end")

    def _update(self, text: str) -> None:
        self.digest.update(f"{text}\n".encode())


@cache
def _source_hash() -> bytes:
    digest = hashlib.sha256()
    for name in _SOURCES:
        for path in sorted([_ROOT / name, *(_ROOT / name).rglob("*.py")]):
            if path.is_file():
                digest.update(str(path.relative_to(_ROOT)).encode() + path.read_bytes())
    return digest.digest()


# Memory layout of compiled steps. Inductor has no public option for the layout of results, nor
# for the level of optimization, so four of its private functions, and a limit, are replaced
# during a compilation. They exist in
# all versions of torch that pyproject.toml allows; tests/deploy/test_inductor.py watches them.

# Stack memory that a step may use [bytes]: allocations there are free, while those of torch
# cost more than the arithmetic. Threads commonly have 8 MB.
_STACK = 2**20
_CAT, _PERMUTE = torch.ops.aten.cat.default, torch.ops.aten.permute.default


@contextmanager
def tuned_for(batch: Sequence[int]) -> Iterator[dict[str, Any]]:
    """Context in which inductor compiles fast code for a step of a batch.

    Args:
        batch: Sizes of the batch, the leading axes of tensors; empty for one arm.

    Yields:
        Options to compile with.
    """
    from torch._inductor import cpp_builder
    from torch._inductor.codegen import cpp_wrapper_cpu_array_ref as wrapper

    plain = cpp_builder._get_optimization_cflags

    def flags_of_batches(*args: Any, **more: Any) -> tuple[list[str], list[str]]:
        # One kernel of 26,000 lines: GCC 12.2 ends with an internal error at -O3. The loops
        # over the batch are vectorized by inductor, at any level.
        compiling, linking = plain(*args, **more)
        return ["O2" if flag == "O3" else flag for flag in compiling], linking

    options: dict[str, Any] = {"aot_inductor.allow_stack_allocation": True}
    with ExitStack() as stack:
        stack.enter_context(_replaced(wrapper, "MAX_STACK_ALLOCATION_SIZE", _STACK))
        if batch:
            stack.enter_context(_batch_last(list(batch)))
            stack.enter_context(
                _replaced(cpp_builder, "_get_optimization_cflags", flags_of_batches)
            )
            options["post_grad_custom_post_pass"] = cat_batch_last(list(batch))
        yield options


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
        self: Any, device: Any, dtype: Any, size: Any, stride_order: Any = None, **more: Any
    ) -> None:
        if not stride_order and _leads(batch, size):
            stride_order = _fill_order(len(batch), len(size))
        plain(self, device, dtype, size, stride_order, **more)

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
    node.meta["val"] = function(*_pytree.tree_map_only(Node, lambda x: x.meta["val"], args))
    return node
