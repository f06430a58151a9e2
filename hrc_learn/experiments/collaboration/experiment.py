"""Experiment 3 of the paper: objects grasped beside a person and placed on shelves."""

import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import ClassVar, Literal

from hrc_learn.demos import Demonstration, load_demos
from hrc_learn.experiments.arm_access import ArmDriver, access_by
from hrc_learn.experiments.collaboration.metrics import (
    CURVES,
    TRIAL_METRICS,
    collaboration_metrics,
)
from hrc_learn.experiments.collaboration.report import SUMMARY, collaboration_sections
from hrc_learn.experiments.collaboration.snapshots import take_snapshots
from hrc_learn.experiments.collaboration.trial import (
    DRAGS_BESIDE_WORKER,
    NULL_SPACE_FORCES,
    CollaborationRun,
    Disturbances,
    Pulls,
    simulate_collaboration,
    workplace_for,
)
from hrc_learn.experiments.frame import UNOBSERVED, Observer, RepeatedRun, Study
from hrc_learn.experiments.metric_table import Metric
from hrc_learn.experiments.run_recording import record, worker_distance
from hrc_learn.geometry import Box
from hrc_learn.kinematics import ArmChoice
from hrc_learn.log import LoggedSteps, RunRecording
from hrc_learn.sim import CameraKind, Imperfections, RenderingUnavailableError
from hrc_learn.skills.pick_and_place import PickAndPlaceConfig
from hrc_learn.skills.placing import PlacingSkill
from hrc_learn.skills.visual_skill import VisualServoSkill
from hrc_learn.skills.work_cell import WorkCellConfig
from hrc_learn.store import read_made_by
from hrc_learn.teleoperation import DrawnInterval, ForceMapping, ScriptedForce
from hrc_learn.teleoperation.hand_guiding import DEFAULT_MAPPING
from hrc_learn.teleoperation.page import PageConfig
from hrc_learn.viz.report import Section

# Time for the elbow to come to rest after the last drag [s], as after the two without a worker.
_AFTER_DRAGS = 1.0


