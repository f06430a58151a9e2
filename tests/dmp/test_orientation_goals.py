"""New goals for an orientation, all around: 36 axes by 5 angles in one batch."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from demo_motions import minimum_jerk
from scipy.spatial.transform import Rotation
from unchecked import shapes_unchecked

from hrc_learn.dmp import OrientationDMP, PoseDMP
from hrc_learn.dmp.orientation_error import angular_acceleration
from hrc_learn.geometry import Pose, quaternion

S = torch.linspace(0, 1, 1000, dtype=torch.float64)
TURN = 120
AWAY = torch.tensor([30.0, 60.0, 90.0, 120.0, 150.0], dtype=torch.float64)


def axes(n=36):
    """Unit vectors spread evenly over the sphere."""
    k = torch.arange(n, dtype=torch.float64) + 0.5
    polar, around = torch.acos(1 - 2 * k / n), torch.pi * (1 + 5**0.5) * k
    flat = [around.cos() * polar.sin(), around.sin() * polar.sin(), polar.cos()]
    return torch.stack(flat, dim=-1)


def fitted(**options):
    axis = torch.nn.functional.normalize(torch.tensor([1.0, 2.0, -0.5]).double(), dim=0)
    turn = quaternion.exp(np.deg2rad(TURN) * minimum_jerk(S)[:, None] * axis)
    return OrientationDMP.fit(2 * S, turn, **options)


def goals(dmp):
    """(5, 36, 4)."""
    away = torch.deg2rad(AWAY)[:, None, None] * axes()
    return quaternion.multiply(quaternion.exp(away), dmp.goal)


def test_no_goal_makes_the_path_flip():
    """The way is no longer than the demonstrated one and what the goal is moved by."""
    dmp = fitted(approach=1.0)
    motion, shown = dmp.rollout(goal=goals(dmp)), dmp.rollout()
    speed, nominal = (x.angular_velocity.norm(dim=-1) for x in (motion, shown))
    longest = 1 + AWAY / TURN
    assert (speed.mean(-1) <= 1.001 * longest[:, None] * nominal.mean()).all()
    assert (speed.amax(-1) <= 1.001 * longest[:, None] * nominal.max()).all()
    assert quaternion.angle(motion.orientation[..., -1, :], goals(dmp)).max() < 1e-3


def test_goals_close_to_each_other_have_paths_close_to_each_other():
    dmp = fitted(approach=1.0)
    near = torch.deg2rad(torch.arange(0, 150, 6.0)).double()[:, None, None] * axes()
    motion = dmp.rollout(goal=quaternion.multiply(quaternion.exp(near), dmp.goal))
    q = motion.orientation
    assert torch.rad2deg(quaternion.angle(q[1:], q[:-1])).max() < 18


def test_switched_at_half_time_the_acceleration_goes_on_and_no_path_flips():
    dmp = fitted()
    peak = dmp.rollout().angular_acceleration.norm(dim=-1).max()
    goal = goals(dmp)
    with torch.no_grad():
        state = dmp.step(dmp.initial_state(duration=torch.full((5, 36), 2.0).double()), 1.0)
        before = acceleration(dmp, state)
        state = dmp.step(state, 0.0, goal=goal, goal_filter=4.0)
        assert (acceleration(dmp, state) - before).norm(dim=-1).max() < 1e-6 * peak
        soon = acceleration(dmp, dmp.step(state, 0.001, goal_filter=4.0))
        assert (soon - before).norm(dim=-1).max() < 0.1 * peak
        way = torch.zeros(5, 36, dtype=torch.float64)
        for _ in range(80):
            state = dmp.step(state, 0.05, goal_filter=4.0)
            way += 0.05 * state.angular_velocity.norm(dim=-1)
    assert quaternion.angle(state.orientation, goal).max() < 5e-3
    # Half of the turn was left, and the state was moving on in its sense.
    assert (torch.rad2deg(way) < TURN / 2 + AWAY[:, None] + 5).all()


def acceleration(dmp, state):
    """Angular [rad/s^2]."""
    motion = state.motion
    curvature = dmp.motion.second_derivative(motion)
    scaled = angular_acceleration(motion.position, motion.rate, curvature)
    return scaled / motion.duration[..., None] ** 2


@pytest.mark.parametrize("goal_filter", [None, 6.0])
def test_the_sign_of_a_new_goal_means_nothing(goal_filter):
    dmp = fitted()
    goal = goals(dmp)[:, ::6]
    states = [dmp.initial_state(duration=torch.full((5, 6), 2.0).double())] * 2
    for k in range(30):
        new = {"goal": goal} if k == 10 else {}
        other = {"goal": -goal} if k == 10 else {}
        states = [
            dmp.step(state, 0.1, goal_filter=goal_filter, **given)
            for state, given in zip(states, (new, other), strict=True)
        ]
    torch.testing.assert_close(states[0].angular_velocity, states[1].angular_velocity)
    assert quaternion.angle(states[0].orientation, states[1].orientation).max() < 1e-7


def pose_around(dmp):
    """A pose that turns as the given primitive does."""
    return PoseDMP.fit(2 * S, S[:, None] * torch.ones(3), dmp.rollout().orientation)


@pytest.fixture(scope="module")
def kinds():
    orientation = fitted(approach=1.0)
    offset = orientation.motion.coordinates().detach()
    offset[:, -1] += torch.tensor([0.2, -0.1, 0.4])
    offset = orientation.motion.with_coordinates(offset)
    return {
        "orientation": orientation,
        "pose": pose_around(orientation),
        "goal with an error": OrientationDMP(offset, orientation.goal),
    }


def turned(error, reference):
    """SciPy's rotation with this error."""
    reference = Rotation.from_quat(np.asarray(reference), scalar_first=True)
    return Rotation.from_rotvec(-np.asarray(error)) * reference


