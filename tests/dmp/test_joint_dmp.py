import numpy as np
import pytest
import torch
from demo_motions import arm_motion, minimum_jerk
from torch.autograd import gradcheck
from unchecked import shapes_unchecked

from hrc_learn.dmp import JointDMP


def nrmse(a, b):
    return ((a - b).square().mean().sqrt() / (b.amax(-2) - b.amin(-2)).amax()).item()


# Reproduction


@pytest.mark.parametrize("moving_start", [False, True])
@pytest.mark.parametrize(("n_basis", "bound"), [(25, 1e-4), (50, 3e-6)])
def test_defaults_repeat_the_demonstration(n_basis, bound, moving_start):
    time, position = arm_motion(moving_start=moving_start)
    dmp = JointDMP.fit(time, position, n_basis=n_basis)
    trajectory = dmp.rollout()
    assert nrmse(trajectory.position, position) < bound
    assert dmp.fit_report.nrmse.item() == pytest.approx(nrmse(trajectory.position, position))
    torch.testing.assert_close(trajectory.time, time)


@pytest.mark.parametrize(
    ("method", "bound"), [("trajectory", 3e-6), ("ridge", 1e-4), ("lwr", 2e-2)]
)
@pytest.mark.parametrize("scaling", ["none", "paper", "amplitude"])
def test_every_method_reproduces_under_every_scaling(method, bound, scaling):
    time, position = arm_motion()
    dmp = JointDMP.fit(time, position, method=method, scaling=scaling)
    assert dmp.fit_report.nrmse.item() < bound


@pytest.mark.parametrize("method", ["trajectory", "ridge"])
def test_recorded_velocity_is_used(method):
    s = torch.linspace(0, 1, 300, dtype=torch.float64)
    position = torch.sin(3 * s)[:, None]
    velocity = 1.5 * torch.cos(3 * s)[:, None]  # over 2 s
    dmp = JointDMP.fit(2 * s, position, velocity=velocity, method=method)
    assert dmp.start_velocity.item() == pytest.approx(1.5, abs=1e-12)
    # The demonstration stops dead: the motion, which cannot, smooths the last samples.
    reproduced = dmp.rollout().velocity[:-30]
    torch.testing.assert_close(reproduced, velocity[:-30], rtol=0, atol=3e-3)


def test_weights_of_the_papers_regression():
    """Each weight of `lwr` is the weighted mean that the paper prints."""
    time, position = arm_motion(n_joints=1)
    dmp = JointDMP.fit(time, position, n_basis=6, method="lwr", scaling="paper")
    s, y = (time / time[-1]).numpy(), position[:, 0].numpy()
    rate = np.gradient(y, s, edge_order=2)
    force = np.gradient(rate, s, edge_order=2) - 25 * (6.25 * (y[-1] - y) - rate)
    z = np.exp(-4 * s) * (y[-1] - y[0])
    for i in range(6):
        psi = np.exp(-((s - i / 5) ** 2) / (2 * (0.6 / 5) ** 2))
        expected = (z * psi * force).sum() / (z * psi * z).sum()
        assert dmp.weights[0, i].item() == pytest.approx(expected, rel=1e-3)


def test_jittered_stamps_cost_no_accuracy():
    time, _ = arm_motion()
    rng = torch.Generator().manual_seed(1)
    step = time[1] - time[0]
    time = time + 0.4 * step * torch.rand(time.shape, generator=rng, dtype=time.dtype)
    s = (time - time[0]) / (time[-1] - time[0])
    position = minimum_jerk(s)[:, None]
    assert JointDMP.fit(time + 17.0, position).fit_report.nrmse.item() < 3e-6


def test_different_lengths_fit_as_if_alone():
    """Padded and masked demonstrations give the primitives that each alone would."""
    lengths = (400, 250, 317)
    demos = [arm_motion(n, duration=n / 100, seed=n) for n in lengths]
    time = torch.full((3, 400), torch.nan, dtype=torch.float64)
    position = torch.full((3, 400, 7), torch.nan, dtype=torch.float64)
    mask = torch.zeros(3, 400, dtype=torch.bool)
    for i, (t, y) in enumerate(demos):
        time[i, : len(t)], position[i, : len(t)], mask[i, : len(t)] = t, y, True
    dmp = JointDMP.fit(time, position, mask=mask)
    trajectory = dmp.rollout()
    for i, (t, y) in enumerate(demos):
        alone = JointDMP.fit(t, y)
        torch.testing.assert_close(dmp.weights[i], alone.weights)
        torch.testing.assert_close(dmp.fit_report.rmse[i], alone.fit_report.rmse)
        assert nrmse(trajectory.position[i, : len(t)], y) < 3e-6