@dataclass(frozen=True, kw_only=True)
class CollaborationExperiment:
    """Grasp each object beside a person, carry it to the cabinet, place it on its shelf."""

    title: ClassVar[str] = "Collaboration: grasping and placing beside a person"
    summary: ClassVar[str] = SUMMARY

    aiming: Path
    """Folder of the visual-servoing skill."""
    placing: Path
    """Folder of the placing skill."""
    shelves: tuple[str, ...] = ("middle",)
    """One for each of up to three objects."""
    shelf_x: float | None = None
    """Where along the boards objects are placed [m]; None: as the cell is laid out."""
    shelf_depth: float | None = None
    """How far behind the boards' front edge [m]; likewise."""
    pulls: Pulls = "scripted"
    """When the scripted person pulls the elbow."""
    mapping: ForceMapping = DEFAULT_MAPPING
    """How these pulls act."""
    worker: bool = False
    """Whether a worker comes to the table, another one each time, and reaches under the arm."""
    handover: bool = False
    """Whether the last object is in a person's hand, who hands it over."""
    disturbances: Disturbances = field(default_factory=Disturbances)
    imperfections: Imperfections = field(default_factory=Imperfections.nominal)
    """Of arm, calibration, camera and objects."""
    curve: tuple[float, ...] = ()
    """Sizes of the imperfections with which to repeat it, in multiples of the nominal ones."""
    cell: WorkCellConfig = field(default_factory=WorkCellConfig)
    config: PickAndPlaceConfig = field(default_factory=PickAndPlaceConfig)
    camera: CameraKind = "auto"
    drawings: tuple[DrawnInterval, ...] = ()
    """What a scripted person draws, in the time of the run."""
    page: PageConfig | None = None
    """Serve a page from which people push the elbow and draw too; the run takes real time
    then."""
    robot: ArmChoice = field(default_factory=ArmChoice)
    """Which arm does it."""
    arm: ArmDriver = "sim"
    """What leads the simulated arm: the simulator itself, or a driver of the real one over its
    network protocol."""

    def run(self, seed: int, observer: Observer = UNOBSERVED) -> CollaborationRun:
        """The whole job once; the seed draws the objects' poses and the image noise."""
        # As many images whatever the number of objects: 200 of them take 1 GB of memory.
        keep_every = self.cell.keep_image_every * len(self.shelves)
        return simulate_collaboration(
            VisualServoSkill.load(self.aiming),
            PlacingSkill.load(self.placing, self.robot.work_arm()),
            self.shelves,
            workplace=workplace_for(
                self.shelves, self.robot.work_arm(), self.shelf_x, self.shelf_depth
            ),
            camera=self.camera,
            forces=self._forces(),
            disturbances=self.disturbances,
            config=self._job(),
            imperfections=self.imperfections,
            worker=self.worker,
            handover=self.handover,
            cell_config=replace(self.cell, keep_image_every=keep_every),
            mapping=self.mapping,
            drawings=self.drawings,
            seed=seed,
            page=self.page,
            access=access_by(self.arm, self.robot.work_arm()),
            view=observer.view,
            on_phase=lambda phase, time: observer.tell(f"  {time:6.2f} s  {phase}"),
            on_page=lambda address: observer.tell(f"Page at {address}"),
        )

    def failure(self, run: CollaborationRun) -> str:
        """Why objects were not delivered, as the robot sees it."""
        return run.failure

    def metrics(self) -> Sequence[Metric[CollaborationRun]]:
        """Contacts, errors, the person's influence."""
        fit = json.loads((self.placing / "metrics.json").read_text(encoding="utf-8"))
        return collaboration_metrics(len(self.shelves), fit["joint_nrmse_median"])

    def recordings(self, run: CollaborationRun) -> Mapping[str, RunRecording]:
        """The whole job."""
        # The box above the table in which the vision region takes over.
        x, y, z = run.workplace.hover().position.tolist()
        region = Box(centre=(x, y, z), half_size=self.config.grasping.servo.half_size)
        recording = record(
            f"Collaboration, placing on {', '.join(self.shelves)}",
            run.cell,
            run.world,
            run.motion,
            plans=[pick.plan for pick in run.picks if pick.plan is not None],
            cameras=run.cameras,
            region=region,
            demonstration=self._demonstration(),
        )
        return {"run": recording}

    def log(self, run: CollaborationRun) -> LoggedSteps:
        """Of the whole job; with a worker, how near he was and was believed to be [m]."""
        log = run.cell.log
        if run.visit is None:
            return log
        return log.with_columns(person_distance_true=worker_distance(run.motion, len(log)))

    def sections(
        self, run: CollaborationRun, recordings: Mapping[str, RunRecording]
    ) -> Sequence[Section]:
        """Timeline, grasping, person, worker, placing."""
        snapshots = []
        if run.visit is not None and len(run.visit.markers) and len(run.cell.log):
            try:
                snapshots = take_snapshots(run)
            except RenderingUnavailableError as error:
                print(f"note: no pictures of the worker, as {error}", file=sys.stderr)
        return collaboration_sections(run, recordings["run"], snapshots)

    def studies(self) -> Mapping[str, Study]:
        """Other poses of the objects and other noise, with each size of the imperfections."""
        cell = replace(self.cell, keep_image_every=0)
        study = Study(
            title="Collaborations with other seeds",
            trial=RepeatedRun(replace(self, cell=cell, page=None, curve=())),
            metrics=TRIAL_METRICS,
            text="Other imperfections, poses of the objects and image noise.",
            shown=CURVES,
        )
        return study.at_sizes(self.curve)

    def _forces(self) -> Sequence[ScriptedForce] | Literal["random"]:
        """Of the person on the elbow."""
        drags = DRAGS_BESIDE_WORKER if self.worker else NULL_SPACE_FORCES
        return {"none": (), "random": "random", "scripted": drags}[self.pulls]

    def _job(self) -> PickAndPlaceConfig:
        """With the time that the drags take, also where nobody drags: runs can be compared."""
        if not self.worker:
            return self.config
        end = DRAGS_BESIDE_WORKER[-1].end + _AFTER_DRAGS
        return replace(self.config, interaction=max(self.config.interaction, end))

    def _demonstration(self) -> Demonstration | None:
        """The first one that the placing motion was learned from, if it is still there."""
        dataset = Path(read_made_by(self.placing)["dataset"])
        return load_demos(dataset, episodes=[0])[0] if dataset.is_dir() else None
