"""What is kept between calls never outlives what it was made from."""

import pytest
import torch
from demo_motions import arm_motion

from hrc_learn.dmp import JointDMP


def fitted(seed=0):
    return JointDMP.fit(*arm_motion(n_samples=80, n_joints=2, seed=seed, moving_start=True), 12)


def rebuilt(dmp):
    """The motion of the same numbers, by the definition: no matrices, no caches."""
    rows = dmp.response.evaluate(dmp.timestamps.double())
    return (rows[:, 0] @ dmp.coordinates().double().mT).detach()


@pytest.mark.parametrize("name", ["weights", "start", "goal", "start_velocity", "timestamps"])
@pytest.mark.parametrize("how", ["in place", "data", "load"])
def test_a_change_shows_in_the_next_rollout(name, how):
    dmp = fitted()
    before = dmp.rollout().position
    if how == "load":
        dmp.load_state_dict(dmp.state_dict() | {name: 0.9 * dmp.state_dict()[name]})
    elif how == "data":
        getattr(dmp, name).data.mul_(0.9)
    else:
        with torch.no_grad():
            getattr(dmp, name).mul_(0.9)
    after = dmp.rollout().position
    assert (after - before).abs().max() > 1e-3
    torch.testing.assert_close(after, rebuilt(dmp))


def test_another_precision_shows_in_the_next_rollout():
    dmp = fitted()
    exact = dmp.rollout().position
    single = dmp.to(torch.float32).rollout().position
    assert single.dtype == torch.float32
    torch.testing.assert_close(single.double(), exact, rtol=0, atol=1e-4)
    assert dmp.to(torch.float64).rollout().position.dtype == torch.float64


def test_a_grid_changed_in_place_is_another_grid():
    dmp, time = fitted(), torch.linspace(0, 1, 30, dtype=torch.float64)
    _ = dmp.rollout(time).position
    time += 0.5
    fresh = dmp.rollout(time.clone()).position
    torch.testing.assert_close(dmp.rollout(time).position, fresh, rtol=0, atol=0)


def test_grids_and_primitives_take_turns():
    one, other = fitted(0), fitted(1)
    grids = [torch.linspace(0, end, 20, dtype=torch.float64) for end in (1.0, 2.0)]
    expected = [[dmp.rollout(grid).position for grid in grids] for dmp in (one, other)]
    for _ in range(2):
        for dmp, motions in zip((one, other), expected, strict=True):
            for grid, motion in zip(grids, motions, strict=True):
                torch.testing.assert_close(dmp.rollout(grid).position, motion, rtol=0, atol=0)


def test_no_matrix_holds_numbers_that_make_products_slow():
    """Subnormal ones, which the fading basis functions leave in single precision."""
    dmp = JointDMP.fit(*(column.float() for column in arm_motion(n_joints=2)), 50)
    for matrix in dmp.response.matrices(dmp.timestamps, torch.float32):
        size = matrix.abs()
        assert not ((size > 0) & (size < torch.finfo(torch.float32).tiny)).any()
    exact = dmp.response.evaluate(dmp.timestamps.double())[:, 0]
    position = dmp.response.matrices(dmp.timestamps, torch.float32)[0].mT.double()
    torch.testing.assert_close(position, exact, rtol=0, atol=1e-7)


def test_what_inference_leaves_behind_serves_a_backward_pass():
    """Tables, operators and matrices are shared by all primitives with the same parts."""
    with torch.inference_mode():
        fitted(1).rollout()
    dmp = fitted(1)
    step = dmp.step(dmp.initial_state(), 0.3)
    (dmp.rollout().position.sum() + step.position.sum()).backward()
    assert dmp.weights.grad is not None
    assert dmp.weights.grad.isfinite().all()
