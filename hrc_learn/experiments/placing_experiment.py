"""Experiment 1 of the paper: placing on the demonstrated shelf and on others.

Motions are planned in joint space with a shifted goal, as in the paper, and in task space with
the learned null-space posture.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch

from hrc_learn.demos import load_demos
from hrc_learn.experiments.experiment import Study
from hrc_learn.experiments.metric_table import Metric, evaluate
from hrc_learn.experiments.placing_metrics import (
    TRIAL_METRICS,
    PlacingOutcome,
    PlacingRun,
    placing_metrics,
    run_metrics,
)
from hrc_learn.experiments.placing_trial import (
    SPACES,
    PlacingScene,
    SimulatedPlacing,
    demonstrated_path,
    demonstrated_shelf,
    random_start,
    taught_correction,
)
from hrc_learn.experiments.run_recorder import record
from hrc_learn.experiments.run_report import (
    SUMMARIES,
    placing_joints_figure,
    placing_paths_figure,
    worded,
)
from hrc_learn.experiments.simulated_cell import UNOBSERVED, ArmDriver, Observer, access_by
from hrc_learn.geometry.numerics import check_settings
from hrc_learn.kinematics import ArmChoice
from hrc_learn.log import RunRecording
from hrc_learn.sim import Imperfections, World
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills.placing import PlacingSkill, PlanningSpace
from hrc_learn.store import read_made_by
from hrc_learn.viz.report import Section


@dataclass(frozen=True, kw_only=True)
class PlacingExperiment:
    """Place the object on every shelf, with motions planned in both spaces."""

    title: ClassVar[str] = "Placing: demonstrated once, reproduced faster, on other shelves"
    summary: ClassVar[str] = SUMMARIES["placing"]

    placing: Path
    """Folder of the placing skill."""
    demonstrations: Path
    """Dataset that the skill was learned from."""
    speed: float = 1.5
    """Speed relative to the demonstration."""
    noise: float = 0.1
    """Standard deviation of each joint about home at random starts [rad]."""
    imperfections: Imperfections = field(default_factory=Imperfections.nominal)
    """Imperfections of arm, calibration and objects."""
    taught: bool = True
    """A person first guides the arm to the place on the demonstrated shelf; the measured pose
    there corrects all goals."""
    robot: ArmChoice = field(default_factory=ArmChoice)
    """The arm."""
    arm: ArmDriver = "sim"
    """Driver of the simulated arm: the simulator itself, or a driver of the real arm over its
    network protocol."""

    def __post_init__(self) -> None:
        check_settings(self, positive=["speed"], not_negative=["noise"])

    def run(self, seed: int, observer: Observer = UNOBSERVED) -> PlacingRun:
        """Place on all shelves in both spaces, from the start of the demonstration.

        The seed draws the imperfections.

        Raises:
            ValueError: The demonstration is of another arm, or does not end at a shelf.
        """
        scene = self.open_scene(np.random.default_rng(seed))
        joints = scene.demonstration.joint_position
        assert joints is not None
        placings: dict[tuple[PlanningSpace, str], SimulatedPlacing] = {}
        outcomes: dict[PlanningSpace, dict[str, PlacingOutcome]] = {s: {} for s in SPACES}
        for planned, label in SPACES.items():
            for shelf in scene.workplace.shelf_names():
                observer.tell(f"Placing on the {shelf} shelf, planned in {label}")
                viewed = (planned, shelf) == ("joint", scene.demonstrated_shelf)
                placings[planned, shelf] = placed = scene.place(
                    shelf,
                    torch.from_numpy(joints[0]),
                    space=planned,
                    speed=self.speed,
                    access=access_by(self.arm, scene.skill.robot),
                    observer=observer if viewed else UNOBSERVED,
                )
                outcomes[planned][shelf] = PlacingOutcome.of(placed, scene)
        return PlacingRun(scene=scene, placings=placings, outcomes=outcomes)

    def open_scene(self, rng: np.random.Generator) -> PlacingScene:
        """World with drawn imperfections, skill, demonstration and taught correction.

        Raises:
            FileNotFoundError: If the demonstrations no longer exist.
        """
        if not self.demonstrations.is_dir():
            raise FileNotFoundError(
                f"{self.demonstrations}, the dataset of {self.placing}, no longer exists: "
                "restore it, or name its place by --config experiment.demonstrations=PATH."
            )
        skill = PlacingSkill.load(self.placing, self.robot.work_arm())
        demonstration = load_demos(self.demonstrations, episodes=[0])[0]
        workplace = Workplace.of(skill.robot)
        end = demonstrated_path(demonstration, skill.robot.chain)[-1]
        shelf = demonstrated_shelf(end, workplace)
        robot = skill.robot
        drawn = self.imperfections.draw(rng, robot.joints, robot.hand_size)
        world = World(workplace.scene, drawn)
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

    def metrics(self) -> Sequence[Metric[PlacingRun]]:
        """Metrics of the reproduction and of both planning spaces."""
        return run_metrics(self._shelves)

    def recordings(self, run: PlacingRun) -> Mapping[str, RunRecording]:
        """Placings planned in task space; "run" is the placing on the demonstrated shelf."""
        recordings = {}
        for shelf in run.scene.workplace.shelf_names():
            placed = run.placings["pose", shelf]
            recording = record(
                f"Placing on the {shelf} shelf",
                placed.cell,
                placed.world,
                placed.motion,
                plans=[placed.plan],
                demonstration=run.scene.demonstration,
            )
            name = "run" if shelf == run.scene.demonstrated_shelf else f"run_{shelf}"
            # Neither a camera nor a person takes part.
            recordings[name] = replace(recording, camera=None, nullspace_input=None)
        return recordings

    def sections(
        self, run: PlacingRun, recordings: Mapping[str, RunRecording]
    ) -> Sequence[Section]:
        """Report section: paths and joints on the way to all shelves."""
        figures = {
            "paths": placing_paths_figure(run, self._shelves),
            "joints": placing_joints_figure(run, self._shelves),
        }
        return [worded("shelves", figures)]

    def study(self) -> Study:
        """Trials from random starts."""
        return Study(
            title="Placing on each shelf from random starts",
            trial=RandomStart(self),
            metrics=TRIAL_METRICS,
            text="Each seed draws another start posture near home for each shelf. Motions are "
            "planned in task space.",
        )

    @property
    def _shelves(self) -> Sequence[str]:
        return Workplace.of(self.robot.work_arm()).shelf_names()


@dataclass(frozen=True)
class RandomStart:
    """One trial: place on each shelf, each time from another random start."""

    experiment: PlacingExperiment

    def __call__(self, seed: int) -> Mapping[str, Any]:
        """Metrics of placings in task space."""
        rng, noise = np.random.default_rng(seed), self.experiment.noise
        scene = self.experiment.open_scene(rng)
        outcomes = {}
        for shelf in scene.workplace.shelf_names():
            start = random_start(scene.world, scene.workplace, noise, rng)
            placed = scene.place(shelf, start, space="pose", speed=self.experiment.speed)
            outcomes[shelf] = PlacingOutcome.of(placed, scene)
        evaluation = evaluate(placing_metrics(scene.workplace.shelf_names()), outcomes)
        return {**evaluation.values, "failure": evaluation.failure}


def dataset_of(placing: Path) -> Path:
    """Dataset that a placing skill was learned from; it may no longer exist."""
    return Path(read_made_by(placing)["dataset"])
