"""Steps in closed loop, and motions carried on from any state."""

import dataclasses

import numpy as np
import pytest
import torch
from demo_motions import arm_motion, turning_motion
from dmp_oracle import solve
from unchecked import shapes_unchecked

from hrc_learn.dmp import (
    ContinuedTrajectory,
    GaussianBasis,
    JointDMP,
    MovingGoalDMP,
    OrientationDMP,
    PoseDMP,
    SplineBasis,
    SpringDamper,
    Stepper,
    response_of,
)
from hrc_learn.dmp.closed_loop_step import host_value, uncoupled_step
from hrc_learn.geometry import Pose


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
    dmp = JointDMP.fit(time, position, n_basis=15, approach=0)
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
@pytest.mark.parametrize(("n_steps", "slow"), [(3, 7.0), (3, 0.5), (200, 7.0)])
def test_a_filtered_goal_solves_the_equation(n_steps, slow, spring):
    """As a push of alpha beta (g - target), with g in closed form."""
    time, position = arm_motion(n_joints=1, duration=2.0)
    dmp = JointDMP.fit(time, position, n_basis=15, spring=spring, approach=0)
    start, goal = dmp.start.item(), dmp.goal.item()
    expected = exact(
        dmp,
        start,
        dmp.initial_state().rate.item(),
        1.5,
        (0.0, 0.9),
        lambda s, y, rate: spring.stiffness * (goal - 1.5) * np.exp(-slow * s),
    )
    state = dmp.initial_state()
    for k in range(n_steps):
        change = {"goal": [1.5]} if k == 0 else {}
        state = dmp.step(state, 2.0 * 0.9 / n_steps, goal_filter=slow, **change)
    np.testing.assert_allclose([state.position.item(), state.rate.item()], expected, atol=1e-8)
    assert state.goal.item() == pytest.approx(1.5 + (goal - 1.5) * np.exp(-slow * 0.9))


def test_curvature_is_the_derivative_of_the_rate():
    dmp = primitive()
    behind = dmp.step(dmp.initial_state(), 0.7)
    state = dmp.step(behind, 1e-5)
    ahead = dmp.step(state, 1e-5)
    numeric = (ahead.rate - behind.rate) / 1e-5
    torch.testing.assert_close(numeric, dmp.second_derivative(state), rtol=1e-5, atol=1e-4)


@pytest.mark.parametrize("rate", [0.0, -1.0, 12.5])
def test_impossible_goal_filters_are_refused(rate):
    dmp = primitive()
    with pytest.raises(ValueError, match="goal_filter must be positive and not near a mode"):
        dmp.step(dmp.initial_state(), 0.1, goal=[0.0], goal_filter=rate)


# Steps whose times are read as numbers against those whose times stay tensors


SPRINGS = [
    SpringDamper(),
    SpringDamper(alpha=30.0, beta=2.0),
    SpringDamper(alpha=12.0, beta=20.0),
]


@pytest.mark.parametrize("spring", SPRINGS)
def test_a_step_alone_is_that_of_a_batch(spring):
    """From before the end of the forcing to long after it; a batch is never read."""
    dmp = JointDMP.fit(*arm_motion(moving_start=True), 20, spring=spring, approach=0)
    one, many = dmp.initial_state(), dmp.initial_state(duration=dmp.duration[None])
    for dt in (1e-3, 1.3, 1.3, 0.8, 0.0, 4.0):
        one, many = dmp.step(one, dt), dmp.step(many, dt)
        for name in ("position", "rate", "s", "forced"):
            alone, batched = getattr(one, name), getattr(many, name)[0]
            torch.testing.assert_close(alone, batched, rtol=1e-12, atol=1e-11)


def test_derivatives_by_times_are_kept():
    """Backward, forward and mapped, all through one step of one motion."""
    dmp = JointDMP.fit(*arm_motion(), 12, approach=0)
    state = dmp.step(dmp.initial_state(), 0.4)

    def position(dt):
        return dmp.step(state, dt).position

    dt = torch.tensor(0.2, dtype=torch.float64)
    velocity = dmp.step(state, dt).velocity
    backward = torch.autograd.functional.jacobian(position, dt)
    forward = torch.func.jvp(position, (dt,), (torch.ones_like(dt),))[1]
    torch.testing.assert_close(backward, velocity)
    torch.testing.assert_close(forward, velocity)
    lengths = torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64)
    expected = torch.stack([position(length) for length in lengths])
    torch.testing.assert_close(torch.func.vmap(position)(lengths), expected)


