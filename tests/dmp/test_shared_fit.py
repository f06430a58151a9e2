from collections.abc import Sequence

import pytest
import torch
from torch.testing import assert_close

from hrc_learn.dmp import JointDMP, mean_primitive
from hrc_learn.dmp.shared_fit import LeastSquares, fit_shared
from hrc_learn.dmp.solvers import REGULARIZATION


def demonstrations(n=4, frames=150, seed=0):
    rng = torch.Generator().manual_seed(seed)
    time = torch.linspace(0, 2, frames, dtype=torch.float64)
    wave = torch.randn(n, 1, 3, generator=rng, dtype=torch.float64)
    return time, wave * torch.sin(1.7 * time)[:, None] + (wave.flip(0) * time[:, None]).cos()


@pytest.mark.parametrize("n_basis", [10, 30])
def test_demonstrations_sampled_alike_give_the_mean_of_a_primitive_each(n_basis):
    time, position = demonstrations()
    mean = mean_primitive(JointDMP.fit(time, position, n_basis))
    shared = fit_shared([(time, one) for one in position], n_basis)
    assert shared.samples == position[..., 0].numel()
    # Two orders of summation, through a system of condition 1e3.
    expected = mean.rollout(time).position
    assert_close(shared.primitive.rollout(time).position, expected, rtol=0, atol=1e-10)


def test_the_error_is_that_of_rollouts_with_ends_and_duration_of_each():
    _, position = demonstrations(3)
    stamps = [torch.linspace(0, d, 150, dtype=torch.float64) for d in (1.0, 2.0, 3.5)]
    shared = fit_shared(list(zip(stamps, position, strict=True)), 15)
    errors = [
        shared.primitive.rollout(time, one[0], one[-1], time[-1]).position - one
        for time, one in zip(stamps, position, strict=True)
    ]
    rmse = torch.cat(errors).square().mean(dim=0).sqrt()
    assert_close(shared.rmse, rmse.detach(), rtol=1e-6, atol=1e-12)


def test_demonstrations_of_any_length_and_stamps_are_read_one_by_one():
    class Read(Sequence):
        """Makes each when it is asked for, as one that reads from disk."""

        def __init__(self, which):
            self.which = which

        def __len__(self):
            return len(self.which)

        def __getitem__(self, index):
            if isinstance(index, slice):
                return Read(self.which[index])
            rng = torch.Generator().manual_seed(self.which[index])
            frames = 60 + 10 * self.which[index]
            steps = 0.5 + torch.rand(frames, generator=rng, dtype=torch.float64)
            time = steps.cumsum(0) - steps[0]
            return time, (time / time[-1])[:, None].square()

    shared = fit_shared(Read(range(5)), 12)
    assert shared.samples == 5 * 60 + 100
    assert float(shared.rmse) < 1e-3


def test_a_bad_demonstration_is_named():
    time, position = demonstrations(3)
    bad = position[1].clone()
    bad[7, 2] = torch.nan
    with pytest.raises(ValueError, match="demonstration 1: position is nan at sample 7"):
        fit_shared([(time, position[0]), (time, bad)], 10)
    with pytest.raises(ValueError, match="no demonstrations"):
        fit_shared([], 10)


def test_least_squares_in_pieces_is_that_of_all_rows():
    rng = torch.Generator().manual_seed(0)
    A = torch.randn(90, 6, generator=rng, dtype=torch.float64)
    B = torch.randn(90, 2, generator=rng, dtype=torch.float64)
    pieces = [slice(0, 4), slice(4, 50), slice(50, 90)]
    problem = LeastSquares.empty(6, 2)
    for piece in pieces:
        problem = problem.with_rows(A[piece], B[piece])
    ridge = REGULARIZATION * torch.linalg.svdvals(A)[0]
    eye = ridge * torch.eye(6, dtype=torch.float64)
    zeros = torch.zeros(6, 2, dtype=torch.float64)
    expected = torch.linalg.lstsq(torch.cat([A, eye]), torch.cat([B, zeros])).solution
    X = problem.solve(torch.ones(6, dtype=torch.float64))
    assert_close(X, expected, rtol=1e-10, atol=1e-12)
    rms = (A @ X - B).square().mean(dim=0).sqrt()
    assert_close(problem.residual(X), rms, rtol=1e-10, atol=1e-12)
