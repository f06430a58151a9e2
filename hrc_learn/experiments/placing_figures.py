"""Figures of placings: each shelf has one colour, demonstrations are grey."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import matplotlib
import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, NullFormatter, StrMethodFormatter

from hrc_learn.geometry import Box
from hrc_learn.log import JointRanges
from hrc_learn.viz import palette
from hrc_learn.viz.figure_parts import STYLE, WIDTH, draw_box, frame_space, near, space
from hrc_learn.viz.figures import JointCurves, demonstrated_joints, joint_grid_figure

_SHELF_COLOURS = (palette.ORANGE, palette.BLUE, palette.PURPLE, palette.GREEN)


@dataclass(frozen=True, kw_only=True, eq=False)
class Motion:
    """Motion of the arm."""

    time: Float[np.ndarray, " samples"]
    """Time [s]."""
    joint_position: Float[np.ndarray, "samples joints"]
    """Joint positions [rad]."""
    path: Float[np.ndarray, "samples 3"]
    """Path of the tool centre point [m]."""


def shelf_colours(shelves: Sequence[str]) -> dict[str, str]:
    """Colour of each shelf, in order."""
    return dict(zip(shelves, _SHELF_COLOURS, strict=False))


def shelf_paths_figure(
    demonstration: Motion,
    motions: Mapping[str, Mapping[str, Motion]],
    boxes: tuple[Box, ...],
) -> Figure:
    """Paths of the end effector, one panel for each planning space.

    Args:
        demonstration: Demonstrated motion.
        motions: Motions by planning space and shelf.
        boxes: Boxes around the arm.
    """
    everything = [m.path for by_shelf in motions.values() for m in by_shelf.values()]
    points = np.concatenate([demonstration.path, *everything])
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, 4.5))
        for i, (space_name, by_shelf) in enumerate(motions.items()):
            axes = space(figure, position=(1, len(motions), 1 + i))
            for box in near(boxes, points):
                draw_box(axes, box, "#8D8F94", alpha=0.08)
            axes.plot(*demonstration.path.T, color=palette.DEMO, lw=5, label="demonstration")
            for shelf, colour in shelf_colours(list(by_shelf)).items():
                path = by_shelf[shelf].path
                axes.plot(*path.T, color=colour, lw=1.8, label=f"{shelf} shelf")
                axes.plot(*path[-1], "s", color=colour, ms=4)
            axes.set_title(space_name.capitalize(), loc="left")
            frame_space(axes, points, zoom=1.0)
            axes.xaxis.set_major_locator(MaxNLocator(3))
            axes.view_init(elev=16, azim=62)
        _legend_above(figure)
    return figure


def shelf_joints_figure(
    names: Sequence[str],
    demonstration: Motion,
    motions: Mapping[str, Motion],
    limits: JointRanges,
) -> Figure:
    """Joint positions over time: the demonstration, and the motion to each shelf.

    Args:
        names: Names of the joints.
        demonstration: Demonstrated motion.
        motions: Motions by shelf.
        limits: Joint limits.
    """
    colours = shelf_colours(list(motions))
    curves = [
        JointCurves(
            label=f"{shelf} shelf",
            time=motions[shelf].time,
            position=motions[shelf].joint_position,
            colour=colour,
        )
        for shelf, colour in colours.items()
    ]
    demo = demonstrated_joints(demonstration.time, demonstration.joint_position)
    return joint_grid_figure(names, [demo, *curves], limits)


@dataclass(frozen=True, kw_only=True, eq=False)
class ApproachDistance:
    """Distance of an approach path from the demonstrated one."""

    remaining: Float[np.ndarray, " samples"]
    """Remaining distance to the goal [m]."""
    distance: Float[np.ndarray, " samples"]
    """Distance from the demonstrated path at the same depth [m]."""


def approach_figure(
    approaches: Mapping[str, Mapping[str, ApproachDistance]], bound: float
) -> Figure:
    """Deviation of the approach paths, one panel for each planning space.

    Args:
        approaches: Approach paths by planning space and shelf.
        bound: Bound of a good placing [m].
    """
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, 2.9))
        panels = figure.subplots(1, len(approaches), sharey=True, squeeze=False)[0]
        for axes, (title, by_shelf) in zip(panels, approaches.items(), strict=True):
            for shelf, colour in shelf_colours(list(by_shelf)).items():
                approach = by_shelf[shelf]
                axes.plot(
                    1e3 * approach.remaining,
                    1e3 * approach.distance,
                    color=colour,
                    label=f"{shelf} shelf",
                )
            axes.axhline(1e3 * bound, color=palette.LIMIT, lw=1, ls="--", label="bound")
            axes.set(title=title.capitalize(), xlabel="remaining distance to the goal [mm]")
            axes.set_yscale("log")
            axes.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
            axes.set_ylim(0.1, 400)
            longest = max(a.remaining.max(initial=1e-3) for a in by_shelf.values())
            axes.set_xlim(1e3 * longest, 0)
        panels[0].set_ylabel("approach-path deviation [mm]")
        _legend_above(figure)
    return figure


def smoothness_figure(demonstration: Motion, reproduction: Motion) -> Figure:
    """Speed and jerk of the end effector, demonstrated and reproduced.

    Both are scaled by the duration and length of the path, so that a faster or longer motion
    does not count as less smooth.
    """
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, 2.9))
        speed, jerk = figure.subplots(1, 2)
        for label, motion, colour, width in (
            ("demonstration", demonstration, palette.DEMO, 1.2),
            ("reproduction", reproduction, palette.RUN, 1.6),
        ):
            fraction, first, third = _scaled_derivatives(motion)
            speed.plot(fraction, first, color=colour, lw=width, label=label)
            jerk.plot(fraction, third, color=colour, lw=width, label=label)
        speed.set(
            title="Speed of the end effector",
            ylabel="[path lengths / duration]",
            ylim=(0, None),
        )
        jerk.set(title="Jerk of the end effector", ylabel="[path lengths / duration³]")
        jerk.set_yscale("log")
        jerk.set_ylim(10, None)
        for axes in (speed, jerk):
            axes.set_xlabel("fraction of the motion")
            axes.margins(x=0)
        _legend_above(figure)
    return figure


def _legend_above(figure: Figure) -> None:
    """Draw one legend for all panels, which show the same curves."""
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=len(labels))


def _scaled_derivatives(motion: Motion) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Fraction of the duration, and norms of the first and third derivatives by it."""
    fraction = (motion.time - motion.time[0]) / (motion.time[-1] - motion.time[0])
    path = motion.path / np.linalg.norm(np.diff(motion.path, axis=0), axis=1).sum()
    sizes, values = [], path
    for _ in range(3):
        values = np.gradient(values, fraction, axis=0)
        sizes.append(np.linalg.norm(values, axis=1))
    return fraction, sizes[0], sizes[2]


