"""Steps from video to landmarks, each with features of a camera that OpenCV models."""

from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from unchecked import shapes_unchecked

from hrc_learn.demos import Demonstration, DemonstrationSet
from hrc_learn.geometry import Pose
from hrc_learn.learning import markerless_fitting
from hrc_learn.learning.markerless_fitting import (
    _below,
    _common_object,
    _described,
    _Link,
    _points,
    _poses,
    _Search,
    _tool,
    _Tracks,
    _tracks,
    find_landmarks,
)
from hrc_learn.learning.visual_servo_fitting import _ends
from hrc_learn.skills.visual_skill import ANGLE_FEATURE, OBJECT_FEATURE
from hrc_learn.vision.landmarks import Features, Finding

pytestmark = pytest.mark.simulation

WIDTH, HEIGHT, FOCUS, RADIAL = 720, 540, 800.0, -0.1
TURN, SHIFT = Rotation.from_euler("xyz", [2.9, 0.2, 0.4]), np.array([-0.2, 0.1, 1.3])
CAMERA = torch.tensor(
    [np.log(FOCUS), WIDTH / 2, HEIGHT / 2, RADIAL, *TURN.as_rotvec(), *SHIFT, 0, 0, 0]
).double()
MATRIX = np.array([[FOCUS, 0, WIDTH / 2], [0, FOCUS, HEIGHT / 2], [0, 0, 1]])


def projected(points):
    lens = np.array([RADIAL, 0, 0, 0])
    return cv2.projectPoints(points, TURN.as_rotvec(), SHIFT, MATRIX, lens)[0][:, 0]


def motion(frames, seed=0):
    """Poses of a link, and as a position and a rotation of each frame."""
    rng = np.random.default_rng(seed)
    position = rng.uniform(-0.15, 0.15, (frames, 3)) + np.array([0.2, 0.1, 0.2])
    turns = Rotation.from_rotvec(rng.uniform(-0.6, 0.6, (frames, 3)))
    q = turns.as_quat(scalar_first=True)
    return Pose(torch.from_numpy(position), torch.from_numpy(q)), position, turns


def tracked(points, frames, seed=0):
    pose, position, turns = motion(frames, seed)
    pixels = np.stack([projected(position + turns.apply(point)) for point in points])
    return pose, pixels


def names(count, seed=0):
    return np.random.default_rng(seed).integers(0, 200, (count, 128)).astype(np.uint8)


def tracks_of(pixels):
    return _Tracks(pixels, names(len(pixels)))


POINTS = np.random.default_rng(1).uniform(-0.08, 0.08, (14, 3))


def test_points_that_move_with_a_link_are_found_where_they_are_on_it():
    pose, pixels = tracked(POINTS, 24)
    pixels[0, ::3] = np.nan
    pixels[1, ::4] += 90.0  # a quarter is of something else
    point, good = _points(tracks_of(pixels), pose, CAMERA, WIDTH)
    assert good.all()
    np.testing.assert_allclose(point, POINTS, atol=2e-4)


def test_near_and_far_frames_count_by_the_angles_between_their_lines_of_sight():
    """Against the least squares of SciPy, with noise too small to be weighed down."""
    _, position, turns = motion(30)
    position[::2] -= 0.7 * TURN.inv().apply([0.0, 0.0, 1.0])  # half of them are near the camera
    pose = Pose(torch.from_numpy(position), torch.from_numpy(turns.as_quat(scalar_first=True)))
    pixels = projected(position + turns.apply(POINTS[0]))
    pixels += np.random.default_rng(6).normal(0, 0.05, pixels.shape)
    plain = cv2.undistortPoints(pixels, MATRIX, np.array([RADIAL, 0, 0, 0]))[:, 0]
    sight = np.column_stack([plain, np.ones(len(plain))])
    sight /= np.linalg.norm(sight, axis=1, keepdims=True)

    def angles(point):
        seen = TURN.apply(position + turns.apply(point)) + SHIFT
        return np.cross(sight, seen / np.linalg.norm(seen, axis=1, keepdims=True)).ravel()

    expected = least_squares(angles, POINTS[0], x_scale=0.1, xtol=1e-12, ftol=1e-12).x
    found, _ = _points(tracks_of(pixels[None]), pose, CAMERA, WIDTH)
    off = np.linalg.norm(expected - POINTS[0])
    # Frames are weighted by the distance of the link, which is some centimetres from the point.
    np.testing.assert_allclose(found[0], expected, atol=0.2 * off)


