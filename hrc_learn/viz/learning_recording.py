"""What a fit in rounds hands over to be shown: how it converged, and where it errs."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True, kw_only=True, eq=False)
class ErrorMap:
    """Shares over cells of the horizontal plane."""

    x: Float[np.ndarray, " nx_and_1"]
    """Edges of the cells [m]."""
    y: Float[np.ndarray, " ny_and_1"]
    """Edges of the cells [m]."""
    z: float
    """Height at which they are drawn [m]."""
    share: Float[np.ndarray, "nx ny"]
    """Error over size of what was predicted; NaN in an empty cell."""


@dataclass(frozen=True, kw_only=True, eq=False)
class LearningRecording:
    """Rounds of learning, the first before anything was learned.

    Raises:
        ValueError: If curves or centres do not have a value for each round, or the best round
            is none of them.
    """

    title: str
    measured: Mapping[str, float] = field(default_factory=dict)
    """Values of the result, by name."""
    curves: Mapping[str, Float[np.ndarray, "_"]] = field(default_factory=dict)
    """Of the rounds, by name with unit; none where nothing was learned in rounds."""
    best: int = 0
    """The round that was kept."""
    centers: Float[np.ndarray, "rounds neurons 3"] = field(
        default_factory=lambda: np.zeros((1, 0, 3))
    )
    """Where the neurons stood in each [m]."""
    paths: tuple[Float[np.ndarray, "_ 3"], ...] = ()
    """Of the hand in demonstrations [m]."""
    errors: ErrorMap | None = None
    """On demonstrations held out."""

    def __post_init__(self) -> None:
        rounds = len(self.centers)
        for name, values in self.curves.items():
            if len(values) != rounds:
                raise ValueError(
                    f"{name!r} has {len(values)} values, but there are centers of {rounds} "
                    "rounds; they must agree."
                )
        if not 0 <= self.best < rounds:
            raise ValueError(f"best must be one of the {rounds} rounds, but is {self.best}.")
