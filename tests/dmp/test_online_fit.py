"""Weights that follow samples, against one weighted least-squares problem written out."""

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from hrc_learn.dmp import JointDMP, OnlineFit

N, PRIOR = 12, 5.0
TIME = torch.linspace(0, 2, 200, dtype=torch.float64)


def motion(size):
    rise = TIME / 2 + torch.sin(3 * TIME) / 9
    return torch.stack([rise, size * torch.sin(2 * TIME)], dim=-1)


def samples(n=60, seed=0):
    rng = torch.Generator().manual_seed(seed)
    time = 2 * torch.rand(n, generator=rng, dtype=torch.float64)
    noise = 0.01 * torch.randn(n, 2, generator=rng, dtype=torch.float64)
    rise = time / 2 + torch.sin(3 * time) / 9
    return time, torch.stack([rise, 1.4 * torch.sin(2 * time)], dim=-1) + noise


def batch_weights(dmp, time, position, forgetting):
    """Least squares over all rows at once, in NumPy, of responses found by differences."""
    at = np.linspace(0, 1, 20 * N + 1)
    grid = torch.from_numpy(np.concatenate([time.numpy(), 2 * at]))
    w = dmp.weights.detach()
    plain = dmp.rollout(grid).position.detach().numpy()
    columns = []
    for i in range(N):
        # The motion is linear in the weights: a unit of one of them, exactly.
        one = w.clone()
        one[:, i] += 1000.0
        moved = JointDMP(
            weights=one,
            **{k: v for k, v in dmp.named_buffers() if "." not in k},
            basis=dmp.basis,
            spring=dmp.spring,
            scaling=dmp.scaling,
        )
        columns.append((moved.rollout(grid).position.detach().numpy() - plain) / 1000.0)
    n, found = len(time), []
    weight = forgetting ** ((n - 1 - np.arange(n)) / 2)
    for d in range(2):
        A = np.stack([c[:, d] for c in columns], axis=1)
        b = np.concatenate([position[:, d].numpy() - plain[:n, d], np.zeros(len(at))])
        share = np.concatenate(
            [weight, np.full(len(at), (PRIOR / len(at) * forgetting**n) ** 0.5)]
        )
        found.append(np.linalg.lstsq(share[:, None] * A, share * b, rcond=None)[0])
    return w.numpy() + np.stack(found)


@pytest.mark.parametrize("forgetting", [1.0, 0.93])
@pytest.mark.parametrize("scaling", ["none", "amplitude", "rotation"])
@pytest.mark.parametrize("at_once", [1, 7, 60])
def test_is_the_batch_fit_of_all_samples(forgetting, scaling, at_once):
    dmp = JointDMP.fit(TIME, motion(1.0), N, scaling=scaling)
    time, position = samples()
    online = OnlineFit.begin(dmp, PRIOR)
    for part in zip(time.split(at_once), position.split(at_once), strict=True):
        online = online.with_samples(*part, forgetting)
    fitted = online.primitive
    for mine, theirs in zip(
        fitted.rollout(TIME).position.T,
        reference(dmp, time, position, forgetting, scaling).T,
        strict=True,
    ):
        assert_close(mine.detach(), theirs, rtol=0, atol=1e-7)
    assert fitted.scaling == scaling
    assert_close(fitted.goal, dmp.goal)


def reference(dmp, time, position, forgetting, scaling):
    """The motion of the batch fit; weights of any scaling make the same."""
    plain = JointDMP.fit(TIME, motion(1.0), N) if scaling != "none" else dmp
    weights = torch.from_numpy(batch_weights(plain, time, position, forgetting))
    rest = plain.coordinates().detach()[:, N:]
    made = plain.with_coordinates(torch.cat([weights, rest], dim=-1))
    return made.rollout(TIME).position.detach()


def test_nothing_seen_changes_nothing_and_the_newest_counts_most():
    dmp = JointDMP.fit(TIME, motion(1.0), N)
    untouched = OnlineFit.begin(dmp).primitive
    assert_close(untouched.weights, dmp.weights, rtol=1e-12, atol=0)
    true = motion(1.4)

    def missed(online):
        return (online.primitive.rollout(TIME).position - true).square().mean().item()

    # First another motion, then the true one: the more is forgotten, the nearer to it.
    online, errors = OnlineFit.begin(dmp, 50), []
    for forgetting in (1.0, 0.99, 0.95):
        after = online.with_samples(TIME, motion(0.5), forgetting)
        errors.append(missed(after.with_samples(TIME, true, forgetting)))
    assert errors[0] > 10 * errors[1] > 10 * errors[2]


def test_a_strong_prior_keeps_the_motion():
    dmp = JointDMP.fit(TIME, motion(1.0), N)
    changes = []
    for prior in (1e-3, 10.0, 1e6):
        changed = OnlineFit.begin(dmp, prior).with_samples(*samples()).primitive
        changes.append((changed.rollout().position - dmp.rollout().position).abs().max())
    assert changes[0] > changes[1] > 100 * changes[2]
    assert changes[2] < 1e-3


def test_refuses_with_a_sentence():
    dmp = JointDMP.fit(TIME, motion(1.0), N)
    online = OnlineFit.begin(dmp)
    with pytest.raises(ValueError, match="one primitive, got a batch \\(2,\\)"):
        OnlineFit.begin(JointDMP.fit(TIME, torch.stack([motion(1.0), motion(2.0)]), N))
    with pytest.raises(ValueError, match="prior must be positive"):
        OnlineFit.begin(dmp, 0)
    with pytest.raises(ValueError, match="must be \\(n,\\) and \\(n, 2\\)"):
        online.with_samples(TIME, motion(1.0)[1:])
    with pytest.raises(ValueError, match="forgetting must be above 0"):
        online.with_samples(TIME, motion(1.0), 0.0)
    with pytest.raises(ValueError, match="at most 1"):
        online.with_samples(TIME, motion(1.0), 1.01)
    with pytest.raises(ValueError, match="position must be finite"):
        online.with_samples(TIME, motion(torch.nan))
    with pytest.raises(ValueError, match="none negative"):
        online.with_samples(-TIME, motion(1.0))