@pytest.mark.parametrize("method", ["trajectory", "ridge", "lwr"])
def test_lists_of_demonstrations_fit_as_if_alone(method):
    """Times of their own or one grid, and masks in a list; velocities as recorded."""
    time, position = arm_motion(120, n_joints=2)
    other = arm_motion(120, n_joints=2, seed=1)[1]
    mask = [torch.ones(120, dtype=torch.bool), torch.arange(120) < 90]
    shared = JointDMP.fit(time, [position, other], 10, mask=mask, method=method)
    listed = JointDMP.fit([time, time[:90]], [position, other[:90]], 10, method=method)
    for i, end in enumerate((120, 90)):
        alone = JointDMP.fit(time[:end], [position, other][i][:end], 10, method=method)
        for together in (shared, listed):
            torch.testing.assert_close(together.weights[i], alone.weights)
            torch.testing.assert_close(together.duration[i], alone.duration)
    slopes = [torch.gradient(y, spacing=(time,), dim=0)[0] for y in (position, other)]
    both = JointDMP.fit(
        [time, time[:90]],
        [position, other[:90]],
        10,
        velocity=[slopes[0], slopes[1][:90]],
        method=method,
    )
    alone = JointDMP.fit(time[:90], other[:90], 10, velocity=slopes[1][:90], method=method)
    torch.testing.assert_close(both.weights[1], alone.weights)


def test_dropouts_are_bridged():
    time, position = arm_motion()
    mask = torch.ones(400, dtype=torch.bool)
    mask[100:110] = mask[200] = False
    broken = position.masked_fill(~mask[:, None], torch.nan)
    dmp = JointDMP.fit(time, broken, mask=mask)
    assert nrmse(dmp.rollout(time=time).position, position) < 1e-5


# Shapes and types


def test_one_coordinate_may_go_without_its_axis():
    time, position = arm_motion(n_joints=1)
    plain = JointDMP.fit(time, position[:, 0]).rollout().position
    torch.testing.assert_close(plain, JointDMP.fit(time, position).rollout().position)


def test_numpy_and_float32_are_taken_as_they_are():
    time, position = arm_motion()
    dmp = JointDMP.fit(time.numpy(), position.numpy().astype(np.float32))
    assert dmp.weights.dtype == torch.float32
    assert dmp.rollout(goal=np.zeros(7)).position.dtype == torch.float32
    assert nrmse(dmp.rollout().position.double(), position) < 1e-5


@pytest.mark.filterwarnings("error")
def test_read_only_and_reversed_arrays_are_taken():
    time, position = (column.numpy() for column in arm_motion())
    expected = JointDMP.fit(time, position).rollout(goal=np.zeros(7)).position
    backwards = position[::-1].copy()[::-1]
    frozen = time.copy()
    frozen.flags.writeable = False
    got = JointDMP.fit(frozen, backwards).rollout(goal=np.zeros(14)[::-2]).position
    torch.testing.assert_close(got, expected, rtol=0, atol=0)


def test_lists_keep_their_precision():
    time = [0.1 * k for k in range(30)]
    plain = JointDMP.fit(torch.tensor(time, dtype=torch.float64), torch.tensor(time).double())
    listed = JointDMP.fit(time, torch.tensor(time).double())
    torch.testing.assert_close(listed.timestamps, plain.timestamps, rtol=0, atol=0)


@pytest.mark.parametrize("batch", [(2,), (3, 1, 2)])
def test_a_batch_is_a_loop(batch):
    demos = [arm_motion(seed=i) for i in range(int(np.prod(batch)))]
    position = torch.stack([y for _, y in demos]).reshape(*batch, 400, 7)
    dmp = JointDMP.fit(demos[0][0], position)
    goal = torch.linspace(-1, 1, 7, dtype=torch.float64)
    together = dmp.rollout(goal=goal, speed=2.0)
    for i, (t, y) in zip(np.ndindex(batch), demos, strict=True):
        alone = JointDMP.fit(t, y).rollout(goal=goal, speed=2.0)
        for output in ("time", "position", "velocity", "acceleration"):
            torch.testing.assert_close(
                getattr(together, output)[i], getattr(alone, output), rtol=1e-9, atol=1e-9
            )


