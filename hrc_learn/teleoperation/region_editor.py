"""Draw, move and size the region that attracts the end effector, and mark the target."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from hrc_learn.geometry import Box, quaternion
from hrc_learn.protocols import DrawnRegion
from hrc_learn.teleoperation.page_scene import ViserServer, box_edges, in_loop
from hrc_learn.viz.palette import GREEN, VERMILION, rgba


def view_ray(
    screen: tuple[float, float],
    orientation: Float[np.ndarray, "4"],
    field_of_view: float,
    aspect: float,
) -> Float[np.ndarray, "3"]:
    """Unit vector from a camera through a point of its screen.

    Args:
        screen: Point of the screen, from (0, 0) at the upper left to (1, 1) at the lower right.
        orientation: Orientation of the camera (wxyz): x right, y down, z into the scene.
        field_of_view: Vertical field of view [rad].
        aspect: Width over height of the screen.
    """
    half = math.tan(field_of_view / 2)
    x, y = (2 * screen[0] - 1) * half * aspect, (2 * screen[1] - 1) * half
    ray = torch.tensor([x, y, 1.0], dtype=torch.float64)
    turned = quaternion.rotate(torch.as_tensor(orientation, dtype=torch.float64), ray)
    return (turned / turned.norm()).numpy()


def meet_plane(
    origin: Float[np.ndarray, "3"], direction: Float[np.ndarray, "3"], axis: int, value: float
) -> Float[np.ndarray, "3"] | None:
    """Intersection of a ray with an axis-aligned plane.

    Args:
        origin: Origin of the ray [m].
        direction: Direction of the ray, a unit vector.
        axis: Axis normal to the plane: 2 for a horizontal plane.
        value: Coordinate of the plane along that axis [m].

    Returns:
        The point [m]; None if the ray is parallel to the plane or points away from it.
    """
    if abs(direction[axis]) < 1e-9:
        return None
    distance = (value - origin[axis]) / direction[axis]
    return origin + distance * direction if distance > 0 else None


def meet_box(
    origin: Float[np.ndarray, "3"],
    direction: Float[np.ndarray, "3"],
    centre: Float[np.ndarray, "3"],
    half_size: Float[np.ndarray, "3"],
) -> float:
    """Distance at which a ray enters an axis-aligned box [m]; infinity if it misses the box.

    This is the slab method of Kay and Kajiya (1986).

    Args:
        origin: Origin of the ray [m], outside the box.
        direction: Direction of the ray, a unit vector.
        centre: Centre of the box [m].
        half_size: Half size of the box [m].
    """
    # For a ray parallel to a slab, both distances become huge: with equal signs if the origin
    # is outside the slab, with opposite signs if it is inside.
    safe = np.where(np.abs(direction) < 1e-12, 1e-12, direction)
    near = (centre - half_size - origin) / safe
    far = (centre + half_size - origin) / safe
    enter = float(np.minimum(near, far).max())
    leave = float(np.maximum(near, far).min())
    return enter if 0 < enter <= leave else math.inf


def region_over(
    points: Float[np.ndarray, "points 3"], bottom: float, height: float, smallest: float = 0.02
) -> DrawnRegion:
    """Axis-aligned box over the bounding rectangle of points, as seen from above.

    Args:
        points: Points [m]; their heights do not matter.
        bottom: Height of the box's lower face [m].
        height: Height of the box [m].
        smallest: Smallest half size along any axis [m].
    """
    low, high = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
    half_size = np.maximum(np.append(high - low, height) / 2, smallest)
    centre = np.append((low + high) / 2, bottom + half_size[2])
    return DrawnRegion(centre=_triple(centre), half_size=_triple(half_size))


def _triple(vector: Sequence[float] | Float[np.ndarray, "3"]) -> tuple[float, float, float]:
    x, y, z = map(float, vector)
    return x, y, z


FIRST_REGION = DrawnRegion(centre=(0.35, 0.45, 0.22), half_size=(0.14, 0.14, 0.10))
"""Initial region, for a Panda."""

_COLOUR = rgba(GREEN)[:3]
_DRAW: Any = "cube-plus"
QUIET = 73, 80, 87
"""Colour of buttons that undo something, dark enough for white letters (8:1)."""
_MARK: Any = "target"
# Largest and smallest half sizes of a region [m]: the largest is the reach of the arm, the
# smallest leaves a margin around a point.
_LARGEST, _SMALLEST = 0.5, 0.02
# Height of a target above the clicked surface, for a Panda: a little more than an object's
# height [m].
_LIFTED = 0.08


class RegionEditor:
    """The box in the scene, its controls in the panel, and the mark of the target.

    Attributes:
        drawn: The region, active or not.
        target: Marked point [m]; None: no target.
    """

    def __init__(self, server: ViserServer, boxes: Sequence[Box], size: float = 1.0):
        """Draw the initial region, not active.

        Args:
            server: Server of the page; controls go into the folder that is open.
            boxes: Furniture that targets may be marked on.
            size: Size of the hand, 1 for a Panda, by which lengths are scaled.
        """
        self._server, self._scene, self._boxes = server, server.scene, tuple(boxes)
        self._size, first = size, FIRST_REGION
        centre, half_size = (size * np.array(v) for v in (first.centre, first.half_size))
        self.drawn = DrawnRegion(centre=_triple(centre), half_size=_triple(half_size))
        self.target: tuple[float, float, float] | None = None
        self._add_controls()
        self._add_nodes()
        self._update()

    @property
    def region(self) -> DrawnRegion | None:
        """The region; None while it is not active."""
        return self.drawn if self._in_force.value else None

    def draw(self, region: DrawnRegion, active: bool | None = None) -> None:
        """Set the region, and update scene and panel.

        Args:
            region: The region.
            active: True if the region attracts the end effector; None: no change.
        """
        if active is not None:
            self._in_force.value = active
        self.drawn = region
        self._update()

    def mark(self, point: Float[np.ndarray, "3"] | None) -> None:
        """Mark the target at a point [m]; None: remove it."""
        self._mark.visible = point is not None
        self.target = None if point is None else _triple(point)
        if point is not None:
            self._mark.position = point

    def _add_controls(self) -> None:
        gui = self._server.gui
        draw = gui.add_button("Draw on the table", icon=_DRAW)
        select = self._scene.on_rect_select, self._scene.remove_rect_select_callback
        draw.on_click(in_loop(lambda _: _once(draw, *select, self._draw_over)))
        self._in_force = gui.add_checkbox(
            "Active", False, hint="The end effector is attracted into the region."
        )
        self._in_force.on_update(in_loop(lambda _: self._update()))
        self._sizes = [
            gui.add_slider(f"Size {axis} [m]", 2 * _SMALLEST, 2 * _LARGEST, 0.01, 0.1)
            for axis in "xyz"
        ]
        for slider in self._sizes:
            slider.on_update(in_loop(self._resized))
        mark = gui.add_button("Mark the target", icon=_MARK)
        click = self._scene.on_click, self._scene.remove_click_callback
        mark.on_click(in_loop(lambda _: _once(mark, *click, self._mark_above)))
        clear = gui.add_button("Clear the target", color=QUIET)
        clear.on_click(in_loop(lambda _: self.mark(None)))

    def _add_nodes(self) -> None:
        scene, region = self._scene, self.drawn
        self._gizmo = scene.add_transform_controls(
            "/region", scale=0.16 * self._size, disable_rotations=True, position=region.centre
        )
        self._gizmo.on_update(self._moved)
        self._box = scene.add_box(
            "/region/box",
            color=_COLOUR,
            dimensions=_triple(2 * np.array(region.half_size)),
            opacity=0.12,
            side="double",
            cast_shadow=False,
            receive_shadow=False,
        )
        self._edges = scene.add_line_segments(
            "/region/edges", box_edges(region.half_size), _COLOUR, thickness=0.004
        )
        self._corner = scene.add_icosphere(
            "/region/corner",
            radius=0.022 * self._size,
            color=_COLOUR,
            position=region.half_size,
        )
        self._corner.on_drag(self._corner_dragged)
        self._mark = scene.add_icosphere(
            "/target", radius=0.02 * self._size, color=rgba(VERMILION)[:3], visible=False
        )
        self._mark.on_drag(in_loop(lambda event: self.mark(np.array(event.end_position))))

    async def _moved(self, event: Any) -> None:
        self.drawn = replace(self.drawn, centre=_triple(event.target.position))

    async def _corner_dragged(self, event: Any) -> None:
        # Two sizes follow the pointer; the third, along the view, stays as it is.
        centre = np.array(self.drawn.centre)
        corner, eye = centre + self.drawn.half_size, event.client.camera.position
        view = np.array(event.end_position) - eye
        axis = int(np.abs(view).argmax())
        place = meet_plane(eye, view / np.linalg.norm(view), axis, corner[axis])
        if place is not None:
            half_size = np.clip(place - centre, _SMALLEST, _LARGEST)
            self.draw(replace(self.drawn, half_size=_triple(half_size)))

    def _resized(self, event: Any) -> None:
        if event.client is not None:  # otherwise, the program has moved the slider
            sizes = [slider.value / 2 for slider in self._sizes]
            self.draw(replace(self.drawn, half_size=_triple(sizes)))

    def _update(self) -> None:
        region = self.drawn
        self._gizmo.position = region.centre
        self._box.dimensions = _triple(2 * np.array(region.half_size))
        self._box.opacity = 0.3 if self._in_force.value else 0.12
        self._edges.points = box_edges(region.half_size)
        self._corner.position = region.half_size
        for slider, half in zip(self._sizes, region.half_size, strict=True):
            slider.value = round(2 * half, 3)

    def _draw_over(self, event: Any) -> None:
        """Use a rectangle drawn on the screen as the region's footprint on the table."""
        (left, top), (right, bottom) = event.screen_min, event.screen_max
        x, y = (left + right) / 2, (top + bottom) / 2
        camera = event.client.camera
        points = []
        for screen in ((left, y), (right, y), (x, top), (x, bottom)):
            ray = view_ray(screen, camera.wxyz, camera.fov, camera.aspect)
            points.append(meet_plane(camera.position, ray, 2, 0.0))
        if all(point is not None for point in points):
            half = self.drawn.half_size[2]
            self.draw(region_over(np.array(points), self.drawn.centre[2] - half, 2 * half))

    def _mark_above(self, event: Any) -> None:
        """Mark the target above the clicked point of the furniture. If the click hit no
        furniture, mark it above the clicked point at the height of the table.
        """
        origin, direction = np.array(event.ray_origin), np.array(event.ray_direction)
        distances = [
            meet_box(origin, direction, np.array(box.centre), np.array(box.half_size))
            for box in self._boxes
        ]
        nearest = min(distances, default=np.inf)
        if np.isfinite(nearest):
            point = origin + nearest * direction
        else:
            point = meet_plane(origin, direction, 2, 0.0)
        if point is not None:
            self.mark(point + np.array([0.0, 0.0, self._size * _LIFTED]))


def _once(
    button: Any, listen: Any, remove: Callable[[Any], None], act: Callable[[Any], None]
) -> None:
    """Act on the next event of the pointer only; the button is disabled until then."""
    button.disabled = True

    async def heard(event: Any) -> None:
        remove(heard)
        button.disabled = False
        act(event)

    listen()(heard)
