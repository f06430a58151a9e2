"""Markers, and their detection."""

import cv2
import numpy as np
import pytest
from marker_scenes import MARKER, camera_on, corners_of, overhead, poses_in_view

from hrc_learn.vision import ImageNoise, Marker, MarkerDetector, centre, marker_texture


@pytest.mark.parametrize("id", [0, 7, 49])
def test_texture_is_the_marker_in_a_white_frame(id):
    texture = marker_texture(id, 160)
    frame = texture.copy()
    frame[20:-20, 20:-20] = 255
    assert (frame == 255).all()
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    corners, ids, _ = cv2.aruco.ArucoDetector(dictionary).detectMarkers(texture)
    # OpenCV 4 gives a column, OpenCV 5 a row.
    assert ids.ravel().tolist() == [id]
    # The black square spans pixels 20 to 139; its outline runs through pixel centres.
    expected = [[20, 20], [139, 20], [139, 139], [20, 139]]
    np.testing.assert_allclose(corners[0][0], expected, atol=1.0)


@pytest.mark.parametrize("pixels", [0, -8, 100])
def test_texture_needs_whole_modules(pixels):
    with pytest.raises(ValueError, match="multiple of 8"):
        marker_texture(7, pixels)


def test_corners_run_clockwise_from_the_top_left_as_read():
    a, b, c, d = Marker(3, 0.06).corners
    assert a.tolist() == [-0.03, 0.03, 0.0]
    # Seen from the front (+z towards the reader) clockwise is negative about z.
    assert np.cross(b - a, c - b)[2] == pytest.approx(-0.0036)
    np.testing.assert_allclose(a + c, b + d)


def test_plate_has_one_quiet_module_all_round():
    marker = Marker(3, 0.06)
    assert marker.plate_size == pytest.approx(0.08)
    np.testing.assert_allclose(marker.plate_corners * 0.75, marker.corners)


@pytest.mark.parametrize(("id", "size"), [(50, 0.06), (-1, 0.06), (0, 0.0), (0, float("nan"))])
def test_impossible_markers_are_refused(id, size):
    with pytest.raises(ValueError, match="must be"):
        Marker(id, size)


VIEWS = 40


@pytest.mark.parametrize("tracked", [False, True], ids=["whole image", "near the last place"])
def test_corners_are_found_to_a_third_of_a_pixel(tracked):
    model, shown = overhead(), {}
    camera = camera_on(model, shown, MARKER)
    errors = []
    for pose in poses_in_view(model, MARKER, VIEWS, seed=0):
        shown[7] = pose
        detector, image = MarkerDetector([7]), camera.read()
        corners = detector.detect(image)[7]
        if tracked:
            corners = detector.detect(image)[7]
        errors.append(corners - model.project(corners_of(MARKER, pose)))
    distance = np.linalg.norm(errors, axis=-1)
    assert distance.mean() < 0.3
    assert np.quantile(distance, 0.95) < 0.4
    assert distance.max() < 1.0
    # No drift to one side: pixel centres mean the same to the camera and the detector.
    assert np.abs(np.mean(errors, axis=(0, 1))).max() < 0.05


def test_centre_of_the_marker_is_found_to_a_quarter_of_a_pixel():
    model, shown = overhead(), {}
    camera = camera_on(model, shown, MARKER)
    errors = []
    for pose in poses_in_view(model, MARKER, VIEWS, seed=1):
        shown[7] = pose
        corners = MarkerDetector([7]).detect(camera.read())[7]
        errors.append(np.linalg.norm(centre(corners) - model.project(pose[:3, 3])))
    assert np.mean(errors) < 0.25


def test_a_moving_marker_is_followed_and_lost_ones_found_again():
    model, shown, hidden = overhead(), {}, set()
    camera = camera_on(model, shown, MARKER, Marker(9, 0.05), hidden=lambda: hidden)
    detector = MarkerDetector([7, 9])
    path = np.linspace([0.3, -0.3, 0.0], [0.7, 0.3, 0.4], 12)
    for step, position in enumerate(path):
        shown[7] = np.eye(4)
        shown[7][:3, 3] = position
        shown[9] = np.eye(4)
        shown[9][:3, 3] = [0.85, -position[1], 0.0]
        hidden.clear()
        if step in (4, 5):
            hidden.add(7)
        found = detector.detect(camera.read())
        assert set(found) == {7, 9} - hidden
        for id, corners in found.items():
            true = model.project(corners_of(camera.markers[id], shown[id]))
            assert np.linalg.norm(corners - true, axis=1).max() < 1.5


