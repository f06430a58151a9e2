import cv2
import numpy as np
import pytest

from hrc_learn.vision import CameraModel

LENS = (-0.12, 0.03, 5e-4, -3e-4, 0.01)


def camera(distortion=LENS) -> CameraModel:
    model = CameraModel(focal=(1150.0, 1230.0), principal=(700.0, 552.0), distortion=distortion)
    return model.look_at(np.array([0.9, 0.4, 1.2]), np.array([0.5, 0.0, 0.1]), roll=0.7)


def points_in_view(model: CameraModel, n: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    points = rng.uniform([0.0, -0.5, 0.0], [1.0, 0.5, 0.5], size=(20 * n, 3))
    return points[model.in_view(points)][:n]


@pytest.mark.parametrize("distortion", [(0.0,) * 5, LENS])
def test_projects_as_opencv_does(distortion):
    model = camera(distortion)
    points = points_in_view(model, 200)
    assert len(points) == 200
    world_to_camera = np.linalg.inv(model.pose)
    rvec, _ = cv2.Rodrigues(world_to_camera[:3, :3])
    expected, _ = cv2.projectPoints(
        points, rvec, world_to_camera[:3, 3], model.matrix, np.array(distortion)
    )
    np.testing.assert_allclose(model.project(points), expected[:, 0], atol=1e-8)


@pytest.mark.parametrize("batch", [(), (1,), (3, 2)])
def test_projection_keeps_batch_axes(batch):
    model = camera()
    points = points_in_view(model, int(np.prod(batch))).reshape(*batch, 3)
    assert model.project(points).shape == (*batch, 2)
    assert model.in_view(points).shape == batch
    assert model.image_jacobian(points, points + 0.1).shape == (*batch, 2, 6)


def test_normalised_points_and_pixels_are_inverses():
    model = camera()
    pixels = np.random.default_rng(1).uniform([0, 0], [1439, 1079], size=(500, 2))
    np.testing.assert_allclose(model.to_pixels(model.to_normalised(pixels)), pixels, atol=1e-9)


def test_points_behind_the_camera_have_no_pixel():
    model = camera()
    behind = model.pose[:3, 3] - 0.5 * model.pose[:3, 2]
    assert np.isnan(model.project(behind)).all()
    assert not model.in_view(behind)


@pytest.mark.parametrize("x", [-0.5, 0.0, 0.5])
@pytest.mark.parametrize("y", [-0.25, 0.0, 0.25])
def test_the_image_reaches_to_the_outer_edges_of_its_pixels(x, y):
    """All numbers are exact in binary: 128 x 64 pixels, 128 px of focal length."""
    model = CameraModel(width=128, height=64, focal=(128.0, 128.0), principal=(63.5, 31.5))
    assert model.in_view(np.array([x, y, 1.0]))
    assert not model.in_view(np.array([1.01 * x or 0.51, 1.01 * y, 1.0]))


def test_a_lens_that_folds_over_brings_nothing_into_view():
    # x (1 - 0.15 x^2) comes back to zero at x = 2.58, far outside the field of view.
    model = CameraModel(distortion=(-0.15, 0.0, 0.0, 0.0, 0.0))
    folded = np.array([2.5, 0.0, 1.0])
    u, v = model.project(folded)
    assert 0 < u < model.width
    assert 0 < v < model.height
    assert not model.in_view(folded)


def test_the_target_of_look_at_lies_on_the_optical_axis():
    model = camera()
    np.testing.assert_allclose(
        model.project(np.array([0.5, 0.0, 0.1])), model.principal, atol=1e-9
    )
    assert np.linalg.det(model.pose[:3, :3]) == pytest.approx(1.0, abs=1e-12)


def test_up_is_up_in_the_image():
    model = CameraModel().look_at(np.array([2.0, 0.0, 0.5]), np.array([0.0, 0.0, 0.5]))
    low, high = model.project(np.array([[0.0, 0.0, 0.4], [0.0, 0.0, 0.6]]))
    assert high[1] < low[1]
    assert high[0] == pytest.approx(low[0])


def test_image_jacobian_is_the_derivative_of_the_projection():
    model, step = camera(), 1e-6
    points = points_in_view(model, 20)
    origins = points + np.random.default_rng(2).normal(scale=0.2, size=points.shape)
    numeric = np.empty((20, 2, 6))
    for axis in range(3):
        e = np.eye(3)[axis]
        forward, back = model.project(points + step * e), model.project(points - step * e)
        numeric[..., axis] = (forward - back) / (2 * step)
        R, _ = cv2.Rodrigues(step * e)
        forward = model.project(origins + (points - origins) @ R.T)
        back = model.project(origins + (points - origins) @ R)
        numeric[..., 3 + axis] = (forward - back) / (2 * step)
    # Entries reach 1e3 px/m; central differences leave 1e-10 / 1e-6 of rounding.
    np.testing.assert_allclose(model.image_jacobian(points, origins), numeric, atol=2e-4)


def test_no_points_have_no_image_jacobians_and_no_pixels_no_directions():
    assert CameraModel().image_jacobian(np.zeros((0, 3))).shape == (0, 2, 6)
    assert camera().to_normalised(np.zeros((0, 2))).shape == (0, 2)


def test_rotation_about_the_point_itself_moves_nothing():
    model = camera()
    point = points_in_view(model, 1)[0]
    assert (model.image_jacobian(point)[:, 3:] == 0).all()
    np.testing.assert_array_equal(
        model.image_jacobian(point), model.image_jacobian(point, point)
    )


def test_a_pose_that_is_no_rotation_is_refused():
    with pytest.raises(ValueError, match=r"det R is -1\..*look_at"):
        CameraModel(pose=np.diag([1.0, 1.0, -1.0, 1.0]))


def test_look_at_needs_two_points():
    with pytest.raises(ValueError, match="must differ"):
        CameraModel().look_at(np.zeros(3), np.zeros(3))


@pytest.mark.parametrize("wrong", [{"width": 0}, {"height": -1}, {"focal": (1200.0, 0.0)}])
def test_a_camera_without_an_extent_is_refused(wrong):
    with pytest.raises(ValueError, match="width, height and focal must be positive, but are"):
        CameraModel(**wrong)
