"""Machine code of single operations against PyTorch's own."""

import math
import operator
import random

import numpy as np
import pytest
import sampling
import torch
from torch import Tensor, nn

from hrc_learn.deploy import UnknownOperationError, native_code
from hrc_learn.deploy.native_code import NativeCode, NativeStep, assemble, lanes_of
from hrc_learn.deploy.scalar_program import ScalarProgram, scalar_program

SPECIAL = (0.0, -0.0, 1.0, -1.0, 0.5, math.inf, -math.inf, math.nan)
ROWS = 24


def operations(x: Tensor) -> list[Tensor]:
    """Results of all kinds of operations that a step may use; x (24, *batch)."""
    a, b, c = x.unflatten(0, (3, 8))
    yes, no = a > b, ~(a >= 0.5)
    pairs = a.unflatten(0, (2, 4))  # reduced along an axis that is not the first
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
        a.logsumexp(0, keepdim=True), a.logsumexp(0)[None],
        pairs.logsumexp(1), pairs.softmax(1).flatten(0, 1), pairs.argmax(1).to(x.dtype),
        pairs.roll(1, 1).flatten(0, 1), torch.linalg.vector_norm(pairs, dim=1),
        a.cumsum(0), pairs.cumsum(1).flatten(0, 1),
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
    assert program.value(program.emit("lt", two, program.constant(3.0))) is True


def test_what_no_result_needs_is_left_out():
    program = ScalarProgram(torch.float64)
    x = program.input("observation", 0, 0)
    program.emit("exp", x)
    kept = program.emit("sin", x)
    program.results["command"] = [kept]
    assert program.needed() == [x, kept]


def defaults(x: Tensor) -> list[Tensor]:
    """Operations with what PyTorch takes where it is not told otherwise; x (24,)."""
    a, b = x[:12].reshape(2, 2, 3), x[12:].reshape(2, 2, 3)
    none = a[:0]
    return [
        y.to(x.dtype).flatten()
        for y in (
            a.sum(), a.mean(), a.amax(), (a > 0.2).any(), (a > -9).all(), a.sum((0, 2)),
            torch.linalg.vector_norm(a), torch.linalg.cross(a, b), torch.linalg.vecdot(a, b),
            none.sum(0), (none > 0).any(0), (none > 0).all(0), a.argmax(-1),
            torch.linalg.vector_norm(none, dim=0), a.amax((1, 2), keepdim=True),
            torch.nn.functional.pad(a, (1, 1), value=2.5), torch.addcmul(a, b, b),
            torch.addcdiv(a, b, b), a.gather(2, b.argmax(-1, keepdim=True)), a.to(torch.bool),
        )
    ]  # fmt: skip


def test_operations_without_options_equal_those_of_torch():
    numbers = torch.rand(ROWS, generator=sampling.generator(), dtype=torch.float64) - 0.4
    expected = torch.cat(defaults(numbers))
    vectors = (torch.zeros(1, dtype=torch.float64), numbers, torch.zeros_like(expected))

    class Defaults(nn.Module):
        def forward(self, state: Tensor, observation: Tensor, command: Tensor) -> None:
            command.copy_(torch.cat(defaults(observation)))

    program = scalar_program(
        torch.export.export(Defaults(), vectors, strict=False), torch.float64
    )
    code = NativeCode(program, ("state", "observation", "command"), 1)
    NativeStep(assemble(code.text), 1, code.workspace)(vectors)
    torch.testing.assert_close(vectors[2], expected, rtol=1e-12, atol=1e-12, equal_nan=True)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("length", [1, 5])
def test_values_wait_in_as_few_slots_as_are_in_use_at_once(monkeypatch, seed, length):
    """Of a random program, cut into functions of so many instructions."""
    monkeypatch.setattr(native_code, "_LENGTH", length)
    rng, program = random.Random(seed), ScalarProgram(torch.float64)
    values = [program.input("observation", row, 0) for row in range(4)]
    meaning = {x: operator.itemgetter(row) for row, x in enumerate(values)}
    for _ in range(24):
        name, of = rng.choice([("add", np.add), ("mul", np.multiply), ("max", np.maximum)])
        a, b = rng.sample(values, 2)
        x = program.emit(name, a, b)
        f, g = meaning[a], meaning[b]
        meaning[x] = lambda numbers, of=of, f=f, g=g: of(f(numbers), g(numbers))
        values.append(x)
    program.results["command"] = chosen = rng.sample(values[4:], 6)
    program.results["state"] = [values[-1]]
    code = NativeCode(program, ("state", "observation", "command"), 2)

    units = native_code._units(program, wide=False)
    results = [units[x] for rows in program.results.values() for x in rows]
    order = [
        x for (x,) in native_code._depth_first(native_code._reads(program, units), results)
    ]
    place = {x: k // length for k, x in enumerate(order)}
    assert sorted(order) == [x for x in program.needed() if x >= 4]
    waits = dict.fromkeys([*chosen, values[-1]], max(place.values()) + 1)
    for x in order:
        for y in program.instructions[x][1:]:
            assert y < 4 or order.index(y) < order.index(x)
            if y >= 4 and place[x] > place[y]:
                waits[y] = max(waits.get(y, 0), place[x])
    used = [
        sum(place[x] <= k <= last for x, last in waits.items())
        for k in range(max(place.values()) + 1)
    ]
    assert code.workspace == 2 * max(used)

    numbers = torch.randn(4, 2, generator=sampling.generator(), dtype=torch.float64)
    state, command = numbers.new_zeros(1, 2), numbers.new_zeros(6, 2)
    NativeStep(assemble(code.text), 2, code.workspace)([state, numbers, command])
    for row, x in zip([*command, state[0]], [*chosen, values[-1]], strict=True):
        np.testing.assert_allclose(row, meaning[x](numbers.numpy()))


@pytest.mark.parametrize(
    ("features", "width"),
    [({}, 16), ({"avx2": True}, 32), ({"avx2": True, "avx512f": True}, 64)],
)
def test_a_vector_register_holds_as_many_numbers_as_fit(monkeypatch, features, width):
    monkeypatch.setattr(native_code.binding, "get_host_cpu_features", lambda: features)
    assert lanes_of(np.dtype(np.float64)) == width / 8
    assert lanes_of(np.dtype(np.float32)) == width / 4


def test_programs_fold_and_choose():
    program = ScalarProgram(torch.float64)
    x, y = (program.input("observation", row, 0) for row in (0, 1))
    yes, no = program.constant(True), program.constant(False)
    assert program.emit("select", yes, x, y) == x
    assert program.emit("select", no, x, y) == y
    assert program.emit("select", program.emit("gt", x, y), x, x) == x
    truth = program.emit("gt", x, y)
    number = program.as_number(truth)
    assert not program.boolean[number]
    one, zero = (program.constant(v) for v in (1.0, 0.0))
    assert program.instructions[number] == ("select", truth, one, zero)
    assert program.instructions[program.as_truth(x)] == ("ne", x, zero)
    assert program.as_truth(truth) == truth
    mixed = program.emit("select", truth, truth, x)
    assert program.instructions[mixed] == ("select", truth, number, x)
    for name, value in (
        ("max", 3.0),
        ("min", 2.0),
        ("and", True),
        ("or", True),
        ("atan2", None),
    ):
        folded = program.value(program.emit(name, program.constant(2.0), program.constant(3.0)))
        assert folded == (math.atan2(2, 3) if value is None else value)
    assert program.value(program.emit("not", yes)) is False
    assert program.constant(-0.0) != zero
    assert program.constant(math.nan) == program.constant(math.nan)
