"""Compile a scalar program (see `scalar_program`) with LLVM, and run its machine code.

For a batch, the code computes as many arms at once as a vector register holds numbers. The
code is a sequence of short functions, so that the compile time is only proportional to the
length of the program. A value that a later function reads is kept in a slot of the workspace, a
small array that the caller provides.
"""

import ctypes
import heapq
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import Any, final

import numpy as np
import torch
from jaxtyping import Int
from llvmlite import binding, ir
from torch import Tensor

from hrc_learn.deploy.scalar_program import ScalarProgram, operands

# Instructions per function: with more, LLVM's register allocation slows down; with fewer, the
# workspace is read and written more often.
_LENGTH = 1000

# Products and sums are not fused: with the extra precision, tests for zero could turn out
# differently from PyTorch.
_BUILT = {
    "add": ir.IRBuilder.fadd, "sub": ir.IRBuilder.fsub, "mul": ir.IRBuilder.fmul,
    "div": ir.IRBuilder.fdiv, "neg": ir.IRBuilder.fneg, "and": ir.IRBuilder.and_,
    "or": ir.IRBuilder.or_, "not": ir.IRBuilder.not_, "select": ir.IRBuilder.select,
}  # fmt: skip
_ORDERED = {"gt": ">", "lt": "<", "ge": ">=", "le": "<=", "eq": "=="}
# Comparisons that are also true if an operand is NaN.
_UNORDERED = {"ne": "!=", "not gt": "<=", "not lt": ">=", "not ge": "<", "not le": ">"}
# Names of LLVM's intrinsic functions, where they differ from ours.
_INTRINSICS = {"abs": "fabs", "round": "roundeven"}

ENTRY = "control_step"
"""Name of the function `control_step(state, observation, command, workspace, stride, count)`.

The function takes a step for the first `count` arms; `count` is a multiple of `lanes`.
Successive rows of a vector are `stride` numbers apart in memory."""


