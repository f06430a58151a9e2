import numpy as np
import pytest
import torch
from demo_motions import arm_motion

from hrc_learn.dmp import JointDMP, select_basis_count

CANDIDATES = (5, 10, 20, 40, 80, 120)


def test_noise_free_detail_asks_for_many_basis_functions():
    time, position = arm_motion(n_samples=300)
    position = position + 0.05 * torch.sin(20 * time)[:, None]
    chosen = select_basis_count(time, position, CANDIDATES)
    assert chosen.count >= 40
    assert chosen.error[0] > 100 * chosen.error.min()


def test_noise_asks_for_few():
    """More than the motion needs only follow the noise, and miss what was held out."""
    time, position = arm_motion(n_samples=300)
    rng = torch.Generator().manual_seed(0)
    noisy = position + 0.02 * torch.randn(position.shape, generator=rng, dtype=torch.float64)
    chosen = select_basis_count(time, noisy, CANDIDATES)
    assert 10 <= chosen.count <= 40
    assert chosen.error[-1] > 1.1 * chosen.error.min()


def test_held_out_samples_are_not_fitted():
    """A spike in one sample is missed by about its height, however many basis functions."""
    time, position = arm_motion(n_samples=60, n_joints=1)
    position[30] += 1.0
    chosen = select_basis_count(time, position, (50,))
    rmse = chosen.error[0] * (position.max() - position.min())
    assert rmse > 0.5 / 60**0.5


@pytest.mark.parametrize(("given", "n_folds"), [({"n_folds": 2}, 2), ({}, 5)])
def test_errors_are_those_of_a_loop_over_folds(given, n_folds):
    """Two demonstrations; every n-th sample is held out, but for the first and the last."""
    time, position = arm_motion(n_samples=41, n_joints=2)
    rng = torch.Generator().manual_seed(3)
    noise = 0.02 * torch.randn(2, *position.shape, generator=rng, dtype=torch.float64)
    position = torch.stack([position, 3 * position]) + noise
    chosen = select_basis_count(time, position, (6, 12), **given)
    expected = []
    for count in (6, 12):
        square, held_out = 0.0, 0
        for fold in range(n_folds):
            held = np.arange(1, 42) % n_folds == fold
            held[[0, -1]] = False
            for one in position:
                fitted = JointDMP.fit(time[~held], one[~held], count)
                with torch.no_grad():
                    error = (fitted.rollout(time).position - one)[held]
                square += error.square().sum().item()
                held_out += error.numel()
        expected.append((square / held_out) ** 0.5)
    span = (position.amax(1) - position.amin(1)).max().item()
    np.testing.assert_allclose(chosen.error, np.array(expected) / span, rtol=1e-6)
    near = [n for n, e in zip((6, 12), expected, strict=True) if e <= 1.05 * min(expected)]
    assert chosen.count == near[0]


def test_masks_are_kept():
    time, position = arm_motion(n_samples=100)
    mask = torch.arange(120) < 100
    padded = torch.cat([position, torch.full((20, 7), torch.nan, dtype=torch.float64)])
    stamps = torch.cat([time, time[:20]])
    plain = select_basis_count(time, position, (10, 20))
    masked = select_basis_count(stamps, padded, (10, 20), mask=mask)
    torch.testing.assert_close(masked.error, plain.error)


def test_no_candidates_or_folds_are_refused():
    time, position = arm_motion(n_samples=30)
    with pytest.raises(ValueError, match="needs candidates"):
        select_basis_count(time, position, ())
    with pytest.raises(ValueError, match="2 folds"):
        select_basis_count(time, position, n_folds=1)


def test_eight_numbers_up_to_a_hundred_are_compared_by_default():
    chosen = select_basis_count(*arm_motion(n_samples=210, n_joints=1), n_folds=2)
    assert chosen.candidates == (10, 15, 20, 30, 40, 50, 70, 100)
    assert len(chosen.error) == 8


def test_a_motion_that_rests_needs_the_fewest():
    time = torch.linspace(0, 1, 30, dtype=torch.float64)
    chosen = select_basis_count(time, torch.ones(30, 2).double(), (5, 10))
    assert chosen.count == 5
    assert chosen.error.tolist() == pytest.approx([0.0, 0.0], abs=1e-12)
