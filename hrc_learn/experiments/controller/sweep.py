"""Experiments on the controller by name, each in batches of its own seed, and what they
are to reach.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

from torch import Tensor

from hrc_learn.experiments.controller.effort_trials import (
    EffortConfig,
    EffortResult,
    run_effort_trials,
)
from hrc_learn.experiments.controller.grasp_trials import TrialConfig, TrialResult, run_trials
from hrc_learn.experiments.controller.stress_trials import (
    StressConfig,
    StressResult,
    run_stress_trials,
)
from hrc_learn.jacobian import (
    BroydenEstimator,
    CompositeEstimator,
    FixedEstimator,
    ImageJacobianEstimator,
    KalmanEstimator,
    PaperEstimator,
    RBFImageJacobian,
    RecursiveLeastSquaresEstimator,
)

# Experiments by name: grasps, a person's pull, and stress, each in batches of its own seed.


@dataclass(frozen=True, kw_only=True)
class Experiment:
    """One kind of trials; `run` takes a configuration, `join` the results of several runs."""

    says: str
    config: Any
    run: Callable[[Any], Any]
    join: Callable[[Any], Any]
    suite: str = "acceptance"
    whole: bool = False
    """Whether it is run as it is, not with a chosen number of trials in chunks."""
    main: bool = False
    """Whether its share of successes has to be known to a tenth of a percent."""


def _grasp(
    says: str,
    estimator: Callable[[RBFImageJacobian], ImageJacobianEstimator] = KalmanEstimator,
    *,
    suite: str = "acceptance",
    main: bool = False,
    **changes: Any,
) -> Experiment:
    def run(config: TrialConfig) -> TrialResult:
        return run_trials(estimator, config)

    settings: dict[str, Any] = {"duration": 8.0} | changes
    config = TrialConfig(**settings)
    return Experiment(
        says=says, config=config, run=run, join=TrialResult.join, suite=suite, main=main
    )


def _imperfect(**changes: Any) -> dict[str, Any]:
    return {"imperfections": replace(TrialConfig().imperfections, **changes)}


def _effort(says: str, **changes: Any) -> Experiment:
    return Experiment(
        says=says,
        config=EffortConfig(**changes),
        run=run_effort_trials,
        join=EffortResult.join,
        whole=True,
    )


def _stress(says: str, **changes: Any) -> Experiment:
    return Experiment(
        says=says,
        config=StressConfig(**changes),
        run=run_stress_trials,
        join=StressResult.join,
        suite="stress",
        main=True,
    )


def flip_row(J: Tensor) -> Tensor:
    """The sign of the first image row turned round."""
    return J * J.new_tensor([[-1.0], [1.0]])


EXPERIMENTS: Mapping[str, Experiment] = {
    "near": _grasp("starts near the ready posture", main=True, contacts=True),
    "global": _grasp(
        "starts anywhere within the limits",
        main=True,
        starts="global",
        contacts=True,
        duration=12.0,
    ),
    "fixed": _grasp("no adaptation", FixedEstimator, main=True),
    "paper": _grasp("the paper's adaptation in our loop", PaperEstimator),
    "printed": _grasp(
        "the paper's law and Table I as printed, behind the safety filter",
        PaperEstimator,
        law="printed",
        duration=12.0,
    ),
    "jacobian_0.3": _grasp("initial Jacobian times 0.3", initial_jacobian=lambda J: 0.3 * J),
    "jacobian_3": _grasp("initial Jacobian times 3", initial_jacobian=lambda J: 3 * J),
    "row_flipped": _grasp(
        "a row of the initial Jacobian with the wrong sign", initial_jacobian=flip_row
    ),
    "rows_swapped": _grasp(
        "rows of the initial Jacobian swapped", initial_jacobian=lambda J: J.flip(0)
    ),
    "noise": _grasp("noise of 2 px", **_imperfect(noise=2.0)),
    "latency": _grasp("images late by 3 frames", **_imperfect(latency_frames=3)),
    "slow_camera": _grasp("images at 15 Hz", **_imperfect(frame_steps=8)),
    "tilt": _grasp("camera tilted by 45 to 75 degrees", tilt=(0.785, 1.309)),
    "marker_lost": _grasp(
        "marker covered for up to 3 s, every 3 s on average",
        duration=20.0,
        **_imperfect(loss_rate=1 / 3, loss_time=3.0),
    ),
    "effort": _effort("a person pulls the elbow away for 7 s and back for 4 s, at 1 kHz"),
    "effort_noise": _effort("the same with 0.5 px of noise", noise=0.5),
    "faulty_images": _grasp(
        "1 % of measurements NaN", suite="estimators", **_imperfect(nan_fraction=0.01)
    ),
    "composite": _grasp("composite adaptation", CompositeEstimator, suite="estimators"),
    "least_squares": _grasp(
        "recursive least squares", RecursiveLeastSquaresEstimator, suite="estimators"
    ),
    "broyden": _grasp("Broyden's update", BroydenEstimator, suite="estimators"),
    "corners": _grasp(
        "the four corners of the marker instead of its centre",
        suite="estimators",
        feature="corners",
    ),
    "stress": _stress("random goals, cameras and efforts"),
    "stress_nan": _stress("the same with 1 % of measurements NaN", fault="nan"),
    "stress_late": _stress("the same, images and joint states late by 0.1 s", fault="late"),
    "stress_lost": _stress("the same with the marker lost at random", fault="lost"),
    "stress_1khz": _stress("the same at 1 kHz, where jerk is limited", dt=0.001, duration=1.5),
}
"""What can be run."""


def run_chunk(name: str, count: int, seed: int) -> Any:
    """Run some trials of an experiment; a whole one has its own number of them."""
    experiment = EXPERIMENTS[name]
    changes = {"seed": seed} if experiment.whole else {"seed": seed, "count": count}
    return experiment.run(replace(experiment.config, **changes))


def chunks(name: str, count: int, seed: int, size: int) -> list[tuple[str, int, int]]:
    """Arguments of `run_chunk` that together make up `count` trials.

    Each chunk has a seed of its own, so the figures do not depend on who runs which chunk.
    """
    if EXPERIMENTS[name].whole:
        return [(name, count, seed)]
    starts = range(0, count, size)
    return [
        (name, min(size, count - start), 1_000_003 * seed + k) for k, start in enumerate(starts)
    ]


# What the controller is to reach: bounds on the figures of experiments.


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
