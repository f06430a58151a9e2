import pytest
import torch
from demo_motions import arm_motion
from dmp_oracle import solve
from torch.autograd import gradcheck
from unchecked import shapes_unchecked

from hrc_learn.dmp import JointDMP, MovingGoalDMP

END = torch.tensor([0.8, -1.5, 0.3], dtype=torch.float64)
START, GOAL = torch.tensor([[0.2, -0.4, 0.1], [0.9, 0.3, -0.6]], dtype=torch.float64)


def primitive(**kwargs):
    return JointDMP.fit(
        *arm_motion(n_joints=3, moving_start=True), n_basis=15, **({"approach": 0} | kwargs)
    )


@pytest.mark.parametrize("approach", [0.0, 0.8])
def test_the_end_velocity_is_met_at_the_goal(approach):
    motion = MovingGoalDMP(primitive(approach=approach)).rollout(
        [0.0, 2.0], START, GOAL, 2.0, [0.5, 0.0, -0.5], end_velocity=END
    )
    torch.testing.assert_close(motion.velocity[-1], END, rtol=0, atol=1e-10)
    torch.testing.assert_close(motion.position[0], START)
    torch.testing.assert_close(motion.velocity[0], torch.tensor([0.5, 0.0, -0.5]).double())
    torch.testing.assert_close(motion.position[-1], GOAL, rtol=0, atol=2e-2)


def test_the_demonstrated_end_velocity_changes_nothing():
    dmp = primitive()
    plain = dmp.rollout()
    moving = MovingGoalDMP(dmp).rollout(end_velocity=plain.velocity[-1].detach())
    torch.testing.assert_close(moving.position, plain.position)


def test_rollouts_solve_the_equation():
    dmp, spring = primitive(), primitive().spring
    moving = MovingGoalDMP(dmp)
    times = [0.0, 0.4, 1.0, 1.2]
    state = moving.initial_state(START, GOAL, 2.0, end_velocity=END)
    rates = 2.0 * state.velocity.detach()
    seconds = 2.0 * torch.tensor(times, dtype=torch.float64)
    got = moving.rollout(seconds, START, GOAL, 2.0, end_velocity=END)
    for j in range(3):
        v = 2.0 * state.goal_velocity[j].item()

        def push(s, y, rate, v=v):
            return spring.alpha * (spring.beta * (s - 1) * v + v)

        weights = dmp.weights[j].detach().numpy()
        ends = START[j].item(), rates[j].item(), GOAL[j].item()
        y, rate = solve(spring, dmp.basis, weights, *ends, times, push)
        torch.testing.assert_close(got.position[:, j], torch.tensor(y), rtol=0, atol=1e-8)
        torch.testing.assert_close(
            got.velocity[:, j], torch.tensor(rate / 2), atol=1e-7, rtol=0
        )


@pytest.mark.parametrize("n_steps", [1, 20, 300])
def test_steps_end_where_the_rollout_does(n_steps):
    moving = MovingGoalDMP(primitive())
    state = moving.initial_state(START, GOAL, 2.0, end_velocity=END)
    with torch.no_grad(), shapes_unchecked():
        for _ in range(n_steps):
            state = moving.step(state, 1.7 / n_steps)
    there = moving.rollout([1.7], START, GOAL, 2.0, end_velocity=END)
    torch.testing.assert_close(state.position, there.position[0], rtol=0, atol=1e-9)
    torch.testing.assert_close(state.velocity, there.velocity[0], rtol=0, atol=1e-8)


def test_slowing_down_stays_on_the_path():
    moving = MovingGoalDMP(primitive())
    state = moving.initial_state(START, GOAL, 2.0, end_velocity=END)
    for _ in range(10):
        state = moving.step(state, 0.1, phase_stopping=1.0)
    there = moving.rollout([0.5], START, GOAL, 2.0, end_velocity=END)
    torch.testing.assert_close(state.position, there.position[0])
    torch.testing.assert_close(2 * state.velocity, there.velocity[0])


def test_batches_broadcast_and_gradients_are_exact():
    moving = MovingGoalDMP(primitive())
    ends = torch.stack([END, -END, 0 * END])
    together = moving.rollout([0.3, 1.1], START, GOAL, 2.0, end_velocity=ends)
    assert together.position.shape == (3, 2, 3)
    alone = moving.rollout([0.3, 1.1], START, GOAL, 2.0, end_velocity=-END)
    torch.testing.assert_close(together.position[1], alone.position)

    def outputs(end, start, goal, duration):
        motion = moving.rollout([0.3, 1.1], start, goal, duration, end_velocity=end)
        return motion.position, motion.velocity

    duration = torch.tensor(2.0, dtype=torch.float64)
    inputs = [x.clone().requires_grad_() for x in (END, START, GOAL, duration)]
    with shapes_unchecked():
        assert gradcheck(outputs, inputs, atol=1e-6, rtol=1e-6)


def test_acceleration_is_the_derivative_of_the_velocity():
    t = torch.linspace(0, 2, 2001, dtype=torch.float64)
    motion = MovingGoalDMP(primitive()).rollout(t, START, GOAL, 2.0, end_velocity=END)
    numeric = (motion.velocity[2:] - motion.velocity[:-2]) / 2e-3
    torch.testing.assert_close(numeric, motion.acceleration[1:-1], rtol=0, atol=2e-2)


def test_lists_are_taken_at_full_precision():
    moving = MovingGoalDMP(primitive())
    from_list = moving.rollout([1.0], START.tolist(), GOAL.tolist(), end_velocity=END.tolist())
    from_tensor = moving.rollout([1.0], START, GOAL, end_velocity=END)
    assert torch.equal(from_list.position, from_tensor.position)


def test_forcing_that_scales_with_the_start_is_refused():
    with pytest.raises(ValueError, match="a moving goal needs"):
        MovingGoalDMP(primitive(scaling="paper"))


def test_a_saved_primitive_is_the_same(tmp_path):
    moving = MovingGoalDMP(primitive())
    moving.save(tmp_path / "model")
    loaded = MovingGoalDMP.load(tmp_path / "model")
    torch.testing.assert_close(loaded.start, moving.rollout(end_velocity=END).position[0])
    torch.testing.assert_close(loaded.goal, primitive().goal)
    there, here = (dmp.rollout(end_velocity=END).position for dmp in (loaded, moving))
    torch.testing.assert_close(there, here, rtol=0, atol=0)
