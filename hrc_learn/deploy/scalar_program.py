"""Unroll a traced step into straight-line arithmetic on single numbers.

Each element of a tensor gets a value number: the index of the instruction that computes it. So
each tensor of the trace becomes a tensor of value numbers. PyTorch applies the operations that
only move elements (views, slices, concatenations) to these tensors. All other operations become
one instruction per element. Equal instructions are kept once, and instructions on constants are
evaluated immediately.
"""

import math
import operator
from collections.abc import Callable, Iterable, Sequence
from functools import partialmethod
from typing import Any, final

import numpy as np
import torch
from torch import Tensor
from torch.export import ExportedProgram
from torch.utils import _pytree

aten = torch.ops.aten


class UnknownOperationError(NotImplementedError):
    """A step uses an operation of PyTorch that has no machine code here."""


type Instruction = tuple[Any, ...]
"""Name of an operation, then the value numbers of its operands.

`("input", vector, row, element)` and `("constant", value)` have no operands; the element is an
index in the flattened batch.
"""

BOOLEAN = frozenset({"gt", "lt", "ge", "le", "eq", "ne", "and", "or", "not"})
"""Operations whose result is always a truth value. The result of "select" is a truth value if
both of its choices are."""


@final
class ScalarProgram:
    """Straight-line program of one step.

    Attributes:
        instructions: The instructions, each after its operands.
        boolean: True for each instruction that results in a truth value.
        results: Value number of each row, for each vector that the step writes.
        series: Value numbers along the last axis of each tensor that was calculated.
    """

    def __init__(self, dtype: torch.dtype):
        """Begin an empty program on numbers of one floating-point type."""
        self.instructions: list[Instruction] = []
        self.boolean: list[bool] = []
        self.results: dict[str, list[int]] = {}
        self.series: list[list[int]] = []
        self.number = np.dtype(str(dtype).removeprefix("torch.")).type
        self._known: dict[Instruction, int] = {}

    def constant(self, value: float | bool) -> int:
        """Value number of a constant."""
        if isinstance(value, bool):
            return self._add(("constant", value), boolean=True)
        # As text, the two signs of zero differ and NaN equals itself.
        return self._add(("constant", repr(float(self.number(value)))), boolean=False)

    def input(self, vector: str, row: int, element: int) -> int:
        """Value number of an input: one element of the batch in a row of a vector."""
        return self._add(("input", vector, row, element), boolean=False)

    def emit(self, name: str, *operands: int) -> int:
        """Value number of the result of an operation."""
        if name == "select":
            condition, yes, no = operands
            condition = self.as_truth(condition)
            if yes == no:
                return yes
            boolean = self.boolean[yes] and self.boolean[no]
            if not boolean:
                yes, no = self.as_number(yes), self.as_number(no)
            if self.instructions[condition][0] == "constant":
                return yes if self.instructions[condition][1] else no
            return self._add((name, condition, yes, no), boolean)
        if name in ("and", "or", "not"):
            operands = tuple(map(self.as_truth, operands))
        else:
            operands = tuple(map(self.as_number, operands))
        if all(self.instructions[x][0] == "constant" for x in operands):
            return self._folded(name, operands)
        return self._add((name, *operands), name in BOOLEAN)

    def as_number(self, x: int) -> int:
        """A truth value as 1 or 0; numbers are returned unchanged."""
        if not self.boolean[x]:
            return x
        return self.emit("select", x, self.constant(1.0), self.constant(0.0))

    def as_truth(self, x: int) -> int:
        """Truth value of a number."""
        return x if self.boolean[x] else self.emit("ne", x, self.constant(0.0))

    def value(self, x: int) -> float | bool:
        """Value of a constant."""
        value = self.instructions[x][1]
        return value if isinstance(value, bool) else float(value)

    def needed(self) -> list[int]:
        """Value numbers that the results depend on, in order."""
        used = {x for rows in self.results.values() for x in rows}
        for x in range(len(self.instructions) - 1, -1, -1):
            if x in used:
                used.update(operands(self.instructions[x]))
        return sorted(used)

    def _add(self, instruction: Instruction, boolean: bool) -> int:
        known = self._known.get(instruction)
        if known is None:
            known = self._known[instruction] = len(self.instructions)
            self.instructions.append(instruction)
            self.boolean.append(boolean)
        return known

    def _folded(self, name: str, operands: Sequence[int]) -> int:
        values = [self.value(x) for x in operands]
        dtype = torch.float64 if self.number is np.float64 else torch.float32
        tensors = [
            torch.tensor(x, dtype=torch.bool if isinstance(x, bool) else dtype) for x in values
        ]
        calculate = getattr(torch, _TORCH_NAMES.get(name, name))
        return self.constant(calculate(*tensors).item())


