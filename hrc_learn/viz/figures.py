"""Figures of runs, fits and sweeps for reports and papers.

Plain matplotlib `Figure` objects: no pyplot, no global state, no window. Curves of runs are the
plots that the dashboards show (`panels.py`).
"""

from collections.abc import Sequence
from pathlib import Path
from textwrap import fill
from typing import Any, NamedTuple

import matplotlib
import numpy as np
from cycler import cycler
from jaxtyping import Bool, Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.legend import Legend
from matplotlib.ticker import MaxNLocator
from mpl_toolkits.mplot3d import Axes3D
from mpl_toolkits.mplot3d.art3d import Line3DCollection

from hrc_learn.geometry import Box
from hrc_learn.log import JointRanges, RunRecording
from hrc_learn.viz import palette
from hrc_learn.viz.panels import Plot, single

_FILE = Path(__file__).with_name("figures.mplstyle")
STYLE: dict[Any, Any] = {
    **matplotlib.rc_params_from_file(_FILE, use_default_template=False),
    "axes.prop_cycle": cycler(color=palette.SERIES),
}
"""Settings of matplotlib for every figure."""

WIDTH = 7.2
"""Width of a figure [inch]: the text width of a page."""

_NARROW = 3.7
"""Width of a figure for a phone [inch]: 390 pixels, with text as large as the page's."""
_TITLE = 50  # letters in a line of a title on a phone
_AROUND = 0.65  # title, ticks and legend of a panel on a phone [inch]
_ZOOM, _NARROW_ZOOM = 0.96, 0.77  # at which the labels of three axes stay inside a figure
_EDGES = "#8D8F94"  # of boxes
_SURROUNDINGS = 0.22  # boxes are drawn up to this distance from the paths [m]


