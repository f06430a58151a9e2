"""The barriers of joints and speed against the conditions that define them."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from sampling import generator, within
from scipy.optimize import brentq

from hrc_learn.controller.limit_barrier import LimitBarrier, SpeedBarrier
from hrc_learn.kinematics import arm, panda

DOUBLE = torch.float64
FIXED = replace(panda.limits, velocity_offset=None, deceleration=None)
SETTINGS = [
    {"margin": 0.02, "rate": 5.0},
    {"margin": 0.05, "rate": 2.0, "delay": 0.03, "jitter": 0.25},
    {"margin": 1e-4, "rate": 20.0},
]
DT = 0.001


def fastest(limits, joint, distance, margin, rate, delay=0.0, jitter=0.0):
    """Speed v with v_hat^2/(2 A') + (1/rate + T) v_hat = distance, v_hat = v + A^2/(2 j)."""
    A, j, v_max = (float(x[joint]) for x in (limits.acceleration, limits.jerk, limits.velocity))
    reserve, braking, time = A**2 / (2 * j), A / (1 + jitter), 1 / rate
    if limits.velocity_offset is not None:
        o = float(limits.velocity_offset[joint]) + 1e-3
        d = float(limits.deceleration[joint])
        braking, time = min(braking, d), max(time, o / d)
        margin = max(margin, (o + reserve) ** 2 / (2 * d))

    def left(v):
        v_hat = v + reserve
        return abs(distance - margin) - v_hat**2 / (2 * braking) - (time + delay) * v_hat

    if distance < margin:  # returns as fast as it may approach from inside, or rests
        return 0.0
    if left(0.0) <= 0:
        return 0.0
    return v_max if left(v_max) >= 0 else brentq(left, 0.0, v_max, xtol=1e-12)


@pytest.mark.parametrize("settings", SETTINGS)
@pytest.mark.parametrize("limits", [FIXED, arm("fr3").limits], ids=["panda", "fr3"])
def test_the_fastest_joint_can_stop_within_the_distance_that_is_left(limits, settings):
    barrier = LimitBarrier(limits, **settings)
    distances = torch.tensor([-3.0, 0.0, 0.021, 0.06, 0.12, 0.4, 1.0, 2.2], dtype=DOUBLE)
    for distance in distances:
        lower, _ = barrier.velocity_bounds(limits.lower + distance)
        _, upper = barrier.velocity_bounds(limits.upper - distance)
        expected = [fastest(limits, k, float(distance), **settings) for k in range(7)]
        np.testing.assert_allclose(upper.numpy(), expected, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(-lower.numpy(), expected, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("dt", [0.002, 0.02])
def test_the_largest_acceleration_ends_on_the_edge_of_the_set(dt):
    """v + a dt + (a + A)^2/(2 j) = bound + A^2/(2 j), and hard braking far outside."""
    barrier = LimitBarrier(FIXED, **SETTINGS[0])
    A, j = FIXED.acceleration, FIXED.jerk
    v = within(-4 * FIXED.velocity, 4 * FIXED.velocity, 30, rng=generator(2))
    bounds = -0.3 * FIXED.velocity, 0.8 * FIXED.velocity
    down, up = barrier.acceleration_bounds(v, bounds, dt)
    for a, sign, bound in ((up, 1, bounds[1]), (-down, -1, -bounds[0])):
        edge = sign * v + a * dt + (a + A) ** 2 / (2 * j) - A**2 / (2 * j)
        reaches = (A + j * dt) ** 2 + 2 * j * (bound - sign * v) >= 0
        assert reaches.any()
        torch.testing.assert_close(
            edge[reaches], bound.expand_as(v)[reaches], rtol=0, atol=1e-9
        )
        # Elsewhere as hard as the parabola reaches.
        assert torch.equal(a[~reaches], (-(A + j * dt)).expand_as(v)[~reaches])
        assert not reaches.all()


def test_rounding_is_left_out_of_the_usable_limits():
    """Velocities rounded by 2 eps v_max change the jerk by 4 roundings over dt^2."""
    barrier = LimitBarrier(FIXED, **SETTINGS[0]).float()
    eps = 2.0**-23
    for dt in (0.001, 0.01):
        A, j = (x.double() for x in barrier.usable(dt))
        unit = 2 * eps * FIXED.velocity / dt
        # Each is a fraction of the limit: float32 leaves 1e-7 of it.
        lost_A, lost_j = 1 - A / FIXED.acceleration, 1 - j / FIXED.jerk
        torch.testing.assert_close(
            lost_A, 4 * eps + 2 * unit / FIXED.acceleration, rtol=0, atol=2.5e-7
        )
        torch.testing.assert_close(
            lost_j, 4 * eps + 4 * unit / (FIXED.jerk * dt), rtol=0, atol=2.5e-7
        )
    assert all((x == 0).all() for x in barrier.usable(1e-8))


def test_reachable_velocities_are_those_of_the_nearest_acceleration():
    """Bounds of every acceleration that is asked for, from one step to the next."""
    barrier = LimitBarrier(FIXED, **SETTINGS[0])
    A, j, rng = FIXED.acceleration, FIXED.jerk, generator(4)
    q = within(FIXED.lower - 0.01, FIXED.upper + 0.01, 60, rng=rng)
    v = within(-0.4 * FIXED.velocity, 0.4 * FIXED.velocity, 60, rng=rng)
    a = within(-1.2 * A, 1.2 * A, 60, rng=rng)
    bounds = barrier.velocity_bounds(q)
    least, most = barrier.reachable_velocity(v, a, bounds, DT)
    down, up = barrier.acceleration_bounds(v, bounds, DT)
    for fraction in (-1.0, -0.5, 0.0, 0.3, 1.0):
        wanted = (fraction * A).expand_as(v)
        chosen = barrier.nearest_acceleration(wanted, a, v, bounds, DT)
        # The set first, then the limits that the arm cannot exceed, or the way back to them.
        lowest = torch.minimum(torch.maximum(a - j * DT, -A), a + j * DT)
        highest = torch.maximum(torch.minimum(a + j * DT, A), a - j * DT)
        expected = wanted.clamp(down, up).clamp(lowest, highest)
        torch.testing.assert_close(chosen, expected, rtol=1e-9, atol=1e-9)
        if abs(fraction) == 1.0:
            extreme = most if fraction > 0 else least
            torch.testing.assert_close(v + DT * chosen, extreme, rtol=1e-9, atol=1e-9)


def test_a_steady_velocity_leaves_some_roundings_to_its_limit():
    _, upper = LimitBarrier(FIXED, **SETTINGS[0]).velocity_bounds(FIXED.middle)
    left = (FIXED.velocity - upper) / (2.0**-52 * FIXED.velocity)
    assert ((left >= 2) & (left <= 5)).all()


def test_the_constants_of_the_speed_barrier():
    """kappa leaves ramps of 0.005 of the velocity limits at a cap of 1 m/s, to the square."""
    joints = LimitBarrier(FIXED, **SETTINGS[1])
    j, A = FIXED.jerk, FIXED.acceleration
    for cap in (0.3, 1.0, 4.0):
        barrier = SpeedBarrier(joints, cap)
        d = barrier.deceleration
        ramps = d**2 / (2 * j) / FIXED.velocity
        expected = torch.full_like(ramps, 0.005 * min(cap, 1.0) ** 2)
        gentle = d < A
        assert gentle.any()
        torch.testing.assert_close(ramps[gentle], expected[gentle])
        assert (ramps <= expected * (1 + 1e-9)).all()
        assert torch.equal(d[~gentle], A[~gentle])
        assert float(barrier.fade) == pytest.approx(float((d / j).max()) / 2)
        speed = torch.linspace(-1, 2, 7, dtype=DOUBLE)
        time = max(abs(float(v)) / float(x) for v, x in zip(speed, d, strict=True))
        assert float(barrier.braking_time(speed)) == pytest.approx(time + float(barrier.fade))
    # A joint near its limit brakes at most at the rate A'/c = 1/(1/rate + T).
    assert float(barrier.decay) == pytest.approx(1 / (1 / 2.0 + 0.03))
    locked = replace(FIXED, velocity=FIXED.velocity * torch.tensor([0.0] + 6 * [1.0]))
    still = SpeedBarrier(LimitBarrier(locked, **SETTINGS[0]), 1.0)
    assert float(still.deceleration[0]) == pytest.approx(1e-3 * float(A[0]))


def bound_by_loops(barrier, points, v, a, dt, delay, jitter):
    """The bound of `SpeedBarrier`, joint by joint, its peak on a grid of y."""
    n, late = len(v), (1 + jitter) * dt + delay
    d, j = barrier.deceleration.numpy(), barrier.jerk.numpy()
    T = max(abs(v) / d) + float(barrier.fade)
    rho = max(float(barrier.decay) * T, 1.0)
    excess = np.zeros(n)
    for i in range(n):
        x, along = abs(v[i]), math.copysign(1.0, v[i]) * a[i] * (v[i] != 0)
        ramp = along + x / T
        faster = ramp**2 / (2 * j[i])
        if min(along, 0.0) ** 2 > 2 * j[i] * x:  # it passes zero before the braking ends
            faster = along**2 / (2 * j[i])
        excess[i] = faster + (1 - (1 + math.log(rho)) / rho) * x
    x = abs(v) + excess
    before = x + barrier.slowing.numpy()
    growth = math.exp(sum(x * T / 2 + before * late))
    y = np.linspace(0, 1, 2001)
    highest = 0.0
    for point in points:
        column = np.linalg.norm(point, axis=0) * growth
        R = np.array([max(column[i:]) for i in range(n)])
        pairs = [(i, k) for i in range(n) for k in range(n)]
        B = sum(R[max(i, k)] * x[i] * x[k] for i, k in pairs)
        turned = sum(R[max(i, k)] * x[i] * before[k] for i, k in pairs)
        M, gamma = np.linalg.norm(point @ v) + late * turned, B * (T + float(barrier.fade)) / 2
        highest = max(highest, max(y * (M + gamma * (1 - y**2))) + R @ excess)
    return highest


@pytest.mark.parametrize(
    ("delay", "jitter", "limits", "rate"),
    [(0.0, 0.0, FIXED, 20.0), (0.02, 0.2, arm("fr3").limits, 20.0)],
)
def test_the_bound_on_speed_is_that_of_the_formula(delay, jitter, limits, rate):
    rng = generator(6)
    joints = LimitBarrier(limits, margin=0.02, rate=rate, delay=delay, jitter=jitter)
    barrier = SpeedBarrier(joints, 1.0, delay=delay, jitter=jitter)
    points = 0.4 * torch.randn(40, 2, 3, 7, generator=rng, dtype=DOUBLE)
    v = 0.3 * FIXED.velocity * torch.randn(40, 7, generator=rng, dtype=DOUBLE)
    v[:10] *= 0.05
    v[3] = 0.0
    a = 0.4 * FIXED.acceleration * torch.randn(40, 7, generator=rng, dtype=DOUBLE)
    T = barrier.braking_time(v)
    assert 0 < (barrier.decay * T > 1).double().mean() < 1
    found = barrier.highest_speed(points, v, a, DT).squeeze(-1).numpy()
    expected = [
        bound_by_loops(barrier, *(x.numpy() for x in row), DT, delay, jitter)
        for row in zip(points, v, a, strict=True)
    ]
    np.testing.assert_allclose(found, expected, rtol=1e-6)