@final
class NativeCode:
    """LLVM assembly of a program.

    Attributes:
        text: The module in LLVM's text format.
        lanes: Number of arms computed at once.
        workspace: Size of the workspace in numbers.
    """

    def __init__(self, program: ScalarProgram, vectors: Sequence[str], lanes: int):
        """Generate the text.

        Args:
            program: Program of one arm.
            vectors: Names of the program's vectors, in the order of `control_step`.
            lanes: Number of arms computed at once.
        """
        self._program, self._vectors, self.lanes = program, tuple(vectors), lanes
        self._size = np.dtype(program.number).itemsize
        self._scalar = {8: ir.DoubleType(), 4: ir.FloatType()}[self._size]
        self._number, self._truth, self._flag = (
            kind if lanes == 1 else ir.VectorType(kind, lanes)
            for kind in (self._scalar, ir.IntType(1), ir.IntType(8))
        )
        self._module = ir.Module()
        order = _depth_first(program)
        chunks = [order[k : k + _LENGTH] for k in range(0, len(order), _LENGTH)]
        self._slot, slots = _allocate(program, chunks)
        self.workspace = slots * lanes
        parts = [self._part(k, chunk) for k, chunk in enumerate(chunks)]
        self._entry([*parts, self._store()])
        self.text = str(self._module)

    def _begun(self, name: str, *more: ir.Type) -> ir.IRBuilder:
        """Builder of a new function that takes the vectors, the workspace and the stride."""
        pointers = [ir.PointerType()] * (len(self._vectors) + 1)
        kind = ir.FunctionType(ir.VoidType(), [*pointers, ir.IntType(64), *more])
        function = ir.Function(self._module, kind, name)
        for pointer in function.args[: len(pointers)]:
            pointer.add_attribute("noalias")
        return ir.IRBuilder(function.append_basic_block("entry"))

    def _entry(self, parts: Sequence[ir.Function]) -> None:
        """Write `control_step`: a loop over the arms that calls all parts for `lanes` arms."""
        builder = self._begun(ENTRY, ir.IntType(64))
        *vectors, workspace, stride, count = builder.function.args
        entry = builder.block
        loop, step, end = (builder.append_basic_block(name) for name in ("loop", "step", "end"))
        builder.branch(loop)
        builder.position_at_end(loop)
        i = builder.phi(ir.IntType(64))
        i.add_incoming(ir.IntType(64)(0), entry)
        following = builder.add(i, ir.IntType(64)(self.lanes))
        i.add_incoming(following, step)
        builder.cbranch(builder.icmp_signed("<=", following, count), step, end)
        builder.position_at_end(step)
        arms = [builder.gep(x, [i], source_etype=self._scalar) for x in vectors]
        for part in parts:
            builder.call(part, [*arms, workspace, stride])
        builder.branch(loop)
        builder.position_at_end(end)
        builder.ret_void()

    def _part(self, index: int, chunk: Sequence[int]) -> ir.Function:
        """Function that loads operands, executes a chunk of instructions and stores values."""
        builder, values = self._begun_part(f"part{index}"), {}
        read = {x for v in chunk for x in operands(self._program.instructions[v])}
        for x in sorted(read - set(chunk)):
            values[x] = self._fetched(builder, x)
        for v in chunk:
            name, *parts = self._program.instructions[v]
            values[v] = self._calculated(builder, name, [values[x] for x in parts])
            if v in self._slot:
                self._keep(builder, v, values[v])
        builder.ret_void()
        return builder.function

    def _store(self) -> ir.Function:
        """Function that writes the results, once all inputs have been read."""
        builder = self._begun_part("store")
        results = self._program.results
        values = {x: self._fetched(builder, x) for rows in results.values() for x in rows}
        for vector, rows in results.items():
            for row, x in enumerate(rows):
                builder.store(values[x], self._row(builder, vector, row), align=self._size)
        builder.ret_void()
        return builder.function

    def _begun_part(self, name: str) -> ir.IRBuilder:
        builder = self._begun(name)
        builder.function.linkage = "private"
        builder.function.attributes.add("noinline")
        return builder

    def _row(self, builder: ir.IRBuilder, vector: str, row: int) -> ir.Value:
        """Address of the present arms' numbers in a row of a vector."""
        *_, stride = builder.function.args
        first = builder.function.args[self._vectors.index(vector)]
        offset = builder.mul(stride, ir.IntType(64)(row))
        return builder.gep(first, [offset], source_etype=self._scalar)

    def _place(self, builder: ir.IRBuilder, x: int) -> ir.Value:
        """Address of a value's slot in the workspace."""
        offset = ir.IntType(64)(self._slot[x] * self.lanes)
        return builder.gep(builder.function.args[-2], [offset], source_etype=self._scalar)

    def _fetched(self, builder: ir.IRBuilder, x: int) -> Any:
        """Value number `x`: a constant, or loaded from an input vector or the workspace."""
        kind, *where = self._program.instructions[x]
        boolean = self._program.boolean[x]
        if kind == "constant":
            return (self._truth if boolean else self._number)(self._program.value(x))
        if kind == "input":
            place = self._row(builder, where[0], where[1])
        else:
            place = self._place(builder, x)
        if not boolean:
            return builder.load(place, align=self._size, typ=self._number)
        return builder.trunc(builder.load(place, align=1, typ=self._flag), self._truth)

    def _keep(self, builder: ir.IRBuilder, x: int, value: Any) -> None:
        """Store a value in the workspace for later functions."""
        place, align = self._place(builder, x), self._size
        if self._program.boolean[x]:
            value, align = builder.zext(value, self._flag), 1
        builder.store(value, place, align=align)

    def _calculated(self, builder: ir.IRBuilder, name: str, parts: list[Any]) -> ir.Value:
        """Result of one instruction."""
        if name in _BUILT:
            return _BUILT[name](builder, *parts)
        if name in _ORDERED:
            return builder.fcmp_ordered(_ORDERED[name], *parts)
        if name in _UNORDERED:
            return builder.fcmp_unordered(_UNORDERED[name], *parts)
        if name in ("max", "min"):
            # NaN if either operand is NaN, as in PyTorch.
            a, b = parts
            better = builder.fcmp_ordered(">" if name == "max" else "<", a, b)
            return builder.select(
                builder.fcmp_unordered("uno", a, a), a, builder.select(better, a, b)
            )
        width = f"f{8 * self._size}" if self.lanes == 1 else f"v{self.lanes}f{8 * self._size}"
        intrinsic = f"llvm.{_INTRINSICS.get(name, name)}.{width}"
        function = self._module.globals.get(intrinsic)
        if function is None:
            kind = ir.FunctionType(self._number, [self._number] * len(parts))
            function = ir.Function(self._module, kind, intrinsic)
        return builder.call(function, parts)


def _depth_first(program: ScalarProgram) -> list[int]:
    """Instructions that the results need, each soon after its operands.

    In this order, few values have to be kept at a time.
    """
    order: list[int] = []
    done = [x[0] in ("constant", "input") for x in program.instructions]
    for results in program.results.values():
        for result in results:
            stack = [(result, False)]
            while stack:
                x, ready = stack.pop()
                if done[x]:
                    continue
                if ready:
                    done[x] = True
                    order.append(x)
                    continue
                stack.append((x, True))
                parts = operands(program.instructions[x])
                stack.extend((y, False) for y in reversed(parts) if not done[y])
    return order


