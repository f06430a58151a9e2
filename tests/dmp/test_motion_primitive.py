"""Behaviour of every kind of primitive, in addition to `dmp_contract.py`."""

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
    fit_rhythmic,
    fit_rhythmic_pose,
    mean_primitive,
    stack,
)
from hrc_learn.dmp.exported_dmp import export_dmp, resting_inputs, state_tensors
from hrc_learn.dmp.motion_primitive import MotionPrimitive
from hrc_learn.geometry import Pose, quaternion

TIME, POSITION = arm_motion(n_samples=120, n_joints=5, moving_start=True)
TURN = turning_motion(n_samples=120)[1]
ROUND = torch.linspace(0, 2, 120, dtype=torch.float64)
SWING = 0.3 * torch.sin(2 * torch.pi * ROUND[:, None] * torch.ones(3))


KINDS = {
    "joint": lambda: JointDMP.fit(TIME, POSITION, 12),
    "orientation": lambda: OrientationDMP.fit(TIME, TURN, 12),
    "pose": lambda: PoseDMP.fit(TIME, POSITION[:, :3], TURN, 12, POSITION[:, 3:]),
    "moving goal": lambda: MovingGoalDMP(JointDMP.fit(TIME, POSITION, 12)),
}
RHYTHMS = {
    "rhythm": lambda: fit_rhythmic(ROUND, SWING, 8, period=1.0),
    "rhythm of a pose": lambda: fit_rhythmic_pose(
        ROUND, SWING, quaternion.exp(SWING), 8, period=1.0
    ),
}


@pytest.mark.parametrize("kind", {**KINDS, **RHYTHMS})
def test_every_kind_is_a_motion_primitive(kind):
    assert isinstance({**KINDS, **RHYTHMS}[kind](), MotionPrimitive)


def value_at(motion, k):
    """What a via point of the kind is given as, at sample k of a trajectory."""
    if hasattr(motion, "pose"):
        return motion.pose[..., k : k + 1]
    values = motion.orientation if hasattr(motion, "orientation") else motion.position
    return values[..., k : k + 1, :]


def off(a, b):
    """Largest distance between two values of a kind."""
    if isinstance(a, Pose):
        apart = quaternion.angle(a.orientation, b.orientation).max()
        return max((a.position - b.position).abs().max(), apart).item()
    turns = a.shape[-1] == 4
    return (quaternion.angle(a, b) if turns else (a - b).abs()).max().item()


def moved(value):
    """A value a little beside another."""
    shift = torch.tensor([0.05, -0.03, 0.04], dtype=torch.float64)
    if isinstance(value, Pose):
        turned = quaternion.multiply(quaternion.exp(shift), value.orientation)
        return Pose(value.position + shift, turned)
    if value.shape[-1] == 4:
        return quaternion.multiply(quaternion.exp(shift), value)
    return value + 0.05


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_is_conditioned_on_via_points(kind):
    """It passes them; its ends stay; the primitive it is made from stays as it was."""
    dmp = KINDS[kind]()
    before = dmp.rollout()
    via = moved(value_at(before, 60))
    bent = dmp.condition(TIME[60:61] - TIME[0], via)
    after = bent.rollout()
    assert type(bent) is type(dmp)
    assert off(value_at(after, 60), via) < 1e-7
    for k in (0, 119):
        assert off(value_at(after, k), value_at(before, k)) < 1e-7
    assert off(value_at(dmp.rollout(), 60), value_at(before, 60)) < 1e-15


@pytest.mark.parametrize("kind", KINDS)
def test_ends_can_be_put_into_every_kind(kind):
    dmp = KINDS[kind]()
    given = {"duration": 1.5}
    if kind == "joint":
        given["goal"] = POSITION[-1] + 0.2
    there, own = dmp.rollout(**given), dmp.with_boundary(**given).rollout()
    assert off(value_at(own, 60), value_at(there, 60)) < 1e-9


def test_a_program_without_a_stepper_does_what_the_primitive_does():
    """Programs of joints, orientations and poses are in `test_exported_dmp.py`."""
    dmp = KINDS["moving goal"]()
    with shapes_unchecked():
        exported = export_dmp(dmp)
    assert exported.stepper is None
    program = exported.program.module()
    state = dmp.initial_state(end_velocity=torch.ones(5).double())
    tensors = state_tensors(state)
    for dt, waiting in ((0.05, 0.0), (0.2, 1.0)):
        inputs = resting_inputs(dmp, tensors)
        inputs["phase_stopping"] = inputs["phase_stopping"] + waiting
        inputs["coupling"] = inputs["coupling"] + 0.3
        tensors = program(tensors, torch.tensor([dt], dtype=torch.float64), inputs)
        state = dmp.step(state, dt, coupling=inputs["coupling"][0], phase_stopping=waiting)
        for name, value in state_tensors(state).items():
            torch.testing.assert_close(tensors[name], value, rtol=1e-9, atol=1e-9, msg=name)


