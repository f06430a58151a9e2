import json

import numpy as np
import pytest
import torch
from demo_motions import minimum_jerk, turning_motion
from dmp_oracle import forcing
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from hrc_learn.dmp import OrientationDMP
from hrc_learn.dmp.orientation_error import angular_velocity
from hrc_learn.dmp.ude_formulation import UdePrimitive, _state_operator
from hrc_learn.geometry import quaternion
from hrc_learn.geometry.quaternion import axis_drift, drift_free_rate

pytestmark = pytest.mark.simulation

GOAL = quaternion.exp(torch.tensor([0.9, -0.7, 0.6], dtype=torch.float64))
TURN_RATE = torch.tensor([1.5, -2.0, 0.5], dtype=torch.float64)


@pytest.fixture(scope="module")
def dmp():
    # One of the tests differentiates it.
    with torch.inference_mode(False):
        return OrientationDMP.fit(*turning_motion(), n_basis=15, formulation="ude", approach=0)


def printed(dmp, start, velocity, goal, duration, times):
    """(q, omega) at `times` by an adaptive solver of the equation as Ude et al. print it."""
    motion, spring = dmp.motion, dmp.motion.spring
    weights = motion.weights.detach().numpy()
    g = Rotation.from_quat(goal.numpy(), scalar_first=True)

    def rhs(t, x):
        w, v, eta = x[0], x[1:4], x[4:]
        q = Rotation.from_quat(x[:4], scalar_first=True)
        force = -weights @ forcing(motion.basis, t / duration)
        error = (g * q.inv()).as_rotvec()
        rate = spring.alpha * (spring.beta * error - eta) + force
        omega = eta / duration
        turn = np.array([-omega @ v, *(w * omega + np.cross(omega, v))]) / 2
        return np.concatenate([turn, rate / duration])

    x0 = np.concatenate([start.numpy(), duration * velocity.numpy()])
    x = solve_ivp(
        rhs, (0, times[-1]), x0, "DOP853", times, rtol=1e-12, atol=1e-12, max_step=0.02
    ).y
    return torch.from_numpy(x[:4].T), torch.from_numpy(x[4:].T / duration)


def test_rollouts_solve_the_printed_equation(dmp):
    times = [0.0, 0.31, 1.0, 1.73, 2.0, 3.1]
    start = quaternion.exp(torch.tensor([-0.4, 0.5, 0.3], dtype=torch.float64))
    expected, omega = printed(dmp, start, TURN_RATE, GOAL, 2.0, times)
    got = dmp.rollout(times, start, GOAL, 2.0, TURN_RATE)
    assert quaternion.angle(got.orientation, expected).max() < 1e-7
    torch.testing.assert_close(got.angular_velocity, omega, rtol=0, atol=1e-6)


def test_steps_are_of_fourth_order(dmp):
    expected, omega = printed(dmp, dmp.start, TURN_RATE, GOAL, 2.0, [0.0, 1.2])
    errors = []
    for n_steps in (6, 12, 24, 120):
        state = dmp.initial_state(None, GOAL, 2.0, TURN_RATE)
        with torch.no_grad():
            for _ in range(n_steps):
                state = dmp.step(state, 1.2 / n_steps)
        errors.append((state.angular_velocity - omega[-1]).norm().item())
    assert quaternion.angle(state.orientation, expected[-1]) < 1e-6
    assert errors[-1] < 1e-7
    orders = np.log2(np.array(errors[:-2]) / errors[1:-1])
    assert ((orders > 3.5) & (orders < 4.5)).all(), orders


def test_a_turn_about_one_axis_is_exact_in_one_step():
    s = torch.linspace(0, 1, 200, dtype=torch.float64)
    axis = torch.tensor([0.0, 0.6, 0.8], dtype=torch.float64)
    q = quaternion.exp((3.0 * minimum_jerk(s))[:, None] * axis)
    log = OrientationDMP.fit(s, q)
    ude = OrientationDMP(UdePrimitive(**log.motion.arguments()), log.goal)
    expected = log.rollout(time=[0.6]).orientation[0]
    got = ude.step(ude.initial_state(), 0.6).orientation
    assert (got - expected).abs().max() < 1e-9


def test_a_long_step_stays_bounded(dmp):
    state = dmp.initial_state(None, GOAL, 1.0)
    for _ in range(20):
        state = dmp.step(state, 5.0)
    assert quaternion.angle(state.orientation, GOAL) < 1e-6


