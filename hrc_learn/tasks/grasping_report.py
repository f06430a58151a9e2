"""The report on grasping: what happened in one setting, and how often it works in many."""

from collections.abc import Mapping, Sequence

from ..viz import RunRecording, figures, grasping_figures
from ..viz.report import Measurement, Picture, Report, Section, software_versions
from .grasping_experiment import GraspingExperiment
from .grasping_recording import RegionActivity, record_grasp
from .grasping_variants import VARIANTS
from .repetition_summary import Summary
from .trial_file import Trial


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
    aiming = experiment.trials.config.aiming
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
