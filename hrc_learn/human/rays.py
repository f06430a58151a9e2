"""Pointing into the scene: from a place on the screen to a point or a box in the workplace."""

import math

import numpy as np
import torch
from jaxtyping import Float

from ..geometry import quaternion
from ..protocols import DrawnRegion


def view_ray(
    screen: tuple[float, float],
    orientation: Float[np.ndarray, "4"],
    field_of_view: float,
    aspect: float,
) -> Float[np.ndarray, "3"]:
    """Direction in which a camera sees a place on its screen, as a unit vector.

    Args:
        screen: Place, from (0, 0) at the upper left to (1, 1) at the lower right.
        orientation: Of the camera (wxyz): x right, y down, z into the scene.
        field_of_view: From the lower to the upper edge [rad].
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
    """Where a ray meets a plane on which one coordinate is the same everywhere.

    Args:
        origin: Of the ray [m].
        direction: Unit vector.
        axis: Which coordinate: 2 for a horizontal plane.
        value: Of the coordinate on the plane [m].

    Returns:
        The point [m]; None if the ray leads away from the plane or along it.
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
    """Distance at which a ray enters a box along the base axes, infinity if it does not [m].

    The slabs of Kay and Kajiya (1986).

    Args:
        origin: Of the ray [m], outside the box.
        direction: Unit vector.
        centre: Of the box [m].
        half_size: Of the box [m].
    """
    # A component of zero leaves its slab never or always: both infinities say so.
    safe = np.where(np.abs(direction) < 1e-12, 1e-12, direction)
    near = (centre - half_size - origin) / safe
    far = (centre + half_size - origin) / safe
    enter = float(np.minimum(near, far).max())
    leave = float(np.maximum(near, far).min())
    return enter if 0 < enter <= leave else math.inf


def region_over(
    points: Float[np.ndarray, "points 3"],
    bottom: float,
    height: float,
    smallest: float = 0.02,
) -> DrawnRegion:
    """The upright box over the rectangle that holds some points, along the base axes.

    Args:
        points: Seen from above [m]; their heights do not matter.
        bottom: Height of the box's lower face [m].
        height: Of the box [m].
        smallest: Half size that no edge falls below [m].
    """
    low, high = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
    x, y = ((low + high) / 2).tolist()
    a, b = np.maximum((high - low) / 2, smallest).tolist()
    c = max(height / 2, smallest)
    return DrawnRegion(centre=(x, y, bottom + c), half_size=(a, b, c))