def trials_figure(
    values: Mapping[str, Mapping[str, Float[np.ndarray, " trials"]]],
    bounds: Mapping[str, float],
) -> Figure:
    """Every trial as a dot, by shelf, one panel for each measure.

    Args:
        values: Values by measure (with its unit) and shelf.
        bounds: Bounds of a good placing, by measure.
    """
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, 2.9))
        panels = figure.subplots(1, len(values), squeeze=False)[0]
        for axes, (measure, by_shelf) in zip(panels, values.items(), strict=True):
            for x, (shelf, colour) in enumerate(shelf_colours(list(by_shelf)).items()):
                dots = by_shelf[shelf]
                # Spread by the golden ratio, so that dots do not hide each other.
                aside = 0.3 * (np.modf(np.arange(len(dots)) * 0.618)[0] - 0.5)
                axes.plot(x + aside, dots, ".", color=colour, ms=4, alpha=0.7)
            axes.axhline(bounds[measure], color=palette.LIMIT, lw=1, ls="--")
            axes.set(title=measure, xticks=range(len(by_shelf)), xticklabels=list(by_shelf))
            axes.set_xlim(-0.6, len(by_shelf) - 0.4)
            axes.set_yscale("log")
            known = np.concatenate([d[np.isfinite(d)] for d in by_shelf.values()])
            decade = 10.0 ** np.floor(np.log10(max(known.min(initial=1.0), 1e-6)))
            axes.set_ylim(decade, 3 * max(bounds[measure], known.max(initial=0.0)))
            axes.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
            axes.yaxis.set_minor_formatter(NullFormatter())
    return figure
