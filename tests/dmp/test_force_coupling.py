import numpy as np
import pytest
import torch
from demo_motions import arm_motion, minimum_jerk
from dmp_oracle import forcing
from scipy.integrate import solve_ivp
from torch.autograd import gradcheck

from hrc_learn.dmp import JointDMP
from hrc_learn.dmp.coupling import velocity_coupling

pytestmark = pytest.mark.simulation

TAU = 2.0
S = torch.linspace(0, 1, 400, dtype=torch.float64)


def printed_form(dmp, goal, end, velocity, lead=0.0):
    """y at s = end of the two equations as printed, for any number of coordinates at once.

    `velocity(s, y, y_dot)` returns V = C / tau and its rate; the rate may depend on y_dot.
    """
    weights = dmp.weights.detach().numpy().reshape(-1, dmp.basis.count)
    state = dmp.initial_state(goal=goal)
    y0, rate = state.position.numpy().ravel(), state.rate.numpy().ravel()
    goal, spring = np.ravel(goal), dmp.spring

    def rhs(s, x):
        y, z = np.split(x, 2)
        C = TAU * velocity(s, y, np.zeros_like(y))[0]
        y_dot = (z + C) / TAU
        C_dot = TAU * velocity(s, y, y_dot)[1]
        f = weights @ forcing(dmp.basis, s)
        pull = spring.alpha * (spring.beta * (goal - y) - z)
        # By s instead of t: everything times tau.
        return np.concatenate([TAU * y_dot, pull + f + lead * TAU * C_dot])

    z0 = rate - TAU * velocity(0.0, y0, rate / TAU)[0]
    solution = solve_ivp(
        rhs, (0, end), [*y0, *z0], "DOP853", rtol=1e-11, atol=1e-11, max_step=0.02
    )
    return solution.y[: len(y0), -1]


def run(dmp, goal, end, n_steps, couple):
    """State after s = end; `couple(k, state)` gives V and its rate."""
    state = dmp.initial_state(goal=goal)
    with torch.no_grad():
        for k in range(n_steps):
            V, V_dot, lead = couple(k, state)
            push = velocity_coupling(
                V, V_dot, spring=dmp.spring, duration=state.duration, lead=lead
            )
            state = dmp.step(state, TAU * end / n_steps, coupling=push)
    return state


def assert_first_order(errors, steps_ratio=2):
    orders = np.log(np.array(errors[:-1]) / errors[1:]) / np.log(steps_ratio)
    assert ((orders > 0.85) & (orders < 1.15)).all(), orders


# Forces

STIFFNESS, GAIN = 1000.0, 0.01  # N/m, m/s/N


@pytest.mark.parametrize("lead", [0.0, 0.5])
def test_a_force_loop_solves_the_printed_equations_to_first_order(lead):
    """Always in contact with an elastic wall, so that the equation is smooth."""
    time, position = arm_motion(n_joints=1, duration=TAU, moving_start=True)
    dmp = JointDMP.fit(time, 0.05 * position, n_basis=15, approach=0)
    goal = dmp.goal.numpy() + 0.03

    def couple(k, state):
        force = STIFFNESS * (state.position + 0.1)
        return GAIN * (50.0 - force), -GAIN * STIFFNESS * state.velocity, lead

    def velocity(s, y, y_dot):
        return GAIN * (50.0 - STIFFNESS * (y + 0.1)), -GAIN * STIFFNESS * y_dot

    expected = printed_form(dmp, goal, 0.6, velocity, lead)
    errors = [
        abs(run(dmp, goal, 0.6, n, couple).position.numpy() - expected).item()
        for n in (60, 120, 240)
    ]
    assert errors[-1] < 4e-3
    assert_first_order(errors)


def press_on_a_wall(dmp, wanted, learned, dt):
    """Force [N] at each step against a wall at 0.3 m that only pushes."""
    feed_forward = torch.gradient(learned, spacing=dt, dim=0)[0]
    wanted_rate = torch.gradient(wanted, spacing=dt, dim=0)[0]
    forces, state = [], dmp.initial_state()
    with torch.no_grad():
        for k in range(len(wanted)):
            depth = state.position - 0.3
            force = STIFFNESS * depth.clamp(min=0)
            force_rate = torch.where(depth > 0, STIFFNESS * state.velocity, 0.0)
            push = velocity_coupling(
                learned[k] + GAIN * (wanted[k] - force),
                feed_forward[k] + GAIN * (wanted_rate[k] - force_rate),
                spring=dmp.spring,
                duration=state.duration,
            )
            state = dmp.step(state, dt, coupling=push)
            forces.append(force)
    return torch.stack(forces)