@pytest.mark.parametrize("kind", ["joint", "orientation", "moving goal"])
def test_arguments_of_other_kinds_are_refused(kind):
    dmp = KINDS[kind]()
    with pytest.raises(ValueError, match="has no goal_body"):
        dmp.rollout(goal_body=[0.1])
    with pytest.raises(ValueError, match="has no goal_body"):
        dmp.step(dmp.initial_state(), 0.1, goal_body=[0.1])
    with pytest.raises(ValueError, match="has no end_velocity"):
        KINDS["pose"]().initial_state(end_velocity=[0.1])


@pytest.mark.parametrize("kind", KINDS)
def test_outputs_that_require_gradients_can_be_plotted(kind):
    dmp = KINDS[kind]()
    motion = dmp.rollout()
    for name, expected in motion.numpy().items():
        values = getattr(motion, name)
        assert np.array_equal(np.asarray(values), expected), name
        assert np.array_equal(np.asarray(values[3:, ...]), expected[3:]), name
    first = motion.position if hasattr(motion, "position") else motion.orientation
    assert first.requires_grad
    first.square().sum().backward()
    assert dmp.motion.weights.grad.abs().max() > 0


@pytest.mark.parametrize("kind", {**KINDS, **RHYTHMS})
def test_no_motions_and_no_times_give_empty_results(kind):
    dmp = {**KINDS, **RHYTHMS}[kind]()
    none, T = stack([dmp, dmp])[:0], len(ROUND)
    for arguments, count in (
        ({}, T),
        ({"time": ROUND}, T),
        ({"time": ROUND.expand(0, -1)}, T),
        ({"dt": 0.1}, 1),
    ):
        for name, values in none.rollout(**arguments).numpy().items():
            assert values.shape[:2] == (0, count), name
    state = none.step(none.step(none.initial_state(), 0.1), 0.1, phase_stopping=1.0)
    assert len(state.position if hasattr(state, "position") else state.orientation) == 0
    for some in (dmp, stack([dmp, dmp])):
        for name, values in some.rollout([]).numpy().items():
            assert values.shape[:-1] == (*some.duration.shape, 0)[: values.ndim - 1], name
    # A grid without times has as many bytes as any other, which must not mix them up.
    assert dmp.rollout(ROUND).numpy()["time"].shape == (T,)
    with pytest.raises(ValueError, match="no primitives to average"):
        mean_primitive(none)


def test_times_in_another_shape_are_another_grid():
    """The matrices of one grid are kept; a batch of times may hold the same bytes."""
    dmp, time = KINDS["joint"](), TIME - TIME[0]
    for some in (dmp, stack([dmp, dmp])):
        whole = some.rollout(time).position
        parts = some.rollout(time.view(2, 60)).position
        assert parts.shape == (2, 60, 5)
        expected = whole.view(-1, 2, 60, 5)
        expected = expected[0] if some is dmp else expected[[0, 1], [0, 1]]
        torch.testing.assert_close(parts, expected, rtol=0, atol=1e-9)


def test_an_array_of_an_output_is_a_copy():
    motion = KINDS["joint"]().rollout()
    before = motion.numpy()["position"].copy()
    array = np.array(motion.position)
    array += 1.0
    np.testing.assert_array_equal(motion.numpy()["position"], before)
    assert np.shares_memory(np.asarray(motion.position), motion.position.detach().numpy())
    assert np.asarray(motion.position, dtype=np.float32).dtype == np.float32


@pytest.mark.parametrize(
    ("kind", "use", "message"),
    [
        ("pose", {"coupling": [1.0] * 4}, r"coupling must have shape \(..., 6\), got \(4,\)"),
        ("pose", {"coupling": [1.0]}, r"coupling must have shape \(..., 6\), got \(1,\)"),
        ("pose", {"coupling": 1.0}, r"coupling must have shape \(..., 6\), got \(\)"),
        ("pose", {"goal_body": [1.0]}, r"goal_body must have shape \(..., 2\), got \(1,\)"),
        (
            "orientation",
            {"coupling": [1.0]},
            r"coupling must have shape \(..., 3\), got \(1,\)",
        ),
        ("ude", {"coupling": [1.0]}, r"coupling must have shape \(..., 3\), got \(1,\)"),
    ],
)
@shapes_unchecked()
def test_steps_refuse_other_numbers_of_columns(kind, use, message):
    ude = {"ude": lambda: OrientationDMP.fit(TIME, TURN, 12, formulation="ude")}
    dmp = (KINDS | ude)[kind]()
    with pytest.raises(ValueError, match=message):
        dmp.step(dmp.initial_state(), 0.1, **use)


@shapes_unchecked()
def test_steps_refuse_a_goal_with_one_coordinate():
    dmp, goal = KINDS["pose"](), Pose(torch.ones(1), TURN[0])
    with pytest.raises(ValueError, match=r"position of goal must have shape \(..., 3\)"):
        dmp.step(dmp.initial_state(), 0.1, goal=goal)


@pytest.mark.parametrize(("kind", "size"), [("pose", 6), ("orientation", 3)])
@pytest.mark.parametrize("given", [1, 4])
@shapes_unchecked()
def test_rollouts_refuse_start_velocities_of_another_size(kind, size, given):
    message = rf"start_velocity must have shape \(..., {size}\), got \({given},\)"
    with pytest.raises(ValueError, match=message):
        KINDS[kind]().rollout(start_velocity=torch.ones(given))
