"""Measures of a layout against NumPy, SciPy and a search through all half turns."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from hrc_learn.geometry import Pose
from hrc_learn.kinematics import coarse_orientation, panda
from hrc_learn.kinematics.inverse import follow_poses
from hrc_learn.sim.layout_quality import (
    _other_side,
    _turned_above_table,
    clearance_quality,
    marked_turns,
    marker_seen,
    path_quality,
)
from hrc_learn.sim.scene import SceneConfig, marked_plate
from hrc_learn.sim.workplace import (
    Workplace,
    _beside,
    _placed,
    _workplaces,
    pose_on_table,
)

pytestmark = pytest.mark.simulation

WORKPLACE = Workplace()
REACH = (0.1, 0.08)


class Changed:
    """The panda with a hand of another size, or with slower joints."""

    def __init__(self, size=1.0, velocity=1.0):
        self.hand_size = size
        self.limits = replace(panda.limits, velocity=velocity * panda.limits.velocity)

    def __getattr__(self, name):
        return getattr(panda, name)


def constant(furniture, itself):
    return lambda q: (furniture + 0 * q[..., 0], itself + 0 * q[..., 0])


def quality(q, error, clear=1.0, size=1.0):
    """Margin to joint limits, singularities and contact, by NumPy."""
    limits, jacobian = panda.limits, panda.jacobian(q).numpy()
    q = q.numpy()
    margin = np.minimum(q - limits.lower.numpy(), limits.upper.numpy() - q).min(-1) / 0.25
    singular = np.linalg.svd(jacobian, compute_uv=False)[..., -1] / (0.08 * size)
    least = np.minimum(np.minimum(margin, singular), clear)
    return np.where(error.numpy() < 5e-3, least.clip(0, 1), 0)


@pytest.mark.parametrize(
    ("furniture", "itself", "size", "expected"),
    [
        (0.04, 9.0, 1.0, 1.0),
        (0.01, 9.0, 1.0, 0.25),
        (9.0, 0.01, 1.0, 1.0),
        (9.0, 0.002, 1.0, 0.2),
        (-0.02, 0.01, 1.0, -0.5),
        (0.04, 9.0, 2.0, 0.5),
    ],
)
def test_four_centimetres_from_furniture_and_one_from_itself_are_ample(
    furniture, itself, size, expected
):
    clearances = constant(furniture, itself)
    found = clearance_quality(clearances, torch.zeros(3, 7).double(), size)
    np.testing.assert_allclose(found, np.full(3, expected))
    if size == 1.0:
        np.testing.assert_allclose(clearance_quality(clearances, torch.zeros(7)), expected)


@cache
def starts():
    """Two postures at home: near the limits of joints, and with a margin."""
    return torch.stack([WORKPLACE.home_joints(), WORKPLACE.home_joints(q7_offset=0.3)])


@pytest.mark.parametrize(("slower", "clear"), [(1.0, 1.0), (1.0, 0.1), (1.0, -0.1), (0.2, 1.0)])
def test_a_path_is_as_good_as_its_worst_sample_and_as_fast_as_the_job_asks(slower, clear):
    points, arm = WORKPLACE.path_to_shelf("upper"), Changed(velocity=slower)
    ends = np.append(0, np.cumsum(np.linalg.norm(np.diff(points.numpy(), axis=0), axis=1)))
    at = np.linspace(0, ends[-1], 60)
    position = np.stack([np.interp(at, ends, column) for column in points.numpy().T], axis=-1)
    there = torch.from_numpy(position)
    path = Pose(there, coarse_orientation(there, WORKPLACE.level_at))
    q, error = follow_poses(panda, path, starts())
    # Largest speed of a minimum-jerk motion of 14 s along 60 samples.
    speed = np.abs(np.diff(q.numpy(), axis=0)).max(axis=0) * 60 * 1.875 / 14
    load = (speed / (slower * panda.limits.velocity.numpy())).max(-1)
    expected = quality(q, error, clear).min(axis=0) * np.minimum(1, 0.8 / load)
    assert (expected.max() > 0.02) == (clear > 0)
    assert (load > 0.8).all() == (slower < 1)
    clearances = constant(0.04 * clear, 1.0)
    found = path_quality(arm, clearances, [points], WORKPLACE.level_at, starts())
    np.testing.assert_allclose(found, expected, rtol=1e-6)


@cache
def turned():
    return _turned_above_table(panda, WORKPLACE.hover(), REACH, WORKPLACE.hover_joints())


def test_the_gripper_turns_both_ways_above_the_middle_and_the_corners():
    q, error = turned()
    assert q.shape == (49, 5, 7)
    hover, tool = WORKPLACE.hover(), panda.forward(q)
    corners = np.array([[0, 0, 0], [1, 1, 0], [1, -1, 0], [-1, 1, 0], [-1, -1, 0]])
    places = hover.position.numpy() + corners * (*REACH, 0)
    usual = Rotation.from_quat(hover.orientation.numpy(), scalar_first=True)
    reached = error.numpy() < 1e-4
    # The panda does not get to the last turns of some corners.
    assert reached[3:-3].all()
    for i, turn in enumerate(np.linspace(-np.pi, np.pi, 49)):
        expected = Rotation.from_euler("z", turn) * usual
        for k in np.flatnonzero(reached[i]):
            np.testing.assert_allclose(tool.position[i, k], places[k], atol=1e-4)
            own = Rotation.from_quat(tool.orientation[i, k].numpy(), scalar_first=True)
            assert (own * expected.inv()).magnitude() < 1e-4


def test_the_other_side_of_the_hand_is_half_a_turn_about_its_axis():
    tilt = Rotation.from_euler("xyz", [0.3, -0.2, 0.9])
    plate = replace(
        marked_plate(1.0, 0.05),
        position=(0.01, 0.14, 0.03),
        orientation=tuple(tilt.as_quat(scalar_first=True).tolist()),
    )
    other, half = _other_side(plate), Rotation.from_euler("z", np.pi)
    np.testing.assert_allclose(other.position, half.apply(plate.position), atol=1e-12)
    own = Rotation.from_quat(other.orientation, scalar_first=True)
    assert (own * (half * tilt).inv()).magnitude() < 1e-12
    assert other.marker == plate.marker


@pytest.mark.parametrize(
    ("furniture", "slope", "flipped"),
    [(1.0, 0.0, False), (0.01, 0.0, True), (0.02, 2e-3, False)],
)
def test_the_best_half_turn_has_the_marker_in_view_and_the_largest_margin(
    furniture, slope, flipped
):
    """With a slope, the least margin is at one end of the half turn."""
    camera, plate = WORKPLACE.scene.camera, WORKPLACE.scene.arm.marker
    assert plate is not None
    if flipped:
        plate = _other_side(plate)
    q, error = turned()
    margin = lambda q: furniture + slope * (q[..., 6] - 0.8)  # noqa: E731
    good = quality(q, error, margin(q.numpy()) / 0.04)
    choices = []
    for side in (plate, _other_side(plate)):
        seen = (good > 0) & marker_seen(panda, camera, side, q).numpy()
        for first in range(25):
            window = slice(first, first + 25)
            least, share = good[window].min(), seen[window].mean()
            score = (round(share, 2), least - abs(first - 12) / 24)
            choices.append((score, least, share, side, first))
    best = max(choices, key=lambda choice: choice[0])
    hover, joints = WORKPLACE.hover(), WORKPLACE.hover_joints()
    clearances = lambda q: (margin(q), 1 + 0 * q[..., 0])  # noqa: E731
    found = marked_turns(panda, clearances, camera, plate, hover, REACH, joints)
    assert found.quality == pytest.approx(best[1], rel=1e-9)
    assert found.seen == pytest.approx(best[2])
    assert found.plate == best[3]
    begin = -np.pi + best[4] * np.pi / 24
    np.testing.assert_allclose(found.turns, (begin, begin + np.pi))


def test_the_usual_place_at_scale_one_is_the_usual_place():
    usual = SceneConfig()
    place = _placed(usual, 1.0, 0.0, 0.0, WORKPLACE.shelf_depth)
    assert place.scene.table == usual.table
    assert place.scene.objects == usual.objects
    np.testing.assert_allclose(place.scene.camera.pose, usual.camera.pose)
    assert replace(place, scene=WORKPLACE.scene).home_position == WORKPLACE.home_position
    for name in ("table_centre", "shelf_x", "hover_height", "level_at", "clearance", "palm"):
        assert getattr(place, name) == getattr(WORKPLACE, name)
    assert place.fingertip == WORKPLACE.fingertip
    cabinet, own = usual.cabinet, place.scene.cabinet
    np.testing.assert_allclose(
        (own.left, own.right, own.depth, own.top, own.door_reach),
        (cabinet.left, cabinet.right, cabinet.depth, cabinet.top, cabinet.door_reach),
    )
    assert own.shelves == cabinet.shelves
    # Objects stand as far inside as asked, level.
    assert own.front - place.shelf_depth == pytest.approx(-place.level_at)


def test_a_nearer_table_keeps_its_height_and_a_shifted_cabinet_its_width():
    usual = SceneConfig()
    place = _placed(usual, 0.7, 0.1, -0.05, 0.05, far=1.4)
    scene, table, cabinet = place.scene, usual.table, usual.cabinet
    np.testing.assert_allclose(scene.table.centre, np.multiply(table.centre, (0.7, 0.7, 1)))
    np.testing.assert_allclose(
        scene.table.half_size, np.multiply(table.half_size, (0.7, 0.7, 1))
    )
    np.testing.assert_allclose(
        scene.camera.pose[:3, 3], usual.camera.pose[:3, 3] * (0.7, 0.7, 1)
    )
    np.testing.assert_allclose(place.table_centre, np.multiply(WORKPLACE.table_centre, 0.7))
    own = scene.cabinet
    assert own.left == pytest.approx(0.7 * cabinet.left + 0.1)
    assert own.right - own.left == pytest.approx(cabinet.right - cabinet.left)
    assert own.top == pytest.approx(cabinet.top - 0.05)
    assert own.door_reach == pytest.approx(0.7 * cabinet.door_reach)
    for name, height in cabinet.shelves.items():
        assert own.shelves[name] == pytest.approx(0.7 * height - 0.05)
    x, y, z = WORKPLACE.home_position
    np.testing.assert_allclose(place.home_position, (0.7 * x + 0.1, y, 0.7 * z))
    higher = _placed(usual, 0.7, 0.0, 0.1, 0.05)
    assert higher.home_position[2] == pytest.approx(0.7 * z + 0.1)
    assert place.shelf_x == pytest.approx(0.7 * WORKPLACE.shelf_x + 0.1)
    assert place.shelf_depth == 0.05
    assert place.level_at == pytest.approx(1.4 * 0.7 * WORKPLACE.level_at)
    assert own.front == pytest.approx(0.05 - place.level_at)
    for name in ("hover_height", "fingertip", "palm", "clearance", "approach"):
        assert getattr(place, name) == getattr(WORKPLACE, name)


def test_a_smaller_hand_works_in_a_smaller_place():
    arm = replace(SceneConfig().arm, robot=Changed(size=0.5))
    usual = replace(SceneConfig(), arm=arm)
    whole, half = (_placed(scene, 0.8, 0.1, 0.1, 0.1) for scene in (SceneConfig(), usual))
    names = ("table_centre", "shelf_x", "hover_height", "fingertip", "palm", "clearance")
    for name in (*names, "approach", "shelf_depth", "level_at"):
        np.testing.assert_allclose(
            np.multiply(2, getattr(half, name)), getattr(whole, name), rtol=1e-12
        )
    large, small = whole.scene.cabinet, half.scene.cabinet
    for name in ("left", "right", "depth", "top", "front"):
        assert 2 * getattr(small, name) == pytest.approx(getattr(large, name))
    np.testing.assert_allclose(
        2 * half.scene.camera.pose[:3, 3], whole.scene.camera.pose[:3, 3]
    )
    for one, other in zip(half.scene.objects, whole.scene.objects, strict=True):
        np.testing.assert_allclose(np.multiply(2, one.half_size), other.half_size)
    np.testing.assert_allclose(half.scaled((0.2, 0.4, 0.6)), (0.1, 0.2, 0.3))
    front, goal = (half.path_to_shelf("upper", lift)[1, 2] for lift in (0.03, 0.0))
    assert front - goal == pytest.approx(0.015)


def test_beside_the_first_axis_cabinet_home_and_shelves_lie_in_one_plane():
    place = _placed(SceneConfig(), 0.7, 0.0, 0.0, 0.05, far=1.6)
    moved = _beside(place, 0.55)
    axis = float(panda.joint_origins(panda.ready)[0, 0])
    cabinet, before = moved.scene.cabinet, place.scene.cabinet
    assert (cabinet.left + cabinet.right) / 2 == pytest.approx(axis)
    assert cabinet.right - cabinet.left == pytest.approx(before.right - before.left)
    assert moved.shelf_x == pytest.approx(axis)
    assert moved.hover_height == pytest.approx(0.85 * place.hover_height)
    heights = [float(place.shelf(name).position[2]) for name in place.shelf_names()]
    np.testing.assert_allclose(
        moved.home_position, (axis, -0.55 * place.level_at, np.mean(heights))
    )
    # The camera has moved away from the base and looks at the middle of the table.
    eye = moved.scene.camera.pose[:3, 3]
    np.testing.assert_allclose(eye, place.scene.camera.pose[:3, 3] * (1.5, 1.5, 1))
    middle = moved.scene.camera.project(np.array([*moved.table_centre, 0.0]))
    camera = moved.scene.camera
    np.testing.assert_allclose(middle, (camera.matrix[0, 2], camera.matrix[1, 2]), atol=1e-6)


@pytest.mark.parametrize(("beside", "count"), [(False, 18), (True, 24)])
def test_layouts_are_all_different_and_begin_with_the_usual_one(beside, count):
    places = list(_workplaces(panda, 0.7, beside))
    keys = {
        (
            p.shelf_x,
            p.shelf_depth,
            p.level_at,
            p.home_position,
            tuple(p.scene.cabinet.shelves.values()),
        )
        for p in places
    }
    assert len(places) == len(keys) == count
    first = places[0]
    if not beside:
        assert first.shelf_depth == 0.10
        assert first.shelf_x == pytest.approx(0.7 * WORKPLACE.shelf_x)
        shifts = [
            abs(p.shelf_x - first.shelf_x) + abs(p.scene.cabinet.top - first.scene.cabinet.top)
            for p in places
        ]
        assert shifts == sorted(shifts, key=lambda shift: round(shift, 9))
    else:
        assert {round(p.level_at / (0.7 * WORKPLACE.level_at), 9) for p in places} == {
            1.2,
            1.4,
            1.6,
        }
        assert first.home_position[1] == pytest.approx(-0.55 * first.level_at)
        drop = min(p.scene.cabinet.top for p in places) - first.scene.cabinet.top
        assert drop == pytest.approx(-0.3)


def test_a_pose_on_the_table_is_turned_about_the_vertical():
    pose = pose_on_table(np.array([0.3, -0.2]), 0.7, 0.05)
    np.testing.assert_allclose(pose[:3, :3], Rotation.from_euler("z", 0.7).as_matrix())
    np.testing.assert_allclose(pose[:, 3], (0.3, -0.2, 0.05, 1))
    np.testing.assert_allclose(pose[3], (0, 0, 0, 1))


def test_objects_are_put_within_the_reach_and_the_yaw_of_the_table():
    rng, reach = np.random.default_rng(0), (0.1, 0.05, 0.0)
    poses = np.stack([WORKPLACE.random_object_pose(reach, rng) for _ in range(300)])
    off = np.abs(poses[:, :2, 3] - WORKPLACE.table_centre).max(axis=0)
    assert (off <= reach[:2]).all()
    assert (off > np.multiply(reach[:2], 0.97)).all()
    yaw = np.arctan2(poses[:, 1, 0], poses[:, 0, 0])
    assert 0.058 < np.abs(yaw).max() <= 0.06
    assert yaw.min() < 0 < yaw.max()
    np.testing.assert_allclose(poses[:, 2, 3], WORKPLACE.scene.objects[0].half_size[2])
    centre, half = WORKPLACE.object_region()
    tallest = 2 * max(item.half_size[2] for item in WORKPLACE.scene.objects)
    np.testing.assert_allclose(centre, (*WORKPLACE.table_centre, tallest / 2))
    np.testing.assert_allclose(half, (*WORKPLACE.table_reach, tallest / 2))
    item, scene = WORKPLACE.scene.objects[0], WORKPLACE.scene
    tower = replace(item, name="tower", half_size=(0.02, 0.02, tallest))
    among = replace(WORKPLACE, scene=replace(scene, objects=(item, tower)))
    for box in among.object_region():
        assert float(box[2]) == pytest.approx(tallest)


def test_a_place_on_a_shelf_counts_up_to_the_edges_of_the_board():
    cabinet, (a, b, c) = WORKPLACE.scene.cabinet, WORKPLACE.scene.objects[0].half_size
    name = WORKPLACE.shelf_names()[1]
    goal = WORKPLACE.shelf(name)
    np.testing.assert_allclose(
        goal.position,
        (0.4, cabinet.front - 0.1, cabinet.shelves[name] + b + WORKPLACE.clearance),
    )
    nudge = 1e-9
    left, right = cabinet.left + a, cabinet.right - a
    for fits in ({"shelf_x": left}, {"shelf_x": right}, {"shelf_depth": c}):
        replace(WORKPLACE, **fits).shelf(name)
    replace(WORKPLACE, shelf_depth=cabinet.depth - c).shelf(name)
    message = f"{2 * a:g} x {2 * c:g} m stands on them for x from {left:g} to {right:g} m"
    message += f" and depths from {c:g} to {cabinet.depth - c:g} m"
    for outside in (
        {"shelf_x": left - nudge},
        {"shelf_x": right + nudge},
        {"shelf_depth": c - nudge},
        {"shelf_depth": cabinet.depth - c + nudge},
    ):
        with pytest.raises(ValueError, match=message):
            replace(WORKPLACE, **outside).shelf(name)
    larger = (a, b + 0.01, c)
    assert WORKPLACE.shelf(name, larger).position[2] - goal.position[2] == pytest.approx(0.01)


def test_a_path_to_a_shelf_goes_over_its_edge():
    home, front, inside, goal = WORKPLACE.path_to_shelf("upper").numpy()
    np.testing.assert_allclose(home, WORKPLACE.home_position)
    np.testing.assert_allclose(goal, WORKPLACE.shelf("upper").position)
    edge = WORKPLACE.scene.cabinet.front
    np.testing.assert_allclose(front, (goal[0], edge + 0.16, goal[2] + 0.03))
    np.testing.assert_allclose(
        inside, (goal[0], goal[1] + 0.3 * (edge + 0.16 - goal[1]), goal[2] + 0.03)
    )


@pytest.mark.parametrize(("b", "expected"), [(0.034, 0.005), (0.029, 0.0), (0.02, 0.0)])
def test_an_object_is_lowered_until_the_hand_is_over_the_board(b, expected):
    # Half the hand and 6 mm stay above; the gap under the object is 7 mm.
    assert WORKPLACE.lowering((0.02, b, 0.03)) == pytest.approx(expected, abs=1e-12)
