"""Operations of every kind of primitive, and of every model that makes primitives."""

import copy
import json
import math

import numpy as np
import pytest
import torch
from unchecked import shapes_unchecked

from hrc_learn.dmp import (
    FramedDMP,
    Frames,
    JointDMP,
    LearnedMotion,
    MovingGoalDMP,
    OrientationDMP,
    PoseDMP,
    ProbabilisticDMP,
    export_dmp,
    fit_rhythmic,
    fit_rhythmic_orientation,
    fit_rhythmic_pose,
    learn,
    mean_primitive,
)
from hrc_learn.geometry import Pose, quaternion

TIME = torch.linspace(0, 2, 60, dtype=torch.float64)
CURVE = torch.sin(TIME[:, None] * torch.tensor([0.8, 1.2, -0.5], dtype=torch.float64))
PATHS = torch.stack([CURVE, 1.1 * CURVE + 0.1, 0.9 * CURVE - 0.1 * TIME[:, None]])
TURNS = quaternion.exp(0.5 * PATHS)
WAVE = 0.4 * torch.sin(math.pi * TIME[:, None] * torch.tensor([1.0, 2.0, 1.0]).double())
FRAMES = Frames(
    torch.eye(3, dtype=torch.float64).expand(3, 2, 3, 3),
    torch.stack([PATHS[:, 0], PATHS[:, -1]], dim=1),
)
PRIMITIVES = {
    "joint": lambda: JointDMP.fit(TIME, CURVE, 12),
    "moving goal": lambda: MovingGoalDMP(JointDMP.fit(TIME, CURVE, 12)),
    "orientation": lambda: OrientationDMP.fit(TIME, TURNS[0], 12),
    "ude": lambda: OrientationDMP.fit(TIME, TURNS[0], 12, formulation="ude"),
    "pose": lambda: PoseDMP.fit(TIME, CURVE, TURNS[0], 12),
    "rhythm": lambda: fit_rhythmic(TIME, WAVE, 9, 2.0),
    "rhythm of an orientation": lambda: fit_rhythmic_orientation(
        TIME, quaternion.exp(WAVE), 9, 2.0
    ),
    "rhythm of a pose": lambda: fit_rhythmic_pose(
        TIME, WAVE, quaternion.exp(WAVE), 9, None, 2.0
    ),
}
MODELS = {
    "distribution of joints": lambda: ProbabilisticDMP.fit(JointDMP.fit(TIME, PATHS, 12)),
    "distribution of orientations": lambda: ProbabilisticDMP.fit(
        OrientationDMP.fit(TIME, TURNS, 12)
    ),
    "distribution of poses": lambda: ProbabilisticDMP.fit(
        PoseDMP.fit(TIME, PATHS, TURNS, 12), slack=0.1
    ),
    "distribution to a moving goal": lambda: ProbabilisticDMP.fit(
        MovingGoalDMP(JointDMP.fit(TIME, PATHS, 12))
    ),
    "frames": lambda: FramedDMP.fit(TIME, PATHS, FRAMES, 12),
    "learned": lambda: learn([(TIME, path) for path in PATHS], n_basis=12),
    "learned in frames": lambda: _in_frames(),
}
NO_VIA_POINTS = {
    "ude": "not linear",
    "rhythm": "no via points",
    "rhythm of an orientation": "no via points",
    "rhythm of a pose": "no via points",
}


def _in_frames() -> LearnedMotion:
    found = learn([(TIME, path) for path in PATHS], n_basis=12, frames=FRAMES)
    chosen = next(c for c in found.candidates if c.kind == "frames")
    return LearnedMotion(
        each=found.each,
        context=found.context,
        by_ends=found.by_ends,
        frames=FRAMES,
        chosen=chosen,
    )


def motion_of(model):
    """Columns of the motion that a model predicts."""
    if isinstance(model, FramedDMP):
        return model.rollout(FRAMES).position
    if isinstance(model, LearnedMotion) and model.frames is not None:
        frames = Frames(model.frames.A[0], model.frames.b[0])
        return model.at(frames=frames).rollout().position
    made = model.rollout()
    return made.motion.position if hasattr(made, "motion") else made.position


def same(one, other):
    torch.testing.assert_close(motion_of(one), motion_of(other), rtol=0, atol=0)


