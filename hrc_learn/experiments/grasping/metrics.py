"""What the experiment on grasping has to reach, measured, beside what the paper claims."""

import math
from collections.abc import Iterable, Sequence

import numpy as np

from hrc_learn.experiments.grasping.experiment import VARIANTS, GraspingExperiment
from hrc_learn.experiments.monte_carlo import Summary, Trial
from hrc_learn.viz.report import Measurement

SUCCESS = 0.98
"""Share of many grasps that has to succeed."""
PLACE = 15.0
"""Distance of the hand from above the object at which the open fingers still take it [mm]; they
leave 18 mm on either side."""


def evaluate_grasping(experiment: GraspingExperiment) -> list[Measurement]:
    """Measured values of the grasp, and of what it is compared with, which has no targets."""
    return [*_default(experiment), *_others(experiment)]


def _default(experiment: GraspingExperiment) -> Iterable[Measurement]:
    outcome = experiment.outcome
    before, after = experiment.jacobian_error()
    yield Measurement(
        name="object held between the fingers, lifted and carried home",
        value=float(outcome.held and not outcome.failure),
        target=1,
        at_least=True,
        claim="the robot grasped the object (Experiment 2)",
    )
    yield Measurement(name="attempts", value=outcome.attempts)
    yield Measurement(
        name="time to aim, from the remote start",
        value=outcome.aim_time,
        unit="s",
        target=20.0,
        claim="9.2 s (Experiment 2)",
    )
    yield Measurement(
        name="time of the whole grasp",
        value=outcome.duration,
        unit="s",
        claim="15 s (Experiment 2)",
    )
    yield Measurement(
        name="pixel error when the hand goes down",
        value=outcome.pixel_error,
        unit="px",
        target=5.0,
        claim="the desired position is reached (Experiment 2)",
    )
    yield Measurement(
        name="hand off the object when it goes down",
        value=1e3 * outcome.place_error,
        unit="mm",
        target=PLACE,
    )
    yield Measurement(
        name="hand turned from the shown approach as it goes down",
        value=float(np.rad2deg(outcome.angle_error)),
        unit="deg",
        target=1.0,
    )
    yield Measurement(
        name="joint limit violations",
        value=outcome.violations,
        unit="steps",
        target=0,
        claim="the joint-space region prevents them",
    )
    yield Measurement(
        name="contacts with table, cabinet and the arm itself", value=outcome.touches, target=0
    )
    yield Measurement(
        name="image Jacobian off the true one as the camera takes over",
        value=100 * before,
        unit="%",
        claim="set at random",
    )
    yield Measurement(
        name="image Jacobian off the true one as the hand goes down",
        value=100 * after,
        unit="%",
        target=20.0,
        claim="estimated online",
    )


def _others(experiment: GraspingExperiment) -> Iterable[Measurement]:
    for variant in experiment.compared:
        time = experiment.arrival(variant)
        # A report has no infinity: that one never arrives is told by a share of none.
        yield Measurement(
            name=f"{VARIANTS[variant].says}, target reached",
            value=float(math.isfinite(time)),
            claim=VARIANTS[variant].claim,
        )
        if math.isfinite(time):
            yield Measurement(
                name=f"{VARIANTS[variant].says}, time in vision", value=time, unit="s"
            )


def evaluate_many(trials: Sequence[Trial]) -> list[Measurement]:
    """Of many grasps in settings of their own."""
    summary = Summary.of(trials)
    success = Measurement(
        name="grasps that succeed",
        value=summary.successes / summary.trials,
        target=SUCCESS,
        at_least=True,
    )
    return [success, *_spreads(summary)]


def _spreads(summary: Summary) -> Iterable[Measurement]:
    """Of what grasps that came as far as aiming measured."""
    for name, what, factor, unit in (
        ("aim_time", "time to aim", 1, "s"),
        ("pixel_error", "pixel error", 1, "px"),
        ("place_error", "hand off the object", 1e3, "mm"),
    ):
        if (spread := summary.spread.get(name)) is not None:
            for kind, value in (("median", spread.median), ("95 %", spread.p95)):
                yield Measurement(
                    name=f"grasps, {what} ({kind})", value=factor * value, unit=unit
                )
