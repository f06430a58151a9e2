"""Experiment 1 of the paper: the demonstrated shelf, then the others, planned in two spaces.

In joint space with a shifted goal, as in the paper, and in task space with the learned
null-space posture.
"""

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from jaxtyping import Float

from hrc_learn.demos import Demonstration, load_demos
from hrc_learn.experiments.arm_access import ArmDriver, access_by
from hrc_learn.experiments.frame import UNOBSERVED, Observer, Study
from hrc_learn.experiments.metric_table import Metric, evaluate
from hrc_learn.experiments.placing import arm_angle_ablation
from hrc_learn.experiments.placing.arm_angle_ablation import Ablation, AblationTrial
from hrc_learn.experiments.placing.figures import take_snapshots
from hrc_learn.experiments.placing.metrics import (
    BLOCKED,
    CURVES,
    placing_metrics,
    random_start_metrics,
    run_metrics,
)
from hrc_learn.experiments.placing.report import (
    SUMMARY,
    placing_sections,
    random_start_pictures,
    record_placing,
)
from hrc_learn.experiments.placing.trial import (
    SPACES,
    PlacingOutcome,
    PlacingRun,
    SimulatedPlacing,
    demonstrated_path,
    place,
    random_start,
    taught_correction,
)
from hrc_learn.experiments.run_recording import no_live_view
from hrc_learn.kinematics import ArmChoice, UnreachableError
from hrc_learn.log import LoggedSteps, RunRecording
from hrc_learn.sim import Imperfections, RenderingUnavailableError, World
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills.failures import BlockedPathError
from hrc_learn.skills.placing import PlacingSkill, PlanningSpace, check_plan
from hrc_learn.store import read_made_by
from hrc_learn.viz.report import Section

ABLATION = "ablation"
"""Name of the study of further paired demonstrations."""

_DT = 0.01
"""Step of plans that are only checked, not carried out [s]."""