@pytest.mark.parametrize("angle", [60, 181, 190, 270])
def test_turns_past_half_a_turn_are_repeated(angle):
    """The axis wanders, and the logarithm is followed past 180 degrees."""
    time, wander = turning_motion(duration=1.0)
    s = time[:, None]
    way = np.deg2rad(angle) * (1 - minimum_jerk(s)) * torch.tensor([0.0, 0.6, 0.8])
    bump = 0.3 * torch.sin(torch.pi * s) * wander[:, 1:]
    q = quaternion.multiply(quaternion.exp(-way - bump), GOAL)
    dmp = OrientationDMP.fit(time, q, formulation="ude")
    assert quaternion.angle(dmp.rollout().orientation, q).max() < 1e-4


def test_whole_turns_are_refused():
    s = torch.linspace(0, 1, 200, dtype=torch.float64)
    q = quaternion.exp(7.0 * minimum_jerk(s)[:, None] * torch.tensor([0.0, 0.6, 0.8]).double())
    with pytest.raises(ValueError, match="a whole turn or more"):
        OrientationDMP.fit(s, q, formulation="ude")


def test_a_goal_that_jumps_moves_nothing_and_a_filtered_one_pulls_no_harder(dmp):
    state = dmp.step(dmp.initial_state(), 1.2)
    dt = 1e-5

    def acceleration(state, **kwargs):
        later = dmp.step(state, dt, **kwargs)
        return (later.angular_velocity - state.angular_velocity) / dt

    jumped = dmp.step(state, 0.0, goal=GOAL)
    assert quaternion.angle(jumped.orientation, state.orientation) < 1e-7
    torch.testing.assert_close(jumped.angular_velocity, state.angular_velocity)
    before = acceleration(state)
    filtered = acceleration(state, goal=GOAL, goal_filter=8.0)
    torch.testing.assert_close(filtered, before, rtol=0, atol=5e-2)
    assert (acceleration(state, goal=GOAL) - before).norm() > 5
    late = dmp.step(state, 0.02, goal=GOAL, goal_filter=8.0)
    with torch.no_grad():
        for _ in range(40):
            late = dmp.step(late, 0.2, goal_filter=8.0)
    assert quaternion.angle(late.orientation, GOAL) < 1e-6


def test_drift_agrees_with_the_derivative_of_the_exponential():
    rng = torch.Generator().manual_seed(0)
    e = torch.randn(60, 3, generator=rng, dtype=torch.float64)
    e = e * torch.logspace(-9, 0.3, 60, dtype=torch.float64)[:, None]
    e[0] = 0
    rate = torch.randn(60, 3, generator=rng, dtype=torch.float64)
    v = drift_free_rate(e, rate)
    torch.testing.assert_close(v, -angular_velocity(e, rate), rtol=0, atol=1e-12)
    torch.testing.assert_close(v + axis_drift(e, v), rate, rtol=0, atol=1e-11)


@pytest.mark.gradients
def test_angular_acceleration_is_that_of_the_error(dmp):
    t = torch.linspace(0, 1, 501, dtype=torch.float64)
    got = dmp.rollout(t, goal=GOAL)
    numeric = (got.angular_velocity[2:] - got.angular_velocity[:-2]) / (t[2] - t[0])
    torch.testing.assert_close(numeric, got.angular_acceleration[1:-1], rtol=0, atol=1e-2)


def test_files_keep_the_formulation_and_older_ones_have_none(dmp, tmp_path):
    dmp.save(tmp_path)
    assert OrientationDMP.load(tmp_path).formulation == "ude"
    (tmp_path / ".manifest.json").unlink()
    path = tmp_path / "config.json"
    config = json.loads(path.read_text())
    path.write_text(json.dumps(config | {"formulation": "euler"}))
    with pytest.raises(ValueError, match=r"config\.json: field 'formulation': unknown"):
        OrientationDMP.load(tmp_path)
    del config["formulation"]
    path.write_text(json.dumps(config))
    assert OrientationDMP.load(tmp_path).formulation == "log"


def test_unknown_formulations_are_refused():
    with pytest.raises(
        ValueError, match="unknown formulation 'hamilton'; choose from log, ude"
    ):
        OrientationDMP.fit(*turning_motion(), formulation="hamilton")


def test_a_coupling_pushes_the_angular_velocity_as_it_does_in_the_other_formulation(dmp):
    """It is an angular acceleration in the base frame [rad/s^2]."""
    push = torch.tensor([0.8, -0.5, 0.3], dtype=torch.float64)
    dt = 1e-4
    for primitive in (dmp, OrientationDMP.fit(*turning_motion(), n_basis=15, approach=0)):
        state = primitive.initial_state()
        with torch.no_grad():
            free = primitive.step(state, dt).angular_velocity
            pushed = primitive.step(state, dt, coupling=push).angular_velocity
        torch.testing.assert_close(pushed - free, push * dt, rtol=1e-3, atol=1e-9)


