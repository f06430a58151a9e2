import cv2
import numpy as np
import pytest

from hrc_learn.vision import Marker, marker_texture


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
