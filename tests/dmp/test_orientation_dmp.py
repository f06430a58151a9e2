import numpy as np
import pytest
import torch
from demo_motions import minimum_jerk, turning_motion
from unchecked import shapes_unchecked

from hrc_learn.dmp import OrientationDMP, PoseDMP
from hrc_learn.dmp.orientation_error import (
    angular_acceleration,
    angular_velocity,
    error_rate,
    nearest_turn,
)
from hrc_learn.geometry import Pose, quaternion

AXIS = torch.nn.functional.normalize(torch.tensor([1.0, 2.0, -0.5]).double(), dim=0)
S = torch.linspace(0, 1, 1000, dtype=torch.float64)


def turn(degrees, s=S):
    """Minimum-jerk rotation about a fixed axis, ending nowhere special."""
    end = quaternion.exp(torch.tensor([0.3, -0.2, 0.9], dtype=torch.float64))
    angle = np.deg2rad(degrees) * minimum_jerk(s)
    return quaternion.multiply(quaternion.exp(angle[:, None] * AXIS), end)


def degrees(radians):
    return np.rad2deg(radians.square().mean().sqrt().item())


@pytest.mark.parametrize("angle", [10, 90, 179, 180, 181, 190, 220, 359, 360, 361, 450, 720])
def test_turns_of_any_angle_are_reproduced(angle):
    dmp = OrientationDMP.fit(2 * S, turn(angle))
    trajectory = dmp.rollout()
    assert degrees(quaternion.angle(trajectory.orientation, turn(angle))) < 1e-3
    # The whole way is turned, not just as far as the goal.
    way = trajectory.angular_velocity.norm(dim=-1).mean() * 2
    assert np.rad2deg(way.item()) == pytest.approx(angle, rel=2e-3)


def test_signs_of_quaternions_mean_nothing():
    rng = torch.Generator().manual_seed(0)
    sign = torch.where(torch.rand(1000, 1, generator=rng) < 0.5, -1.0, 1.0)
    plain, flipped = (OrientationDMP.fit(S, q) for q in (turn(200), sign * turn(200)))
    expected = plain.rollout().orientation
    angle = quaternion.angle(flipped.rollout().orientation, expected)
    assert angle.max() < 1e-12
    for ends in ({"goal": -plain.goal}, {"start": -plain.start}):
        angle = quaternion.angle(plain.rollout(**ends).orientation, expected)
        assert angle.max() < 1e-7


def test_angular_velocity_turns_the_orientation():
    """Integrated by small rotations, it leads from the first orientation to the last."""
    time, q = turning_motion()
    dmp = OrientationDMP.fit(time, q)
    t, h = torch.linspace(0, 3, 2049, dtype=torch.float64), 3 / 2048
    trajectory = dmp.rollout(time=t)
    middle = dmp.rollout(time=(t[1:] + t[:-1]) / 2).angular_velocity
    turns = quaternion.exp(h * middle)
    while len(turns) > 1:
        turns = quaternion.multiply(turns[1::2], turns[::2])
    now = quaternion.multiply(turns[0], trajectory.orientation[0])
    assert quaternion.angle(now, trajectory.orientation[-1]) < 1e-5
    numeric = (trajectory.angular_velocity[2:] - trajectory.angular_velocity[:-2]) / (2 * h)
    torch.testing.assert_close(
        numeric, trajectory.angular_acceleration[1:-1], rtol=0, atol=1e-3
    )


def test_a_given_start_velocity_is_the_first():
    time, q = turning_motion()
    dmp = OrientationDMP.fit(time, q)
    omega = torch.tensor([0.2, -0.7, 0.4], dtype=torch.float64)
    start = quaternion.exp(torch.tensor([0.0, 1.2, 0.1], dtype=torch.float64))
    trajectory = dmp.rollout(start=start, start_velocity=omega, duration=1.7)
    assert quaternion.angle(trajectory.orientation[0], start) < 1e-7
    torch.testing.assert_close(trajectory.angular_velocity[0], omega)


