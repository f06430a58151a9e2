"""What each scaling of the forcing term promises, for every start and goal."""

import dataclasses
from functools import cache

import numpy as np
import pytest
import torch
from demo_motions import arm_motion, turning_motion
from dmp_oracle import forcing
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.integrate import solve_ivp
from torch.autograd import gradcheck
from unchecked import shapes_unchecked

from hrc_learn.dmp import JointDMP, PoseDMP, Stepper, mean_primitive
from hrc_learn.dmp.forcing_scale import SCALINGS, find_scaling
from hrc_learn.geometry import Pose

quick = settings(max_examples=30)
angles = st.floats(-3.1, 3.1)
growths = st.floats(0.1, 10)
plane = arrays("float64", 2, elements=st.floats(-3, 3)).map(torch.from_numpy)
names = st.sampled_from(list(SCALINGS))
TIME, POSITION = arm_motion(n_samples=60, n_joints=3, moving_start=True)


@cache
def primitive(scaling, columns=3, approach=0.0):
    """Fitted once: hypothesis asks for starts and goals, not for demonstrations."""
    return JointDMP.fit(TIME, POSITION[:, :columns], 8, scaling=scaling, approach=approach)


def close(a, b, atol=1e-9):
    torch.testing.assert_close(a, b, rtol=1e-9, atol=atol)


def rotation_in_plane(angle):
    c, s = np.cos(angle), np.sin(angle)
    return torch.tensor([[c, -s], [s, c]])


def minimal_rotation(a, b):
    """Rodrigues' formula, in space: about a x b by the angle between them."""
    a, b = a / a.norm(), b / b.norm()
    axis = torch.linalg.cross(a, b)
    zero = torch.zeros((), dtype=a.dtype)
    x, y, z = axis
    K = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).view(3, 3)
    return torch.eye(3, dtype=a.dtype) + K + K @ K / (1 + a @ b)


# What is promised


@quick
@given(angle=angles, growth=growths, shift=plane)
def test_a_motion_turns_grows_and_moves_with_its_ends(angle, growth, shift):
    """In a plane, for every rotation, with nothing but start and goal given."""
    dmp, R = primitive("rotation", 2, 0.6), growth * rotation_in_plane(angle)
    plain = dmp.rollout()
    moved = dmp.rollout(start=R @ dmp.start + shift, goal=R @ dmp.goal + shift)
    close(moved.position, plain.position @ R.mT + shift)
    close(moved.velocity, plain.velocity @ R.mT)
    close(moved.acceleration, plain.acceleration @ R.mT, 1e-7)


@quick
@given(
    start=arrays("float64", 3, elements=st.floats(-2, 2)),
    way=arrays("float64", 3, elements=st.floats(0.2, 2)),
    sign=st.sampled_from([1, -1]),
)
def test_in_space_it_turns_as_little_as_its_way(start, way, sign):
    dmp = primitive("rotation")
    start, way = torch.from_numpy(start), sign * torch.from_numpy(way)
    shown = dmp.goal - dmp.start
    R = way.norm() / shown.norm() * minimal_rotation(shown, way)
    moved = dmp.rollout(start=start, goal=start + way).position
    close(moved, (dmp.rollout().position - dmp.start) @ R.mT + start, 1e-6)


@quick
@given(scaling=names, shift=arrays("float64", 3, elements=st.floats(-5, 5)))
def test_a_motion_moves_with_its_ends(scaling, shift):
    dmp, shift = primitive(scaling), torch.from_numpy(shift)
    moved = dmp.rollout(start=dmp.start + shift, goal=dmp.goal + shift)
    close(moved.position, dmp.rollout().position + shift)


@quick
@given(factor=arrays("float64", 3, elements=st.floats(-4, 4)))
def test_the_papers_scaling_stretches_each_coordinate_with_its_way(factor):
    dmp, factor = primitive("paper"), torch.from_numpy(factor)
    stretched = dmp.rollout(
        goal=dmp.start + factor * (dmp.goal - dmp.start),
        start_velocity=factor * dmp.start_velocity,
    )
    close(stretched.position - dmp.start, factor * (dmp.rollout().position - dmp.start))