def test_jerk_is_refused(dmp):
    with pytest.raises(ValueError, match="'ude' has no jerk"):
        _ = dmp.motion.rollout().jerk


@pytest.fixture(scope="module")
def batch():
    """Three turns of one duration each, with wandering axes."""
    time, q = turning_motion()
    turned = [quaternion.exp(k * quaternion.log(q)) for k in (1.0, 0.6, 1.3)]
    return OrientationDMP.fit(
        torch.stack([k * time for k in (1.0, 1.5, 0.7)]),
        torch.stack(turned),
        n_basis=12,
        formulation="ude",
    )


@pytest.mark.parametrize("own", [False, True], ids=["one grid", "times of their own"])
def test_a_batch_is_a_loop(batch, own):
    time = torch.linspace(0, 0.2, 5, dtype=torch.float64)
    times = torch.stack([time, time.flip(0), 0.8 * time]) if own else time
    together = batch.rollout(times, duration=torch.tensor([1.0, 1.4, 0.6]).double())
    for i, one in enumerate(batch):
        alone = one.rollout(times[i] if own else time, duration=(1.0, 1.4, 0.6)[i])
        for name in ("orientation", "angular_velocity", "angular_acceleration"):
            made, expected = getattr(together, name)[i], getattr(alone, name)
            torch.testing.assert_close(made, expected, rtol=1e-6, atol=1e-6, msg=name)


def test_rates_are_per_second_at_any_duration(dmp):
    """By central differences, with a start that turns."""
    h = 1e-4
    t = torch.tensor([0.3, 1.1, 2.4], dtype=torch.float64)
    grid = (t[:, None] + torch.tensor([-h, 0.0, h])).flatten()
    with torch.no_grad():
        made = dmp.motion.rollout(grid, duration=2.5)
    y, rate, second = (
        x.unflatten(0, (3, 3)) for x in (made.position, made.velocity, made.acceleration)
    )
    central = (y[:, 2] - y[:, 0]) / (2 * h)
    torch.testing.assert_close(rate[:, 1], central, rtol=1e-5, atol=1e-6)
    central = (rate[:, 2] - rate[:, 0]) / (2 * h)
    torch.testing.assert_close(second[:, 1], central, rtol=1e-4, atol=1e-5)


def test_reports_are_of_the_errors_that_were_fitted():
    time, q = turning_motion()
    motion = OrientationDMP.fit(time, q, n_basis=8, formulation="ude").motion
    log = OrientationDMP.fit(time, q, n_basis=8)
    # The other formulation follows the same path, whose samples it was fitted to.
    shown = log.motion.rollout().position
    torch.testing.assert_close(motion.rollout().position, shown, rtol=0, atol=1e-3)
    report, other = motion.fit_report, log.motion.fit_report
    assert ((report.rmse - other.rmse).abs() < 0.3 * other.rmse).all()


@pytest.mark.parametrize(("turn", "refused"), [(6.27, False), (6.3, True)])
def test_the_end_of_a_whole_turn_is_the_limit(turn, refused):
    s = torch.linspace(0, 1, 150, dtype=torch.float64)
    axis = torch.tensor([0.0, 0.6, 0.8], dtype=torch.float64)
    q = quaternion.exp(turn * minimum_jerk(s)[:, None] * axis)
    if refused:
        with pytest.raises(ValueError, match="use 'log'"):
            OrientationDMP.fit(s, q, formulation="ude")
    else:
        dmp = OrientationDMP.fit(s, q, formulation="ude")
        assert quaternion.angle(dmp.rollout().orientation, q).max() < 1e-3


@pytest.mark.gradients
def test_compilers_call_what_runs_otherwise_with_its_gradients(batch):
    """The operators that stand for the integration."""
    motion = batch.motion
    s = torch.tensor([[0.0, 0.012, 0.03, 0.2]] * 3, dtype=torch.float64)
    made = motion.rollout(s * motion.duration[:, None])
    x = made._coordinates.detach()
    found = _state_operator(x, s, motion.response.name)
    torch.testing.assert_close(found, made.integrate())
    small, times = x[:1].clone().requires_grad_(), s[:1, 1:3].clone().requires_grad_()
    assert torch.autograd.gradcheck(
        lambda x, s: _state_operator(x, s, motion.response.name),
        (small, times),
        atol=1e-5,
        fast_mode=True,
    )


def test_coordinates_of_a_motion_that_is_not_linear_are_refused(dmp):
    for call in (dmp.motion.coordinates, dmp.motion.with_coordinates):
        with pytest.raises(ValueError, match="'ude' is not linear: fit with 'log'"):
            call()
