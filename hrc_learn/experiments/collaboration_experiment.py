"""Experiment 3 of the paper: objects grasped near a person and placed on shelves."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import ClassVar, Literal

from hrc_learn.demos import Demonstration, load_demos
from hrc_learn.experiments.collaboration_metrics import TRIAL_METRICS, collaboration_metrics
from hrc_learn.experiments.collaboration_trial import (
    DRAGS_NEAR_WORKER,
    NULL_SPACE_FORCES,
    CollaborationRun,
    CollaborationScenario,
    simulate_collaboration,
)
from hrc_learn.experiments.experiment import RepeatedRun, Study
from hrc_learn.experiments.metric_table import Metric
from hrc_learn.experiments.run_recorder import record, region_of_vision
from hrc_learn.experiments.run_report import SUMMARIES, run_sections, worded
from hrc_learn.experiments.simulated_cell import UNOBSERVED, ArmDriver, Observer, access_by
from hrc_learn.experiments.surroundings import unmarked_for, workplace_for
from hrc_learn.kinematics import ArmChoice
from hrc_learn.log import RunRecording
from hrc_learn.sim import Imperfections
from hrc_learn.sim.scene import UnmarkedLook
from hrc_learn.skills.pick_and_place import PickAndPlaceConfig
from hrc_learn.skills.placing import PlacingSkill
from hrc_learn.skills.visual_skill import VisualServoSkill
from hrc_learn.store import read_json, read_made_by
from hrc_learn.teleoperation import ScriptedForce
from hrc_learn.viz.report import Section

Pulls = Literal["scripted", "random", "none"]
"""Times at which a scripted person pulls the elbow: while the robot waits above the first
object, at random moments of the whole job, or never."""

# Time for the elbow to come to rest after the last drag [s]; equal with and without a worker.
_AFTER_DRAGS = 1.0


@dataclass(frozen=True, kw_only=True)
class _FitMetrics:
    joint_nrmse_median: float


@dataclass(frozen=True, kw_only=True)
class CollaborationExperiment(CollaborationScenario):
    """Grasp each object near a person, carry it to the cabinet, place it on its shelf."""

    title: ClassVar[str] = "Collaboration: grasping and placing near a person"
    summary: ClassVar[str] = SUMMARIES["collaboration"]

    aiming: Path
    """Folder of the visual-servoing skill."""
    placing: Path
    """Folder of the placing skill."""
    shelves: tuple[str, ...] = ("middle",)
    """Shelf of each object; at most three objects."""
    pulls: Pulls = "scripted"
    """Times at which the scripted person pulls the elbow; overrides `forces`."""
    imperfections: Imperfections = field(default_factory=Imperfections.nominal)
    """Imperfections of arm, calibration, camera and objects."""
    robot: ArmChoice = field(default_factory=ArmChoice)
    """The arm."""
    arm: ArmDriver = "sim"
    """Driver of the simulated arm: the simulator itself, or a driver of the real arm over its
    network protocol."""

    look: UnmarkedLook | None = None
    """Look of a scene without markers; None: tool and objects carry markers."""

    def run(self, seed: int, observer: Observer = UNOBSERVED) -> CollaborationRun:
        """Do the whole job once; the seed draws object poses, imperfections and image noise."""
        # Keep the same number of images for any number of objects: 200 images take 1 GB.
        keep_every = self.cell.keep_image_every * len(self.shelves)
        robot = self.robot.work_arm()
        scenario = replace(
            self,
            forces=self._forces(),
            config=self._job(),
            cell=replace(self.cell, keep_image_every=keep_every),
        )
        skill = VisualServoSkill.load(self.aiming)
        workplace = workplace_for(self.shelves, robot)
        if self.look is not None:
            workplace = unmarked_for(workplace, skill, self.look, seed)
            scenario = replace(scenario, camera="egl")
        return simulate_collaboration(
            skill,
            PlacingSkill.load(self.placing, robot),
            self.shelves,
            scenario,
            workplace=workplace,
            access=access_by(self.arm, robot),
            seed=seed,
            observer=observer,
        )

    def metrics(self) -> Sequence[Metric[CollaborationRun]]:
        """Metrics of contacts, errors and the influence of the person."""
        fit = read_json(self.placing / "metrics.json", _FitMetrics, "fit again")
        return collaboration_metrics(len(self.shelves), fit.joint_nrmse_median)

    def recordings(self, run: CollaborationRun) -> Mapping[str, RunRecording]:
        """Recording of the whole job."""
        recording = record(
            f"Collaboration, shelves: {', '.join(self.shelves)}",
            run.cell,
            run.world,
            run.motion,
            plans=[pick.plan for pick in run.picks if pick.plan is not None],
            cameras=run.cameras,
            region=region_of_vision(run.workplace, self.config.grasping.servo),
            demonstration=self._demonstration(),
        )
        return {"run": recording}

    def sections(
        self, run: CollaborationRun, recordings: Mapping[str, RunRecording]
    ) -> Sequence[Section]:
        """Report sections: timeline, grasping, person, worker, motion, missing null space."""
        notes = [
            f"At {note.time:.1f} s ({pick.item.name}), {note.mishap}: {note.what}."
            for pick in run.picks
            for note in pick.recoveries
        ]
        spans = {pick.item.name: pick.span for pick in run.picks}
        robot = run.workplace.robot
        sections = run_sections(recordings["run"], spans, notes)
        if robot.null_space == "none":
            topic = "nearest_pose" if robot.task == "nearest pose" else "no_null_space"
            more = f" The {robot.name} has {robot.joints} joints."
            sections.append(worded(topic, {}, more))
        return sections

    def study(self) -> Study:
        """Trials with other object poses, imperfections and noise."""
        cell = replace(self.cell, keep_image_every=0)
        return Study(
            title="Collaborations with other seeds",
            trial=RepeatedRun(replace(self, cell=cell, page=None)),
            metrics=TRIAL_METRICS,
            text="Each seed draws other imperfections, object poses and image noise.",
        )

    def _forces(self) -> Sequence[ScriptedForce] | Literal["random"]:
        """Forces of the person on the elbow."""
        drags = DRAGS_NEAR_WORKER if self.worker else NULL_SPACE_FORCES
        return {"none": (), "random": "random", "scripted": drags}[self.pulls]

    def _job(self) -> PickAndPlaceConfig:
        """Job that waits equally long with and without drags, so that runs are comparable."""
        if not self.worker:
            return self.config
        end = DRAGS_NEAR_WORKER[-1].end + _AFTER_DRAGS
        return replace(self.config, interaction=max(self.config.interaction, end))

    def _demonstration(self) -> Demonstration | None:
        """First demonstration of the placing motion, if its dataset still exists."""
        dataset = Path(read_made_by(self.placing)["dataset"])
        return load_demos(dataset, episodes=[0])[0] if dataset.is_dir() else None