def test_the_wanted_force_on_a_wall_is_reached_by_learning():
    """The goal lies 20 mm behind the wall, which left alone presses with 20 N; 8 are wanted."""
    dmp = JointDMP.fit(TAU * S, 0.32 * minimum_jerk(S)[:, None], units="m")
    n_steps, dt = 500, 0.01
    s = torch.arange(n_steps, dtype=torch.float64) * dt / TAU
    wanted = 8.0 * minimum_jerk(((s - 0.9) / 0.3).clamp(0, 1))[:, None]
    learned, last = torch.zeros_like(wanted), []
    for _ in range(4):
        force = press_on_a_wall(dmp, wanted, learned, dt)
        last.append((force[-1] - wanted[-1]).item())
        learned = learned + GAIN * (wanted - force)
    # At rest the pull of the goal, 20 N - 8 N, is fed back over K = stiffness tau / beta.
    shrink = 1 / (1 + GAIN * STIFFNESS * TAU / dmp.spring.beta)
    for i, miss in enumerate(last):
        assert miss == pytest.approx(12.0 * shrink ** (i + 1), rel=0.02, abs=2e-4)
    assert abs(last[-1]) < 0.05
    # Not at the end alone: over the last half, which began at 8 N.
    settled = force[n_steps // 2 :]
    assert (settled - 8.0).abs().max() < 0.1
    assert force.max() < 20.0


# Two arms

ARM_GAIN = 15.0


def two_arms():
    """A batch of two primitives in the plane that carry something 0.5 m long."""
    way = torch.tensor([[0.4, 0.1], [0.4, 0.1]], dtype=torch.float64)
    start = torch.tensor([[0.0, 0.0], [0.3, 0.4]], dtype=torch.float64)
    position = start[:, None] + minimum_jerk(S)[:, None] * way[:, None]
    position = position + 0.05 * torch.sin(torch.pi * S).square()[:, None]
    return JointDMP.fit(TAU * S, position, n_basis=15, units="m", approach=0)


def mirrored(error, rate):
    """The other arm is moved by plus the error, this one by minus."""
    pair = torch.stack([-error, error]), torch.stack([-rate, rate])
    return ARM_GAIN * pair[0], ARM_GAIN * pair[1], 0.0


def keep(k, state):
    (a, b), (va, vb) = state.position, state.velocity
    return mirrored(OFFSET - (b - a), va - vb)


OFFSET = torch.tensor([0.3, 0.4], dtype=torch.float64)
SHIFT = torch.tensor([[0.0, 0.0], [0.1, -0.06]], dtype=torch.float64)


def offset_by_hand(s, x, x_dot):
    a, b = x.reshape(2, 2)
    va, vb = x_dot.reshape(2, 2)
    e, rate = OFFSET.numpy() - (b - a), va - vb
    return ARM_GAIN * np.concatenate([-e, e]), ARM_GAIN * np.concatenate([-rate, rate])


def test_linked_arms_solve_the_printed_equations_to_first_order():
    dmp = two_arms()
    goal = dmp.goal + SHIFT
    expected = printed_form(dmp, goal.numpy(), 0.7, offset_by_hand).reshape(2, 2)
    errors = [
        abs(run(dmp, goal, 0.7, n, keep).position.numpy() - expected).max()
        for n in (100, 200, 400)
    ]
    assert errors[-1] < 2e-3
    assert_first_order(errors)


def test_arms_keep_their_offset_when_one_goal_moves():
    """What is left at rest: the shift over 1 + 2 gain tau / beta."""
    dmp = two_arms()
    a, b = run(dmp, dmp.goal + SHIFT, 3.0, 300, keep).position
    left = SHIFT[1] / (1 + 2 * ARM_GAIN * TAU / dmp.spring.beta)
    torch.testing.assert_close(b - a - OFFSET, left, rtol=0, atol=1e-6)
    assert left.norm() < 0.1 * SHIFT.norm()
    # Each gives way by half: their middle is where it would be.
    middle = (dmp.goal + SHIFT).mean(0)
    torch.testing.assert_close((a + b) / 2, middle, rtol=0, atol=1e-6)


@pytest.mark.gradients
def test_terms_take_batches_and_pass_gradients():
    dmp = two_arms()

    def moved(position, V):
        return velocity_coupling(position, V, spring=dmp.spring, duration=dmp.duration)

    rng = torch.Generator().manual_seed(0)
    position, V = torch.randn(2, 2, 3, generator=rng, dtype=torch.float64).requires_grad_()
    assert gradcheck(moved, (position, V))
