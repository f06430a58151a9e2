"""The report on the experiment on placing, and its recording."""

from collections.abc import Mapping, Sequence

import numpy as np
import torch

from hrc_learn import viz
from hrc_learn.experiments.monte_carlo import Trial
from hrc_learn.experiments.placing import figures as draw
from hrc_learn.experiments.placing.experiment import SPACES, PlacingExperiment, shown_joints
from hrc_learn.experiments.placing.snapshots import Image
from hrc_learn.experiments.placing.trial import (
    BEND,
    GOAL_ANGLE,
    GOAL_DISTANCE,
    PlacingRun,
    demonstrated_way_in,
    hand_path,
    way_in,
)
from hrc_learn.kinematics import panda
from hrc_learn.skills.work_cell import SAFETY_COLUMNS
from hrc_learn.viz.report import Measurement, Picture, Report, Section, software_versions

# A placing run as a recording to look at.


def record_placing(run: PlacingRun, experiment: PlacingExperiment) -> viz.RunRecording:
    """Everything worth looking at in a run, beside the demonstration."""
    log, demonstration = run.cell.log, experiment.demonstration
    joints, safety = log["joint_position"], log["safety"]
    shown = np.full_like(joints, np.nan)
    shown[run.transfer] = shown_joints(demonstration, run.time / run.time[-1])
    return viz.RunRecording(
        title=f"Placing on the {run.shelf} shelf",
        time=log["time"],
        joint_names=panda.joint_names,
        joint_position=joints,
        joint_limits=PANDA_LIMITS,
        demo_joint_position=shown,
        position=panda.forward(torch.from_numpy(joints)).position.numpy(),
        demo_path=hand_path(demonstration),
        plan_path=run.plan.tool_pose.position.numpy(),
        bodies=run.motion.bodies(),
        boxes=tuple(experiment.workplace.scene.boxes()),
        safety={name: safety[:, i] for i, name in enumerate(SAFETY_COLUMNS)},
        phases=tuple(log.events),
    )


PANDA_LIMITS = viz.JointLimits(
    lower=panda.limits.lower.numpy(), upper=panda.limits.upper.numpy()
)
"""To be drawn beside joint positions."""

# The report on the experiment on placing.

Pictures = Mapping[str, Sequence[tuple[str, Image]]]
"""Rendered ones with their titles, by what they show: "motion", "body_shape", "shelves"."""


def placing_report(
    experiment: PlacingExperiment,
    table: Sequence[Measurement],
    *,
    trials: Sequence[Trial] = (),
    pictures: Pictures | None = None,
    configuration: Mapping[str, object],
    command: str,
) -> Report:
    """Figures, table and how to do it again.

    Args:
        experiment: What was done.
        table: What was measured.
        trials: From random starts, where there were any.
        pictures: Rendered ones, where this machine can.
        configuration: Of the run.
        command: That repeats it.
    """
    sections = [
        _shelves(experiment, pictures or {}),
        _way_in(experiment),
        _smoothness(experiment, pictures or {}),
        _body_shape(pictures or {}),
    ]
    if trials:
        sections.append(_random_starts(trials, experiment.workplace.shelf_names()))
    return Report(
        title="Placing: shown once, repeated faster, and on other shelves",
        summary=(
            "An expert leads the hand of an arm into a cabinet and pulls its elbow around the "
            "open door at once. A movement primitive learned from that repeats the motion "
            "faster and more smoothly, and carries it over to the shelves above and below: in "
            "joint space with a shifted goal, as in the paper, and in task space with the "
            "learned body shape.\n\n"
            "Everything runs in MuJoCo with the thing held by friction; contacts, poses and "
            "where the thing stands are read from the simulator."
        ),
        table=table,
        sections=[section for section in sections if section.figures],
        configuration=configuration,
        versions=software_versions(),
        command=command,
    )


def _shelves(experiment: PlacingExperiment, pictures: Pictures) -> Section:
    demonstration, motions = _demonstrated(experiment), _motions(experiment)
    boxes = tuple(experiment.workplace.scene.cabinet.boxes())
    figures = [
        Picture(
            "paths",
            draw.shelf_paths_figure(demonstration, motions, boxes),
            "Paths of the hand. A shifted goal bends the joint-space motion; in task space the "
            "way in keeps its shape.",
        )
    ]
    figures += [
        Picture(
            f"joints_{space}_space",
            draw.shelf_joints_figure(
                panda.joint_names, demonstration, motions[way], PANDA_LIMITS
            ),
            f"Joints in {way}: the demonstration, and the faster motions to three goals.",
        )
        for space, way in SPACES.items()
    ]
    if "shelves" in pictures:
        figures.append(
            Picture(
                "shelves",
                draw.snapshots_figure(pictures["shelves"], columns=3),
                "At the three goals, planned in task space.",
            )
        )
    return Section(
        heading="Other shelves",
        text=(
            "One demonstration on one shelf, three goals. Goals in joint space come from the "
            "analytic inverse kinematics. The paper keeps joint 7 fixed; where the "
            f"demonstration left it, this arm reaches {_listed(experiment.same_joint7)} only, "
            "so it is free here."
        ),
        figures=figures,
    )


