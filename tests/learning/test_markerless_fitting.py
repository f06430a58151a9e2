"""Tool, object and camera found in video that OpenCV projected, without any marker."""

import cv2
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from hrc_learn.demos import DatasetWriter, open_demos
from hrc_learn.jacobian.perspective import FOCAL, eye_of
from hrc_learn.learning.markerless_fitting import find_landmarks
from hrc_learn.skills.visual_skill import ANGLE_FEATURE, OBJECT_FEATURE
from hrc_learn.vision.imaging import carton
from hrc_learn.vision.landmarks import LandmarkDetector

pytestmark = pytest.mark.long

WIDTH, HEIGHT, FOCUS = 480, 360, 520.0
MATRIX = np.array([[FOCUS, 0, WIDTH / 2], [0, FOCUS, HEIGHT / 2], [0, 0, 1]])
EYE = np.array([0.5, 0.0, 1.0])
DOWN = np.diag([1.0, -1.0, -1.0])
"""From base to camera: image right is x, the view straight down."""
PLATE = np.array([0.02, -0.03, -0.06])
"""Middle of a printed plate on the tool, in the tool's frame [m]."""
EPISODES, FRAMES = 3, 16


def projected(points):
    seen = (points - EYE) @ DOWN.T
    return cv2.projectPoints(seen, np.zeros(3), np.zeros(3), MATRIX, None)[0][:, 0]


def paste(image, print_, corners):
    """Warp a print onto four points of the base frame."""
    h, w = print_.shape[:2]
    source = np.array([[0, 0], [w, 0], [w, h], [0, h]], np.float32) - 0.5
    warp = cv2.getPerspectiveTransform(source, projected(corners).astype(np.float32))
    size, flags = (WIDTH, HEIGHT), cv2.INTER_AREA
    shown = cv2.warpPerspective(print_, warp, size, flags=flags)
    inside = cv2.warpPerspective(np.full((h, w), 255, np.uint8), warp, size) > 127
    image[inside] = shown[inside]


def square(half_width, half_height):
    signs = np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]])
    return signs * (half_width, half_height, 0)


@pytest.fixture(scope="module")
def filmed(tmp_path_factory):
    """A dataset of a tool that moves over a table and ends above an object."""
    rng = np.random.default_rng(0)
    folder = tmp_path_factory.mktemp("filmed") / "demos"
    colour, grey = (0.2, 0.45, 0.7, 1.0), (0.7, 0.7, 0.7, 1.0)
    plate, item = carton("gripper", grey)[:256], carton("object", colour)
    places, table = [], np.full((HEIGHT, WIDTH, 3), 150, np.uint8)
    paste(table, carton("other", colour), np.add(square(0.03, 0.05), (0.25, 0.2, 0.0)))
    with DatasetWriter(folder, 10, "hand", cameras={"front": (HEIGHT, WIDTH)}) as writer:
        for _ in range(EPISODES):
            place, yaw = np.array([0.5, 0, 0]) + rng.uniform(-0.15, 0.15, 3), rng.uniform(-2, 2)
            place[2] = 0.05
            turn = Rotation.from_euler("z", yaw).as_matrix()
            knots = place + rng.uniform(-0.2, 0.2, (4, 3)) + np.array([0, 0, 0.2])
            knots = np.vstack([[0.1, 0.3, 0.3], knots, np.add(place, (0, 0, 0.12))])
            writer.start_episode("reach")
            for k in range(FRAMES):
                s = k / (FRAMES - 1)
                position = np.array([np.interp(5 * s, range(6), knots[:, i]) for i in range(3)])
                wobble = 0.25 * np.sin([3 * k, 4 * k + 1, 0]) * (1 - s)
                tool = Rotation.from_rotvec(wobble) * Rotation.from_euler(
                    "zx", [yaw * s, np.pi]
                )
                image = table.copy()
                paste(image, item, square(0.05, 0.08) @ turn.T + place)
                # Seen from above: the plate faces away from where the tool points.
                corners = square(0.05, 0.04) * [1, -1, 1] + PLATE
                paste(image, plate, corners @ tool.as_matrix().T + position)
                noise = rng.normal(0, 2, image.shape)
                writer.add_frame(
                    position=position,
                    orientation=tool.as_quat(scalar_first=True),
                    images={"front": (image + noise).clip(0, 255).astype(np.uint8)},
                )
            writer.save_episode()
            places.append((place, yaw))
    return folder, places