@dataclass(frozen=True, kw_only=True)
class PlacingExperiment:
    """Place on every shelf, planned in both spaces; demonstrate in both ways."""

    title: ClassVar[str] = "Placing: demonstrated once, reproduced faster, on other shelves"
    summary: ClassVar[str] = SUMMARY

    placing: Path
    """Folder of the placing skill."""
    demonstrations: Path
    """Dataset that it was learned from."""
    speed: float = 1.5
    """How many times faster than demonstrated."""
    noise: float = 0.1
    """Standard deviation of each joint at random starts, about home [rad]."""
    imperfections: Imperfections = field(default_factory=Imperfections.nominal)
    """Of arm, calibration and objects."""
    curve: tuple[float, ...] = ()
    """Sizes of the imperfections to repeat random starts with, in multiples of the nominal."""
    taught: bool = True
    """Whether a person leads the arm once to the place on the demonstrated shelf, and what its
    encoders read there corrects all goals."""
    snapshots: bool = True
    """Whether to render pictures of the arm, where this machine can."""
    robot: ArmChoice = field(default_factory=ArmChoice)
    """Which arm does it."""
    arm: ArmDriver = "sim"
    """What leads the simulated arm: the simulator itself, or a driver of the real one over its
    network protocol."""

    def __post_init__(self) -> None:
        if self.speed <= 0 or self.noise < 0:
            raise ValueError(
                "speed must be positive and noise not negative, but they are "
                f"{self.speed:g} and {self.noise:g}."
            )

    def run(self, seed: int, observer: Observer = UNOBSERVED) -> PlacingRun:
        """All placings from the demonstration's start.

        The seed draws the imperfections, and the demonstrations of the ablation.

        Raises:
            ValueError: If the demonstration is not of this arm or ends at none of the shelves.
        """
        skill, demonstration = (
            PlacingSkill.load(self.placing, self.robot.work_arm()),
            self._demonstration(),
        )
        workplace = self._workplace
        path = demonstrated_path(demonstration, skill.robot.chain)
        goal_shelf = demonstrated_shelf(path[-1], workplace)
        assert demonstration.joint_position is not None
        start = torch.from_numpy(demonstration.joint_position[0])
        rng = np.random.default_rng(seed)
        world = World(workplace.scene, self.imperfections.draw(rng, skill.robot.joints))
        correction = None
        if self.taught:
            correction = taught_correction(
                world, workplace.shelf(goal_shelf), skill.joint.goal, rng
            )
        placings: dict[tuple[PlanningSpace, str], SimulatedPlacing] = {}
        outcomes: dict[PlanningSpace, dict[str, PlacingOutcome]] = {s: {} for s in SPACES}
        for space, label in SPACES.items():
            for shelf in workplace.shelf_names():
                observer.tell(f"Placing on the {shelf} shelf, planned in {label}")
                viewed = (space, shelf) == ("joint", goal_shelf)
                view = observer.view if viewed else no_live_view
                placed = place(
                    skill,
                    workplace,
                    shelf,
                    start,
                    space=space,
                    speed=self.speed,
                    world=world,
                    correction=correction,
                    access=access_by(self.arm, self.robot.work_arm()),
                    view=view,
                )
                placings[space, shelf] = placed
                outcomes[space][shelf] = PlacingOutcome.of(placed, workplace, demonstration)
        observer.tell("Demonstrating with and without null-space posture")
        return PlacingRun(
            workplace=workplace,
            demonstration=demonstration,
            demonstrated_shelf=goal_shelf,
            placings=placings,
            outcomes=outcomes,
            ablation=Ablation.run(workplace, goal_shelf, seed),
            same_joint7=_reached_with_joint7(workplace, demonstration.joint_position[-1]),
        )

    def failure(self, run: PlacingRun) -> str:
        """The task itself never gives up."""
        return ""

    def metrics(self) -> Sequence[Metric[PlacingRun]]:
        """Reproduction, both spaces, ablation."""
        return run_metrics(self._workplace.shelf_names())

    def recordings(self, run: PlacingRun) -> Mapping[str, RunRecording]:
        """Placings planned in task space; the demonstrated shelf's is "run"."""
        boxes = tuple(run.workplace.scene.boxes())
        return {
            "run" if shelf == run.demonstrated_shelf else f"run_{shelf}": record_placing(
                run.placings["pose", shelf], run.demonstration, boxes
            )
            for shelf in run.workplace.shelf_names()
        }

    def log(self, run: PlacingRun) -> LoggedSteps:
        """Of the reproduction."""
        return run.reproduction.cell.log

    def sections(
        self, run: PlacingRun, recordings: Mapping[str, RunRecording]
    ) -> Sequence[Section]:
        """Shelves, approach, smoothness, null-space posture."""
        snapshots = {}
        if self.snapshots:
            try:
                snapshots = take_snapshots(run)
            except RenderingUnavailableError as error:
                print(f"note: no pictures of the arm, as {error}", file=sys.stderr)
        return placing_sections(run, snapshots)

    def studies(self) -> Mapping[str, Study]:
        """Placings from random starts, and further paired demonstrations.

        The first with each size of the imperfections.
        """
        shelves = self._workplace.shelf_names()
        starts = RandomStart(
            placing=self.placing,
            demonstrations=self.demonstrations,
            speed=self.speed,
            noise=self.noise,
            imperfections=self.imperfections,
            taught=self.taught,
            robot=self.robot,
        )
        end = demonstrated_path(self._demonstration(), self.robot.work_arm().chain)[-1]
        study = Study(
            title="Placing on each shelf from random starts",
            trial=starts,
            metrics=random_start_metrics(shelves),
            text="Every joint of the start is drawn about home; planned in task space.",
            pictures=lambda trials: random_start_pictures(trials, shelves),
            shown=CURVES,
        )
        return {
            **study.at_sizes(self.curve),
            ABLATION: Study(
                title="Paired demonstrations with and without null-space posture",
                trial=AblationTrial(
                    shelf=demonstrated_shelf(end, self._workplace), robot=self.robot
                ),
                metrics=arm_angle_ablation.TRIAL_METRICS,
                text="Another tremor and start for each pair.",
            ),
        }

    @property
    def _workplace(self) -> Workplace:
        return Workplace.of(self.robot.work_arm())

    def _demonstration(self) -> Demonstration:
        return load_demos(self.demonstrations, episodes=[0])[0]


