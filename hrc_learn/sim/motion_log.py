"""Where everything that moves has been, to be drawn afterwards."""

import numpy as np

from ..viz import Body
from .moving_bodies import MovingBodies
from .world import World


class MotionLog:
    """Remembers where everything that moves was after each step of the station."""

    def __init__(self, world: World):
        self._world = world
        self._bodies = MovingBodies(world)
        self._positions: list[np.ndarray] = []
        self._orientations: list[np.ndarray] = []

    def __len__(self) -> int:
        return len(self._orientations)

    def advance(self, duration: float) -> None:
        """Note where everything is, then let the world go on [s]."""
        position, orientation = self._bodies.poses()
        self._positions.append(position)
        self._orientations.append(orientation)
        self._world.advance(duration)

    def bodies(self, steps: int | None = None) -> tuple[Body, ...]:
        """Everything that moved, as it is to be drawn.

        Args:
            steps: The first steps only.
        """
        positions = np.stack(self._positions[:steps])
        return self._bodies.drawn(positions, np.stack(self._orientations[:steps]))
