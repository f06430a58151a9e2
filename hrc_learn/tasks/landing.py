"""Where on the shelves things go: drawn, and said in words, for a person who shows the way."""

import numpy as np
from jaxtyping import Float

from ..viz import Box
from ..viz.palette import GREEN, rgba
from .workplace import Workplace

_THICKNESS = 0.002  # of what is drawn on a board [m]


def landing_places(workplace: Workplace) -> list[Box]:
    """A green field on each board, where the thing stands once the hand has let go of it."""
    item, (red, green, blue, _) = workplace.scene.objects[0], rgba(GREEN)
    # Held from above, a thing lies on its side once the hand points level.
    x, y = item.half_size[0], item.half_size[2]
    fields = []
    for name in workplace.shelf_names():
        place = workplace.shelf(name).position.tolist()
        height = workplace.scene.cabinet.shelves[name] + _THICKNESS
        fields.append(
            Box(
                name=f"place_{name}",
                centre=(place[0], place[1], height),
                half_size=(x, y, _THICKNESS),
                colour=(red / 255, green / 255, blue / 255, 1.0),
            )
        )
    return fields


def way_left(workplace: Workplace, hand: Float[np.ndarray, "3"]) -> str:
    """How far the hand is from where it would let go on the nearest shelf, in words.

    Args:
        workplace: With the shelves.
        hand: Tool centre point [m].
    """
    names = workplace.shelf_names()
    offsets = {name: workplace.shelf(name).position.numpy() - hand for name in names}
    nearest = min(names, key=lambda name: float(np.linalg.norm(offsets[name])))
    away, left, up = 100 * offsets[nearest]
    steps = (
        _step(away, "away", "back"),
        _step(left, "left", "right"),
        _step(up, "up", "down"),
    )
    return f"{nearest} shelf: {', '.join(step for step in steps if step) or 'there'}"


def _step(way: float, forward: str, backward: str) -> str:
    """A way [cm] in a direction or the other; nothing below one."""
    return "" if abs(way) < 1 else f"{abs(way):.0f} cm {forward if way > 0 else backward}"
