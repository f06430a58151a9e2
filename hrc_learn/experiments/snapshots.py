"""Rendered pictures of a work cell, and the figure that shows several of them."""

from collections.abc import Sequence

import matplotlib
import numpy as np
from jaxtyping import UInt8
from matplotlib.figure import Figure

from hrc_learn.vision import CameraModel
from hrc_learn.viz.figure_parts import STYLE, WIDTH

Image = UInt8[np.ndarray, "height width 3"]

_WIDTH, _HEIGHT = 1200, 900
_FOCAL = 1.2
"""Of the height of the picture: 45 degrees from top to bottom."""


def viewpoint(
    eye: tuple[float, float, float], towards: tuple[float, float, float]
) -> CameraModel:
    """A camera of pictures that people look at.

    Args:
        eye: Where it is [m].
        towards: What is in the middle of the picture [m].
    """
    upright = CameraModel(
        width=_WIDTH,
        height=_HEIGHT,
        focal=(_FOCAL * _HEIGHT, _FOCAL * _HEIGHT),
        principal=((_WIDTH - 1) / 2, (_HEIGHT - 1) / 2),
    )
    return upright.look_at(np.array(eye), np.array(towards))


def snapshots_figure(pictures: Sequence[tuple[str, Image]], columns: int = 2) -> Figure:
    """Pictures side by side, each with its title above."""
    rows = -(-len(pictures) // columns)
    height, width = pictures[0][1].shape[:2]
    with matplotlib.rc_context(STYLE):
        each = WIDTH / columns
        figure = Figure(figsize=(WIDTH, rows * (each * height / width + 0.28)))
        grid = figure.subplots(rows, columns, squeeze=False).ravel()
        for axes in grid:
            axes.set_axis_off()
        for axes, (title, picture) in zip(grid, pictures, strict=False):
            axes.imshow(picture, interpolation="lanczos")
            axes.set_title(title, fontsize=9)
    return figure
