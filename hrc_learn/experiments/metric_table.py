"""What an experiment measures, as a table: name, unit, bound and what the paper claims."""

from collections.abc import Callable, Iterable
from dataclasses import KW_ONLY, dataclass

from hrc_learn.viz.report import Measurement


@dataclass(frozen=True)
class Metric[Run]:
    """One row of the table. `Run` is whatever the experiment leaves to be measured.

    Raises:
        ValueError: If it has both an upper and a lower bound.
    """

    name: str
    """In words; with the unit it makes the key of the measured value in JSON files."""
    of: Callable[[Run], float | int | None]
    """Measures a run. An integer is a count, summed up over trials. None leaves the row out."""
    unit: str = ""
    _: KW_ONLY
    at_most: float | int | None = None
    """Upper bound; without any bound the value is only reported."""
    at_least: float | int | None = None
    """Lower bound."""
    claim: str = ""
    """What the paper says about it."""
    essential: bool = False
    """Whether a run that misses the bound does not count as a success."""
    listed: bool = True
    """Whether the report's table has the row; the JSON file has it in any case."""
    detail: Callable[[Run], str] = lambda run: ""
    """What to add to the reason when an essential bound was missed."""

    def __post_init__(self) -> None:
        if self.at_most is not None and self.at_least is not None:
            raise ValueError(f"metric {self.name!r} is bounded on both sides: make it two.")

    def measure(self, run: Run) -> Measurement | None:
        """The measured value beside its bound; None where the run has none."""
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
        )

    def of_part[Whole](
        self, part: Callable[[Whole], Run], prefix: str = "", *, bounded: bool = True
    ) -> "Metric[Whole]":
        """The same metric of a part of a larger run.

        Args:
            part: Takes the part out of the whole.
            prefix: Of the name.
            bounded: Whether the bound goes along; else the value is reported for comparison.
        """
        return Metric(
            f"{prefix}{self.name}",
            lambda whole: self.of(part(whole)),
            self.unit,
            at_most=self.at_most if bounded else None,
            at_least=self.at_least if bounded else None,
            claim=self.claim,
            essential=self.essential and bounded,
            listed=self.listed,
            detail=lambda whole: self.detail(part(whole)),
        )


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """What a table of metrics came to."""

    table: tuple[Measurement, ...]
    """Listed rows, in order."""
    values: dict[str, float | int]
    """Every measured value by its key."""
    faults: tuple[str, ...]
    """Essential bounds that were missed, in words."""

    def __add__(self, other: "Evaluation") -> "Evaluation":
        """Both tables, one after the other."""
        return Evaluation(
            table=self.table + other.table,
            values=self.values | other.values,
            faults=self.faults + other.faults,
        )


def evaluate[Run](metrics: Iterable[Metric[Run]], run: Run) -> Evaluation:
    """Measure a run by each of the metrics."""
    table, values, faults = [], {}, []
    for metric in metrics:
        measured = metric.measure(run)
        if measured is None:
            continue
        values[measured.key] = measured.value
        if metric.listed:
            table.append(measured)
        # NaN keeps no bound: what could not be measured is no success.
        if metric.essential and measured.ok is False:
            fault = f"{metric.name}: {measured.shown}, but {measured.bound} is wanted"
            detail = metric.detail(run)
            faults.append(f"{fault} ({detail})" if detail else fault)
    return Evaluation(table=tuple(table), values=values, faults=tuple(faults))