def dataset_of(placing: Path) -> Path:
    """The dataset that a placing skill was learned from.

    Raises:
        FileNotFoundError: If it is not there any more.
    """
    path = Path(read_made_by(placing)["dataset"])
    if not path.is_dir():
        raise FileNotFoundError(
            f"{path}, which {placing} was learned from, is not there any more: name the "
            "dataset with --demonstrations."
        )
    return path


def demonstrated_shelf(end: Float[np.ndarray, "3"], workplace: Workplace) -> str:
    """The shelf at which a path of the end effector ends.

    Raises:
        ValueError: If it ends more than 5 cm from the place on any shelf.
    """
    distance = {
        shelf: float(np.linalg.norm(workplace.shelf(shelf).position.numpy() - end))
        for shelf in workplace.shelf_names()
    }
    nearest = min(distance, key=distance.__getitem__)
    # Shelves are 24 cm apart: 5 cm is a careless demonstration, more is another place.
    if distance[nearest] > 0.05:
        x, y, z = end.tolist()
        raise ValueError(
            f"the demonstration ends at ({x:.2f}, {y:.2f}, {z:.2f}) m, "
            f"{100 * distance[nearest]:.0f} cm from the nearest shelf ({nearest}): give "
            "demonstrations of placing, by datasets/record_placing.py."
        )
    return nearest


def _reached_with_joint7(workplace: Workplace, end: np.ndarray) -> tuple[str, ...]:
    """Shelves that need no other position of joint 7 than the demonstration ended with."""
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


@dataclass(frozen=True, kw_only=True)
class RandomStart:
    """A trial: place on each shelf from a random start."""

    placing: Path
    demonstrations: Path
    speed: float
    noise: float
    """Standard deviation of each joint about home [rad]."""
    imperfections: Imperfections
    taught: bool
    robot: ArmChoice = field(default_factory=ArmChoice)

    def __call__(self, seed: int) -> Mapping[str, Any]:
        """Metrics of placings in task space, and how many joint-space plans are blocked."""
        skill = PlacingSkill.load(self.placing, self.robot.work_arm())
        demonstration = load_demos(self.demonstrations, episodes=[0])[0]
        workplace, rng = Workplace.of(skill.robot), np.random.default_rng(seed)
        world = World(workplace.scene, self.imperfections.draw(rng, skill.robot.joints))
        item = workplace.scene.objects[0].name
        correction = None
        if self.taught:
            path = demonstrated_path(demonstration, skill.robot.chain)
            known = demonstrated_shelf(path[-1], workplace)
            correction = taught_correction(world, workplace.shelf(known), skill.joint.goal, rng)
        outcomes, blocked = {}, 0
        for shelf in workplace.shelf_names():
            start = random_start(world, workplace, self.noise, rng)
            plan = skill.plan(
                start, workplace.shelf(shelf), space="joint", dt=_DT, speed=self.speed
            )
            try:
                check_plan(plan, world, item)
            except BlockedPathError:
                blocked += 1
            run = place(
                skill,
                workplace,
                shelf,
                start,
                space="pose",
                speed=self.speed,
                world=world,
                correction=correction,
            )
            outcomes[shelf] = PlacingOutcome.of(run, workplace, demonstration)
        evaluation = evaluate(placing_metrics(workplace.shelf_names()), outcomes)
        failure = "; ".join(evaluation.faults)
        return {**evaluation.values, BLOCKED: blocked, "failure": failure}
