"""Frames in which tool and object are looked for, cameras that are tried, and poses."""

from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from hrc_learn.demos import Demonstration, DemonstrationSet
from hrc_learn.geometry import Pose
from hrc_learn.kinematics import panda
from hrc_learn.learning.markerless_fitting import (
    MarkerlessFit,
    _cameras,
    _Link,
    _Search,
    _Tracks,
    _with_poses,
    _wrist,
)
from hrc_learn.skills.visual_skill import OBJECT_FEATURE
from hrc_learn.vision.landmarks import Finding, Landmarks, Tool, changed_features

pytestmark = pytest.mark.simulation

WIDTH, HEIGHT, FOCUS = 720, 540, 800.0
TURN, SHIFT = Rotation.from_euler("xyz", [2.9, 0.2, 0.4]), np.array([-0.2, 0.1, 1.3])
MARKER = np.array([0.02, -0.01, 0.05])
CAMERA = torch.tensor(
    [np.log(FOCUS), WIDTH / 2, HEIGHT / 2, 0.0, *TURN.as_rotvec(), *SHIFT, *MARKER]
).double()
MATRIX = np.array([[FOCUS, 0, WIDTH / 2], [0, FOCUS, HEIGHT / 2], [0, 0, 1]])


def projected(points):
    return cv2.projectPoints(points, TURN.as_rotvec(), SHIFT, MATRIX, None)[0][:, 0]


def demo(frames, episode=0, **more):
    rng = np.random.default_rng(episode)
    turns = Rotation.from_rotvec(rng.uniform(-0.6, 0.6, (frames, 3)))
    given = {
        "time": np.arange(frames) / 10,
        "position": rng.uniform(-0.15, 0.15, (frames, 3)) + np.array([0.2, 0.1, 0.2]),
        "orientation": turns.as_quat(scalar_first=True),
        "episode": episode,
        "fps": 10,
    }
    return Demonstration(**(given | more))


def places(one):
    turns = Rotation.from_quat(one.orientation, scalar_first=True)
    return projected(one.position + turns.apply(MARKER))


class Film:
    """Images of each episode, and the frames that were read."""

    def __init__(self, image):
        self.image, self.read = image, []

    def stream(self, episode, key, frames):
        assert key == "front"
        self.read.append((episode, list(frames)))
        for k in dict.fromkeys(frames):  # videos give an image once
            yield k, self.image(episode, k)


def search_in(film, demos, size=(WIDTH, HEIGHT)):
    reader: Any = film
    return _Search(reader, "front", demos, size)


def finding(pixel=(10.0, 20.0), **more):
    points = np.add(pixel, [[0, 5], [5, 0], [-5, -5]])
    given = {"covariance": np.eye(2), "points": points, "pixel": np.array(pixel)}
    return Finding(**(given | more))


def textured(episode, k):
    """A table, and a plate on it at a place of its own in each frame."""
    rng = np.random.default_rng(0)
    image = rng.integers(90, 110, (60, 80, 3)).astype(np.uint8)
    at = np.random.default_rng([episode, k]).integers(0, 30, 2)
    plate = rng.integers(0, 2, (7, 7, 1)).repeat(4, 0).repeat(4, 1) * 255
    image[at[0] : at[0] + 28, at[1] : at[1] + 28] = plate
    return image


def test_features_are_those_of_what_differs_from_the_median_image():
    """The median of every second of 72 images."""
    demos = DemonstrationSet([demo(40, 0), demo(40, 1)])
    film = Film(textured)
    search = search_in(film, demos, (80, 60))
    found = search.features()
    assert film.read == list(enumerate(search.picked))
    grey = [
        cv2.cvtColor(textured(episode, k), cv2.COLOR_RGB2GRAY)
        for episode, frames in enumerate(search.picked)
        for k in frames
    ]
    assert len(found) == len(grey) == 72
    usual = np.median(grey[::2], axis=0).astype(np.uint8)
    for features, image in zip(found[::9], grey[::9], strict=True):
        expected = changed_features(image, usual)
        assert len(features.pixels) > 5
        np.testing.assert_array_equal(features.pixels, expected.pixels)


TOOL = Tool(
    points=np.zeros((8, 3)),
    descriptors=np.zeros((8, 128), np.uint8),
    place=np.zeros(3),
    optics=(FOCUS, WIDTH / 2, HEIGHT / 2, 0.0),
)


