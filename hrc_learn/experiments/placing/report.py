"""The report of placings: recordings, and sections with their figures."""

from collections.abc import Sequence

import numpy as np

from hrc_learn.demos import Demonstration
from hrc_learn.experiments.metric_table import column
from hrc_learn.experiments.monte_carlo import Trial
from hrc_learn.experiments.placing.figures import (
    ApproachDistance,
    Motion,
    Snapshots,
    approach_figure,
    shelf_joints_figure,
    shelf_paths_figure,
    smoothness_figure,
    trials_figure,
)
from hrc_learn.experiments.placing.metrics import (
    DEVIATION_MM,
    PLACE_ERROR_MM,
    PLACE_TILT_DEG,
)
from hrc_learn.experiments.placing.trial import (
    SPACES,
    PlacingRun,
    SimulatedPlacing,
    approach_path,
    demonstrated_approach,
    demonstrated_path,
)
from hrc_learn.experiments.run_recording import demonstrated_joints, drawn_limits, true_tool
from hrc_learn.experiments.snapshots import snapshots_figure
from hrc_learn.geometry import Box
from hrc_learn.log import RunRecording
from hrc_learn.skills.work_cell import SAFETY_COLUMNS
from hrc_learn.viz.report import Picture, Section

SUMMARY = (
    "An expert leads the end effector of an arm into a cabinet and at the same time moves its "
    "elbow around the open door. A movement primitive learned from that reproduces the motion "
    "faster and more smoothly, and adapts it to the shelves above and below: in task space "
    "with the learned null-space posture, and, for comparison, in joint space with a shifted "
    "goal, as in the paper.\n\n"
    "Everything runs in MuJoCo with the object held by friction; contacts, poses and where the "
    "object stands are read from the simulator. Values are of task space and of the worst "
    "shelf unless they say otherwise."
)


def record_placing(
    run: SimulatedPlacing, demonstration: Demonstration, boxes: tuple[Box, ...]
) -> RunRecording:
    """The recording of a placing, beside the demonstration.

    Args:
        run: The placing.
        demonstration: One that the motion was learned from.
        boxes: What stands around.
    """
    log = run.cell.log
    joints, safety = log["joint_position"], log["safety"]
    tool = true_tool(run.motion, run.world, len(log))
    demonstrated = np.full_like(joints, np.nan)
    demonstrated[run.transfer] = demonstrated_joints(demonstration, run.time / run.time[-1])
    return RunRecording(
        title=f"Placing on the {run.shelf} shelf",
        time=log["time"],
        joint_names=run.cell.chain.joint_names,
        joint_position=joints,
        joint_limits=drawn_limits(run.cell.chain),
        demo_joint_position=demonstrated,
        position=tool.position.numpy(),
        demo_path=demonstrated_path(demonstration, run.cell.chain),
        plan_path=run.plan.tool_pose.position.numpy(),
        bodies=run.motion.bodies(),
        boxes=boxes,
        safety={name: safety[:, i] for i, name in enumerate(SAFETY_COLUMNS)},
        phases=tuple(log.events),
    )


def placing_sections(run: PlacingRun, snapshots: Snapshots) -> list[Section]:
    """Shelves, approach, smoothness, null-space posture.

    Args:
        run: What happened.
        snapshots: Rendered pictures; empty where this machine cannot render.
    """
    demonstration = Motion(
        time=run.demonstration.time - run.demonstration.time[0],
        joint_position=np.asarray(run.demonstration.joint_position),
        path=demonstrated_path(run.demonstration, run.workplace.robot.chain),
    )
    sections = [
        _shelves(run, demonstration, snapshots),
        _approach(run),
        Section(
            heading="Faster and smoother than demonstrated",
            text="The primitive leaves out the tremor of the person's hand that led the arm.",
            figures=(
                Picture(
                    "smoothness",
                    smoothness_figure(demonstration, _motion(run.reproduction)),
                    "Speed and jerk of the end effector, scaled by duration and length.",
                ),
                *_pictures(
                    snapshots, "snapshots", "The demonstration, and the faster reproduction."
                ),
            ),
        ),
    ]
    if "null_space_posture" in snapshots:
        posture = Section(
            heading="Null-space posture",
            text=(
                "The same motion of the end effector, demonstrated with and without moving "
                "the elbow aside. The link that touches the cabinet is coloured."
            ),
            figures=_pictures(
                snapshots,
                "null_space_posture",
                "Without the null-space posture the arm is stopped by the open door.",
            ),
        )
        sections.append(posture)
    return sections


