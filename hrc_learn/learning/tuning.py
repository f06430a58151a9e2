"""Tuning of positive parameters such as gains without gradients, and their file."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import torch

from hrc_learn.controller import ControllerConfig


@dataclass(frozen=True, kw_only=True)
class TuningState:
    """State of a tuning run. Plain numbers: as JSON it can be resumed elsewhere.

    An evolution strategy with a step size for each parameter (sep-CMA-ES without its evolution
    paths; Ros and Hansen 2008, "A simple modification in CMA-ES achieving linear time and space
    complexity"), on logarithms, so that factors count.
    """

    names: tuple[str, ...]
    middle: tuple[float, ...]
    """Best guess of each number."""
    spread: tuple[float, ...]
    """Standard deviation of the logarithm of each."""
    seed: int = 0
    generation: int = 0
    best: tuple[float, ...] = ()
    """The best that was tried; none before the first generation."""
    best_cost: float = math.inf

    @classmethod
    def around(
        cls, start: Mapping[str, float], spread: float = 0.4, seed: int = 0
    ) -> TuningState:
        """Begin.

        Args:
            start: Positive numbers by name.
            spread: Standard deviation of their logarithms.
            seed: Of what is drawn.

        Raises:
            ValueError: A number that is not positive and finite.
        """
        wrong = [name for name, value in start.items() if not 0 < value < math.inf]
        if wrong:
            raise ValueError(
                f"{wrong[0]} must be positive to be searched, got {start[wrong[0]]}"
            )
        return cls(
            names=tuple(start),
            middle=tuple(start.values()),
            spread=(spread,) * len(start),
            seed=seed,
        )

    def ask(self, count: int) -> list[dict[str, float]]:
        """Numbers to try next: the middle, then draws about it in mirrored pairs."""
        # A prime keeps the streams of two seeds apart for the first million generations.
        rng = torch.Generator().manual_seed(1_000_003 * self.seed + self.generation)
        half = torch.randn(count // 2, len(self.names), generator=rng, dtype=torch.float64)
        z = torch.cat([torch.zeros(1, len(self.names)), half, -half])[:count]
        steps = z * torch.tensor(self.spread, dtype=torch.float64)
        values = torch.tensor(self.middle, dtype=torch.float64) * steps.exp()
        return [dict(zip(self.names, row, strict=True)) for row in values.tolist()]

    def tell(self, tried: Sequence[Mapping[str, float]], costs: Sequence[float]) -> TuningState:
        """Learn from what was tried: towards the better half, as wide as it is.

        Args:
            tried: From `ask`.
            costs: The lower the better; NaN counts as the worst.
        """
        costs = [math.inf if math.isnan(cost) else cost for cost in costs]
        order = sorted(range(len(costs)), key=costs.__getitem__)
        elite = [tried[i] for i in order[: max(len(order) // 2, 1)]]
        # Weights of rank k fall as log(mu + 1/2) - log k (Hansen 2016, eq. 49).
        share = [math.log(len(elite) + 0.5) - math.log(k + 1) for k in range(len(elite))]
        weights = torch.tensor(share, dtype=torch.float64) / sum(share)
        rows = torch.tensor([[one[name] for name in self.names] for one in elite])
        rows = rows.double().log()
        before = torch.tensor(self.middle, dtype=torch.float64).log()
        middle = weights @ rows
        moved = weights @ (rows - before).square()
        old = torch.tensor(self.spread, dtype=torch.float64)
        # Half of the old variance is kept: a generation of ten tells the new one badly.
        spread = (0.5 * old.square() + 0.5 * moved).sqrt()
        found = costs[order[0]] < self.best_cost
        return replace(
            self,
            middle=tuple(middle.exp().tolist()),
            spread=tuple(spread.tolist()),
            generation=self.generation + 1,
            best=tuple(elite[0][name] for name in self.names) if found else self.best,
            best_cost=costs[order[0]] if found else self.best_cost,
        )

    def to_json(self) -> dict[str, Any]:
        """As JSON values."""
        return asdict(self) | {"best_cost": self.best_cost if self.best else None}

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> TuningState:
        """What `to_json` gave.

        Raises:
            ValueError: It gave something else.
        """
        try:
            fields: dict[str, Any] = {
                name: tuple(value) if isinstance(value, list) else value
                for name, value in values.items()
            }
            if fields["best_cost"] is None:
                fields["best_cost"] = math.inf
            return cls(**fields)
        except (KeyError, TypeError, AttributeError) as error:
            raise ValueError(f"not the state of a search: {error}") from None


TUNED = ("vision_rate", "linear_speed", "angular_speed")
"""Fields of `ControllerConfig` that tuning searches."""


def with_gains(config: ControllerConfig, path: Path | None) -> ControllerConfig:
    """The settings with the gains of a file in their place.

    Args:
        config: The settings.
        path: Of hrc tune; None: as they are.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It holds something else; names the field.
    """
    if path is None:
        return config
    try:
        gains = json.loads(path.read_text(encoding="utf-8"))
    except json.JSONDecodeError as error:
        raise ValueError(f"{path}: not valid JSON ({error})") from None
    known = {field.name for field in fields(ControllerConfig)}
    wrong = [
        name
        for name, value in (gains.items() if isinstance(gains, dict) else [("it", None)])
        if name not in known or isinstance(value, bool) or not isinstance(value, int | float)
    ]
    if wrong:
        raise ValueError(f"{path}: {wrong[0]} is no gain; there are {', '.join(TUNED)}")
    return replace(config, **gains)
