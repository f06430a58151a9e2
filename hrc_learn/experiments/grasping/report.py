"""The report of grasps: which region acted when, and sections with their figures."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float

from hrc_learn.experiments.grasping.figures import reach_figure, regions_figure, variants_figure
from hrc_learn.experiments.grasping.trial import VARIANTS, GraspingRun, SimulatedGrasp
from hrc_learn.experiments.run_recording import record
from hrc_learn.geometry import Box
from hrc_learn.kinematics import panda
from hrc_learn.skills.visual_servoing import VisualServoConfig
from hrc_learn.viz import RunRecording
from hrc_learn.viz.figures import image_jacobian_figure, joints_figure
from hrc_learn.viz.report import Picture, Section

SUMMARY = (
    "The arm starts far from the table and has to grasp an object that it sees with one fixed "
    "camera. The camera was moved, tilted or turned since the demonstrations from which the "
    "image Jacobian was learned, and the controller is not told how. An approach in joint "
    "space brings the end effector near, a region in Cartesian space into the camera's view, "
    "and visual servoing to above the object; then it descends, grasps and carries the object "
    "home. Simulated in MuJoCo; success is read from contacts and poses there."
)


@dataclass(frozen=True, kw_only=True, eq=False)
class RegionActivity:
    """Which feedback led the arm, and the regions' potentials; NaN without a target."""

    approach: Float[np.ndarray, " time"]
    """Fraction of the joint-space approach in the command."""
    cartesian: Float[np.ndarray, " time"]
    """Fraction of the Cartesian regions."""
    vision: Float[np.ndarray, " time"]
    """Fraction of the vision region, which acts beside the Cartesian ones."""
    potentials: dict[str, Float[np.ndarray, " time"]]
    """Of each region, by name."""

    @classmethod
    def of(cls, run: SimulatedGrasp, config: VisualServoConfig) -> "RegionActivity":
        """From the log of a grasp."""
        log, above = run.cell.log, run.scene.workplace.hover()
        servoed = np.isfinite(log["target"]).all(axis=1)
        seen = servoed & np.isfinite(log["feature"]).all(axis=1)
        tool = panda.forward(torch.from_numpy(log["joint_position"]))
        goals = config.goals(above, np.zeros(2))
        turn = np.where(servoed, goals.orientation.potential(tool.orientation).numpy(), np.nan)
        vision = np.full_like(turn, np.nan)
        for k in np.flatnonzero(seen):
            region = config.goals(above, log["target"][k]).vision
            vision[k] = float(region.potential(torch.from_numpy(log["feature"][k])))
        # What is left of the sum that the controller logged is the position's.
        level = log["vision_activation"]
        position = log["potential"] - turn - np.nan_to_num(level * vision)
        return cls(
            approach=log["approach"],
            cartesian=1 - log["approach"],
            vision=level,
            potentials={
                "position": position.clip(min=0),
                "orientation": turn,
                "vision": vision,
            },
        )


def record_grasp(run: SimulatedGrasp, config: VisualServoConfig, title: str) -> RunRecording:
    """The recording of a grasp.

    Args:
        run: The grasp.
        config: How it servoed.
        title: Of the recording.
    """
    hover = run.scene.workplace.hover().position.tolist()
    region = Box(centre=(hover[0], hover[1], hover[2]), half_size=config.half_size)
    recording = record(title, run.cell, run.world, run.motion, region=region)
    activity = RegionActivity.of(run, config)
    fractions = {
        "fraction of the joint-space approach": activity.approach,
        "fraction of vision": activity.vision,
    }
    return replace(
        recording, potentials={**recording.potentials, **activity.potentials, **fractions}
    )


def grasping_sections(
    run: GraspingRun, recordings: Mapping[str, RunRecording], config: VisualServoConfig
) -> list[Section]:
    """Comparison of the variants, regions, image Jacobian.

    Args:
        run: The grasps.
        recordings: Of the grasp as "run", of the variants as "compared_NAME".
        config: How the grasp servoed.
    """
    default, activity = recordings["run"], RegionActivity.of(run.grasp, config)
    fractions = {
        "joint space": activity.approach,
        "Cartesian space": activity.cartesian,
        "vision": activity.vision,
    }
    sections = [
        Section(
            heading="From region to region",
            figures=(
                Picture(
                    "path",
                    reach_figure(default),
                    "Path of the tool, from the remote start to home with the object.",
                ),
                Picture(
                    "regions",
                    regions_figure(default, fractions, activity.potentials),
                    "Fractions of the feedback in the command, and potentials of the regions. "
                    "The position's jumps where the end effector is sent up and down to learn "
                    "how height looks in the image.",
                ),
                Picture("joints", joints_figure(default), "Joint positions and limits."),
            ),
        ),
        Section(
            heading="The image Jacobian",
            text=(
                "Learned from a camera that stood elsewhere, it is wrong at first, and is "
                "estimated from the motion of the marker."
            ),
            figures=(
                Picture(
                    "image_jacobian",
                    image_jacobian_figure(default),
                    "The controller's estimate and the simulator's truth.",
                ),
            ),
        ),
    ]
    if not run.compared:
        return sections
    runs = {VARIANTS[name].label: recordings[f"compared_{name}"] for name in run.compared}
    comparison = Section(
        heading="With and without adaptation",
        text=(
            "Object, start and camera are the same for all, and all are told the target pixel: "
            "they differ in nothing but the image Jacobian. An estimate that does not adapt, "
            "or adapts without using the measured motion, as the paper's law does, turns away "
            "from the target where the camera is turned far enough."
        ),
        figures=(
            Picture(
                "variants",
                variants_figure(runs, run.grasp.scene.true_target(run.grasp.world)),
                "Path of the gripper's marker in the image, and its distance from the target.",
            ),
        ),
    )
    return [comparison, *sections]
