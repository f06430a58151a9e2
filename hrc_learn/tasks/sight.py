"""What a camera saw, and how it gets to the task: late, and not always."""

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True, kw_only=True)
class Sight:
    """Markers found in an image."""

    time: float = -np.inf
    """When the image was taken [s]."""
    joints: Float[Tensor, " joints"] | None = None
    """Joint positions at that time [rad]."""
    pixels: Mapping[int, Float[np.ndarray, "2"]] = field(default_factory=dict)
    """Centre of each marker in it, by number (u, v) [px]."""


@dataclass(frozen=True, kw_only=True)
class TransportConfig:
    """What happens to images on their way."""

    latency: float = 0.0
    """From an image being taken until its markers are known [s]."""
    dropped: float = 0.0
    """Share of the images that never arrive."""

    def __post_init__(self) -> None:
        if self.latency < 0 or not 0 <= self.dropped < 1:
            raise ValueError(
                "latency must not be negative and dropped must be in [0, 1), but are "
                f"{self.latency:g} s and {self.dropped:g}."
            )


class Transport:
    """Images on their way from camera to task, in the order in which they were taken."""

    def __init__(self, config: TransportConfig, rng: np.random.Generator):
        """Nothing is under way yet.

        Args:
            config: How late, and how many are lost.
            rng: Decides which.
        """
        self._config, self._rng = config, rng
        self._under_way: deque[Sight] = deque()

    def send(self, sight: Sight) -> None:
        """Hand over what was found in an image."""
        if self._rng.random() >= self._config.dropped:
            self._under_way.append(sight)

    def newest(self, time: float) -> Sight | None:
        """The newest that has arrived by a time [s] since last asked; None if none has."""
        arrived = None
        taken_by = time - self._config.latency + 1e-9  # clocks add up steps
        while self._under_way and self._under_way[0].time <= taken_by:
            arrived = self._under_way.popleft()
        return arrived
