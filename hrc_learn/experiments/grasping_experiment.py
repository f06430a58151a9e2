"""Experiment 2 of the paper: an object grasped with an uncalibrated camera."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import ClassVar

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from hrc_learn.experiments.experiment import RepeatedRun, Study
from hrc_learn.experiments.grasping_metrics import TRIAL_METRICS, grasping_metrics
from hrc_learn.experiments.grasping_trial import (
    GraspingRun,
    GraspingScene,
    GraspingSceneConfig,
    simulate_grasp,
)
from hrc_learn.experiments.metric_table import Metric
from hrc_learn.experiments.run_recorder import record
from hrc_learn.experiments.simulated_cell import UNOBSERVED, ArmDriver, Observer, access_by
from hrc_learn.geometry import Box
from hrc_learn.kinematics import ArmChoice
from hrc_learn.log import LoggedSteps, RunRecording
from hrc_learn.sim import CameraKind, Imperfections
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills.grasping import GraspingConfig
from hrc_learn.skills.visual_skill import VisualServoSkill
from hrc_learn.teleoperation.page import PageConfig
from hrc_learn.viz import palette
from hrc_learn.viz.figures import (
    STYLE,
    WIDTH,
    draw_box,
    frame_space,
    image_jacobian_figure,
    joints_figure,
    near,
    needed,
    space,
)
from hrc_learn.viz.report import Picture, Section


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
        """Recording of the grasp, with the feedback that guided the arm."""
        x, y, z = run.scene.workplace.hover().position.tolist()
        region = Box(centre=(x, y, z), half_size=self.config.servo.half_size)
        recording = record("Grasping", run.cell, run.world, run.motion, region=region)
        fractions = {
            "fraction of the joint-space approach": run.cell.log["approach"],
            "fraction of vision": run.cell.log["vision_activation"],
        }
        return {"run": replace(recording, potentials={**recording.potentials, **fractions})}

    def log(self, run: GraspingRun) -> LoggedSteps:
        """Log of the grasp."""
        return run.cell.log

    def sections(
        self, run: GraspingRun, recordings: Mapping[str, RunRecording]
    ) -> Sequence[Section]:
        """Report sections: regions, image Jacobian."""
        recording = recordings["run"]
        path = "Path of the tool, from the remote start to home with the object."
        regions = (
            "Fractions of the feedback in the command, and potential of all regions. It jumps "
            "where the end effector moves up and down to learn the effect of its height on "
            "the image."
        )
        jacobian = "The controller's estimate and the simulator's truth."
        return [
            Section(
                heading="From region to region",
                figures=(
                    Picture("path", reach_figure(recording), path),
                    Picture("regions", regions_figure(recording), regions),
                    Picture("joints", joints_figure(recording), "Joint positions and limits."),
                ),
            ),
            Section(
                heading="The image Jacobian",
                text=(
                    "Learned with the camera in another place, it is wrong at first, and is "
                    "then estimated from the motion of the marker."
                ),
                figures=(
                    Picture("image_jacobian", image_jacobian_figure(recording), jacobian),
                ),
            ),
        ]

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


def reach_figure(run: RunRecording) -> Figure:
    """Path of the tool from its remote start, before and after the marker came into view."""
    camera, region = needed(run.camera, "camera"), needed(run.region, "region")
    seen = np.isfinite(camera.feature).all(1) & np.isfinite(camera.target).all(1)
    first = int(seen.argmax()) if seen.any() else len(run.time) - 1
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, 5.0))
        axes = space(figure)
        path = run.position
        for box in near(run.boxes, path):
            draw_box(axes, box, "#8D8F94", alpha=0.08)
        draw_box(axes, region, palette.GREEN, alpha=0.30)
        axes.plot(*path[: first + 1].T, color=palette.ORANGE, label="out of view")
        axes.plot(*path[first:].T, color=palette.RUN, label="since the marker was in view")
        axes.plot(*path[0], "o", color=palette.ORANGE, ms=5)
        axes.plot(*path[-1], "s", color=palette.RUN, ms=5)
        axes.legend(loc="upper left")
        axes.set_title(
            "Path of the tool centre point (dot: start, square: end; green: Cartesian region)",
            loc="left",
        )
        frame_space(axes, path)
    return figure


def regions_figure(run: RunRecording) -> Figure:
    """Fractions of the feedback in the command, and potential of the regions, over time."""
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, 4.2))
        above, below = figure.subplots(2, 1, sharex=True, height_ratios=[1, 1.4])
        for colour, (name, values) in zip(palette.SERIES, run.potentials.items(), strict=False):
            axes = above if name.startswith("fraction") else below
            axes.plot(run.time, values, color=colour, label=name.removeprefix("fraction of "))
        above.set(ylabel="fraction [-]", ylim=(-0.03, 1.08), title="Active feedback")
        below.set(xlabel="time [s]", ylabel="potential [-]", yscale="log", title="Potential")
        for axes in (above, below):
            axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
            for phase in run.phases:
                axes.axvline(phase.time, color=palette.GREY, lw=0.7, ls=":")
        active = np.isfinite(np.stack(list(run.potentials.values()))).any(axis=0)
        if active.any():
            below.set_xlim(run.time[active][0], run.time[active][-1])
    return figure