def _way_in(experiment: PlacingExperiment) -> Section:
    shown = demonstrated_way_in(experiment.demonstration, experiment.workplace)
    ways: dict[str, dict[str, draw.WayIn]] = {way: {} for way in SPACES.values()}
    for (space, shelf), run in experiment.runs.items():
        done = way_in(run.path, run.plan.goal, experiment.workplace)
        ways[SPACES[space]][shelf] = draw.WayIn(left=done.left, aside=done.aside(shown))
    return Section(
        heading="The way into the shelf",
        text=(
            "How far the hand is, sideways and in height, from the demonstrated way in, moved "
            "to the goal, from where what it carries crosses the boards' front edge."
        ),
        figures=[
            Picture(
                "bend",
                draw.bend_figure(ways, BEND),
                "Distance from the demonstrated way in; the demonstration's own tremor is part "
                "of it.",
            )
        ],
    )


def _smoothness(experiment: PlacingExperiment, pictures: Pictures) -> Section:
    figures = [
        Picture(
            "smoothness",
            draw.smoothness_figure(_demonstrated(experiment), _motion(experiment.reproduction)),
            "Speed and jerk of the hand, scaled by duration and length of the path.",
        )
    ]
    if "motion" in pictures:
        figures.append(
            Picture(
                "snapshots",
                draw.snapshots_figure(pictures["motion"]),
                "The demonstration, and the faster reproduction.",
            )
        )
    return Section(
        heading="Faster and smoother than shown",
        text="The primitive leaves out the tremor of the hand that led the arm.",
        figures=figures,
    )


def _body_shape(pictures: Pictures) -> Section:
    shown = pictures.get("body_shape", ())
    return Section(
        heading="The body's shape",
        text=(
            "The same motion of the hand, shown with and without pulling the elbow aside. The "
            "link that touches the cabinet is coloured."
        ),
        figures=[
            Picture(
                "body_shape",
                draw.snapshots_figure(shown),
                "Without the body's shape the arm is stopped by the open door.",
            )
        ]
        if shown
        else [],
    )


def _random_starts(trials: Sequence[Trial], shelves: Sequence[str]) -> Section:
    measures = {
        "goal error [mm]": ("goal_error_mm", 1e3 * GOAL_DISTANCE),
        "goal error [deg]": ("goal_error_deg", float(np.rad2deg(GOAL_ANGLE))),
        "way in bent [mm]": ("bend_mm", 1e3 * BEND),
    }
    values = {
        measure: {
            shelf: np.array([t.values.get(f"{shelf}_{name}", np.nan) for t in trials], float)
            for shelf in shelves
        }
        for measure, (name, _) in measures.items()
    }
    failed = [f"Seed {trial.seed}: {trial.failure}." for trial in trials if trial.failure]
    return Section(
        heading=f"From {len(trials)} random starts to each shelf",
        text=(
            "Every joint of the start is drawn about home; planned in task space.\n\n"
            + ("\n\n".join(failed) or "None failed.")
        ),
        figures=[
            Picture(
                "random_starts",
                draw.repetition_figure(
                    values, {m: bound for m, (_, bound) in measures.items()}
                ),
                "Each dot is a placing; dashed: the bound.",
            )
        ],
    )


def _listed(shelves: Sequence[str]) -> str:
    return f"the {' and the '.join(shelves)} shelf" if shelves else "no shelf"


def _motions(experiment: PlacingExperiment) -> dict[str, dict[str, draw.Motion]]:
    """By way of planning, then by shelf."""
    return {
        way: {
            shelf: _motion(experiment.runs[space, shelf])
            for shelf in experiment.workplace.shelf_names()
        }
        for space, way in SPACES.items()
    }


def _motion(run: PlacingRun) -> draw.Motion:
    return draw.Motion(time=run.time, joint_position=run.joint_position, path=run.path)


def _demonstrated(experiment: PlacingExperiment) -> draw.Motion:
    shown = experiment.demonstration
    assert shown.joint_position is not None
    return draw.Motion(
        time=shown.time - shown.time[0],
        joint_position=shown.joint_position,
        path=hand_path(shown),
    )
