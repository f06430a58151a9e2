"""New goals for an orientation, all around: 36 axes by 5 angles in one batch."""

import numpy as np
import pytest
import torch
from demo_motions import minimum_jerk

from hrc_learn.dmp import OrientationDMP
from hrc_learn.dmp.orientation_error import angular_acceleration
from hrc_learn.geometry import quaternion

S = torch.linspace(0, 1, 1000, dtype=torch.float64)
TURN = 120
AWAY = torch.tensor([30.0, 60.0, 90.0, 120.0, 150.0], dtype=torch.float64)


def axes(n=36):
    """Unit vectors spread evenly over the sphere."""
    k = torch.arange(n, dtype=torch.float64) + 0.5
    polar, around = torch.acos(1 - 2 * k / n), torch.pi * (1 + 5**0.5) * k
    flat = [around.cos() * polar.sin(), around.sin() * polar.sin(), polar.cos()]
    return torch.stack(flat, dim=-1)


def fitted(**options):
    axis = torch.nn.functional.normalize(torch.tensor([1.0, 2.0, -0.5]).double(), dim=0)
    turn = quaternion.exp(np.deg2rad(TURN) * minimum_jerk(S)[:, None] * axis)
    return OrientationDMP.fit(2 * S, turn, **options)


def goals(dmp):
    """(5, 36, 4)."""
    away = torch.deg2rad(AWAY)[:, None, None] * axes()
    return quaternion.multiply(quaternion.exp(away), dmp.goal)


def test_no_goal_makes_the_path_flip():
    """The way is no longer than the demonstrated one and what the goal is moved by."""
    dmp = fitted(approach=1.0)
    motion, shown = dmp.rollout(goal=goals(dmp)), dmp.rollout()
    speed, nominal = (x.angular_velocity.norm(dim=-1) for x in (motion, shown))
    longest = 1 + AWAY / TURN
    assert (speed.mean(-1) <= 1.001 * longest[:, None] * nominal.mean()).all()
    assert (speed.amax(-1) <= 1.001 * longest[:, None] * nominal.max()).all()
    assert quaternion.angle(motion.orientation[..., -1, :], goals(dmp)).max() < 1e-3


def test_goals_close_to_each_other_have_paths_close_to_each_other():
    dmp = fitted(approach=1.0)
    near = torch.deg2rad(torch.arange(0, 150, 6.0)).double()[:, None, None] * axes()
    motion = dmp.rollout(goal=quaternion.multiply(quaternion.exp(near), dmp.goal))
    q = motion.orientation
    assert torch.rad2deg(quaternion.angle(q[1:], q[:-1])).max() < 18


def test_switched_at_half_time_the_acceleration_goes_on_and_no_path_flips():
    dmp = fitted()
    peak = dmp.rollout().angular_acceleration.norm(dim=-1).max()
    goal = goals(dmp)
    with torch.no_grad():
        state = dmp.step(dmp.initial_state(duration=torch.full((5, 36), 2.0).double()), 1.0)
        before = acceleration(dmp, state)
        state = dmp.step(state, 0.0, goal=goal, goal_filter=4.0)
        assert (acceleration(dmp, state) - before).norm(dim=-1).max() < 1e-6 * peak
        soon = acceleration(dmp, dmp.step(state, 0.001, goal_filter=4.0))
        assert (soon - before).norm(dim=-1).max() < 0.1 * peak
        way = torch.zeros(5, 36, dtype=torch.float64)
        for _ in range(80):
            state = dmp.step(state, 0.05, goal_filter=4.0)
            way += 0.05 * state.angular_velocity.norm(dim=-1)
    assert quaternion.angle(state.orientation, goal).max() < 5e-3
    # Half of the turn was left, and the state was moving on in its sense.
    assert (torch.rad2deg(way) < TURN / 2 + AWAY[:, None] + 5).all()


def acceleration(dmp, state):
    """Angular [rad/s^2]."""
    motion = state.motion
    curvature = dmp.motion.second_derivative(motion)
    scaled = angular_acceleration(motion.position, motion.rate, curvature)
    return scaled / motion.duration[..., None] ** 2


@pytest.mark.parametrize("goal_filter", [None, 6.0])
def test_the_sign_of_a_new_goal_means_nothing(goal_filter):
    dmp = fitted()
    goal = goals(dmp)[:, ::6]
    states = [dmp.initial_state(duration=torch.full((5, 6), 2.0).double())] * 2
    for k in range(30):
        new = {"goal": goal} if k == 10 else {}
        other = {"goal": -goal} if k == 10 else {}
        states = [
            dmp.step(state, 0.1, goal_filter=goal_filter, **given)
            for state, given in zip(states, (new, other), strict=True)
        ]
    torch.testing.assert_close(states[0].angular_velocity, states[1].angular_velocity)
    assert quaternion.angle(states[0].orientation, states[1].orientation).max() < 1e-7