@pytest.mark.parametrize(
    ("frames", "wrong", "there"),
    [(10, 0, True), (9, 0, False), (24, 11, True), (24, 13, False)],
)
def test_ten_frames_and_more_than_half_of_them_make_a_point(frames, wrong, there):
    pose, pixels = tracked(POINTS[:1], 24)
    pixels[:, frames:] = np.nan
    rng = np.random.default_rng(3)
    pixels[:, :wrong] += rng.uniform(150, 300, (wrong, 2)) * rng.choice([-1, 1], (wrong, 2))
    assert _points(tracks_of(pixels), pose, CAMERA, WIDTH)[1].tolist() == [there]


@pytest.mark.parametrize(("off", "width", "there"), [(1.8, WIDTH, True), (2.2, WIDTH, False)])
def test_two_pixels_of_720_are_no_error(off, width, there):
    """Errors along u of both signs, so that no other point explains them."""
    pose, pixels = tracked(POINTS[:1], 40)
    signs = np.random.default_rng(0).permutation(np.repeat([-1, 1], 20))
    pixels[0, :, 0] += off * signs
    assert bool(_points(tracks_of(pixels), pose, CAMERA, width)[1][0]) == there


@pytest.mark.parametrize(("distance", "there"), [(0.34, True), (0.36, False)])
def test_a_point_is_within_35_centimetres_of_its_link(distance, there):
    pose, pixels = tracked(distance * np.array([[0.6, 0.8, 0.0]]), 24)
    assert _points(tracks_of(pixels), pose, CAMERA, WIDTH)[1].tolist() == [there]


def test_a_tool_is_the_points_of_its_link_about_their_median():
    pose, pixels = tracked(POINTS, 24)
    other = np.random.default_rng(4).uniform(0, 500, (2, 24, 2))
    found = tracks_of(np.concatenate([pixels, other]))
    rough = CAMERA + torch.tensor([1e-3, 0.5, -0.5, 0, 3e-4, 0, 2e-4, 5e-4, 0, 0, 0, 0, 0])
    tool, adjusted = _tool(found, _Link(pose), rough, (WIDTH, HEIGHT))
    # The focal length is between the usual one and that of the images.
    np.testing.assert_allclose(tool.points, POINTS, atol=2e-3)
    np.testing.assert_array_equal(tool.descriptors, found.descriptors[:14])
    np.testing.assert_allclose(tool.place, np.median(tool.points, axis=0))
    focal, *others = tool.optics
    assert focal == pytest.approx(float(adjusted[0].exp()))
    assert focal == pytest.approx(FOCUS, rel=5e-3)
    np.testing.assert_allclose(others, adjusted[1:4])
    # On a link that turns about an axis the place is the foot on that axis.
    origin, direction = np.array([0.01, 0.02, 0.0]), np.array([0.0, 0.6, 0.8])
    on_axis, _ = _tool(found, _Link(pose, (origin, direction)), rough, (WIDTH, HEIGHT))
    middle = np.median(on_axis.points, axis=0)
    np.testing.assert_allclose(np.cross(on_axis.place - origin, direction), 0, atol=1e-9)
    assert (middle - on_axis.place) @ direction == pytest.approx(0, abs=1e-9)


def frames_of(paths, seen):
    """Features of each frame: points with paths (points, frames, 2) where they are seen."""
    own = names(len(paths))
    return [
        Features(pixels=paths[seen[:, k], k], descriptors=own[seen[:, k]])
        for k in range(paths.shape[1])
    ]


def test_tracks_are_of_features_seen_in_ten_frames_that_moved():
    frames, count = 12, 8
    rng = np.random.default_rng(0)
    start = rng.uniform(100, 600, (count, 1, 2))
    # Median distance from the middle of a path to and fro: its amplitude.
    to_and_fro = np.where(np.arange(frames) % 2, 1.0, -1.0)[None, :, None]
    amplitude = np.array([50, 11, 9.5, 0, 50, 50, 30, 10.5])
    paths = start + to_and_fro * (amplitude[:, None, None] * (1.0, 0.0))
    seen = np.ones((count, frames), bool)
    seen[4, 10:] = False  # ten frames
    seen[5, 9:] = False  # nine
    found = _tracks(frames_of(paths, seen), WIDTH)
    moved = {0, 1, 4, 6, 7}  # further than 10 px of 720
    own, many = names(count), {}
    for descriptor, pixels in zip(found.descriptors, found.pixels, strict=True):
        k = int(np.flatnonzero((own == descriptor).all(axis=1))[0])
        many[k] = many.get(k, 0) + 1
        np.testing.assert_array_equal(np.isfinite(pixels[:, 0]), seen[k])
        np.testing.assert_allclose(pixels[seen[k]], paths[k, seen[k]])
    assert set(many) == moved
    # Ten of the twelve frames are starts, from which everything seen is followed.
    starts = np.unique(np.linspace(0, frames - 1, 10).astype(int))
    assert many == {k: int(seen[k, starts].sum()) for k in moved}


