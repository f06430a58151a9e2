"""Metrics of an experiment, for one run and over many trials.

A `Metric` has a name, a unit, a bound and the claim of the paper. A `Summary` holds the success
rate, quantiles and totals of trials, from which `median`, `p95` and others make metrics.
"""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from hrc_learn.experiments.trials import Trial
from hrc_learn.viz.report import Measurement

# mm: encoder noise of 1e-4 rad moves the tool by 0.1 to 0.2 mm, and contacts in MuJoCo yield by
# as much. deg: the same noise in seven joints adds up to sqrt(7) * 1e-4 rad. px: the noise of a
# detected marker centre is 0.08 px per coordinate. s: the control step.
RESOLUTIONS = {"mm": 0.1, "deg": 0.02, "px": 0.1, "s": 0.01}
"""Resolution of measurements by unit; values in other units are shown as they are."""


@dataclass(frozen=True)
class Metric[Run]:
    """One row of the table. `Run` is the result of one run of the experiment.

    Raises:
        ValueError: The metric has both an upper and a lower bound.
    """

    name: str
    """Name in words; with the unit it makes the key of the value in JSON files."""
    of: Callable[[Run], float | int | None]
    """Measures a run. An integer result is a count, which is summed over trials. If the result
    is None, the row is left out."""
    unit: str = ""
    _: KW_ONLY
    at_most: float | int | None = None
    """Upper bound; without a bound the value is only reported."""
    at_least: float | int | None = None
    """Lower bound."""
    claim: str = ""
    """Claim of the paper."""
    essential: bool = False
    """True if a run that misses the bound is a failure."""
    listed: bool = True
    """True if the table of the report has the row; the JSON file always has it."""
    detail: Callable[[Run], str] = lambda run: ""
    """Detail that is added to the reason if a run misses an essential bound."""

    def __post_init__(self) -> None:
        if self.at_most is not None and self.at_least is not None:
            raise ValueError(f"metric {self.name!r} has two bounds: split it into two metrics.")

    def measure(self, run: Run) -> Measurement | None:
        """Measured value with its bound; None if the run has no such value."""
        value = self.of(run)
        if value is None:
            return None
        return Measurement(
            name=self.name,
            value=value,
            unit=self.unit,
            target=self.at_most if self.at_least is None else self.at_least,
            at_least=self.at_least is not None,
            claim=self.claim,
            resolution=RESOLUTIONS.get(self.unit, 0.0),
        )

    def of_part[Whole](
        self, part: Callable[[Whole], Run], prefix: str = "", *, bounded: bool = True
    ) -> "Metric[Whole]":
        """The same metric for a part of a larger run.

        Args:
            part: Extracts the part from the whole.
            prefix: Prefix of the name.
            bounded: Keep the bound. False: the value is only reported, for comparison.
        """
        free = {} if bounded else {"at_most": None, "at_least": None, "essential": False}
        parted: Any = replace(self, name=f"{prefix}{self.name}", **free)
        return replace(
            parted,
            of=lambda whole: self.of(part(whole)),
            detail=lambda whole: self.detail(part(whole)),
        )


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """Values of a table of metrics."""

    table: tuple[Measurement, ...]
    """Listed rows, in order."""
    values: dict[str, float | int]
    """Every measured value by its key."""
    faults: tuple[str, ...]
    """Reason for which the task was given up, and essential bounds that were missed."""

    @property
    def failure(self) -> str:
        """All faults in one line; empty after a success."""
        return "; ".join(self.faults)

    @property
    def ok(self) -> bool:
        """True if there are no faults and every bound of the table is met."""
        return not self.faults and all(m.ok is not False for m in self.table)

    def __add__(self, other: "Evaluation") -> "Evaluation":
        """Concatenation of both tables."""
        return Evaluation(
            table=self.table + other.table,
            values=self.values | other.values,
            faults=self.faults + other.faults,
        )


def evaluate[Run](metrics: Iterable[Metric[Run]], run: Run, given_up: str = "") -> Evaluation:
    """Measure a run with each of the metrics.

    Args:
        metrics: The metrics.
        run: The run.
        given_up: Reason for which its task was given up; empty if it was not.
    """
    table, values, faults = [], {}, [given_up] if given_up else []
    for metric in metrics:
        measured = metric.measure(run)
        if measured is None:
            continue
        values[measured.key] = measured.value
        if metric.listed:
            table.append(measured)
        # NaN meets no bound: a value that could not be measured is no success.
        if metric.essential and measured.ok is False:
            fault = f"{metric.name}: {measured.shown}, but the bound is {measured.bound}"
            detail = metric.detail(run)
            faults.append(f"{fault} ({detail})" if detail else fault)
    return Evaluation(table=tuple(table), values=values, faults=tuple(faults))


# Quantile of the normal distribution for a two-sided interval of 95 %.
_Z = 1.959964

_UNITS = {"s", "m", "mm", "rad", "deg", "px", "%"}
"""Units at the ends of keys; the name of a statistic comes before: `place_error_p95_mm`."""


