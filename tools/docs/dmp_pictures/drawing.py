"""What the pictures share."""

from collections.abc import Callable
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from hrc_learn.viz import palette

type Picture = Callable[[Figure], None]

DEMO = {"color": palette.DEMO, "lw": 4.5, "alpha": 0.55, "solid_capstyle": "round"}
"""Style of demonstrations: wide and pale, so that what lies on them shows."""


def panels(figure: Figure, n: int, **options: Any) -> list[Axes]:
    """Axes side by side."""
    return list(figure.subplots(1, n, **options)) if n > 1 else [figure.subplots()]


def plane(axes: Axes, title: str) -> None:
    """Axes of a path in the plane."""
    axes.set(xlabel="x [m]", ylabel="y [m]", title=title)
    axes.set_aspect("equal", adjustable="datalim")


def ends(axes: Axes, start: Any, goal: Any, colour: str) -> None:
    """A dot at the start, a square at the goal."""
    axes.plot(*start, "o", color=colour, ms=4.5, zorder=5)
    axes.plot(*goal, "s", color=colour, ms=4.5, zorder=5)
