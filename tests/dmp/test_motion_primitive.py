"""What every kind of primitive promises as a `MotionPrimitive`, beside `dmp_contract.py`."""

import json

import pytest
import torch
from demo_motions import arm_motion, turning_motion
from safetensors.torch import load_file, save_file
from unchecked import shapes_unchecked

from hrc_learn.dmp import (
    DualArmDMP,
    JointDMP,
    LearnedGaussianBasis,
    LimitedDMP,
    MotionPrimitive,
    MovingGoalDMP,
    OrientationDMP,
    PoseDMP,
    fit_rhythmic,
    fit_rhythmic_pose,
    through,
)
from hrc_learn.dmp.exported_dmp import resting_inputs, state_tensors
from hrc_learn.geometry import Pose, quaternion

TIME, POSITION = arm_motion(n_samples=120, n_joints=5, moving_start=True)
TURN = turning_motion(n_samples=120)[1]
ROUND = torch.linspace(0, 2, 120, dtype=torch.float64)
SWING = 0.3 * torch.sin(2 * torch.pi * ROUND[:, None] * torch.ones(3))


def two_hands():
    position = torch.stack([POSITION[:, :3], POSITION[:, 2:]], dim=-2)
    return DualArmDMP.fit(TIME, position, torch.stack([TURN, TURN.flip(0)], dim=-2), 12, gain=4)


KINDS = {
    "joint": lambda: JointDMP.fit(TIME, POSITION, 12),
    "orientation": lambda: OrientationDMP.fit(TIME, TURN, 12),
    "pose": lambda: PoseDMP.fit(TIME, POSITION[:, :3], TURN, 12, POSITION[:, 3:]),
    "limited": lambda: LimitedDMP.fit(TIME, POSITION, -2.0, 2.5, 12),
    "moving goal": lambda: MovingGoalDMP.fit(TIME, POSITION, 12),
    "two arms": two_hands,
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


def test_through_is_the_same_as_condition():
    dmp = KINDS["joint"]()
    via = POSITION[60:61] + 0.1
    ours, same = through(dmp, [1.0], via), dmp.condition([1.0], via)
    assert torch.equal(ours.rollout().position, same.rollout().position)


@pytest.mark.parametrize("kind", KINDS)
def test_ends_can_be_put_into_every_kind(kind):
    dmp = KINDS[kind]()
    given = {"duration": 1.5}
    if kind == "joint":
        given["goal"] = POSITION[-1] + 0.2
    there, own = dmp.rollout(**given), dmp.with_ends(**given).rollout()
    assert off(value_at(own, 60), value_at(there, 60)) < 1e-9


@pytest.mark.parametrize(
    "kind", ["limited", "moving goal", pytest.param("two arms", marks=pytest.mark.slow)]
)
def test_a_program_of_every_kind_does_what_the_primitive_does(kind):
    """Those of joints, orientations and poses are in `test_exported_dmp.py`."""
    dmp = KINDS[kind]()
    with shapes_unchecked():
        exported = dmp.export()
    assert exported.stepper is None
    program = exported.program.module()
    start = {"end_velocity": torch.ones(5).double()} if kind == "moving goal" else {}
    state = dmp.initial_state(**start)
    tensors = state_tensors(state)
    for dt, waiting in ((0.05, 0.0), (0.2, 1.0)):
        inputs = resting_inputs(dmp, tensors)
        inputs["phase_stopping"] = inputs["phase_stopping"] + waiting
        inputs["coupling"] = inputs["coupling"] + 0.3
        tensors = program(tensors, torch.tensor([dt], dtype=torch.float64), inputs)
        state = dmp.step(state, dt, coupling=inputs["coupling"][0], phase_stopping=waiting)
        for name, value in state_tensors(state).items():
            torch.testing.assert_close(tensors[name], value, rtol=1e-9, atol=1e-9, msg=name)


def test_exporters_register_for_a_type():
    class Toaster:
        duration = torch.tensor(1.0)

    from hrc_learn.dmp.motion_primitive import export_primitive

    with pytest.raises(TypeError, match="no exporter is registered for Toaster"):
        export_primitive(Toaster())


def test_a_kept_end_velocity_is_refused():
    dmp = KINDS["moving goal"]()
    with pytest.raises(ValueError, match="is given to rollout"):
        dmp.with_ends(end_velocity=torch.ones(5).double())


def test_files_with_older_names_are_read(tmp_path):
    """Timestamps were once "stamps", learned bases placed ones."""
    basis = LearnedGaussianBasis(centres=(0.0, 0.3, 1.0), widths=(0.2, 0.3, 0.3))
    dmp = JointDMP.fit(TIME, POSITION, basis=basis)
    dmp.save(tmp_path)
    model, config = tmp_path / "model.safetensors", tmp_path / "config.json"
    tensors, fields = load_file(model), json.loads(config.read_text())
    tensors["stamps"] = tensors.pop("timestamps")
    save_file(tensors, model)
    fields["basis"]["type"] = "PlacedBasis"
    config.write_text(json.dumps(fields))
    older = JointDMP.load(tmp_path)
    assert older.basis == basis
    assert torch.equal(older.rollout().position, dmp.rollout().position)
