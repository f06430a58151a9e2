"""Rules for joints that a push has taken off their path."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from hrc_learn.controller.arm_loop_state import PathState
from hrc_learn.controller.joint_path import (
    FAR_ASIDE,
    POORLY_ALIGNED,
    DirectReturn,
    JointPaths,
    changed_rate,
    deviation_ratio,
    may_not_return,
    nears_singularity,
    push_fraction,
    return_alignment,
)
from hrc_learn.controller.null_space_motion import YieldingConfig
from hrc_learn.kinematics import panda

Q = torch.tensor([0.4, 0.2, -0.3, -2.2, 0.1, 2.4, 0.6], dtype=torch.float64)


def aside(size, straight):
    """An error of that size [rad] and its null-space part, of that cosine."""
    first, *_, null = torch.from_numpy(np.linalg.svd(panda.jacobian(Q).numpy())[2])
    return size * (straight * null + np.sqrt(1 - straight**2) * first), size * straight * null


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
def test_joints_far_aside_or_poorly_aligned_may_not_return(size, straight, lost):
    error, null = aside(size, straight)
    assert bool(may_not_return(error, return_alignment(null, error))) == lost


@pytest.mark.parametrize(
    ("size", "straight", "lost"),
    [(1.45, 0.9, True), (1.0, 0.77, True), (1.35, 0.82, False), (0.01, 1.0, False)],
)
def test_a_path_that_has_waited_goes_on_once_the_joints_are_well_on_their_way(
    size, straight, lost
):
    error, null = aside(size, straight)
    assert bool(may_not_return(error, return_alignment(null, error), True)) == lost


@pytest.mark.parametrize(("straight", "fraction"), [(0.6, 0.0), (0.725, 0.5), (0.9, 1.0)])
def test_a_push_fades_where_the_joints_might_not_find_back(straight, fraction):
    error, null = aside(1.0, straight)
    alignment = return_alignment(null, error)
    assert float(push_fraction(-null, null, alignment)) == pytest.approx(fraction)
    assert float(push_fraction(null, null, alignment)) == 1.0


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


def test_a_path_waits_for_joints_as_long_as_they_come_nearer():
    """2 s without 0.05 rad of way; half as long again after time in which it went on."""
    one, dt = torch.ones((), dtype=torch.float64), 0.01
    still = PathState.none(Q, panda.forward(Q))

    def steps(offs, waited=0.0, nearest=torch.inf, rate=0.0, counts=True):
        waited, nearest = waited * one, nearest * one
        for off in offs:
            path = replace(still, waited=waited, nearest=nearest, rate=rate * one)
            waited, nearest = path.waiting(off * one, torch.tensor(counts), 2.0, dt)
        return float(waited)

    slowly, stuck = np.linspace(2.0, 1.0, 600), np.full(100, 1.5)
    assert steps(slowly) < 0.5
    assert steps(stuck) == pytest.approx(0.99)
    assert steps(np.linspace(1.5, 1.46, 100)) == pytest.approx(0.99)
    assert steps(stuck, rate=1.0, waited=1.5, nearest=1.5) == pytest.approx(0.5)
    assert steps(stuck[:50], waited=1.0, nearest=1.5, rate=-1.0) == pytest.approx(1.5)
    # Not while somebody pushes, who may push it farther: that is where it comes back from.
    assert steps(stuck, waited=1.0, counts=False) == pytest.approx(1.0)
    pushed = replace(still, waited=one, nearest=0.5 * one)
    _, nearest = pushed.waiting(2.5 * one, torch.tensor(False), 2.0, dt)
    assert steps(np.linspace(2.5, 1.0, 600), nearest=float(nearest)) < 0.5
    # A path that is gone back is gone back to where the joints are on it again.
    assert steps(slowly, waited=2.5, nearest=2.0) > 8.0


START = panda.ready
AWAY = START + torch.tensor([0.0, 0.3, 0.0, 0.3, 0.0, 0.0, 0.0], dtype=torch.float64)


def planned(samples, progress, joints, clearance):
    paths = JointPaths.of(panda, [samples.numpy()], 0.01)
    zero = torch.tensor(0)
    progress = torch.tensor(progress, dtype=torch.float64)
    config = YieldingConfig()
    return DirectReturn.planned(paths, zero, progress, joints, config, clearance)


@pytest.mark.parametrize("distance", [0.5, -0.5])
def test_a_direct_return_is_blocked_where_the_arm_would_meet_something(distance):
    def clearance(q):
        # Clear at both ends; in between as given.
        near = (q[..., None, :] - torch.stack([START, AWAY])).norm(dim=-1).amin(-1)
        return torch.where(near < 0.05, 0.5, distance)

    direct = planned(START[None], 0.0, AWAY, clearance)
    assert bool(direct.blocked) == (distance < 0)
    assert bool(direct.active) == (distance > 0)
    torch.testing.assert_close(direct.joint_position(), AWAY)
    if distance > 0:
        # A minimum-jerk motion of 0.3 rad whose peak is 0.4 rad/s.
        assert float(direct.duration) == pytest.approx(1.875 * 0.3 / 0.4)


def test_a_direct_return_leads_to_another_sample_if_the_way_is_blocked():
    joints = START + torch.tensor([0.2] + 6 * [0.0], dtype=torch.float64)
    post = (joints + AWAY) / 2

    def clearance(q):
        return (q - post).norm(dim=-1) - 0.15

    fraction = torch.linspace(0, 1, 101, dtype=torch.float64)[:, None]
    direct = planned(torch.lerp(START, AWAY, fraction), 100.0, joints, clearance)
    assert bool(direct.active)
    assert float(direct.progress) < 50
    way = torch.lerp(direct.start, direct.goal, fraction)
    assert clearance(way).min() > 0


@pytest.mark.parametrize("axis", range(6))
def test_deviations_and_speeds_count_along_each_axis_and_about_it(axis):
    """A millimetre is tolerated at rest, and 60 ms of the speed; 0.1 m are a radian."""
    unit = torch.eye(6, dtype=torch.float64)[axis] * (1.0 if axis < 3 else 10.0)
    still = torch.zeros_like(unit)
    assert deviation_ratio(0.002 * unit, still) == pytest.approx(2.0)
    assert deviation_ratio(-0.002 * unit, 0.1 * unit) == pytest.approx(2.0 / 7.0)


def test_paths_are_tabulated_with_their_slopes_and_narrow_places():
    """One that rests, one through a singularity of the shoulder, one in between."""
    dt, rest = 0.05, torch.tensor([-0.3, 0.4, 1.5, -1.9, -0.1, 2.0, -0.3], dtype=torch.float64)
    through = rest.repeat(60, 1)
    through[:, 1] = torch.linspace(0.6, -0.6, 60, dtype=torch.float64)
    lines = [rest[None].numpy(), through.numpy(), through[:25].numpy()]
    table = JointPaths.of(panda, lines, dt)
    assert table.last.tolist() == [0, 59, 24]
    for row, line in enumerate(lines):
        n, pad = len(line), 60 - len(line)
        narrow = np.linalg.svd(panda.jacobian(torch.from_numpy(line)).numpy())[1][:, -1] < 0.07
        # Within 0.2 s, four samples.
        ahead = [narrow[k : k + 5].any() for k in range(n)]
        slope = np.gradient(line, dt, axis=0) if n > 1 else np.zeros_like(line)
        for found, expected in (
            (table.position, line),
            (table.velocity, slope),
            (table.narrow, narrow),
            (table.narrow_ahead, np.array(ahead)),
        ):
            padded = np.concatenate([expected, expected[-1:].repeat(pad, 0)])
            np.testing.assert_array_equal(found[row].numpy(), padded)
    assert 0 < table.narrow[1].sum() < table.narrow_ahead[1].sum() < 60
    samples = torch.tensor([0.0, 0.25, 7.5, 23.9, 24.0, 24.5, 40.0], dtype=torch.float64)
    for row in (1, 2):
        found = table.interpolated(table.position, torch.full((7,), row), samples)
        expected = np.interp(samples.numpy(), np.arange(len(lines[row])), lines[row][:, 1])
        np.testing.assert_allclose(found[:, 1].numpy(), expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("rate", "wanted", "direction", "expected"),
    [
        (0.5, 1.0, 1, 0.6),
        (0.5, 0.0, 1, 0.4),
        (0.5, 0.55, 1, 0.55),
        (0.95, 7.0, 1, 1.0),
        (0.05, -7.0, 1, 0.0),
        (0.05, 1.0, -1, -0.05),
        (-0.95, 7.0, -1, -1.0),
        (0.3, 0.35, -1, 0.2),
    ],
)
def test_a_rate_changes_by_its_full_range_in_a_fifth_of_a_second(
    rate, wanted, direction, expected
):
    found = changed_rate(torch.tensor(rate).double(), wanted, 0.02, direction)
    assert float(found) == pytest.approx(expected)


def test_joints_right_at_the_limits_of_their_way_back_may_return():
    error = torch.zeros(7, dtype=torch.float64)
    # The limits themselves are numbers of float32.
    error[2] = FAR_ASIDE * (1 - 1e-6)
    aligned = torch.tensor(POORLY_ALIGNED * (1 + 1e-6), dtype=torch.float64)
    assert not may_not_return(error, aligned)
    assert may_not_return(error * (1 + 2e-6), aligned)
    assert may_not_return(error, aligned * (1 - 2e-6))
    # A push across the way back fades, one along it does not.
    middle = aligned + 0.075
    push = torch.eye(7, dtype=torch.float64)
    assert float(push_fraction(push[0], error, middle)) == pytest.approx(0.5, abs=1e-5)
    assert float(push_fraction(push[2], error, middle)) == 1.0


@pytest.mark.parametrize("samples", [12, 101])
def test_a_direct_return_leads_to_the_nearest_sample_with_a_clear_way(samples):
    """The one that waits comes first, then each twentieth part of the path by its distance."""
    middle = torch.lerp(START, AWAY, torch.tensor(0.62).double())
    joints = middle + torch.tensor([0.2] + 6 * [0.0], dtype=torch.float64)
    line = torch.lerp(START, AWAY, torch.linspace(0, 1, samples).double()[:, None])
    post = (joints + middle) / 2

    def clearance(q):
        return (q - post).norm(dim=-1) - 0.02

    def clear(goal):
        s = np.linspace(0, 1, 51)[:, None]
        way = clearance(torch.from_numpy(joints.numpy() + s * (goal - joints).numpy()))
        return bool((way >= min(way[0], way[-1], 0.03)).all())

    waits = 0.57 * samples
    whole = int(waits)
    here = torch.lerp(line[whole], line[whole + 1], waits - whole)
    assert not clear(here)
    candidates = list(range(0, samples, max(samples // 20, 1)))
    candidates.sort(key=lambda k: float((line[k] - joints).norm()))
    expected = next(k for k in candidates if clear(line[k]))
    assert 0 < expected != candidates[0]
    direct = planned(line, waits, joints, clearance)
    assert float(direct.progress) == expected
    torch.testing.assert_close(direct.goal, line[expected])
    assert bool(direct.active)
    assert not bool(direct.blocked)
    # Where nothing is known to be near, the sample that waits.
    assert float(planned(line, waits, joints, None).progress) == pytest.approx(waits)


def test_a_direct_return_moves_with_minimum_jerk():
    direct = planned(START[None], 0.0, AWAY, None)
    duration = 1.875 * 0.3 / 0.4
    for fraction in (0.0, 0.2, 0.5, 0.9, 1.0):
        s = 10 * fraction**3 - 15 * fraction**4 + 6 * fraction**5
        now = replace(direct, time=torch.tensor(fraction * duration, dtype=torch.float64))
        torch.testing.assert_close(now.joint_position(), AWAY + s * (START - AWAY))
    there = planned(START[None], 0.0, START, None)
    torch.testing.assert_close(there.joint_position(), START)
    none = DirectReturn.none(START)
    assert not none.active
    assert not none.blocked
    torch.testing.assert_close(none.joint_position(), START)
