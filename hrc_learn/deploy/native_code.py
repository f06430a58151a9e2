"""Machine code of a scalar program, by LLVM.

The code works on as many arms at once as a vector register has numbers. It is a row of short
functions, which compile in time proportional to their number; a value that a later function
reads is kept in a slot of a small workspace.
"""

from __future__ import annotations

import ctypes
import heapq
import struct
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import Any, final

import numpy as np
import torch
from jaxtyping import Int
from torch import Tensor

from hrc_learn.deploy.scalar_program import Instruction, ScalarProgram, operands

# Instructions of one function: with more the register allocation of LLVM slows down, with fewer
# the workspace is read and written more often.
_LENGTH = 1000

# Products and sums are not fused: one more digit would let tests for zero turn out otherwise
# than in PyTorch.
_BINARY = {"add": "fadd", "sub": "fsub", "mul": "fmul", "div": "fdiv", "and": "and", "or": "or"}
_COMPARISONS = {
    "gt": "ogt", "lt": "olt", "ge": "oge", "le": "ole", "eq": "oeq", "ne": "une",
    "not gt": "ule", "not lt": "uge", "not ge": "ult", "not le": "ugt",
}  # fmt: skip
_INTRINSICS = {
    "abs": "fabs", "sqrt": "sqrt", "trunc": "trunc", "floor": "floor", "ceil": "ceil",
    "round": "roundeven", "sin": "sin", "cos": "cos", "exp": "exp", "log": "log",
    "tanh": "tanh", "asin": "asin", "acos": "acos", "atan": "atan", "atan2": "atan2",
    "pow": "pow", "copysign": "copysign",
}  # fmt: skip

ENTRY = "control_step"
"""Name of the function `control_step(state, observation, command, workspace, stride, count)`.

It takes a step for the first `count` arms, a multiple of `lanes`. Rows of the vectors are
`stride` numbers apart."""


