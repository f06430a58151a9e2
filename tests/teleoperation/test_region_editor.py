"""Pointing into the scene, against a pinhole camera that projects the other way."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from hrc_learn.geometry import quaternion
from hrc_learn.teleoperation.region_editor import (
    meet_box,
    meet_plane,
    region_over,
    view_ray,
)

FIELD, ASPECT = 1.1, 1.6
EYE = np.array([2.0, 0.5, 1.5])


def looking_down_at(target):
    """Orientation of a camera at EYE that looks at a point, z forward and y down (wxyz)."""
    z = (target - EYE) / np.linalg.norm(target - EYE)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    R = np.stack([x, np.cross(z, x), z], axis=-1)
    return quaternion.from_matrix(torch.from_numpy(R)).numpy(), R


def project(point, R):
    """Place on the screen at which the camera sees a point."""
    x, y, z = R.T @ (point - EYE)
    half = math.tan(FIELD / 2)
    return 0.5 + 0.5 * x / (z * half * ASPECT), 0.5 + 0.5 * y / (z * half)


def test_what_the_camera_projects_the_ray_hits():
    orientation, R = looking_down_at(np.array([0.1, 0.3, 0.0]))
    rng = np.random.default_rng(0)
    for _ in range(50):
        point = np.array([*rng.uniform(-0.8, 0.8, 2), 0.25])
        ray = view_ray(project(point, R), orientation, FIELD, ASPECT)
        assert np.linalg.norm(ray) == pytest.approx(1.0)
        np.testing.assert_allclose(meet_plane(EYE, ray, 2, 0.25), point, atol=1e-9)


def test_a_ray_that_leads_away_meets_no_plane():
    assert meet_plane(EYE, np.array([0.0, 0.6, 0.8]), 2, 0.0) is None
    assert meet_plane(EYE, np.array([0.0, 1.0, 0.0]), 2, 0.0) is None
    assert meet_plane(EYE, np.array([0.6, 0.8, 0.0]), 0, 0.0) is None


def test_a_ray_meets_upright_planes_too():
    point = meet_plane(EYE, np.array([-0.6, 0.0, -0.8]), 0, 0.8)
    np.testing.assert_allclose(point, [0.8, 0.5, -0.1], atol=1e-12)


CENTRE, HALF = np.array([0.2, -0.1, 0.3]), np.array([0.3, 0.2, 0.1])


@given(st.lists(st.floats(-1.0, 1.0), min_size=3, max_size=3))
def test_a_ray_enters_a_box_where_a_walk_along_it_does(aim):
    direction = np.array(aim) - EYE
    direction /= np.linalg.norm(direction)
    walk = np.linspace(0.0, 6.0, 6001)
    inside = (np.abs(EYE + walk[:, None] * direction - CENTRE) <= HALF).all(axis=1)
    distance = meet_box(EYE, direction, CENTRE, HALF)
    if inside.any():
        # The walk takes steps of a millimetre.
        assert walk[inside.argmax()] - 1.01e-3 <= distance <= walk[inside.argmax()] + 1e-9
    else:
        # A ray may graze an edge between two steps.
        touched = EYE + min(distance, 10.0) * direction
        assert distance == math.inf or (np.abs(touched - CENTRE) <= HALF + 1e-9).all()


def test_rays_along_the_axes_meet_boxes_too():
    origin = np.array([0.2, -0.1, 2.0])
    assert meet_box(origin, np.array([0.0, 0.0, -1.0]), CENTRE, HALF) == pytest.approx(1.6)
    assert meet_box(origin, np.array([0.0, 0.0, 1.0]), CENTRE, HALF) == math.inf
    beside = origin + np.array([0.31, 0.0, 0.0])
    assert meet_box(beside, np.array([0.0, 0.0, -1.0]), CENTRE, HALF) == math.inf


def test_a_region_stands_over_what_was_drawn():
    points = np.array([[0.1, 0.2, 0.0], [0.5, 0.3, 0.0], [0.2, -0.2, 0.0]])
    region = region_over(points, bottom=0.05, height=0.3)
    np.testing.assert_allclose(region.centre, [0.3, 0.05, 0.2])
    np.testing.assert_allclose(region.half_size, [0.2, 0.25, 0.15])


def test_a_region_has_a_size_whatever_was_drawn():
    region = region_over(np.zeros((1, 3)), bottom=0.0, height=0.0, smallest=0.03)
    assert region.half_size == (0.03, 0.03, 0.03)