def test_features_that_resemble_two_others_are_not_followed():
    frames = 12
    pixels = np.arange(4)[:, None] * (100.0, 0.0) + 50
    own = names(4)
    own[1] = own[0]
    own[1, 0] += 1
    images = [
        Features(pixels=pixels + 30.0 * (k % 2), descriptors=own + np.uint8(k % 2))
        for k in range(frames)
    ]
    found = _tracks(images, WIDTH)
    kept = {int(u) for u in found.pixels[:, 0, 0]}
    assert kept == {250, 350}
    # A frame with one feature has no second nearest.
    lonely = [Features(pixels=pixels[:1], descriptors=own[:1])] * frames
    assert len(_tracks(lonely, WIDTH).pixels) == 0


def demo(frames=6, episode=0, **more):
    _, position, turns = motion(frames, seed=episode)
    return Demonstration(
        time=np.arange(frames) / 10,
        position=position,
        orientation=turns.as_quat(scalar_first=True),
        episode=episode,
        fps=10,
        **more,
    )


def test_below_the_tool_lies_a_line_of_25_centimetres_where_it_ends():
    one = demo()
    direction = Rotation.from_quat(one.orientation[-1], scalar_first=True).apply([0, 0, 1])
    line = one.position[-1] + np.linspace(0, 0.25, 16)[:, None] * direction
    with_marker = torch.cat([CAMERA[:10], torch.tensor([0.05, 0.1, 0.2]).double()])
    np.testing.assert_allclose(_below(one, with_marker), projected(line), atol=1e-6)


def test_poses_are_those_of_the_picked_frames():
    demos = DemonstrationSet([demo(episode=0), demo(episode=1)])
    pose = _poses(demos, [[0, 2], [5]])
    expected = np.stack([demos[0].position[0], demos[0].position[2], demos[1].position[5]])
    np.testing.assert_allclose(pose.position, expected)
    turns = [demos[0].orientation[0], demos[0].orientation[2], demos[1].orientation[5]]
    np.testing.assert_allclose(pose.orientation, turns)


