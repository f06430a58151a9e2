"""Compile a scalar program (see `scalar_program`) with LLVM, and run its machine code.

For a batch, the code computes as many arms at once as a vector register holds numbers. For one
arm, it computes successive elements of a tensor at once if their operands are equal, or are
successive elements as well. The code is a sequence of short functions, so that the compile time
is only proportional to the length of the program. A value that a later function reads is kept
in a slot of the workspace, a small array that the caller provides.
"""

import ctypes
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
# Operations that a processor computes for one number at a time.
_SINGLE = {"sin", "cos", "exp", "log", "tanh", "asin", "acos", "atan", "atan2", "pow"}
_TRUTH, _INDEX = ir.IntType(1), ir.IntType(32)
# Names of LLVM's intrinsic functions, where they differ from ours.
_INTRINSICS = {"abs": "fabs", "round": "roundeven"}

type Unit = tuple[int, ...]
"""Consecutive value numbers (see `scalar_program`) whose values one instruction computes."""

ENTRY = "control_step"
"""Name of the function `control_step(state, observation, command, workspace, stride, count)`.

The function takes a step for the first `count` arms; `count` is a multiple of `lanes`.
Successive rows of a vector are `stride` numbers apart in memory. With one lane, `stride` and
`count` are 1."""


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
        self._module = ir.Module()
        self._unit = _units(program, wide=lanes == 1)
        results = [x for rows in program.results.values() for x in rows]
        last = [self._unit[x] for x in results if x in self._unit]
        order = _depth_first(reads := _reads(program, self._unit), last)
        chunks = [order[k : k + _LENGTH] for k in range(0, len(order), _LENGTH)]
        self._slot, slots = _allocate(chunks, reads, last)
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

    def _part(self, index: int, chunk: Sequence[Unit]) -> ir.Function:
        """Function that executes a chunk of instructions, and stores the values that later
        functions need.
        """
        builder, made = self._begun_part(f"part{index}"), {}
        for unit in chunk:
            names, *parts = zip(*(self._program.instructions[x] for x in unit), strict=True)
            values = [self._value(builder, made, xs) for xs in parts]
            made[unit] = value = self._calculated(builder, names[0], values)
            if unit in self._slot:
                builder.store(value, self._place(builder, unit), align=self._size)
        builder.ret_void()
        return builder.function

    def _store(self) -> ir.Function:
        """Function that writes the results, once all inputs have been read."""
        builder, results = self._begun_part("store"), self._program.results
        inputs = {x for rows in results.values() for x in rows if x not in self._unit}
        made = {(x,): self._value(builder, {}, (x,)) for x in inputs}
        for vector, rows in results.items():
            row = 0
            while row < len(rows):
                unit = self._unit.get(rows[row], ())
                xs = unit if tuple(rows[row : row + len(unit)]) == unit != () else (rows[row],)
                place = self._row(builder, vector, row)
                builder.store(self._value(builder, made, xs), place, align=self._size)
                row += len(xs)
        builder.ret_void()
        return builder.function

    def _begun_part(self, name: str) -> ir.IRBuilder:
        builder = self._begun(name)
        builder.function.linkage = "private"
        builder.function.attributes.add("noinline")
        return builder

    def _row(self, builder: ir.IRBuilder, vector: str, row: int) -> ir.Value:
        """Address of the part of a vector's row that belongs to the arms being computed."""
        first, offset = builder.function.args[self._vectors.index(vector)], ir.IntType(64)(row)
        if self.lanes > 1:
            offset = builder.mul(builder.function.args[-1], offset)
        return builder.gep(first, [offset], source_etype=self._scalar)

    def _place(self, builder: ir.IRBuilder, unit: Unit) -> ir.Value:
        """Address of a unit's slots in the workspace."""
        offset = ir.IntType(64)(self._slot[unit] * self.lanes)
        return builder.gep(builder.function.args[-2], [offset], source_etype=self._scalar)

    def _value(self, builder: ir.IRBuilder, made: dict[Unit, Any], xs: Unit) -> Any:
        """Operand: made by this function, constant, or loaded from an input or the workspace.

        Each use repeats the load, since the processor's instructions can read an operand from
        memory.
        """
        if xs in made:
            return made[xs]
        unit, (name, *where) = self._unit.get(xs[0], ()), self._program.instructions[xs[0]]
        scalar = _TRUTH if self._program.boolean[xs[0]] else self._scalar
        kind = (
            scalar if len(xs) * self.lanes == 1 else ir.VectorType(scalar, len(xs) * self.lanes)
        )
        if unit == xs:
            return builder.load(self._place(builder, unit), align=self._size, typ=kind)
        if len(xs) == 1 and unit:
            return builder.extract_element(
                self._value(builder, made, unit), _INDEX(unit.index(*xs))
            )
        if name == "constant" and _fixed(self._program, xs):
            values = [self._program.value(x) for x in xs]
            return kind(values if len(xs) > 1 else values[0])
        if name == "input" and _fixed(self._program, xs):
            return builder.load(self._row(builder, *where[:2]), align=self._size, typ=kind)
        # The operands have only one or two different values, each of them repeated.
        order = ir.VectorType(_INDEX, len(xs))([0] * len(xs))
        repeated = []
        for value in [self._value(builder, made, (x,)) for x in dict.fromkeys(xs)]:
            alone = builder.insert_element(kind(None), value, _INDEX(0))
            repeated.append(builder.shuffle_vector(alone, kind(None), order))
        first = ir.VectorType(_TRUTH, len(xs))([x == xs[0] for x in xs])
        return builder.select(first, *repeated) if len(repeated) > 1 else repeated[0]

    def _calculated(self, builder: ir.IRBuilder, name: str, parts: list[Any]) -> ir.Value:
        """Result of one instruction."""
        if name in _BUILT:
            return _BUILT[name](builder, *parts)
        if name in _ORDERED:
            return builder.fcmp_ordered(_ORDERED[name], *parts)
        if name == "ne":  # true for NaN, too
            return builder.fcmp_unordered("!=", *parts)
        if name in ("max", "min"):
            # NaN if either operand is NaN, as in PyTorch.
            a, b = parts
            better = builder.fcmp_ordered(">" if name == "max" else "<", a, b)
            return builder.select(
                builder.fcmp_unordered("uno", a, a), a, builder.select(better, a, b)
            )
        kind = parts[0].type
        lanes = f"v{kind.count}" if isinstance(kind, ir.VectorType) else ""
        intrinsic = f"llvm.{_INTRINSICS.get(name, name)}.{lanes}f{8 * self._size}"
        function = self._module.globals.get(intrinsic)
        if function is None:
            signature = ir.FunctionType(kind, [kind] * len(parts))
            function = ir.Function(self._module, signature, intrinsic)
        return builder.call(function, parts)