def test_only_single_plain_times_are_read():
    time = torch.tensor(0.5, dtype=torch.float64)
    assert host_value(time) == 0.5
    assert isinstance(host_value(time), float)
    for kept in (time[None], time.clone().requires_grad_()):
        assert host_value(kept) is kept


# Motions carried on


RESPONSE = response_of(SpringDamper(), GaussianBasis(count=12))


def random_primitive(batch: tuple[int, ...], seed: int = 0) -> JointDMP:
    """Three coordinates with weights, ends and durations drawn at random."""
    rng = torch.Generator().manual_seed(seed)

    def draw(*shape: int) -> torch.Tensor:
        return torch.randn((*batch, *shape), generator=rng, dtype=torch.float64)

    return JointDMP(
        weights=100 * draw(3, 12),
        start=draw(3),
        goal=draw(3),
        start_velocity=draw(3),
        duration=1 + draw().abs(),
        amplitude=torch.ones(*batch, 3, dtype=torch.float64),
        timestamps=torch.linspace(0, 1, 5, dtype=torch.float64),
        basis=RESPONSE.basis,
        spring=RESPONSE.spring,
    )


def continued(weights, goal, position, velocity, *, duration, elapsed, time):
    """Position and velocity of a motion from rest at its goal, from another state on."""
    ends = torch.stack([torch.zeros_like(goal), goal, goal], -1)
    since = elapsed.double() / duration
    motion = ContinuedTrajectory(
        coordinates=torch.cat([weights, ends], -1),
        s=since[..., None] + time / duration[..., None],
        duration=duration,
        response=RESPONSE,
        since=since,
        position=position,
        velocity=velocity,
    )
    return motion.position, motion.velocity


@pytest.mark.parametrize("batch", [(), (1,), (2, 3)])
def test_from_the_start_it_is_the_rollout(batch):
    dmp = random_primitive(batch)
    time = torch.linspace(0, 3, 7, dtype=torch.float64)
    y, v = continued(
        dmp.weights,
        dmp.goal,
        dmp.start,
        dmp.start_velocity,
        duration=dmp.duration,
        elapsed=torch.zeros_like(dmp.duration),
        time=time.expand(*batch, -1),
    )
    rollout = dmp.rollout(time)
    torch.testing.assert_close(y, rollout.position, rtol=0, atol=1e-9)
    torch.testing.assert_close(v, rollout.velocity, rtol=0, atol=1e-9)


@pytest.mark.parametrize("elapsed", [0.3, 1.7, 4.0])
def test_of_a_motion_left_alone_it_is_what_follows(elapsed):
    """Cut anywhere, also after its end, a motion goes on as if it had not been."""
    dmp = random_primitive((2,), seed=1)
    ahead = torch.linspace(0, 1, 5, dtype=torch.float64)
    cut = dmp.rollout(torch.tensor([elapsed]))
    y, v = continued(
        dmp.weights,
        dmp.goal,
        cut.position[:, 0],
        cut.velocity[:, 0],
        duration=dmp.duration,
        elapsed=torch.full((2,), elapsed),
        time=ahead.expand(2, -1),
    )
    # The cut is at a float32 time, and all that follows with it.
    whole = dmp.rollout(torch.tensor(elapsed).double() + ahead)
    torch.testing.assert_close(y, whole.position, rtol=0, atol=1e-9)
    torch.testing.assert_close(v, whole.velocity, rtol=0, atol=1e-9)


def test_after_a_push_it_is_what_steps_come_to():
    """The exact steps of the primitive, from the same disturbed state."""
    dmp = random_primitive((), seed=2)
    state = dmp.initial_state()
    for _ in range(10):
        state = dmp.step(state, 0.02, coupling=torch.full((3,), 40.0, dtype=torch.float64))
    time = 0.03 * torch.arange(1, 6, dtype=torch.float64)
    y, v = continued(
        dmp.weights,
        dmp.goal,
        state.position,
        state.velocity,
        duration=dmp.duration,
        elapsed=state.s * dmp.duration,
        time=time,
    )
    for k in range(5):
        state = dmp.step(state, 0.03)
        torch.testing.assert_close(y[k], state.position, rtol=0, atol=1e-9)
        torch.testing.assert_close(v[k], state.velocity, rtol=0, atol=1e-9)


def test_gradients_reach_everything():
    dmp, time = random_primitive((2,), seed=3), torch.tensor([[0.0, 0.4], [0.1, 2.5]]).double()
    arguments = (
        dmp.weights.detach(),
        dmp.goal,
        dmp.start,
        dmp.start_velocity,
        dmp.duration,
        torch.tensor([0.2, 0.5], dtype=torch.float64),
    )

    def motion(w, g, y, v, duration, elapsed):
        return continued(w, g, y, v, duration=duration, elapsed=elapsed, time=time)

    assert torch.autograd.gradcheck(motion, [x.requires_grad_() for x in arguments])


