"""Figures that every run gives by the same name, from whatever its trials measured."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from hrc_learn.experiments.monte_carlo import Summary, Trial


@dataclass(frozen=True)
class Figure:
    """One figure over all trials."""

    measured: str
    """Name of the value that it is made of; "_name" is any that ends so."""
    of: Callable[[np.ndarray], float]
    factor: float = 1.0
    """To the unit that the name of the figure says."""

    def matches(self, name: str) -> bool:
        """Whether it is made of the value of that name."""
        if self.measured.startswith("_"):
            return name.endswith(self.measured)
        return name == self.measured


def total(values: np.ndarray) -> float:
    """Of a count, over all trials."""
    return float(values.sum())


def median(values: np.ndarray) -> float:
    """Of trials that measured it."""
    return float(np.median(values))


def p95(values: np.ndarray) -> float:
    """What 95 % of trials stay below."""
    return float(np.percentile(values, 95))


def common_figures(
    trials: Sequence[Trial], figures: Mapping[str, Figure]
) -> dict[str, float | int]:
    """Number and success rate of trials, and of the figures what was measured.

    Args:
        trials: At least one.
        figures: By the name that they are given. One that no trial measured is left out.
    """
    summary = Summary.of(trials)
    values: dict[str, float | int] = {
        "trials": summary.trials,
        "success_rate": summary.successes / summary.trials,
    }
    for name, figure in figures.items():
        found = np.array(
            [
                value
                for trial in trials
                for key, value in trial.values.items()
                if figure.matches(key) and not isinstance(value, str)
            ],
            dtype=float,
        )
        found = found[np.isfinite(found)]
        if len(found):
            values[name] = figure.factor * figure.of(found)
    return values
