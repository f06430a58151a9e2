"""What a sweep hands over to be shown: how often and how fast its trials succeeded."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int


@dataclass(frozen=True, kw_only=True, eq=False)
class SweptTrials:
    """The trials of one experiment."""

    success: Bool[np.ndarray, " trials"]
    arrival: Float[np.ndarray, " trials"]
    """When each was on target for good [s]; infinite if it never was."""
    group: Int[np.ndarray, " trials"]
    """Class of each trial, counted from 0."""

    def share(self, time: Float[np.ndarray, " time"]) -> Float[np.ndarray, " time"]:
        """Share of the trials that are on target."""
        return np.searchsorted(np.sort(self.arrival), time, side="right") / len(self.arrival)

    def of(self, group: int) -> "SweptTrials":
        """The trials of a class."""
        chosen = self.group == group
        return SweptTrials(
            success=self.success[chosen],
            arrival=self.arrival[chosen],
            group=self.group[chosen],
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class SweepRecording:
    """Experiments of one kind, their trials in classes.

    Raises:
        ValueError: If there is no experiment, or one has a class without a name or no trials.
    """

    title: str
    groups: tuple[str, ...]
    """Names of the classes, with their unit."""
    experiments: Mapping[str, SweptTrials]

    def __post_init__(self) -> None:
        if not self.experiments:
            raise ValueError("a sweep needs at least one experiment.")
        for name, trials in self.experiments.items():
            if not len(trials.group):
                raise ValueError(f"experiment {name!r} has no trials.")
            if trials.group.max() >= len(self.groups):
                raise ValueError(
                    f"experiment {name!r} has a trial of class {trials.group.max()}, but there "
                    f"are {len(self.groups)} classes, counted from 0."
                )
