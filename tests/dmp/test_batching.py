"""Batches of primitives that are put together, against one fit of all of them."""

import pytest
import torch
from demo_motions import arm_motion

from hrc_learn.dmp import JointDMP
from hrc_learn.dmp.motion_primitive import concatenate


def primitives(seeds, frames, n_basis=12):
    time, _ = arm_motion(frames, 3)
    position = torch.stack([arm_motion(frames, 3, seed=seed)[1] for seed in seeds])
    return JointDMP.fit(time, position, n_basis)


def test_batches_sampled_differently_are_one_behind_the_other():
    first, second = primitives([0, 1, 2], 80), primitives([3], 120)
    joined = concatenate(iter([first, second]), 200)
    assert joined.weights.shape == (4, 3, 12)
    for name in ("weights", "start", "goal", "start_velocity", "duration", "amplitude"):
        expected = torch.cat([getattr(first, name), getattr(second, name)])
        torch.testing.assert_close(getattr(joined, name), expected, rtol=0, atol=0)
    assert joined.fit_report is not None
    assert joined.fit_report.nrmse.shape[0] == 4
    times = torch.linspace(0, float(second.duration[0]), 200, dtype=torch.float64)
    torch.testing.assert_close(joined.rollout().position[3], second.rollout(times).position[0])
    with torch.no_grad():
        joined.weights.zero_()
    assert (first.weights != 0).any()


def test_a_report_that_one_batch_lacks_is_none_of_all():
    reported = primitives([0], 80)
    bare = reported.with_coordinates(reported.coordinates().detach())
    assert concatenate([reported, bare], 80).fit_report is None


def test_batches_that_differ_or_are_none_are_refused():
    with pytest.raises(ValueError, match="no primitives to concatenate"):
        concatenate([], 10)
    with pytest.raises(ValueError, match="of batch 1 is"):
        concatenate([primitives([0], 80), primitives([1], 80, n_basis=13)], 10)
