"""Experiment 1 of the paper: the demonstrated shelf, then the others, planned in two spaces.

In joint space with a shifted goal, as in the paper, and in task space with the learned
null-space posture.
"""

import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from jaxtyping import Float

from hrc_learn.demos import Demonstration, load_demos
from hrc_learn.experiments.arm_access import ArmDriver, access_by
from hrc_learn.experiments.experiment import Study
from hrc_learn.experiments.metric_table import Metric, column, evaluate, largest, total
from hrc_learn.experiments.placing_report import (
    SUMMARY,
    placing_sections,
    random_start_pictures,
    record_placing,
)
from hrc_learn.experiments.placing_trial import (
    DEVIATION_MM,
    PLACE_ERROR_MM,
    PLACE_TILT_DEG,
    SPACES,
    PlacingOutcome,
    PlacingRun,
    SimulatedPlacing,
    demonstrated_path,
    place,
    random_start,
    taught_correction,
)
from hrc_learn.experiments.run_recorder import demonstrated_joints
from hrc_learn.experiments.simulated_cell import UNOBSERVED, Observer
from hrc_learn.experiments.snapshots import placing_snapshots
from hrc_learn.experiments.trials import Trial
from hrc_learn.kinematics import ArmChoice, UnreachableError
from hrc_learn.log import LoggedSteps, RunRecording
from hrc_learn.sim import Imperfections, RenderingUnavailableError, World
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills.failures import BlockedPathError
from hrc_learn.skills.placing import PlaceCorrection, PlacingSkill, PlanningSpace, check_plan
from hrc_learn.store import read_made_by
from hrc_learn.viz.report import Section

# Step of plans that are only checked, not carried out [s].
_DT = 0.01
# Of 50 placings from random starts one may fail.
_FRACTION = 0.98
# Largest dimensionless jerk of a reproduction relative to the demonstration.
_JERK = 1e-2
# Largest distance of the end of a demonstration from a shelf [m]. Shelves are 24 cm apart: 5 cm
# is a careless demonstration, more is another place.
_SHELF_DISTANCE = 0.05
_NO_COLLISION = "no collision with the cabinet"
_BLOCKED = "joint_space_plans_blocked"


