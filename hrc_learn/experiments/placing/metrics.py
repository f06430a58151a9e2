"""What is measured of placings, by shelf and over all shelves, once and from random starts."""

from collections.abc import Mapping, Sequence

import numpy as np

from hrc_learn.experiments.metric_table import Metric
from hrc_learn.experiments.monte_carlo import Trial
from hrc_learn.experiments.placing import arm_angle_ablation
from hrc_learn.experiments.placing.trial import (
    SPACES,
    PlacingOutcome,
    PlacingRun,
    demonstrated_joints,
)
from hrc_learn.experiments.trial_statistics import column, largest, total

# Bounds of a good placing. Approach paths planned in task space deviate by 2 mm, those planned
# in joint space with a shifted goal by 100 mm.
DEVIATION_MM, PLACE_ERROR_MM, PLACE_TILT_DEG = 12.0, 2.0, 0.5
# Of 50 placings from random starts one may touch something.
_FREE_FRACTION = 0.98
# What of the demonstration's dimensionless jerk a reproduction may keep.
_JERK = 1e-2
_NO_COLLISION = "no collision with the cabinet"

type ByShelf = Mapping[str, PlacingOutcome]


def placing_metrics(shelves: Sequence[str]) -> list[Metric[ByShelf]]:
    """The table of one placing on each of the shelves."""
    return [
        *(metric for shelf in shelves for metric in _shelf_metrics(shelf)),
        Metric(
            "place error",
            lambda outcomes: 1e3 * max(o.place_error for o in outcomes.values()),
            "mm",
            at_most=PLACE_ERROR_MM,
            essential=True,
        ),
        Metric(
            "place tilt",
            lambda outcomes: _degrees(max(o.place_tilt for o in outcomes.values())),
            "deg",
            at_most=PLACE_TILT_DEG,
            essential=True,
        ),
        Metric(
            "joint limit violations",
            lambda outcomes: sum(o.violations for o in outcomes.values()),
            at_most=0,
            essential=True,
        ),
        Metric(
            "contacts",
            lambda outcomes: sum(len(o.contacts) for o in outcomes.values()),
            at_most=0,
            claim=_NO_COLLISION,
            essential=True,
            detail=lambda outcomes: "; ".join(
                f"{shelf} shelf: {o.contacts[0]}" for shelf, o in outcomes.items() if o.contacts
            ),
        ),
        Metric(
            "peak joint speed, fraction of its limit",
            lambda outcomes: max(o.peak_speed for o in outcomes.values()),
            at_most=1.0,
        ),
        Metric(
            "dimensionless jerk, fraction of the demonstration's",
            lambda outcomes: max(o.jerk for o in outcomes.values()),
            at_most=_JERK,
            claim="several unnecessary jerks removed",
        ),
        Metric(
            "objects that stand on their shelf",
            lambda outcomes: sum(o.placed for o in outcomes.values()),
            at_least=len(shelves),
            essential=True,
        ),
    ]


def _shelf_metrics(shelf: str) -> list[Metric[ByShelf]]:
    return [
        Metric(
            f"{shelf} shelf, approach-path deviation",
            lambda outcomes: 1e3 * outcomes[shelf].deviation,
            "mm",
            at_most=DEVIATION_MM,
            claim="similar paths towards the goals",
            essential=True,
        ),
        Metric(f"{shelf} shelf, contacts", lambda outcomes: len(outcomes[shelf].contacts)),
        Metric(
            f"{shelf} shelf, place error",
            lambda outcomes: 1e3 * outcomes[shelf].place_error,
            "mm",
            listed=False,
        ),
        Metric(
            f"{shelf} shelf, place tilt",
            lambda outcomes: _degrees(outcomes[shelf].place_tilt),
            "deg",
            listed=False,
        ),
        Metric(
            f"{shelf} shelf, placed", lambda outcomes: int(outcomes[shelf].placed), listed=False
        ),
    ]


def run_metrics(shelves: Sequence[str]) -> list[Metric[PlacingRun]]:
    """The table of an experiment: reproduction, task space, joint space, ablation."""
    table = placing_metrics(shelves)
    return [
        Metric(
            "demonstration, duration",
            lambda run: float(run.demonstration.duration),
            "s",
            claim="30 s",
        ),
        Metric(
            "reproduction, duration",
            lambda run: run.reproduction.plan.duration,
            "s",
            claim="20 s, tau = 1.5",
        ),
        Metric("reproduction, joint RMSE", joint_rmse, "deg", at_most=2.0),
        *(metric.of_part(lambda run: run.outcomes["pose"]) for metric in table),
        *(
            metric.of_part(
                lambda run: run.outcomes["joint"], f"{SPACES['joint']}, ", bounded=False
            )
            for metric in table
        ),
        *(metric.of_part(lambda run: run.ablation) for metric in arm_angle_ablation.METRICS),
        Metric(
            "shelves within reach with joint 7 as demonstrated",
            lambda run: len(run.same_joint7),
            claim="joint 7 is fixed for all three",
        ),
    ]


def joint_rmse(run: PlacingRun) -> float:
    """Of the reproduction, from the demonstration at the same fraction of the motion [deg]."""
    done = run.reproduction
    demonstrated = demonstrated_joints(run.demonstration, done.time / done.time[-1])
    return _degrees(float(np.sqrt(np.square(done.joint_position - demonstrated).mean())))


BLOCKED = "joint_space_plans_blocked"
"""Value of a trial from random starts: how many of the paper's plans are not free."""


def random_start_metrics(shelves: Sequence[str]) -> list[Metric[Sequence[Trial]]]:
    """Rows of the table that placings from random starts add."""

    def fraction(trials: Sequence[Trial], key: str, wanted: int) -> float:
        values = [column(trials, f"{shelf}_shelf_{key}") for shelf in shelves]
        return float((np.array(values) == wanted).mean())

    deviations = [f"{shelf}_shelf_approach_path_deviation_mm" for shelf in shelves]
    return [
        Metric("random starts, placings", lambda trials: len(trials) * len(shelves)),
        Metric(
            "random starts, fraction without contact",
            lambda trials: fraction(trials, "contacts", 0),
            at_least=_FREE_FRACTION,
        ),
        Metric(
            "random starts, fraction that stands on its shelf",
            lambda trials: fraction(trials, "placed", 1),
            at_least=_FREE_FRACTION,
        ),
        Metric(
            "random starts, joint limit violations", total("joint_limit_violations"), at_most=0
        ),
        Metric(
            "random starts, largest place error",
            largest("place_error_mm"),
            "mm",
            at_most=PLACE_ERROR_MM,
        ),
        Metric(
            "random starts, largest place tilt",
            largest("place_tilt_deg"),
            "deg",
            at_most=PLACE_TILT_DEG,
        ),
        Metric(
            "random starts, largest approach-path deviation",
            lambda trials: float(np.max([column(trials, key) for key in deviations])),
            "mm",
            at_most=DEVIATION_MM,
        ),
        Metric(
            "random starts, fraction of joint-space plans that are blocked",
            lambda trials: float(column(trials, BLOCKED).mean()) / len(shelves),
            claim=_NO_COLLISION,
        ),
    ]


def _degrees(angle: float) -> float:
    return float(np.rad2deg(angle))