@quick
@given(factor=st.floats(0.01, 100), scaling=st.sampled_from(["paper", "amplitude"]))
def test_weights_without_a_unit_do_not_depend_on_the_demonstrations_size(factor, scaling):
    scaled = JointDMP.fit(TIME, factor * POSITION, 8, scaling=scaling, approach=0)
    close(scaled.weights, primitive(scaling).weights, 1e-6)


@quick
@given(scaling=names, stretch=st.floats(0.05, 20))
def test_the_path_does_not_depend_on_the_duration(scaling, stretch):
    dmp = primitive(scaling)
    goal = dmp.goal + 0.3
    slow = dmp.rollout(goal=goal, duration=stretch * dmp.duration)
    close(slow.position, dmp.rollout(goal=goal).position)
    close(stretch * slow.velocity, dmp.rollout(goal=goal).velocity)


@quick
@given(
    scaling=names,
    goal=arrays("float64", 3, elements=st.floats(-3, 3)),
    push=arrays("float64", 3, elements=st.floats(-3, 3)),
)
def test_the_goal_is_reached_from_any_perturbation(scaling, goal, push):
    dmp, goal, push = primitive(scaling), torch.from_numpy(goal), torch.from_numpy(push)
    state = dmp.step(dmp.initial_state(goal=goal), 0.4)
    state = dataclasses.replace(state, position=state.position + push, rate=50 * push)
    close(dmp.step(state, 1e3).position, goal, 1e-6)


@quick
@given(scaling=names, goals=arrays("float64", (3, 3), elements=st.floats(-2, 2)))
def test_a_batch_of_goals_is_a_loop(scaling, goals):
    dmp, goals = primitive(scaling), torch.from_numpy(goals)
    together = dmp.rollout(goal=goals).position
    state = dmp.step(dmp.initial_state(goal=goals), 0.7)
    for i, goal in enumerate(goals):
        close(together[i], dmp.rollout(goal=goal).position)
        close(state.position[i], dmp.step(dmp.initial_state(goal=goal), 0.7).position)


# Where turning is delicate


@pytest.mark.parametrize("tilt", [0.0, 1e-9, 1e-4, 2e-3, 0.1])
def test_a_way_back_is_finite_and_reached_and_has_gradients(tilt):
    dmp = primitive("rotation")
    way = dmp.goal - dmp.start
    across = torch.linalg.cross(way, torch.tensor([0.3, -0.5, 0.8], dtype=torch.float64))
    goal = (dmp.start - way + tilt * across).requires_grad_()
    motion = dmp.rollout(goal=goal)
    size = (motion.position - dmp.start).norm(dim=-1)
    close(size, (dmp.rollout().position - dmp.start).norm(dim=-1), 1e-3 + 2 * tilt)
    (gradient,) = torch.autograd.grad(motion.position.sum(), goal)
    assert gradient.isfinite().all()


def test_no_way_at_all_is_a_motion_without_forcing():
    dmp = primitive("rotation")
    goal = dmp.start.clone().requires_grad_()
    motion = dmp.rollout(goal=goal)
    close(motion.position, dmp.start.expand_as(motion.position))
    (gradient,) = torch.autograd.grad(motion.position.sum(), goal)
    assert gradient.isfinite().all()


@pytest.mark.parametrize("turn", [1.0, -1.0])
def test_gradients_are_exact(turn):
    dmp = JointDMP.fit(TIME[::3], POSITION[::3], 4, scaling="rotation", approach=0.5)
    dmp.forward = dmp.rollout

    def outputs(weights, start, goal, duration):
        kwargs = {"start": start, "goal": goal, "duration": duration, "time": [0.2, 1.1, 2.0]}
        moved = torch.func.functional_call(dmp, {"weights": weights}, (), kwargs)
        return moved.position, moved.velocity

    goal = dmp.start + turn * (dmp.goal - dmp.start) + 0.1
    inputs = (dmp.weights, dmp.start, goal, dmp.duration)
    inputs = tuple(x.detach().clone().requires_grad_() for x in inputs)
    with shapes_unchecked():
        assert gradcheck(outputs, inputs, atol=1e-6)


# Steps, in every scaling


