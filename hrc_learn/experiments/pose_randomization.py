"""Objects on the table: what they are, and where they happen to lie."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from hrc_learn.sim import ObjectConfig
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
"""Three boxes of sizes that the gripper takes, none so tall that the palm meets it when the
fingers reach down beside it."""

_APART = (0.115, 0.095)
"""Distance along x or y at which the open fingers about one object clear the next [m]."""
_TURN = 0.06
"""How far an object is turned at most, either way [rad]."""


def scatter(
    items: Sequence[ObjectConfig],
    middle: tuple[float, float],
    reach: tuple[float, float],
    rng: np.random.Generator,
    attempts: int = 10_000,
) -> dict[str, Float[np.ndarray, "4 4"]]:
    """Poses of objects that lie at random, clear of each other.

    Args:
        items: The objects.
        middle: Of the part of the table where they lie [m].
        reach: How far from it they lie at most, along x and y [m].
        rng: Source of places and turns.
        attempts: Arrangements tried.

    Raises:
        ValueError: If they do not fit.
    """
    for _ in range(attempts):
        places = np.array(middle) + rng.uniform(-1, 1, (len(items), 2)) * reach
        if _clear(places):
            return {
                item.name: _lying(item, place, rng.uniform(-_TURN, _TURN))
                for item, place in zip(items, places, strict=True)
            }
    raise ValueError(
        f"{len(items)} objects do not fit within {reach[0]:g} and {reach[1]:g} m of the "
        "middle with room for the fingers between them: fewer objects, or more reach."
    )


def _clear(places: Float[np.ndarray, "objects 2"]) -> bool:
    first, second = np.triu_indices(len(places), k=1)
    gaps = np.abs(places[first] - places[second])
    return bool((gaps >= _APART).any(axis=1).all())


def _lying(
    item: ObjectConfig, place: Float[np.ndarray, "2"], turn: float
) -> Float[np.ndarray, "4 4"]:
    c, s = np.cos(turn), np.sin(turn)
    pose = np.eye(4)
    pose[:2, :2] = [[c, -s], [s, c]]
    pose[:3, 3] = (*place, item.half_size[2])
    return pose
