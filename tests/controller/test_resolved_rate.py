import numpy as np
import pytest
import sampling
import torch
from projections import null_space_projector
from scipy.optimize import lsq_linear

from hrc_learn.controller.resolved_rate import (
    excess_speed,
    resolved_rate,
    saturate_in_null_space,
    scale_null_space,
    scale_task,
)
from hrc_learn.kinematics import panda
from hrc_learn.kinematics.inverse import SINGULAR_BELOW


def random(*shape: int, rng: torch.Generator) -> torch.Tensor:
    return torch.randn(*shape, generator=rng, dtype=torch.float64)


def regular_jacobians(count: int, rng: torch.Generator) -> torch.Tensor:
    q = sampling.within(panda.limits.lower, panda.limits.upper, count, rng=rng)
    J = panda.jacobian(q)
    return J[torch.linalg.svdvals(J)[:, -1] > 0.1]


def test_equals_pseudo_inverse_and_projector():
    rng = sampling.generator()
    J = regular_jacobians(300, rng)
    twist, wish = random(len(J), 6, rng=rng), random(len(J), 7, rng=rng)
    task, null = resolved_rate(J, twist, wish)
    torch.testing.assert_close(
        task, (torch.linalg.pinv(J) @ twist[..., None])[..., 0], rtol=0, atol=1e-11
    )
    torch.testing.assert_close(
        null, (null_space_projector(J) @ wish[..., None])[..., 0], rtol=0, atol=1e-11
    )


def test_the_null_space_does_not_move_the_tool():
    """J N = 0, N J^+ = 0, N N = N to 1e-12."""
    rng = sampling.generator(1)
    J = regular_jacobians(300, rng)
    zero = torch.zeros(len(J), 6, dtype=torch.float64)
    twist, wish = random(len(J), 6, rng=rng), random(len(J), 7, rng=rng)
    task, null = resolved_rate(J, twist, wish)
    assert (J @ null[..., None]).abs().max() < 1e-12
    assert ((J @ task[..., None])[..., 0] - twist).abs().max() < 1e-12
    assert resolved_rate(J, zero, task)[1].abs().max() < 1e-12
    assert (resolved_rate(J, zero, null)[1] - null).abs().max() < 1e-12


def test_nor_does_it_where_the_task_is_damped():
    """Anywhere within the limits, stretched out (rank 5), and next to that."""
    rng = sampling.generator(5)
    anywhere = sampling.within(panda.limits.lower, panda.limits.upper, 2000, rng=rng)
    singular = torch.zeros(2, 7, dtype=torch.float64)
    singular[1, 1] = 0.7
    near = singular.repeat(100, 1) + 1e-3 * random(200, 7, rng=rng) ** 3
    J = panda.jacobian(torch.cat([anywhere, singular, near]))
    smallest = torch.linalg.svdvals(J)[:, -1]
    assert (smallest < 0.05).sum() > 500
    assert (smallest < 1e-9).any()
    wish = random(len(J), 7, rng=rng)
    _, null = resolved_rate(J, torch.zeros(len(J), 6, dtype=torch.float64), wish)
    moved = (J @ null[..., None])[..., 0].norm(dim=-1)
    assert (moved <= 1e-12 * wish.norm(dim=-1)).all()
    assert null.norm(dim=-1).median() > 0.3


def test_damping_is_zero_away_from_singularities_and_bounds_the_gain_at_them():
    rng = sampling.generator(2)
    U, V = torch.linalg.qr(random(6, 6, rng=rng))[0], torch.linalg.qr(random(7, 7, rng=rng))[0]
    gains = {}
    for smallest in (0.2, 0.09, 0.03, 0.01, 1e-4, 0.0):
        sigma = torch.tensor([2.0, 1.5, 1.2, 1.0, 0.8, smallest], dtype=torch.float64)
        J = U @ torch.diag(sigma) @ V[:, :6].mT
        task, _ = resolved_rate(J, U[:, 5], torch.zeros(7, dtype=torch.float64))
        gains[smallest] = task.norm().item()
    # Exact inverse where J is regular ...
    assert gains[0.2] == pytest.approx(1 / 0.2, rel=1e-10)
    assert gains[0.09] == pytest.approx(1 / 0.09, rel=1e-10)
    # ... and never a gain above 1 / (2 x 0.05), less towards the singularity itself.
    assert all(gain <= 1.3 / 0.1 for gain in gains.values())
    assert gains[1e-4] < gains[0.01] < gains[0.03]
    assert gains[0.0] < 1e-6