@pytest.mark.parametrize("n_steps", [20, 400])
@pytest.mark.parametrize("scaling", SCALINGS)
def test_steps_solve_the_equation(scaling, n_steps):
    """Against an adaptive solver, to a goal that jumps half way."""
    dmp, spring = primitive(scaling), primitive(scaling).spring
    weights, start, shown = dmp.weights.detach(), dmp.start, dmp.goal - dmp.start

    def scaled(goal):
        """The weights times what the scaling's definition says."""
        way = goal - start
        if scaling == "rotation":
            return way.norm() / shown.norm() * minimal_rotation(shown, way) @ weights
        factor = {"none": 1.0, "amplitude": dmp.amplitude, "paper": way}[scaling]
        return (torch.as_tensor(factor).expand(3)[:, None] * weights).numpy()

    def solve(x, goal, span):
        W, g = np.asarray(scaled(goal)), goal.numpy()

        def rhs(s, x):
            y, rate = x.reshape(2, 3)
            pull = spring.alpha * (spring.beta * (g - y) - rate)
            return np.concatenate([rate, pull + W @ forcing(dmp.basis, s)])

        options = {"rtol": 1e-12, "atol": 1e-12, "max_step": 0.02}
        return solve_ivp(rhs, span, x, "DOP853", **options).y[:, -1]

    goals = dmp.goal + 0.4, dmp.goal * torch.tensor([0.5, 2.0, -1.0]) - 0.3
    state = dmp.initial_state(goal=goals[0])
    x = torch.cat([state.position, state.rate]).detach().numpy()
    x = solve(solve(x, goals[0], (0.0, 0.5)), goals[1], (0.5, 1.1))
    # Unchecked: hundreds of steps with all their shapes checked take seconds.
    with torch.no_grad(), shapes_unchecked():
        for k in range(n_steps):
            first = k < n_steps // 2
            dt = (0.5 if first else 0.6) / (n_steps // 2) * dmp.duration
            state = dmp.step(state, dt, goal=goals[0 if first else 1])
    got = torch.cat([state.position, state.rate]).numpy()
    np.testing.assert_allclose(got, x, rtol=0, atol=1e-8)


def test_a_filtered_goal_that_scales_the_forcing_is_of_first_order():
    dmp = primitive("rotation")

    def end(n_steps):
        state = dmp.initial_state()
        for _ in range(n_steps):
            state = dmp.step(state, 2.0 / n_steps, goal=dmp.goal + 0.5, goal_filter=5.0)
        return state.position

    with torch.no_grad(), shapes_unchecked():
        finest = end(400)
        errors = [(end(n) - finest).norm().item() for n in (20, 40, 80)]
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert ((orders > 0.9) & (orders < 1.3)).all(), orders


def test_curvature_is_the_derivative_of_the_rate():
    dmp = primitive("rotation")
    behind = dmp.step(dmp.initial_state(goal=dmp.goal + 0.4), 0.7)
    state = dmp.step(behind, 1e-5)
    ahead = dmp.step(state, 1e-5)
    numeric = (ahead.rate - behind.rate) / (2e-5 / dmp.duration)
    torch.testing.assert_close(numeric, dmp.second_derivative(state), rtol=1e-5, atol=1e-4)


@pytest.mark.parametrize("columns", [None, 2])
@pytest.mark.parametrize("scaling", SCALINGS)
def test_a_stepper_does_what_the_primitive_does(scaling, columns):
    dmp = JointDMP.fit(TIME, POSITION, 8, scaling=find_scaling(scaling, columns))
    stepper, goals = Stepper(dmp), (dmp.goal + 0.3, -dmp.goal)
    ends = {"start": dmp.start + 0.1, "goal": goals[0]}
    state = dmp.initial_state(**ends)
    array = stepper.initial_state(**{k: v.numpy() for k, v in ends.items()})
    for k in range(30):
        change = {} if k < 15 else {"goal": goals[1]}
        state = dmp.step(state, 0.07, **change)
        array = stepper.step(array, 0.07, **{k: v.numpy() for k, v in change.items()})
        np.testing.assert_allclose(array.position, state.position.detach(), atol=1e-9)
        np.testing.assert_allclose(array.velocity, state.velocity.detach(), atol=1e-9)


# Some coordinates only


@pytest.mark.parametrize("scaling", SCALINGS)
def test_the_other_coordinates_are_left_alone(scaling):
    part = JointDMP.fit(TIME, POSITION, 8, scaling=find_scaling(scaling, columns=2))
    goal = part.goal + torch.tensor([0.4, -0.2, 0.5], dtype=torch.float64)
    moved = part.rollout(goal=goal.expand(4, 3)).position
    first = JointDMP.fit(TIME, POSITION[:, :2], 8, scaling=scaling).rollout(goal=goal[:2])
    last = JointDMP.fit(TIME, POSITION[:, 2:], 8, approach=part.response.approach).rollout(
        goal=goal[2:]
    )
    expected = torch.cat([first.position, last.position], dim=-1)
    close(moved, expected.expand(4, -1, -1))


@pytest.mark.parametrize("columns", [None, 2])
def test_a_saved_primitive_is_the_same(tmp_path, columns):
    scaling = find_scaling("rotation", columns)
    dmp = JointDMP.fit(TIME, POSITION, 8, scaling=scaling)
    dmp.save(tmp_path / "saved")
    loaded = JointDMP.load(tmp_path / "saved")
    assert loaded.forcing_scale == scaling
    goal = torch.zeros(3, dtype=torch.float64)
    close(loaded.rollout(goal=goal).position, dmp.rollout(goal=goal).position, 0)


# What cannot be


def test_motions_that_end_where_they_start_are_refused():
    there_and_back = torch.cat([POSITION, POSITION.flip(0)])
    time = torch.linspace(0, 2, 120, dtype=torch.float64)
    both = torch.stack([POSITION.repeat_interleave(2, 0), there_and_back])
    with pytest.raises(ValueError, match="demonstration 1: scaling 'rotation' divides by"):
        JointDMP.fit(time, both, 8, scaling="rotation")


@pytest.mark.parametrize("scaling", ["paper", "rotation"])
@pytest.mark.parametrize(("offset", "refused"), [(1.01e-3, False), (0.99e-3, True)])
def test_ends_must_be_a_thousandth_of_the_range_apart(scaling, offset, refused):
    """Each demonstration by its own range; in a rotation by the largest of its columns."""
    s = torch.linspace(0, 1, 60, dtype=torch.float64)
    way = torch.stack([torch.sin(torch.pi * s), s], dim=-1)
    paths = torch.stack([way * size for size in (1.0, 50.0)])
    paths[1, :, 1] *= 0.01 if scaling == "rotation" else 1.0
    ends = torch.linspace(0, offset, 60, dtype=torch.float64)
    if scaling == "rotation":
        # A distance of which the first column is the whole.
        paths[..., 1] = paths[..., 1] * (1 - s)
    span = paths[1, :, 0].max()
    paths[1, :, 0] += span * ends
    paths[0, :, 0] += 0.1 * s
    if not refused:
        JointDMP.fit(TIME[-1] * s, paths, 8, scaling=scaling)
        return
    name = "paper" if scaling == "paper" else "rotation"
    with pytest.raises(ValueError, match=f"demonstration 1: scaling '{name}' divides by"):
        JointDMP.fit(TIME[-1] * s, paths, 8, scaling=scaling)


def test_a_line_cannot_turn():
    with pytest.raises(ValueError, match="2 coordinates or more"):
        JointDMP.fit(TIME, POSITION[:, :1], 8, scaling="rotation")


def test_frames_of_several_demonstrations_have_no_mean():
    dmp = JointDMP.fit(TIME, torch.stack([POSITION, -POSITION]), 8, scaling="rotation")
    with pytest.raises(ValueError, match="each primitive in a different frame"):
        mean_primitive(dmp)


def test_the_place_of_a_pose_turns_and_its_orientation_and_body_do_not():
    time, orientation = turning_motion(n_samples=60)
    body = arm_motion(n_samples=60, n_joints=2, seed=3)[1]
    options = {"n_basis": 8, "body": body}
    turning = PoseDMP.fit(time, POSITION, orientation, scaling="rotation", **options)
    plain = PoseDMP.fit(time, POSITION, orientation, **options)
    start, way = turning.start.position, turning.goal.position - turning.start.position
    R = 1.5 * minimal_rotation(way, torch.tensor([0.2, 0.9, -0.4], dtype=torch.float64))
    goal = Pose(start + R @ way, turning.goal.orientation)
    moved, same = turning.rollout(goal=goal), plain.rollout(goal=goal)
    close(moved.position, (turning.rollout().position - start) @ R.mT + start)
    close(moved.orientation, same.orientation)
    close(moved.body, same.body)
