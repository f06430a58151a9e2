import numpy as np
import pytest

from hrc_learn.sim import CameraChange, ChangingCamera, SceneConfig

MODEL = SceneConfig().camera
WATCHED = np.array([[0.14, 0.46, 0.06], [0.34, 0.62, 0.06], [0.24, 0.54, 0.25]])


def turn_between(a, b):
    cosine = (np.trace(a[:3, :3].T @ b[:3, :3]) - 1) / 2
    return float(np.arccos(np.clip(cosine, -1, 1)))


def test_a_changed_camera_is_moved_and_turned_as_far_as_asked_and_sees_what_it_should():
    change, rng = CameraChange(), np.random.default_rng(0)
    directions = []
    for _ in range(20):
        changed = change.applied(MODEL, WATCHED, rng)
        moved = changed.pose[:3, 3] - MODEL.pose[:3, 3]
        assert np.linalg.norm(moved) == pytest.approx(0.10)
        assert turn_between(changed.pose, MODEL.pose) == pytest.approx(np.deg2rad(10))
        assert changed.in_view(WATCHED).all()
        assert changed.distortion == MODEL.distortion
        directions.append(moved)
    assert np.linalg.norm(np.mean(directions, axis=0)) < 0.05


def test_refocusing_scales_the_image_about_the_principal_point():
    change = CameraChange(distance=0.0, angle=0.0, focus=1.1)
    changed = change.applied(MODEL, WATCHED, np.random.default_rng(0))
    offset = MODEL.project(WATCHED) - MODEL.principal
    np.testing.assert_allclose(changed.project(WATCHED) - MODEL.principal, 1.1 * offset)


def test_a_camera_that_would_look_elsewhere_is_refused():
    with pytest.raises(ValueError, match="change it less"):
        CameraChange(focus=9.0).applied(MODEL, WATCHED, np.random.default_rng(0), 50)
    with pytest.raises(ValueError, match="not negative"):
        CameraChange(distance=-0.1)


def test_images_come_from_the_camera_of_the_day():
    class Named:
        def __init__(self, model):
            self.model = model

        def read(self):
            return np.full((1, 1, 3), int(self.model.focal[0]) % 256, dtype=np.uint8)

    camera = ChangingCamera(MODEL, Named)
    other = CameraChange(focus=1.1).applied(MODEL, WATCHED, np.random.default_rng(1))
    before = camera.read()
    camera.change(3.5, other)
    assert (camera.read() != before).all()
    assert [time for time, _ in camera.history] == [-np.inf, 3.5]
    assert camera.model is other