def test_everything_stays_finite_at_a_singularity_of_the_arm():
    q = torch.zeros(7, dtype=torch.float64)  # stretched out: rank 5
    J = panda.jacobian(q)
    task, null = resolved_rate(J, torch.ones(6, dtype=torch.float64), torch.ones_like(q))
    assert task.isfinite().all()
    assert null.isfinite().all()
    assert task.norm() < 50


@pytest.mark.parametrize("batch", [(), (1,), (3, 1, 2)])
def test_a_capped_twist_keeps_its_direction(batch):
    twist = random(*batch, 6, rng=sampling.generator(3))
    caps = torch.tensor([0.25, 1.0], dtype=torch.float64)
    capped = twist / excess_speed(twist, caps)
    linear, angular = capped[..., :3].norm(dim=-1), capped[..., 3:].norm(dim=-1)
    torch.testing.assert_close(
        torch.maximum(linear / 0.25, angular), torch.ones(batch, dtype=torch.float64)
    )
    along = (capped * twist).sum(-1) / (capped.norm(dim=-1) * twist.norm(dim=-1))
    torch.testing.assert_close(along, torch.ones(batch, dtype=torch.float64))
    assert (excess_speed(0.01 * twist, caps) == 1).all()


class TestFitNullSpace:
    lower = torch.full((3,), -1.0, dtype=torch.float64)
    upper = torch.full((3,), 1.0, dtype=torch.float64)

    def fit(self, task, null):
        task, null = (torch.tensor(v, dtype=torch.float64) for v in (task, null))
        return scale_null_space(task, null, self.lower, self.upper).tolist()

    def test_what_fits_is_left_alone(self):
        assert self.fit([0.5, 0.0, -0.5], [0.4, 0.2, -0.4]) == [0.4, 0.2, -0.4]

    def test_it_is_scaled_as_a_whole(self):
        assert self.fit([0.5, 0.0, 0.0], [1.0, 0.4, -0.2]) == [0.5, 0.2, -0.1]

    def test_it_stops_where_it_would_make_things_worse(self):
        # The task alone is beyond the limit of joint 1.
        assert self.fit([1.2, 0.0, 0.0], [0.1, 0.2, 0.0]) == [0.0, 0.0, 0.0]

    def test_it_helps_the_task_as_far_as_it_was_wanted(self):
        assert self.fit([1.2, 0.0, 0.0], [-0.4, 0.2, 0.0]) == [-0.4, 0.2, 0.0]

    def test_where_nothing_fits_it_moves_least(self):
        # Joint 1 needs the factor <= -2, joint 2 a factor >= 3: zero is between them.
        assert self.fit([1.2, -1.3, 0.0], [0.1, 0.1, 0.0]) == [0.0, 0.0, 0.0]

    def test_no_null_motion_stays_none(self):
        assert self.fit([0.5, 1.0, 2.0], [0.0, 0.0, 0.0]) == [0.0, 0.0, 0.0]

    def test_a_batch_is_a_loop(self):
        rng = sampling.generator(4)
        task, null = random(50, 3, rng=rng), random(50, 3, rng=rng)
        whole = scale_null_space(task, null, self.lower, self.upper)
        for k in range(50):
            one = scale_null_space(task[k], null[k], self.lower, self.upper)
            assert (one == whole[k]).all()