def wilson_interval(successes: int, trials: int) -> tuple[float, float]:
    """Confidence interval (95 %) of a success rate (Wilson 1927), valid also near 0 and 1.

    Args:
        successes: Number of successes.
        trials: Number of trials, at least one.

    Raises:
        ValueError: If there are no trials, or more successes than trials.
    """
    if not 0 <= successes <= trials or trials == 0:
        raise ValueError(f"{successes} successes in {trials} trials do not give a rate.")
    rate, z2 = successes / trials, _Z**2 / trials
    middle = rate + z2 / 2
    half = _Z * math.sqrt(rate * (1 - rate) / trials + z2 / (4 * trials))
    return max(0.0, (middle - half) / (1 + z2)), min(1.0, (middle + half) / (1 + z2))


def spread(values: Float[np.ndarray, " trials"]) -> dict[str, float]:
    """Quantiles of finite values, at least one: median, p95, min and max."""
    levels = {"median": 0.5, "p95": 0.95, "min": 0.0, "max": 1.0}
    # "higher" returns a measured value. At least the requested fraction of values is not above.
    found = np.quantile(values, [*levels.values()], method="higher")
    return dict(zip(levels, found.tolist(), strict=True))


@dataclass(frozen=True, kw_only=True)
class Summary:
    """Statistics of a repeated experiment."""

    trials: int
    failed: Mapping[int, str]
    """Reasons of failures, by seed."""
    spread: Mapping[str, Mapping[str, float]]
    """Quantiles of the values that are not counts, by key; failed trials are included."""
    totals: Mapping[str, int]
    """Sums of the counts, by key."""

    @classmethod
    def of(cls, trials: Sequence[Trial]) -> "Summary":
        """Statistics of the trials.

        Raises:
            ValueError: There are no trials.
        """
        if not trials:
            raise ValueError("there are no trials to sum up.")
        spreads, totals = {}, {}
        for key in dict.fromkeys(key for trial in trials for key in trial.values):
            counts = [trial.values.get(key, 0) for trial in trials]
            if all(isinstance(count, int) for count in counts):
                totals[key] = sum(map(int, counts))
            elif len(known := (values := column(trials, key))[np.isfinite(values)]):
                spreads[key] = spread(known)
        failed = {trial.seed: trial.failure for trial in trials if trial.failure}
        return cls(trials=len(trials), failed=failed, spread=spreads, totals=totals)

    @property
    def successes(self) -> int:
        """Number of trials that did not fail."""
        return self.trials - len(self.failed)

    @property
    def interval(self) -> tuple[float, float]:
        """Confidence interval (95 %) of the success rate."""
        return wilson_interval(self.successes, self.trials)

    @property
    def rate(self) -> str:
        """Successes and success rate in words."""
        low, high = self.interval
        return (
            f"{self.successes} of {self.trials} succeeded "
            f"({100 * low:.1f} to {100 * high:.1f} % with 95 % confidence)"
        )

    def figures(self) -> dict[str, float | int]:
        """The summary as one flat mapping of numbers, without seeds and reasons."""
        low, high = self.interval
        values: dict[str, float | int] = {
            "trials": self.trials,
            "successes": self.successes,
            "success_rate": self.successes / self.trials,
            "success_rate_low": low,
            "success_rate_high": high,
            **self.totals,
        }
        for key, quantiles in self.spread.items():
            stem, _, unit = key.rpartition("_")
            for kind, value in quantiles.items():
                name = f"{stem}_{kind}_{unit}" if unit in _UNITS else f"{key}_{kind}"
                values[name] = value
        return values

    def __str__(self) -> str:
        """The success rate, and the reasons of failures by seed."""
        reasons = [f"seed {seed}: {reason}" for seed, reason in self.failed.items()]
        return "\n".join([self.rate, *reasons])


def column(trials: Sequence[Trial], key: str) -> Float[np.ndarray, " trials"]:
    """One value of every trial; NaN where a trial has no such number."""
    values = (trial.values.get(key, math.nan) for trial in trials)
    return np.array([math.nan if isinstance(v, str) else v for v in values], dtype=float)


def never[Run](
    name: str,
    of: Callable[[Run], float | int | None],
    claim: str = "",
    detail: Callable[[Run], str] = lambda run: "",
) -> Metric[Run]:
    """Metric of a count that must be zero; otherwise the run is a failure."""
    return Metric(name, of, at_most=0, claim=claim, essential=True, detail=detail)


# Statistics make metrics over trials: `Metric("place error, p95", p95("place_error_mm"))`.

type Statistic = Callable[[Sequence[Trial]], float | int | None]
"""Number computed from many trials; None if no trial measured its value."""


def success_rate(trials: Sequence[Trial]) -> float:
    """Fraction of the trials that did not fail."""
    return sum(not trial.failure for trial in trials) / len(trials)


def median(key: str, kind: str = "median") -> Statistic:
    """Median over the trials that measured the value."""
    return lambda trials: Summary.of(trials).spread.get(key, {}).get(kind)


def p95(key: str) -> Statistic:
    """95th percentile over the trials that measured the value."""
    return median(key, "p95")
