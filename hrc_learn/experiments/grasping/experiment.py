"""Experiment 2 of the paper: an object grasped with an uncalibrated camera."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import ClassVar

import numpy as np

from hrc_learn.experiments.arm_access import ArmDriver, access_by
from hrc_learn.experiments.frame import UNOBSERVED, Observer, RepeatedRun, Study
from hrc_learn.experiments.grasping.metrics import CURVES, TRIAL_METRICS, grasping_metrics
from hrc_learn.experiments.grasping.report import SUMMARY, grasping_sections, record_grasp
from hrc_learn.experiments.grasping.trial import (
    DEFAULT,
    VARIANTS,
    GraspingRun,
    GraspingScene,
    GraspingSceneConfig,
    SimulatedGrasp,
    simulate_grasp,
)
from hrc_learn.experiments.metric_table import Metric
from hrc_learn.kinematics import ArmChoice
from hrc_learn.log import LoggedSteps, RunRecording
from hrc_learn.sim import CameraKind, Imperfections
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills.grasping import GraspingConfig
from hrc_learn.skills.visual_skill import VisualServoSkill
from hrc_learn.teleoperation import DrawnInterval
from hrc_learn.teleoperation.page import PageConfig
from hrc_learn.viz.report import Section

_COMPARED_TIMEOUT = 20.0
"""Of servoing by a variant that is only compared [s]: three times as long as the slow ones
need, and some never arrive."""


@dataclass(frozen=True, kw_only=True)
class GraspingExperiment:
    """Grasp once by the default, then servo to the same target by each of the variants."""

    title: ClassVar[str] = "Grasping with an uncalibrated camera"
    summary: ClassVar[str] = SUMMARY

    aiming: Path
    """Folder of the visual-servoing skill."""
    variants: tuple[str, ...] = ()
    """Names in `VARIANTS` to compare."""
    scene: GraspingSceneConfig = field(
        default_factory=lambda: GraspingSceneConfig(random_camera=True)
    )
    """How camera, start and object are drawn."""
    imperfections: Imperfections = field(default_factory=Imperfections.nominal)
    """Of arm, calibration, camera and object."""
    curve: tuple[float, ...] = ()
    """Sizes of the imperfections to repeat with, in multiples of the nominal ones."""
    camera: CameraKind = "synthetic"
    config: GraspingConfig = field(default_factory=GraspingConfig)
    drawings: tuple[DrawnInterval, ...] = ()
    """What a scripted person draws during the grasp, not what it is compared with."""
    page: PageConfig | None = None
    """Serve a page from which people draw and pull the arm too; the grasp takes real time
    then."""
    robot: ArmChoice = field(default_factory=ArmChoice)
    """Which arm does it."""
    arm: ArmDriver = "sim"
    """What leads the simulated arm: the simulator itself, or a driver of the real one over its
    network protocol."""

    def __post_init__(self) -> None:
        if unknown := [name for name in self.variants if name not in VARIANTS]:
            raise ValueError(f"no variant {unknown[0]!r}; there are {', '.join(VARIANTS)}.")

    def run(self, seed: int, observer: Observer = UNOBSERVED) -> GraspingRun:
        """The grasp, then the comparison.

        The seed draws the scene, the imperfections and the image noise.
        """
        observer.tell("The whole grasp")
        grasp, compared = self._grasp(seed, DEFAULT, observer), {}
        for name in dict.fromkeys(self.variants):
            observer.tell(f"Comparison: {VARIANTS[name].label}")
            compared[name] = self._grasp(seed, name)
        return GraspingRun(grasp=grasp, compared=compared)

    def _grasp(
        self, seed: int, variant: str, observer: Observer | None = None
    ) -> SimulatedGrasp:
        """One grasp; for comparison it knows the target, goes straight there and tries once.

        Args:
            seed: Of the scene.
            variant: Of `VARIANTS`.
            observer: Of the grasp itself; None: it is done for comparison.
        """
        config, compared = self.config, observer is None
        observer = observer or UNOBSERVED
        if compared:
            servo = replace(config.servo, probe=0.0, timeout=_COMPARED_TIMEOUT)
            config = replace(config, servo=servo, attempts=1)
        skill, rng = VisualServoSkill.load(self.aiming), np.random.default_rng(seed)
        return simulate_grasp(
            skill,
            GraspingScene.draw(
                Workplace.of(self.robot.work_arm()),
                self.scene,
                rng,
                self.camera,
                self.imperfections,
            ),
            estimator=VARIANTS[variant].estimator(skill.jacobian),
            told_target=compared,
            camera=self.camera,
            config=config,
            rng=np.random.default_rng([seed, 1]),
            drawings=() if compared else self.drawings,
            page=None if compared else self.page,
            access=access_by(self.arm, self.robot.work_arm()),
            view=observer.view,
            on_page=lambda address: observer.tell(f"Page at {address}"),
        )

    def failure(self, run: GraspingRun) -> str:
        """Why the task gave up."""
        return run.grasp.failure

    def metrics(self) -> Sequence[Metric[GraspingRun]]:
        """Of the grasp, and of what it is compared with."""
        return grasping_metrics(tuple(dict.fromkeys(self.variants)))

    def recordings(self, run: GraspingRun) -> Mapping[str, RunRecording]:
        """The grasp and each variant."""
        compared = {
            f"compared_{name}": record_grasp(
                grasp, self.config.servo, f"Visual servoing, {VARIANTS[name].label}"
            )
            for name, grasp in run.compared.items()
        }
        return {"run": record_grasp(run.grasp, self.config.servo, "Grasping"), **compared}

    def log(self, run: GraspingRun) -> LoggedSteps:
        """Of the grasp."""
        return run.grasp.cell.log

    def sections(
        self, run: GraspingRun, recordings: Mapping[str, RunRecording]
    ) -> Sequence[Section]:
        """Comparison, regions, image Jacobian."""
        return grasping_sections(run, recordings, self.config.servo)

    def studies(self) -> Mapping[str, Study]:
        """Grasps by the default alone, in random scenes, with the synthetic camera.

        With each size of the imperfections.
        """
        scene = replace(self.scene, random_camera=True)
        trial = replace(self, variants=(), scene=scene, camera="synthetic", curve=(), page=None)
        study = Study(
            title="Grasps in random scenes",
            trial=RepeatedRun(trial),
            metrics=TRIAL_METRICS,
            text="For each seed other imperfections, another camera, start and object pose.",
            shown=CURVES,
        )
        return study.at_sizes(self.curve)