@pytest.mark.parametrize(
    ("frames", "stride"), [(12, 1), (160, 1), (161, 1), (320, 2), (330, 2)]
)
def test_the_tool_is_looked_for_backwards_in_about_320_frames(frames, stride, monkeypatch):
    """What is not within 8 of 720 pixels of where the arm has it is not the tool."""
    demos = DemonstrationSet([demo(frames, 0), demo(frames, 1)])
    true = [places(one) for one in demos]
    off = [7.9, 8.1, 0.0, np.nan, 4.0]

    class Detector:
        def __init__(self, landmarks):
            assert landmarks.tool is TOOL

        def find(self, image, names):
            assert names == ["tool"]
            episode, k = image
            if np.isnan(off[k % 5]):
                return {}
            return {"tool": finding(true[episode][k] + off[k % 5] * np.array([0.6, -0.8]))}

    monkeypatch.setattr("hrc_learn.learning.markerless_fitting.LandmarkDetector", Detector)
    film = Film(lambda episode, k: (episode, k))
    search = search_in(film, demos)
    found = search.follow(Landmarks(tool=TOOL, image_size=(WIDTH, HEIGHT)), CAMERA)
    wanted = list(range(frames))[::-1][::stride][::-1]
    assert film.read == [(0, wanted), (1, wanted)]
    assert search.followed == 2 * len(wanted)
    for episode, row in enumerate(found):
        assert len(row) == frames
        for k, seen in enumerate(row):
            if k not in wanted or k % 5 in (1, 3):
                assert seen is None
            else:
                np.testing.assert_allclose(
                    np.linalg.norm(seen.pixel - true[episode][k]), off[k % 5], atol=1e-6
                )


def test_a_tool_that_is_found_nowhere_is_refused():
    demos = DemonstrationSet([demo(5, 0), demo(4, 1)], source="films")
    search = search_in(Film(lambda *_: np.zeros((HEIGHT, WIDTH, 3), np.uint8)), demos)
    with pytest.raises(ValueError, match="films, front: the tool is found in none of 9 frames"):
        search.follow(Landmarks(tool=TOOL, image_size=(WIDTH, HEIGHT)), CAMERA)


def test_the_object_is_seen_while_the_tool_is_far_from_where_it_ends():
    """In the seven frames of the largest distance from the line below the end."""
    demos = DemonstrationSet([demo(20, 0), demo(5, 1)])
    blank = np.full((HEIGHT, WIDTH, 3), 80, np.uint8)
    film = Film(lambda episode, k: blank)
    assert search_in(film, demos).object(CAMERA) is None
    expected = []
    for episode, one in enumerate(demos):
        direction = Rotation.from_quat(one.orientation[-1], scalar_first=True).apply([0, 0, 1])
        line = projected(one.position[-1] + np.linspace(0, 0.25, 16)[:, None] * direction)
        away = np.linalg.norm(places(one)[:, None] - line, axis=-1).min(1)
        expected.append((episode, sorted(np.argsort(-away)[:7].tolist())))
    assert film.read == expected


