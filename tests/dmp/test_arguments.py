"""Conversion of arguments, one function at a time."""

import math

import numpy as np
import pandas as pd
import pytest
import torch
from torch import nn
from torch.autograd import forward_ad

from hrc_learn.dmp import _arguments as arguments

pytestmark = [pytest.mark.simulation, pytest.mark.gradients]
PLAIN = torch.zeros(3, dtype=torch.float64)
WITH_GRADIENT = torch.zeros(3, dtype=torch.float64, requires_grad=True)


class Own(torch.Tensor):
    """A subclass, whose operations may be overridden."""


def under(transform, function):
    """Value of a function called under a transform."""
    seen = []

    def inner(x):
        seen.append(function(x))
        return x

    if transform == "vmap":
        torch.vmap(inner)(PLAIN)
    elif transform == "jvp":
        torch.func.jvp(inner, (PLAIN,), (PLAIN,))
    elif transform == "dual":
        with forward_ad.dual_level():
            inner(forward_ad.make_dual(PLAIN, PLAIN + 1))
    elif transform == "other dual":
        with forward_ad.dual_level():
            inner(PLAIN)
    else:
        inner(PLAIN)
    return seen[0]


@pytest.mark.parametrize(
    ("transform", "transforming", "readable"),
    [
        ("", False, True),
        ("vmap", True, False),
        ("jvp", True, False),
        ("dual", True, False),
        ("other dual", True, True),
    ],
)
def test_values_are_not_read_under_transforms(transform, transforming, readable):
    with torch.no_grad():
        assert under(transform, lambda x: arguments.transforming()) == transforming
        assert under(transform, arguments.fits_numpy) == (not transforming)
        assert under(transform, arguments.readable) == readable
        assert under(transform, lambda x: arguments.readable(PLAIN, x)) == readable


@pytest.mark.parametrize(
    ("detached", "others", "fits"),
    [
        (PLAIN, (), True),
        (nn.Parameter(PLAIN), (PLAIN,), True),
        (WITH_GRADIENT, (PLAIN, PLAIN), True),
        (PLAIN.as_subclass(Own), (), False),
        (PLAIN.to("meta"), (), False),
        (PLAIN, (PLAIN, PLAIN.float()), False),
        (PLAIN, (WITH_GRADIENT,), False),
        (PLAIN, (PLAIN.to("meta"), PLAIN), False),
        (PLAIN, (PLAIN.as_subclass(Own),), False),
        (PLAIN, (nn.Parameter(PLAIN, requires_grad=False),), False),
        (PLAIN.float(), (PLAIN.float(),), True),
    ],
)
def test_numpy_computes_with_plain_numbers_on_the_processor(detached, others, fits):
    with torch.no_grad():
        assert arguments.fits_numpy(detached, *others) == fits
    assert not arguments.fits_numpy(detached, *others)


@pytest.mark.parametrize(
    "shapes", [((2, 3),) * 3, ((2, 1), (3,)), ((), (4,), (1, 1)), ((5, 1, 2), (3, 2), ())]
)
def test_shapes_broadcast_as_in_pytorch(shapes):
    assert arguments.broadcast_shapes(*shapes) == torch.broadcast_shapes(*shapes)


def test_numbers_are_converted_without_a_copy_where_none_is_needed():
    assert arguments.to_tensor(PLAIN, torch.float64, PLAIN.device) is PLAIN
    assert arguments.to_tensor(PLAIN, torch.float32).dtype == torch.float32
    third = arguments.to_tensor([1 / 3], torch.float64)
    assert third.item() == 1 / 3
    backwards = np.arange(6.0)[::-2]
    assert arguments.to_tensor(backwards).tolist() == [5, 3, 1]
    backwards.flags.writeable = False
    assert arguments.to_tensor(backwards, torch.float32).tolist() == [5, 3, 1]
    foreign = np.array([1.5, 2.0], dtype=">f8")  # as instruments on a network write them
    assert arguments.to_tensor(foreign).tolist() == [1.5, 2.0]
    assert arguments.to_tensor(pd.Series([1, 2], index=[5, 6])).tolist() == [1, 2]
    table = arguments.to_tensor(pd.DataFrame({"a": [1.5], "b": [2.0]}), torch.float32)
    assert table.tolist() == [[1.5, 2.0]]
    assert arguments.to_tensor(np.array([True, False])).tolist() == [True, False]
    assert arguments.to_tensor([True], torch.int64).tolist() == [1]
    for wrong in ([True, False], np.zeros(2, bool)):
        with pytest.raises(ValueError, match=r"real numbers, got torch\.bool"):
            arguments.to_tensor(wrong, torch.float64)


