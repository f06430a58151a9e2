"""Figures of what training measured."""

from collections.abc import Mapping, Sequence

import matplotlib
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from . import palette
from .figure_parts import STYLE, WIDTH


def workspace_figure(
    maps: Sequence[tuple[str, Float[np.ndarray, "nx ny"]]],
    x: Float[np.ndarray, " nx_and_1"],
    y: Float[np.ndarray, " ny_and_1"],
) -> Figure:
    """Shares over cells of the horizontal plane, in percent, side by side.

    Args:
        maps: Title and values of each, x first; NaN where nothing is known.
        x: Edges of the cells [m].
        y: Edges of the cells [m].
    """
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, 0.15 + 3.1 * 2 / max(len(maps), 2)))
        row = figure.subplots(1, len(maps), sharex=True, sharey=True, squeeze=False)[0]
        for axes, (title, shares) in zip(row, maps, strict=True):
            mesh = axes.pcolormesh(x, y, 100 * shares.T, cmap="Blues", vmin=0)
            _write_cells(axes, x, y, 100 * shares)
            axes.set(title=title, xlabel="x [m]", aspect="equal")
            axes.grid(False)
            figure.colorbar(mesh, ax=axes, label="%", shrink=0.8)
        row[0].set_ylabel("y [m]")
    return figure


def _write_cells(axes: Axes, x: np.ndarray, y: np.ndarray, values: np.ndarray) -> None:
    most = np.nanmax(values)
    for (i, j), value in np.ndenumerate(values):
        if np.isfinite(value):
            colour = "white" if value > 0.6 * most else "black"
            place = (x[i] + x[i + 1]) / 2, (y[j] + y[j + 1]) / 2
            axes.text(*place, f"{value:.2g}", color=colour, ha="center", va="center")


def learning_figure(held_out: Sequence[float], best: int, unit: str) -> Figure:
    """Held-out error over the rounds of learning.

    Args:
        held_out: Error after each round, the first before any.
        best: The round that was kept.
        unit: Of the error.
    """
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(0.62 * WIDTH, 2.5))
        axes = figure.subplots()
        axes.plot(held_out, "o-", color=palette.RUN, ms=4)
        axes.plot(best, held_out[best], "o", color=palette.LIMIT, ms=9, mfc="none", mew=1.8)
        axes.annotate(
            "kept",
            (best, held_out[best]),
            xytext=(8, 8),
            textcoords="offset points",
            color=palette.LIMIT,
        )
        axes.set(
            xlabel="round",
            ylabel=f"held-out error [{unit}]",
            title="Error on demonstrations held out",
        )
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    return figure


def measures_figure(
    measures: Mapping[str, Float[np.ndarray, " demos"]],
    episodes: Sequence[int],
    units: Mapping[str, str],
) -> Figure:
    """Each measure over the demonstrations, with its median.

    Args:
        measures: Values by name.
        episodes: Number of each demonstration.
        units: Of the measures.
    """
    rows = -(-len(measures) // 2)
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, 1.9 * rows))
        grid = figure.subplots(rows, 2, sharex=True, squeeze=False).ravel()
        places = np.arange(len(episodes))
        for axes, (name, values) in zip(grid, measures.items(), strict=False):
            axes.bar(places, values, color=palette.RUN)
            axes.axhline(float(np.median(values)), color=palette.LIMIT, lw=1.0)
            unit = units.get(name, "")
            axes.set_title(name.replace("_", " ") + (f" [{unit}]" if unit else ""))
        for axes in grid[len(measures) :]:
            axes.set_axis_off()
        for axes in grid[max(len(measures) - 2, 0) : len(measures)]:
            axes.tick_params(labelbottom=True)
            if len(episodes) <= 20:
                axes.set_xticks(places, [str(episode) for episode in episodes])
        figure.supxlabel("episode (line: median)", fontsize=9)
    return figure
