"""Report of placings: recordings, and sections with their figures."""

from collections.abc import Sequence

import numpy as np

from hrc_learn.controller import INTERVENTIONS
from hrc_learn.demos import Demonstration
from hrc_learn.experiments.metric_table import column
from hrc_learn.experiments.placing_figures import (
    ApproachDistance,
    Motion,
    approach_figure,
    shelf_joints_figure,
    shelf_paths_figure,
    smoothness_figure,
    trials_figure,
)
from hrc_learn.experiments.placing_trial import (
    DEVIATION_MM,
    PLACE_ERROR_MM,
    PLACE_TILT_DEG,
    SPACES,
    PlacingRun,
    SimulatedPlacing,
    approach_path,
    demonstrated_approach,
    demonstrated_path,
)
from hrc_learn.experiments.run_measures import true_tool
from hrc_learn.experiments.run_recorder import demonstrated_joints, joint_ranges
from hrc_learn.experiments.snapshots import Snapshots, snapshots_figure
from hrc_learn.experiments.trials import Trial
from hrc_learn.geometry import Box
from hrc_learn.log import RunRecording
from hrc_learn.viz.report import Picture, Section

SUMMARY = (
    "An expert guides the end effector of an arm into a cabinet and at the same time moves its "
    "elbow around the open door. A movement primitive learned from that reproduces the motion "
    "faster and more smoothly, and adapts it to the shelves above and below: in task space "
    "with the learned null-space posture, and, for comparison, in joint space with a shifted "
    "goal, as in the paper.\n\n"
    "Everything runs in MuJoCo with the object held by friction; contacts, poses and the place "
    "of the object are read from the simulator. Values are for task space and the worst "
    "shelf unless stated otherwise."
)


def record_placing(
    run: SimulatedPlacing, demonstration: Demonstration, boxes: tuple[Box, ...]
) -> RunRecording:
    """Recording of a placing, with the demonstration.

    Args:
        run: The placing.
        demonstration: Demonstration that the motion was learned from.
        boxes: Boxes around the arm.
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
        joint_limits=joint_ranges(run.cell.chain),
        demo_joint_position=demonstrated,
        position=tool.position.numpy(),
        demo_path=demonstrated_path(demonstration, run.cell.chain),
        plan_path=run.plan.tool_pose.position.numpy(),
        bodies=run.motion.bodies(),
        boxes=boxes,
        safety={name: safety[:, i] for i, name in enumerate(INTERVENTIONS)},
        phases=tuple(log.events),
    )


def placing_sections(run: PlacingRun, snapshots: Snapshots) -> list[Section]:
    """Report sections: shelves, approach, smoothness.

    Args:
        run: The placings.
        snapshots: Rendered pictures; empty if this machine cannot render.
    """
    demonstration = Motion(
        time=run.demonstration.time - run.demonstration.time[0],
        joint_position=np.asarray(run.demonstration.joint_position),
        path=demonstrated_path(run.demonstration, run.workplace.robot.chain),
    )
    return [
        _shelves(run, demonstration, snapshots),
        _approach(run),
        Section(
            heading="Faster and smoother than demonstrated",
            text="The primitive leaves out the tremor of the person who guided the arm.",
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
            "analytic inverse kinematics. The paper keeps joint 7 fixed; with joint 7 as "
            "demonstrated, this arm reaches "
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
                        joint_ranges(run.workplace.robot.chain),
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
    """Figure of all trials as dots, with the bounds."""
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
    """Figure of these snapshots; none if they were not rendered."""
    if name not in snapshots:
        return ()
    return (Picture(name, snapshots_figure(snapshots[name], columns=columns), caption),)


def _motion(run: SimulatedPlacing) -> Motion:
    return Motion(time=run.time, joint_position=run.joint_position, path=run.path)