def test_arguments_broadcast_against_the_batch():
    time, position = arm_motion()
    dmp = JointDMP.fit(time, position)
    goals = torch.zeros(5, 1, 7, dtype=torch.float64)
    durations = torch.tensor([1.0, 2.0, 4.0])
    fan = dmp.rollout(goal=goals, duration=durations)
    for output in (fan.position, fan.velocity, fan.acceleration):
        assert output.shape == (5, 3, 400, 7)
    assert fan.time.shape == (5, 3, 400)
    own_grids = dmp.rollout(time=torch.linspace(0, 1, 11), goal=goals, duration=durations)
    assert own_grids.velocity.shape == (5, 3, 11, 7)
    slow = dmp.rollout(time=torch.linspace(0, 1, 11), goal=goals[0, 0], duration=4.0)
    torch.testing.assert_close(own_grids.position[2, 2], slow.position)


# Reshaping the motion


def test_the_path_does_not_depend_on_the_duration():
    time, position = arm_motion(moving_start=True)
    dmp = JointDMP.fit(time, position)
    normal, fast = dmp.rollout(), dmp.rollout(speed=4.0)
    torch.testing.assert_close(fast.position, normal.position)
    torch.testing.assert_close(fast.velocity, 4 * normal.velocity)
    torch.testing.assert_close(fast.acceleration, 16 * normal.acceleration)
    torch.testing.assert_close(fast.time, normal.time / 4)
    same = dmp.rollout(duration=dmp.duration / 4)
    torch.testing.assert_close(same.position, fast.position, rtol=0, atol=0)


def test_velocity_and_acceleration_are_derivatives_of_position():
    time, position = arm_motion(moving_start=True)
    dmp = JointDMP.fit(time, position)
    t = torch.linspace(0, 4.2, 4201, dtype=torch.float64)
    trajectory = dmp.rollout(time=t, goal=torch.zeros(7), duration=3.5)
    for integral, derivative, bound in (
        (trajectory.position, trajectory.velocity, 1e-4),
        (trajectory.velocity, trajectory.acceleration, 1e-2),
    ):
        central = (integral[2:] - integral[:-2]) / (t[2:] - t[:-2])[:, None]
        torch.testing.assert_close(central, derivative[1:-1], rtol=0, atol=bound)


@pytest.mark.parametrize("scaling", ["none", "paper", "amplitude"])
def test_motion_reaches_any_goal_from_any_start(scaling):
    time, position = arm_motion()
    dmp = JointDMP.fit(time, position, scaling=scaling)
    goal = position[-1] + torch.linspace(-0.5, 0.5, 7, dtype=torch.float64)
    start = position[0] + 0.3
    trajectory = dmp.rollout(time=torch.tensor([0.0, 9.0]), start=start, goal=goal)
    torch.testing.assert_close(trajectory.position[0], start)
    torch.testing.assert_close(trajectory.position[1], goal, rtol=0, atol=1e-6)


@pytest.mark.parametrize("scaling", ["none", "amplitude"])
def test_start_and_goal_may_agree(scaling):
    s = torch.linspace(0, 1, 200, dtype=torch.float64)
    there_and_back = torch.stack([torch.sin(torch.pi * s) ** 2, torch.zeros_like(s)], -1)
    dmp = JointDMP.fit(s, there_and_back, scaling=scaling)
    torch.testing.assert_close(dmp.rollout().position, there_and_back, rtol=0, atol=1e-5)


@pytest.mark.parametrize("scaling", ["paper", "none", "amplitude"])
def test_equivariance_that_each_scaling_promises(scaling):
    time, position = arm_motion()
    dmp = JointDMP.fit(time, position, scaling=scaling)
    moved = dmp.rollout(start=dmp.start + 0.7, goal=dmp.goal + 0.7).position
    torch.testing.assert_close(moved, dmp.rollout().position + 0.7)
    if scaling == "paper":
        doubled = dmp.rollout(
            goal=dmp.start + 2 * (dmp.goal - dmp.start), start_velocity=2 * dmp.start_velocity
        ).position
        torch.testing.assert_close(
            doubled - dmp.start, 2 * (dmp.rollout().position - dmp.start)
        )
    scaled = JointDMP.fit(time, 3 * position, scaling=scaling)
    factor = 3 if scaling == "none" else 1
    torch.testing.assert_close(scaled.weights, factor * dmp.weights, rtol=1e-6, atol=1e-4)


# Gradients


@pytest.mark.parametrize("scaling", ["none", "paper"])
@pytest.mark.parametrize("own_grid", [False, True])
def test_gradients_are_exact(own_grid, scaling):
    time, position = arm_motion(n_samples=30, n_joints=2, moving_start=True)
    dmp = JointDMP.fit(time, position, n_basis=4, scaling=scaling)
    grid = torch.tensor([0.0, 0.5, 2.0, 3.3], dtype=torch.float64) if own_grid else None

    def outputs(weights, start, goal, velocity, duration):
        ends = {"start": start, "goal": goal, "start_velocity": velocity}
        kwargs = ends | {"time": grid, "duration": duration}
        moved = torch.func.functional_call(dmp, {"weights": weights}, (), kwargs)
        return moved.position, moved.velocity, moved.acceleration

    dmp.forward = dmp.rollout
    inputs = (dmp.weights, dmp.start, dmp.goal, dmp.start_velocity, dmp.duration)
    inputs = tuple(x.detach().clone().requires_grad_() for x in inputs)
    with shapes_unchecked():
        assert gradcheck(outputs, inputs, atol=1e-6)