@dataclass(frozen=True, kw_only=True)
class PlacingExperiment:
    """Place the object on every shelf, planned in both spaces."""

    title: ClassVar[str] = "Placing: demonstrated once, reproduced faster, on other shelves"
    summary: ClassVar[str] = SUMMARY

    placing: Path
    """Folder of the placing skill."""
    demonstrations: Path
    """Dataset that the skill was learned from."""
    speed: float = 1.5
    """Speed relative to the demonstration."""
    noise: float = 0.1
    """Standard deviation of each joint at random starts, about home [rad]."""
    imperfections: Imperfections = field(default_factory=Imperfections.nominal)
    """Imperfections of arm, calibration and objects."""
    taught: bool = True
    """A person first guides the arm to the place on the demonstrated shelf; the measured pose
    there corrects all goals."""
    snapshots: bool = True
    """Render pictures of the arm, if this machine can."""
    robot: ArmChoice = field(default_factory=ArmChoice)
    """The arm."""
    arm: ArmDriver = "sim"
    """Driver of the simulated arm: the simulator itself, or a driver of the real arm over its
    network protocol."""

    def __post_init__(self) -> None:
        if self.speed <= 0 or self.noise < 0:
            raise ValueError(
                "speed must be positive and noise not negative, but they are "
                f"{self.speed:g} and {self.noise:g}."
            )

    def run(self, seed: int, observer: Observer = UNOBSERVED) -> PlacingRun:
        """Place on all shelves in both spaces, from the start of the demonstration.

        The seed draws the imperfections.

        Raises:
            ValueError: If the demonstration is not of this arm or ends at no shelf.
        """
        scene = self.open_scene(np.random.default_rng(seed))
        joints = scene.demonstration.joint_position
        assert joints is not None
        placings: dict[tuple[PlanningSpace, str], SimulatedPlacing] = {}
        outcomes: dict[PlanningSpace, dict[str, PlacingOutcome]] = {s: {} for s in SPACES}
        for space, label in SPACES.items():
            for shelf in scene.workplace.shelf_names():
                observer.tell(f"Placing on the {shelf} shelf, planned in {label}")
                viewed = (space, shelf) == ("joint", scene.demonstrated_shelf)
                placed = place(
                    scene.skill,
                    scene.workplace,
                    shelf,
                    torch.from_numpy(joints[0]),
                    space=space,
                    speed=self.speed,
                    world=scene.world,
                    correction=scene.correction,
                    access=access_by(self.arm, scene.skill.robot),
                    observer=observer if viewed else UNOBSERVED,
                )
                placings[space, shelf] = placed
                outcomes[space][shelf] = scene.outcome(placed)
        return PlacingRun(
            workplace=scene.workplace,
            demonstration=scene.demonstration,
            demonstrated_shelf=scene.demonstrated_shelf,
            placings=placings,
            outcomes=outcomes,
            same_joint7=_reached_with_joint7(scene.workplace, joints[-1]),
        )

    def open_scene(self, rng: np.random.Generator) -> "PlacingScene":
        """World with drawn imperfections, skill, demonstration and taught correction."""
        skill = PlacingSkill.load(self.placing, self.robot.work_arm())
        demonstration = load_demos(self.demonstrations, episodes=[0])[0]
        workplace = Workplace.of(skill.robot)
        end = demonstrated_path(demonstration, skill.robot.chain)[-1]
        shelf = demonstrated_shelf(end, workplace)
        world = World(workplace.scene, self.imperfections.draw(rng, skill.robot.joints))
        correction = None
        if self.taught:
            goal = workplace.shelf(shelf)
            correction = taught_correction(world, goal, skill.joint.goal, rng)
        return PlacingScene(
            skill=skill,
            workplace=workplace,
            world=world,
            demonstration=demonstration,
            demonstrated_shelf=shelf,
            correction=correction,
        )

    def failure(self, run: PlacingRun) -> str:
        """Empty: the task itself never gives up."""
        return ""

    def metrics(self) -> Sequence[Metric[PlacingRun]]:
        """Metrics of the reproduction and of both planning spaces."""
        return run_metrics(self._shelves)

    def recordings(self, run: PlacingRun) -> Mapping[str, RunRecording]:
        """Placings planned in task space; that on the demonstrated shelf is named "run"."""
        boxes = tuple(run.workplace.scene.boxes())
        return {
            "run" if shelf == run.demonstrated_shelf else f"run_{shelf}": record_placing(
                run.placings["pose", shelf], run.demonstration, boxes
            )
            for shelf in run.workplace.shelf_names()
        }

    def log(self, run: PlacingRun) -> LoggedSteps:
        """Log of the reproduction."""
        return run.reproduction.cell.log

    def sections(
        self, run: PlacingRun, recordings: Mapping[str, RunRecording]
    ) -> Sequence[Section]:
        """Report sections: shelves, approach, smoothness."""
        snapshots = {}
        if self.snapshots:
            try:
                snapshots = placing_snapshots(run)
            except RenderingUnavailableError as error:
                print(f"note: no pictures of the arm: {error}", file=sys.stderr)
        return placing_sections(run, snapshots)

    def study(self) -> Study:
        """Trials from random starts."""
        shelves = self._shelves
        return Study(
            title="Placing on each shelf from random starts",
            trial=RandomStart(self),
            metrics=random_start_metrics(shelves),
            text="Every joint of the start is drawn about home; planned in task space.",
            pictures=lambda trials: random_start_pictures(trials, shelves),
        )

    @property
    def _shelves(self) -> Sequence[str]:
        return Workplace.of(self.robot.work_arm()).shelf_names()


@dataclass(frozen=True, kw_only=True, eq=False)
class PlacingScene:
    """World of placings, with the skill and the demonstration it was learned from."""

    skill: PlacingSkill
    workplace: Workplace
    world: World
    demonstration: Demonstration
    demonstrated_shelf: str
    correction: PlaceCorrection | None

    def outcome(self, run: SimulatedPlacing) -> PlacingOutcome:
        """Measured outcome of a placing."""
        return PlacingOutcome.of(run, self.workplace, self.demonstration)