def active_intervals(active: Bool[np.ndarray, " time"]) -> list[tuple[int, int]]:
    """First and last index of every interval of consecutive true samples."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], active, [False]]).astype(int)))
    return [(int(a), int(b) - 1) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def draw_limits(axes: Axes, lower: float, upper: float) -> None:
    """Name the limits of a joint in the title, and draw those near the motion."""
    low, high = axes.dataLim.intervaly
    around = max(0.25, 0.15 * (high - low))  # at least 0.25 rad, if the joint hardly moves
    for limit in (lower, upper):
        axes.axhline(limit, color=palette.LIMIT, lw=0.9)
    axes.set_ylim(low - around, high + around)
    text = f"limits {lower:.2f}, {upper:.2f}"
    axes.set_title(text, loc="right", fontsize=7, color=palette.LIMIT)


def space(figure: Figure, position: tuple[int, int, int] = (1, 1, 1)) -> Axes3D:
    """Axes in three dimensions, in a cell of a grid (rows, columns, number of the cell)."""
    axes = figure.add_subplot(*position, projection="3d", computed_zorder=False)
    assert isinstance(axes, Axes3D)
    axes.view_init(elev=24, azim=35)
    for axis in (axes.xaxis, axes.yaxis, axes.zaxis):
        axis.set_major_locator(MaxNLocator(4))
        axis.set_pane_color((1, 1, 1, 0))  # pyright: ignore[reportAttributeAccessIssue]
    axes.set(xlabel="x [m]", ylabel="y [m]", zlabel="z [m]")
    axes.zaxis.set_rotate_label(False)  # it would be read from above
    axes.zaxis.label.set_rotation(90)
    return axes


def frame_space(
    axes: Axes3D, points: Float[np.ndarray, "n 3"], boxes: Sequence[Box] = ()
) -> None:
    """Show the surroundings of some points, with the same scale on every axis.

    Args:
        axes: Axes in three dimensions.
        points: Points [m].
        boxes: Boxes; their parts in the surroundings of the points are drawn.
    """
    low, high = points.min(axis=0) - _SURROUNDINGS, points.max(axis=0) + _SURROUNDINGS
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    axes.set_box_aspect(tuple(high - low), zoom=_ZOOM)  # pyright: ignore[reportArgumentType]
    for box in boxes:
        centre, half = np.array(box.centre), np.array(box.half_size)
        a, b = np.maximum(centre - half, low), np.minimum(centre + half, high)
        if (a < b).all():
            x, y, z = ((a + b) / 2).tolist()
            dx, dy, dz = ((b - a) / 2).tolist()
            part = Box(centre=(x, y, z), half_size=(dx, dy, dz), colour=box.colour)
            lines = list(part.edges())
            look = {"colors": _EDGES, "linewidths": 0.6, "alpha": 0.6}
            axes.add_collection3d(Line3DCollection(lines, **look))


class JointCurves(NamedTuple):
    """Joint positions of one motion over time, with their look."""

    label: str
    time: Float[np.ndarray, " time"]
    """Time [s]."""
    position: Float[np.ndarray, "time joints"]
    """Joint positions [rad, or m for sliding joints]."""
    colour: str = palette.RUN
    width: float = 1.8


DEMO_LOOK = palette.DEMO, 4.5
"""Colour and width of the curves of a demonstration, thick and behind the others."""


def joint_grid_figure(
    names: Sequence[str],
    motions: Sequence[JointCurves],
    limits: JointRanges | None = None,
    unit: str = "rad",
) -> Figure:
    """Joint positions of several motions over time, one panel for each joint.

    Args:
        names: Names of the joints.
        motions: Motions, the last one on top.
        limits: Joint limits; None: none are drawn.
        unit: Unit of the positions.
    """
    plots = [
        Plot(
            title=f"{name} [{unit}]",
            curves=tuple(
                single("", m.label, m.position[:, i], m.colour, m.width, m.time)
                for m in motions
            ),
            legend=i == 0,
        )
        for i, name in enumerate(names)
    ]
    figure = plots_figure(motions[0].time, plots, columns=2)
    if limits is not None:
        for axes, lower, upper in zip(figure.axes, limits.lower, limits.upper, strict=False):
            draw_limits(axes, float(lower), float(upper))
    return figure


def joints_figure(run: RunRecording) -> Figure:
    """Joint positions over time, with the demonstration and the limits."""
    motions = [JointCurves("run", run.time, run.joint_position)]
    if (demo := run.demo_joint_position) is not None:
        motions.insert(0, JointCurves("demonstration", run.time, demo, *DEMO_LOOK))
    return joint_grid_figure(run.joint_names, motions, run.joint_limits)


def stack_panels(figure: Figure) -> None:
    """Put the panels of a figure above one another, for the width of a phone.

    Curves keep their height, images and 3D views keep their proportions. Legends come below
    their panels. The figure must have been drawn once, which sets the sizes of the panels.
    """
    panels = [axes for axes in figure.axes if axes.axison or axes.name == "3d"]
    if not panels or any(axes.get_subplotspec() is None for axes in panels):
        return
    width, height = figure.get_size_inches()
    rows = []
    for axes in panels:
        area = axes.get_position()
        shaped = axes.name == "3d" or axes.get_aspect() != "auto"
        scale = min(1.0, _NARROW / width / area.width) if shaped else 1.0
        rows.append(scale * height * area.height)
    grid = figure.add_gridspec(len(panels), 1, height_ratios=rows)
    for axes, row in zip(panels, range(len(panels)), strict=True):
        axes.set_subplotspec(grid[row])
        if isinstance(axes, Axes3D):
            aspect = axes.get_box_aspect()
            axes.set_box_aspect(aspect, zoom=_NARROW_ZOOM)  # pyright: ignore[reportArgumentType]
        axes.tick_params(labelbottom=True)
        axes.set_title(fill(axes.get_title("left"), _TITLE), loc="left", fontsize=8)
        if (legend := axes.get_legend()) is not None:
            below = 0.0 if axes.name == "3d" else -0.2  # a 3D view leaves its corners free
            axes.legend(**_narrow(legend), loc="upper left", bbox_to_anchor=(0, below))
    for legend in [*figure.legends]:
        legend.remove()
        figure.legend(**_narrow(legend), loc="outside upper center")
    figure.set_size_inches(_NARROW, sum(rows) + _AROUND * len(rows) + 0.3)


def _narrow(legend: Legend) -> dict[str, Any]:
    """Entries and look of a legend in two columns."""
    handles = [handle for handle in legend.legend_handles if handle is not None]
    labels = [text.get_text() for text in legend.texts]
    return {"handles": handles, "labels": labels, "fontsize": 8, "frameon": False, "ncols": 2}


def plots_figure(
    time: Float[np.ndarray, " time"],
    plots: Sequence[Plot],
    *,
    columns: int = 1,
    shown: Bool[np.ndarray, " time"] | None = None,
    shaded: Bool[np.ndarray, " time"] | None = None,
    axis: str = "time [s]",
) -> Figure:
    """Plots of a dashboard on white paper, with a common horizontal axis.

    Args:
        time: Time of the curves [s], or the quantity that `axis` names.
        plots: Plots; their titles name the units.
        columns: Number of columns.
        shown: True at samples that the time axis must show; if None or never true: all samples.
        shaded: Samples in which the background is shaded; None: none.
        axis: Title of the horizontal axis.
    """
    rows = -(-len(plots) // columns)
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, 0.6 + 1.6 * rows))
        grid = figure.subplots(rows, columns, sharex=True, squeeze=False).ravel()
        for axes, plot in zip(grid, plots, strict=False):
            for curves in plot.curves:
                columned = zip(curves.names, curves.values.T, curves.colours, strict=True)
                for name, values, colour in columned:
                    look = palette.on_white(colour)
                    at = time if curves.time is None else curves.time
                    axes.plot(at, values, color=look, lw=0.8 * curves.width, label=name)
            for first, last in () if shaded is None else active_intervals(shaded):
                axes.axvspan(time[first], time[last], color=palette.PERSON, alpha=0.13, lw=0)
            axes.set_title(plot.title, fontsize=10 if columns == 1 else 8)
            axes.set_ylim(plot.range)
            axes.margins(x=0)
            handles, names = axes.get_legend_handles_labels()
            if plot.rows:
                rows, names = zip(*(name.split(" ", 1) for name in names), strict=True)
                axes.set_yticks([*map(int, rows)], names, fontsize=7)
            elif plot.legend:
                once = dict(zip(names, handles, strict=True))  # names may be repeated
                beside = {"loc": "center left", "bbox_to_anchor": (1.0, 0.5)}
                below = {"loc": "upper left", "bbox_to_anchor": (0.0, -0.02), "ncols": 4}
                axes.legend(once.values(), once, **(beside if columns == 1 else below))
        for axes in grid[len(plots) :]:
            axes.set_axis_off()
        if shown is not None and shown.any():
            grid[0].set_xlim(time[shown][0], time[shown][-1])
        figure.supxlabel(axis, fontsize=9)
    return figure