@final
class NativeCode:
    """LLVM's text of a program.

    Attributes:
        text: The module.
        lanes: Number of arms at once.
        slots: Size of the workspace in vectors of `lanes` numbers.
    """

    def __init__(self, program: ScalarProgram, vectors: Sequence[str], lanes: int):
        """Write the text.

        Args:
            program: Program of one arm.
            vectors: Names of the program's vectors in the order of the arguments.
            lanes: Number of arms at once.
        """
        self._program, self._vectors, self.lanes = program, tuple(vectors), lanes
        scalar = {8: "double", 4: "float"}[np.dtype(program.number).itemsize]
        self._scalar = scalar
        self._number = scalar if lanes == 1 else f"<{lanes} x {scalar}>"
        self._truth = "i1" if lanes == 1 else f"<{lanes} x i1>"
        self._declared: set[str] = set()
        order = _depth_first(program)
        chunks = [order[k : k + _LENGTH] for k in range(0, len(order), _LENGTH)]
        self._slot, self.slots = _allocate(program, chunks)
        functions = [self._function(k, chunk) for k, chunk in enumerate(chunks)]
        functions.append(self._store(len(chunks)))
        functions.append(self._entry(len(functions)))
        self.text = "\n".join([*functions, *sorted(self._declared), ""])

    @property
    def _parameters(self) -> str:
        pointers = [f"ptr noalias %{name}" for name in (*self._vectors, "workspace")]
        return ", ".join([*pointers, "i64 %stride"])

    def _entry(self, functions: int) -> str:
        """Loop over the arms, `lanes` at a time."""
        vectors = [f"%{name}" for name in self._vectors]
        arguments = ", ".join(
            [*(f"ptr {name}.i" for name in vectors), "ptr %workspace", "i64 %stride"]
        )
        return "\n".join([
            f"define void @{ENTRY}({self._parameters}, i64 %count) {{",
            "entry:",
            "  br label %loop",
            "loop:",
            "  %i = phi i64 [ 0, %entry ], [ %next, %step ]",
            f"  %next = add i64 %i, {self.lanes}",
            "  %goes = icmp sle i64 %next, %count",
            "  br i1 %goes, label %step, label %end",
            "step:",
            *(f"  {x}.i = getelementptr {self._scalar}, ptr {x}, i64 %i" for x in vectors),
            *(f"  call void @part{k}({arguments})" for k in range(functions)),
            "  br label %loop",
            "end:",
            "  ret void",
            "}",
        ])  # fmt: skip

    @property
    def workspace(self) -> int:
        """Size of the workspace in numbers."""
        return self.slots * self.lanes

    def _function(self, index: int, chunk: Sequence[int]) -> str:
        """Function of some instructions, with what it reads and leaves behind."""
        inside, lines = set(chunk), []
        read = {x for v in chunk for x in operands(self._program.instructions[v])}
        for x in sorted(read - inside):
            lines += self._fetch(x)
        for v in chunk:
            lines += self._calculate(v, self._program.instructions[v])
            if v in self._slot:
                lines += self._keep(v)
        return self._defined(index, lines)

    def _store(self, index: int) -> str:
        """Function that writes the results, once all inputs have been read."""
        loads, stores, known = [], [], set()
        for vector, rows in self._program.results.items():
            for row, x in enumerate(rows):
                if x not in known:
                    known.add(x)
                    loads += self._fetch(x)
                place = f"%{vector}.{row}"
                stores += [
                    *self._row(place, vector, row),
                    f"  store {self._number} {self._name(x)}, ptr {place}, align {self._size}",
                ]
        return self._defined(index, loads + stores)

    def _defined(self, index: int, lines: Sequence[str]) -> str:
        head = f"define private void @part{index}({self._parameters}) noinline {{"
        return "\n".join([head, *lines, "  ret void", "}"])

    @property
    def _size(self) -> int:
        return np.dtype(self._program.number).itemsize

    def _row(self, name: str, vector: str, row: int) -> list[str]:
        """Address of a row."""
        return [
            f"  {name}.o = mul i64 %stride, {row}",
            f"  {name} = getelementptr {self._scalar}, ptr %{vector}, i64 {name}.o",
        ]

    def _fetch(self, x: int) -> list[str]:
        """A value of an earlier function, or an input."""
        kind, *where = self._program.instructions[x]
        if kind == "constant":
            return []
        if kind == "input":
            vector, row, _ = where
            place = f"%in.{vector}.{row}"
            return [
                *self._row(place, vector, row),
                f"  %v{x} = load {self._number}, ptr {place}, align {self._size}",
            ]
        place = [f"  %at{x} = {self._slot_address(x)}"]
        if not self._program.boolean[x]:
            return [*place, f"  %v{x} = load {self._number}, ptr %at{x}, align {self._size}"]
        wide = self._truth.replace("i1", "i8")
        return [
            *place,
            f"  %w{x} = load {wide}, ptr %at{x}, align 1",
            f"  %v{x} = trunc {wide} %w{x} to {self._truth}",
        ]

    def _keep(self, x: int) -> list[str]:
        place = [f"  %at{x} = {self._slot_address(x)}"]
        if not self._program.boolean[x]:
            return [*place, f"  store {self._number} %v{x}, ptr %at{x}, align {self._size}"]
        wide = self._truth.replace("i1", "i8")
        return [
            *place,
            f"  %w{x} = zext {self._truth} %v{x} to {wide}",
            f"  store {wide} %w{x}, ptr %at{x}, align 1",
        ]

    def _slot_address(self, x: int) -> str:
        offset = self._slot[x] * self.lanes
        return f"getelementptr {self._scalar}, ptr %workspace, i64 {offset}"

    def _calculate(self, v: int, instruction: Instruction) -> list[str]:
        """Text of one instruction."""
        name, *parts = instruction
        kind = self._truth if parts and self._program.boolean[parts[-1]] else self._number
        a, *more = (self._name(x) for x in parts)
        if name in _BINARY:
            return [f"  %v{v} = {_BINARY[name]} {kind} {a}, {more[0]}"]
        if name in _COMPARISONS:
            return [f"  %v{v} = fcmp {_COMPARISONS[name]} {kind} {a}, {more[0]}"]
        if name == "neg":
            return [f"  %v{v} = fneg {kind} {a}"]
        if name == "not":
            return [f"  %v{v} = xor {kind} {a}, {self._literal(True, kind)}"]
        if name == "select":
            return [f"  %v{v} = select {self._truth} {a}, {kind} {more[0]}, {kind} {more[1]}"]
        if name in ("max", "min"):
            return self._extreme(v, name, kind, a, more[0])
        function = f"@llvm.{_INTRINSICS[name]}.{self._suffix}"
        kinds = ", ".join([self._number] * len(parts))
        self._declared.add(f"declare {self._number} {function}({kinds})")
        arguments = ", ".join(f"{self._number} {self._name(x)}" for x in parts)
        return [f"  %v{v} = call {self._number} {function}({arguments})"]

    def _extreme(self, v: int, name: str, kind: str, a: str, b: str) -> list[str]:
        """Larger or smaller of two numbers; NaN if one is NaN, as in PyTorch."""
        ordered = "ogt" if name == "max" else "olt"
        return [
            f"  %c{v} = fcmp {ordered} {kind} {a}, {b}",
            f"  %s{v} = select {self._truth} %c{v}, {kind} {a}, {kind} {b}",
            f"  %n{v} = fcmp uno {kind} {a}, {a}",
            f"  %v{v} = select {self._truth} %n{v}, {kind} {a}, {kind} %s{v}",
        ]

    @property
    def _suffix(self) -> str:
        width = f"f{8 * self._size}"
        return width if self.lanes == 1 else f"v{self.lanes}{width}"

    def _name(self, x: int) -> str:
        """Text of an operand."""
        instruction = self._program.instructions[x]
        if instruction[0] != "constant":
            return f"%v{x}"
        kind = self._truth if self._program.boolean[x] else self._number
        return self._literal(self._program.value(x), kind)

    def _literal(self, value: float | bool, kind: str) -> str:
        if "i1" in kind:
            text, scalar = str(int(value)), "i1"
        else:
            # LLVM writes numbers of any size by the bits of the equal double.
            (bits,) = struct.unpack("<Q", struct.pack("<d", float(value)))
            text, scalar = f"0x{bits:016X}", self._scalar
        return text if kind == scalar else f"splat ({scalar} {text})"


