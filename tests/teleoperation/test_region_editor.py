"""Pointing into the scene, against a pinhole camera that projects the other way."""

import asyncio
import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from unchecked import shapes_unchecked

from hrc_learn.geometry import Box, quaternion
from hrc_learn.protocols import DrawnRegion
from hrc_learn.teleoperation.region_editor import (
    RegionEditor,
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


class Handle(SimpleNamespace):
    """A control or a node of viser's page: what it is made with, and what it calls."""

    def on(self, act):
        self.act = act

    on_click = on_update = on_drag = on


class Server:
    """A viser server that keeps controls and nodes by their name, and pointer listeners."""

    def __init__(self):
        self.scene = self.gui = self
        self.made, self.listening = {}, {}

    def _add(self, name, *values, **settings):
        self.made[name] = Handle(values=values, disabled=False, **settings)
        return self.made[name]

    add_button = add_transform_controls = add_box = add_icosphere = _add

    def add_checkbox(self, name, value, *, hint):
        return self._add(name, value=value)

    def add_slider(self, name, low, high, step, value):
        return self._add(name, value=value, low=low, high=high)

    def add_line_segments(self, name, points, *_, **settings):
        return self._add(name, points=points)

    def on_rect_select(self):
        return lambda act: self.listening.update(rectangle=act)

    def on_click(self):
        return lambda act: self.listening.update(click=act)

    def remove_rect_select_callback(self, act):
        assert self.listening.pop("rectangle") is act

    def remove_click_callback(self, act):
        assert self.listening.pop("click") is act

    def use(self, name, event=None):
        asyncio.run(self.made[name].act(event))


TABLE = Box(centre=(0.4, 0.3, -0.1), half_size=(0.5, 0.5, 0.1), name="table")
BOARD = Box(centre=(0.4, 0.3, 0.5), half_size=(0.1, 0.1, 0.01), name="board")


@pytest.fixture
def page():
    with shapes_unchecked():  # a stand-in is no ViserServer
        yield Server()


@pytest.fixture
def editor(page):
    return RegionEditor(page, [TABLE, BOARD])


def shown(page):
    """Middle, edges and sliders of the region that is shown."""
    sliders = [page.made[f"Size {axis} [m]"].value for axis in "xyz"]
    box = page.made["/region/box"]
    corner, edges = page.made["/region/corner"].position, page.made["/region/edges"].points
    np.testing.assert_allclose(np.abs(edges).reshape(-1, 3).max(axis=0), corner)
    np.testing.assert_allclose(2 * np.array(corner), box.dimensions)
    np.testing.assert_allclose(sliders, box.dimensions, atol=5e-4)
    return page.made["/region"].position, box.dimensions


def test_a_region_attracts_only_while_it_is_active(page, editor):
    assert editor.region is None
    faint = page.made["/region/box"].opacity
    page.made["Active"].value = True
    page.use("Active")
    assert editor.region == editor.drawn
    assert page.made["/region/box"].opacity > faint
    other = DrawnRegion(centre=(0.1, 0.2, 0.3), half_size=(0.1, 0.2, 0.05))
    editor.draw(other, active=False)
    assert (editor.region, editor.drawn) == (None, other)
    assert shown(page) == (other.centre, (0.2, 0.4, 0.1))
    editor.draw(other, active=True)
    editor.draw(other)
    assert editor.region == other


def test_sliders_gizmo_and_corner_change_the_region(page, editor):
    for axis, size in zip("xyz", (0.3, 0.2, 0.5), strict=True):
        page.made[f"Size {axis} [m]"].value = size
    page.use("Size x [m]", SimpleNamespace(client=None))  # moved by ourselves
    assert editor.drawn.half_size != (0.15, 0.1, 0.25)
    page.use("Size x [m]", SimpleNamespace(client=1))
    assert editor.drawn.half_size == (0.15, 0.1, 0.25)
    page.use("/region", SimpleNamespace(target=SimpleNamespace(position=(0.2, 0.1, 0.4))))
    assert editor.drawn.centre == (0.2, 0.1, 0.4)
    assert editor.drawn.half_size == (0.15, 0.1, 0.25)
    # Seen from above, the corner follows the pointer in the plane of its height.
    eye = np.array([0.2, 0.1, 2.4])
    client = SimpleNamespace(camera=SimpleNamespace(position=eye))
    for pointer, half in (
        ((0.5, 0.3, 0.65), (0.3, 0.2, 0.25)),
        ((0.2, 0.1, 0.64), (0.02, 0.02, 0.25)),  # no smaller
        ((1.7, 1.6, 0.65), (0.5, 0.5, 0.25)),  # and no larger
    ):
        page.use("/region/corner", SimpleNamespace(client=client, end_position=pointer))
        np.testing.assert_allclose(editor.drawn.half_size, half, atol=1e-9)
        assert editor.drawn.centre == (0.2, 0.1, 0.4)
        shown(page)


def camera(target):
    orientation, R = looking_down_at(np.array(target))
    view = SimpleNamespace(wxyz=orientation, fov=FIELD, aspect=ASPECT, position=EYE)
    return SimpleNamespace(camera=view), R


def test_a_rectangle_on_the_screen_is_the_footprint_of_the_region(page, editor):
    client, R = camera([0.3, 0.4, 0.0])
    bottom = editor.drawn.centre[2] - editor.drawn.half_size[2]
    page.use("Draw on the table")
    assert page.made["Draw on the table"].disabled
    sides = [np.array([0.3 + a, 0.4 + b, 0.0]) for a in (-0.1, 0.1) for b in (-0.08, 0.08)]
    places = np.array([project(side, R) for side in sides])
    low, high = places.min(axis=0), places.max(axis=0)
    event = SimpleNamespace(client=client, screen_min=low, screen_max=high)
    asyncio.run(page.listening["rectangle"](event))
    assert page.listening == {}  # it counts once
    assert not page.made["Draw on the table"].disabled
    # The middles of the rectangle's sides, seen from the camera, lie on the region's edge.
    middle = (low + high) / 2
    rays = [
        view_ray(place, client.camera.wxyz, FIELD, ASPECT)
        for place in (
            (low[0], middle[1]),
            (high[0], middle[1]),
            (middle[0], low[1]),
            (middle[0], high[1]),
        )
    ]
    points = np.array([EYE - EYE[2] / ray[2] * ray for ray in rays])[:, :2]
    centre, half = np.array(editor.drawn.centre), np.array(editor.drawn.half_size)
    np.testing.assert_allclose(centre[:2] - half[:2], points.min(axis=0))
    np.testing.assert_allclose(centre[:2] + half[:2], points.max(axis=0))
    assert centre[2] - half[2] == pytest.approx(bottom)
    before = editor.drawn
    page.use("Draw on the table")
    up = SimpleNamespace(client=client, screen_min=(0.4, -3.0), screen_max=(0.6, 0.5))
    asyncio.run(page.listening["rectangle"](up))  # above the horizon
    assert editor.drawn == before


@pytest.mark.parametrize(
    ("aim", "marked"),
    [
        ((0.4, 0.3, 0.51), (0.4, 0.3, 0.59)),  # the board before the table
        ((0.1, 0.0, 0.0), (0.1, 0.0, 0.08)),  # the table
        ((-2.0, -1.0, 0.0), (-2.0, -1.0, 0.08)),  # beside it, at its height
    ],
)
def test_a_click_marks_the_target_above_what_is_nearest(page, editor, aim, marked):
    page.use("Mark the target")
    way = np.array(aim) - EYE
    event = SimpleNamespace(ray_origin=EYE, ray_direction=way / np.linalg.norm(way))
    asyncio.run(page.listening["click"](event))
    assert page.listening == {}
    np.testing.assert_allclose(editor.target, marked, atol=1e-9)
    mark = page.made["/target"]
    assert mark.visible
    np.testing.assert_allclose(mark.position, marked, atol=1e-9)
    page.use("/target", SimpleNamespace(end_position=(0.1, 0.2, 0.3)))
    assert editor.target == (0.1, 0.2, 0.3)
    page.use("Mark the target")
    up = SimpleNamespace(ray_origin=EYE, ray_direction=np.array([0.0, 0.6, 0.8]))
    asyncio.run(page.listening["click"](up))
    assert editor.target == (0.1, 0.2, 0.3)  # the sky is no place
    page.use("Clear the target")
    assert editor.target is None
    assert not mark.visible


def test_controls_and_nodes_begin_as_they_are_described(page, editor):
    for axis in "xyz":
        slider = page.made[f"Size {axis} [m]"]
        assert (slider.low, slider.high) == (0.04, 1.0)
    assert editor.drawn == DrawnRegion(centre=(0.35, 0.45, 0.22), half_size=(0.14, 0.14, 0.10))
    assert shown(page) == ((0.35, 0.45, 0.22), (0.28, 0.28, 0.2))
    gizmo, box, corner, mark = (
        page.made[name] for name in ("/region", "/region/box", "/region/corner", "/target")
    )
    assert (gizmo.scale, gizmo.disable_rotations) == (0.16, True)
    assert (box.opacity, box.side) == (0.12, "double")
    assert (box.cast_shadow, box.receive_shadow) == (False, False)
    assert (corner.radius, mark.radius) == (0.022, 0.02)
    assert not page.made["Active"].value
    assert not mark.visible
    assert editor.target is None
    page.made["Active"].value = True
    page.use("Active")
    assert box.opacity == 0.3


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_corner_is_dragged_in_the_plane_across_the_view(page, editor, axis):
    start = DrawnRegion(centre=(0.1, 0.2, 0.3), half_size=(0.1, 0.1, 0.1))
    editor.draw(start)
    corner = np.array(start.centre) + 0.1
    away = np.eye(3)[axis]
    client = SimpleNamespace(camera=SimpleNamespace(position=corner + 2.0 * away))
    aside = np.roll([0.0, 0.05, 0.12], axis)
    # Half way to the corner a pointer is half as far aside as in its plane.
    pointer = corner + 1.0 * away + aside / 2
    page.use("/region/corner", SimpleNamespace(client=client, end_position=tuple(pointer)))
    np.testing.assert_allclose(editor.drawn.half_size, 0.1 + aside, atol=1e-9)


@pytest.mark.parametrize("half", [0.02, 0.03])
def test_a_region_is_no_thinner_than_two_centimetres_to_either_side(half):
    points = np.array([[0.1, 0.2, 0.0], [0.1, 0.3, 0.0]])
    region = region_over(points, bottom=0.4, height=2 * half)
    np.testing.assert_allclose(region.half_size, (0.02, 0.05, half))
    np.testing.assert_allclose(region.centre, (0.1, 0.25, 0.4 + half))
