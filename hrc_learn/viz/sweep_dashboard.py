"""A sweep as one Rerun recording: success by class, and how trials arrive over time."""

import os

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from jaxtyping import Float

from hrc_learn.viz import palette
from hrc_learn.viz.panels import Plot, Tab, several, slug
from hrc_learn.viz.recordings import SweepRecording, SweptTrials
from hrc_learn.viz.rerun_stream import (
    dashboard,
    markdown_table,
    rrd_file,
    send_summary,
    send_tab,
    tab_view,
)

# Of the curves over time: about as many as the plot has pixels.
_SAMPLES = 400
_COLUMNS = 2


def record_sweep(path: str | os.PathLike[str], sweep: SweepRecording) -> None:
    """Write a sweep as an .rrd file with its layout; `rerun FILE` shows it.

    Args:
        path: File to write; it appears only when complete.
        sweep: What was measured.
    """
    arrivals = np.concatenate([trials.arrival for trials in sweep.experiments.values()])
    latest = arrivals[np.isfinite(arrivals)].max(initial=0.0)
    time = np.linspace(0.0, 1.05 * latest or 1.0, _SAMPLES)
    tabs = sweep_tabs(sweep, time)
    summary = rrb.TextDocumentView(origin="/summary", name="Sweep")
    views = [*(tab_view(tab) for tab in tabs), _bar_charts(sweep)]
    layout = dashboard([summary], [rrb.Tabs(contents=views, active_tab=0)])
    with rrd_file(path, sweep.title, layout) as stream:
        send_summary(stream, _measured(sweep))
        for name, trials in sweep.experiments.items():
            bars = rr.BarChart(_success(sweep, trials), color=palette.rgba(palette.SKY))
            stream.log(_bars(name), bars, static=True)
        for tab in tabs:
            send_tab(stream, time, tab)


def sweep_tabs(sweep: SweepRecording, time: Float[np.ndarray, " time"]) -> list[Tab]:
    """Shares of trials on target over time: of all experiments, and of each by class."""
    shares = np.stack([t.share(time) for t in sweep.experiments.values()], axis=-1)
    every = several("arrival/all", sweep.experiments, 100 * shares)
    title = "Trials on target [%] over time"
    tabs = [Tab(title="Arrival", plots=(Plot(title=title, curves=(every,), legend=True),))]
    plots = []
    for name, trials in sweep.experiments.items():
        by_class = [trials.of(group).share(time) for group in range(len(sweep.groups))]
        curves = several(
            f"arrival/{slug(name)}", sweep.groups, 100 * np.stack(by_class, axis=-1)
        )
        plots.append(Plot(title=f"{name}: on target [%]", curves=(curves,), legend=True))
    return [*tabs, Tab(title="Arrival by class", plots=tuple(plots), columns=_COLUMNS)]


def _success(sweep: SweepRecording, trials: SweptTrials) -> list[float]:
    """Of each class [%]; none where it has no trials."""
    groups = [trials.of(group).success for group in range(len(sweep.groups))]
    return [100 * float(success.mean()) if len(success) else 0.0 for success in groups]


def _bars(name: str) -> str:
    return f"success/{slug(name)}"


def _bar_charts(sweep: SweepRecording) -> rrb.Grid:
    bars = [
        rrb.BarChartView(
            origin=_bars(name),
            name=f"{name}: success [%]",
            plot_legend=rrb.PlotLegend(visible=False),
        )
        for name in sweep.experiments
    ]
    title = f"Success by class: {', '.join(sweep.groups)}"
    return rrb.Grid(contents=bars, grid_columns=_COLUMNS, name=title)


def _measured(sweep: SweepRecording) -> str:
    """What was measured, as Markdown."""
    heads = ["experiment", "trials", "success [%]", *sweep.groups, "median [s]", "95 % [s]"]
    rows = []
    for name, trials in sweep.experiments.items():
        ordered = np.sort(trials.arrival)
        when = [ordered[int(np.ceil(share * len(ordered))) - 1] for share in (0.5, 0.95)]
        row = [name, len(ordered), f"{100 * trials.success.mean():.1f}"]
        row += [f"{share:.0f}" for share in _success(sweep, trials)]
        rows.append([*row, *(f"{t:.2f}" if np.isfinite(t) else "never" for t in when)])
    note = "Success by class in percent; times until on target."
    return "\n".join([f"# {sweep.title}", "", *markdown_table(heads, rows), "", note])
