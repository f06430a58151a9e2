"""Fit of a visual servoing skill: rest above the object, decisions, and its errors."""

from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from unchecked import shapes_unchecked

from hrc_learn.demos import Demonstration, DemonstrationSet
from hrc_learn.geometry import Pose
from hrc_learn.kinematics import panda
from hrc_learn.learning import visual_servo_fitting as fitting
from hrc_learn.learning.visual_servo_fitting import (
    _ends,
    _marker_angle,
    feature_trajectories,
    fit_visual_servo,
)
from hrc_learn.skills.visual_skill import ANGLE_FEATURE, OBJECT_FEATURE

FRAMES, FPS = 21, 20.0


def demonstration(episode=0, objects=True, angle=None, hidden=(), unseen=(), **changes):
    """One second at 20 Hz; the tool and the object move until the end, frame by frame.

    `hidden`: frames without the object; `unseen`: frames without the tool's marker.
    """
    k = np.arange(FRAMES, dtype=float)
    visible = np.ones(FRAMES, dtype=bool)
    visible[list(unseen)] = False
    extra = {}
    if objects:
        extra[OBJECT_FEATURE] = np.stack([100 + k, 200 - 2 * k, np.ones(FRAMES)], axis=-1)
        extra[OBJECT_FEATURE][list(hidden), 2] = 0.0
    if angle is not None:
        extra[ANGLE_FEATURE] = np.stack([np.zeros(FRAMES), angle + 0.01 * k], axis=-1)
    turn = 0.02 * k
    content: dict[str, Any] = {
        "time": k / FPS,
        "position": np.stack([0.4 + 0.01 * k, 0.0 * k, 0.3 - 0.01 * k], axis=-1),
        "orientation": np.stack([np.cos(turn), 0 * k, 0 * k, np.sin(turn)], axis=-1),
        "feature": np.stack([300 + k, 400 + k], axis=-1),
        "feature_visible": visible,
        "fps": FPS,
        "episode": episode,
        "extra": extra,
    }
    return Demonstration(**content | changes)


def test_the_end_is_the_mean_of_the_last_three_tenths_of_a_second():
    """Frames 15 to 20: the frame 0.3 s before the end does not count."""
    (end,) = _ends(DemonstrationSet([demonstration(angle=0.5)]))
    np.testing.assert_allclose(end.object_pixel, [117.5, 165.0])
    np.testing.assert_allclose(end.pose.position, [0.575, 0.0, 0.125], atol=1e-12)
    # A mean of quaternions is none: the last one counts, and the last angle.
    np.testing.assert_allclose(end.pose.orientation, [np.cos(0.4), 0, 0, np.sin(0.4)])
    assert end.angle == pytest.approx(0.5 + 0.01 * 20)
    assert len(end.path.position) == FRAMES


def test_frames_without_tool_or_object_do_not_count_at_the_end():
    demo = demonstration(hidden=(20, 16), unseen=(19, 15), angle=0.0)
    (end,) = _ends(DemonstrationSet([demo]))  # frames 17 and 18 are left
    np.testing.assert_allclose(end.object_pixel, [117.5, 165.0])
    np.testing.assert_allclose(end.pose.orientation, [np.cos(0.36), 0, 0, np.sin(0.36)])
    assert end.angle == pytest.approx(0.18)


def test_an_end_without_angles_has_none():
    (end,) = _ends(DemonstrationSet([demonstration()]))
    assert end.angle is None


def test_a_rest_in_which_nothing_is_seen_is_named():
    demos = DemonstrationSet(
        [demonstration(), demonstration(episode=4, hidden=range(15, 21))], source="SET"
    )
    with pytest.raises(ValueError, match=r"SET, episode 4: .* the last 0.3 s, at rest"):
        _ends(demos)


def test_an_object_in_some_demonstrations_is_an_error_unless_that_is_allowed():
    demos = DemonstrationSet(
        [demonstration(), demonstration(episode=3, objects=False)], source="SET"
    )
    with pytest.raises(ValueError, match=f"SET, episode 3: no {OBJECT_FEATURE}"):
        _ends(demos)
    assert len(_ends(demos, partial=True)) == 1
    assert _ends(demos[1:]) == []


@pytest.mark.parametrize(
    ("lacks", "named"),
    [
        ({"feature": None}, "no feature. An"),
        ({"feature_visible": None}, "no feature_visible. An"),
        ({"position": None}, "no position, orientation. An"),
        ({"orientation": None}, "no position, orientation. An"),
        ({"feature": None, "position": None}, "no feature, position, orientation. An"),
    ],
)
def test_missing_columns_are_named_with_their_episode(lacks, named):
    demos = DemonstrationSet([demonstration(episode=2, **lacks)], source="SET")
    # A check of the shapes would read the first episode at once.
    with (
        shapes_unchecked(),
        pytest.raises(ValueError, match=f"SET, episode 2: {named}"),
    ):
        feature_trajectories(demos)[0]


def test_poses_of_a_panda_come_from_its_joints_where_none_were_recorded():
    joints = panda.ready.numpy() + 0.01 * np.arange(FRAMES)[:, None]
    lacks: dict[str, Any] = {"position": None, "orientation": None, "joint_position": joints}
    known = demonstration(**lacks, joint_names=panda.joint_names)
    (watched,) = feature_trajectories(DemonstrationSet([known]))
    expected = panda.forward(torch.from_numpy(joints))
    torch.testing.assert_close(watched.pose.position, expected.position)
    other = demonstration(**lacks, joint_names=tuple("abcdefg"))
    with shapes_unchecked(), pytest.raises(ValueError, match="position, orientation"):
        feature_trajectories(DemonstrationSet([other]))[0]