def test_only_the_markers_asked_for_are_reported():
    pose = np.eye(4)
    pose[:3, 3] = [0.5, 0.0, 0.2]
    image = camera_on(overhead(), {7: pose}, MARKER).read()
    assert MarkerDetector([3, 4]).detect(image) == {}


def test_grey_and_colour_images_give_the_same_corners():
    pose = np.eye(4)
    pose[:3, 3] = [0.5, 0.0, 0.2]
    image = camera_on(overhead(), {7: pose}, MARKER, noise=ImageNoise(noise=0.0)).read()
    grey = (image @ [0.299, 0.587, 0.114] + 0.5).astype(np.uint8)
    np.testing.assert_allclose(
        MarkerDetector([7]).detect(image)[7], MarkerDetector([7]).detect(grey)[7], atol=0.05
    )


def test_the_answer_can_be_changed_without_leading_the_search_astray():
    pose = np.eye(4)
    pose[:3, 3] = [0.5, 0.0, 0.2]
    image = camera_on(overhead(), {7: pose}, MARKER).read()
    detector = MarkerDetector([7])
    first = detector.detect(image)[7]
    kept = first.copy()
    first += 500.0
    np.testing.assert_allclose(detector.detect(image)[7], kept, atol=0.1)


def test_images_may_become_smaller():
    pose = np.eye(4)
    pose[:3, 3] = [0.5, 0.0, 0.2]
    image = camera_on(overhead(), {7: pose}, MARKER).read()
    detector = MarkerDetector([7])
    first = detector.detect(image)[7]
    assert detector.detect(image[:200, :300].copy()) == {}
    np.testing.assert_allclose(detector.detect(image)[7], first, atol=0.1)


def test_centre_is_the_image_of_the_middle_and_not_the_mean():
    H = np.array([[200.0, 30.0, 400.0], [-20.0, 150.0, 300.0], [0.4, 0.3, 1.0]])
    square = np.array([[-0.5, 0.5, 1], [0.5, 0.5, 1], [0.5, -0.5, 1], [-0.5, -0.5, 1]])
    corners = square @ H.T
    corners = corners[:, :2] / corners[:, 2:]
    np.testing.assert_allclose(centre(corners), [400.0, 300.0], atol=1e-9)
    assert np.linalg.norm(corners.mean(axis=0) - [400.0, 300.0]) > 5


def test_only_the_markers_that_matter_now_are_looked_for():
    near, far = np.eye(4), np.eye(4)
    near[:3, 3], far[:3, 3] = [0.5, 0.0, 0.2], [0.7, 0.2, 0.0]
    image = camera_on(overhead(), {7: near, 9: far}, MARKER, Marker(9, 0.05)).read()
    detector = MarkerDetector([7, 9])
    both = detector.detect(image)
    assert set(detector.detect(image, [7, 30])) == {7}
    assert detector.detect(image, []) == {}
    np.testing.assert_allclose(detector.detect(image)[9], both[9], atol=0.1)


def test_a_marker_too_tilted_for_half_resolution_is_found_sooner_or_later():
    """Whatever the search has tried in vain before."""
    model, shown = overhead(), {}
    tilted = np.eye(4)
    tilt = np.deg2rad(73)
    tilted[:3, :3] = [
        [1, 0, 0],
        [0, np.cos(tilt), -np.sin(tilt)],
        [0, np.sin(tilt), np.cos(tilt)],
    ]
    tilted[:3, 3] = [0.5, 0.35, 0.0]
    camera = camera_on(model, shown, Marker(7, 0.03))
    detector = MarkerDetector([7])
    for _ in range(3):
        assert detector.detect(camera.read()) == {}
    shown[7] = tilted
    half = [detector.detect(camera.read()) for _ in range(6)]
    assert any(half)
    assert not half[0]


def test_an_id_on_two_markers_is_reported_only_where_it_was_last():
    def image(*places):
        grey = np.full((480, 640), 90, np.uint8)
        for u in places:
            grey[200:280, u : u + 80] = marker_texture(7, 80)
        return grey

    detector = MarkerDetector([7, 8])
    with pytest.warns(UserWarning, match="marker 7 is in the image twice: neither is used"):
        assert not detector.detect(image(100, 450))
    assert centre(detector.detect(image(450))[7])[0] == pytest.approx(489.5, abs=0.5)
    # The one that was followed goes on, until it cannot be told from the other.
    assert centre(detector.detect(image(100, 455))[7])[0] == pytest.approx(494.5, abs=0.5)
    with pytest.warns(UserWarning, match="twice"):
        assert not detector.detect(image(100, 300))
    assert centre(detector.detect(image(100))[7])[0] == pytest.approx(139.5, abs=0.5)
