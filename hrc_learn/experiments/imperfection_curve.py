"""Success and errors of repeated experiments against the size of the imperfections."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from hrc_learn.experiments.metric_table import Summary
from hrc_learn.experiments.monte_carlo import Trial
from hrc_learn.viz.report import Picture, Section

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def curve_section(trials: Mapping[float, Sequence[Trial]], shown: Mapping[str, str]) -> Section:
    """Success rate and errors by the size of the imperfections, as text and picture.

    Args:
        trials: By the size, in multiples of the nominal ones.
        shown: Labels by the keys of the values to draw.
    """
    summaries = {size: Summary.of(known) for size, known in sorted(trials.items())}
    lines = [f"{size:g} times nominal: {known.rate}." for size, known in summaries.items()]
    picture = Picture(
        "imperfections",
        _figure(summaries, shown),
        "Success rate with its interval of 95 %, median and 95th percentile of errors, by the "
        "size of the imperfections.",
    )
    return Section(
        heading="Success against imperfections", text="\n\n".join(lines), figures=(picture,)
    )


def _figure(summaries: Mapping[float, Summary], shown: Mapping[str, str]) -> Figure:
    import matplotlib
    from matplotlib.figure import Figure

    from hrc_learn.viz import palette
    from hrc_learn.viz.figure_parts import STYLE, WIDTH

    sizes = np.array(list(summaries))
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, 2.4))
        first, *others = figure.subplots(1, 1 + len(shown))
        rates = np.array([s.successes / s.trials for s in summaries.values()])
        low, high = np.array([s.interval for s in summaries.values()]).T
        error = 100 * np.abs(np.stack([rates - low, high - rates]))
        first.errorbar(sizes, 100 * rates, error, fmt="o-", color=palette.RUN, capsize=3)
        first.set(title="success [%]", ylim=(0, 104))
        for axes, (key, label) in zip(others, shown.items(), strict=True):
            for kind, dash in (("p95", "o--"), ("median", "o-")):
                values = [
                    getattr(s.spread[key], kind) if key in s.spread else np.nan
                    for s in summaries.values()
                ]
                axes.plot(sizes, values, dash, color=palette.RUN)
                last = np.flatnonzero(np.isfinite(values))
                if len(last):
                    at = (sizes[last[-1]], values[last[-1]])
                    axes.annotate(kind, at, (4, 0), textcoords="offset points", fontsize=7)
            axes.set(title=label, ylim=(0, None))
            axes.margins(x=0.15)
        for axes in (first, *others):
            axes.set_xticks(sizes, [f"{size:g}" for size in sizes])
        figure.supxlabel("size of the imperfections [nominal]", fontsize=9)
    return figure
