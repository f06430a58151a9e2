"""A sweep as one Rerun recording: success by class, and how trials arrive over time."""

import os

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from jaxtyping import Float

from hrc_learn.viz import palette
from hrc_learn.viz.panels import Plot, Tab, several, slug
from hrc_learn.viz.recordings import SweepRecording, SweptTrials
from hrc_learn.viz.rerun_stream import TIMELINE, rrd_file, send_curves, tab_view

_SAMPLES = 400
_COLUMNS = 2


def record_sweep(path: str | os.PathLike[str], sweep: SweepRecording) -> None:
    """Write a sweep as an .rrd file with its layout; `rerun FILE` shows it.

    Args:
        path: File to write; it appears only when complete.
        sweep: What was measured.
    """
    time = _times(sweep)
    tabs = sweep_tabs(sweep, time)
    with rrd_file(path, sweep.title, _blueprint(sweep, tabs)) as stream:
        table = rr.TextDocument(_table(sweep), media_type="text/markdown")
        stream.log("summary", table, static=True)
        for name, trials in sweep.experiments.items():
            bars = rr.BarChart(_success(sweep, trials), color=palette.rgba(palette.SKY))
            stream.log(_bars(name), bars, static=True)
        for tab in tabs:
            for plot in tab.plots:
                for curves in plot.curves:
                    send_curves(stream, time, curves)


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


def _times(sweep: SweepRecording) -> Float[np.ndarray, " time"]:
    arrivals = np.concatenate([trials.arrival for trials in sweep.experiments.values()])
    latest = arrivals[np.isfinite(arrivals)].max(initial=0.0)
    return np.linspace(0.0, 1.05 * latest or 1.0, _SAMPLES)


def _success(sweep: SweepRecording, trials: SweptTrials) -> list[float]:
    """Of each class [%]; none where it has no trials."""
    groups = [trials.of(group).success for group in range(len(sweep.groups))]
    return [100 * float(success.mean()) if len(success) else 0.0 for success in groups]


def _bars(name: str) -> str:
    return f"success/{slug(name)}"


def _table(sweep: SweepRecording) -> str:
    """What was measured, as Markdown."""
    heads = ["experiment", "trials", "success [%]", *sweep.groups, "median [s]", "95 % [s]"]
    lines = [f"# {sweep.title}", "", _line(heads), _line(["---"] * len(heads))]
    for name, trials in sweep.experiments.items():
        ordered = np.sort(trials.arrival)
        when = [ordered[int(np.ceil(share * len(ordered))) - 1] for share in (0.5, 0.95)]
        lines.append(
            _line(
                [
                    name,
                    str(len(ordered)),
                    f"{100 * trials.success.mean():.1f}",
                    *(f"{share:.0f}" for share in _success(sweep, trials)),
                    *(f"{t:.2f}" if np.isfinite(t) else "never" for t in when),
                ]
            )
        )
    return "\n".join([*lines, "", "Success by class in percent; times until on target."])


def _line(cells: list[str]) -> str:
    return f"| {' | '.join(cells)} |"


def _blueprint(sweep: SweepRecording, tabs: list[Tab]) -> rrb.Blueprint:
    bars = [
        rrb.BarChartView(
            origin=_bars(name),
            name=f"{name}: success [%]",
            plot_legend=rrb.PlotLegend(visible=False),
        )
        for name in sweep.experiments
    ]
    order = f"Success by class: {', '.join(sweep.groups)}"
    success = rrb.Grid(contents=bars, grid_columns=_COLUMNS, name=order)
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.TextDocumentView(origin="/summary", name="Sweep"),
            rrb.Tabs(contents=[*(tab_view(tab) for tab in tabs), success], active_tab=0),
            column_shares=[1, 1],
        ),
        rrb.TimePanel(state="collapsed", timeline=TIMELINE),
        collapse_panels=True,
    )