@pytest.mark.parametrize(("count", "each"), [(3, 24), (10, 8), (36, 2), (50, 2)])
def test_seventy_two_frames_of_all_demonstrations_are_searched(count, each):
    demos: Any = [np.zeros(40)] * count
    search = _Search(SimpleNamespace(), "front", demos, (WIDTH, HEIGHT))  # pyright: ignore
    for picked in search.picked:
        assert len(picked) == each
        assert (picked[0], picked[-1]) == (0, 39)
        assert set(np.diff(picked)) <= {39 // (each - 1), 39 // (each - 1) + 1}
    short: Any = [np.zeros(3)] * count
    search = _Search(SimpleNamespace(), "front", short, (WIDTH, HEIGHT))  # pyright: ignore
    assert search.picked[0] == ([0, 1, 2] if each > 2 else [0, 2])


VIEW = np.random.default_rng(7).uniform(-60, 60, (20, 2))


def shown(middle, angle, scale=1.0):
    """Features of the object at a place of an image."""
    turn = scale * Rotation.from_euler("z", angle).as_matrix()[:2, :2]
    return Features(pixels=VIEW @ turn.T + middle, descriptors=names(20))


def vertical(u, v):
    return np.array([[u, v + 5.0 * k] for k in range(16)])


def test_the_object_is_what_lies_where_the_motions_end():
    places = [(300, 200), (400, 260), (250, 300)]
    turns, scales = (0.3, 1.0, -0.6), (1.0, 1.2, 0.8)
    seen = [shown(*given) for given in zip(places, turns, scales, strict=True)]
    lines = [vertical(u + 20, v - 30) for u, v in places]
    found = _common_object(seen, lines, WIDTH)
    assert found is not None
    item, findings = found
    assert len(item.views) == 3
    reference = item.views[0].pixels
    for view, finding, turn, scale in zip(item.views, findings, turns, scales, strict=True):
        # All views are of the same size and direction, about the same middle.
        np.testing.assert_allclose(view.pixels, reference, atol=1e-6)
        assert finding is not None
        base = findings[0]
        assert base is not None
        assert finding.angle - base.angle == pytest.approx(turn - 0.3, abs=1e-6)
        assert finding.scale / base.scale == pytest.approx(scale, rel=1e-6)
    middle = [np.subtract(f.pixel, place) for f, place in zip(findings, places, strict=True)]
    turned = [
        Rotation.from_euler("z", -turn).as_matrix()[:2, :2] @ off / scale
        for off, turn, scale in zip(middle, turns, scales, strict=True)
    ]
    np.testing.assert_allclose(turned, np.broadcast_to(turned[0], (3, 2)), atol=1e-6)


@pytest.mark.parametrize(("aside", "there"), [(42.0, True), (45.0, False)])
def test_the_object_lies_within_six_hundredths_of_the_width_of_the_line(aside, there):
    places = [(300, 200), (400, 260)]
    seen = [shown(place, 0.0) for place in places]
    # The middle of what matches is where the first line is at half its length.
    lines = [vertical(300, 160), vertical(400 + aside, 220)]
    found = _common_object(seen, lines, WIDTH)
    if there:
        assert found is not None
        assert [f is not None for f in found[1]] == [True, True]
    else:
        assert found is None


def test_an_object_of_a_single_demonstration_is_none():
    seen = [shown((300, 200), 0.0), Features(pixels=VIEW + 300, descriptors=names(20, 9))]
    assert _common_object(seen, [vertical(300, 160), vertical(300, 300)], WIDTH) is None


def test_what_was_found_becomes_columns():
    demos = DemonstrationSet(
        [
            demo(3, 0, extra={"mood": np.ones((3, 1))}),
            demo(3, 1, extra={OBJECT_FEATURE: np.ones((3, 3)), ANGLE_FEATURE: np.ones((3, 2))}),
        ],
        notes=("kept",),
        source="here",
        joint_unit="rad",
    )

    def finding(u, v):
        return Finding(
            pixel=np.array([u, v]), covariance=np.eye(2), angle=0.4, points=np.zeros((1, 2))
        )

    tools = [[finding(1.0, 2.0), None, finding(3.0, 4.0)], [None, None, None]]
    made = _described(demos, tools, [finding(50.0, 60.0), None])
    np.testing.assert_array_equal(made[0].feature, [[1, 2], [0, 0], [3, 4]])
    assert made[0].feature_visible.tolist() == [True, False, True]
    assert not made[1].feature_visible.any()
    np.testing.assert_array_equal(made[0].extra[OBJECT_FEATURE], [[50, 60, 1]] * 3)
    angle = made[0].extra[ANGLE_FEATURE]
    assert np.isnan(angle[:, 0]).all()
    np.testing.assert_array_equal(angle[:, 1], [0.4] * 3)
    np.testing.assert_array_equal(made[0].extra["mood"], np.ones((3, 1)))
    assert not {OBJECT_FEATURE, ANGLE_FEATURE} & made[1].extra.keys()
    assert (made.notes, made.source, made.joint_unit) == (("kept",), "here", "rad")


def test_ends_are_those_of_the_demonstrations_whose_object_was_found():
    seen = {"feature": np.ones((6, 2)), "feature_visible": np.ones(6, dtype=bool)}
    shown = [
        demo(6, k, extra={OBJECT_FEATURE: np.full((6, 3), k + 1.0)}, **seen) for k in (0, 1)
    ]
    demos = DemonstrationSet([shown[0], demo(6, 5, **seen), shown[1]])
    ends = _ends(demos, partial=True)
    np.testing.assert_array_equal([end.object_pixel for end in ends], [[1, 1], [2, 2]])
    with pytest.raises(ValueError, match=f"episode 5: no {OBJECT_FEATURE}, unlike other"):
        _ends(demos)


@pytest.fixture
def found(monkeypatch):
    """A search whose numbers of explained tracks are given for each camera and link."""

    def run(counts, item=None, sure=((1.0, None, 3.0), (2.0,))):
        tried = []
        there = torch.tensor([[0.5, 0.1, 0.2]]).double()
        quarter = torch.tensor([[np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)]]).double()
        unit = torch.tensor([[1.0, 0.0, 0.0, 0.0]]).double()
        links = {"tool": Pose(there, unit), "wrist": Pose(there + 0.1, quarter)}
        fits = [SimpleNamespace(camera=name) for name in range(len(counts))]
        place = np.array([0.03, 0.02, 0.01])
        camera = torch.arange(13.0).double()
        search = SimpleNamespace(
            picked="picked",
            followed=8,
            features=lambda: "features",
            follow=lambda landmarks, seen: [
                [None if d is None else SimpleNamespace(deviation=d) for d in row]
                for row in sure
            ],
            object=lambda seen: item,
            picture=lambda findings, objects: ("picture", objects),
        )

        def points(tracks, pose, number, width):
            tried.append(number)
            count = counts[number][next(k for k, v in links.items() if v is pose)]
            return None, torch.arange(20) < count

        for name, value in {
            "ImageReader": lambda folder: SimpleNamespace(
                cameras=[], size=lambda key: (48, 64)
            ),
            "camera_key": lambda cameras, camera: "KEY",
            "_with_poses": lambda source, demos: ["first", "second"],
            "_Search": lambda *given: search,
            "_poses": lambda demos, picked: links["tool"],
            "_wrist": lambda *given: [_Link(links["wrist"])],
            "_tracks": lambda features, width: "tracks",
            "_cameras": lambda *given: iter(fits),
            "_points": points,
            "_tool": lambda *given: (
                SimpleNamespace(place=place, link=given[1]),
                camera,
            ),
            "Landmarks": Kept,
            "_described": lambda demos, findings, objects: (demos, objects),
            "_ENOUGH": 15,
            "FEWEST_POINTS": 5,
        }.items():
            monkeypatch.setattr(markerless_fitting, name, value)
        source: Any = SimpleNamespace(folder="folder", source="SET", load=lambda: "loaded")
        with shapes_unchecked():
            return find_landmarks(source), tried, links

    return run


