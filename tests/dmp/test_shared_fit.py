from collections.abc import Sequence

import pytest
import torch
from torch.testing import assert_close

from hrc_learn.dmp import JointDMP, mean_primitive
from hrc_learn.dmp.joint_dmp import fit_shared


def demonstrations(n=4, frames=150, seed=0):
    rng = torch.Generator().manual_seed(seed)
    time = torch.linspace(0, 2, frames, dtype=torch.float64)
    wave = torch.randn(n, 1, 3, generator=rng, dtype=torch.float64)
    return time, wave * torch.sin(1.7 * time)[:, None] + (wave.flip(0) * time[:, None]).cos()


@pytest.mark.parametrize("n_basis", [10, 30])
def test_demonstrations_sampled_alike_give_the_mean_of_a_primitive_each(n_basis):
    time, position = demonstrations()
    mean = mean_primitive(JointDMP.fit(time, position, n_basis))
    shared, _ = fit_shared([(time, one) for one in position], n_basis)
    # Two orders of summation, through a system of condition 1e3.
    expected = mean.rollout(time).position
    assert_close(shared.rollout(time).position, expected, rtol=0, atol=1e-10)


def test_the_error_is_that_of_rollouts_with_ends_and_duration_of_each():
    _, position = demonstrations(3)
    stamps = [torch.linspace(0, d, 150, dtype=torch.float64) for d in (1.0, 2.0, 3.5)]
    shared, found = fit_shared(list(zip(stamps, position, strict=True)), 15)
    errors = [
        shared.rollout(time, one[0], one[-1], time[-1]).position - one
        for time, one in zip(stamps, position, strict=True)
    ]
    rmse = torch.cat(errors).square().mean(dim=0).sqrt()
    assert_close(found, rmse.detach(), rtol=1e-6, atol=1e-12)


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

    _, rmse = fit_shared(Read(range(5)), 12)
    assert float(rmse) < 1e-3


def test_a_bad_demonstration_is_named():
    time, position = demonstrations(3)
    bad = position[1].clone()
    bad[7, 2] = torch.nan
    with pytest.raises(ValueError, match="demonstration 1: position is nan at sample 7"):
        fit_shared([(time, position[0]), (time, bad)], 10)
    with pytest.raises(ValueError, match="no demonstrations"):
        fit_shared([], 10)


def test_fewer_samples_than_functions_are_followed_all_the_same():
    time, position = demonstrations(1, frames=20)
    shared, rmse = fit_shared([(time, position[0])], 40)
    assert rmse.max() < 1e-4
    assert shared.weights.isfinite().all()
