"""Depth and focal length from image Jacobians, against OpenCV's pinhole camera."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from hrc_learn.geometry import Pose, quaternion
from hrc_learn.jacobian import (
    ImageDemonstration,
    MarkerCamera,
    RBFImageJacobian,
    depth_gradient,
    paper_grid,
)

IMAGE = (1440, 1080)
CENTER = np.array(IMAGE) / 2


def camera(rng):
    """Rotation vector and translation of a camera that looks at the origin from about 1 m."""
    rotation = np.array([np.pi, 0.0, 0.0]) + rng.normal(0, 0.3, 3)
    return rotation, np.array([*rng.normal(0, 0.05, 2), rng.uniform(0.8, 1.3)])


def seen(points, rotation, shift, focal):
    """Pixels of points by OpenCV, and their derivatives by the place."""
    matrix = np.array([[focal, 0, CENTER[0]], [0, focal, CENTER[1]], [0, 0, 1.0]])
    pixels, jacobian = cv2.projectPoints(points, rotation, shift, matrix, None)
    # A point that moves by d moves the camera's frame by R d.
    by_shift = jacobian[:, 3:6].reshape(-1, 2, 3)
    return pixels[:, 0], by_shift @ cv2.Rodrigues(rotation)[0]


@pytest.mark.parametrize("seed", range(5))
def test_the_depth_gradient_predicts_points_far_away(seed):
    rng = np.random.default_rng(seed)
    rotation, shift = camera(rng)
    points, offset = rng.uniform(-0.2, 0.2, (20, 3)), np.array([0.1, -0.15, -0.2])
    pixels, jacobians = seen(points, rotation, shift, 1700.0)
    gradient = depth_gradient(jacobians, pixels, 1700.0, CENTER)
    depth_ratio = 1 + gradient @ offset
    far = pixels + (jacobians @ offset) / depth_ratio[:, None]
    expected, _ = seen(points + offset, rotation, shift, 1700.0)
    np.testing.assert_allclose(far, expected, atol=1e-8)
    # Without perspective the prediction is off by far more than a detector's noise.
    assert np.abs(pixels + jacobians @ offset - expected).max() > 5


def test_of_an_unknown_camera_depth_is_the_same_everywhere():
    gradient = depth_gradient(np.zeros((2, 3)), CENTER, 1700.0, CENTER)
    np.testing.assert_array_equal(gradient, np.zeros(3))


def demonstration(rng, rotation, shift, focal, marker, frames=200, noise=0.1):
    """A tool that moves and turns before a camera, its marker unseen now and then."""
    along = np.linspace(0, 1, frames)[:, None]
    ends = rng.uniform(-0.1, 0.1, (2, 3)) * [1, 1, 0.6]
    place = ends[0] + along * (ends[1] - ends[0])
    turn = quaternion.exp(torch.from_numpy(along * rng.normal(0, 0.5, 3)))
    pose = Pose(torch.from_numpy(place), turn)
    pixels, _ = seen(pose.apply(torch.from_numpy(marker)).numpy(), rotation, shift, focal)
    visible = torch.from_numpy(rng.random(frames) > 0.1)
    pixels[~visible.numpy()] = np.nan
    feature = torch.from_numpy(pixels + rng.normal(0, noise, pixels.shape))
    return ImageDemonstration(pose=pose, feature=feature, visible=visible)


def constant_network(jacobian):
    return RBFImageJacobian.from_jacobian(torch.from_numpy(jacobian), paper_grid(), 0.1)


@pytest.mark.parametrize("focal", [900.0, 2000.0])
def test_the_focal_length_is_found_from_motion(focal):
    rng = np.random.default_rng(1)
    rotation, shift = camera(rng)
    marker = np.array([0.0, 0.12, 0.03])
    demos = [demonstration(rng, rotation, shift, focal, marker) for _ in range(6)]
    _, (jacobian,) = seen(marker[None], rotation, shift, focal)
    # To begin with it is enough to know the Jacobian roughly.
    rough = np.hstack([1.1 * jacobian, np.zeros((2, 3))])
    found = MarkerCamera.fit(demos, constant_network(rough), IMAGE, lens=False).focal
    assert found == pytest.approx(focal, rel=0.03)
    # Some frames of another marker do not lead it astray.
    wrong = demos[0].feature.clone()
    wrong[50:60] += 300.0
    demos[0] = replace(demos[0], feature=wrong)
    found = MarkerCamera.fit(demos, constant_network(rough), IMAGE, lens=False).focal
    assert found == pytest.approx(focal, rel=0.05)


def test_motion_that_tells_nothing_leaves_the_width_of_the_image():
    rng = np.random.default_rng(2)
    rotation, shift = np.array([np.pi, 0.0, 0.0]), np.array([0.0, 0.0, 1.0])
    place = torch.zeros(50, 3, dtype=torch.float64)
    place[:, 0] = torch.linspace(-0.01, 0.01, 50)
    still = torch.tensor([1.0, 0, 0, 0], dtype=torch.float64).expand(50, 4)
    pixels, (jacobian, *_) = seen(place.numpy(), rotation, shift, 3000.0)
    feature = torch.from_numpy(pixels + rng.normal(0, 0.1, pixels.shape))
    demo = ImageDemonstration(
        pose=Pose(place, still), feature=feature, visible=torch.ones(50, dtype=torch.bool)
    )
    network = constant_network(np.hstack([jacobian, np.zeros((2, 3))]))
    found = MarkerCamera.fit([demo], network, IMAGE, lens=False).focal
    assert found == pytest.approx(IMAGE[0], rel=0.1)