@pytest.fixture(scope="module")
def fit(filmed):
    return find_landmarks(open_demos(filmed[0]))


def test_the_camera_is_found_without_calibration(fit):
    assert fit.camera[FOCAL].exp() == pytest.approx(FOCUS, rel=0.05)
    torch.testing.assert_close(eye_of(fit.camera), torch.from_numpy(EYE), atol=0.05, rtol=0)


def test_the_tool_is_where_its_pose_says(fit):
    assert fit.seen > 0.7
    place = fit.landmarks.tool.place
    assert np.linalg.norm(place - PLATE) < 0.06  # on the plate
    for demo in fit.demos:
        turns = Rotation.from_quat(demo.orientation, scalar_first=True)
        true = projected(demo.position + turns.apply(place))
        off = np.linalg.norm(true - demo.feature, axis=1)[demo.feature_visible]
        assert np.median(off) < 1.0
        assert np.quantile(off, 0.9) < 2.5


def test_figures_are_those_of_the_frames(fit):
    visible = np.concatenate([demo.feature_visible for demo in fit.demos])
    assert fit.seen == pytest.approx(visible.mean())  # of so few, each is looked at
    assert 0.02 < fit.deviation < 1.0
    figures = fit.figures()
    assert figures["objects_found"] == EPISODES
    assert figures["tool_points"] == len(fit.landmarks.tool.points)


def test_the_picture_marks_the_tool_where_its_own_image_shows_it(fit):
    assert fit.picture.shape == (3 * HEIGHT, 2 * WIDTH, 3)
    red = (fit.picture == (255, 40, 40)).all(axis=-1)
    for row, demo in enumerate(fit.demos):
        seen = np.flatnonzero(demo.feature_visible)[[0, -1]]
        for column, (u, v) in enumerate(np.rint(demo.feature[seen]).astype(int)):
            tile = red[row * HEIGHT : (row + 1) * HEIGHT, column * WIDTH : (column + 1) * WIDTH]
            assert tile[v, u]


def test_the_object_is_found_with_its_angle(fit, filmed):
    found = np.array([d.extra[OBJECT_FEATURE][0, :2] for d in fit.demos])
    true = projected(np.array([place for place, _ in filmed[1]]))
    # The middle is that of the object's outline in one image.
    assert np.linalg.norm(found - true, axis=1).max() < 4
    angles = np.array([d.extra[ANGLE_FEATURE][0, 1] for d in fit.demos])
    yaws = np.array([yaw for _, yaw in filmed[1]])
    apart = np.exp(1j * (angles + yaws))  # the image's v points against the base's y
    assert np.abs(np.angle(apart / apart[0])).max() < 0.05


def test_an_image_without_them_says_so(fit):
    rng = np.random.default_rng(0)
    detector = LandmarkDetector(fit.landmarks)
    noise = rng.integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    paste(
        noise, carton("other", (0.2, 0.45, 0.7, 1.0)), np.add(square(0.03, 0.05), (0.5, 0, 0))
    )
    assert detector.find(noise, ["tool", "object"]) == {}


def test_a_camera_of_another_size_is_refused(fit):
    with pytest.raises(ValueError, match=r"images are 100x80, but.*480x360"):
        LandmarkDetector(fit.landmarks).find(np.zeros((80, 100, 3), np.uint8), ["tool"])
