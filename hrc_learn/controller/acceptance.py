"""What the controller is to reach: bounds on the figures of experiments."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Criterion:
    """A bound on one figure."""

    number: str
    """Of the acceptance figure."""
    experiment: str
    figure: str
    """Name in the summary of the experiment, or one of `compared`."""
    least: float = -math.inf
    most: float = math.inf

    @property
    def key(self) -> str:
        """Name of the figure among those of all experiments."""
        return f"{self.experiment}_{self.figure}"

    def met(self, value: float) -> bool:
        """Whether a measured value lies within the bound."""
        return self.least <= value <= self.most

    @property
    def bound(self) -> str:
        """In words."""
        return f">= {self.least:g}" if self.most == math.inf else f"<= {self.most:g}"


def _criteria(number: str, experiment: str, **bounds: tuple[float, float]) -> list[Criterion]:
    """One criterion for each figure of an experiment: its name, and its lowest and highest."""
    return [
        Criterion(number=number, experiment=experiment, figure=figure, least=low, most=high)
        for figure, (low, high) in bounds.items()
    ]


def _least(value: float) -> tuple[float, float]:
    return value, math.inf


def _most(value: float) -> tuple[float, float]:
    return -math.inf, value


_SAFE = {"violations": _most(0.0)}
_ROBUST = {"success": _least(0.98)} | _SAFE
_NEVER = {
    "beyond_position": _most(0.0),
    "beyond_velocity": _most(0.0),
    "beyond_acceleration": _most(0.0),
    "beyond_jerk": _most(0.0),
    "nan": _most(0.0),
}
_GUESSES = ("jacobian_0.3", "jacobian_3", "row_flipped", "rows_swapped")
_CAMERAS = ("noise", "latency", "slow_camera", "tilt")
_STRESSES = ("stress", "stress_nan", "stress_late", "stress_lost", "stress_1khz")

CRITERIA: tuple[Criterion, ...] = (
    *_criteria("1", "near", success=_least(0.99), t50=_most(5.5), t95=_most(8.0), **_SAFE),
    *_criteria("2", "global", free_success=_least(0.98), **_SAFE),
    *_criteria(
        "3",
        "near",
        speed_up_roll_0_30=_least(1.0),
        speed_up_roll_30_60=_least(1.0),
        speed_up_roll_60_90=_least(2.0),
    ),
    *(c for name in _GUESSES for c in _criteria("4", name, **_ROBUST)),
    *(c for name in _CAMERAS for c in _criteria("5", name, **_ROBUST)),
    *_criteria("5", "marker_lost", success=_least(0.97), **_SAFE),
    *_criteria(
        "7",
        "effort",
        elbow_mm=_least(100.0),
        deviation_mm=_most(0.2),
        turn_deg=_most(0.05),
        deviation_p95_mm=_most(1.5),
        turn_p95_deg=_most(0.5),
    ),
    *_criteria("7", "effort_noise", elbow_mm=_least(100.0), deviation_p95_mm=_most(2.5)),
    *(c for name in _STRESSES for c in _criteria("limits", name, **_NEVER)),
)
"""All bounds. Figures 6 and 8, placing and the whole pipeline, need the simulator."""


def compared(figures: Mapping[str, float]) -> dict[str, float]:
    """Figures made of those of two experiments: how much faster adaptation is than none."""
    gains: dict[str, float] = {}
    for key, with_ in figures.items():
        if key.startswith("near_vision_phase_roll"):
            without = figures.get(key.replace("near", "fixed", 1))
            if without is not None:
                gains[key.replace("vision_phase", "speed_up")] = without / with_
    return gains