@pytest.mark.parametrize("count", [1, 32, 33, 500])
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_one_value_that_is_not_finite_is_found_among_many(count, bad):
    values = torch.ones(count, dtype=torch.float64)
    assert arguments.finite("x", values) is values
    values[count // 2] = bad
    with pytest.raises(ValueError, match=f"x must be finite, but contains {bad}"):
        arguments.finite("x", values)
    with pytest.raises(ValueError, match="x must be finite"):
        arguments.finite("x", values[None])
    # Finite values whose sum overflows.
    large = torch.full((count + 1,), 1.5e308, dtype=torch.float64)
    assert arguments.finite("x", large) is large


@pytest.mark.parametrize(
    ("value", "positive", "not_negative"),
    [
        (1e-300, True, True),
        (0.0, False, True),
        (-1e-300, False, False),
        (math.inf, False, False),
        (math.nan, False, False),
    ],
)
def test_numbers_that_are_positive_or_not_negative(value, positive, not_negative):
    given = torch.tensor([1.0, value], dtype=torch.float64)
    if positive:
        assert arguments.positive("p", given, PLAIN) is given
    else:
        with pytest.raises(ValueError, match=f"p must be positive and finite, got {value}"):
            arguments.positive("p", given, PLAIN)
    for one in (value, given):
        if not_negative:
            arguments.check_not_negative("n", one)
        else:
            with pytest.raises(ValueError, match="n must be finite and not negative"):
                arguments.check_not_negative("n", one)
    with pytest.raises(ValueError, match="n must be finite and not negative, got True"):
        arguments.check_not_negative("n", True)
    # What another device holds is not read.
    arguments.check_not_negative("n", given.to("meta"))
    if not_negative:
        assert arguments.seconds(given, PLAIN.device) is given
    else:
        with pytest.raises(ValueError, match="non-negative seconds"):
            arguments.seconds(given, PLAIN.device)
    with pytest.raises(ValueError, match="must be an array"):
        arguments.seconds(torch.tensor(1.0), PLAIN.device)


@pytest.mark.parametrize("grids", ["equal", "different"])
@pytest.mark.parametrize("durations", ["equal", "different"])
def test_equal_grids_of_times_become_one(grids, durations):
    time = torch.linspace(0, 2, 5, dtype=torch.float64).repeat(3, 1)
    duration = torch.full((3,), 4.0, dtype=torch.float64)
    if grids == "different":
        time[1, 2] += 0.1
    if durations == "different":
        duration[2] = 5
    s = arguments.normalised_time(time, duration)
    assert s.shape == ((5,) if grids == durations == "equal" else (3, 5))
    torch.testing.assert_close(s.expand(3, 5), time / duration[:, None])
    followed = arguments.normalised_time(time.clone().requires_grad_(), duration)
    assert followed.shape == (3, 5)
    with pytest.raises(ValueError, match=r"time must be \(T,\) or \(3, 5\)"):
        arguments.normalised_time(time[:2], duration)


@pytest.mark.parametrize(
    ("dt", "durations", "count"),
    [(0.1, [1.0], 11), (0.3, [1.0], 5), (0.1, [0.3, 0.7], 8), (2.0, [1.0], 2), (1.0, [3.0], 4)],
)
def test_regular_times_reach_the_end_of_the_longest(dt, durations, count):
    time = arguments.regular_times(dt, torch.tensor(durations, dtype=torch.float64))
    np.testing.assert_allclose(time, dt * np.arange(count))
    assert time[-2] < max(durations) <= time[-1] + 1e-9


@pytest.mark.parametrize("dt", [0.0, -0.1, math.inf, math.nan])
def test_intervals_are_positive(dt):
    with pytest.raises(ValueError, match="dt must be positive"):
        arguments.regular_times(dt, PLAIN + 1)


def test_vectors_have_as_many_coordinates():
    assert arguments.checked_vector("v", [1, 2, 3], PLAIN).dtype == torch.float64
    for wrong in ([1.0, 2.0], 1.0, np.zeros((3, 2))):
        with pytest.raises(ValueError, match=r"v must have shape \(\.\.\., 3\), got"):
            arguments.checked_vector("v", wrong, PLAIN)


def test_half_precision_is_left():
    def product(x):
        return (x @ x, torch.is_autocast_enabled("cpu"))

    x = torch.full((2, 2), 1 / 3)
    exact = x @ x
    assert torch.equal(arguments.full_precision(product)(x)[0], exact)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert product(x)[0].dtype == torch.bfloat16
        found, enabled = arguments.full_precision(product)(x)
        assert torch.equal(found, exact)
        assert not enabled
        assert torch.is_autocast_enabled("cpu")
