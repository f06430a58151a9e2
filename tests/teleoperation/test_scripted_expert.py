import math

import numpy as np
import pytest
import torch

from hrc_learn.geometry import quaternion
from hrc_learn.kinematics import coarse_orientation, gripper_down, panda
from hrc_learn.protocols import ArmState
from hrc_learn.teleoperation import GuidedPath, ScriptedExpert, Tremor

WAYPOINTS = np.array([[0.4, 0.0, 0.5], [0.42, -0.2, 0.45], [0.4, -0.35, 0.4], [0.4, -0.6, 0.4]])


def test_the_rule_tilts_with_the_sideways_position_and_then_no_further():
    y = torch.tensor([0.0, -0.3, -0.6, -0.9, 0.6], dtype=torch.float64)
    position = torch.stack([torch.zeros_like(y), y, torch.zeros_like(y)], dim=-1)
    approach = quaternion.to_matrix(coarse_orientation(position))[..., :, 2]
    s = math.sqrt(0.5)
    expected = torch.tensor(
        [[0, 0, -1], [0, -s, -s], [0, -1, 0], [0, -1, 0], [0, 1, 0]], dtype=torch.float64
    )
    torch.testing.assert_close(approach, expected, atol=1e-12, rtol=0)
    # The fingers keep closing along x, so that a board never stands in their way.
    closing = quaternion.to_matrix(coarse_orientation(position))[..., :, 1]
    torch.testing.assert_close(closing, torch.tensor([1.0, 0, 0]).double().expand(5, 3))
    torch.testing.assert_close(coarse_orientation(position)[0], gripper_down())


def test_a_guided_path_passes_its_waypoints_from_rest_to_rest():
    path = GuidedPath(WAYPOINTS, duration=10.0, start=2.0)
    np.testing.assert_allclose(path.position(0.0), WAYPOINTS[0])
    np.testing.assert_allclose(path.position(12.0), WAYPOINTS[-1], atol=1e-12)
    for time in (2.0, 12.0, 20.0):
        np.testing.assert_allclose(path.velocity(time), 0.0, atol=1e-9)
    samples = np.array([path.position(t) for t in np.linspace(2, 12, 2001)])
    for waypoint in WAYPOINTS:
        assert np.linalg.norm(samples - waypoint, axis=1).min() < 1e-3
    for time in (3.3, 6.1, 9.7):
        numeric = (path.position(time + 1e-5) - path.position(time - 1e-5)) / 2e-5
        np.testing.assert_allclose(path.velocity(time), numeric, atol=1e-6)


@pytest.mark.parametrize(
    ("waypoints", "duration"),
    [(WAYPOINTS[:1], 5.0), (WAYPOINTS[[0, 0, 1]], 5.0), (WAYPOINTS, 0.0)],
)
def test_a_path_that_leads_nowhere_is_refused(waypoints, duration):
    with pytest.raises(ValueError, match="way points"):
        GuidedPath(waypoints, duration)


def test_tremor_is_a_small_motion_about_the_path():
    tremor = Tremor(5e-4, np.random.default_rng(0))
    dt = 1e-3
    velocity = np.array([tremor.velocity(t) for t in np.arange(0, 20, dt)])
    drift = np.cumsum(velocity, axis=0) * dt
    assert 1e-4 < np.abs(drift - drift.mean(axis=0)).max() < 5e-3


def test_the_experts_hand_reaches_the_end_of_the_path():
    start = torch.tensor([0.2402, -0.5026, -0.1803, -2.1236, -0.0934, 1.6267, -0.7]).double()
    position = panda.forward(start).position.numpy()
    goal = position + np.array([0.05, -0.2, -0.1])
    path = GuidedPath(np.stack([position, goal]), duration=4.0)
    expert = ScriptedExpert(panda, path)
    q, dt = start, 0.01
    for k in range(600):
        state = ArmState(
            time=k * dt, joint_position=q.numpy(), joint_velocity=np.zeros(7), gripper_width=0.0
        )
        q = q + dt * torch.linalg.pinv(panda.jacobian(q)) @ torch.from_numpy(
            expert.read(state).twist
        )
    pose = panda.forward(q)
    np.testing.assert_allclose(pose.position.numpy(), path.position(6.0), atol=1e-4)
    assert float(quaternion.angle(pose.orientation, coarse_orientation(pose.position))) < 1e-3
