"""What a set of demonstrations hands over to be shown."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from .recording import Body, JointLimits


@dataclass(frozen=True, kw_only=True, eq=False)
class ShownDemonstration:
    """One demonstration; whatever was not recorded is None.

    Raises:
        ValueError: If a field has another number of samples than `time`.
    """

    episode: int
    task: str
    time: Float[np.ndarray, " time"]
    """[s]"""
    joint_position: Float[np.ndarray, "time joints"] | None = None
    """[rad], or [m] of sliding joints."""
    position: Float[np.ndarray, "time 3"] | None = None
    """Tool centre point [m]."""
    feature: Float[np.ndarray, "time 2"] | None = None
    """In the image [px]; NaN while it was not seen."""
    human_effort: Float[np.ndarray, "time joints"] | None = None
    gripper: Float[np.ndarray, " time"] | None = None
    """Opening [m]."""
    bodies: tuple[Body, ...] = ()
    """The arm along the demonstration."""

    def __post_init__(self) -> None:
        for name in ("joint_position", "position", "feature", "human_effort", "gripper"):
            value = getattr(self, name)
            if value is not None and len(value) != len(self.time):
                raise ValueError(
                    f"episode {self.episode}: {name} has {len(value)} samples, but time has "
                    f"{len(self.time)}."
                )

    @property
    def duration(self) -> float:
        """[s]"""
        return float(self.time[-1] - self.time[0])

    @property
    def length(self) -> float | None:
        """Of the path of the tool centre point [m]."""
        if self.position is None:
            return None
        return float(np.linalg.norm(np.diff(self.position, axis=0), axis=1).sum())


@dataclass(frozen=True, kw_only=True, eq=False)
class DemonstrationsRecording:
    """Demonstrations of one task by one robot.

    Raises:
        ValueError: If there is none.
    """

    title: str
    joint_names: tuple[str, ...]
    demonstrations: tuple[ShownDemonstration, ...]
    joint_limits: JointLimits | None = None
    notes: tuple[str, ...] = ()
    """What was guessed or odd when they were read."""

    def __post_init__(self) -> None:
        if not self.demonstrations:
            raise ValueError("there is no demonstration to show.")