def _fixed(program: ScalarProgram, xs: Unit) -> bool:
    """True for constants, and for successive rows of one vector."""
    first, *_, last = (program.instructions[x] for x in (xs[0], *xs))
    if first[0] == "constant":
        return all(program.instructions[x][0] == "constant" for x in xs)
    return first[:2] == ("input", last[1]) and xs == tuple(range(xs[0], xs[0] + len(xs)))


def _units(program: ScalarProgram, *, wide: bool) -> dict[int, Unit]:
    """Unit of each value that the results need, with up to 8 values if `wide`."""
    needed = {x for x in program.needed() if operands(program.instructions[x])}
    units: dict[int, Unit] = {}

    def fits(xs: Unit) -> bool:
        names, *parts = zip(*(program.instructions[x] for x in xs), strict=False)
        return (
            needed.issuperset(xs)
            and len({*names}) == 1
            and names[0] not in _SINGLE
            and len({program.boolean[x] for x in xs}) == 1
            # All operands have lower numbers than the unit, so no unit depends on itself.
            and xs == tuple(range(xs[0], xs[0] + len(xs)))
            and xs[0] > max(map(max, parts))
            and units.keys().isdisjoint(xs)
            and all(
                len({*part}) <= 2 or units.get(part[0]) == part or _fixed(program, part)
                for part in parts
            )
        )

    for row in program.series if wide else ():
        k = 0
        while k < len(row):
            parts = (tuple(row[k : k + n]) for n in (8, 4) if k + n <= len(row))
            unit = next(filter(fits, parts), ())
            units.update(dict.fromkeys(unit, unit))
            k += len(unit) or 1
    return {x: units.get(x, (x,)) for x in sorted(needed)}


def _reads(program: ScalarProgram, units: dict[int, Unit]) -> dict[Unit, list[Unit]]:
    """Units that each unit reads."""
    return {
        unit: [units[y] for x in unit for y in operands(program.instructions[x]) if y in units]
        for unit in units.values()
    }


def _depth_first(reads: dict[Unit, list[Unit]], results: Sequence[Unit]) -> list[Unit]:
    """Units that the results need, each soon after its operands.

    In this order, few values have to be kept at a time.
    """
    order: dict[Unit, None] = {}
    stack = [(unit, False) for unit in reversed(results)]
    while stack:
        unit, ready = stack.pop()
        if ready:
            order[unit] = None
        elif unit not in order:
            stack.append((unit, True))
            stack.extend((x, False) for x in reversed(reads[unit]))
    return list(order)


def _allocate(
    chunks: Sequence[Sequence[Unit]], reads: dict[Unit, list[Unit]], results: Sequence[Unit]
) -> tuple[dict[Unit, int], int]:
    """First slot of each unit that a later function reads, and the number of slots."""
    place = {unit: k for k, chunk in enumerate(chunks) for unit in chunk}
    last = {x: k for unit, k in place.items() for x in reads[unit] if place[x] < k}
    last.update(dict.fromkeys(results, len(chunks)))
    slot: dict[Unit, int] = {}
    free: dict[int, list[int]] = {1: [], 4: [], 8: []}
    slots = 0
    for k, chunk in enumerate(chunks):
        for unit in (x for x in chunk if x in last):
            if not free[len(unit)]:
                free[len(unit)], slots = [slots], slots + len(unit)
            slot[unit] = free[len(unit)].pop()
        for unit in (x for x, end in last.items() if end == k):
            free[len(unit)].append(slot[unit])
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
