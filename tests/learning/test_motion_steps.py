"""Steps of playing and of multiplying motions, on small arrays whose answer is known."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from hrc_learn.demos import Demonstration
from hrc_learn.geometry import Pose
from hrc_learn.kinematics import panda
from hrc_learn.learning.motion_playing import (
    DT,
    BeyondLimitsError,
    Target,
    _completed,
    _distance,
    _duration,
    _pose_errors,
    _require_range,
    _times,
    _within_limits,
)
from hrc_learn.learning.multiply_motions import (
    Draws,
    Segmentation,
    _best_frame,
    _collisions,
    _switches,
    _turned,
    find_segments,
    frame_of,
)

pytestmark = pytest.mark.simulation


def poses(positions, turns):
    q = turns.as_quat(scalar_first=True)
    return Pose(torch.tensor(np.asarray(positions)).double(), torch.from_numpy(q))


@pytest.mark.parametrize(("periods", "count"), [(1, 2), (10, 11), (10.5, 12), (10.999, 12)])
def test_times_reach_the_end_and_no_further(periods, count):
    found = _times(periods * DT)
    assert len(found) == count
    np.testing.assert_allclose(np.diff(found), DT)
    assert float(found[-2]) < periods * DT <= float(found[-1]) + 1e-9


@pytest.mark.parametrize(
    ("given", "expected"), [(None, 2.5), (1.5, 1.5), (1.01 * DT, 1.01 * DT)]
)
def test_a_duration_is_the_models_unless_it_is_given(given, expected):
    model: Any = SimpleNamespace(primitives={"pose": SimpleNamespace(duration=2.5)})
    assert _duration(model, "pose", given) == expected
    for wrong in (DT, 0.0, -1.0, np.inf, np.nan):
        with pytest.raises(ValueError, match=f"more than {DT} s, but is {wrong}"):
            _duration(model, "pose", wrong)


def test_what_a_target_leaves_open_is_as_usual():
    usual = poses([1.0, 2, 3], Rotation.from_euler("z", 0.3))
    place = torch.tensor([4.0, 5, 6]).double()
    turn = torch.tensor([0.0, 1, 0, 0]).double()
    for target in (None, Target(), Target(orientation=turn)):
        assert _completed(target, usual) is usual
    moved = _completed(Target(position=place), usual)
    assert torch.equal(moved.position, place)
    assert torch.equal(moved.orientation, usual.orientation)
    assert torch.equal(
        _completed(Target(position=place, orientation=turn), usual).orientation, turn
    )


def test_errors_are_of_the_last_pose_in_millimetres_and_degrees():
    path = poses([[9.0] * 3, [0.1] * 3], Rotation.from_rotvec([[0, 0, 2.0], [0, 0, 0.5]]))
    place = torch.tensor([0.1, 0.13, 0.06]).double()
    turn = torch.from_numpy(Rotation.from_euler("z", 0.3).as_quat(scalar_first=True))
    found = _pose_errors(path, Target(position=place, orientation=turn))
    assert found["goal_position_error_mm"] == pytest.approx(50)
    assert found["goal_turn_error_deg"] == pytest.approx(np.degrees(0.2))
    assert _pose_errors(path, Target()) == {}


def test_a_path_up_to_the_limits_is_in_range_and_its_worst_excess_is_named():
    lower, upper = panda.limits.lower, panda.limits.upper
    path = torch.lerp(lower, upper, torch.linspace(0, 1, 5).double()[:, None])
    _require_range(panda, path)
    for row, joint, sign, share in ((3, 2, 1, "75%"), (1, 4, -1, "25%")):
        wrong = path.clone()
        wrong[row, joint] = (upper if sign > 0 else lower)[joint] + sign * 0.123
        wrong[4, 0] = upper[0] + 0.05
        message = rf"{panda.joint_names[joint]} would be 0\.123 rad beyond its range at {share}"
        with pytest.raises(BeyondLimitsError, match=message):
            _require_range(panda, wrong)
    with pytest.raises(BeyondLimitsError, match="at 0%"):
        _require_range(panda, upper[None] + 1)


def test_a_motion_is_as_far_from_a_path_as_from_its_nearest_quarter():
    rng = np.random.default_rng(0)
    path = torch.from_numpy(np.cumsum(rng.normal(0, 0.1, (6, 3)), axis=0))
    fine = np.concatenate(
        [path[:-1].numpy() + f * np.diff(path.numpy(), axis=0) for f in (0, 0.25, 0.5, 0.75)]
    )
    fine = np.vstack([fine, path[-1:].numpy()])
    joints = fine[rng.integers(len(fine), size=9)] + rng.normal(0, 0.02, (9, 3))
    expected = np.abs(joints[:, None] - fine).max(-1).min(1).max()
    assert _distance(joints, path) == pytest.approx(expected)
    assert _distance(fine, path) == pytest.approx(0, abs=1e-12)


def test_a_smoothed_path_keeps_the_limits_and_comes_to_rest_at_its_end():
    start, end = panda.ready.numpy(), panda.ready.numpy() + 0.2
    steps = np.concatenate([np.linspace(0, 1, 60), np.ones(5)])[:, None]
    path = torch.from_numpy(start + steps * (end - start))
    made = _within_limits(panda, path)
    assert len(made) > len(path)
    np.testing.assert_array_equal(made[0], start)
    np.testing.assert_allclose(made[-1], end, atol=1e-5)
    assert np.abs(made[-1] - made[-2]).max() < 1e-4 * DT * 1.01
    limits = (panda.limits.velocity, panda.limits.acceleration, panda.limits.jerk)
    for order, limit in enumerate(limits, 1):
        rate = np.abs(np.diff(made, n=order, axis=0)) / DT**order
        assert (rate <= limit.numpy() * (1 + 1e-6)).all()
    still = torch.from_numpy(np.broadcast_to(start, (3, 7)).copy())
    assert len(_within_limits(panda, still)) == 3


def opening(*levels):
    return np.repeat(levels, 10).astype(float)


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        (opening(0.08, 0.04), [9]),
        (opening(0.08, 0.04, 0.08), [9, 19]),
        (opening(0.04), []),
        (opening(0.08, 0.0765), []),  # hardly a change
        (np.interp(np.arange(40), [12, 22], [0.08, 0.04]), [12]),
        (np.interp(np.arange(40), [0, 8], [0.08, 0.04]), [0]),
    ],
)
def test_a_gripper_switches_where_it_begins_to_move(values, expected):
    assert _switches(values, values.min(), values.max()) == expected


def test_a_change_of_a_twentieth_is_none():
    assert _switches(opening(20.0, 19.0), 19.0, 20.0) == []
    assert _switches(opening(1.0, 0.94), 0.94, 1.0) == [9]
    assert _switches(opening(-1.0, -0.94), -1.0, -0.94) == [9]
    # A drift of less than a fiftieth of the range per frame is none.
    drift = np.concatenate([1 - 0.01 * np.arange(20), opening(0.0)])
    assert _switches(drift, 0.0, 1.0) == [19]


def ends_of(objects, local, wobble=0.0, seed=0):
    """Ends of a motion that are `local` in the frames of the objects, to a wobble."""
    rng = np.random.default_rng(seed)
    here = Pose(
        local.position
        + wobble * torch.from_numpy(rng.standard_normal((len(objects.position), 3))),
        local.orientation,
    )
    return objects @ here


def places(seed, count=4):
    rng = np.random.default_rng(seed)
    return poses(
        rng.uniform(-0.3, 0.3, (count, 3)), Rotation.from_rotvec(rng.normal(0, 0.8, (count, 3)))
    )


LOCAL = poses([[0.0, 0.0, 0.1]] * 4, Rotation.from_rotvec([[0.3, 0, 0]] * 4))


def test_a_segment_follows_the_object_at_which_all_its_ends_agree():
    objects = {"cup": places(0), "lid": places(1)}
    assert _best_frame(ends_of(objects["lid"], LOCAL), objects) == "lid"
    assert _best_frame(ends_of(objects["cup"], LOCAL, 5e-4), objects) == "cup"
    upright = Pose(objects["cup"].position, torch.tensor([[1.0, 0, 0, 0]] * 4).double())
    assert _best_frame(ends_of(upright, LOCAL), objects) == "cup position"
    fixed = Pose(LOCAL.position[:1].expand(4, 3) + 5, LOCAL.orientation)
    assert _best_frame(fixed, objects) == "base"
    # Of two that stand alike the nearer one.
    beside = Pose(objects["cup"].position + 0.2, objects["cup"].orientation)
    same = {"far": Pose(upright.position + 0.2, upright.orientation), "near": upright}
    assert _best_frame(ends_of(upright, LOCAL), same) == "near"
    assert beside.position.shape == (4, 3)


@pytest.mark.parametrize(
    ("turn", "shift", "frame"), [(0.0, 0.0, "cup"), (0.2, 0.0, "base"), (0.0, 0.02, "base")]
)
def test_ends_that_scatter_by_2_cm_or_a_fifth_of_a_radian_do_not_agree(turn, shift, frame):
    """Ends agree in the base up to the tremor; a radian counts as 10 cm."""
    rng = np.random.default_rng(0)
    wobble = Rotation.from_rotvec(turn * rng.standard_normal((4, 3)))
    scatter = shift * rng.standard_normal((4, 3))
    cup = poses(np.array([0.5, 0, 0.1]) + scatter, wobble)
    fixed = poses([[0.5, 0.0, 0.15]] * 4, Rotation.from_rotvec([[0.3, 0, 0]] * 4))
    found = _best_frame(fixed, {"cup": cup})
    assert found == frame or (turn > 0 and found == "cup position")
    assert (found == "cup") == (frame == "cup")


def test_frames_of_a_scene_are_the_base_an_object_or_its_place():
    objects, like = {"cup": places(0)}, places(1)
    base = frame_of(objects, "base", like)
    np.testing.assert_array_equal(base.position, np.zeros((4, 3)))
    np.testing.assert_array_equal(base.orientation, [[1, 0, 0, 0]] * 4)
    assert frame_of(objects, "cup", like) is objects["cup"]
    place = frame_of(objects, "cup position", like)
    np.testing.assert_array_equal(place.position, objects["cup"].position)
    np.testing.assert_array_equal(place.orientation, [[1, 0, 0, 0]] * 4)


def test_twists_are_turned_into_the_axes_of_the_base():
    frame, twist = (
        places(2),
        torch.randn(4, 6, generator=torch.Generator().manual_seed(0)).double(),
    )
    turns = Rotation.from_quat(frame.orientation.numpy(), scalar_first=True)
    expected = np.concatenate([turns.apply(twist[:, :3]), turns.apply(twist[:, 3:])], axis=1)
    np.testing.assert_allclose(_turned(frame, twist), expected)


def demo(gripper, episode=0):
    n = len(gripper)
    return Demonstration(
        time=np.arange(n) / 20,
        gripper=gripper,
        joint_position=np.zeros((n, 7)),
        joint_names=panda.joint_names,
        fps=20,
        episode=episode,
    )


def test_cuts_are_six_frames_apart_and_end_with_the_demonstration():
    objects, gripper = {"cup": places(0, 1)}, np.ones(40)
    tool = [poses(np.zeros((40, 3)), Rotation.from_rotvec(np.zeros((40, 3))))]
    for begin, cuts in ((6, (0, 6, 39)), (5, (0, 39)), (33, (0, 33, 39)), (34, (0, 39))):
        values = gripper.copy()
        values[begin + 1 :] = 0.0
        found = find_segments([demo(values)], objects, tool)
        assert found.cuts == {0: cuts}
        assert len(found.frames) == len(cuts) - 1


@pytest.mark.parametrize(
    ("departures", "cuts"),
    [
        ([], (0, 10, 25, 49)),
        ([14], (0, 14, 25, 49)),
        ([17, 14, 30, 49], (0, 14, 30, 49)),  # the first object that moves after each switch
        ([19], (0, 19, 25, 49)),
        ([20], (0, 10, 25, 49)),  # too near to the next switch
        ([10], (0, 10, 25, 49)),
        ([4, 44], (0, 10, 25, 49)),  # before all switches, and too near to the end
    ],
)
def test_a_grasp_ends_where_its_object_begins_to_move(departures, cuts):
    """The hand may still approach the object while the gripper closes."""
    objects, gripper = {"cup": places(0, 1)}, np.ones(50)
    gripper[11:26] = 0.0
    tool = [poses(np.zeros((50, 3)), Rotation.from_rotvec(np.zeros((50, 3))))]
    found = find_segments([demo(gripper)], objects, tool, [departures])
    assert found.cuts == {0: cuts}


def test_segments_are_listed_with_their_times():
    demos = [demo(np.ones(40), 3), demo(np.ones(50), 5)]
    cuts = {3: (0, 20, 39), 5: (0, 10, 49)}
    rows = Segmentation(frames=("cup", "base"), cuts=cuts).rows(demos)
    assert rows == [
        ("segment", "frame", "episode 3", "episode 5"),
        ("0", "cup", "0.00 .. 1.00 s", "0.00 .. 0.50 s"),
        ("1", "base", "1.00 .. 1.95 s", "0.50 .. 2.45 s"),
    ]


def test_a_part_of_the_draws_is_those_motions():
    draws = Draws(
        scene={"cup": places(0)},
        weights=torch.eye(4).double(),
        speed=torch.arange(4).double(),
        start=torch.arange(12).double().view(4, 3),
    )
    part = draws[torch.tensor([2, 0])]
    assert part.speed.tolist() == [2, 0]
    np.testing.assert_array_equal(part.weights, np.eye(4)[[2, 0]])
    np.testing.assert_array_equal(part.start, [[6, 7, 8], [0, 1, 2]])
    np.testing.assert_array_equal(part.scene["cup"].position, places(0).position[[2, 0]])


def collisions(boxes, q):
    return _collisions(panda, torch.tensor(boxes).double().view(-1, 6), q)


def test_collisions_are_of_the_arm_itself_before_those_with_boxes():
    elbow = panda.link_poses(panda.ready).position[4].tolist()
    ready = panda.ready.expand(7, 7)
    folded = ready.clone()
    folded[:, 3], folded[:, 5] = -3.0, 0.0
    both = torch.stack([ready, folded])
    assert collisions([], both) == ["", "collides with the arm itself"]
    far, near = [5.0, 0, 0, 0.1, 0.1, 0.1], [*elbow, 0.02, 0.02, 0.02]
    assert collisions([far], ready[None]) == [""]
    found = collisions([far, near], both)
    assert found == ["collides with an obstacle", "collides with the arm itself"]
    assert collisions([near], both[:0]) == []
