"""Null-space motions that leave the end effector in place and the arm clear."""

import math

import numpy as np
import pytest
import torch

from hrc_learn.controller.null_space_motion import (
    YieldingConfig,
    eased_null_velocity,
    fraction_in_null_space,
    fraction_kept,
    guided_elbow_speed,
    kept_clear,
    limiting_joint,
    null_space_giving_way,
    null_space_slowdown,
    singularity_fade,
)
from hrc_learn.geometry.numerics import null_projection
from hrc_learn.kinematics import panda

Q = torch.tensor([0.4, 0.2, -0.3, -2.2, 0.1, 2.4, 0.6], dtype=torch.float64)
FREE = -torch.full((7,), 9.0, dtype=torch.float64), torch.full((7,), 9.0, dtype=torch.float64)


def random_configurations(n, seed):
    rng = torch.Generator().manual_seed(seed)
    lower, upper = panda.limits.lower, panda.limits.upper
    return lower + (upper - lower) * torch.rand(n, 7, generator=rng, dtype=torch.float64)


def regular_configurations(n, seed):
    q = random_configurations(8 * n, seed)
    return q[torch.linalg.svdvals(panda.jacobian(q))[:, -1] > 0.1][:n]


def self_motion(q, speed):
    """Unit vector of the null space, times a speed."""
    unit = np.linalg.svd(panda.jacobian(q).numpy())[2][6]
    return speed * torch.from_numpy(unit)


def test_the_slowdown_is_that_of_the_bending_of_the_null_space():
    bent = dict.fromkeys(("hand", "elbow", "joint speed", "nothing"), 0)
    for q, speed in zip(regular_configurations(60, seed=8), 20 * [0.3, 1.0, 3.0], strict=True):
        null = self_motion(q, speed)
        allowed = {"nothing": 1.0}
        for here in (q, q + 0.15 * null):
            # The change of the Jacobian along the motion, by automatic differentiation.
            _, change = torch.func.jvp(panda.jacobian, (here,), (null,))
            bending = change @ null
            scale = torch.tensor([1.0, 1.0, 1.0, 0.1, 0.1, 0.1], dtype=torch.float64)
            hand = (0.2 / float((scale * bending).norm())) ** 0.5
            allowed["hand"] = min(allowed.get("hand", 1.0), hand)
        _, moved = torch.func.jvp(panda.joint_origins, (q,), (null,))
        allowed["elbow"] = 0.25 / float(moved.norm(dim=-1).max())
        allowed["joint speed"] = 1.0 / float(null.abs().max())
        least = min(allowed, key=allowed.__getitem__)
        bent[least] += 1
        assert null_space_slowdown(panda, q, null, 0.25) == pytest.approx(
            allowed[least], rel=2e-3
        )
    assert min(bent.values()) > 0, bent


def test_nobody_moves_an_arm_into_a_singularity_but_out_of_one():
    q = regular_configurations(40, seed=5)
    faded = 0
    for joints in q:
        for speed in (-2.0, 2.0):
            null = self_motion(joints, speed)
            way = joints + torch.linspace(0, 0.3, 6, dtype=torch.float64)[:, None] * null
            now, *ahead = torch.linalg.svdvals(panda.jacobian(way))[:, -1]
            later = min(ahead)
            fraction = singularity_fade(panda, joints, null)
            if later > now or later > 0.08:
                assert fraction == 1.0
            else:
                faded += 1
                assert fraction == pytest.approx(max(float(later) - 0.05, 0.0) / 0.03)
    assert faded > 2


def test_the_null_space_gives_way_by_as_little_as_lets_the_task_go_on():
    rng = np.random.default_rng(2)
    given, compromises = 0, 0
    for q in regular_configurations(250, seed=3):
        J = panda.jacobian(q)
        task = torch.from_numpy(rng.normal(0, 0.3, 7))
        null = self_motion(q, float(rng.normal(0, 0.5)))
        lower, upper = (
            -torch.from_numpy(rng.uniform(0, 1, 7)),
            torch.from_numpy(rng.uniform(0, 1, 7)),
        )
        result = null_space_giving_way(J, task, null, lower, upper)
        assert float((J @ result).norm()) < 1e-9
        # Every null-space velocity there is, on a grid.
        unit = self_motion(q, 1.0)
        grid = torch.linspace(-6, 6, 24001, dtype=torch.float64)
        velocities = task + grid[:, None] * unit
        excess = torch.maximum(velocities - upper, lower - velocities).amax(-1)
        mine = float(torch.maximum(task + result - upper, lower - task - result).max())
        if bool((excess <= 0).any()):
            wanted = null @ unit
            nearest = grid[excess <= 0][(grid[excess <= 0] - wanted).abs().argmin()]
            assert float(result @ unit) == pytest.approx(float(nearest), abs=6e-4)
            assert mine < 1e-9
            given += abs(float(nearest - wanted)) > 1e-3
        elif not torch.equal(result, null):
            before = float(torch.maximum(task + null - upper, lower - task - null).max())
            compromises += mine <= before + 1e-9
    assert given > 5
    assert compromises > 5


