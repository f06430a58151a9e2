import pytest
import sampling
import torch
from graphs import library_calls
from unchecked import shapes_unchecked

from hrc_learn.kinematics import panda
from hrc_learn.kinematics.chain import transform_and_jacobian

MOUNTS, TIP = panda.mounts.tolist(), (panda.flange @ panda.tcp).tolist()


def postures(*batch: int) -> torch.Tensor:
    count = int(torch.tensor(batch).prod()) if batch else 1
    lower, upper = panda.limits.lower, panda.limits.upper
    return sampling.within(lower, upper, count, rng=sampling.generator()).reshape(*batch, 7)


@pytest.mark.parametrize("batch", [(), (1,), (3, 1, 2), (100,)])
def test_it_equals_the_matrix_form(batch):
    q = postures(*batch)
    T, J = transform_and_jacobian(q, MOUNTS, TIP)
    expected_T, expected_J = panda.transform_and_jacobian(q)
    torch.testing.assert_close(T, expected_T, rtol=0, atol=1e-14)
    torch.testing.assert_close(J, expected_J, rtol=0, atol=1e-14)


def test_the_batch_is_last_in_memory():
    q = postures(5)
    T, J = transform_and_jacobian(q, MOUNTS, TIP)
    assert (T.stride(), J.stride()) == ((1, 20, 5), (1, 35, 5))


def test_the_jacobian_is_the_derivative():
    q = postures()

    def position(q: torch.Tensor) -> torch.Tensor:
        return transform_and_jacobian(q, MOUNTS, TIP)[0][:, 3]

    expected = torch.autograd.functional.jacobian(position, q)
    assert isinstance(expected, torch.Tensor)
    J = transform_and_jacobian(q, MOUNTS, TIP)[1]
    torch.testing.assert_close(J[:3], expected, rtol=0, atol=1e-14)


def test_a_traced_chain_is_written_out_and_equal():
    class Chain(torch.nn.Module):
        def forward(self, q: torch.Tensor) -> tuple[torch.Tensor, ...]:
            pose, J = panda.forward_and_jacobian(q)
            return pose.position, pose.orientation, J

    q = postures(4)
    with shapes_unchecked():
        program = torch.export.export(Chain(), (q,), strict=False)
        traced, eager = program.module()(q), Chain()(q)
    assert not library_calls(program)
    torch.testing.assert_close(traced, eager, rtol=0, atol=1e-13)
