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
    waited_for,
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


def aside(size, straight):
    """From `Q` to a path: as far, and with that cosine to where the null space leads."""
    first = np.linalg.svd(panda.jacobian(Q).numpy())[2][0]
    return torch.from_numpy(size * (straight * unit() + np.sqrt(1 - straight**2) * first))


def yielding_at(*ways, after_push="return", pushed=False):
    """After steps with joints aside by each of the ways."""
    yielding = NullSpaceYielding(panda, 0.01, YieldingConfig(after_push=after_push))
    yielding.begin(ways[0])
    if pushed:
        yielding.nullspace_input = -unit()
    for way in ways:
        yielding.way_back(Q, way)
    return yielding


@pytest.mark.parametrize(
    ("size", "straight", "lost"),
    [
        (1.7, 0.9, False),
        (1.9, 0.9, True),
        (1.0, 0.7, False),
        (1.0, 0.6, True),
        # So near they do find back; in between there is no jump.
        (0.29, 0.1, False),
        (0.36, 0.6, False),
        (0.45, 0.5, True),
    ],
)
def test_joints_are_lost_far_aside_and_where_the_null_space_leads_elsewhere(
    size, straight, lost
):
    assert yielding_at(aside(size, straight)).lost == lost
    assert yielding_at(aside(size, straight), pushed=True).lost == lost
    # Whoever stays beside the path need not find back.
    stays = yielding_at(aside(size, straight), after_push="stay")
    assert not stays.lost
    assert stays.push_share == 1.0


@pytest.mark.parametrize("lost", [aside(1.9, 0.9), aside(1.0, 0.6)])
def test_joints_that_were_lost_are_until_they_are_well_on_their_way(lost):
    assert yielding_at(lost, aside(1.45, 0.9)).lost
    assert yielding_at(lost, aside(1.0, 0.77)).lost
    assert not yielding_at(lost, aside(1.35, 0.82)).lost
    assert not yielding_at(lost, aside(1.35, 0.82), aside(1.7, 0.7)).lost
    # Back on the path, or beside it while they are held there, they are not.
    assert not yielding_at(lost, aside(0.01, 1.0), aside(1.7, 0.7)).lost
    assert not yielding_at(lost, aside(1.7, 0.7), pushed=True).lost


def test_a_path_waits_for_joints_as_long_as_they_come_nearer():
    """2 s without 0.05 rad of way; half as long again after time in which it went on."""
    one, dt = torch.ones((), dtype=torch.float64), 0.01

    def steps(offs, waited=0.0, nearest=torch.inf, rate=0.0, counts=True):
        waited, nearest = waited * one, nearest * one
        for off in offs:
            waited, nearest = waited_for(
                waited, nearest, off * one, rate * one, torch.tensor(counts), dt
            )
        return float(waited)

    slowly, stuck = np.linspace(2.0, 1.0, 600), np.full(100, 1.5)
    assert steps(slowly) < 0.5
    assert steps(stuck) == pytest.approx(0.99)
    assert steps(np.linspace(1.5, 1.46, 100)) == pytest.approx(0.99)
    assert steps(stuck, rate=1.0, waited=1.5, nearest=1.5) == pytest.approx(0.5)
    assert steps(stuck[:50], waited=1.0, nearest=1.5, rate=-1.0) == pytest.approx(1.5)
    # Not while somebody pushes, who may push it farther: that is where it comes back from.
    assert steps(stuck, waited=1.0, counts=False) == pytest.approx(1.0)
    _, nearest = waited_for(one, 0.5 * one, 2.5 * one, one, torch.tensor(False), dt)
    assert steps(np.linspace(2.5, 1.0, 600), nearest=float(nearest)) < 0.5
    # A path that is gone back is gone back to where the joints are on it again.
    assert steps(slowly, waited=2.5, nearest=2.0) > 8.0
