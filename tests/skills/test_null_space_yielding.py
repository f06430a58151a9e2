"""How the null space takes in what a person asks for."""

import numpy as np
import pytest
import torch

from hrc_learn.kinematics import panda
from hrc_learn.skills.arm_motion import null_space_slowdown
from hrc_learn.skills.null_space_yielding import (
    NullSpaceYielding,
    YieldingConfig,
    eased_null_velocity,
    nears_singularity,
)

Q = torch.tensor([0.4, 0.2, -0.3, -2.2, 0.1, 2.4, 0.6], dtype=torch.float64)
FREE = -torch.full((7,), 9.0, dtype=torch.float64), torch.full((7,), 9.0, dtype=torch.float64)


def felt(asked, bounds=FREE, steps=400):
    """Null-space velocity after a while [rad/s]."""
    yielding = NullSpaceYielding(panda, 0.01, YieldingConfig())
    for _ in range(steps):
        d = yielding.feel(asked, Q, bounds)
    np.testing.assert_array_equal(d, yielding.nullspace_input)
    return yielding.null_velocity


def unit():
    return np.linalg.svd(panda.jacobian(Q).numpy())[2][6]


@pytest.mark.parametrize("torque", [1.5, 60.0])
def test_what_is_felt_is_in_the_null_space_and_no_faster_than_the_arm_follows(torque):
    wanted = torch.from_numpy(torque / 3.0 * unit())
    expected = null_space_slowdown(panda, Q, wanted) * wanted
    assert (float(expected.norm()) < 0.9 * float(wanted.norm())) == (torque > 10)
    across = panda.jacobian(Q)[0].numpy()  # moves the hand, so it is nothing to the null space
    np.testing.assert_allclose(felt(torque * unit() + 2.0 * across), expected, atol=1e-6)


def test_nothing_is_felt_beyond_the_bounds():
    k = int(np.abs(unit()).argmax())
    upper = FREE[1].clone()
    upper[k] = 0.05
    lower = -upper
    velocity = felt(6.0 * unit(), (lower, upper))
    assert abs(float(velocity[k])) == pytest.approx(0.05, rel=1e-6)
    assert float((panda.jacobian(Q) @ velocity).norm()) < 1e-9


def test_one_who_limits_it_himself_gets_it_smooth_alone():
    yielding = NullSpaceYielding(panda, 0.04, YieldingConfig(nullspace_rise=0.16))
    asked = np.array([4.0, 0.0, -4.0, 0.0, 3.0, 0.0, 0.0])
    np.testing.assert_allclose(yielding.feel(asked), asked / 4)
    np.testing.assert_allclose(yielding.feel(asked), asked * 7 / 16)
    for _ in range(30):
        d = yielding.feel(0 * asked)
    assert not d.any()
    assert not yielding.pushed


def test_arms_of_a_batch_yield_as_each_alone():
    rng = torch.Generator().manual_seed(5)
    q = Q + 0.4 * torch.randn(12, 7, generator=rng, dtype=torch.float64)
    before, wanted = 3 * torch.randn(2, 12, 7, generator=rng, dtype=torch.float64) ** 3
    J, bounds = panda.jacobian(q), (FREE[0].expand(12, 7), FREE[1].expand(12, 7))
    together = eased_null_velocity(panda, q, J, before, wanted, bounds, 0.01, YieldingConfig())
    for k in range(12):
        alone = eased_null_velocity(
            panda,
            q[k],
            J[k],
            before[k],
            wanted[k],
            (bounds[0][k], bounds[1][k]),
            0.01,
            YieldingConfig(),
        )
        for one, every in zip(alone, together, strict=True):
            torch.testing.assert_close(every[k], one, rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("smallest", "towards", "nears"),
    [(0.09, 1.0, True), (0.09, -1.0, False), (0.09, 0.0, False), (0.06, -1.0, True)],
)
def test_an_arm_nears_a_singularity_by_the_time_that_its_path_has_stopped(
    smallest, towards, nears
):
    """The second joint takes the shoulder to where its axes are in a plane."""
    postures = torch.tensor([-0.3, 0.0, 1.5, -1.9, -0.1, 2.0, -0.3], dtype=torch.float64)
    postures = postures.repeat(700, 1)
    postures[:, 1] = torch.linspace(0.1, 0.8, 700, dtype=torch.float64)
    values = np.linalg.svd(panda.jacobian(postures).numpy())[1][:, -1]
    assert (np.diff(values) > 0).all()
    q = postures[np.abs(values - smallest).argmin()]
    velocity = torch.zeros(7, dtype=torch.float64)
    velocity[1] = -towards
    assert bool(nears_singularity(panda, q, velocity)) == nears