@pytest.mark.parametrize("kind", [*PRIMITIVES, *MODELS])
def test_saves_loads_and_moves_to_a_device(kind, tmp_path):
    model = (PRIMITIVES | MODELS)[kind]()
    model.save(tmp_path / "model")
    same(type(model).load(tmp_path / "model"), model)
    assert json.loads((tmp_path / "model" / "config.json").read_text())["kind"] == (
        type(model).__name__
    )
    if hasattr(model, "to"):  # the primitives of a learned motion are an attribute
        same(copy.deepcopy(model).to("cpu"), model)


@pytest.mark.parametrize("kind", [k for k in MODELS if "learned" not in k])
def test_a_model_refuses_another_precision(kind):
    with pytest.raises(ValueError, match="needs float64"):
        MODELS[kind]().to(torch.float32)


def test_a_model_on_another_device_leaves_no_part_behind():
    """The device `meta` holds no values, so each tensor shows where it is."""
    for make in (make for kind, make in MODELS.items() if "learned" not in kind):
        model = make()
        moved = model.to("meta")
        for each, device in ((moved, "meta"), (model, "cpu")):
            # The residuals of a fit stay where they were computed.
            used = [x for k, x in each.tensors().items() if "fit_report" not in k]
            assert {x.device.type for x in used} == {device}


@pytest.mark.parametrize("kind", MODELS)
def test_a_model_names_a_wrong_file(kind, tmp_path):
    model = MODELS[kind]()
    model.save(tmp_path / "model")
    with pytest.raises(ValueError, match="kind is"):
        JointDMP.load(tmp_path / "model")
    with pytest.raises(FileNotFoundError):
        type(model).load(tmp_path / "none")


@pytest.mark.parametrize("kind", PRIMITIVES)
def test_every_primitive_steps_along_its_rollout(kind):
    dmp = PRIMITIVES[kind]()
    with torch.no_grad(), shapes_unchecked():
        state = dmp.initial_state()
        for _ in range(20):
            state = dmp.step(state, 0.05)
        there = dmp.rollout([1.0])
    reached = getattr(state, "motion", state).position
    columns = there.motion.position if hasattr(there, "motion") else there.position
    if kind == "moving goal":
        reached = state.position
    torch.testing.assert_close(reached, columns[0], rtol=0, atol=1e-6)


@pytest.mark.parametrize("kind", PRIMITIVES)
def test_every_primitive_passes_via_points_or_says_why_not(kind):
    dmp = PRIMITIVES[kind]()
    if kind in NO_VIA_POINTS:
        with pytest.raises(ValueError, match=NO_VIA_POINTS[kind]):
            dmp.condition([1.0], velocity=torch.zeros(1, 6 if "pose" in kind else 3))
        return
    end = dmp.goal
    via = Pose(end.position[None], end.orientation[None]) if kind == "pose" else end[None]
    passed = dmp.condition([1.0], via).rollout([1.0])
    made = passed.orientation if kind == "orientation" else passed.position
    wanted = end.position if kind == "pose" else end
    torch.testing.assert_close(made[0].abs(), wanted.abs(), rtol=0, atol=1e-9)


@pytest.mark.parametrize("kind", PRIMITIVES)
def test_every_primitive_is_exported(kind):
    with shapes_unchecked():
        assert export_dmp(PRIMITIVES[kind]()).program is not None


@pytest.mark.parametrize("kind", MODELS)
def test_export_names_what_makes_a_primitive(kind):
    with pytest.raises(TypeError, match="is no primitive: export one that it makes"):
        export_dmp(MODELS[kind]())


def test_a_distribution_to_a_moving_goal_is_about_the_primitive(tmp_path):
    made = ProbabilisticDMP.fit(MovingGoalDMP(JointDMP.fit(TIME, PATHS, 12)))
    made.save(tmp_path / "model")
    loaded = ProbabilisticDMP.load(tmp_path / "model")
    assert isinstance(loaded.primitive, MovingGoalDMP)
    np.testing.assert_array_equal(loaded.mean.numpy(), made.mean.numpy())


def test_the_mean_of_one_demonstration_is_itself():
    dmp = PRIMITIVES["joint"]()
    same(mean_primitive(dmp), dmp)