def _shelves(run: PlacingRun, demonstration: Motion, snapshots: Snapshots) -> Section:
    motions = {
        label: {
            shelf: _motion(run.placings[space, shelf]) for shelf in run.workplace.shelf_names()
        }
        for space, label in SPACES.items()
    }
    shelves = " and the ".join(run.same_joint7)
    return Section(
        heading="Other shelves",
        text=(
            "One demonstration on one shelf, three goals. Goals in joint space come from the "
            "analytic inverse kinematics. The paper keeps joint 7 fixed; where the "
            "demonstration left it, this arm reaches "
            f"{f'the {shelves} shelf' if shelves else 'no shelf'} only, so it is free here."
        ),
        figures=(
            Picture(
                "paths",
                shelf_paths_figure(
                    demonstration, motions, tuple(run.workplace.scene.cabinet.boxes())
                ),
                "Paths of the end effector. A shifted goal bends the joint-space motion; in "
                "task space the approach keeps its shape.",
            ),
            *(
                Picture(
                    f"joints_{space}_space",
                    shelf_joints_figure(
                        run.workplace.robot.chain.joint_names,
                        demonstration,
                        motions[label],
                        drawn_limits(run.workplace.robot.chain),
                    ),
                    f"Joints, planned in {label}: the demonstration, and the faster motions to "
                    "three goals.",
                )
                for space, label in SPACES.items()
            ),
            *_pictures(
                snapshots, "shelves", "At the three goals, planned in task space.", columns=3
            ),
        ),
    )


def _approach(run: PlacingRun) -> Section:
    reference = demonstrated_approach(run.demonstration, run.workplace)
    distances: dict[str, dict[str, ApproachDistance]] = {}
    for (space, shelf), placing in run.placings.items():
        approach = approach_path(placing.path, placing.goal, run.workplace)
        distances.setdefault(SPACES[space], {})[shelf] = ApproachDistance(
            remaining=approach.remaining, distance=approach.distance(reference)
        )
    return Section(
        heading="The approach path",
        text=(
            "Distance of the end effector, sideways and in height, from the demonstrated "
            "approach moved to the goal, from where the object crosses the boards' front edge."
        ),
        figures=(
            Picture(
                "approach",
                approach_figure(distances, 1e-3 * DEVIATION_MM),
                "Distance from the demonstrated approach path; the demonstration's own tremor "
                "is part of it.",
            ),
        ),
    )


def random_start_pictures(trials: Sequence[Trial], shelves: Sequence[str]) -> list[Picture]:
    """Every trial as a dot, beside the bounds."""
    measures = {
        "place error [mm]": ("place_error_mm", PLACE_ERROR_MM),
        "place tilt [deg]": ("place_tilt_deg", PLACE_TILT_DEG),
        "approach deviation [mm]": ("approach_path_deviation_mm", DEVIATION_MM),
    }
    values = {
        label: {shelf: column(trials, f"{shelf}_shelf_{key}") for shelf in shelves}
        for label, (key, _) in measures.items()
    }
    bounds = {label: bound for label, (_, bound) in measures.items()}
    caption = "Each dot is a placing; dashed: the bound."
    return [Picture("random_starts", trials_figure(values, bounds), caption)]


def _pictures(
    snapshots: Snapshots, name: str, caption: str, columns: int = 2
) -> tuple[Picture, ...]:
    """The figure of these snapshots, if there are any."""
    if name not in snapshots:
        return ()
    return (Picture(name, snapshots_figure(snapshots[name], columns=columns), caption),)


def _motion(run: SimulatedPlacing) -> Motion:
    return Motion(time=run.time, joint_position=run.joint_position, path=run.path)
