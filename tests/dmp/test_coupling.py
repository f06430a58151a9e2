import numpy as np
import pytest
import torch
from demo_motions import minimum_jerk
from scipy.spatial.transform import Rotation

from hrc_learn.dmp import JointDMP, SpringDamper
from hrc_learn.dmp.coupling import (
    phase_stopping,
    repulsion,
    steering,
    velocity_coupling,
)

pytestmark = pytest.mark.simulation

S = torch.linspace(0, 1, 400, dtype=torch.float64)
OBSTACLE = torch.tensor([0.3, 0.01, 0.0], dtype=torch.float64)


def reach_past_the_obstacle():
    """A straight line of 0.6 m in 3 s that passes 10 mm beside the obstacle."""
    way = torch.tensor([0.6, 0.0, 0.0], dtype=torch.float64)
    return JointDMP.fit(3 * S, minimum_jerk(S)[:, None] * way, units="m")


def run(dmp, couple, steps=300):
    state, path = dmp.initial_state(), []
    with torch.no_grad():
        for _ in range(steps):
            state = dmp.step(state, 0.02, coupling=couple(state))
            path.append(state.position)
    return torch.stack(path)


def clearance(path):
    return (path - OBSTACLE).norm(dim=-1).min().item()


@pytest.mark.parametrize(
    "couple",
    [
        lambda state: steering(state.position, state.velocity, OBSTACLE[None], gain=200.0),
        lambda state: repulsion(state.position, OBSTACLE[None], reach=0.15, gain=2e-3),
    ],
    ids=["steering", "repulsion"],
)
def test_obstacles_are_passed_and_the_goal_is_reached(couple):
    dmp = reach_past_the_obstacle()
    plain, avoiding = run(dmp, lambda state: None), run(dmp, couple)
    assert clearance(plain) < 0.011
    assert clearance(avoiding) > 0.04
    torch.testing.assert_close(avoiding[-1], dmp.goal, rtol=0, atol=1e-3)


def test_steering_neither_drives_nor_brakes():
    rng = torch.Generator().manual_seed(0)
    position, velocity = torch.randn(2, 50, 3, generator=rng, dtype=torch.float64)
    obstacles = torch.randn(50, 4, 3, generator=rng, dtype=torch.float64)
    term = steering(position, velocity, obstacles)
    power = (term * velocity).sum(-1)
    torch.testing.assert_close(power, torch.zeros_like(power), rtol=0, atol=1e-9)


@pytest.mark.parametrize("given", [{}, {"gain": 30.0, "sharpness": 2.0}, {"reach": 0.4}])
def test_steering_is_the_published_formula(given):
    """gamma R v phi exp(-beta phi), with gamma = 1000 and beta = 20 / pi in the paper."""
    rng = np.random.default_rng(1)
    position, velocity, obstacles = (
        rng.normal(size=3), rng.normal(size=3), rng.normal(size=(4, 3)),
    )  # fmt: skip
    gain, sharpness = given.get("gain", 1000), given.get("sharpness", 20 / np.pi)
    expected = np.zeros(3)
    for towards in obstacles - position:
        distance = np.linalg.norm(towards)
        phi = np.arccos(towards @ velocity / distance / np.linalg.norm(velocity))
        axis = np.cross(towards, velocity)
        turn = Rotation.from_rotvec(np.pi / 2 * axis / np.linalg.norm(axis))
        term = gain * turn.apply(velocity) * phi * np.exp(-sharpness * phi)
        expected += term * (np.exp(-distance / given["reach"]) if "reach" in given else 1)
    arguments = map(torch.from_numpy, (position, velocity, obstacles))
    np.testing.assert_allclose(steering(*arguments, **given), expected)


def test_a_clock_runs_at_half_speed_at_one_over_the_root_of_the_gain():
    planned = torch.tensor([[0.3, -0.2], [0.3, 0.0]], dtype=torch.float64)
    measured = torch.tensor([0.0, 0.2], dtype=torch.float64)
    stopping = phase_stopping(planned, measured, gain=1 / 0.25)
    np.testing.assert_allclose(stopping, [1.0, 4 * (0.09 + 0.04)])
    np.testing.assert_allclose(1 / (1 + stopping[0]), 0.5)


def test_steering_turns_away_from_the_obstacle():
    velocity = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)
    for side in (-1.0, 1.0):
        obstacle = torch.tensor([[1.0, 0.2 * side, 0.0]], dtype=torch.float64)
        term = steering(torch.zeros(3).double(), velocity, obstacle)
        assert term[1] * side < 0
        near, far = (
            steering(torch.zeros(3).double(), velocity, k * obstacle, reach=0.5).norm()
            for k in (1, 2)
        )
        assert far < near < term.norm()


def test_steering_is_finite_at_rest_and_straight_ahead():
    obstacle = torch.tensor([[1.0, 0.0, 0.0]])
    for velocity in (torch.zeros(3), torch.tensor([1.0, 0.0, 0.0])):
        assert (steering(torch.zeros(3), velocity, obstacle) == 0).all()