def _depth_first(program: ScalarProgram) -> list[int]:
    """Needed instructions, each soon after its operands, so that few values wait."""
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
    """Numbers in a vector register of this processor."""
    from llvmlite import binding

    features = binding.get_host_cpu_features()
    width = 64 if features.get("avx512f") else 32 if features.get("avx2") else 16
    return width // dtype.itemsize


def assemble(text: str) -> bytes:
    """Object code of a module for this processor."""
    from llvmlite import binding

    machine = _machine()
    module = binding.parse_assembly(text)
    module.triple = machine.triple
    return machine.emit_object(module)


def _machine() -> Any:
    """LLVM's code generator for this processor."""
    from llvmlite import binding

    binding.initialize_native_target()
    binding.initialize_native_asmprinter()
    return binding.Target.from_default_triple().create_target_machine(
        cpu=binding.get_host_cpu_name(),
        features=binding.get_host_cpu_features().flatten(),
        opt=1,  # the program has no loops and nothing twice; level 2 takes half as long again
        reloc="pic",
        codemodel="large",  # loaded code and constants may be far apart in memory
    )


@final
class NativeStep:
    """Loaded machine code of a step, a function of the three vectors.

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
            lanes: Number of arms at once.
            workspace: Size of the workspace in numbers.
            shared: Rows of each vector in which the number of the first arm counts for all.
        """
        from llvmlite import binding

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
        """Take a step; state, observation and command have shape (rows, *batch), contiguous."""
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
        """The last arms of a batch, fewer than there are lanes."""
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


# Arms for which a thread is worth its start: a step takes about a microsecond an arm.
_ARMS_A_THREAD = 256


@cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, "control steps")
