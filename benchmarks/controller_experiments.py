"""Experiments with the controller in batches of closed loops, by name, and their bounds."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import torch
from disturbance_trials import (
    EffortConfig,
    StressConfig,
    run_effort_trials,
    run_stress_trials,
)
from grasp_trials import TrialConfig, TrialResult, run_trials
from hostile_trials import (
    PlantConfig,
    PoisonConfig,
    run_plant_trials,
    run_poison_trials,
)
from paper_law import PrintedEstimator
from torch import Tensor

from hrc_learn.experiments.metric_table import Metric
from hrc_learn.jacobian import (
    BroydenEstimator,
    CompositeEstimator,
    FixedEstimator,
    ImageJacobianEstimator,
    KalmanEstimator,
    PaperEstimator,
    RBFImageJacobian,
)
from hrc_learn.kinematics import ArmChoice

_PANDA = ArmChoice()


@dataclass(frozen=True, kw_only=True)
class BatchedTrials:
    """A kind of trials; `run` takes a configuration with a seed."""

    label: str
    config: Any
    run: Callable[[Any], Any]
    suite: str = "acceptance"
    whole: bool = False
    """True if the experiment runs as a whole, not in chunks of a chosen number of trials."""
    main: bool = False
    """True if its success rate must be accurate to a tenth of a percent."""


def join[Result](parts: Sequence[Result]) -> Result:
    """The trials of several results: tensors with one entry per trial."""
    first = parts[0]
    columns = {
        field.name: torch.cat([getattr(part, field.name) for part in parts])
        for field in fields(first)  # pyright: ignore[reportArgumentType]
    }
    return type(first)(**columns)


def _grasp(
    label: str,
    estimator: Callable[[RBFImageJacobian], ImageJacobianEstimator] = KalmanEstimator,
    *,
    suite: str = "acceptance",
    main: bool = False,
    mujoco: bool = False,
    **changes: Any,
) -> BatchedTrials:
    def run(config: TrialConfig) -> TrialResult:
        if mujoco:  # importing it takes a second
            from mujoco_trials import run_mujoco_trials

            return run_mujoco_trials(estimator, config)
        return run_trials(estimator, config)

    settings: dict[str, Any] = {"duration": 8.0} | changes
    config = TrialConfig(**settings)
    return BatchedTrials(label=label, config=config, run=run, suite=suite, main=main)


def _printed(
    label: str,
    estimator: Callable[[RBFImageJacobian], ImageJacobianEstimator],
    **changes: Any,
) -> BatchedTrials:
    """Configuration of the paper's regions and gains, without a planned approach, with the
    safety filter.
    """
    settings = {"suite": "paper", "law": "printed", "duration": 12.0} | changes
    return _grasp(label, estimator, **settings)


def _in_mujoco(
    experiment: Callable[..., BatchedTrials], *args: Any, **changes: Any
) -> BatchedTrials:
    """The same experiment in the simulator, whose images have their own noise."""
    images = replace(TrialConfig().imperfections, noise=0.0)
    settings: dict[str, Any] = {"imperfections": images, "contacts": True} | changes
    return experiment(*args, suite="mujoco", mujoco=True, **settings)


def _rows_right(network: RBFImageJacobian) -> PrintedEstimator:
    return PrintedEstimator(network, mixed=False)


def _with_gain(gain: float) -> Callable[[RBFImageJacobian], ImageJacobianEstimator]:
    return lambda network: PaperEstimator(network, gain)


def _imperfect(**changes: Any) -> dict[str, Any]:
    return {"imperfections": replace(TrialConfig().imperfections, **changes)}


def _effort(label: str, **changes: Any) -> BatchedTrials:
    config = EffortConfig(**changes)
    return BatchedTrials(label=label, config=config, run=run_effort_trials, whole=True)


def _stress(label: str, **changes: Any) -> BatchedTrials:
    config = StressConfig(**changes)
    return BatchedTrials(
        label=label, config=config, run=run_stress_trials, suite="stress", main=True
    )


def _plant(label: str, **changes: Any) -> BatchedTrials:
    config = PlantConfig(**changes)
    return BatchedTrials(
        label=label, config=config, run=run_plant_trials, suite="stress", main=True
    )


def flip_row(J: Tensor) -> Tensor:
    """The Jacobian with the opposite sign of the first image row."""
    return J * J.new_tensor([[-1.0], [1.0]])


_FIRM_BOX = {"stiffness": (4e-3, 4e-3, 4e-3)}
"""Box stiffness k_c of our own regions: ten times Table I's in x and y, a hundred times in z.
"""


EXPERIMENTS: Mapping[str, BatchedTrials] = {
    "near": _grasp("starts near the ready posture", main=True, contacts=True),
    "global": _grasp(
        "starts anywhere within the limits",
        main=True,
        starts="global",
        contacts=True,
        duration=12.0,
    ),
    "fixed": _grasp("no adaptation", FixedEstimator, main=True),
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
    "effort": _effort("a person pushes the elbow away for 7 s and back for 4 s, at 1 kHz"),
    "effort_noise": _effort("the same with 0.5 px of noise", noise=0.5),
    "faulty_images": _grasp(
        "1 % of measurements NaN", suite="estimators", **_imperfect(nan_fraction=0.01)
    ),
    "encoder_noise": _grasp(
        "encoder noise of 1e-4 rad",
        suite="estimators",
        duration=30.0,
        **_imperfect(encoder_noise=1e-4),
    ),
    "composite": _grasp("composite adaptation", CompositeEstimator, suite="estimators"),
    "broyden": _grasp("Broyden's update", BroydenEstimator, suite="estimators"),
    "corners": _grasp(
        "the four corners of the marker instead of its centre",
        suite="estimators",
        feature="corners",
    ),
    "paper": _grasp("the paper's adaptation in our loop", PaperEstimator, suite="paper"),
    "literal": _printed("the paper's law, all as printed", PrintedEstimator, main=True),
    "unmixed": _printed("literal, the image rows of J_s0 not mixed", _rows_right, main=True),
    "printed": _printed("unmixed, neurons normalised", PaperEstimator, main=True),
    "printed_fixed": _printed("printed, L = 0", FixedEstimator),
    "printed_kalman": _printed("printed, our estimator", KalmanEstimator),
    "printed_z": _printed(
        "printed, k_c = 4e-4 in z too", PaperEstimator, stiffness=(4e-4, 4e-4, 4e-4)
    ),
    "literal_box": _printed("literal, k_c = 4e-3", PrintedEstimator, **_FIRM_BOX),
    "unmixed_box": _printed("unmixed, k_c = 4e-3", _rows_right, **_FIRM_BOX),
    "printed_box": _printed("printed, k_c = 4e-3", PaperEstimator, main=True, **_FIRM_BOX),
    "box_fixed": _printed("printed_box, L = 0", FixedEstimator, **_FIRM_BOX),
    "box_gain_1e7": _printed("printed_box, L = 1e7 I", _with_gain(1e7), **_FIRM_BOX),
    "box_gain_1e8": _printed("printed_box, L = 1e8 I", _with_gain(1e8), **_FIRM_BOX),
    "box_kalman": _printed("printed_box, our estimator", KalmanEstimator, **_FIRM_BOX),
    "box_global": _printed(
        "printed_box, starts anywhere within the limits",
        PaperEstimator,
        starts="global",
        **_FIRM_BOX,
    ),
    "mujoco_near": _in_mujoco(_grasp, "near, in MuJoCo"),
    "mujoco_literal": _in_mujoco(_printed, "literal, in MuJoCo", PrintedEstimator),
    "mujoco_printed": _in_mujoco(_printed, "printed, in MuJoCo", PaperEstimator),
    "mujoco_kalman": _in_mujoco(_printed, "printed_kalman, in MuJoCo", KalmanEstimator),
    "stress": _stress("random goals, cameras and efforts"),
    "stress_nan": _stress("the same with 1 % of measurements NaN", fault="nan"),
    "stress_late": _stress("the same, images and joint states late by 0.1 s", fault="late"),
    "stress_lost": _stress("the same with the marker lost at random", fault="lost"),
    "stress_1khz": _stress("the same at 1 kHz, where jerk is limited", dt=0.001, duration=1.5),
    "stress_poison": BatchedTrials(
        label="NaN and infinity in any input, 400 ticks a trial, and whether arms move again",
        config=PoisonConfig(),
        run=run_poison_trials,
        suite="stress",
        main=True,
    ),
    "stress_plant": _plant(
        "hostile commands to plants as slow, late and irregular as declared"
    ),
    "stress_plant_worse": _plant("the same half as much again as was declared", worse=1.5),
}
"""All experiments by name."""


def run_chunk(name: str, count: int, seed: int, robot: ArmChoice = _PANDA) -> Any:
    """Run some trials of an experiment; an experiment that runs as a whole has its own number.

    Args:
        name: Name of the experiment.
        count: Number of trials.
        seed: Seed of all random numbers.
        robot: Arm, for experiments with other arms (`takes_another_arm`).
    """
    experiment = EXPERIMENTS[name]
    changes: dict[str, Any] = {"seed": seed}
    if not experiment.whole:
        changes["count"] = count
    if robot != _PANDA:
        # For the Panda, the paper's pull applies; with it, some other arms stop on their way.
        changes |= {"robot": robot, "pull": "saturated"}
    return experiment.run(replace(experiment.config, **changes))


def takes_another_arm(name: str) -> bool:
    """True if an experiment uses kinematics alone, and so applies to any arm."""
    experiment = EXPERIMENTS[name]
    return isinstance(experiment.config, TrialConfig) and experiment.suite != "mujoco"


def chunks(name: str, count: int, seed: int, size: int) -> list[tuple[str, int, int]]:
    """Arguments of `run_chunk` that together make up `count` trials.

    Each chunk has its own seed, so the results do not depend on the process that runs a chunk.
    """
    if EXPERIMENTS[name].whole:
        return [(name, count, seed)]
    starts = range(0, count, size)
    # A prime larger than any number of chunks keeps the chunks of all seeds apart.
    return [
        (name, min(size, count - start), 1_000_003 * seed + k) for k, start in enumerate(starts)
    ]


type Figures = Mapping[str, float]
"""Figures of all experiments, each behind the name of its experiment."""


@dataclass(frozen=True, kw_only=True)
class Criterion:
    """A bound on one value of an experiment, or of `compared`."""

    number: str
    """Number of the acceptance criterion."""
    experiment: str
    metric: Metric[Figures]


def _criteria(
    number: str,
    experiment: str,
    *,
    at_least: Mapping[str, float] | None = None,
    at_most: Mapping[str, float] | None = None,
) -> list[Criterion]:
    """One criterion for each value of an experiment, given by name and bound."""
    lower, upper = at_least or {}, at_most or {}

    def criterion(figure: str) -> Criterion:
        def value(figures: Figures) -> float | None:
            # None if the experiment was not run: the row is left out.
            return figures.get(f"{experiment}_{figure}")

        name = figure.replace("_", " ")
        metric = Metric(name, value, at_least=lower.get(figure), at_most=upper.get(figure))
        return Criterion(number=number, experiment=experiment, metric=metric)

    return [criterion(figure) for figure in (*lower, *upper)]


_SAFE = {"violations": 0.0}
_NO_VIOLATION: dict[str, float] = dict.fromkeys(
    ("beyond_position", "beyond_velocity", "beyond_acceleration", "beyond_jerk", "nan"), 0.0
)
_MOVES_AGAIN = {"stuck": 0.0}
_IRREGULAR = {"beyond_position": 0.0, "beyond_velocity": 0.0, "nan": 0.0} | _MOVES_AGAIN
_GUESSES = ("jacobian_0.3", "jacobian_3", "row_flipped", "rows_swapped")
_CAMERAS = ("noise", "latency", "slow_camera", "tilt")
_STRESSES = ("stress", "stress_nan", "stress_late", "stress_lost", "stress_1khz")


def _robust(number: str, names: Sequence[str], success: float = 0.98) -> list[Criterion]:
    """Bounds on success rates under a disturbance, and on limit violations."""
    bounds = {"success": success}
    return [
        c for name in names for c in _criteria(number, name, at_least=bounds, at_most=_SAFE)
    ]


CRITERIA: tuple[Criterion, ...] = (
    *_criteria(
        "1", "near", at_least={"success": 0.99}, at_most={"t50": 5.5, "t95": 8.0, **_SAFE}
    ),
    *_criteria("2", "global", at_least={"free_success": 0.98}, at_most=_SAFE),
    *_criteria(
        "3",
        "near",
        at_least={
            "speed_up_roll_0_30": 1.0,
            "speed_up_roll_30_60": 1.0,
            "speed_up_roll_60_90": 2.0,
        },
    ),
    *_robust("4", _GUESSES),
    *_robust("5", _CAMERAS),
    *_robust("5", ("marker_lost",), success=0.97),
    *_criteria(
        "7",
        "effort",
        at_least={"elbow_mm": 100.0},
        at_most={
            "deviation_mm": 0.2,
            "turn_deg": 0.05,
            "deviation_p95_mm": 1.5,
            "turn_p95_deg": 0.5,
        },
    ),
    *_criteria(
        "7", "effort_noise", at_least={"elbow_mm": 100.0}, at_most={"deviation_p95_mm": 2.5}
    ),
    *(
        criterion
        for name in _STRESSES
        for criterion in _criteria("limits", name, at_most=_NO_VIOLATION)
    ),
    *_criteria("limits", "stress_poison", at_most=_NO_VIOLATION | _MOVES_AGAIN),
    *_criteria("limits", "stress_plant", at_most=_IRREGULAR | {"beyond_acceleration": 0.0}),
    *_criteria("limits", "stress_plant_worse", at_most=_IRREGULAR),
)
"""All bounds. Criteria 6 and 8 (placing, the whole pipeline) need the simulator."""


def compared(figures: Mapping[str, float]) -> dict[str, float]:
    """Ratio of times without and with adaptation, from the values of two experiments."""
    gains: dict[str, float] = {}
    for key, with_ in figures.items():
        if key.startswith("near_vision_phase_roll"):
            without = figures.get(key.replace("near", "fixed", 1))
            if without is not None:
                gains[key.replace("vision_phase", "speed_up")] = without / with_
    return gains
