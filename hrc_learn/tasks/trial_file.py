"""Trials on disk: one line of JSON each, written as soon as it is known.

The first line tells what was tried, so that results of different things never mix.
"""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

_SEED, _FAILURE, _MADE_BY = "seed", "failure", "made_by"


@dataclass(frozen=True, kw_only=True)
class Trial:
    """What one seed came to."""

    seed: int
    values: Mapping[str, float | int | str]
    """Measured, by name; of a failed trial what was measured all the same."""
    failure: str = ""
    """Why it failed; empty if it did not."""

    @classmethod
    def of(cls, seed: int, measured: Mapping[str, Any]) -> "Trial":
        """From what a run returned: measured values, and "failure" with a reason if it failed.

        Raises:
            ValueError: If a value is neither a number nor text, or one is named "seed".
        """
        if _SEED in measured:
            raise ValueError("a trial measures no 'seed': that names the trial itself.")
        values = {name: _plain(name, value) for name, value in measured.items()}
        return cls(seed=seed, failure=str(values.pop(_FAILURE, "")), values=values)

    def line(self) -> str:
        """As one line of JSON, which has no NaN or infinity: they become null."""
        row = {_SEED: self.seed, _FAILURE: self.failure, **self.values}
        finite = {
            name: None if isinstance(value, float) and not math.isfinite(value) else value
            for name, value in row.items()
        }
        return json.dumps(finite) + "\n"

    @classmethod
    def from_line(cls, line: str) -> "Trial":
        """The trial of a line; null becomes NaN."""
        row = json.loads(line)
        seed, failure = row.pop(_SEED), row.pop(_FAILURE)
        values = {name: math.nan if value is None else value for name, value in row.items()}
        return cls(seed=seed, failure=failure, values=values)


class TrialFile:
    """Trials of one thing, in a file that grows.

    Attributes:
        trials: Those in the file, by seed.
    """

    def __init__(self, path: Path, made_by: Mapping[str, Any]):
        """Open a file to go on with, or begin one.

        Args:
            path: JSON-lines file.
            made_by: What is tried; whatever is no JSON is kept as text.

        Raises:
            ValueError: If the file holds trials of something else, or no trials.
        """
        self._path = path
        self.trials: dict[int, Trial] = {}
        made_by = json.loads(json.dumps(made_by, default=str))
        if path.exists():
            self._resume(made_by)
        else:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(json.dumps({_MADE_BY: made_by}) + "\n")

    def append(self, trial: Trial) -> None:
        """Add a trial; it is on disk when this returns."""
        with self._path.open("a") as file:
            file.write(trial.line())
        self.trials[trial.seed] = trial

    def _resume(self, made_by: Mapping[str, Any]) -> None:
        text = self._path.read_text()
        whole = text[: text.rfind("\n") + 1]
        lines = whole.splitlines()
        try:
            before = json.loads(lines[0])[_MADE_BY]
            found = [Trial.from_line(line) for line in lines[1:]]
        except (IndexError, KeyError, TypeError, ValueError) as error:
            raise ValueError(
                f"{self._path} holds no trials: choose another file, or remove it."
            ) from error
        if before != made_by:
            raise ValueError(
                f"{self._path} holds trials of something else ({_difference(before, made_by)}):"
                " remove it to begin anew, or choose another place."
            )
        if whole != text:  # stopped in the middle of a line
            self._path.write_text(whole)
        self.trials = {trial.seed: trial for trial in found}


def _difference(before: Mapping[str, Any], now: Mapping[str, Any]) -> str:
    for name in [*before, *now]:
        if before.get(name) != now.get(name):
            return f"{name} was {before.get(name)!r} there and is {now.get(name)!r} now"
    raise AssertionError("nothing differs")


def _plain(name: str, value: Any) -> float | int | str:
    # numpy's and torch's scalars come as their plain counterparts.
    plain = value.item() if hasattr(value, "item") else value
    if not isinstance(plain, (bool, int, float, str)):
        raise ValueError(f"{name} must be a number or text, but is a {type(value).__name__}.")
    return plain