def test_bounds_that_exclude_each_other_are_exceeded_alike():
    """Joints 1 and 2 move against each other in the null space, and both have to give way."""
    J = torch.eye(7, dtype=torch.float64)[1:]
    J[0, 0] = 1.0  # the null space is along (1, -1, 0, ...)
    task = torch.tensor([1.0, 0.6, 0, 0, 0, 0, 0], dtype=torch.float64)
    upper = torch.full((7,), 0.5, dtype=torch.float64)
    result = null_space_giving_way(J, task, torch.zeros_like(task), -upper, upper)
    torch.testing.assert_close(task + result, task.new_tensor([0.8, 0.8, 0, 0, 0, 0, 0]))


def test_joints_that_the_null_space_hardly_moves_do_not_count():
    """Joint 3 exceeds its limit, too, but the null space moves it by a billionth."""
    J = torch.eye(7, dtype=torch.float64)[1:]
    J[0, 0], J[1, 0] = 1.0, 1e-9  # the null space is along (1, -1, -1e-9, 0, ...)
    task = torch.tensor([0.6, 0, 0.51, 0, 0, 0, 0], dtype=torch.float64)
    upper = torch.full((7,), 0.5, dtype=torch.float64)
    result = null_space_giving_way(J, task, torch.zeros_like(task), -upper, upper)
    torch.testing.assert_close(task + result, task.new_tensor([0.5, 0.1, 0.51, 0, 0, 0, 0]))


def test_an_arm_slides_along_what_is_around_it_and_stops_before_it():
    q, task = panda.ready, torch.zeros(7, dtype=torch.float64)
    null = self_motion(q, 0.5)
    along = null / null.norm()

    def wall(at):
        return lambda joints: at - (joints - q) @ along

    def kept(at):
        part, blocked, distance = kept_clear(q, task, null, wall(at), margin=0.03)
        assert not blocked
        assert distance == pytest.approx(at)
        return float(part @ along)

    assert kept(1.0) == pytest.approx(0.5)
    # At the margin 2 mm/s, 5 mm within it nothing; continuous in between and beyond.
    assert kept(0.03) == pytest.approx(0.002, rel=1e-3)
    assert kept(0.0275) == pytest.approx(0.001, rel=1e-3)
    assert kept(0.025) == pytest.approx(0.0, abs=1e-9)
    assert kept(0.03 + 0.15 * 0.1) == pytest.approx(0.102, rel=1e-3)

    # What is met half-way and left behind again ends the way there.
    def post(joints):
        return 0.031 - 0.02 * torch.exp(-((((joints - q) @ along) / 0.03 - 1) ** 2) / 0.05)

    half_way = float(kept_clear(q, task, null, post, margin=0.03)[0] @ along)
    # 20 mm nearer where 1.3 mm are allowed, at 0.4 of the way.
    assert half_way == pytest.approx(0.5 * 0.4 * 1.3 / 20, rel=0.02)
    # Away from the wall, or along it, it is free.
    assert float(kept_clear(q, task, -null, wall(0.0), 0.03)[0] @ along) == pytest.approx(-0.5)
    aside = kept_clear(q, task, null, lambda joints: 0.02 + 0 * joints[..., 0], 0.03)[0]
    torch.testing.assert_close(aside, null)


def test_arms_of_a_batch_give_way_and_keep_clear_as_each_alone():
    rng, q = torch.Generator().manual_seed(6), regular_configurations(30, seed=6)
    J, bound = panda.jacobian(q), torch.full((30, 7), 0.4, dtype=torch.float64)
    task, null = 0.3 * torch.randn(2, 30, 7, generator=rng, dtype=torch.float64)
    null = null_projection(J, null)

    def clearance(joints):
        return 0.05 + 0.1 * torch.sin(5 * joints).amin(-1)

    gives = null_space_giving_way(J, task, null, -bound, bound)
    kept, blocked, now = kept_clear(q, task, null, clearance, 0.03)
    torch.testing.assert_close(now, clearance(q))
    assert (gives != null).any()
    assert 0 < blocked.sum() < 30
    for k in range(30):
        alone = null_space_giving_way(J[k], task[k], null[k], -bound[k], bound[k])
        torch.testing.assert_close(gives[k], alone)
        part, waiting, _ = kept_clear(q[k], task[k], null[k], clearance, 0.03)
        torch.testing.assert_close(kept[k], part)
        assert blocked[k] == waiting


def eased(requested, bounds=FREE, steps=300):
    """Null-space velocity after a constant request [rad/s]."""
    velocity, J = torch.zeros(7, dtype=torch.float64), panda.jacobian(Q)
    for _ in range(steps):
        velocity = eased_null_velocity(
            panda, Q, J, velocity, requested, bounds, 0.01, YieldingConfig()
        ).velocity
    return velocity


@pytest.mark.parametrize("speed", [0.5, 20.0])
def test_a_request_is_followed_in_the_null_space_no_faster_than_the_arm_can(speed):
    wanted = self_motion(Q, speed)
    expected = null_space_slowdown(panda, Q, wanted, 0.25) * wanted
    assert (float(expected.norm()) < 0.9 * speed) == (speed > 3)
    across = panda.jacobian(Q)[0]  # moves the end effector: nothing in the null space
    torch.testing.assert_close(eased(wanted + across), expected, rtol=0, atol=1e-6)