@dataclass(frozen=True)
class Kept:
    """Landmarks without checks."""

    tool: Any
    image_size: tuple[int, int]
    objects: Any = None


def test_camera_and_link_are_those_that_explain_the_most_tracks(found):
    counts = [{"tool": 6, "wrist": 9}, {"tool": 12, "wrist": 3}, {"tool": 11, "wrist": 12}]
    fit, tried, links = found(counts)
    assert tried == [0, 0, 1, 1, 2, 2]
    assert fit.landmarks.tool.link.pose is links["tool"]
    assert fit.landmarks.image_size == (64, 48)
    np.testing.assert_allclose(fit.camera[10:], [0.03, 0.02, 0.01])
    np.testing.assert_array_equal(fit.camera[:10], np.arange(10.0))


def test_no_further_camera_is_tried_once_enough_tracks_are_explained(found):
    fit, tried, _ = found([{"tool": 6, "wrist": 15}, {"tool": 20, "wrist": 20}])
    assert tried == [0, 0]
    # A point on the wrist, seen from the tool: a quarter turn, then 0.1 m along each axis.
    np.testing.assert_allclose(fit.camera[10:], [0.1 - 0.02, 0.1 + 0.03, 0.1 + 0.01])


@pytest.mark.parametrize(("most", "refused"), [(4, True), (5, False)])
def test_a_few_tracks_that_move_as_the_arm_may_be_chance(found, most, refused):
    counts = [{"tool": most, "wrist": 1}]
    if refused:
        with pytest.raises(
            ValueError, match=r"SET, KEY: nothing .* \(4 points found, 5 needed"
        ):
            found(counts)
    else:
        found(counts)


def test_a_video_without_a_camera_that_fits_has_no_points(found):
    with pytest.raises(ValueError, match="0 points found, 5 needed"):
        found([])


def test_figures_count_the_frames_in_which_the_tool_is_sure(found):
    fit, _, _ = found([{"tool": 9, "wrist": 1}])
    assert fit.seen == pytest.approx(3 / 8)
    assert fit.deviation == 2.0
    assert fit.landmarks.objects is None
    assert fit.demos[1] == fit.picture[1] == [None, None]
    fit, _, _ = found([{"tool": 9, "wrist": 1}], item=("views", ["a", "b"]))
    assert fit.landmarks.objects == {"object": "views"}
    assert fit.demos[1] == fit.picture[1] == ["a", "b"]
