"""What many trials come to: how often they succeed, and what they measure."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from .trial_file import Trial

if TYPE_CHECKING:
    from rich.table import Table

_Z = 1.959964  # of a two-sided interval of 95 %


def wilson_interval(successes: int, trials: int) -> tuple[float, float]:
    """Interval of 95 % of a share (Wilson 1927); honest for few trials and shares near 0 or 1.

    Args:
        successes: Of the trials.
        trials: At least one.

    Raises:
        ValueError: If there are no trials, or more successes than trials.
    """
    if not 0 <= successes <= trials or trials == 0:
        raise ValueError(f"{successes} successes of {trials} trials make no share.")
    share, z2 = successes / trials, _Z**2 / trials
    middle = share + z2 / 2
    half = _Z * math.sqrt(share * (1 - share) / trials + z2 / (4 * trials))
    return max(0.0, (middle - half) / (1 + z2)), min(1.0, (middle + half) / (1 + z2))


@dataclass(frozen=True, kw_only=True)
class Spread:
    """Of one measured value over the trials that know it."""

    median: float
    p95: float
    """95 % of the trials are below."""
    smallest: float
    largest: float


@dataclass(frozen=True, kw_only=True)
class Summary:
    """Of a repetition."""

    trials: int
    failed: Mapping[int, str]
    """Reason by seed."""
    spread: Mapping[str, Spread]
    """By name of the value; over failed trials too, as far as they measured it."""

    @classmethod
    def of(cls, trials: Sequence[Trial]) -> "Summary":
        """Count and sort.

        Raises:
            ValueError: Without trials.
        """
        if not trials:
            raise ValueError("there are no trials to sum up.")
        names = dict.fromkeys(name for trial in trials for name in trial.values)
        known = {name: _numbers(trials, name) for name in names}
        return cls(
            trials=len(trials),
            failed={trial.seed: trial.failure for trial in trials if trial.failure},
            spread={name: _spread(values) for name, values in known.items() if len(values)},
        )

    @property
    def successes(self) -> int:
        """Number of trials that did not fail."""
        return self.trials - len(self.failed)

    @property
    def interval(self) -> tuple[float, float]:
        """Of the share of successes, 95 %."""
        return wilson_interval(self.successes, self.trials)

    def figures(self) -> dict[str, float | int]:
        """All of it as one flat object of numbers; seeds and reasons left out."""
        low, high = self.interval
        values: dict[str, float | int] = {
            "trials": self.trials,
            "successes": self.successes,
            "success_rate": self.successes / self.trials,
            "success_rate_low": low,
            "success_rate_high": high,
        }
        for name, spread in self.spread.items():
            values |= {f"{name}_{kind}": value for kind, value in vars(spread).items()}
        return values

    def table(self, title: str) -> "Table":
        """To be printed; the heading tells how many succeeded, the foot why others did not."""
        from rich.table import Table
        from rich.text import Text

        low, high = self.interval
        heading = (
            f"{title}: {self.successes} of {self.trials} succeeded "
            f"({100 * low:.1f} to {100 * high:.1f} % with 95 % confidence)"
        )
        # As text: brackets in a reason are no markup.
        reasons = Text(
            "\n".join(f"seed {seed}: {reason}" for seed, reason in self.failed.items())
        )
        table = Table("measured", title=heading, caption=reasons, caption_justify="left")
        for column in ("median", "p95", "smallest", "largest"):
            table.add_column(column, justify="right")
        for name, spread in self.spread.items():
            numbers = (spread.median, spread.p95, spread.smallest, spread.largest)
            table.add_row(name.replace("_", " "), *(f"{number:.4g}" for number in numbers))
        return table


def _numbers(trials: Sequence[Trial], name: str) -> np.ndarray:
    values = [v for t in trials if not isinstance(v := t.values.get(name, math.nan), str)]
    numbers = np.array(values, dtype=float)
    return numbers[np.isfinite(numbers)]


def _spread(values: np.ndarray) -> Spread:
    median, p95 = (float(np.quantile(values, share, method="higher")) for share in (0.5, 0.95))
    return Spread(
        median=median, p95=p95, smallest=float(values.min()), largest=float(values.max())
    )
