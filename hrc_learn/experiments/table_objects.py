"""Objects on the table of a work cell: up to three boxes in random, clear poses."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float

from hrc_learn.geometry import quaternion
from hrc_learn.kinematics import Arm
from hrc_learn.sim import ObjectConfig, World
from hrc_learn.sim.workplace import Workplace
from hrc_learn.vision import Marker

THREE_OBJECTS = (
    ObjectConfig(),
    ObjectConfig(
        name="carton",
        half_size=(0.027, 0.034, 0.028),
        mass=0.15,
        marker=Marker(12, 0.030),
        colour=(0.80, 0.47, 0.13, 1.0),
    ),
    ObjectConfig(
        name="tin",
        half_size=(0.019, 0.036, 0.026),
        mass=0.10,
        marker=Marker(13, 0.027),
        colour=(0.20, 0.55, 0.38, 1.0),
    ),
)
"""Three boxes that fit into the gripper."""

OBJECT_REACH = (0.10, 0.08, 0.0)
"""Largest distance of a single object from the middle of the table [m]."""
OBJECTS_REACH = (0.12, 0.10)
"""Largest distance of several objects from the middle of the table along x and y [m]."""

# Distance at which the open fingers around one object clear the next one, in any orientation
# [m]: 0.06 m to the outside of a finger, 0.046 m to the corner of the largest object.
_APART = 0.118


def with_objects(workplace: Workplace, items: Sequence[ObjectConfig]) -> Workplace:
    """Workplace with these objects on its table."""
    return replace(workplace, scene=replace(workplace.scene, objects=tuple(items)))


def workplace_for(shelves: Sequence[str], robot: Arm) -> Workplace:
    """Workplace of an arm with one object for each shelf.

    Raises:
        ValueError: If no shelf is named, or more than there are objects.
    """
    if not 1 <= len(shelves) <= len(THREE_OBJECTS):
        raise ValueError(
            f"{len(shelves)} shelves are named, but there are 1 to {len(THREE_OBJECTS)} "
            "objects, each with a shelf of its own."
        )
    return with_objects(Workplace.of(robot), THREE_OBJECTS[: len(shelves)])


def check_shelves(workplace: Workplace, shelves: Sequence[str]) -> None:
    """Check that every object has a shelf of its own.

    Raises:
        ValueError: If a shelf is unknown or named twice, or their number is wrong.
    """
    items = workplace.scene.objects
    for name in shelves:
        workplace.shelf(name)
    if len(shelves) != len(items) or len(set(shelves)) != len(shelves):
        raise ValueError(
            f"each of the {len(items)} objects needs a shelf of its own, but the shelves are "
            f"{', '.join(shelves)}."
        )


def draw_object_poses(
    workplace: Workplace, world: World, yaw: float, rng: np.random.Generator
) -> dict[str, Float[np.ndarray, "4 4"]]:
    """Random poses of all objects on the table, with its true height and the true object sizes.

    Args:
        workplace: Workplace of the world.
        world: World with the objects.
        yaw: Largest rotation about the vertical, either way [rad].
        rng: Source of positions and rotations.
    """
    items = world.config.objects
    reach = OBJECT_REACH[:2] if len(items) == 1 else OBJECTS_REACH
    return random_object_poses(
        items, workplace.table_centre, reach, rng, yaw=yaw, table_top=world.table_top
    )


def random_object_poses(
    items: Sequence[ObjectConfig],
    middle: tuple[float, float],
    reach: tuple[float, float],
    rng: np.random.Generator,
    *,
    yaw: float = np.pi,
    table_top: float = 0.0,
    attempts: int = 10_000,
) -> dict[str, Float[np.ndarray, "4 4"]]:
    """Random poses of objects on the table, clear of each other.

    Args:
        items: The objects.
        middle: Middle of the region in which they lie [m].
        reach: Largest distance from the middle along x and y [m].
        rng: Source of positions and rotations.
        yaw: Largest rotation about the vertical, either way [rad].
        table_top: Height of the table [m].
        attempts: Largest number of arrangements tried.

    Raises:
        ValueError: If they do not fit.
    """
    for _ in range(attempts):
        positions = np.array(middle) + rng.uniform(-1, 1, (len(items), 2)) * reach
        if _are_clear(positions):
            return {
                item.name: _pose_on_table(item, position, rng.uniform(-yaw, yaw), table_top)
                for item, position in zip(items, positions, strict=True)
            }
    raise ValueError(
        f"{len(items)} objects do not fit within {reach[0]:g} and {reach[1]:g} m of the "
        "middle with clearance for the fingers: use fewer objects or a larger reach."
    )


def _are_clear(positions: Float[np.ndarray, "objects 2"]) -> bool:
    first, second = np.triu_indices(len(positions), k=1)
    gaps = np.linalg.norm(positions[first] - positions[second], axis=1)
    return bool((gaps >= _APART).all())


def _pose_on_table(
    item: ObjectConfig, position: Float[np.ndarray, "2"], yaw: float, table_top: float
) -> Float[np.ndarray, "4 4"]:
    c, s = np.cos(yaw), np.sin(yaw)
    pose = np.eye(4)
    pose[:2, :2] = [[c, -s], [s, c]]
    pose[:3, 3] = (*position, table_top + item.half_size[2])
    return pose


def points_to_see(workplace: Workplace, world: World) -> Float[np.ndarray, "points 3"]:
    """Points that a camera must see: the region of the objects and of the gripper's marker [m].

    Args:
        workplace: Workplace of the world.
        world: World with the true place of the marker on the gripper.
    """
    reach = np.array([*OBJECTS_REACH, 0.0])
    corners = np.array([[a, b, 0.0] for a in (-1, 1) for b in (-1, 1)])
    hover, offset = workplace.hover(), torch.from_numpy(world.hand_marker_offset())
    turns = torch.linspace(*workplace.hover_turns, 7, dtype=torch.float64)
    about_z = torch.stack([0 * turns, 0 * turns, turns], dim=-1)
    orientations = quaternion.multiply(quaternion.exp(about_z), hover.orientation)
    markers = (hover.position + quaternion.rotate(orientations, offset)).numpy()
    on_table = np.array([*workplace.table_centre, workplace.scene.objects[0].half_size[2]])
    # The plate of a marker extends 3 cm from its centre; the rest is margin.
    return np.concatenate(
        [middle + corners * (reach + 0.05) for middle in (on_table, *markers)]
    )
