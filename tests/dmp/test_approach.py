import pytest
import torch
from demo_motions import arm_motion, minimum_jerk
from dmp_oracle import solve
from torch.autograd.functional import jvp

from hrc_learn.dmp import JointDMP, OrientationDMP, PeriodicBasis, fit_rhythmic, fit_shared
from hrc_learn.dmp.dynamics import approach_curve
from hrc_learn.geometry import quaternion

S = torch.linspace(0, 1, 1000, dtype=torch.float64)


def test_the_curve_is_the_minimum_jerk_one_and_its_derivatives():
    s = torch.linspace(0, 1.2, 50, dtype=torch.float64)
    m = approach_curve(s, 0.8, 0) + 1
    torch.testing.assert_close(m, minimum_jerk((s / 0.8).clamp(max=1)))
    ones = torch.ones_like(s)
    for order in range(1, 4):
        slope = jvp(lambda s, k=order - 1: approach_curve(s, 0.8, k), s, ones)[1]
        torch.testing.assert_close(approach_curve(s, 0.8, order), slope)


@pytest.mark.parametrize("method", ["trajectory", "ridge", "lwr"])
def test_a_moved_goal_adds_a_minimum_jerk_motion(method):
    time, position = arm_motion(moving_start=True)
    dmp = JointDMP.fit(time, position, approach=0.8, method=method)
    assert dmp.fit_report.nrmse < 2e-2
    shift = torch.linspace(-1, 1, 7, dtype=torch.float64)
    added = dmp.rollout(goal=dmp.goal + shift).position - dmp.rollout().position
    expected = minimum_jerk((time / 3 / 0.8).clamp(max=1))[:, None] * shift
    torch.testing.assert_close(added, expected)


def test_the_force_of_the_approach_solves_the_equation():
    """The printed equation, with the approach as an extra force, by an adaptive solver."""
    time, position = arm_motion(n_joints=1)
    dmp = JointDMP.fit(time, position, n_basis=12, approach=0.6)
    start, goal, rate = dmp.start.item(), dmp.goal.item() + 0.5, 3 * dmp.start_velocity.item()

    def push(s, y, y_rate):
        s = torch.tensor(s, dtype=torch.float64)
        return (goal - start) * dmp.response.approach_force(s).item()

    weights = dmp.weights[0].detach().numpy()
    times = [0.0, 0.3, 0.59, 0.9, 1.3]
    expected = solve(dmp.spring, dmp.basis, weights, start, rate, goal, times, push)[0]
    got = dmp.rollout(time=3 * torch.tensor(times, dtype=torch.float64), goal=[goal]).position
    torch.testing.assert_close(got[:, 0], torch.tensor(expected), rtol=0, atol=1e-8)


def test_a_moved_goal_makes_no_haste():
    """Unlike left to the spring, which sets off at once."""
    axis = torch.tensor([0.0, 0.6, 0.8], dtype=torch.float64)
    q = quaternion.exp(minimum_jerk(S)[:, None] * 2.0 * axis)
    for approach, at_most, at_least in ((1.0, 1.8, 0.0), (0.0, 9.9, 1.8)):
        dmp = OrientationDMP.fit(2 * S, q, approach=approach)
        peak = dmp.rollout().angular_velocity.norm(dim=-1).max()
        turn = quaternion.exp(torch.tensor([1.5, 0.0, 0.0], dtype=torch.float64))
        moved = dmp.rollout(goal=quaternion.multiply(turn, dmp.goal))
        ratio = moved.angular_velocity.norm(dim=-1).max() / peak
        assert at_least < ratio < at_most


def test_impossible_approaches_are_refused():
    time, position = arm_motion()
    for approach in (-0.1, 1.1):
        with pytest.raises(ValueError, match="approach must be a fraction"):
            JointDMP.fit(time, position, approach=approach)
    rhythm = fit_rhythmic(time, torch.sin(8 * time)[:, None])
    with pytest.raises(ValueError, match="0 for rhythms"):
        JointDMP(
            weights=rhythm.weights.detach(),
            **dict(rhythm.named_buffers()),
            basis=rhythm.basis,
            spring=rhythm.spring,
            approach=0.5,
        )


REACH = torch.stack([0.5 * minimum_jerk(S), -0.3 * minimum_jerk(S)], -1)


def by_default(kind):
    if kind == "shared":
        return fit_shared([(2 * S, REACH), (2 * S, REACH)])[0]
    return JointDMP.fit(2 * S, REACH, **{"scaling": kind})


@pytest.mark.parametrize("kind", ["none", "amplitude", "rotation", "shared"])
@pytest.mark.parametrize("change", ["near", "far", "closer", "mirrored"])
def test_by_default_a_new_goal_is_as_gentle_as_the_demonstration(kind, change):
    """Ten times the distance needs ten times the acceleration, and no more."""
    dmp = by_default(kind)
    factor = {"near": 1.2, "far": 10.0, "closer": 0.1, "mirrored": -1.0}[change]
    goal = factor * torch.tensor([0.5, -0.3], dtype=dmp.goal.dtype)
    shown, made = dmp.rollout(dt=0.01), dmp.rollout(goal=goal, dt=0.01)
    peak = shown.acceleration.abs().max()
    if kind != "rotation":  # the demonstrated acceleration at the start grows with it
        assert made.acceleration[0].abs().max() < 0.1 * peak
    assert made.acceleration.abs().max() < 1.05 * max(abs(factor), 1.0) * peak
    ends = torch.stack([dmp.start, goal])
    margin = 0.02 * (goal - dmp.start).abs() + 1e-3
    assert (made.position > ends.amin(0) - margin).all()
    assert (made.position < ends.amax(0) + margin).all()


def test_a_new_start_is_as_gentle():
    dmp = by_default("none")
    made = dmp.rollout(start=dmp.start + 0.1, dt=0.01)
    assert made.acceleration[0].abs().max() < 0.1 * dmp.rollout(dt=0.01).acceleration.max()


def test_the_papers_form_is_kept_by_name_and_for_rhythms():
    assert JointDMP.fit(2 * S, REACH, approach=0).response.approach == 0
    assert JointDMP.fit(2 * S, REACH, scaling="paper").response.approach == 0
    wave = torch.sin(12 * S)[:, None]
    assert JointDMP.fit(2 * S, wave, basis=PeriodicBasis(count=8)).response.approach == 0
    assert fit_rhythmic(2 * S, wave, 8).response.approach == 0
