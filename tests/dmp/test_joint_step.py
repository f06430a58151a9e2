import dataclasses

import numpy as np
import pytest
import torch
from demo_motions import arm_motion
from dmp_oracle import solve
from unchecked import shapes_unchecked

from hrc_learn.dmp import JointDMP, SpringDamper


@pytest.mark.parametrize("n_steps", [1, 20, 400])
@pytest.mark.parametrize("scaling", ["none", "paper"])
def test_steps_end_where_the_rollout_does(n_steps, scaling):
    time, position = arm_motion(moving_start=True)
    dmp = JointDMP.fit(time, position, scaling=scaling)
    goal = position[-1] + 0.2
    state = dmp.initial_state(goal=goal, duration=2.0)
    with torch.no_grad(), shapes_unchecked():
        for _ in range(n_steps):
            state = dmp.step(state, 2.2 / n_steps)
    end = dmp.rollout(time=[2.2], goal=goal, duration=2.0)
    torch.testing.assert_close(state.position, end.position[0], rtol=0, atol=1e-9)
    torch.testing.assert_close(state.velocity, end.velocity[0], rtol=0, atol=1e-9)


def test_steps_of_any_length_in_any_order():
    time, position = arm_motion()
    dmp = JointDMP.fit(time, position)
    state = dmp.initial_state(speed=1.5)
    elapsed = 0.0
    for dt in (0.001, 0.3, 0.05, 0.0, 0.7, 1e-6):
        state = dmp.step(state, dt)
        elapsed += dt
        there = dmp.rollout(time=torch.tensor([elapsed], dtype=torch.float64), speed=1.5)
        torch.testing.assert_close(state.position, there.position[0], rtol=0, atol=1e-9)


def test_a_pushed_robot_comes_back_to_the_goal():
    time, position = arm_motion()
    dmp = JointDMP.fit(time, position)
    state = dmp.step(dmp.initial_state(), 1.0)
    state = dataclasses.replace(state, position=state.position + 0.5)
    for _ in range(50):
        state = dmp.step(state, 0.1)
    torch.testing.assert_close(state.position, dmp.goal, rtol=0, atol=1e-6)


def test_a_goal_that_moves_on_the_way_is_reached():
    time, position = arm_motion()
    dmp = JointDMP.fit(time, position)
    goal = torch.zeros(7, dtype=torch.float64)
    state = dmp.step(dmp.initial_state(), 1.0)
    before = state.position
    state = dmp.step(state, 0.0, goal=goal)
    torch.testing.assert_close(state.position, before)
    for _ in range(50):
        state = dmp.step(state, 0.1)
    torch.testing.assert_close(state.position, goal, rtol=0, atol=1e-6)


def test_slowing_down_stays_on_the_path():
    time, position = arm_motion(moving_start=True)
    dmp = JointDMP.fit(time, position)
    state = dmp.initial_state()
    for k in range(20):
        state = dmp.step(state, 0.1, phase_stopping=3.0 if k % 2 else None)
    on_path = dmp.rollout(time=3.0 * state.s[None])
    torch.testing.assert_close(state.position, on_path.position[0], rtol=0, atol=1e-9)
    torch.testing.assert_close(4 * state.velocity, on_path.velocity[0], rtol=0, atol=1e-9)


def test_a_constant_push_shifts_the_resting_point():
    """At rest, spring force balances the push: alpha beta (y - g) = tau^2 c."""
    time, position = arm_motion()
    dmp = JointDMP.fit(time, position, spring=SpringDamper(alpha=20.0))
    state = dmp.initial_state()
    for _ in range(100):
        state = dmp.step(state, 0.1, coupling=torch.full((7,), 0.4))
    shift = torch.full((7,), 0.4 * 3.0**2 / 100, dtype=torch.float64)
    torch.testing.assert_close(state.position - dmp.goal, shift, rtol=0, atol=1e-6)


# Order of accuracy, against an adaptive solver


def primitive():
    """One joint that moves for 2 s, with rough weights and a moving start."""
    time, position = arm_motion(n_joints=1, duration=2.0, moving_start=True)
    dmp = JointDMP.fit(time, position, n_basis=15)
    rng = torch.Generator().manual_seed(0)
    noise = 200 * torch.randn(dmp.weights.shape, generator=rng, dtype=torch.float64)
    dmp.weights.data += noise
    return dmp