def test_the_demonstrated_start_velocity_survives_a_new_goal():
    time, q = turning_motion()
    dmp = OrientationDMP.fit(time, q)
    goal = quaternion.exp(torch.tensor([1.0, 0.5, -0.4], dtype=torch.float64))
    first = dmp.rollout().angular_velocity[0]
    assert first.norm() > 0.1
    torch.testing.assert_close(dmp.rollout(goal=goal).angular_velocity[0], first)
    faster = dmp.rollout(goal=goal, speed=2.0).angular_velocity[0]
    torch.testing.assert_close(faster, 2 * first)


@pytest.mark.parametrize("angle", [90, 170])
def test_a_goal_past_half_a_turn_is_reached_on_the_demonstrated_side(angle):
    dmp = OrientationDMP.fit(S, turn(angle))
    further = quaternion.multiply(quaternion.exp(np.deg2rad(40) * AXIS), dmp.goal)
    trajectory = dmp.rollout(goal=further)
    assert quaternion.angle(trajectory.orientation[-1], further) < 1e-2
    way = trajectory.angular_velocity.norm(dim=-1).mean()
    assert np.rad2deg(way.item()) == pytest.approx(angle + 40, rel=0.05)


def test_moving_the_tool_frame_moves_the_motion_along():
    time, q = turning_motion()
    dmp = OrientationDMP.fit(time, q)
    tool = quaternion.exp(torch.tensor([0.4, 0.1, -1.0], dtype=torch.float64))
    moved = dmp.rollout(
        start=quaternion.multiply(dmp.start, tool), goal=quaternion.multiply(dmp.goal, tool)
    )
    expected = quaternion.multiply(dmp.rollout().orientation, tool)
    assert quaternion.angle(moved.orientation, expected).max() < 1e-7


def test_a_goal_that_jumps_moves_neither_pose_nor_velocity():
    time, q = turning_motion()
    dmp = OrientationDMP.fit(time, q)
    state = dmp.step(dmp.initial_state(), 1.2)
    goal = quaternion.exp(torch.tensor([0.1, -1.0, 0.4], dtype=torch.float64))
    jumped = dmp.step(state, 0.0, goal=goal)
    assert quaternion.angle(jumped.orientation, state.orientation) < 1e-7
    torch.testing.assert_close(jumped.angular_velocity, state.angular_velocity)
    for _ in range(60):
        jumped = dmp.step(jumped, 0.1)
    assert quaternion.angle(jumped.orientation, goal) < 1e-6


def turned_away(dmp, angle):
    """The goal, turned about another axis."""
    axis = torch.nn.functional.normalize(torch.tensor([0.3, -1.0, 0.5]).double(), dim=0)
    return quaternion.multiply(quaternion.exp(np.deg2rad(angle) * axis), dmp.goal)


def acceleration_of(dmp, state):
    """Angular acceleration at a state, times the duration squared."""
    motion = state.motion
    return angular_acceleration(
        motion.position, motion.rate, dmp.motion.second_derivative(motion)
    )


@pytest.mark.parametrize("angle", [90, 150])
def test_a_filtered_goal_leaves_the_angular_acceleration_without_a_jump(angle):
    dmp = OrientationDMP.fit(2 * S, turn(120))
    before = dmp.step(dmp.initial_state(), 1.0)
    goal = turned_away(dmp, angle)
    filtered = dmp.step(before, 0.0, goal=goal, goal_filter=8.0)
    plain = dmp.step(before, 0.0, goal=goal)
    torch.testing.assert_close(acceleration_of(dmp, filtered), acceleration_of(dmp, before))
    jump = (acceleration_of(dmp, plain) - acceleration_of(dmp, before)).norm()
    assert jump > 0.5 * 4 * dmp.rollout().angular_acceleration.norm(dim=-1).max()


@pytest.mark.parametrize("angle", [90, 150])
def test_a_goal_that_jumps_far_is_reached_without_a_detour(angle):
    dmp = OrientationDMP.fit(2 * S, turn(120))
    goal = turned_away(dmp, angle)
    state, speed = dmp.step(dmp.initial_state(), 1.0), []
    with shapes_unchecked(), torch.no_grad():
        for k in range(200):
            state = dmp.step(state, 0.02, goal_filter=8.0, **({} if k else {"goal": goal}))
            speed.append(state.angular_velocity.norm().item())
    assert quaternion.angle(state.orientation, goal) < 1e-3
    # At half time 60 degrees are left. The way is no longer than those and the new ones.
    assert np.rad2deg(sum(speed) * 0.02) < 60 + angle