def operands(instruction: Instruction) -> tuple[int, ...]:
    """Value numbers that an instruction reads."""
    return () if instruction[0] in ("input", "constant") else instruction[1:]


# PyTorch's names of our operations, where they differ.
_TORCH_NAMES = {
    "max": "maximum", "min": "minimum",
    "and": "logical_and", "or": "logical_or", "not": "logical_not",
}  # fmt: skip


def _operations(names: str) -> dict[Any, str]:
    return {getattr(aten, name): name for name in names.split()}


# PyTorch's names of operations on each element, where they differ from ours.
_SYNONYMS = {
    "maximum": "max", "clamp_min": "max", "minimum": "min", "clamp_max": "min",
    "bitwise_and": "and", "logical_and": "and", "__and__": "and",
    "bitwise_or": "or", "logical_or": "or", "__or__": "or",
    "bitwise_not": "not", "logical_not": "not", "where": "select",
}  # fmt: skip
_ELEMENTWISE = {
    operation: _SYNONYMS.get(name, name)
    for operation, name in _operations(
        "add sub mul div neg abs sqrt trunc floor ceil round sin cos exp log tanh asin acos "
        "atan atan2 copysign maximum clamp_min minimum clamp_max gt lt ge le eq ne bitwise_and "
        "logical_and __and__ bitwise_or logical_or __or__ bitwise_not logical_not where"
    ).items()
}
# Operations that only move elements: PyTorch carries them out on value numbers.
_MOVES = {operator.getitem} | set(
    _operations(
        "alias broadcast_tensors cat clone copy copy_ detach detach_ diagonal expand expand_as "
        "fill_ flatten flip index index_select lift_fresh_copy mT movedim permute repeat "
        "reshape roll select select_scatter slice slice_scatter split split_with_sizes squeeze "
        "stack t transpose unbind unflatten unsqueeze view"
    )
)
# Operations that depend only on shapes and constants.
_FILLS = set(
    _operations(
        "arange eye full full_like new_zeros ones ones_like scalar_tensor zeros zeros_like"
    )
)
type _Each = Callable[..., Tensor]
# Operations composed of others. The first argument emits an elementwise operation; the other
# arguments are those of PyTorch's operation.
_COMPOSED: dict[str, _Each] = {
    "addcdiv": lambda of, x, a, b, value=1: of("add", x, of("div", of("mul", a, value), b)),
    "addcmul": lambda of, x, a, b, value=1: of("add", x, of("mul", of("mul", a, value), b)),
    "isfinite": lambda of, x: of("lt", of("abs", x), math.inf),
    "isnan": lambda of, x: of("ne", x, x),
    "lerp": lambda of, a, b, weight: of("add", a, of("mul", weight, of("sub", b, a))),
    "masked_fill": lambda of, x, mask, value: of("select", mask, value, x),
    "reciprocal": lambda of, x: of("div", 1.0, x),
    "rsqrt": lambda of, x: of("div", 1.0, of("sqrt", x)),
    "rsub": lambda of, x, other: of("sub", other, x),
    "sign": lambda of, x: of("sub", of("gt", x, 0.0), of("lt", x, 0.0)),
    "square": lambda of, x: of("mul", x, x),
}


def scalar_program(program: ExportedProgram, dtype: torch.dtype) -> ScalarProgram:
    """Unroll a traced step into instructions of its first batch element.

    Args:
        program: Trace of a step on vectors of shape (rows, *batch), without a batch or with a
            small one.
        dtype: Floating-point type of the numbers.

    Raises:
        UnknownOperationError: An operation is unknown here, or an arm of the batch affects
            another arm.
    """
    result = ScalarProgram(dtype)
    with torch.no_grad():
        written = _Unroller(result, program).run()
    for name, values in written.items():
        result.results[name] = values.reshape(len(values), -1)[:, 0].tolist()
    for x in result.needed():
        name, *where = result.instructions[x]
        if name == "input" and where[2] != 0:
            raise UnknownOperationError(f"an arm of the batch reads {where[0]} of another")
    return result