def _allocate(
    program: ScalarProgram, chunks: Sequence[Sequence[int]]
) -> tuple[dict[int, int], int]:
    """Slot of each value that a later function reads, and the number of slots."""
    last: dict[int, int] = {}
    made: dict[int, int] = {}
    for k, chunk in enumerate(chunks):
        for v in chunk:
            made[v] = k
            for x in operands(program.instructions[v]):
                if x in made and made[x] < k:
                    last[x] = k
    for rows in program.results.values():
        last.update((x, len(chunks)) for x in rows if x in made)
    ends: dict[int, list[int]] = {}
    for x, k in last.items():
        ends.setdefault(k, []).append(x)
    slot: dict[int, int] = {}
    free: list[int] = []
    slots = 0
    for k, chunk in enumerate(chunks):
        for v in chunk:
            if v in last:
                if not free:
                    heapq.heappush(free, slots)
                    slots += 1
                slot[v] = heapq.heappop(free)
        for x in ends.get(k, ()):
            heapq.heappush(free, slot[x])
    return slot, slots


def lanes_of(dtype: np.dtype) -> int:
    """Number of values of a dtype in a vector register of this processor."""
    features = binding.get_host_cpu_features()
    width = 64 if features.get("avx512f") else 32 if features.get("avx2") else 16
    return width // dtype.itemsize


def assemble(text: str) -> bytes:
    """Object code of a module for this processor."""
    machine = _machine()
    module = binding.parse_assembly(text)
    module.triple = machine.triple
    return machine.emit_object(module)


def _machine() -> Any:
    """LLVM's code generator for this processor."""
    binding.initialize_native_target()
    binding.initialize_native_asmprinter()
    return binding.Target.from_default_triple().create_target_machine(
        cpu=binding.get_host_cpu_name(),
        features=binding.get_host_cpu_features().flatten(),
        opt=1,  # the program has no loops and no repetitions; level 2 takes 1.5 times as long
        reloc="pic",
        codemodel="large",  # loaded code and constants may be far apart in memory
    )


@final
class NativeStep:
    """Loaded machine code of a step: a function of the vectors state, observation and command.

    Large batches run on as many threads as PyTorch may use.
    """

    def __init__(
        self,
        code: bytes,
        lanes: int,
        workspace: int,
        shared: Sequence[Int[Tensor, " rows"]] = (),
    ):
        """Load the code.

        Args:
            code: Object code for this processor.
            lanes: Number of arms computed at once.
            workspace: Size of the workspace in numbers.
            shared: For each vector, the rows with one value for all arms. The value of the
                first arm is used.
        """
        engine = binding.create_mcjit_compiler(binding.parse_assembly(""), _machine())
        engine.add_object_file(binding.ObjectFileRef.from_data(code))
        engine.finalize_object()
        kind = ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * 4, *[ctypes.c_int64] * 2)
        self._function = kind(engine.get_function_address(ENTRY))
        self._engine = engine  # keeps the code in memory
        self._lanes, self._workspace = lanes, workspace
        self._spaces: list[Tensor] = []
        self._shared = shared

    def __call__(self, vectors: Sequence[Tensor]) -> None:
        """Take a step: update state and command in place.

        Args:
            vectors: State, observation and command, each (rows, *batch) and contiguous.
        """
        first = vectors[0]
        count = first[0].numel()
        for vector, rows in zip(vectors, self._shared, strict=False):
            flat = vector.view(len(vector), -1)
            flat[rows] = flat[rows, :1]
        whole = count - count % self._lanes
        pointers = [x.data_ptr() for x in vectors]
        if count == self._lanes:
            self._function(*pointers, self._space(0, first).data_ptr(), count, count)
            return
        threads = min(torch.get_num_threads(), max(whole // _ARMS_A_THREAD, 1))
        edges = [whole * k // threads // self._lanes * self._lanes for k in range(threads + 1)]

        def work(k: int) -> None:
            begin, end = edges[k : k + 2]
            starts = [pointer + begin * first.element_size() for pointer in pointers]
            space = self._space(k, first).data_ptr()
            self._function(*starts, space, count, end - begin)

        if threads == 1:
            work(0)
        else:
            self._space(threads - 1, first)
            list(_pool(threads).map(work, range(threads)))
        if whole < count:
            self._rest(vectors, whole)

    def _rest(self, vectors: Sequence[Tensor], begin: int) -> None:
        """Take the step for the last arms of a batch, from `begin` on: fewer than `lanes`."""
        rows = [x.view(len(x), -1)[:, begin:] for x in vectors]
        copies = [row.new_zeros(len(row), self._lanes) for row in rows]
        for copy, row in zip(copies, rows, strict=True):
            copy[:, : row.shape[1]] = row
        self(copies)
        for copy, row in zip(copies, rows, strict=True):
            row.copy_(copy[:, : row.shape[1]])

    def _space(self, thread: int, like: Tensor) -> Tensor:
        while len(self._spaces) <= thread:
            self._spaces.append(like.new_empty(max(self._workspace, 1)))
        return self._spaces[thread]


# Fewest arms per thread: a step takes about a microsecond per arm, so that a thread for fewer
# arms would not pay off.
_ARMS_A_THREAD = 256


@cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, "control steps")