class TestScaleTask:
    """Two joints that undo each other's motion of the tool, and one along another axis."""

    lower = torch.tensor([-1.0, -1.0, -1.0], dtype=torch.float64)
    upper = torch.tensor([1.0, 1.0, 1.0], dtype=torch.float64)
    caps = torch.tensor([0.25, 1.0], dtype=torch.float64)
    J = torch.zeros(6, 3, dtype=torch.float64)
    J[0, 0], J[0, 1], J[4, 2] = 1.0, -0.8, 0.5

    def scaled(self, *task: float) -> list[float]:
        task = torch.tensor(task, dtype=torch.float64)
        return scale_task(task, self.J, self.lower, self.upper, self.caps).tolist()

    def test_what_fits_is_left_alone(self):
        assert self.scaled(1.0, -1.0, 0.5) == [1.0, -1.0, 0.5]
        assert self.scaled(0.0, 0.0, 0.0) == [0.0, 0.0, 0.0]

    def test_a_cut_that_makes_the_tool_slower_is_left_to_the_limit(self):
        assert self.scaled(2.0, 0.0, 0.0) == [2.0, 0.0, 0.0]
        assert self.scaled(0.0, 0.0, -4.0) == [0.0, 0.0, -4.0]

    def test_a_cut_that_makes_it_faster_slows_all(self):
        # Asked for 1.25 - 1.2 = 0.05 m/s; cut, the first joint would leave -0.2 m/s.
        assert self.scaled(1.25, 1.5, 0.0) == pytest.approx([0.8333333, 1.0, 0.0])
        assert self.scaled(-1.25, -1.5, 0.0) == pytest.approx([-0.8333333, -1.0, 0.0])

    def test_both_speeds_count_by_their_caps(self):
        # 0.05 m/s and 1 rad/s of (0.25, 1): 1.02. Cut: 0.2 and 0.5: 0.94, which is slower.
        assert self.scaled(1.25, 1.5, 2.0) == [1.25, 1.5, 2.0]
        # 0.05 and 0.9: 0.92. Cut, 0.2 and 0.5: 0.94, which is faster.
        share = np.hypot(0.05 / 0.25, 0.9) / np.hypot(0.2 / 0.25, 0.5)
        expected = [1.25 * share, 1.5 * share, 1.8 * share]
        assert self.scaled(1.25, 1.5, 1.8) == pytest.approx(expected)

    def test_unbounded_caps_slow_nothing(self):
        task = torch.tensor([1.25, 1.5, 0.0], dtype=torch.float64)
        caps = torch.full((2,), torch.inf, dtype=torch.float64)
        assert (scale_task(task, self.J, self.lower, self.upper, caps) == task).all()

    def test_a_batch_is_a_loop(self):
        rng = sampling.generator(7)
        task = torch.tensor([1.25, 1.5, 0.0]) + 0.3 * random(50, 3, rng=rng)
        J = self.J + 0.1 * random(50, 6, 3, rng=rng)
        whole = scale_task(task, J, self.lower, self.upper, self.caps)
        assert (whole != task).any()
        for k in range(50):
            one = scale_task(task[k], J[k], self.lower, self.upper, self.caps)
            torch.testing.assert_close(one, whole[k])