def spin(error, rate, reference, h=1e-5):
    """Angular velocity by central differences."""
    before, after = (turned(error + k * h * rate, reference) for k in (-1, 1))
    return (after * before.inv()).as_rotvec() / (2 * h)


@pytest.mark.parametrize("kind", ["orientation", "pose", "goal with an error"])
@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-5, 0.4, 3.1, 4.5, 8.0, 20.0])
@pytest.mark.parametrize("stays", [False, True])
def test_a_goal_that_jumps_changes_only_what_is_seen_from_it(kinds, kind, angle, stays):
    dmp, rng = kinds[kind], np.random.default_rng(round(10 * angle))
    E = dmp.error_columns
    axis, rate = rng.normal(size=(2, 3))
    error = angle * axis / np.linalg.norm(axis)
    with torch.no_grad(), shapes_unchecked():
        state = dmp.initial_state()
        columns = state.motion.position.clone(), state.motion.rate.clone()
        columns[0][E], columns[1][E] = torch.tensor(error), torch.tensor(rate)
        motion = replace(state.motion, position=columns[0], rate=columns[1])
        state = replace(state, motion=motion)
        q = Rotation.random(rng=rng).as_quat(scalar_first=True)
        if stays:
            q = -1.3 * (dmp.goal.orientation if kind == "pose" else dmp.goal)
        place = torch.tensor([1.0, -2.0, 3.0]).double()
        goal = Pose(place, torch.as_tensor(q)) if kind == "pose" else q
        new = dmp.retarget(state, goal, filtered=False)
        plain = dmp.retarget(state, goal)
    moved = new.motion.position[E].numpy(), new.motion.rate[E].numpy(), new.reference
    change = turned(*moved[::2]) * turned(error, state.reference).inv()
    assert change.magnitude() < 1e-12
    # A goal that stays, whichever the sign and length of its quaternion, changes nothing.
    if stays:
        np.testing.assert_allclose(moved[0], error, rtol=0, atol=1e-7)
    expected = spin(error, rate, state.reference)
    np.testing.assert_allclose(spin(*moved), expected, rtol=0, atol=1e-7)
    # No other number of whole turns is closer to where it was.
    turn = 2 * np.pi * moved[0] / np.linalg.norm(moved[0]) if moved[0].any() else 0.0
    far = [np.linalg.norm(moved[0] + k * turn - error) for k in (-1, 0, 1)]
    assert far[1] <= min(far) + 1e-9
    torch.testing.assert_close(new.motion.position, plain.motion.position, rtol=0, atol=1e-7)
    torch.testing.assert_close(new.reference, plain.reference)
    if kind == "pose":
        torch.testing.assert_close(new.motion.target[:3], place)
        torch.testing.assert_close(state.motion.target[:3], dmp.goal.position)


def test_whole_turns_away_only_the_rate_along_the_error_stays(kinds):
    dmp = kinds["orientation"]
    axis = torch.tensor([0.6, 0.0, -0.8], dtype=torch.float64)
    with torch.no_grad():
        state = dmp.initial_state()
        rate = torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)
        motion = replace(state.motion, position=2 * torch.pi * axis, rate=rate)
        new = dmp.retarget(replace(state, motion=motion), dmp.goal, filtered=False).motion
    torch.testing.assert_close(new.position, 2 * torch.pi * axis)
    torch.testing.assert_close(new.rate, (rate @ axis) * axis, rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    "wrong", [[0.1, 0.2, 0.1, 0.0], [1.0, 0.0, 0.0], [np.nan, 0, 0, 1], 1.0]
)
def test_a_goal_that_is_no_orientation_is_refused(kinds, wrong):
    dmp = kinds["orientation"]
    with torch.no_grad(), shapes_unchecked(), pytest.raises(ValueError, match="unit quat"):
        dmp.step(dmp.initial_state(), 0.01, goal=wrong)


@pytest.mark.parametrize(
    ("place", "length", "message"),
    [
        ([np.nan, 0.0, 0.0], 1.0, "position of goal"),
        ([0.0, np.inf, -np.inf], 1.0, "position of goal"),
        ([0.0, 0.0], 1.0, "position of goal"),
        ([0.0, 0.0, 0.0], 0.5, "unit quat"),
        ([0.0, 0.0, 0.0], 1e100, ""),
        ([1e308, 1e308, 1e308], 0.51, ""),
    ],
)
def test_a_pose_is_refused_or_taken_for_one_motion_as_for_several(
    kinds, place, length, message
):
    """One motion is computed in Python's numbers, several by PyTorch."""
    dmp, found = kinds["pose"], []
    q = length * torch.tensor([0.5, 0.5, -0.5, 0.5]).double()
    with torch.no_grad(), shapes_unchecked():
        for batch in ((), (1,)):
            state = dmp.initial_state(duration=torch.full(batch, 2.0).double())
            position = torch.tensor(place, dtype=torch.float64)
            goal = Pose(position.expand(*batch, -1), q.expand(*batch, 4))
            if message:
                with pytest.raises(ValueError, match=message):
                    dmp.retarget(state, goal, filtered=False)
            else:
                new = dmp.retarget(state, goal, filtered=False)
                found.append((new.motion.position, new.motion.target[..., :3], new.reference))
    for one, several in zip(*found, strict=True) if found else ():
        torch.testing.assert_close(one, several[0], rtol=1e-9, atol=1e-9)
