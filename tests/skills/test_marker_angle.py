"""Turning the gripper for an object by the markers' directions, against a pinhole camera."""

import copy
import json
import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch

from hrc_learn.geometry import Pose, quaternion
from hrc_learn.kinematics import gripper_down
from hrc_learn.kinematics.tool_orientation import turn_about_vertical
from hrc_learn.skills.marker_sensor import AngleDemonstration, MarkerAngle
from hrc_learn.vision import CameraModel, Marker, angle

MARKER = Marker(7, 0.048)
# On the tool its marker faces back, away from where the tool points.
ON_TOOL = np.array([[0.0, 1, 0, 0], [1, 0, 0, 0.145], [0, 0, -1, -0.08], [0, 0, 0, 1]])
ALLOWED = (math.radians(-75), math.radians(105))
ABOVE = torch.tensor([0.25, 0.50, 0.17], dtype=torch.float64)


def turned(yaw, q=None):
    about = quaternion.exp(torch.tensor([0.0, 0.0, yaw], dtype=torch.float64))
    return quaternion.multiply(about, gripper_down() if q is None else q)


def camera(tilt=0.0, roll=0.0):
    pose = np.eye(4)
    lean = quaternion.to_matrix(quaternion.exp(torch.tensor([tilt, 0, roll]).double())).numpy()
    pose[:3, :3] = lean @ np.diag([-1.0, 1.0, -1.0])
    pose[:3, 3] = (0.24, 0.52, 1.55)
    return CameraModel(focal=(2050.0, 2050.0), pose=pose)


def seen(made, frame):
    corners = MARKER.corners @ frame[:3, :3].T + frame[:3, 3]
    return angle(made.project(corners))


def of_tool(made, pose):
    return seen(made, pose.matrix().numpy() @ ON_TOOL)


def of_object(made, yaw):
    c, s = math.cos(yaw), math.sin(yaw)
    frame = np.array([[c, -s, 0, 0.25], [s, c, 0, 0.5], [0, 0, 1, 0.06], [0, 0, 0, 1]])
    return seen(made, frame)


def demonstration(made, yaw, start=-0.5, noise=0.0, seed=0):
    """The tool turns from a start to the object's own turn, less whole half turns."""
    rng = np.random.default_rng(seed)
    end = ALLOWED[0] + (yaw - ALLOWED[0]) % math.pi
    yaws = np.linspace(start, end, 30)
    offsets = torch.from_numpy(0.05 * rng.standard_normal(3))
    pose = Pose(
        ABOVE + torch.linspace(1, 0, 30).double()[:, None] * offsets,
        torch.stack([turned(float(y)) for y in yaws]),
    )
    tool = torch.tensor([of_tool(made, pose[k]) for k in range(30)]).double()
    tool = tool + noise * torch.from_numpy(rng.standard_normal(30))
    return AngleDemonstration(
        pose=pose, tool=tool, item=of_object(made, yaw), final=float(tool[-1])
    )


@cache
def learned(noise=0.0):
    made = camera()
    yaws = np.linspace(-math.pi, math.pi, 8, endpoint=False)
    return MarkerAngle.fit(
        [demonstration(made, yaw, noise=noise, seed=k) for k, yaw in enumerate(yaws)]
    )


def converged(skill, made, yaw, start=0.3, images=6):
    """Turn of a tool that goes where each image tells it to."""
    servo, pose = skill, Pose(ABOVE, turned(start))
    state, item = servo.initial_state(), of_object(made, yaw)
    for _ in range(images):
        direction = of_tool(made, pose)
        state = servo.updated(state, pose, direction, 0.04)
        goal, state = servo.turned(state, pose, direction, item, gripper_down(), ALLOWED)
        pose = Pose(ABOVE, goal)
    return turn_about_vertical(pose.orientation, gripper_down())


