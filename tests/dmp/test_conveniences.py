"""What makes a primitive easy to hold: batches, times, precision, files, messages."""

import copy
import pickle

import numpy as np
import pytest
import torch
from demo_motions import arm_motion, turning_motion
from unchecked import shapes_unchecked

from hrc_learn.dmp import (
    JointDMP,
    MovingGoalDMP,
    OrientationDMP,
    PoseDMP,
    stack,
)
from hrc_learn.geometry import Pose


def demonstrations(n_samples=60, count=3):
    pairs = [arm_motion(n_samples, n_joints=3, seed=k) for k in range(count)]
    turns = torch.stack([turning_motion(n_samples, seed=k)[1] for k in range(count)])
    time, position = (torch.stack(x) for x in zip(*pairs, strict=True))
    return time, position, turns


def fit_kind(kind):
    time, position, turns = demonstrations()
    if kind is OrientationDMP:
        return kind.fit(time, turns, 8)
    if kind is MovingGoalDMP:
        return kind(JointDMP.fit(time, position, 8))
    columns = (position, turns) if kind is PoseDMP else (position,)
    return kind.fit(time, *columns, 8)


KINDS = (JointDMP, OrientationDMP, PoseDMP, MovingGoalDMP)


@pytest.mark.parametrize("kind", KINDS)
def test_a_batch_is_its_primitives(kind):
    batch = fit_kind(kind)
    assert len(batch) == 3
    assert batch
    assert "functions of GaussianBasis" in repr(batch)
    together = batch.rollout().numpy()
    for i, one in enumerate(batch):
        assert type(one) is kind
        assert one.duration.ndim == 0
        for name, values in one.rollout().numpy().items():
            np.testing.assert_allclose(values, together[name][i], rtol=1e-9, atol=1e-9)
    again = stack([batch[0], batch[1], batch[2]])
    for name, values in again.rollout().numpy().items():
        np.testing.assert_allclose(values, together[name], rtol=1e-9, atol=1e-9)
    assert again.fit_report is not None
    assert batch.fit_report is not None
    torch.testing.assert_close(again.fit_report.rmse, batch.fit_report.rmse)
    torch.testing.assert_close(batch[1:].rollout().time, batch.rollout().time[1:])
    with pytest.raises(TypeError, match="not a batch"):
        len(batch[0])
    with pytest.raises(IndexError):
        batch[3]


def test_one_of_a_batch_has_memory_and_gradients_of_its_own():
    batch = fit_kind(JointDMP)
    one = batch[0]
    assert isinstance(one.weights, torch.nn.Parameter)
    with torch.no_grad():
        one.weights.zero_()
    assert batch.weights[0].abs().max() > 0
    copy.deepcopy(one)


def test_only_primitives_that_are_alike_are_stacked():
    time, position, _ = demonstrations()
    with pytest.raises(ValueError, match=r"but basis is .* in primitive 1"):
        stack([JointDMP.fit(time[0], position[0], n) for n in (8, 9)])
    with pytest.raises(ValueError, match="no primitives"):
        stack([])
    short = JointDMP.fit(time[0, :40], position[0, :40], 8)
    both = stack([JointDMP.fit(time[0], position[0], 8), short])
    own = short.rollout().position
    torch.testing.assert_close(both.rollout().position[1, :40], own)
    torch.testing.assert_close(both.rollout().position[1, 40:], own[-1:].expand(20, -1))


def test_rollouts_every_dt():
    dmp = fit_kind(JointDMP)[0]
    motion = dmp.rollout(dt=0.01, duration=0.35)
    np.testing.assert_allclose(motion.numpy()["time"], 0.01 * np.arange(36), atol=1e-12)
    torch.testing.assert_close(dmp.rollout(dt=0.1, duration=0.35).time[-1].item(), 0.4)
    with pytest.raises(ValueError, match="not both"):
        dmp.rollout([0.0, 1.0], dt=0.1)
    with pytest.raises(ValueError, match="dt must be positive"):
        dmp.rollout(dt=0.0)


@pytest.mark.parametrize("as_array", [torch.as_tensor, np.asarray])
def test_demonstrations_of_any_lengths(as_array):
    time, position, turns = demonstrations()
    lengths = (60, 43, 51)
    times = [as_array(t[:n]) for t, n in zip(time, lengths, strict=True)]
    places = [as_array(x[:n]) for x, n in zip(position, lengths, strict=True)]
    rotations = [as_array(x[:n]) for x, n in zip(turns, lengths, strict=True)]
    joint, pose = JointDMP.fit(times, places, 8), PoseDMP.fit(times, places, rotations, 8)
    turning = OrientationDMP.fit(times, rotations, 8)
    for i, n in enumerate(lengths):
        t, x, q = time[i, :n], position[i, :n], turns[i, :n]
        alone = JointDMP.fit(t, x, 8)
        torch.testing.assert_close(joint.weights[i], alone.weights, rtol=1e-6, atol=1e-6)
        torch.testing.assert_close(joint.duration[i], alone.duration)
        alone = PoseDMP.fit(t, x, q, 8).motion
        torch.testing.assert_close(pose.motion.weights[i], alone.weights, rtol=1e-6, atol=1e-6)
        alone = OrientationDMP.fit(t, q, 8).motion
        torch.testing.assert_close(
            turning.motion.weights[i], alone.weights, rtol=1e-6, atol=1e-6
        )
    with pytest.raises(ValueError, match=r"\[60, 43, 51\] samples"):
        JointDMP.fit(times[::-1], places, 8)


