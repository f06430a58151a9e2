"""Turning the gripper as an object lies, against the simulator's camera."""

import json
import math

import numpy as np
import pytest
import torch
from seen_cameras import camera_vector

from hrc_learn.geometry import Pose, quaternion
from hrc_learn.kinematics import gripper_down
from hrc_learn.kinematics.tool_orientation import turn_about_vertical
from hrc_learn.skills.visual_skill import MarkerAngle
from hrc_learn.skills.visual_target import VisualTarget, object_heading
from hrc_learn.vision import CameraModel, Marker, angle, centre

MARKER = Marker(7, 0.048)
ALLOWED = (math.radians(-75), math.radians(105))
# The object's marker lies 11 cm below the tool.
TARGET, HEIGHT = VisualTarget(offset=np.array([0.0, 0.0, 0.11]), error=0.0), 0.06


def turned(yaw, q=None):
    about = quaternion.exp(torch.tensor([0.0, 0.0, yaw], dtype=torch.float64))
    return quaternion.multiply(about, gripper_down() if q is None else q)


def camera(tilt=0.0, roll=0.0):
    pose = np.eye(4)
    lean = quaternion.to_matrix(quaternion.exp(torch.tensor([tilt, 0, roll]).double())).numpy()
    pose[:3, :3] = lean @ np.diag([-1.0, 1.0, -1.0])
    pose[:3, 3] = (0.24, 0.52, 1.55)
    return CameraModel(focal=(2050.0, 2050.0), pose=pose)


def seen(made, yaw, place=(0.25, 0.5)):
    """Pixel and direction of the marker of an object that lies at an angle."""
    c, s = math.cos(yaw), math.sin(yaw)
    frame = np.array([[c, -s, 0, place[0]], [s, c, 0, place[1]], [0, 0, 1, HEIGHT]])
    corners = made.project(MARKER.corners @ frame[:, :3].T + frame[:, 3])
    return centre(corners), angle(corners)


def learned(noise=0.0):
    made, rng, objects, angles, poses = camera(), np.random.default_rng(0), [], [], []
    for yaw in np.linspace(-math.pi, math.pi, 8, endpoint=False):
        place = rng.uniform([0.2, 0.45], [0.3, 0.55])
        pixel, direction = seen(made, yaw, place)
        objects.append(pixel)
        angles.append(direction + noise * rng.standard_normal())
        end = ALLOWED[0] + (yaw - ALLOWED[0]) % math.pi
        poses.append(Pose(torch.tensor([*place, HEIGHT + 0.11]).double(), turned(end)))
    both = Pose(
        torch.stack([pose.position for pose in poses]),
        torch.stack([pose.orientation for pose in poses]),
    )
    return MarkerAngle.fit(camera_vector(made), np.array(objects), angles, both, TARGET)


def chosen(skill, made, yaw, now=0.3, kept=None):
    pixel, direction = seen(made, yaw)
    heading = object_heading(camera_vector(made), torch.from_numpy(pixel), direction, HEIGHT)
    return skill.turn(heading, gripper_down(), now, ALLOWED, kept)


@pytest.mark.parametrize("yaw", np.linspace(-3.1, 3.1, 9))
@pytest.mark.parametrize(("tilt", "roll"), [(0.0, 0.0), (0.17, 1.0), (-0.15, -2.0)])
def test_the_gripper_turns_as_the_object_lies_under_any_camera(tilt, roll, yaw):
    turn = chosen(learned(), camera(tilt, roll), yaw)
    assert ALLOWED[0] <= turn <= ALLOWED[1]
    assert math.remainder(turn - yaw, math.pi) == pytest.approx(0, abs=math.radians(0.3))


@pytest.mark.parametrize("end", [0, 1])
def test_near_an_end_of_the_range_the_tool_is_not_turned_to_and_fro(end):
    """Directions that differ by noise; half a turn further is as good a turn."""
    skill, kept, turns = learned(), None, []
    for noise in np.random.default_rng(end).normal(0, 0.03, 30):
        kept = chosen(skill, camera(), ALLOWED[end] + noise, kept=kept)
        turns.append(kept)
    assert np.ptp(turns) < 0.3
    # Far out of the range nothing is kept.
    beyond = ALLOWED[0] - 0.4 if turns[-1] < 0 else ALLOWED[1] + 0.4
    far = chosen(skill, camera(), beyond, kept=turns[-1])
    assert ALLOWED[0] < far < ALLOWED[1]
    assert abs(far - turns[-1]) > 1.0


@pytest.mark.parametrize("side", [-1.0, 1.0])
@pytest.mark.parametrize(("beyond", "kept"), [(0.03, True), (0.14, True), (0.16, False)])
def test_a_turn_is_kept_up_to_its_margin_outside_the_range(side, beyond, kept):
    skill, end = MarkerAngle(offset_rad=0.0, spread_rad=0.0), math.pi / 2
    upright, yaw = torch.tensor([1.0, 0.0, 0.0, 0.0]), side * (end + beyond)
    half_turn = yaw - side * math.pi
    before = yaw + 0.02
    turn = skill.turn(half_turn, upright, before, (-end, end), before)
    assert turn == pytest.approx(yaw if kept else half_turn)
    # Without an earlier choice, it is a turn within the range.
    assert skill.turn(yaw, upright, before, (-end, end), None) == pytest.approx(half_turn)


def test_the_turn_about_the_vertical_is_that_of_the_rotation():
    for yaw in (-2.5, -0.3, 0.0, 1.2, 3.0):
        lean = quaternion.exp(torch.tensor([0.1, -0.2, 0.0], dtype=torch.float64))
        tilted = quaternion.multiply(lean, gripper_down())
        assert turn_about_vertical(turned(yaw, tilted), tilted) == pytest.approx(yaw)


def test_of_two_ways_to_grasp_the_one_within_reach_is_taken():
    # A tool at -70 degrees is nearer to -80, which is out of reach, than to 100.
    turn = chosen(learned(), camera(), math.radians(-80), now=math.radians(-70))
    assert turn == pytest.approx(math.radians(100), abs=math.radians(1))


@pytest.mark.parametrize("yaw", [-3.0, -1.0, -0.2, 0.3, 1.5, 2.4, 3.1])
def test_a_tool_of_little_reach_turns_as_far_as_it_can(yaw):
    skill, reach = MarkerAngle(offset_rad=0.0, spread_rad=0.0), (-0.3, 0.5)
    turn = skill.turn(yaw, torch.tensor([1.0, 0.0, 0.0, 0.0]), 0.0, reach, None)
    assert reach[0] <= turn <= reach[1]
    best = np.abs(np.sin(np.linspace(*reach, 10_001) - yaw)).min()
    assert abs(math.sin(turn - yaw)) == pytest.approx(best, abs=2e-4)


def test_the_spread_is_that_of_the_demonstrations():
    assert learned().spread_rad < math.radians(0.3)
    assert learned(noise=0.05).spread_rad == pytest.approx(0.05, rel=0.5)


def test_a_saved_angle_is_read_back(tmp_path):
    skill, path = learned(noise=0.01), tmp_path / "angle.json"
    skill.save(path)
    assert MarkerAngle.load(path) == skill
    path.write_text(json.dumps({"version": 9}))
    with pytest.raises(ValueError, match=r"angle\.json"):
        MarkerAngle.load(path)