@dataclass(frozen=True)
class RandomStart:
    """One trial: place on each shelf, each time from another random start."""

    experiment: PlacingExperiment

    def __call__(self, seed: int) -> Mapping[str, Any]:
        """Metrics of placings in task space, and the number of blocked joint-space plans."""
        rng = np.random.default_rng(seed)
        scene, speed = self.experiment.open_scene(rng), self.experiment.speed
        item = scene.workplace.scene.objects[0].name
        outcomes, blocked = {}, 0
        for shelf in scene.workplace.shelf_names():
            start = random_start(scene.world, scene.workplace, self.experiment.noise, rng)
            goal = scene.workplace.shelf(shelf)
            plan = scene.skill.plan(start, goal, space="joint", dt=_DT, speed=speed)
            try:
                check_plan(plan, scene.world, item)
            except BlockedPathError:
                blocked += 1
            placed = place(
                scene.skill,
                scene.workplace,
                shelf,
                start,
                space="pose",
                speed=speed,
                world=scene.world,
                correction=scene.correction,
            )
            outcomes[shelf] = scene.outcome(placed)
        evaluation = evaluate(placing_metrics(scene.workplace.shelf_names()), outcomes)
        failure = "; ".join(evaluation.faults)
        return {**evaluation.values, _BLOCKED: blocked, "failure": failure}


def dataset_of(placing: Path) -> Path:
    """Dataset that a placing skill was learned from.

    Raises:
        FileNotFoundError: If it no longer exists.
    """
    path = Path(read_made_by(placing)["dataset"])
    if not path.is_dir():
        raise FileNotFoundError(
            f"{path}, the dataset of {placing}, no longer exists: name the dataset with "
            "--demonstrations."
        )
    return path


def demonstrated_shelf(end: Float[np.ndarray, "3"], workplace: Workplace) -> str:
    """Shelf at which a path of the end effector ends.

    Raises:
        ValueError: If it ends more than 5 cm from the place on any shelf.
    """
    distance = {
        shelf: float(np.linalg.norm(workplace.shelf(shelf).position.numpy() - end))
        for shelf in workplace.shelf_names()
    }
    nearest = min(distance, key=distance.__getitem__)
    if distance[nearest] > _SHELF_DISTANCE:
        x, y, z = end.tolist()
        raise ValueError(
            f"the demonstration ends at ({x:.2f}, {y:.2f}, {z:.2f}) m, "
            f"{100 * distance[nearest]:.0f} cm from the nearest shelf ({nearest}): give "
            "demonstrations of placing (hrc record expert)."
        )
    return nearest


def _reached_with_joint7(workplace: Workplace, end: np.ndarray) -> tuple[str, ...]:
    """Shelves within reach of a Franka arm with joint 7 as at the end of the demonstration."""
    near = torch.from_numpy(end)
    reached: list[str] = []
    if not workplace.robot.is_franka:
        return ()
    for shelf in workplace.shelf_names():
        try:
            workplace.robot.chain.inverse(workplace.shelf(shelf), near[6], near=near)
        except UnreachableError:
            continue
        reached.append(shelf)
    return tuple(reached)


type ByShelf = Mapping[str, PlacingOutcome]


def _millimetres(outcome: PlacingOutcome) -> float:
    return 1e3 * outcome.place_error


def _degrees(outcome: PlacingOutcome) -> float:
    return float(np.rad2deg(outcome.place_tilt))


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
    """Metrics of the experiment: reproduction, task space, joint space."""
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
        Metric(
            "shelves within reach with joint 7 as demonstrated",
            lambda run: len(run.same_joint7),
            claim="joint 7 is fixed for all three",
        ),
    ]


def _joint_rmse(run: PlacingRun) -> float:
    """RMSE of the reproduced joints at equal fractions of the motion [deg]."""
    done = run.reproduction
    demonstrated = demonstrated_joints(run.demonstration, done.time / done.time[-1])
    return float(np.rad2deg(np.sqrt(np.square(done.joint_position - demonstrated).mean())))


def random_start_metrics(shelves: Sequence[str]) -> list[Metric[Sequence[Trial]]]:
    """Metrics of placings from random starts."""

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
            lambda trials: float(column(trials, _BLOCKED).mean()) / len(shelves),
            claim=_NO_COLLISION,
        ),
    )
    return [metric.of_part(lambda trials: trials, "random starts, ") for metric in metrics]