def test_a_request_is_followed_within_the_bounds():
    k = int(self_motion(Q, 1.0).abs().argmax())
    upper = FREE[1].clone()
    upper[k] = 0.05
    velocity = eased(self_motion(Q, 2.0), (-upper, upper))
    assert abs(float(velocity[k])) == pytest.approx(0.05, rel=1e-6)
    assert float((panda.jacobian(Q) @ velocity).norm()) < 1e-9


@pytest.mark.parametrize(("before", "wanted"), [(0.0, 0.02), (0.02, 0.0), (-0.05, 0.1)])
def test_a_push_rises_smoothly_and_ends_at_once(before, wanted):
    """A first-order lag of 0.15 s on the way up; both within the acceleration of the arm."""
    unit, J = self_motion(Q, 1.0), panda.jacobian(Q)
    dt, config = 0.01, YieldingConfig()
    found = eased_null_velocity(
        panda, Q, J, before * unit, wanted * unit, FREE, dt, config
    ).velocity
    slows = abs(wanted) < abs(before)
    change = (wanted - before) * (1.0 if slows else dt / 0.15)
    reach = (0.6 if slows else 0.3) * dt * panda.limits.acceleration
    expected = (before + change * min(1.0, float((reach / (change * unit).abs()).min()))) * unit
    torch.testing.assert_close(found, expected)


@pytest.mark.parametrize("slowly", [False, True])
def test_accelerations_of_a_push_leave_the_task_what_it_needs(slowly):
    unit, J, dt = self_motion(Q, 1.0), panda.jacobian(Q), 0.01
    before, wanted = (0.4, 0.0) if slowly else (0.0, 2.0)
    arguments = panda, Q, J, before * unit, wanted * unit, FREE, dt, YieldingConfig()
    eased = eased_null_velocity(*arguments)
    a = (eased.velocity - before * unit).abs() / dt / panda.limits.acceleration
    assert float(a.max()) == pytest.approx(0.6 if slowly else 0.3)


def test_fractions_of_a_velocity_count_along_its_direction():
    v = torch.tensor([[3.0, 4.0], [0.0, 0.0], [1.0, 0.0]], dtype=torch.float64)
    after = torch.tensor([[1.5, 2.0], [1.0, 0.0], [-1.0, 5.0]], dtype=torch.float64)
    torch.testing.assert_close(fraction_kept(v, after), v.new_tensor([0.5, 1.0, 0.0]))
    # Slow motions count as fast ones do, down to the rest.
    slow = 3e-7 * v
    torch.testing.assert_close(fraction_kept(slow, slow / 2)[:2], v.new_tensor([0.5, 1.0]))
    assert fraction_kept(slow[0], 0 * slow[0], rest=2e-6) == 1.0


def test_a_push_with_a_tenth_in_the_null_space_counts_as_one():
    push = torch.tensor([[1.0, 0.0], [1.0, 0.0], [0.0, 0.0]], dtype=torch.float64)
    angle = torch.tensor([0.2, 0.05, 0.0], dtype=torch.float64)
    unit = torch.stack([angle, (1 - angle**2).sqrt()], dim=-1)
    projected = (push * unit).sum(-1, keepdim=True) * unit
    expected = push.new_tensor([1.0, 0.05, 1.0])
    torch.testing.assert_close(fraction_in_null_space(push, projected), expected)


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


def test_the_limiting_joint_is_the_first_to_reach_its_bound():
    rng = np.random.default_rng(0)
    for _ in range(20):
        v, upper, lower = rng.normal(size=7), rng.uniform(0, 1, 7), -rng.uniform(0, 1, 7)
        # By scaling up until a joint is out of its bounds.
        scale = next(
            s for s in np.linspace(0, 5, 20_001) if ((s * v > upper) | (s * v < lower)).any()
        )
        expected = int(np.argmax(np.maximum(scale * v - upper, lower - scale * v)))
        found = limiting_joint(*map(torch.from_numpy, (v, lower, upper)))
        assert found == expected


def test_guided_elbow_leaves_room_below_a_cap_on_speed():
    assert guided_elbow_speed(0.25) == pytest.approx(0.15)
    assert guided_elbow_speed(1.0) == guided_elbow_speed(math.inf) == 0.25
    still, J = torch.zeros_like(Q), panda.jacobian(Q)
    wanted = 5 * null_projection(J, torch.ones_like(Q))
    bounds = -torch.full_like(Q, 9.0), torch.full_like(Q, 9.0)
    for speed in (0.25, 0.15):
        config = YieldingConfig(elbow_speed=speed)
        v = eased_null_velocity(panda, Q, J, still, wanted, bounds, 0.01, config).unbounded
        points, _ = panda.chain.joint_origins_and_jacobian(torch.stack([Q, Q + 1e-6 * v]))
        fastest = (points[1] - points[0]).norm(dim=-1).max() / 1e-6
        assert fastest <= 1.001 * speed
