"""What is measured of placings, by shelf and over all shelves, once and from random starts."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from hrc_learn.experiments.metric_table import Metric, column, largest, total
from hrc_learn.experiments.monte_carlo import Trial
from hrc_learn.experiments.placing import arm_angle_ablation
from hrc_learn.experiments.placing.trial import SPACES, PlacingOutcome, PlacingRun
from hrc_learn.experiments.run_recording import demonstrated_joints

# Bounds of a good placing. Approach paths planned in task space deviate by 2 mm, those planned
# in joint space with a shifted goal by 100 mm. Errors are those of the object on its board.
DEVIATION_MM, PLACE_ERROR_MM, PLACE_TILT_DEG = 12.0, 3.0, 3.0
# Of 50 placings from random starts one may go wrong.
_FRACTION = 0.98
# What of the demonstration's dimensionless jerk a reproduction may keep.
_JERK = 1e-2
_NO_COLLISION = "no collision with the cabinet"

type ByShelf = Mapping[str, PlacingOutcome]


def _millimetres(outcome: PlacingOutcome) -> float:
    return 1e3 * outcome.place_error


def _degrees(outcome: PlacingOutcome) -> float:
    return float(np.rad2deg(outcome.place_tilt))


def placing_metrics(shelves: Sequence[str]) -> list[Metric[ByShelf]]:
    """The table of one placing on each of the shelves."""

    def worst(of: Callable[[PlacingOutcome], float]) -> Callable[[ByShelf], float]:
        return lambda outcomes: max(map(of, outcomes.values()))

    def count(of: Callable[[PlacingOutcome], int]) -> Callable[[ByShelf], int]:
        return lambda outcomes: sum(map(of, outcomes.values()))

    def touched(outcomes: ByShelf) -> str:
        first = {shelf: o.contacts[0] for shelf, o in outcomes.items() if o.contacts}
        return "; ".join(f"{shelf} shelf: {touch}" for shelf, touch in first.items())

    return [
        *(metric for shelf in shelves for metric in _shelf_metrics(shelf)),
        Metric(
            "place error", worst(_millimetres), "mm", at_most=PLACE_ERROR_MM, essential=True
        ),
        Metric("place tilt", worst(_degrees), "deg", at_most=PLACE_TILT_DEG, essential=True),
        Metric(
            "joint limit violations", count(lambda o: o.violations), at_most=0, essential=True
        ),
        Metric(
            "contacts",
            count(lambda o: len(o.contacts)),
            at_most=0,
            claim=_NO_COLLISION,
            essential=True,
            detail=touched,
        ),
        Metric(
            "peak joint speed, fraction of its limit",
            worst(lambda o: o.peak_speed),
            at_most=1.0,
        ),
        Metric(
            "dimensionless jerk, fraction of the demonstration's",
            worst(lambda o: o.jerk),
            at_most=_JERK,
            claim="several unnecessary jerks removed",
        ),
        Metric(
            "objects that stand on their shelf",
            count(lambda o: o.placed),
            at_least=len(shelves),
            essential=True,
        ),
    ]


def _shelf_metrics(shelf: str) -> list[Metric[ByShelf]]:
    metrics = (
        Metric[PlacingOutcome](
            "approach-path deviation",
            lambda outcome: 1e3 * outcome.deviation,
            "mm",
            at_most=DEVIATION_MM,
            claim="similar paths towards the goals",
            essential=True,
        ),
        Metric[PlacingOutcome]("contacts", lambda outcome: len(outcome.contacts)),
        Metric("place error", _millimetres, "mm", listed=False),
        Metric("place tilt", _degrees, "deg", listed=False),
        Metric[PlacingOutcome]("placed", lambda outcome: int(outcome.placed), listed=False),
    )
    return [metric.of_part(lambda run: run[shelf], f"{shelf} shelf, ") for metric in metrics]


def run_metrics(shelves: Sequence[str]) -> list[Metric[PlacingRun]]:
    """The table of an experiment: reproduction, task space, joint space, ablation."""
    table, joint_space = placing_metrics(shelves), f"{SPACES['joint']}, "
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
        Metric("reproduction, joint RMSE", _joint_rmse, "deg", at_most=2.0),
        *(m.of_part(lambda run: run.outcomes["pose"]) for m in table),
        *(
            m.of_part(lambda run: run.outcomes["joint"], joint_space, bounded=False)
            for m in table
        ),
        *(m.of_part(lambda run: run.ablation) for m in arm_angle_ablation.METRICS),
        Metric(
            "shelves within reach with joint 7 as demonstrated",
            lambda run: len(run.same_joint7),
            claim="joint 7 is fixed for all three",
        ),
    ]


def _joint_rmse(run: PlacingRun) -> float:
    """Of the reproduction, from the demonstration at the same fraction of the motion [deg]."""
    done = run.reproduction
    demonstrated = demonstrated_joints(run.demonstration, done.time / done.time[-1])
    return float(np.rad2deg(np.sqrt(np.square(done.joint_position - demonstrated).mean())))


BLOCKED = "joint_space_plans_blocked"
"""Value of a trial from random starts: how many of the paper's plans are not free."""


CURVES = {
    "place_error_mm": "place error [mm]",
    "place_tilt_deg": "place tilt [deg]",
}
"""Drawn against the size of the imperfections, the worst of the shelves: labels by keys."""


def random_start_metrics(shelves: Sequence[str]) -> list[Metric[Sequence[Trial]]]:
    """Rows of the table that placings from random starts add."""

    def by_shelf(trials: Sequence[Trial], key: str) -> np.ndarray:
        return np.array([column(trials, f"{shelf}_shelf_{key}") for shelf in shelves])

    metrics: Sequence[Metric[Sequence[Trial]]] = (
        Metric("placings", lambda trials: len(trials) * len(shelves)),
        Metric(
            "fraction without contact",
            lambda trials: float((by_shelf(trials, "contacts") == 0).mean()),
            at_least=_FRACTION,
        ),
        Metric(
            "fraction that stands on its shelf",
            lambda trials: float((by_shelf(trials, "placed") == 1).mean()),
            at_least=_FRACTION,
        ),
        Metric("joint limit violations", total("joint_limit_violations"), at_most=0),
        Metric(
            f"fraction within {PLACE_ERROR_MM:g} mm and {PLACE_TILT_DEG:g} deg of its place",
            lambda trials: float(
                (
                    (by_shelf(trials, "place_error_mm") <= PLACE_ERROR_MM)
                    & (by_shelf(trials, "place_tilt_deg") <= PLACE_TILT_DEG)
                ).mean()
            ),
            at_least=_FRACTION,
        ),
        Metric(
            "place error (median)",
            lambda trials: float(np.nanmedian(by_shelf(trials, "place_error_mm"))),
            "mm",
        ),
        Metric("largest place error", largest("place_error_mm"), "mm"),
        Metric("largest place tilt", largest("place_tilt_deg"), "deg"),
        Metric(
            "largest approach-path deviation",
            lambda trials: float(by_shelf(trials, "approach_path_deviation_mm").max()),
            "mm",
            at_most=DEVIATION_MM,
        ),
        Metric(
            "fraction of joint-space plans that are blocked",
            lambda trials: float(column(trials, BLOCKED).mean()) / len(shelves),
            claim=_NO_COLLISION,
        ),
    )
    return [metric.of_part(lambda trials: trials, "random starts, ") for metric in metrics]
