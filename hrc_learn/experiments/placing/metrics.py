"""What the experiment on placing has to reach, measured, beside what the paper claims."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from hrc_learn.experiments.monte_carlo import Trial
from hrc_learn.experiments.placing.experiment import SPACES, PlacingExperiment
from hrc_learn.experiments.placing.trial import BEND, GOAL_ANGLE, GOAL_DISTANCE, PlacingFigures
from hrc_learn.skills.placing import PlanningSpace
from hrc_learn.viz.report import Measurement

_COLLIDES = "the 4th link collides with the cabinet"
_AVOIDED = "the collision is avoided"
_FREE = "no collision with the cabinet"

JERK = 1e-2
"""Share of the demonstration's dimensionless jerk that a reproduction may keep."""
FREE = 0.98
"""Share of placings from random starts that have to be free of contacts."""


def evaluate_placing(experiment: PlacingExperiment) -> list[Measurement]:
    """Measured values of the detailed runs.

    Bounds are those of task space: the paper's joint space is reported beside it.
    """
    return [
        *_reproduction(experiment),
        *(m for space in SPACES for m in _shelves(experiment, space)),
        Measurement(
            name="contacts of the arm with the cabinet, hand alone shown",
            value=len(experiment.untaught.met_by_arm),
            target=1,
            at_least=True,
            claim=_COLLIDES,
        ),
        Measurement(
            name="contacts with the cabinet, body shown as well",
            value=len(experiment.taught.touches),
            target=0,
            claim=_AVOIDED,
        ),
        Measurement(
            name="shelves within reach if joint 7 stays as demonstrated",
            value=len(experiment.same_joint7),
            claim="joint 7 is fixed for all three",
        ),
    ]


def _reproduction(experiment: PlacingExperiment) -> Iterable[Measurement]:
    run = experiment.reproduction
    yield Measurement(
        name="demonstration, duration",
        value=float(experiment.demonstration.duration),
        unit="s",
        claim="30 s",
    )
    yield Measurement(
        name="reproduction, duration",
        value=run.plan.duration,
        unit="s",
        claim="20 s, tau = 1.5",
    )
    yield Measurement(
        name="reproduction, joints off the demonstration (RMS)",
        value=_degrees(experiment.joint_rmse),
        unit="deg",
        target=2.0,
    )


def _shelves(experiment: PlacingExperiment, space: PlanningSpace) -> Iterable[Measurement]:
    by_shelf = {
        shelf: experiment.figures[space, shelf] for shelf in experiment.workplace.shelf_names()
    }
    for m in _bounded(by_shelf):
        m = replace(m, name=f"{SPACES[space]}, {m.name}")
        yield m if space == "pose" else replace(m, target=None)


def _bounded(by_shelf: Mapping[str, PlacingFigures]) -> Iterable[Measurement]:
    for shelf, figures in by_shelf.items():
        yield Measurement(
            name=f"{shelf} shelf: way in bent",
            value=1e3 * figures.bend,
            unit="mm",
            target=1e3 * BEND,
            claim="similar paths towards the goals",
        )
    for shelf, figures in by_shelf.items():
        yield Measurement(
            name=f"{shelf} shelf: contacts",
            value=len(figures.touches),
            target=0,
            claim=_FREE,
        )

    def worst(of: str) -> float:
        return float(max(getattr(figures, of) for figures in by_shelf.values()))

    yield Measurement(
        name="goal error, worst shelf",
        value=1e3 * worst("goal_distance"),
        unit="mm",
        target=1e3 * GOAL_DISTANCE,
    )
    yield Measurement(
        name="goal error, angle, worst shelf",
        value=_degrees(worst("goal_angle")),
        unit="deg",
        target=_degrees(GOAL_ANGLE),
    )
    yield Measurement(
        name="joint limit violations",
        value=sum(figures.violations for figures in by_shelf.values()),
        unit="steps",
        target=0,
    )
    yield Measurement(
        name="peak joint speed, share of its limit", value=worst("peak_speed"), target=1.0
    )
    yield Measurement(
        name="dimensionless jerk left of the demonstration's, worst shelf",
        value=worst("jerk"),
        target=JERK,
        claim="several unnecessary jerks removed",
    )
    yield Measurement(
        name="things that stand on their shelf",
        value=sum(figures.placed for figures in by_shelf.values()),
        target=len(by_shelf),
        at_least=True,
    )


def evaluate_random_starts(
    trials: Sequence[Trial], shelves: Sequence[str]
) -> list[Measurement]:
    """Measured values of placings from random starts, planned in task space.

    Args:
        trials: Of `PlacingTrials`.
        shelves: On which was placed in each.
    """

    def values(name: str) -> np.ndarray:
        # A trial that was given up measured nothing: NaN keeps no target.
        rows = [t.values.get(f"{shelf}_{name}", np.nan) for t in trials for shelf in shelves]
        return np.array(rows, dtype=float)

    free = float((values("contacts") == 0).mean())
    start = "random starts"
    return [
        Measurement(name=f"{start}, placings", value=len(trials) * len(shelves)),
        Measurement(
            name=f"{start}, share without contact", value=free, target=FREE, at_least=True
        ),
        Measurement(
            name=f"{start}, share that stands on its shelf",
            value=float(values("placed").mean()),
            target=FREE,
            at_least=True,
        ),
        Measurement(
            name=f"{start}, joint limit violations",
            value=float(values("limit_violations").sum()),
            unit="steps",
            target=0,
        ),
        Measurement(
            name=f"{start}, largest goal error",
            value=float(values("goal_error_mm").max()),
            unit="mm",
            target=1e3 * GOAL_DISTANCE,
        ),
        Measurement(
            name=f"{start}, largest goal error, angle",
            value=float(values("goal_error_deg").max()),
            unit="deg",
            target=_degrees(GOAL_ANGLE),
        ),
        Measurement(
            name=f"{start}, way in bent most",
            value=float(values("bend_mm").max()),
            unit="mm",
            target=1e3 * BEND,
        ),
        Measurement(
            name=f"{start}, share of joint space plans that are not free",
            value=float(values("joint_space_blocked").mean()),
            claim=_FREE,
        ),
    ]


def evaluate_lessons(trials: Sequence[Trial]) -> list[Measurement]:
    """Measured values of demonstrations with and without the body's shape."""
    untaught = sum(int(trial.values["untaught_hit"]) for trial in trials)
    taught = sum(int(trial.values["taught_hit"]) for trial in trials)
    return [
        Measurement(name="demonstrations with and without body shape", value=len(trials)),
        Measurement(
            name="demonstrations in which the arm hit the cabinet, hand alone shown",
            value=untaught,
            claim=_COLLIDES,
        ),
        Measurement(
            name="demonstrations in which something hit the cabinet, body shown as well",
            value=taught,
            target=0,
            claim=_AVOIDED,
        ),
    ]


def _degrees(angle: float) -> float:
    return float(np.rad2deg(angle))