@pytest.mark.parametrize("end", [0, 1])
def test_near_an_end_of_the_range_the_tool_is_not_turned_to_and_fro(end):
    """Directions that differ by noise; half a turn further is as good a turn."""
    made, rng, goals = camera(), np.random.default_rng(end), []
    servo, pose = learned(), Pose(ABOVE, turned(0.3))
    direction, item = of_tool(made, pose), of_object(made, ALLOWED[end])
    state = servo.initial_state()
    for noise in rng.normal(0, 0.03, 30):
        goal, state = servo.turned(
            state, pose, direction, item + noise, gripper_down(), ALLOWED
        )
        goals.append(turn_about_vertical(goal, gripper_down()))
    assert np.ptp(goals) < 0.3
    # Another motion may choose anew, and far out of the range nothing is kept.
    beyond = item + (
        -0.4 if goals[-1] > 0 else 0.4
    )  # the image shows turns the other way round
    far, _ = servo.turned(state, pose, direction, beyond, gripper_down(), ALLOWED)
    assert ALLOWED[0] < turn_about_vertical(far, gripper_down()) < ALLOWED[1]
    assert abs(turn_about_vertical(far, gripper_down()) - goals[-1]) > 1.0


def test_the_turn_about_the_vertical_is_that_of_the_rotation():
    for yaw in (-2.5, -0.3, 0.0, 1.2, 3.0):
        lean = quaternion.exp(torch.tensor([0.1, -0.2, 0.0], dtype=torch.float64))
        tilted = quaternion.multiply(lean, gripper_down())
        assert turn_about_vertical(turned(yaw, tilted), tilted) == pytest.approx(yaw)


def test_a_camera_above_sees_the_opposite_turn():
    row = learned().jacobian.weight.detach()[:, 0]
    assert float(row[5]) == pytest.approx(-1.0, abs=0.03)
    assert learned().spread < math.radians(1)


@pytest.mark.parametrize("yaw", np.linspace(-3.1, 3.1, 9))
def test_the_gripper_ends_as_the_object_lies(yaw):
    turn = converged(learned(), camera(), yaw)
    assert ALLOWED[0] <= turn <= ALLOWED[1]
    assert math.remainder(turn - yaw, math.pi) == pytest.approx(0, abs=math.radians(1))


@pytest.mark.parametrize(("tilt", "roll"), [(0.17, 0.0), (0.0, 1.0), (-0.15, -2.0)])
def test_also_under_a_camera_that_was_moved(tilt, roll):
    skill, made = learned(), camera(tilt, roll)
    turn = converged(skill, made, 0.7)
    assert math.remainder(turn - 0.7, math.pi) == pytest.approx(0, abs=math.radians(2))


def test_a_wrong_rate_is_learned_online():
    jacobian = copy.deepcopy(learned().jacobian)
    jacobian.weight.data[5] = -1.6
    skill = replace(learned(), jacobian=jacobian)
    assert converged(skill, camera(), 1.5, images=10) == pytest.approx(1.5, abs=0.02)


def test_noise_of_the_corners_does_not_shrink_the_rate():
    row = learned(noise=5e-3).jacobian.weight.detach()[:, 0]
    assert float(row[5]) == pytest.approx(-1.0, abs=0.05)


def test_of_two_ways_to_grasp_the_one_within_reach_is_taken():
    skill, made = learned(), camera()
    # A tool at -70 degrees is nearer to -80, which is out of reach, than to 100.
    turn = converged(skill, made, math.radians(-80), start=math.radians(-70))
    assert turn == pytest.approx(math.radians(100), abs=math.radians(1.5))


def test_a_saved_angle_is_read_back(tmp_path):
    skill = learned()
    (tmp_path / "skill").mkdir()
    skill.save(tmp_path / "skill")
    again = MarkerAngle.load(tmp_path / "skill")
    assert (again.offset, again.spread) == (skill.offset, skill.spread)
    assert torch.equal(again.jacobian.weight, skill.jacobian.weight)
    path = tmp_path / "skill" / "angle.json"
    path.write_text(json.dumps({"version": 9}))
    with pytest.raises(ValueError, match=r"angle\.json"):
        MarkerAngle.load(tmp_path / "skill")


def test_no_demonstration_teaches_nothing():
    with pytest.raises(ValueError, match="one demonstration"):
        MarkerAngle.fit([])
