"""Common style and parts of the figures."""

from itertools import pairwise, product
from typing import Any

import numpy as np
from cycler import cycler
from jaxtyping import Bool, Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from mpl_toolkits.mplot3d import Axes3D
from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection

from hrc_learn.geometry import Box
from hrc_learn.viz import palette

STYLE: dict[Any, Any] = {
    "font.size": 9.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.titlesize": 10.0,
    "axes.titlelocation": "left",
    "axes.prop_cycle": cycler(color=palette.SERIES),
    "grid.color": "#E3E5E8",
    "grid.linewidth": 0.6,
    "lines.linewidth": 1.4,
    "legend.frameon": False,
    "legend.fontsize": 8.0,
    "figure.constrained_layout.use": True,
}
"""Settings of matplotlib for every figure."""

WIDTH = 7.2
"""Width of a figure [inch]: the text width of a page."""

_SURROUNDINGS = 0.22  # how far around the paths boxes are drawn [m]


def needed[T](value: T | None, name: str) -> T:
    """The value, or an error that names the missing field of the recording."""
    if value is None:
        raise ValueError(f"this figure needs {name}, which the recording does not have.")
    return value


def scaled(
    values: Float[np.ndarray, " time"] | None, factor: float
) -> Float[np.ndarray, " time"] | None:
    """Values in another unit; None without values."""
    return None if values is None else factor * values


def finite_span(
    axes: Axes, time: Float[np.ndarray, " time"], known: Bool[np.ndarray, " time"]
) -> None:
    """Limit the time axis to the span of known values."""
    if known.any():
        axes.set_xlim(time[known][0], time[known][-1])


def active_intervals(active: Bool[np.ndarray, " time"]) -> list[tuple[int, int]]:
    """First and last index of every run of true samples."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], active, [False]]).astype(int)))
    return [(int(a), int(b) - 1) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def shade(
    axes: Axes, time: Float[np.ndarray, " time"], active: Bool[np.ndarray, " time"]
) -> None:
    """Shade the intervals in which something was active."""
    for first, last in active_intervals(active):
        axes.axvspan(time[first], time[last], color=palette.PERSON, alpha=0.13, lw=0)


def draw_limits(axes: Axes, lower: float, upper: float) -> None:
    """Draw lines at the limits of a joint, and tint the range beyond them.

    The motion drawn before fills the panel: if a limit is far from it, both limits are written
    as text instead.
    """
    low, high = axes.dataLim.intervaly
    around = max(0.25, 0.15 * (high - low))  # of a joint that hardly moves [rad]
    beyond = 0.06 * (upper - lower)
    bottom, top = max(lower - beyond, low - around), min(upper + beyond, high + around)
    for limit, end in ((lower, bottom), (upper, top)):
        if bottom <= limit <= top:
            inner, outer = sorted((limit, end))
            axes.axhspan(inner, outer, color=palette.LIMIT, alpha=0.15, lw=0)
            axes.axhline(limit, color=palette.LIMIT, lw=0.9, label="limit")
    axes.set_ylim(bottom, top)
    if not (bottom <= lower and upper <= top):
        said = f"limits {lower:.2f}, {upper:.2f}"
        axes.set_title(said, loc="right", fontsize=7, color=palette.LIMIT)


def legend_in_free_cell(figure: Figure, grid: np.ndarray, used: int) -> None:
    """Draw one legend for all cells, in the first unused one, or above if all are used."""
    unique = {}
    for axes in grid[:used]:
        handles, labels = axes.get_legend_handles_labels()
        unique |= dict(zip(labels, handles, strict=True))
    for axes in grid[used:]:
        axes.set_axis_off()
    if used < len(grid):
        grid[used].legend(unique.values(), unique.keys(), loc="center left", fontsize=9)
    else:
        figure.legend(unique.values(), unique.keys(), loc="outside upper right", ncols=3)
    for axes in grid[max(used - 2, 0) : used]:
        axes.tick_params(labelbottom=True)
    figure.supxlabel("time [s]", fontsize=9)


def space(figure: Figure, position: tuple[int, int, int] = (1, 1, 1)) -> Axes3D:
    """Axes in three dimensions, in a cell of a grid (rows, columns, number of the cell)."""
    axes = figure.add_subplot(*position, projection="3d", computed_zorder=False)
    assert isinstance(axes, Axes3D)
    axes.view_init(elev=24, azim=35)
    for axis in (axes.xaxis, axes.yaxis, axes.zaxis):
        axis.set_major_locator(MaxNLocator(5))
        axis.set_pane_color((1, 1, 1, 0))  # pyright: ignore[reportAttributeAccessIssue]
    axes.set(xlabel="x [m]", ylabel="y [m]", zlabel="z [m]")
    return axes


def frame_space(axes: Axes3D, points: Float[np.ndarray, "n 3"], zoom: float = 1.12) -> None:
    """Show the surroundings of some points, with the same scale on every axis."""
    low, high = points.min(axis=0) - _SURROUNDINGS, points.max(axis=0) + _SURROUNDINGS
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    axes.set_box_aspect(tuple(high - low), zoom=zoom)  # pyright: ignore[reportArgumentType]


def near(boxes: tuple[Box, ...], points: Float[np.ndarray, "n 3"]) -> list[Box]:
    """Parts of the boxes in the surroundings of some points."""
    low, high = points.min(axis=0) - _SURROUNDINGS, points.max(axis=0) + _SURROUNDINGS
    parts = []
    for box in boxes:
        centre, half = np.array(box.centre), np.array(box.half_size)
        a, b = np.maximum(centre - half, low), np.minimum(centre + half, high)
        if (a < b).all():
            x, y, z = ((a + b) / 2).tolist()
            dx, dy, dz = ((b - a) / 2).tolist()
            parts.append(Box(centre=(x, y, z), half_size=(dx, dy, dz), colour=box.colour))
    return parts


def draw_box(axes: Axes3D, box: Box, colour: str, *, alpha: float) -> None:
    """A translucent box with its edges."""
    corners = np.array(list(product((-1, 1), repeat=3))) * box.half_size + box.centre
    faces, edges = [], []
    for axis, side in product(range(3), (-1, 1)):
        rim = [k for k, signs in enumerate(product((-1, 1), repeat=3)) if signs[axis] == side]
        ring = [rim[0], rim[1], rim[3], rim[2], rim[0]]  # round the face
        faces.append(corners[ring[:4]])
        edges += [corners[[a, b]] for a, b in pairwise(ring)]
    axes.add_collection3d(
        Poly3DCollection(faces, facecolor=colour, alpha=alpha, edgecolor="none")
    )
    axes.add_collection3d(Line3DCollection(edges, colors=colour, linewidths=0.6, alpha=0.6))
