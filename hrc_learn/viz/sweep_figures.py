"""Figures of what sweeps measured."""

from collections.abc import Mapping
from itertools import product

import matplotlib
import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from . import palette
from .figure_parts import STYLE, WIDTH

_DASHES = ("-", "--", ":", "-.")


def arrival_figure(times: Mapping[str, Float[np.ndarray, " trials"]]) -> Figure:
    """Share of the trials that are on target, over time.

    Args:
        times: By experiment, when each trial arrived for good [s]; infinite if it did not.
    """
    looks = product(_DASHES, palette.SERIES)
    latest = max((t[np.isfinite(t)].max(initial=0.0) for t in times.values()), default=0.0)
    end = 1.05 * latest or 1.0
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, 3.2))
        axes = figure.subplots()
        for (name, arrival), (dash, colour) in zip(times.items(), looks, strict=False):
            ordered = np.sort(arrival[np.isfinite(arrival)])
            share = 100 * np.arange(1, len(ordered) + 1) / len(arrival)
            axes.step(
                [0.0, *ordered, end],
                [0.0, *share, share[-1] if len(share) else 0.0],
                dash,
                where="post",
                color=colour,
                label=name.replace("_", " "),
            )
        axes.set(xlabel="time [s]", ylabel="on target [% of trials]", xlim=(0, end))
        axes.set_ylim(0, 102)
        figure.legend(loc="outside right upper")
    return figure
