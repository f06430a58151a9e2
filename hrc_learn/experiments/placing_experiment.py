"""Experiment 1 of the paper: the demonstrated shelf, then the others, planned in two spaces.

In joint space with a shifted goal, as in the paper, and in task space with the learned
null-space posture.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar

import matplotlib
import numpy as np
import torch
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from hrc_learn.demos import Demonstration, load_demos
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
    SimulatedPlacing,
    demonstrated_path,
    demonstrated_shelf,
    place,
    random_start,
    taught_correction,
)
from hrc_learn.experiments.run_recorder import joint_ranges, record
from hrc_learn.experiments.simulated_cell import UNOBSERVED, ArmDriver, Observer, access_by
from hrc_learn.kinematics import ArmChoice
from hrc_learn.log import LoggedSteps, RunRecording
from hrc_learn.sim import Imperfections, World
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills.placing import PlaceCorrection, PlacingSkill, PlanningSpace
from hrc_learn.store import read_made_by
from hrc_learn.viz import palette
from hrc_learn.viz.figures import (
    STYLE,
    WIDTH,
    JointCurves,
    demonstrated_joints,
    draw_box,
    frame_space,
    joint_grid_figure,
    near,
    space,
)
from hrc_learn.viz.report import Picture, Section

_COLOURS = (palette.ORANGE, palette.BLUE, palette.PURPLE, palette.GREEN)
"""Colours of the shelves, from bottom to top."""


@dataclass(frozen=True, kw_only=True)
class PlacingExperiment:
    """Place the object on every shelf, planned in both spaces."""

    title: ClassVar[str] = "Placing: demonstrated once, reproduced faster, on other shelves"
    summary: ClassVar[str] = (
        "An expert guides the end effector of an arm into a cabinet and at the same time moves "
        "its elbow around the open door. A movement primitive learned from that reproduces the "
        "motion faster and more smoothly, and adapts it to the shelves above and below: in "
        "task space with the learned null-space posture, and, for comparison, in joint space "
        "with a shifted goal, as in the paper.\n\n"
        "Everything runs in MuJoCo with the object held by friction; contacts, poses and the "
        "place of the object are read from the simulator. Values are for task space and the "
        "worst shelf unless stated otherwise."
    )

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
        for planned, label in SPACES.items():
            for shelf in scene.workplace.shelf_names():
                observer.tell(f"Placing on the {shelf} shelf, planned in {label}")
                viewed = (planned, shelf) == ("joint", scene.demonstrated_shelf)
                placed = place(
                    scene.skill,
                    scene.workplace,
                    shelf,
                    torch.from_numpy(joints[0]),
                    space=planned,
                    speed=self.speed,
                    world=scene.world,
                    correction=scene.correction,
                    access=access_by(self.arm, scene.skill.robot),
                    observer=observer if viewed else UNOBSERVED,
                )
                placings[planned, shelf] = placed
                outcomes[planned][shelf] = PlacingOutcome.of(
                    placed, scene.workplace, scene.demonstration
                )
        return PlacingRun(
            workplace=scene.workplace,
            demonstration=scene.demonstration,
            demonstrated_shelf=scene.demonstrated_shelf,
            placings=placings,
            outcomes=outcomes,
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
        recordings = {}
        for shelf in run.workplace.shelf_names():
            placed = run.placings["pose", shelf]
            recording = record(
                f"Placing on the {shelf} shelf",
                placed.cell,
                placed.world,
                placed.motion,
                plans=[placed.plan],
                demonstration=run.demonstration,
            )
            name = "run" if shelf == run.demonstrated_shelf else f"run_{shelf}"
            # Neither a camera nor a person takes part.
            recordings[name] = replace(recording, camera=None, nullspace_input=None)
        return recordings

    def log(self, run: PlacingRun) -> LoggedSteps:
        """Log of the reproduction."""
        return run.reproduction.cell.log

    def sections(
        self, run: PlacingRun, recordings: Mapping[str, RunRecording]
    ) -> Sequence[Section]:
        """Report section: paths and joints on the way to all shelves."""
        paths = Picture(
            "paths",
            paths_figure(run),
            "Paths of the end effector. A shifted goal bends the joint-space motion; in task "
            "space the approach keeps its shape.",
        )
        joints = Picture(
            "joints",
            joints_figure(run),
            "Joints, planned in task space: the demonstration, and the faster motions to three "
            "goals.",
        )
        text = (
            "One demonstration on one shelf, three goals. Goals in joint space come from the "
            "analytic inverse kinematics. The paper keeps joint 7 fixed, with which this arm "
            "does not reach all shelves, so it is free here."
        )
        return [Section(heading="Other shelves", text=text, figures=(paths, joints))]

    def study(self) -> Study:
        """Trials from random starts."""
        return Study(
            title="Placing on each shelf from random starts",
            trial=RandomStart(self),
            metrics=TRIAL_METRICS,
            text="Every joint of the start is drawn about home; planned in task space.",
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


@dataclass(frozen=True)
class RandomStart:
    """One trial: place on each shelf, each time from another random start."""

    experiment: PlacingExperiment

    def __call__(self, seed: int) -> Mapping[str, Any]:
        """Metrics of placings in task space."""
        rng = np.random.default_rng(seed)
        scene = self.experiment.open_scene(rng)
        outcomes = {}
        for shelf in scene.workplace.shelf_names():
            placed = place(
                scene.skill,
                scene.workplace,
                shelf,
                random_start(scene.world, scene.workplace, self.experiment.noise, rng),
                space="pose",
                speed=self.experiment.speed,
                world=scene.world,
                correction=scene.correction,
            )
            outcomes[shelf] = PlacingOutcome.of(placed, scene.workplace, scene.demonstration)
        evaluation = evaluate(placing_metrics(scene.workplace.shelf_names()), outcomes)
        return {**evaluation.values, "failure": evaluation.failure}


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


def paths_figure(run: PlacingRun) -> Figure:
    """Paths of the end effector, one panel for each planning space."""
    shown = demonstrated_path(run.demonstration, run.workplace.robot.chain)
    paths = {key: placed.path for key, placed in run.placings.items()}
    points = np.concatenate([shown, *paths.values()])
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, 4.5))
        for i, (planned, label) in enumerate(SPACES.items()):
            axes = space(figure, position=(1, len(SPACES), 1 + i))
            for box in near(tuple(run.workplace.scene.cabinet.boxes()), points):
                draw_box(axes, box, "#8D8F94", alpha=0.08)
            axes.plot(*shown.T, color=palette.DEMO, lw=5, label="demonstration")
            for shelf, colour in zip(run.workplace.shelf_names(), _COLOURS, strict=False):
                path = paths[planned, shelf]
                axes.plot(*path.T, color=colour, lw=1.8, label=f"{shelf} shelf")
                axes.plot(*path[-1], "s", color=colour, ms=4)
            axes.set_title(label.capitalize(), loc="left")
            frame_space(axes, points, zoom=1.0)
            axes.xaxis.set_major_locator(MaxNLocator(3))
            axes.view_init(elev=16, azim=62)
        handles, labels = figure.axes[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper center", ncols=len(labels))
    return figure


def joints_figure(run: PlacingRun) -> Figure:
    """Joint positions over time: the demonstration, and the motion to each shelf."""
    shown, chain = run.demonstration, run.workplace.robot.chain
    assert shown.joint_position is not None
    curves = [demonstrated_joints(shown.time - shown.time[0], shown.joint_position)]
    for shelf, colour in zip(run.workplace.shelf_names(), _COLOURS, strict=False):
        placed = run.placings["pose", shelf]
        curves.append(
            JointCurves(
                label=f"{shelf} shelf",
                time=placed.time,
                position=placed.joint_position,
                colour=colour,
            )
        )
    return joint_grid_figure(chain.joint_names, curves, joint_ranges(chain))
