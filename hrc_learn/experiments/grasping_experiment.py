"""Experiment 2 of the paper: an object grasped with an uncalibrated camera."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import ClassVar

import numpy as np

from hrc_learn.experiments.experiment import RepeatedRun, Study
from hrc_learn.experiments.grasping_metrics import TRIAL_METRICS, grasping_metrics
from hrc_learn.experiments.grasping_trial import (
    GraspingRun,
    GraspingScene,
    GraspingSceneConfig,
    simulate_grasp,
)
from hrc_learn.experiments.metric_table import Metric
from hrc_learn.experiments.run_recorder import record, region_of_vision
from hrc_learn.experiments.run_report import run_sections
from hrc_learn.experiments.simulated_cell import UNOBSERVED, ArmDriver, Observer, access_by
from hrc_learn.kinematics import ArmChoice
from hrc_learn.log import LoggedSteps, RunRecording
from hrc_learn.sim import CameraKind, Imperfections
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills.grasping import GraspingConfig
from hrc_learn.skills.visual_skill import VisualServoSkill
from hrc_learn.teleoperation.page import PageConfig
from hrc_learn.viz.report import Section


@dataclass(frozen=True, kw_only=True)
class GraspingExperiment:
    """Grasp an object once, seen by a camera that was moved since the demonstrations."""

    title: ClassVar[str] = "Grasping with an uncalibrated camera"
    summary: ClassVar[str] = (
        "The arm starts far from the table and has to grasp an object that it sees with one "
        "fixed camera. The camera was moved, tilted or turned since the demonstrations from "
        "which the image Jacobian was learned, in a manner unknown to the controller. An "
        "approach in joint space brings the end effector near, a region in Cartesian space "
        "into the camera's view, and visual servoing to above the object; then it descends, "
        "grasps and carries the object home. Simulated in MuJoCo; success is read from "
        "contacts and poses there."
    )

    aiming: Path
    """Folder of the visual-servoing skill."""
    scene: GraspingSceneConfig = field(
        default_factory=lambda: GraspingSceneConfig(random_camera=True)
    )
    """Distribution of camera, start and object."""
    imperfections: Imperfections = field(default_factory=Imperfections.nominal)
    """Imperfections of arm, calibration, camera and object."""
    camera: CameraKind = "synthetic"
    config: GraspingConfig = field(default_factory=GraspingConfig)
    page: PageConfig | None = None
    """Serves a page on which people draw and pull the arm too, in real time; None: no page."""
    robot: ArmChoice = field(default_factory=ArmChoice)
    """The arm."""
    arm: ArmDriver = "sim"
    """Driver of the simulated arm: the simulator itself, or a driver of the real arm over its
    network protocol."""

    def run(self, seed: int, observer: Observer = UNOBSERVED) -> GraspingRun:
        """Grasp once; the seed draws the scene, the imperfections and the image noise."""
        rng = np.random.default_rng(seed)
        workplace = Workplace.of(self.robot.work_arm())
        return simulate_grasp(
            VisualServoSkill.load(self.aiming),
            GraspingScene.draw(workplace, self.scene, rng, self.camera, self.imperfections),
            camera=self.camera,
            config=self.config,
            rng=np.random.default_rng([seed, 1]),
            page=self.page,
            access=access_by(self.arm, workplace.robot),
            observer=observer,
        )

    def failure(self, run: GraspingRun) -> str:
        """Reason of the task to give up."""
        return run.failure

    def metrics(self) -> Sequence[Metric[GraspingRun]]:
        """Metrics of the grasp."""
        return grasping_metrics()

    def recordings(self, run: GraspingRun) -> Mapping[str, RunRecording]:
        """Recording of the grasp."""
        region = region_of_vision(run.scene.workplace, self.config.servo)
        return {"run": record("Grasping", run.cell, run.world, run.motion, region=region)}

    def log(self, run: GraspingRun) -> LoggedSteps:
        """Log of the grasp."""
        return run.cell.log

    def sections(
        self, run: GraspingRun, recordings: Mapping[str, RunRecording]
    ) -> Sequence[Section]:
        """Report sections: timeline, servoing, motion."""
        return run_sections(recordings["run"], {run.item.name: (0.0, math.inf)})

    def study(self) -> Study:
        """Trials in random scenes, with the synthetic camera."""
        scene = replace(self.scene, random_camera=True)
        return Study(
            title="Grasps in random scenes",
            trial=RepeatedRun(replace(self, scene=scene, camera="synthetic", page=None)),
            metrics=TRIAL_METRICS,
            text="Each seed draws other imperfections, and another camera, start and object "
            "pose.",
        )
