"""Report of grasps: activity of the regions, sections, and their figures."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import matplotlib
import numpy as np
import torch
from jaxtyping import Bool, Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.ticker import StrMethodFormatter

from hrc_learn.experiments.grasping_trial import (
    REACHED,
    VARIANTS,
    GraspingRun,
    SimulatedGrasp,
)
from hrc_learn.experiments.run_recorder import record
from hrc_learn.geometry import Box
from hrc_learn.log import CameraRecording, RunRecording
from hrc_learn.skills.servo_target import VisualServoConfig
from hrc_learn.viz import palette
from hrc_learn.viz.figure_parts import STYLE, WIDTH, draw_box, frame_space, near, needed, space
from hrc_learn.viz.figures import image_jacobian_figure, joints_figure
from hrc_learn.viz.report import Picture, Section

_NOTHING_LEFT = 1e-6  # potential below which a region counts as reached
_REGIONS = (palette.ORANGE, palette.VERMILION, palette.GREEN)  # Cartesian ones alike

SUMMARY = (
    "The arm starts far from the table and has to grasp an object that it sees with one fixed "
    "camera. The camera was moved, tilted or turned since the demonstrations from which the "
    "image Jacobian was learned, in a manner unknown to the controller. An approach in joint "
    "space brings the end effector near, a region in Cartesian space into the camera's view, "
    "and visual servoing to above the object; then it descends, grasps and carries the object "
    "home. Simulated in MuJoCo; success is read from contacts and poses there."
)


@dataclass(frozen=True, kw_only=True, eq=False)
class RegionActivity:
    """Feedback that guided the arm, and potentials of the regions; NaN without a target."""

    approach: Float[np.ndarray, " time"]
    """Fraction of the joint-space approach in the command, 0 to 1."""
    cartesian: Float[np.ndarray, " time"]
    """Fraction of the Cartesian regions, 0 to 1."""
    vision: Float[np.ndarray, " time"]
    """Activation of the vision region, which acts together with the Cartesian ones, 0 to 1."""
    potentials: dict[str, Float[np.ndarray, " time"]]
    """Potential of each region, by name."""

    @classmethod
    def of(cls, run: SimulatedGrasp, config: VisualServoConfig) -> "RegionActivity":
        """Activity in the log of a grasp."""
        log, above = run.cell.log, run.scene.workplace.hover()
        servoed = np.isfinite(log["target"]).all(axis=1)
        seen = servoed & np.isfinite(log["feature"]).all(axis=1)
        tool = run.cell.chain.forward(torch.from_numpy(log["joint_position"]))
        goals = config.goals(above, np.zeros(2))
        assert goals.orientation is not None
        turn = np.where(servoed, goals.orientation.potential(tool.orientation).numpy(), np.nan)
        vision = np.full_like(turn, np.nan)
        for k in np.flatnonzero(seen):
            region = config.goals(above, log["target"][k]).vision
            vision[k] = float(region.potential(torch.from_numpy(log["feature"][k])))
        # The rest of the logged sum is the potential of the position.
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
    """Recording of a grasp.

    Args:
        run: The grasp.
        config: Configuration of its visual servoing.
        title: Title of the recording.
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
    """Report sections: comparison of the variants, regions, image Jacobian.

    Args:
        run: The grasps.
        recordings: Recording of the grasp as "run", of the variants as "compared_NAME".
        config: Configuration of the visual servoing.
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
                    "The potential of the position jumps where the end effector moves up and "
                    "down to learn the effect of its height on the image.",
                ),
                Picture("joints", joints_figure(default), "Joint positions and limits."),
            ),
        ),
        Section(
            heading="The image Jacobian",
            text=(
                "Learned with the camera in another place, it is wrong at first, and is then "
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
            "Object, start and camera are the same for all, and all know the target pixel: "
            "they differ only in the image Jacobian. An estimate that does not adapt, or that "
            "adapts without the measured motion, as the paper's law does, leads away from the "
            "target if the camera is rotated far enough."
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


def variants_figure(runs: Mapping[str, RunRecording], target: Float[np.ndarray, "2"]) -> Figure:
    """Paths of the feature in the image, and pixel errors over time, of several runs.

    Args:
        runs: Runs by label in the legend, the most important one first. All start alike. Time
            starts when the first of them saw the feature.
        target: True target of the feature [px]; all errors are measured from it.
    """
    cameras = {name: needed(run.camera, "camera") for name, run in runs.items()}
    seen = {name: _seen(camera) for name, camera in cameras.items()}
    starts = [runs[name].time[known][0] for name, known in seen.items() if known.any()]
    if not starts:
        raise ValueError("no run saw the feature, so there is nothing to draw.")
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, 3.9))
        image, error = figure.subplots(1, 2, width_ratios=[1.15, 1])
        # The most important one is drawn last, on top.
        for k, (name, camera) in reversed(list(enumerate(cameras.items()))):
            time, known = runs[name].time - min(starts), seen[name]
            width = 2.2 if k == 0 else 1.3
            style = {"color": palette.SERIES[k], "lw": width, "label": name, **_dashed(k)}
            image.plot(*np.where(known[:, None], camera.feature, np.nan).T, **style)
            distance = np.linalg.norm(camera.feature - target, axis=1)
            error.plot(time, np.where(known, distance, np.nan), **style)
        _frame_image(image, next(iter(cameras.values())), target)
        error.axhline(REACHED, color=palette.BLACK, lw=0.8, ls=":")
        error.set(
            xlabel="time since the marker was seen [s]",
            ylabel="distance to the target [px]",
            title="Pixel error",
            yscale="log",
        )
        error.set_xlim(left=0)
        error.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        handles, labels = error.get_legend_handles_labels()
        figure.legend(handles[::-1], labels[::-1], loc="outside lower center", ncols=2)
    return figure


def _dashed(k: int) -> dict[str, Any]:
    """Style of curve k: every other one is dashed and on top, as some coincide exactly."""
    return {"ls": "--", "zorder": 3} if k % 2 else {"ls": "-", "zorder": 2}


def _seen(camera: CameraRecording) -> Bool[np.ndarray, " time"]:
    """True at steps in which the feature was seen and had a target."""
    return np.asarray(np.isfinite(camera.feature).all(1) & np.isfinite(camera.target).all(1))


def _frame_image(axes: Axes, camera: CameraRecording, target: Float[np.ndarray, "2"]) -> None:
    width, height = camera.model.width, camera.model.height
    if camera.images:
        axes.imshow(camera.images[0], alpha=0.35)
    axes.add_patch(
        Rectangle((0, 0), width, height, fill=False, ec=palette.GREEN, lw=2.0, clip_on=False)
    )
    axes.plot(*target, "+", color=palette.LIMIT, ms=14, mew=2)
    axes.text(target[0] + 20, target[1] - 30, "target", fontsize=8)
    axes.set(
        xlim=(0, width),
        ylim=(height, 0),
        aspect="equal",
        xlabel="u [px]",
        ylabel="v [px]",
        title="Path of the marker (green: field of view)",
    )


def reach_figure(run: RunRecording) -> Figure:
    """Path of the tool from its remote start, before and after the marker came into view."""
    camera, region = needed(run.camera, "camera"), needed(run.region, "region")
    seen = np.flatnonzero(_seen(camera))
    first = int(seen[0]) if len(seen) else len(run.time) - 1
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


def regions_figure(
    run: RunRecording,
    fractions: Mapping[str, Float[np.ndarray, " time"]],
    potentials: Mapping[str, Float[np.ndarray, " time"]],
) -> Figure:
    """Fractions of the feedback over time, and potentials of the regions.

    Args:
        run: Recording with times and phases.
        fractions: Fraction of each kind of feedback in the command, 0 to 1; NaN while none was
            active.
        potentials: Potentials of the regions of position, orientation and vision.
    """
    active = np.logical_or.reduce([np.isfinite(values) for values in fractions.values()])
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, 4.2))
        above, below = figure.subplots(2, 1, sharex=True, height_ratios=[1, 1.4])
        for k, (name, values) in enumerate(fractions.items()):
            colour = palette.SERIES[k]
            above.fill_between(run.time, values, alpha=0.15, color=colour, lw=0)
            above.plot(run.time, values, color=colour, label=name, **_dashed(k))
        above.set(ylabel="fraction [-]", ylim=(-0.03, 1.08), title="Active feedback")
        for colour, (name, values) in zip(_REGIONS, potentials.items(), strict=True):
            left = np.where(values > _NOTHING_LEFT, values, np.nan)
            below.plot(run.time, left, color=colour, label=name)
        below.set(
            xlabel="time [s]",
            ylabel="potential [-]",
            yscale="log",
            title="Potentials",
        )
        for axes in (above, below):
            axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
            for phase in run.phases:
                axes.axvline(phase.time, color=palette.GREY, lw=0.7, ls=":")
        if active.any():
            below.set_xlim(run.time[active][0], run.time[active][-1])
    return figure