@pytest.mark.gradients
@pytest.mark.parametrize("speed", [-1.0, 0.0, 1.0])
def test_steering_has_a_finite_gradient_where_it_has_no_axis(speed):
    velocity = torch.tensor([speed, 0.0, 0.0], dtype=torch.float64, requires_grad=True)
    obstacles = torch.tensor([[0.5, 0.0, 0.0]], dtype=torch.float64, requires_grad=True)
    term = steering(torch.zeros(3, dtype=torch.float64), velocity, obstacles)
    assert (term == 0).all()
    for gradient in torch.autograd.grad(term.sum(), (velocity, obstacles)):
        assert (gradient.abs() < 1e-3).all()


@pytest.mark.gradients
def test_repulsion_is_the_gradient_of_its_potential():
    rng = torch.Generator().manual_seed(0)
    position = torch.rand(100, 3, generator=rng, dtype=torch.float64).requires_grad_()
    obstacles = torch.rand(3, 3, generator=rng, dtype=torch.float64)
    distance = (position[:, None] - obstacles).norm(dim=-1)
    potential = 0.5e-3 * (1 / distance - 1 / 0.4).clamp_min(0) ** 2
    (gradient,) = torch.autograd.grad(potential.sum(), position)
    torch.testing.assert_close(repulsion(position, obstacles, reach=0.4), -gradient)
    twice = repulsion(position, obstacles, reach=0.4, gain=2e-3)
    torch.testing.assert_close(twice, -2 * gradient)
    # On the obstacle there is no direction.
    assert repulsion(obstacles, obstacles[:1], reach=0.4).isfinite().all()
    assert (gradient == 0).any(dim=-1).any()


def test_a_held_robot_is_waited_for():
    """Held at its start, the motion all but stops; let go, it ends on its path."""
    dmp = reach_past_the_obstacle()
    state, robot = dmp.initial_state(), dmp.start
    with torch.no_grad():
        for k in range(750):
            waiting = phase_stopping(state.position, robot, gain=1e4)
            state = dmp.step(state, 0.02, phase_stopping=waiting)
            if k >= 250:
                robot = state.position
            if k == 249:
                assert state.s < 0.5
                on_path = dmp.rollout(time=3 * state.s[None]).position[0]
                torch.testing.assert_close(state.position, on_path, rtol=0, atol=1e-9)
    torch.testing.assert_close(state.position, dmp.goal, rtol=0, atol=1e-3)


@pytest.mark.parametrize("distance", [2e-3, 1e-3, 1e-4])
def test_repulsion_is_constant_within_a_millimetre(distance):
    """It is gain (1 / d - 1 / reach) / d^2, with d at least 1 mm, along the direction."""
    direction = np.array([0.6, 0.0, -0.8])
    found = repulsion(torch.from_numpy(distance * direction), torch.zeros(1, 3), reach=0.1)
    d = max(distance, 1e-3)
    strength = 1e-3 * (1 / d - 1 / 0.1) / d**2
    np.testing.assert_allclose(found, strength * direction, rtol=1e-6)


@pytest.mark.gradients
def test_repulsion_is_finite_at_the_obstacle_and_so_is_its_gradient():
    position = torch.zeros(3, dtype=torch.float64, requires_grad=True)
    found = repulsion(position, torch.zeros(1, 3), reach=0.1)
    assert found.tolist() == [0.0, 0.0, 0.0]
    found.sum().backward()
    assert position.grad.isfinite().all()


def test_repulsion_of_several_obstacles_adds_up_and_ends_at_the_reach():
    rng = np.random.default_rng(0)
    position = torch.from_numpy(rng.uniform(-1, 1, (2, 5, 3)))
    obstacles = torch.from_numpy(rng.uniform(-1, 1, (2, 1, 3, 3)))
    whole = repulsion(position, obstacles, reach=0.8)
    single = sum(repulsion(position, obstacles[..., k : k + 1, :], reach=0.8) for k in range(3))
    torch.testing.assert_close(whole, single)
    away = torch.tensor([[0.0, 0.0, 0.7999], [0.0, 0.0, 0.8], [0.0, 0.0, 3.0]]).double()
    acting = repulsion(away, torch.zeros(1, 3), reach=0.8).norm(dim=-1) > 0
    assert acting.tolist() == [True, False, False]


@pytest.mark.parametrize("given", [{}, {"lead": 0.0}, {"lead": 0.7}])
def test_a_velocity_acts_as_a_term_added_to_the_printed_system(given):
    """tau z' = alpha (beta (g - y) - z) + lead tau C' and tau y' = z + C."""
    alpha, beta, tau = 20.0, 4.0, torch.tensor([1.5, 0.8]).double()
    y, z, g, t, h = 0.3, -0.2, 1.0, 0.4, 1e-5

    def C(t):
        return tau * np.sin(2.0 * t)

    rate_of_C = (C(t + h) - C(t - h)) / (2 * h)
    z_rate = (alpha * (beta * (g - y) - z) + given.get("lead", 0.0) * tau * rate_of_C) / tau
    printed = (z_rate + rate_of_C) / tau
    # The same state without C: y' = z / tau, so z there is z + C.
    plain = alpha * (beta * (g - y) - (z + C(t))) / tau**2
    velocity, acceleration = (C(t) / tau)[:, None], (rate_of_C / tau)[:, None]
    spring = SpringDamper(alpha=alpha, beta=beta)
    found = velocity_coupling(velocity, acceleration, spring=spring, duration=tau, **given)
    torch.testing.assert_close(plain + found[:, 0], printed, rtol=1e-6, atol=1e-8)
