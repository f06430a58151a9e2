import pytest
import torch
from demo_motions import arm_motion
from dmp_contract import DMPContract
from hypothesis import given, settings
from hypothesis import strategies as st

from hrc_learn.dmp import JointDMP, LimitedDMP, SoftLimits

LOWER = torch.tensor([-2.9, -1.8, -2.0], dtype=torch.float64)
UPPER = torch.tensor([2.9, 1.8, 2.2], dtype=torch.float64)
anywhere = st.lists(st.floats(-1e6, 1e6), min_size=3, max_size=3)


class TestLimited(DMPContract):
    def demonstrate(self, seed, n_samples=300):
        return arm_motion(n_samples, n_joints=3, seed=seed, moving_start=True)

    def fit(self, *demonstration, **kwargs):
        return LimitedDMP.fit(*demonstration, LOWER, UPPER, **kwargs)

    def outputs(self, trajectory):
        return {"position": trajectory.position, "rate of position": trajectory.velocity}

    state_outputs = outputs

    def ends(self, seed):
        rng = torch.Generator().manual_seed(seed)
        return (2 * torch.rand(2, 3, generator=rng, dtype=torch.float64) - 1).unbind()

    def distance(self, outputs, demonstration):
        return (outputs["position"] - demonstration[1]).abs().max()


@pytest.fixture(scope="module")
def dmp():
    return LimitedDMP.fit(*arm_motion(n_joints=3), LOWER, UPPER)


def inside(position):
    return bool(((position > LOWER) & (position < UPPER)).all())


@settings(max_examples=60, deadline=None)
@given(goal=anywhere, velocity=anywhere, speed=st.floats(0.01, 100))
def test_no_goal_leads_out_of_the_limits(dmp, goal, velocity, speed):
    motion = dmp.rollout(goal=goal, start_velocity=velocity, speed=speed)
    assert inside(motion.position.detach())


@settings(max_examples=60, deadline=None)
@given(pushes=st.lists(anywhere, min_size=1, max_size=8), goal=anywhere)
def test_no_push_leads_out_of_the_limits(dmp, pushes, goal):
    state = dmp.initial_state()
    for push in pushes:
        state = dmp.step(state, 0.1, goal=goal, coupling=push)
        assert inside(state.position.detach())
    late = dmp.step(state, 100.0)
    nearest = torch.minimum(torch.maximum(torch.tensor(goal).double(), LOWER), UPPER)
    torch.testing.assert_close(late.position.detach(), nearest, rtol=0, atol=1e-3)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_the_map_is_strict_and_inverted(dtype):
    limits = SoftLimits(LOWER, UPPER, 0.02 * (UPPER - LOWER))
    far = torch.logspace(-3, 30, 100).to(dtype)[:, None] * torch.tensor([1, -1, 1], dtype=dtype)
    for x in (far, -far):
        assert inside(limits.constrain(x).double())
    q = LOWER + (UPPER - LOWER) * torch.linspace(0.001, 0.999, 500)[:, None].double()
    back = limits.constrain(limits.release(q.to(dtype))).double()
    torch.testing.assert_close(back, q, rtol=0, atol=1e-12 if dtype == torch.float64 else 1e-6)


def test_narrow_limits_far_from_zero_hold_in_single_precision():
    lower, upper = torch.tensor([1000.0]), torch.tensor([1001.0])
    limits = SoftLimits(lower, upper, 0.02 * (upper - lower))
    away = torch.logspace(-3, 6, 50)[:, None]
    assert limits.contain(limits.constrain(1000.5 + torch.cat([away, -away]))).all()


def test_the_middle_of_the_range_is_left_as_it_is():
    limits = SoftLimits(LOWER, UPPER, 0.02 * (UPPER - LOWER))
    q = LOWER + (UPPER - LOWER) * torch.linspace(0.2, 0.8, 50)[:, None].double()
    # Ten times the softness from a limit, exp(-10) of it is left.
    assert (limits.release(q) - q).abs().max() < 5e-5 * (UPPER - LOWER).max() * 0.02


def test_the_map_has_the_derivatives_it_claims():
    limits = SoftLimits(LOWER, UPPER, 0.1 * (UPPER - LOWER))
    x = torch.linspace(-4, 4, 9).double()[:, None].repeat(1, 3).requires_grad_()
    assert torch.autograd.gradcheck(limits.constrain, (x,))
    assert torch.autograd.gradgradcheck(limits.constrain, (x,))


def test_a_motion_along_a_limit_is_reproduced():
    """Closer than the softness, all along: the map bends it there, the fit unbends it."""
    time, position = arm_motion(n_joints=3)
    low, high = position.amin(0) - 0.01, position.amax(0) + 0.01
    dmp = LimitedDMP.fit(time, position, low, high)
    plain = JointDMP.fit(time, position)
    assert dmp.fit_report.nrmse < 3 * plain.fit_report.nrmse + 1e-4
    t = torch.linspace(0, 3, 3001, dtype=torch.float64)
    motion = dmp.rollout(time=t)
    numeric = (motion.velocity[2:] - motion.velocity[:-2]) / 2e-3
    torch.testing.assert_close(numeric, motion.acceleration[1:-1], rtol=0, atol=1e-2)


def test_the_same_goal_makes_a_joint_primitive_overshoot_and_this_one_not(dmp):
    time, position = arm_motion(n_joints=3)
    goal = UPPER - 0.02
    assert not inside(JointDMP.fit(time, position).rollout(goal=goal + 0.2).position)
    assert inside(dmp.rollout(goal=goal + 0.2).position)


def test_what_cannot_be_is_refused(dmp):
    time, position = arm_motion(n_joints=3)
    with pytest.raises(ValueError, match=r"position of elbow at sample \d+ is .* not between"):
        LimitedDMP.fit(time, position, LOWER, [3, 3, 0.1], joint_names=["a", "b", "elbow"])
    with pytest.raises(ValueError, match="not between the limits"):
        dmp.rollout(start=[0.0, 1.9, 0.0])
    with pytest.raises(ValueError, match="lower < upper"):
        LimitedDMP(dmp.motion, UPPER, LOWER, UPPER - LOWER)