@pytest.mark.parametrize("basis", [GaussianBasis(count=20), SplineBasis(count=20)], ids=str)
def test_steps_without_gradients_are_those_with_them(basis):
    """NumPy and PyTorch do the same sums; past the end of the forcing as before it."""
    time = torch.linspace(0, 2, 200, dtype=torch.float64)
    motion = torch.stack([torch.sin(2 * time), time * torch.cos(time)], dim=-1)
    dmp = JointDMP.fit(time, motion, basis=basis)
    derived = plain = dmp.initial_state()
    for _ in range(30):
        derived = dmp.step(derived, 0.11)
        with torch.no_grad():
            plain = dmp.step(plain, 0.11)
        for name, value in vars(derived).items():
            mine = getattr(plain, name)
            assert mine.shape == value.shape
            assert not mine.requires_grad
            torch.testing.assert_close(mine, value.detach(), rtol=1e-12, atol=1e-12)
    assert plain.s > 1.5
    with torch.inference_mode():
        once = dmp.step(dmp.initial_state(), 0.3)
    again = dmp.step(dmp.initial_state(), 0.3)
    torch.testing.assert_close(once.position, again.position.detach())


def test_a_step_that_the_fast_way_is_not_for_goes_the_other():
    time = torch.linspace(0, 2, 200, dtype=torch.float64)
    wave = torch.sin(2 * time)[:, None]
    for dmp in (
        JointDMP.fit(time, wave, 20, approach=1.0),
        JointDMP.fit(time, wave, 20, scaling="amplitude"),
        JointDMP.fit(time, wave, 20).float(),
        JointDMP.fit(time, torch.stack([wave, 2 * wave]), 20),
    ):
        derived = dmp.step(dmp.step(dmp.initial_state(), 0.4), 0.3)
        with torch.no_grad():
            plain = dmp.step(dmp.step(dmp.initial_state(), 0.4), 0.3)
        torch.testing.assert_close(plain.position, derived.position.detach())


def test_numpy_steps_single_motions_in_float64_without_gradients():
    time = torch.linspace(0, 2, 200, dtype=torch.float64)
    wave = torch.sin(2 * time)[:, None]
    one, several = (JointDMP.fit(time, w, 20) for w in (wave, torch.stack([wave, wave])))

    def stepped(dmp):
        motion = dmp.motion
        return uncoupled_step(dmp.initial_state(), 0.1, motion.response, motion.weights)

    assert stepped(one) is None
    with torch.no_grad():
        assert stepped(one) is not None
        assert stepped(several) is None
        assert stepped(one.float()) is None


def pose_of(position):
    turned = torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=torch.float64)
    return Pose(torch.as_tensor(position, dtype=torch.float64), turned)


@pytest.mark.parametrize("kind", ["joint", "orientation", "pose", "moving goal"])
def test_steps_refuse_what_no_loop_means(kind):
    """Numbers that are no numbers, and time that runs backwards, in the loop of every kind."""
    time, position = arm_motion(n_joints=4, moving_start=True)
    turning = turning_motion()[1]
    dmp = {
        "joint": lambda: JointDMP.fit(time, position, 12),
        "orientation": lambda: OrientationDMP.fit(time, turning, 12),
        "pose": lambda: PoseDMP.fit(time, position[:, :3], turning, 12),
        "moving goal": lambda: MovingGoalDMP(JointDMP.fit(time, position, 12)),
    }[kind]()
    loops = [dmp, Stepper(dmp)] if kind == "joint" else [dmp]
    nan = float("nan")
    bad_goal = {
        "orientation": np.full(4, nan),
        "pose": pose_of([nan, 0.0, 0.0]),
    }.get(kind, np.full(4, nan))
    push = {"orientation": 3, "pose": 3}.get(kind, 4)
    for loop in loops:
        state = loop.initial_state()
        for wrong in (
            {"dt": -0.5},
            {"dt": nan},
            {"dt": 0.01, "phase_stopping": -2.0},
            {"dt": 0.01, "phase_stopping": nan},
            {"dt": 0.01, "coupling": np.full(push, nan)},
            {"dt": 0.01, "goal": bad_goal},
        ):
            with pytest.raises(ValueError, match=r"finite|unit quaternions"):
                loop.step(state, **wrong)
