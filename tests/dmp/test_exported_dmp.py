"""Exported primitives: NumPy steppers and traced programs against the eager step."""

import numpy as np
import pytest
import torch
from demo_motions import arm_motion, turning_motion

from hrc_learn.dmp import (
    JointDMP,
    MovingGoalDMP,
    OrientationDMP,
    PoseDMP,
    Stepper,
)
from hrc_learn.dmp.exported_dmp import (
    StepModule,
    export_dmp,
    load_stepper,
    resting_inputs,
    state_tensors,
)
from hrc_learn.geometry import Pose, quaternion

pytestmark = pytest.mark.simulation


def make(kind, **options):
    time, position = arm_motion(moving_start=True)
    orientation = turning_motion()[1]
    if kind == "joint":
        return JointDMP.fit(time, position, 20, **options)
    if kind == "orientation":
        return OrientationDMP.fit(time, orientation, 20, **options)
    return PoseDMP.fit(time, position[:, :3], orientation, 20, position[:, 3:5], **options)


@pytest.fixture(scope="module")
def exported():
    """Of joints; tracing takes its time."""
    return export_dmp(make("joint"), goal_filter=6.0)


def eager_arguments(inputs):
    """Inputs of a program as the step of a primitive takes them."""
    arguments = dict(inputs)
    if "goal_position" in arguments:
        goal = Pose(arguments.pop("goal_position"), arguments.pop("goal_orientation"))
        arguments["goal"] = goal
    return arguments


@pytest.mark.parametrize(
    "kind",
    [
        "joint",
        pytest.param("orientation", marks=pytest.mark.slow),
        pytest.param("pose", marks=pytest.mark.slow),
    ],
)
def test_a_program_does_what_the_primitive_does(kind, exported):
    """In a batch that it was not traced with, over goals, pushes and slow-downs."""
    batch, goal_filter = 2, 6.0
    if kind != "joint":
        exported = export_dmp(make(kind), goal_filter=goal_filter)
    dmp, program = exported.dmp, exported.program.module()
    rng = np.random.default_rng(2)
    state = dmp.initial_state(duration=torch.tensor(rng.uniform(1, 3, batch)))
    tensors = state_tensors(state)
    for _ in range(5):
        changes = {
            name: torch.tensor(rng.uniform(0.5, 1, value.shape))
            for name, value in resting_inputs(dmp, tensors).items()
        }
        dt = torch.tensor(rng.uniform(0.001, 0.2, batch))
        tensors = program(tensors, dt, changes)
        state = dmp.step(state, dt, goal_filter=goal_filter, **eager_arguments(changes))
        expected = state_tensors(state)
        assert tensors.keys() == expected.keys()
        for name, value in expected.items():
            torch.testing.assert_close(tensors[name], value, rtol=1e-12, atol=1e-12, msg=name)


def test_a_goal_that_stays_changes_nothing_a_whole_turn_away():
    """There an error cannot hold all of an angular velocity, but need not be made anew."""
    s = torch.linspace(0, 1, 100, dtype=torch.float64)
    error = torch.stack([2 * torch.pi * (1 - s), s * (1 - s), 0 * s], dim=-1)
    dmp = OrientationDMP(JointDMP.fit(s, error, 10), quaternion.exp(0 * error[0]))
    state = dmp.initial_state()
    assert state.motion.rate[1].abs() > 0.9
    tensors = state_tensors(state)
    dt = torch.tensor([0.1], dtype=torch.float64)
    after = StepModule(dmp, None)(tensors, dt, resting_inputs(dmp, tensors))
    expected = state_tensors(dmp.step(state, 0.1))
    torch.testing.assert_close(after, expected, rtol=0, atol=1e-8)


def test_resting_inputs_change_nothing(exported):
    dmp, program = exported.dmp, exported.program.module()
    state = dmp.initial_state()
    tensors = state_tensors(state)
    for dt in (0.1, 0.4):
        step = torch.tensor([dt], dtype=torch.float64)
        tensors = program(tensors, step, resting_inputs(dmp, tensors))
        state = dmp.step(state, dt)
    torch.testing.assert_close(tensors["position"][0], state.position, rtol=0, atol=1e-12)


def test_an_export_is_written_and_read(exported, tmp_path):
    dmp = exported.dmp
    exported.save(tmp_path / "place")
    exported.save(tmp_path / "place")
    program = torch.export.load(tmp_path / "place" / "step.pt2").module()
    assert dmp.weights.requires_grad
    assert {p.name for p in tmp_path.iterdir()} == {"place"}
    state = state_tensors(dmp.initial_state())
    inputs = resting_inputs(dmp, state)
    dt = torch.tensor([0.1], dtype=torch.float64)
    frozen = load_stepper(tmp_path / "place")
    after = frozen.step(frozen.initial_state(), 0.1).position
    np.testing.assert_allclose(
        program(state, dt, inputs)["position"][0].detach(), after, atol=1e-12
    )


def test_what_is_no_export_is_left_alone(exported, tmp_path):
    (tmp_path / "thesis.tex").write_text("precious")
    with pytest.raises(ValueError, match="so it is not overwritten"):
        exported.save(tmp_path)
    assert (tmp_path / "thesis.tex").read_text() == "precious"


def test_what_cannot_be_stepped_is_refused(tmp_path):
    time, position = arm_motion()
    with pytest.raises(ValueError, match="takes one primitive, got a batch"):
        export_dmp(JointDMP.fit(time, torch.stack([position, position])))
    for kind, other in (
        ("MovingGoalDMP", MovingGoalDMP(make("joint"))),
        ("PoseDMP", make("pose")),
    ):
        with pytest.raises(ValueError, match=f"takes a JointDMP, got {kind}: use the program"):
            Stepper(other)
    with pytest.raises(ValueError, match="got UdePrimitive"):
        Stepper(make("orientation", formulation="ude").motion)
    with pytest.raises(FileNotFoundError, match="no model was saved here"):
        load_stepper(tmp_path / "nothing")
    make("pose").save(tmp_path / "pose")
    with pytest.raises(ValueError, match=r"config\.json: kind is 'PoseDMP'"):
        load_stepper(tmp_path / "pose")