class TestSaturation:
    """What limits take from joints of the task, the others do."""

    def cut_tasks(self, limit: float, seed: int, count: int = 400):
        """Jacobians of the Panda, twists, their least velocities, and a bound on all joints."""
        rng = sampling.generator(seed)
        J = regular_jacobians(count, rng)
        twist = random(len(J), 6, rng=rng)
        task, _ = resolved_rate(J, twist, torch.zeros(len(J), 7, dtype=torch.float64))
        twist, task = (v / task.abs().amax(-1, keepdim=True) for v in (twist, task))
        return J, twist, task, torch.full((7,), limit, dtype=torch.float64)

    def missed(self, J, velocity, twist, bound):
        """Of the twist, by a velocity that is cut."""
        return (
            (J @ torch.minimum(torch.maximum(velocity, -bound), bound)[..., None])[..., 0]
            - twist
        ).norm(dim=-1)

    def test_what_fits_is_left_alone(self):
        J, twist, task, bound = self.cut_tasks(1.0 + 1e-9, 11)
        assert torch.equal(saturate_in_null_space(task, J, twist, -bound, bound), task)

    def test_the_tool_moves_as_asked_where_the_other_joints_can(self):
        J, twist, task, bound = self.cut_tasks(0.9, 12, 2000)
        shared = saturate_in_null_space(task, J, twist, -bound, bound)
        # Near the singularities of the joints that are left the motion is damped.
        left = J.masked_fill((task.abs() > bound)[..., None, :], 0)
        regular = torch.linalg.svdvals(left)[:, -1] > 2 * SINGULAR_BELOW
        fits = regular & (shared.abs() <= bound + 1e-12).all(-1)
        assert fits.sum() > 20
        assert (self.missed(J, shared, twist, bound)[fits] < 1e-9).all()
        assert (self.missed(J, task, twist, bound)[fits] > 0.05).all()

    def test_no_velocity_within_the_bounds_does_much_better(self):
        J, twist, task, bound = self.cut_tasks(0.8, 13)
        shared = saturate_in_null_space(task, J, twist, -bound, bound)
        missed, before = (self.missed(J, v, twist, bound) for v in (shared, task))
        assert (missed <= before + 1e-12).all()
        assert (missed < before - 1e-3).double().mean() > 0.5
        bounds = -bound.numpy(), bound.numpy()
        least = [
            np.sqrt(2 * lsq_linear(a.numpy(), b.numpy(), bounds).cost)
            for a, b in zip(J, twist, strict=True)
        ]
        least = torch.tensor(least, dtype=torch.float64)
        # One round leaves to limits what it drives others into.
        assert (missed >= least - 1e-6).all()
        gained = ((before - missed) / (before - least).clamp(min=1e-9)).clamp(0, 1)
        assert gained.mean() > 0.6

    def test_a_joint_that_is_locked_goes_as_far_as_its_limit(self):
        J, twist, task, _ = self.cut_tasks(1.0, 14)
        most = task.abs().argmax(-1, keepdim=True)
        wide = torch.full_like(task, 50.0)
        lower, upper = -wide, wide.scatter(-1, most, 0.3)
        task, twist = (v * task.gather(-1, most).sign() for v in (task, twist))
        shared = saturate_in_null_space(task, J, twist, lower, upper)
        changed = (shared != task).any(-1)
        assert changed.double().mean() > 0.5
        torch.testing.assert_close(
            shared.gather(-1, most)[changed], torch.full_like(shared[changed, :1], 0.3)
        )

    def test_six_joints_slide_along_a_limit(self):
        rng = sampling.generator(15)
        J = regular_jacobians(400, rng)[..., :6]
        J = J[torch.linalg.svdvals(J)[:, -1] > 0.1]
        twist = random(len(J), 6, rng=rng)
        task = torch.linalg.solve(J, twist)
        bound = (0.5 * task.abs().amax(-1, keepdim=True)).expand_as(task)
        shared = saturate_in_null_space(task, J, twist, -bound, bound)
        assert shared.isfinite().all()
        assert (
            self.missed(J, shared, twist, bound) <= self.missed(J, task, twist, bound)
        ).all()

    def test_a_batch_is_a_loop(self):
        J, twist, task, bound = self.cut_tasks(0.7, 16)
        whole = saturate_in_null_space(task, J, twist, -bound, bound)
        for k in range(0, len(J), 10):
            one = saturate_in_null_space(task[k], J[k], twist[k], -bound, bound)
            torch.testing.assert_close(one, whole[k])


@pytest.mark.parametrize("joints", [4, 5])
def test_fewer_joints_keep_the_position_and_turn_as_near_as_they_can(joints):
    rng = torch.Generator().manual_seed(joints)
    J = torch.randn(6, 6, joints, generator=rng, dtype=torch.float64)
    twist = torch.randn(6, 6, generator=rng, dtype=torch.float64)
    task, null = resolved_rate(J, twist, torch.ones(6, joints, dtype=torch.float64))
    assert not null.any()
    for k in range(6):
        linear, angular = J[k, :3].numpy(), J[k, 3:].numpy()
        # Least squares of the rotation among all motions of that linear velocity.
        first = np.linalg.pinv(linear) @ twist[k, :3].numpy()
        still = np.linalg.svd(linear)[2][3:].T
        left = twist[k, 3:].numpy() - angular @ first
        wanted = first + still @ np.linalg.lstsq(angular @ still, left, rcond=None)[0]
        np.testing.assert_allclose(task[k].numpy(), wanted, atol=1e-9)