def test_angles_that_were_not_seen_are_left_out_of_the_marker_angle(monkeypatch):
    calls = []
    monkeypatch.setattr(
        fitting,
        "MarkerAngle",
        SimpleNamespace(fit=lambda *given: calls.append(given) or "angle"),
    )
    ends = [
        SimpleNamespace(angle=angle, object_pixel=[10.0 * k, 0.0], pose=pose)
        for k, (angle, pose) in enumerate(zip([0.1, None, np.nan, -0.2], poses(4), strict=True))
    ]
    camera: Any = "camera"
    target: Any = "target"
    with shapes_unchecked():
        assert _marker_angle(ends[1:3], camera, target) is None
        assert _marker_angle(ends, camera, target) == "angle"
    ((_, pixels, angles, stacked, _),) = calls
    np.testing.assert_array_equal(pixels, [[0.0, 0.0], [30.0, 0.0]])
    assert angles == [0.1, -0.2]
    np.testing.assert_array_equal(stacked.position[:, 0], [0.0, 3.0])


def poses(count):
    unit = torch.tensor([1.0, 0, 0, 0]).double()
    return [Pose(torch.tensor([float(k), 0, 0]).double(), unit) for k in range(count)]


@dataclass(frozen=True)
class Report:
    motion: float = 0.0
    held_out_error: float = 0.0


@pytest.fixture
def stages(monkeypatch):
    """What the stages of a fit were given; they return names, and known errors."""
    given: dict[str, Any] = {}
    held_out = SimpleNamespace(
        motion=torch.tensor([[3.0, 4.0], [0.0, 0.0]]),
        error=torch.tensor([[1.0, 1.0], [1.0, -1.0]]),
        by_cell=lambda: "cells",
    )

    def stage(name, result):
        def run(*arguments):
            given[name] = arguments
            return result

        return run

    learned = SimpleNamespace(kept=SimpleNamespace(neurons="learned", config="learned too"))
    for name, result in {
        "fit_camera": SimpleNamespace(camera="camera"),
        "unexplained": "left",
        "maximize_evidence": learned,
        "cross_validate": held_out,
        "_marker_angle": "angle",
        "VisualServoSkill": None,
    }.items():
        monkeypatch.setattr(fitting, name, stage(name, result))
    monkeypatch.setattr(fitting, "VisualServoSkill", lambda **parts: SimpleNamespace(**parts))
    for name, method in {
        "RBFImageJacobian": "fit",
        "VisualTarget": "fit",
        "Approach": "fit",
    }.items():
        result = SimpleNamespace(report=Report()) if name == "RBFImageJacobian" else name
        monkeypatch.setattr(fitting, name, SimpleNamespace(**{method: stage(name, result)}))
    monkeypatch.setattr(fitting, "RBFCenters", SimpleNamespace(around=lambda watched: "around"))
    monkeypatch.setattr(
        fitting, "ImageJacobianFitConfig", SimpleNamespace(of_residual=lambda: "residual")
    )
    with shapes_unchecked():
        yield given


def test_errors_of_a_fit_are_root_mean_squares_over_pairs(stages):
    skill: Any = fit_visual_servo(DemonstrationSet([demonstration()]))
    assert skill.jacobian.report.motion == pytest.approx(np.sqrt(12.5))
    assert skill.jacobian.report.held_out_error == pytest.approx(np.sqrt(2.0))
    assert skill.cells == "cells"
    assert stages["RBFImageJacobian"][1:3] == ("around", "residual")
    assert stages["fit_camera"][1] == stages["cross_validate"][3] == fitting.IMAGE_SIZE
    assert (skill.target, skill.approach, skill.angle) == ("VisualTarget", "Approach", "angle")


@pytest.mark.parametrize(("count", "learns"), [(2, False), (3, True), (4, True)])
def test_neurons_are_learned_from_enough_demonstrations_only(stages, count, learns):
    learning: Any = SimpleNamespace(hold_out=3)
    neurons: Any = "given"
    demos = DemonstrationSet([demonstration(k) for k in range(count)])
    skill: Any = fit_visual_servo(demos, neurons, learning=learning)
    assert (skill.learned is not None) == learns
    expected = ("learned", "learned too") if learns else ("given", "residual")
    assert stages["RBFImageJacobian"][1:3] == expected
    assert ("maximize_evidence" in stages) == learns


def test_neurons_are_learned_only_if_asked(stages):
    config: Any = "config"
    demos = DemonstrationSet([demonstration(k) for k in range(9)])
    skill: Any = fit_visual_servo(demos, config=config)
    assert skill.learned is None
    assert stages["RBFImageJacobian"][2] == "config"


def test_without_an_object_there_is_no_target(stages):
    skill: Any = fit_visual_servo(DemonstrationSet([demonstration(objects=False)]))
    assert (skill.target, skill.approach, skill.angle) == (None, None, None)


def test_landmarks_bring_their_image_size_and_may_miss_the_object(stages):
    landmarks: Any = SimpleNamespace(image_size=(64, 48))
    demos = DemonstrationSet([demonstration(), demonstration(1, objects=False)])
    skill: Any = fit_visual_servo(demos, landmarks=landmarks)
    assert stages["fit_camera"][1] == stages["cross_validate"][3] == (64, 48)
    assert skill.landmarks is landmarks
    assert len(stages["VisualTarget"][1]) == 1
    with pytest.raises(ValueError, match="unlike other episodes"):
        fit_visual_servo(demos)
