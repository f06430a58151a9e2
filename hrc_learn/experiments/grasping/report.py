"""The report on grasping, and its recording."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float

from hrc_learn.experiments.grasping import figures as grasping_figures
from hrc_learn.experiments.grasping.experiment import VARIANTS, GraspingExperiment
from hrc_learn.experiments.grasping.trial import SimulatedGrasp
from hrc_learn.experiments.monte_carlo import Summary, Trial
from hrc_learn.experiments.run_recording import record
from hrc_learn.geometry import Box
from hrc_learn.kinematics import panda
from hrc_learn.skills.visual_servoing import VisualServoConfig
from hrc_learn.viz import RunRecording, figures
from hrc_learn.viz.report import Measurement, Picture, Report, Section, software_versions

# A grasp as it is shown: what every run records, and which region pulled when.


@dataclass(frozen=True, kw_only=True, eq=False)
class RegionActivity:
    """Which feedback led the arm, and how far it still was; NaN while nothing was aimed at."""

    approach: Float[np.ndarray, " time"]
    """Share of the joint-space approach."""
    cartesian: Float[np.ndarray, " time"]
    """Share of the Cartesian regions."""
    vision: Float[np.ndarray, " time"]
    """Share of the vision region, which acts beside the Cartesian ones."""
    potentials: dict[str, Float[np.ndarray, " time"]]
    """Of each region."""

    @classmethod
    def of(cls, run: SimulatedGrasp, config: VisualServoConfig) -> "RegionActivity":
        """From what was logged."""
        log, above = run.cell.log, run.setting.workplace.hover()
        aimed = np.isfinite(log["target"]).all(axis=1)
        seen = aimed & np.isfinite(log["feature"]).all(axis=1)
        hand = panda.forward(torch.from_numpy(log["joint_position"]))
        goals = config.goals(above, np.zeros(2))
        turned = np.where(aimed, goals.orientation.potential(hand.orientation).numpy(), np.nan)
        vision = np.full_like(turned, np.nan)
        for k in np.flatnonzero(seen):
            region = config.goals(above, log["target"][k]).vision
            vision[k] = float(region.potential(torch.from_numpy(log["feature"][k])))
        level = log["vision_activation"]
        position = log["potential"] - turned - np.nan_to_num(level * vision)
        return cls(
            approach=log["approach"],
            cartesian=1 - log["approach"],
            vision=level,
            potentials={
                "position": position.clip(min=0),
                "orientation": turned,
                "vision": vision,
            },
        )


def record_grasp(run: SimulatedGrasp, config: VisualServoConfig, title: str) -> RunRecording:
    """Everything worth looking at in a grasp.

    Args:
        run: What happened.
        config: How it was aimed.
        title: What it was.
    """
    hover = run.setting.workplace.hover().position.tolist()
    region = Box(centre=(hover[0], hover[1], hover[2]), half_size=config.half_size)
    recording = record(title, run.cell, run.world, run.motion, region=region)
    activity = RegionActivity.of(run, config)
    shares = {
        "share of the joint-space approach": activity.approach,
        "share of the camera": activity.vision,
    }
    return replace(
        recording, potentials={**recording.potentials, **activity.potentials, **shares}
    )


# The report on grasping: what happened in one setting, and how often it works in many.


def grasping_report(
    experiment: GraspingExperiment,
    table: Sequence[Measurement],
    *,
    trials: Sequence[Trial] = (),
    configuration: Mapping[str, object],
    command: str,
) -> Report:
    """Figures, table and how to do it again.

    Args:
        experiment: What happened.
        table: What was measured.
        trials: Of many settings.
        configuration: Of the run.
        command: That repeats it.
    """
    aiming = experiment.trials.config.servo
    runs = {
        VARIANTS[name].says: record_grasp(run, aiming, name)
        for name, run in experiment.compared.items()
    }
    default = record_grasp(experiment.grasp, aiming, "grasp")
    activity = RegionActivity.of(experiment.grasp, aiming)
    shares = {
        "joint space": activity.approach,
        "Cartesian space": activity.cartesian,
        "vision": activity.vision,
    }
    return Report(
        title="Grasping with a camera that nobody calibrated",
        summary=(
            "The arm starts far from the table and has to grasp an object that it sees with "
            "one fixed camera. The camera was moved, tilted or turned since the demonstrations "
            "from which the image Jacobian was learned, and the controller is not told how. "
            "An approach in joint space brings the hand near, a region in Cartesian space into "
            "the camera's view, and the image to above the object; then the hand goes down, "
            "grasps and carries the object home. Simulated in MuJoCo; success is read from "
            "contacts and poses there."
        ),
        table=table,
        sections=(
            *([_compared(experiment, runs)] if runs else []),
            Section(
                heading="From region to region",
                figures=(
                    Picture(
                        "path",
                        grasping_figures.reach_figure(default),
                        "Path of the tool, from the remote start to home with the object.",
                    ),
                    Picture(
                        "regions",
                        grasping_figures.regions_figure(default, shares, activity.potentials),
                        "Shares of the feedback in the command, and potentials of the regions. "
                        "The position's jumps where the hand is sent up and down to learn how "
                        "height looks.",
                    ),
                    Picture(
                        "joints",
                        figures.joints_figure(default),
                        "Joint positions and their limits.",
                    ),
                ),
            ),
            Section(
                heading="The image Jacobian",
                text=(
                    "Learned from a camera that stood elsewhere, it is wrong at first, and "
                    "found from the motion of the marker."
                ),
                figures=(
                    Picture(
                        "image_jacobian",
                        figures.image_jacobian_figure(default),
                        "The controller's estimate, and the simulator's truth.",
                    ),
                ),
            ),
            *([_repeated(trials)] if trials else []),
        ),
        configuration=configuration,
        versions=software_versions(),
        command=command,
    )


def _compared(experiment: GraspingExperiment, runs: Mapping[str, RunRecording]) -> Section:
    return Section(
        heading="With and without adaptation",
        text=(
            "The same object, start and camera for all, and all are told the pixel to aim at: "
            "they differ in nothing but the image Jacobian. What does not adapt, or adapts "
            "without looking at the measured motion, as the paper's law does, turns away from "
            "the target where the camera is turned far enough."
        ),
        figures=(
            Picture(
                "variants",
                grasping_figures.variants_figure(runs, experiment.target),
                "Path of the hand's marker in the image, and its distance from the target.",
            ),
        ),
    )


def _repeated(trials: Sequence[Trial]) -> Section:
    summary = Summary.of(trials)
    low, high = summary.interval
    reasons = "\n\n".join(f"Seed {seed}: {why}" for seed, why in summary.failed.items())
    return Section(
        heading="Many settings",
        text=(
            f"{summary.successes} of {summary.trials} grasps succeeded ({100 * low:.1f} to "
            f"{100 * high:.1f} % with 95 % confidence), each with another camera, start and "
            f"object.\n\n{reasons}"
        ).strip(),
    )