@pytest.mark.parametrize(("width", "smaller"), [(720, 1), (721, 2), (1440, 2), (1500, 3)])
def test_a_picture_is_the_first_and_last_images_with_the_tool(width, smaller):
    demos = DemonstrationSet([demo(6, episode) for episode in range(4)])

    def image(episode, k):
        return np.full((60, width, 3), 10 * episode + k, np.uint8)

    tools: list[list[Any]] = [
        [None, finding((40, 30)), None, finding((50, 31)), finding((60, 32)), None],
        [None] * 6,
        [None, None, finding((45, 30)), None, None, None],
        [finding()] * 6,
    ]
    objects = [finding((300, 30)), None, None, None]
    film = Film(image)
    made = search_in(film, demos, (width, 60)).picture(tools, objects)
    assert film.read == [(0, [1, 4]), (1, [0, 0]), (2, [2, 2])]
    tile = -(-width // smaller)
    assert made.shape == (3 * -(-60 // smaller), 2 * tile, 3)
    assert made[:: 60 // smaller, 0, 0].tolist() == [1, 10, 22]
    assert made[:: 60 // smaller, tile, 0].tolist() == [4, 10, 22]
    if smaller == 1:
        red = (255, 40, 40)
        for row, column, u, v, there in (
            (0, 0, 40, 30, True),
            (0, 1, 60, 32, True),
            (0, 1, 40, 30, False),
            (0, 0, 300, 30, True),
            (0, 1, 300, 30, True),
            (1, 0, 300, 30, False),
            (2, 0, 45, 30, True),
        ):
            shown = made[60 * row + v, tile * column + u]
            assert (tuple(shown) == red) == there


def test_cameras_are_fitted_to_the_longest_tracks_that_are_apart(monkeypatch):
    """Of each link; tracks within 10 of 720 pixels of another are the same point."""
    rng = np.random.default_rng(0)
    base = rng.uniform(100, 600, (1, 30, 2))
    shift = np.array([0, 9.5, 10.5, 50.0, 200.0])
    seen = np.array([30, 29, 28, 12, 20])
    pixels = (base + shift[:, None, None] * (1.0, 0.0)).astype(float)
    for k, count in enumerate(seen):
        pixels[k, count:] = np.nan
    pixels[3] = np.nan
    pixels[3, 18:] = base[0, 18:] + 3.0  # seen together with the first one only
    fitted = []

    def fit(demonstrations, size):
        (one,) = demonstrations
        assert size == (WIDTH, HEIGHT)
        assert torch.equal(one.visible, one.feature.isfinite().all(-1))
        fitted.append((one.feature.numpy(), one.pose))
        return len(fitted)

    monkeypatch.setattr("hrc_learn.learning.markerless_fitting.fit_camera", fit)
    pose = Pose(torch.zeros(30, 3), torch.tensor([1.0, 0, 0, 0]).expand(30, 4))
    links = [_Link(pose), _Link(Pose(pose.position + 1, pose.orientation))]
    tracks = _Tracks(pixels, np.zeros((5, 128), np.uint8))
    assert list(_cameras(tracks, links, (WIDTH, HEIGHT))) == [1, 2, 3, 4, 5, 6]
    for k, track in enumerate((0, 2, 4)):
        for (feature, shown), link in zip(fitted[2 * k : 2 * k + 2], links, strict=True):
            np.testing.assert_array_equal(feature, pixels[track])
            assert shown is link.pose
    # Not of more than twelve tracks.
    fitted.clear()
    many = base + 20.0 * np.arange(15)[:, None, None]
    tracks = _Tracks(many, np.zeros((15, 128), np.uint8))
    assert len(list(_cameras(tracks, links[:1], (WIDTH, HEIGHT)))) == 12


def dataset_of(demos, robot="panda", **more):
    unit = SimpleNamespace(unit_of=lambda column: "rad")
    given = {
        "folder": SimpleNamespace(robot_type=robot),
        "units": {"joint_position": unit},
        "joint_names": panda.joint_names,
    }
    source: Any = SimpleNamespace(**(given | more))
    return source


def joints(frames, episode):
    rng = np.random.default_rng(episode)
    return panda.ready.numpy() + 0.3 * rng.normal(size=(frames, 7))


def test_poses_are_computed_from_joints_where_one_is_not_recorded():
    names = panda.joint_names
    whole = demo(4, 0, joint_position=joints(4, 0), joint_names=names)
    bare = demo(3, 1, joint_position=joints(3, 1), joint_names=names)
    recorded = DemonstrationSet([whole, bare], source="here")
    assert _with_poses(dataset_of(recorded), recorded) is recorded
    for missing in ({"position": None}, {"orientation": None}):
        given = {**vars(bare), **missing}
        demos = DemonstrationSet([whole, Demonstration(**given)], source="here")
        made = _with_poses(dataset_of(demos), demos)
        for one in made:
            tool = panda.forward(torch.from_numpy(one.joint_position))
            np.testing.assert_allclose(one.position, tool.position, atol=1e-9)
            turns = Rotation.from_quat(one.orientation, scalar_first=True)
            same = Rotation.from_quat(tool.orientation, scalar_first=True)
            np.testing.assert_allclose((turns * same.inv()).magnitude(), 0, atol=1e-6)


def test_the_wrist_is_the_link_before_the_last_joint_with_its_axis():
    demos = DemonstrationSet(
        [demo(6, k, joint_position=joints(6, k), joint_names=panda.joint_names) for k in (0, 1)]
    )
    picked = [[0, 3], [2, 4, 5]]
    (link,) = _wrist(dataset_of(demos), demos, picked)
    q = np.concatenate([demos[k].joint_position[rows] for k, rows in enumerate(picked)])
    links = panda.link_poses(torch.from_numpy(q))
    torch.testing.assert_close(link.pose.position, links[:, 5].position)
    torch.testing.assert_close(link.pose.orientation, links[:, 5].orientation)
    # The last joint turns about this axis at any configuration of the arm.
    assert link.axis is not None
    origin, direction = link.axis
    for k in range(5):
        turn = Rotation.from_quat(links[k, 5].orientation, scalar_first=True)
        start = links[k, 5].position.numpy() + turn.apply(origin)
        last = Rotation.from_quat(links[k, 6].orientation, scalar_first=True)
        np.testing.assert_allclose(start, links[k, 6].position, atol=1e-6)
        np.testing.assert_allclose(turn.apply(direction), last.apply([0, 0, 1]), atol=1e-6)


def test_without_arm_or_joints_there_is_no_wrist():
    some = demo(6, 0, joint_position=joints(6, 0), joint_names=panda.joint_names)
    demos = DemonstrationSet([some])
    assert list(_wrist(dataset_of(demos, robot="unheard of"), demos, [[0]])) == []
    mixed: Any = [some, demo(6, 1)]
    assert list(_wrist(dataset_of(mixed), mixed, [[0], [1]])) == []


def test_figures_count_points_and_objects(tmp_path):
    views = np.zeros((4, 3))
    demos = DemonstrationSet([demo(4, 0, extra={OBJECT_FEATURE: views}), demo(4, 1)])
    picture = np.random.default_rng(0).integers(0, 255, (5, 7, 3)).astype(np.uint8)
    fit = MarkerlessFit(
        demos=demos,
        landmarks=Landmarks(tool=TOOL, image_size=(WIDTH, HEIGHT)),
        camera=CAMERA,
        seen=0.75,
        deviation=0.4,
        picture=picture,
    )
    assert fit.figures() == {
        "tool_points": 8,
        "tool_seen": 0.75,
        "tool_pixel_std_px": 0.4,
        "objects_found": 1,
    }
    fit.save_picture(tmp_path / "found.png")
    read = cv2.imread(str(tmp_path / "found.png"))
    np.testing.assert_array_equal(cv2.cvtColor(np.asarray(read), cv2.COLOR_BGR2RGB), picture)
