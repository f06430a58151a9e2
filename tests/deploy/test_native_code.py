"""Machine code of single operations against PyTorch's own."""

import math

import pytest
import sampling
import torch
from torch import Tensor, nn

from hrc_learn.deploy import UnknownOperationError
from hrc_learn.deploy.native_code import NativeCode, NativeStep, assemble
from hrc_learn.deploy.scalar_program import ScalarProgram, scalar_program

SPECIAL = (0.0, -0.0, 1.0, -1.0, 0.5, math.inf, -math.inf, math.nan)
ROWS = 24


def operations(x: Tensor) -> list[Tensor]:
    """Results of all kinds of operations that a step may use; x (24, *batch)."""
    a, b, c = x.unflatten(0, (3, 8))
    yes, no = a > b, ~(a >= 0.5)
    return [
        a + b, torch.sub(a, b, alpha=2), a * b, a / b, -a, a.abs(), a.abs().sqrt(), a.trunc(),
        a.floor(), a.ceil(), a.round(), a.sin(), a.cos(), a.exp(), a.log(), a.tanh(),
        a.atan(), torch.atan2(a, b), torch.copysign(a, b), torch.maximum(a, b),
        torch.minimum(a, b), a.clamp(-0.3, 0.4), a.clamp(min=b), a.clamp(max=0.1), a.square(),
        a**2, a**3, a**4, a.abs() ** 0.5, a.abs() ** 1.3, a.reciprocal(), 2 - a, a.sign(),
        torch.addcmul(a, b, c, value=0.5), torch.addcdiv(a, b, c),
        torch.lerp(a, b, 0.3), torch.where(yes, a, b), a.masked_fill(no, 7.0),
        torch.linalg.cross(a[:3], b[3:6], dim=0),
        torch.where(torch.zeros_like(yes), a, b), torch.where(yes & ~no, yes, no).to(x.dtype),
        (yes | no).to(x.dtype), (a <= b).to(x.dtype), (a < b).to(x.dtype), (a != b).to(x.dtype),
        (~(a <= b)).to(x.dtype), (~(a < b)).to(x.dtype), (~(a > b)).to(x.dtype),
        (a == b).to(x.dtype) + yes, a.isnan().to(x.dtype), a.isfinite().to(x.dtype),
        a.sum(0, keepdim=True), a.mean(0)[None], a.amax(0)[None], a.amin(0, keepdim=True),
        yes.any(0)[None].to(x.dtype), yes.all(0)[None].to(x.dtype),
        torch.linalg.vector_norm(a, dim=0)[None], torch.linalg.vecdot(a, b, dim=0)[None],
        torch.linalg.vector_norm(a, ord=math.inf, dim=0)[None],
        a.softmax(0), a.argmax(0)[None].to(x.dtype),
        a.argmin(0, keepdim=True).to(x.dtype), a.gather(0, b.argmax(0, keepdim=True)),
        filled(a), a.flip(0), a.roll(3, 0), torch.stack([a, b], 1).reshape(16, *a.shape[1:]),
        torch.nn.functional.pad(a.movedim(0, -1), (1, 2)).movedim(-1, 0),
        a.new_zeros(2, *a.shape[1:]), torch.full_like(a, 3.0), torch.ones_like(a),
        torch.where(a.abs() < 9, 3 * a, 0.0).to(torch.int64).to(x.dtype),
    ]  # fmt: skip


def filled(x: Tensor) -> Tensor:
    """In place, through a view."""
    result = torch.zeros_like(x)
    result[2] = 5.0
    return result


class Step(nn.Module):
    def forward(self, state: Tensor, observation: Tensor, command: Tensor) -> None:
        command.copy_(torch.cat(operations(observation)))
        state.copy_(state + observation[:1])


@pytest.mark.parametrize(
    ("batch", "lanes", "dtype"),
    [((), 1, torch.float64), ((11,), 4, torch.float64), ((3, 5), 8, torch.float32)],
)
def test_operations_equal_those_of_torch(batch, lanes, dtype):
    generator = sampling.generator()
    numbers = torch.randn(ROWS, *batch, generator=generator, dtype=torch.float64).to(dtype)
    example = (torch.zeros(1, *batch, dtype=dtype), numbers)
    size = len(torch.cat(operations(numbers)))
    command = torch.zeros(size, *batch, dtype=dtype)
    part = (slice(None), slice(2), slice(1))[: 1 + len(batch)]
    few = tuple(x[part] for x in (*example, command))
    traced = torch.export.export(Step(), few, strict=False)
    program = scalar_program(traced, dtype)
    code = NativeCode(program, ("state", "observation", "command"), lanes)
    run = NativeStep(assemble(code.text), lanes, code.workspace)
    for special in (False, True):
        if special:
            which = torch.randint(len(SPECIAL), numbers.shape, generator=generator)
            numbers = torch.tensor(SPECIAL, dtype=dtype)[which]
        state = torch.ones(1, *batch, dtype=dtype)
        run([state, numbers, command])
        torch.testing.assert_close(
            command,
            torch.cat(operations(numbers)),
            rtol=1e-12 if dtype == torch.float64 else 2e-5,
            atol=1e-12 if dtype == torch.float64 else 1e-5,
            equal_nan=True,
        )
        torch.testing.assert_close(state, 1 + numbers[:1], equal_nan=True)


class One(nn.Module):
    def __init__(self, operation):
        super().__init__()
        self.operation = operation

    def forward(self, state: Tensor, observation: Tensor, command: Tensor) -> None:
        command.copy_(self.operation(observation))


@pytest.mark.parametrize(
    ("operation", "message"),
    [
        (lambda x: torch.linalg.vector_norm(x, ord=1, dim=0, keepdim=True), "norm of order 1"),
        (lambda x: torch.div(x, 2.0, rounding_mode="floor"), "div.* with rounding_mode"),
        (lambda x: x.sort(0).values, "operation aten.sort.default"),
    ],
)
def test_what_has_no_code_is_named(operation, message):
    vectors = [torch.zeros(n, dtype=torch.float64) for n in (1, ROWS, ROWS)]
    with pytest.raises(UnknownOperationError, match=message):
        scalar_program(
            torch.export.export(One(operation), tuple(vectors), strict=False), torch.float64
        )


def test_equal_instructions_are_kept_once_and_constants_carried_out():
    program = ScalarProgram(torch.float64)
    x, two = program.input("observation", 0, 0), program.constant(2.0)
    assert program.emit("mul", x, two) == program.emit("mul", x, two)
    assert program.value(program.emit("add", two, two)) == 4.0
    assert program.emit("mul", program.constant(1.0), x) == x
    assert program.emit("div", x, program.constant(1.0)) == x
    assert program.value(program.emit("lt", two, program.constant(3.0))) is True
    with pytest.raises(UnknownOperationError, match="a constant is needed"):
        program.value(x)


def test_what_no_result_needs_is_left_out():
    program = ScalarProgram(torch.float64)
    x = program.input("observation", 0, 0)
    program.emit("exp", x)
    kept = program.emit("sin", x)
    program.results["command"] = [kept]
    assert program.needed() == [x, kept]
