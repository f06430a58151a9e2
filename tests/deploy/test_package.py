import numpy as np
import pytest
import torch
from torch import Tensor

from hrc_learn.deploy.package import IOLayout
from hrc_learn.pytree import pytree

DOUBLE = torch.float64


@pytree
class Reading:
    """Of every kind that a step has."""

    angles: Tensor
    matrix: Tensor
    seen: Tensor
    count: Tensor
    gain: Tensor
    """One for the whole batch."""
    dt: float = 0.1
    nothing: Tensor | None = None


def reading(*batch: int) -> Reading:
    size = int(np.prod(batch, dtype=int))
    numbers = torch.arange(size * 7, dtype=DOUBLE)
    return Reading(
        angles=numbers.reshape(*batch, 7),
        matrix=-numbers[: size * 6].reshape(*batch, 2, 3),
        seen=(numbers[:size] % 2 == 0).reshape(batch),
        count=torch.arange(size).reshape(batch) + 2**40,
        gain=torch.tensor([0.5, 0.25, 0.125], dtype=DOUBLE),
    )


def tensors(value: Reading) -> list[Tensor]:
    return [value.angles, value.matrix, value.seen, value.count, value.gain]


@pytest.mark.parametrize("batch", [(), (1,), (5,), (4, 2)])
def test_what_is_packed_comes_back(batch):
    value = reading(*batch)
    layout = IOLayout.of(value, batch)
    vector = layout.pack(tensors(value))
    assert vector.shape == (7 + 6 + 1 + 1 + 3, *batch)
    assert list(layout.rows) == ["angles", "matrix", "seen", "count", "gain"]
    for before, after in zip(tensors(value), layout.unpack(vector), strict=True):
        assert after.dtype == before.dtype
        assert torch.equal(after, before)


def test_a_row_is_one_quantity_of_the_whole_batch():
    value = reading(5)
    layout = IOLayout.of(value, (5,))
    vector = layout.pack(tensors(value))
    assert torch.equal(vector[layout.rows["angles"]][3], value.angles[:, 3])
    assert torch.equal(vector[layout.rows["matrix"]][4], value.matrix[:, 1, 1])


@pytest.mark.parametrize("batch", [(), (5,)])
def test_arrays_are_views_by_name(batch):
    layout = IOLayout.of(reading(*batch), batch)
    vector = layout.empty()
    arrays = layout.arrays(vector)
    assert np.isnan(arrays["angles"]).all()
    assert not arrays["seen"].any()
    arrays["matrix"][...] = np.arange(6).reshape(2, 3)
    arrays["seen"][...] = True
    arrays["gain"][...] = (1, 2, 3)
    _, matrix, seen, _, gain = layout.unpack(vector)
    assert torch.equal(
        matrix, torch.arange(6.0, dtype=DOUBLE).reshape(2, 3).expand(*batch, 2, 3)
    )
    assert seen.all()
    assert gain.tolist() == [1, 2, 3]
