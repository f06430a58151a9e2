"""Metrics of placings: outcome of one placing, values of a run, statistics of random starts."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from jaxtyping import Float

from hrc_learn.demos.quality.ranking import log_dimensionless_jerk
from hrc_learn.experiments import run_measures as measures
from hrc_learn.experiments.metric_table import Metric, never, p95, success_rate
from hrc_learn.experiments.placing_trial import (
    SPACES,
    PlacingScene,
    SimulatedPlacing,
    demonstrated_path,
)
from hrc_learn.experiments.run_recorder import demonstrated_joints
from hrc_learn.experiments.trials import Trial
from hrc_learn.log import LoggedSteps
from hrc_learn.sim import Touch
from hrc_learn.skills.placing import PlanningSpace

DEVIATION_MM, PLACE_ERROR_MM, PLACE_TILT_DEG = 12.0, 3.0, 3.0
"""Bounds of a good placing. Approach paths planned in task space deviate by 2 mm; approach
paths planned in joint space with a shifted goal deviate by 100 mm. The other two bounds are for
errors of the object on its board."""

# Largest dimensionless jerk of a reproduction relative to the demonstration.
_JERK = 1e-2


@dataclass(frozen=True, kw_only=True)
class PlacingOutcome:
    """Measured outcome of one placing."""

    deviation: float
    """Largest distance of the approach from the demonstrated path, when the demonstrated path
    is shifted so that it ends at this goal [m]."""
    place_error: float
    """Horizontal distance between the placed object and its intended place [m]."""
    place_tilt: float
    """Angle between the object's actual and intended orientation [rad]."""
    place_turns: tuple[float, float] | None = None
    """Pitch and yaw of the object relative to its intended orientation [rad]; None if the arm
    has more than five joints."""
    violations: int
    """Steps in which a joint was outside its range of position or velocity."""
    contacts: tuple[Touch, ...]
    """Unwanted contacts."""
    peak_speed: float
    """Largest joint velocity as a fraction of the limit of that joint."""
    jerk: float
    """Dimensionless jerk of the end effector's path, relative to that of the demonstration."""
    placed: bool
    """True if the object stands on its board afterwards."""

    @classmethod
    def of(cls, run: SimulatedPlacing, scene: PlacingScene) -> "PlacingOutcome":
        """Measure a placing on any shelf, relative to the demonstration."""
        workplace, demonstration = scene.workplace, scene.demonstration
        shown = demonstrated_path(demonstration, run.cell.chain)
        # The load crosses the front edge of the boards before the end effector does.
        edge = workplace.scene.cabinet.front + workplace.scene.objects[0].half_size[2]
        error = run.object_pose[:3, 3] - run.goal.position.numpy()
        turns = measures.place_pitch_and_yaw(run.object_pose, run.goal.orientation)
        speed = np.abs(run.cell.log["joint_velocity"]) / run.cell.chain.limits.velocity.numpy()
        done, demonstrated = (
            log_dimensionless_jerk(time, path)
            for time, path in ((run.time, run.path), (demonstration.time, shown))
        )
        return cls(
            deviation=approach_deviation(run.path, run.goal.position.numpy(), shown, edge),
            place_error=float(np.linalg.norm(error[:2])),
            place_tilt=measures.place_angle(run.object_pose, run.goal.orientation),
            place_turns=turns if workplace.robot.task == "nearest pose" else None,
            violations=measures.limit_violations(run.cell),
            contacts=run.contacts,
            peak_speed=float(speed.max()),
            jerk=math.exp(done - demonstrated),
            placed=run.placed,
        )


def approach_deviation(
    path: Float[np.ndarray, "steps 3"],
    goal: Float[np.ndarray, "3"],
    demonstrated: Float[np.ndarray, "frames 3"],
    edge: float,
) -> float:
    """Largest distance of an approach from the demonstrated approach shifted to its goal [m].

    Approaches run along -y, because the boards open towards +y. Their sideways and vertical
    distance at equal depths is measured, so that different shelves can be compared.

    Args:
        path: Path of the end effector [m].
        goal: Intended end of the path [m].
        demonstrated: Demonstrated path of the end effector, which ends behind the edge [m].
        edge: y of the front edge of the boards [m]; the approach begins where the path crosses
            this edge for the last time.

    Returns:
        Distance [m]; infinite if the path ends in front of the edge.
    """
    done, shown = _approach(path, goal, edge), _approach(demonstrated, demonstrated[-1], edge)
    if not len(done):
        return np.inf
    # Tremor moves a demonstration back a little: use the first time at each depth.
    progress = np.maximum.accumulate(-shown[:, 1])
    x, z = (np.interp(-done[:, 1], progress, shown[:, k]) for k in (0, 2))
    return float(np.hypot(done[:, 0] - x, done[:, 2] - z).max())