def test_half_precision_is_refused_and_changes_nothing():
    time, position, _ = demonstrations()
    with pytest.raises(ValueError, match="float32 or float64"):
        JointDMP.fit(time, position.half(), 8)
    for kind in (JointDMP, PoseDMP):
        dmp = fit_kind(kind)
        for dtype in (torch.float16, torch.bfloat16):
            with pytest.raises(ValueError, match="float32 or float64"):
                dmp.to(dtype)
        assert {x.dtype for x in dmp.parameters()} == {torch.float64}
        assert dmp.float().motion.rollout().position.dtype == torch.float32


NAN = torch.tensor([0.0, float("nan"), 0.0])


def test_what_is_not_a_number_is_refused():
    dmp = fit_kind(JointDMP)
    state = dmp.initial_state()
    calls = {
        "goal": lambda: dmp.rollout(goal=NAN),
        "start": lambda: dmp.rollout(start=NAN),
        "start_velocity": lambda: dmp.rollout(start_velocity=NAN),
        "duration": lambda: dmp.rollout(duration=float("inf")),
        "speed": lambda: dmp.rollout(speed=float("nan")),
        "goal ": lambda: dmp.step(state, 0.1, goal=NAN),
    }
    for name, call in calls.items():
        with pytest.raises(ValueError, match=name.strip()):
            call()
    pose = fit_kind(PoseDMP)
    with pytest.raises(ValueError, match="position of goal"):
        pose.rollout(goal=Pose(NAN.double(), pose.goal.orientation[0]))
    with pytest.raises(ValueError, match="unit quaternions"):
        fit_kind(OrientationDMP).rollout(goal=[float("nan")] * 4)


@shapes_unchecked()
def test_a_pose_is_a_pose():
    dmp = fit_kind(PoseDMP)
    for call in (dmp.rollout, dmp.initial_state):
        for name in ("start", "goal"):
            with pytest.raises(ValueError, match=f"{name} of a pose primitive must be a Pose"):
                call(**{name: torch.zeros(7)})
    with pytest.raises(ValueError, match="must be a Pose, got Tensor"):
        dmp.step(dmp.initial_state(), 0.1, goal=torch.zeros(7))


@shapes_unchecked()
def test_messages_name_what_does_not_fit():
    dmp = fit_kind(JointDMP)
    for call in (dmp.rollout, dmp.initial_state):
        with pytest.raises(ValueError, match=r"primitive has \(3,\), .*goal \(2,\)"):
            call(goal=torch.zeros(2, 3))
        with pytest.raises(ValueError, match=r"duration \(2,\)"):
            call(duration=torch.ones(2))
    with pytest.raises(ValueError, match=r"time has shape \(2, 5\)"):
        dmp.rollout(torch.zeros(2, 5))


def test_a_pickle_holds_the_tensors_and_no_tables():
    time, position, _ = demonstrations()
    dmp = JointDMP.fit(time, position, 50)
    dmp.rollout(duration=torch.tensor([1.0, 2.0, 3.0]))
    tensors = sum(x.nbytes for x in dmp.state_dict().values())
    tensors += sum(x.nbytes for x in dmp.fit_report.tensors().values())
    data = pickle.dumps(dmp)
    assert len(data) < tensors + 20_000  # names and types; the tables are a megabyte
    again = pickle.loads(data)
    torch.testing.assert_close(again.rollout().position, dmp.rollout().position)
    assert again.response is dmp.response
    assert copy.deepcopy(dmp).response is dmp.response


def test_gradients_reach_weights_that_are_a_leaf():
    dmp = fit_kind(JointDMP)[0]
    leaf = dmp.weights.detach().clone().requires_grad_()
    parts = {name: getattr(dmp, name) for name in ("start", "goal", "start_velocity")}
    parts |= {name: getattr(dmp, name) for name in ("duration", "amplitude", "timestamps")}
    made = JointDMP(weights=leaf, basis=dmp.basis, spring=dmp.spring, **parts)
    made.rollout().position.sum().backward()
    assert leaf.grad is not None
    assert leaf.grad.abs().max() > 0
    kept = JointDMP(weights=dmp.weights, basis=dmp.basis, spring=dmp.spring, **parts)
    assert kept.weights is dmp.weights


def test_forward_derivatives():
    dmp = fit_kind(JointDMP)[0]
    one = torch.ones((), dtype=torch.float64)

    def stepped(dt):
        return dmp.step(dmp.initial_state(), dt).position

    def ended(goal):
        return dmp.rollout(goal=goal).position

    at = 0.1 * one
    rate = torch.func.jvp(stepped, (at,), (one,))[1]
    h = 1e-6
    torch.testing.assert_close(
        rate, (stepped(at + h) - stepped(at - h)) / (2 * h), rtol=1e-6, atol=1e-6
    )
    direction = torch.ones_like(dmp.goal)
    rate = torch.func.jvp(ended, (dmp.goal,), (direction,))[1]
    torch.testing.assert_close(rate, ended(dmp.goal + 1) - ended(dmp.goal))