@final
class _Unroller:
    """Walks over the nodes of a trace, and emits their instructions."""

    def __init__(self, result: ScalarProgram, program: ExportedProgram):
        self.result, self.program = result, program
        self.values: dict[Any, Any] = {}

    def run(self) -> dict[str, Tensor]:
        """Value numbers that the step writes, by the name of the vector that receives them."""
        signature = self.program.graph_signature
        stored: dict[str, Any] = self.program.state_dict | self.program.constants
        names = dict(signature.inputs_to_parameters) | dict(signature.inputs_to_buffers)
        names |= dict(signature.inputs_to_lifted_tensor_constants)
        written: dict[str, Tensor] = {}
        nodes: Any = self.program.graph.nodes
        for node in nodes:
            if node.op == "placeholder" and node.name in names:
                self.values[node] = self._constants(stored[names[node.name]])
            elif node.op == "placeholder":
                self.values[node] = self._inputs(node.name, node.meta["val"].shape)
            elif node.target is aten.copy_.default and node.args[0].op == "placeholder":
                target, source = node.args
                written[target.name] = self.values[source]
            elif node.op == "call_function":
                self.values[node] = self._called(node)
        return written

    def _constants(self, x: Tensor) -> Tensor:
        values = x.detach().flatten().tolist()
        kept = [self.result.constant(v if x.dtype == torch.bool else float(v)) for v in values]
        return torch.tensor(kept, dtype=torch.int64).reshape(x.shape)

    def _inputs(self, name: str, shape: Sequence[int]) -> Tensor:
        rows, elements = shape[0], math.prod(shape[1:])
        kept = [self.result.input(name, row, k) for row in range(rows) for k in range(elements)]
        return torch.tensor(kept, dtype=torch.int64).reshape(tuple(shape))

    def _called(self, node: Any) -> Any:
        args, keywords = _pytree.tree_map_only(
            torch.fx.Node, lambda x: self.values[x], (list(node.args), dict(node.kwargs))
        )
        operation: Any = getattr(node.target, "overloadpacket", node.target)
        if operation in _ELEMENTWISE:
            if "alpha" in keywords:
                args[1] = self._each("mul", args[1], keywords.pop("alpha"))
            if keywords:
                raise UnknownOperationError(f"{node.target} with {', '.join(keywords)}")
            return self._each(_ELEMENTWISE[operation], *args)
        if operation in _MOVES:
            return node.target(*args, **keywords)
        if operation in _FILLS:
            # Only shape and type of a tensor matter.
            args = [x.double() if isinstance(x, Tensor) else x for x in args]
            return self._constants(node.target(*args, **keywords))
        name = operation.__name__.lstrip("_")
        if name in _COMPOSED:
            return _COMPOSED[name](self._each, *args, **keywords)
        method = getattr(self, f"aten_{name}", None)
        if method is None:
            raise UnknownOperationError(f"operation {node.target} of the step is not known")
        return method(*args, **keywords)

    def _each(self, name: str, *args: Any) -> Tensor:
        """An operation on each element, with broadcasting."""
        tensors = torch.broadcast_tensors(*map(self._tensor, args))
        rows = zip(*(x.flatten().tolist() for x in tensors), strict=True)
        kept = [self.result.emit(name, *row) for row in rows]
        values = torch.tensor(kept, dtype=torch.int64).reshape(tensors[0].shape)
        self.result.series += (
            values.reshape(-1, *(values.shape[-1:] or (1,))).tolist() if kept else []
        )
        return values

    def _tensor(self, x: Any) -> Tensor:
        if isinstance(x, Tensor):
            return x
        return torch.tensor(self.result.constant(x if isinstance(x, bool) else float(x)))

    def _reduced(
        self, name: str, first: Any, x: Tensor, dim: Any = None, keepdim: bool = False, **_: Any
    ) -> Tensor:
        """Reduce elements along axes; `first` is the result for no elements."""
        axes = list(range(x.ndim)) if dim in (None, []) else dim
        axes = [axis % x.ndim for axis in ([axes] if isinstance(axes, int) else axes)]
        others = [axis for axis in range(x.ndim) if axis not in axes]
        shape = [x.shape[axis] for axis in others]
        rows = x.permute(*axes, *others).flatten(0, len(axes) - 1) if axes else x[None]
        if not len(rows):
            rows = self._tensor(first).expand(1, *shape)
        # Pair the halves: processors do independent operations at the same time.
        while (count := len(rows)) > 1:
            half = 1 << (count - 1).bit_length() - 1
            paired = self._each(name, rows[: count - half], rows[half:])
            rows = torch.cat([paired, rows[count - half : half]])
        if keepdim:
            shape = [1 if axis in axes else x.shape[axis] for axis in range(x.ndim)]
        return rows.reshape(shape)

    # Operations of PyTorch by name, with PyTorch's arguments.

    aten_sum = partialmethod(_reduced, "add", 0.0)
    aten_amax = partialmethod(_reduced, "max", -math.inf)
    aten_amin = partialmethod(_reduced, "min", math.inf)
    aten_any = partialmethod(_reduced, "or", False)
    aten_all = partialmethod(_reduced, "and", True)

    def aten_mean(self, x: Tensor, dim: Any = None, keepdim: bool = False, **_: Any) -> Tensor:
        total = self.aten_sum(x, dim, keepdim)
        return self._each("div", total, float(x.numel() // total.numel()))

    def aten_linalg_vector_norm(
        self, x: Tensor, ord: float | int = 2, dim: Any = None, keepdim: bool = False, **_: Any
    ) -> Tensor:
        if ord == math.inf:
            return self._reduced("max", 0.0, self._each("abs", x), dim, keepdim)
        if ord != 2:
            raise UnknownOperationError(f"norm of order {ord}")
        return self._each("sqrt", self.aten_sum(self._each("mul", x, x), dim, keepdim))

    def aten_softmax(self, x: Tensor, dim: int, *_: Any) -> Tensor:
        weights = self._each("exp", self._each("sub", x, self.aten_amax(x, [dim], True)))
        return self._each("div", weights, self.aten_sum(weights, dim, True))

    def aten_logsumexp(self, x: Tensor, dim: list[int], keepdim: bool = False) -> Tensor:
        most = self.aten_amax(x, dim, True)
        finite = self._each("lt", self._each("abs", most), math.inf)
        most = self._each("select", finite, most, 0.0)
        weights = self._each("exp", self._each("sub", x, most))
        result = self._each("add", most, self._each("log", self.aten_sum(weights, dim, True)))
        return result if keepdim else result.squeeze(dim)

    def _best(self, better: str, x: Tensor, dim: int, keepdim: bool = False) -> Tensor:
        """Index of the first best element along an axis; NaN is better than any number."""
        first, *others = x.unbind(dim)
        best, position = first, self._tensor(0.0).expand(first.shape)
        for k, element in enumerate(others, start=1):
            is_nan = self._each("ne", element, element)
            replaces = self._each("or", self._each(better, element, best), is_nan)
            replaces = self._each("and", replaces, self._each("eq", best, best))
            best = self._each("select", replaces, element, best)
            position = self._each("select", replaces, float(k), position)
        return position.unsqueeze(dim) if keepdim else position

    aten_argmax = partialmethod(_best, "gt")
    aten_argmin = partialmethod(_best, "lt")

    def aten_gather(self, x: Tensor, dim: int, index: Tensor) -> Tensor:
        part = x[tuple(slice(None) if k == dim % x.ndim else slice(size)
                       for k, size in enumerate(index.shape))]  # fmt: skip
        result, *others = (element.unsqueeze(dim) for element in part.unbind(dim))
        for k, element in enumerate(others, start=1):
            result = self._each("select", self._each("eq", index, float(k)), element, result)
        return result.expand(index.shape)

    def aten_clamp(self, x: Tensor, low: Any = None, high: Any = None) -> Tensor:
        if low is not None:
            x = self._each("max", x, low)
        return x if high is None else self._each("min", x, high)

    def aten_linalg_cross(self, a: Tensor, b: Tensor, *, dim: int = -1) -> Tensor:
        a, b = torch.broadcast_tensors(a, b)
        there = self._each("mul", a.roll(-1, dim), b.roll(-2, dim))
        return self._each("sub", there, self._each("mul", a.roll(-2, dim), b.roll(-1, dim)))

    def aten_linalg_vecdot(self, a: Tensor, b: Tensor, *, dim: int = -1) -> Tensor:
        return self.aten_sum(self._each("mul", a, b), dim)

    def aten_cumsum(self, x: Tensor, dim: int) -> Tensor:
        ends = range(1, x.shape[dim] + 1)
        return torch.stack([self.aten_sum(x.narrow(dim, 0, k), [dim]) for k in ends], dim)

    def aten_pow(self, x: Tensor, exponent: Any) -> Tensor:
        if exponent == 0.5:
            return self._each("sqrt", x)
        if isinstance(exponent, int | float) and exponent in (2, 3, 4):
            square = self._each("mul", x, x)
            rest = {2: None, 3: x, 4: square}[exponent]
            return square if rest is None else self._each("mul", square, rest)
        return self._each("pow", x, exponent)

    def aten_to(self, x: Tensor, dtype: Any = None, *_: Any, **__: Any) -> Tensor:
        if not isinstance(dtype, torch.dtype) or not x.numel():
            return x
        convert = self.result.as_truth if dtype == torch.bool else self.result.as_number
        kept = [convert(v) for v in x.flatten().tolist()]
        values = torch.tensor(kept, dtype=torch.int64).reshape(x.shape)
        if dtype == torch.bool or dtype.is_floating_point:
            return values
        # Whole numbers are kept as floating-point ones, exact to 2^53.
        return self._each("trunc", values)

    def aten_pad(
        self, x: Tensor, pad: Iterable[int], mode: str = "constant", value: Any = None
    ) -> Tensor:
        filled = self.result.constant(float(value or 0.0))
        return torch.nn.functional.pad(x, list(pad), mode, value=filled)

    def aten_assert_tensor_metadata(self, *_: Any, **__: Any) -> None:
        """Ignore a check that the trace has already passed."""