def _approach(
    path: Float[np.ndarray, "steps 3"], goal: Float[np.ndarray, "3"], edge: float
) -> Float[np.ndarray, "samples 3"]:
    """Offsets from the goal along the last part of a path, which is behind the edge [m]."""
    outside = np.flatnonzero(path[:, 1] > edge)
    return path[int(outside[-1]) + 1 if len(outside) else 0 :] - goal


@dataclass(frozen=True, kw_only=True, eq=False)
class PlacingRun:
    """Placings on every shelf, planned in both spaces."""

    scene: PlacingScene
    placings: Mapping[tuple[PlanningSpace, str], SimulatedPlacing]
    """Placings from the start of the demonstration, by space and shelf."""
    outcomes: Mapping[PlanningSpace, Mapping[str, PlacingOutcome]]
    """Outcomes by space, then by shelf."""
    failure: str = ""
    """Empty: the task itself never gives up."""

    @property
    def reproduction(self) -> SimulatedPlacing:
        """Demonstrated motion, reproduced in joint space as in the paper."""
        return self.placings["joint", self.scene.demonstrated_shelf]

    @property
    def log(self) -> LoggedSteps:
        """Log of the reproduction."""
        return self.reproduction.log


type ByShelf = Mapping[str, PlacingOutcome]


def placing_metrics(shelves: Sequence[str]) -> list[Metric[ByShelf]]:
    """Metrics of one placing on each of the shelves."""

    def worst(of: Callable[[PlacingOutcome], float]) -> Callable[[ByShelf], float]:
        return lambda outcomes: max(map(of, outcomes.values()))

    def count(of: Callable[[PlacingOutcome], int]) -> Callable[[ByShelf], int]:
        return lambda outcomes: sum(map(of, outcomes.values()))

    def first_contacts(outcomes: ByShelf) -> str:
        first = {shelf: o.contacts[0] for shelf, o in outcomes.items() if o.contacts}
        return "; ".join(f"{shelf} shelf: {touch}" for shelf, touch in first.items())

    return [
        *(metric for shelf in shelves for metric in _shelf_metrics(shelf)),
        Metric(
            "place error",
            worst(lambda o: 1e3 * o.place_error),
            "mm",
            at_most=PLACE_ERROR_MM,
            essential=True,
        ),
        Metric(
            "place tilt",
            worst(lambda o: math.degrees(o.place_tilt)),
            "deg",
            at_most=PLACE_TILT_DEG,
            essential=True,
        ),
        *_turn_metrics(),
        never("joint limit violations", count(lambda o: o.violations)),
        never(
            "contacts",
            count(lambda o: len(o.contacts)),
            claim="no collision with the cabinet",
            detail=first_contacts,
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


def _turn_metrics() -> list[Metric[ByShelf]]:
    """Largest pitch and yaw of the objects; left out for arms with more than five joints."""

    def largest(outcomes: ByShelf, which: int) -> float | None:
        turns = [o.place_turns[which] for o in outcomes.values() if o.place_turns]
        return math.degrees(max(turns)) if turns else None

    return [
        Metric(f"place {name}", partial(largest, which=k), "deg", at_most=PLACE_TILT_DEG)
        for k, name in enumerate(("pitch", "yaw"))
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
    ]


TRIAL_METRICS: Sequence[Metric[Sequence[Trial]]] = (
    # Of 50 trials one may fail.
    Metric("random starts, success rate", success_rate, at_least=0.98),
    Metric("random starts, place error (95 %)", p95("place_error_mm"), "mm"),
    Metric("random starts, place tilt (95 %)", p95("place_tilt_deg"), "deg"),
)
"""Metrics of placings from random starts."""


def run_metrics(shelves: Sequence[str]) -> list[Metric[PlacingRun]]:
    """Metrics of the experiment: reproduction, task space, joint space."""
    table, joint_space = placing_metrics(shelves), f"{SPACES['joint']}, "
    return [
        Metric(
            "demonstration, duration",
            lambda run: float(run.scene.demonstration.duration),
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
        # Joint space serves only for comparison: the table lists only rows of single shelves.
        *(
            replace(
                m.of_part(lambda run: run.outcomes["joint"], joint_space, bounded=False),
                listed="shelf," in m.name,
            )
            for m in table
        ),
    ]


def _joint_rmse(run: PlacingRun) -> float:
    """RMSE of the reproduced joints at equal fractions of the motion [deg]."""
    done = run.reproduction
    demonstrated = demonstrated_joints(run.scene.demonstration, done.time / done.time[-1])
    return float(np.rad2deg(np.sqrt(np.square(done.joint_position - demonstrated).mean())))