def test_error_rate_inverts_angular_velocity():
    rng = torch.Generator().manual_seed(0)
    error = 3 * torch.randn(50, 3, generator=rng, dtype=torch.float64)
    error[0] = 0
    rate = torch.randn(50, 3, generator=rng, dtype=torch.float64)
    torch.testing.assert_close(error_rate(error, angular_velocity(error, rate)), rate)


def test_nearest_turn_is_the_same_rotation_closest_to_the_reference():
    rng = torch.Generator().manual_seed(0)
    error = torch.randn(200, 3, generator=rng, dtype=torch.float64)
    reference = 5 * torch.randn(200, 3, generator=rng, dtype=torch.float64)
    near = nearest_turn(error, reference)
    same = quaternion.angle(quaternion.exp(near), quaternion.exp(error))
    assert same.max() < 1e-7
    axis = torch.nn.functional.normalize(error, dim=-1)
    for turns in (-1, 1):
        other = near + 2 * torch.pi * turns * axis
        assert ((near - reference).norm(dim=-1) <= (other - reference).norm(dim=-1)).all()


@pytest.mark.parametrize(
    ("orientation", "complaint"),
    [
        (0.9 * turn(20), "orientation has norm 0.9000 at sample 0"),
        (turn(20)[:, :3], "quaternions"),
        (turn(20).masked_fill(S[:, None] == S[5], torch.nan), "orientation is nan at sample 5"),
        (turn(20)[:-1], "time has shape"),
    ],
)
def test_bad_orientations_are_refused(orientation, complaint):
    with shapes_unchecked(), pytest.raises(ValueError, match=complaint):
        OrientationDMP.fit(S, orientation)
    with shapes_unchecked(), pytest.raises(ValueError, match=complaint):
        PoseDMP.fit(S, torch.zeros(1000, 3), orientation)


def test_bad_poses_are_refused():
    with pytest.raises(ValueError, match="3 columns"):
        PoseDMP.fit(S, torch.zeros(1000, 4), turn(20))
    with pytest.raises(ValueError, match="body is nan at sample 0"):
        PoseDMP.fit(S, torch.zeros(1000, 3), turn(20), body=torch.full((1000, 1), torch.nan))
    dmp = PoseDMP.fit(S, torch.zeros(1000, 3), turn(20))
    with pytest.raises(ValueError, match="unit quaternions"):
        dmp.rollout(goal=Pose(torch.zeros(3), torch.zeros(4)))


def test_a_pose_without_body_has_none():
    dmp = PoseDMP.fit(S, torch.zeros(1000, 3).double(), turn(20))
    assert dmp.rollout().body.shape == (1000, 0)


def test_the_body_keeps_its_shape_when_the_pose_goes_elsewhere():
    time = 2 * S
    position = minimum_jerk(S)[:, None] * torch.tensor([0.3, 0.2, 0.1], dtype=torch.float64)
    body = torch.sin(3 * S)
    dmp = PoseDMP.fit(time, position, turn(40), body=body)
    goal = Pose(dmp.goal.position + 0.2, dmp.goal.orientation)
    moved = dmp.rollout(goal=goal)
    torch.testing.assert_close(moved.body, dmp.rollout().body)
    torch.testing.assert_close(moved.position[-1], goal.position, rtol=0, atol=1e-3)


def test_a_push_moves_the_position_alone():
    dmp = PoseDMP.fit(S, torch.zeros(1000, 3).double(), turn(40), body=torch.sin(3 * S))
    plain = dmp.step(dmp.initial_state(), 0.1)
    pushed = dmp.step(dmp.initial_state(), 0.1, coupling=[1.0, 0.0, 0.0])
    assert pushed.pose.position[0] > plain.pose.position[0] + 1e-3
    torch.testing.assert_close(pushed.pose.orientation, plain.pose.orientation)
    torch.testing.assert_close(pushed.body, plain.body)
