"""The way into a shelf: its last stretch, compared with the demonstrated one."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True, kw_only=True, eq=False)
class Insertion:
    """The last stretch of a path of the hand, from a plane across the way on.

    The way in runs against y, as boards that open towards +y want it.
    """

    offset: Float[np.ndarray, "samples 3"]
    """Of the hand from the goal [m]."""

    @classmethod
    def of(
        cls,
        path: Float[np.ndarray, "steps 3"],
        goal: Float[np.ndarray, "3"],
        edge: float,
    ) -> "Insertion":
        """Cut it off.

        Args:
            path: Of the hand [m].
            goal: Where it should end [m].
            edge: y at which the insertion begins, when it is crossed for the last time [m]. A
                path that ends in front of it has no samples.
        """
        outside = np.flatnonzero(path[:, 1] > edge)
        first = int(outside[-1]) + 1 if len(outside) else 0
        return cls(offset=path[first:] - goal)

    @property
    def left(self) -> Float[np.ndarray, " samples"]:
        """What is left of the way in [m]."""
        return self.offset[:, 1]

    def aside(self, other: "Insertion") -> Float[np.ndarray, " samples"]:
        """Distance from another way in, sideways and in height, where that is as deep [m].

        Both are taken relative to their goals, so that shelves can be compared.
        """
        # A hand that trembles goes back a little: count from where it first was that deep.
        progress = np.maximum.accumulate(-other.left)
        there = [np.interp(-self.left, progress, other.offset[:, k]) for k in (0, 2)]
        return np.hypot(self.offset[:, 0] - there[0], self.offset[:, 2] - there[1])

    def bend(self, other: "Insertion") -> float:
        """Largest of these distances [m]; infinite if the hand never got in."""
        return float(self.aside(other).max()) if len(self.offset) else np.inf