def exact(dmp, y, rate, goal, span, push=None):
    weights = dmp.weights[0].detach().numpy()
    return solve(dmp.spring, dmp.basis, weights, y, rate, goal, np.array(span), push)[:, -1]


@pytest.mark.parametrize("n_steps", [20, 400])
def test_steps_solve_the_equation_also_when_the_goal_jumps(n_steps):
    dmp = primitive()
    state = dmp.initial_state()
    y, rate = state.position.item(), state.rate.item()
    middle = exact(dmp, y, rate, dmp.goal.item(), (0.0, 0.5))
    expected = exact(dmp, *middle, 1.5, (0.5, 1.2))
    with torch.no_grad(), shapes_unchecked():
        for _ in range(n_steps // 2):
            state = dmp.step(state, 2.0 * 0.5 / (n_steps // 2))
        for _ in range(n_steps // 2):
            state = dmp.step(state, 2.0 * 0.7 / (n_steps // 2), goal=[1.5])
    got = [state.position.item(), state.rate.item()]
    np.testing.assert_allclose(got, expected, rtol=0, atol=1e-8)


def test_coupling_sampled_at_the_start_of_a_step_is_of_first_order():
    """An elastic band to y = 1 of 30 / s^2, which depends on the state."""
    dmp = primitive()
    start = dmp.initial_state()
    expected = exact(
        dmp,
        start.position.item(),
        start.rate.item(),
        dmp.goal.item(),
        (0.0, 1.0),
        lambda s, y, rate: 2.0**2 * 30 * (1 - y),
    )[0]
    errors = []
    for n_steps in (100, 200, 400):
        state = start
        with torch.no_grad(), shapes_unchecked():
            for _ in range(n_steps):
                state = dmp.step(state, 2.0 / n_steps, coupling=30 * (1 - state.position))
        errors.append(abs(state.position.item() - expected))
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert ((orders > 0.9) & (orders < 1.2)).all(), orders


# Filtered goals


@pytest.mark.parametrize("spring", [SpringDamper(), SpringDamper(alpha=12.0, beta=20.0)])
@pytest.mark.parametrize("n_steps", [3, 200])
def test_a_filtered_goal_solves_the_equation(n_steps, spring):
    """As a push of alpha beta (g - target), with g in closed form."""
    time, position = arm_motion(n_joints=1, duration=2.0)
    dmp = JointDMP.fit(time, position, n_basis=15, spring=spring)
    start, goal = dmp.start.item(), dmp.goal.item()
    expected = exact(
        dmp,
        start,
        dmp.initial_state().rate.item(),
        1.5,
        (0.0, 0.9),
        lambda s, y, rate: spring.stiffness * (goal - 1.5) * np.exp(-7.0 * s),
    )
    state = dmp.initial_state()
    for k in range(n_steps):
        change = {"goal": [1.5]} if k == 0 else {}
        state = dmp.step(state, 2.0 * 0.9 / n_steps, goal_filter=7.0, **change)
    np.testing.assert_allclose([state.position.item(), state.rate.item()], expected, atol=1e-8)
    assert state.goal.item() == pytest.approx(1.5 + (goal - 1.5) * np.exp(-7.0 * 0.9))


def test_curvature_is_the_derivative_of_the_rate():
    dmp = primitive()
    state = dmp.step(dmp.initial_state(), 0.7)
    ahead, behind = (dmp.step(state, dt) for dt in (1e-5, -1e-5))
    numeric = (ahead.rate - behind.rate) / 1e-5
    torch.testing.assert_close(numeric, dmp.curvature(state), rtol=1e-5, atol=1e-4)


@pytest.mark.parametrize("rate", [0.0, -1.0, 12.5])
def test_impossible_goal_filters_are_refused(rate):
    dmp = primitive()
    with pytest.raises(ValueError, match="goal filter"):
        dmp.step(dmp.initial_state(), 0.1, goal=[0.0], goal_filter=rate)