def test_rows_of_times_that_are_equal_have_gradients_of_their_own():
    """By time, position has the velocity for derivative, row by row."""
    dmp = JointDMP.fit(*arm_motion(n_samples=30, n_joints=2), n_basis=4).requires_grad_(False)
    time = torch.tensor([[0.5, 1.7]] * 3, dtype=torch.float64, requires_grad=True)
    motion = dmp.rollout(time=time)
    (gradient,) = torch.autograd.grad(motion.position.sum(), time)
    torch.testing.assert_close(gradient, motion.velocity.sum(-1))


# Bad input


TIME, POSITION = arm_motion(n_samples=20, n_joints=2)


def broken(values, index, value):
    values = values.clone()
    values[index] = value
    return values


@pytest.mark.parametrize(
    ("time", "position", "kwargs", "complaint"),
    [
        (
            TIME,
            broken(POSITION, (7, 1), torch.nan),
            {},
            "position is nan at sample 7, column 1",
        ),
        (broken(TIME, 3, torch.inf), POSITION, {}, "time is inf at sample 3"),
        (broken(TIME, 5, TIME[4]), POSITION, {}, "time must increase.*at sample 5"),
        (TIME.flip(0), POSITION, {}, "time must increase.*at sample"),
        ((TIME + 1e9).float(), POSITION, {}, "time must increase.*large times in float64"),
        (TIME[:-1], POSITION, {}, r"time has shape \(19,\).*must be \(20,\)"),
        (TIME[:2], POSITION[:2], {}, "at least 3 samples, got 2"),
        (TIME, POSITION, {"velocity": POSITION[:3]}, "velocity has shape"),
        (TIME, POSITION, {"velocity": broken(POSITION, (1, 0), torch.inf)}, "velocity is inf"),
        (TIME, POSITION, {"mask": torch.zeros(20)}, "at least 3 samples, got 0"),
        (TIME, POSITION, {"joint_names": ["a"]}, "1 joint names for 2 coordinates"),
        (TIME, POSITION, {"joint_names": ["a", "a"]}, "joint names must differ, but are a, a"),
        (
            TIME,
            POSITION[:, [0, 0]] * 0,
            {"scaling": "paper", "joint_names": ["a"]},
            "1 joint names for 2 coordinates",
        ),
        (TIME, POSITION, {"scaling": "cubic"}, "unknown scaling 'cubic'"),
        (TIME, POSITION, {"method": "magic"}, "unknown method 'magic'"),
        (TIME, torch.zeros(20, 0), {}, "nothing to fit"),
        (TIME, torch.tensor(1.0), {}, r"expected \(T,\) and \(T, D\)"),
        (
            TIME,
            broken(POSITION, (-1, 1), POSITION[0, 1]),
            {"scaling": "paper", "joint_names": ["a", "b"]},
            "divides by goal - start, which is 0 for b",
        ),
    ],
)
def test_bad_demonstrations_are_refused(time, position, kwargs, complaint):
    with shapes_unchecked(), pytest.raises(ValueError, match=complaint):
        JointDMP.fit(time, position, **kwargs)


def test_errors_say_which_demonstration():
    batch = torch.stack([POSITION, broken(POSITION, (4, 0), torch.nan)])
    with pytest.raises(ValueError, match="demonstration 1: position is nan at sample 4"):
        JointDMP.fit(TIME, batch)


@pytest.mark.parametrize(
    ("kwargs", "complaint"),
    [
        ({"goal": torch.zeros(3)}, r"goal must have shape \(\.\.\., 2\), got \(3,\)"),
        ({"start": 1.0}, "start must have shape"),
        ({"duration": 0.0}, "duration must be positive"),
        ({"duration": 1.0, "speed": 1.0}, "not both"),
        ({"time": [-0.1, 0.0]}, "non-negative"),
    ],
)
def test_bad_rollouts_are_refused(kwargs, complaint):
    # Also what the types forbid already: nobody checks those outside of the tests.
    dmp = JointDMP.fit(TIME, POSITION)
    with shapes_unchecked(), pytest.raises(ValueError, match=complaint):
        dmp.rollout(**kwargs)
