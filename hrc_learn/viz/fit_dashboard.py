"""Fits as Rerun recordings: primitives beside their demonstrations, and image Jacobians
learned in rounds.
"""

import os

import matplotlib
import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from hrc_learn.viz import palette
from hrc_learn.viz.panels import (
    Curves,
    Plot,
    Tab,
    joint_plot,
    joints_title,
    several,
    single,
    slug,
)
from hrc_learn.viz.recordings import ErrorMap, FitRecording, LearningRecording
from hrc_learn.viz.rerun_stream import (
    TIMELINE,
    boxes,
    frame_view,
    rrd_file,
    samples,
    seconds,
    send_curves,
    send_rows,
    style,
    tab_view,
    thin,
)

# A fit as one Rerun recording: demonstrations beside their reproductions.

_POINT_RATE = 30.0


def record_fit(path: str | os.PathLike[str], fit: FitRecording, *, most: int = 6) -> None:
    """Write demonstrations and reproductions as an .rrd file with its layout.

    Args:
        path: File to write; it appears only when complete.
        fit: What was fitted.
        most: Demonstrations that get a tab of their own; all are drawn in 3D.
    """
    tabs = fit_tabs(fit, most)
    with rrd_file(path, fit.title, _blueprint(fit, tabs)) as stream:
        _send_paths(stream, fit)
        stream.log(
            "summary", rr.TextDocument(_summary(fit), media_type="text/markdown"), static=True
        )
        for tab, time in zip(tabs, fit.time, strict=False):
            for plot in tab.plots:
                for curves in plot.curves:
                    send_curves(stream, time, curves)


def fit_tabs(fit: FitRecording, most: int) -> list[Tab]:
    """One tab of joint plots for each of the first demonstrations."""
    tabs = []
    for i in range(min(most, len(fit.demos))):
        demo, reproduction = fit.demos[i], fit.reproductions[i]
        root = f"demonstration_{i + 1}"
        plots = [
            joint_plot(root, name, j, reproduction, demo, fit.joint_limits, fit.unit)
            for j, name in enumerate(fit.joint_names)
        ]
        error = several(f"{root}/error", fit.joint_names, 1e3 * (reproduction - demo))
        plots.append(Plot(title=f"Error, all together [m{fit.unit}]", curves=(error,)))
        tabs.append(Tab(title=f"Demonstration {i + 1}", plots=tuple(plots), columns=2))
    return tabs


def _send_paths(stream: rr.RecordingStream, fit: FitRecording) -> None:
    if fit.boxes:
        stream.log("world/scene", boxes(fit.boxes), static=True)
    for name, paths, colour, radius in (
        ("demonstrations", fit.demo_paths, palette.DEMO, 0.004),
        ("reproductions", fit.reproduction_paths, palette.RUN_ON_DARK, 0.002),
    ):
        if paths:
            strips = rr.LineStrips3D(
                [thin(path) for path in paths], radii=radius, colors=[palette.rgba(colour)]
            )
            stream.log(f"world/{name}", strips, static=True)
    for i, (time, path) in enumerate(zip(fit.time, fit.reproduction_paths, strict=False)):
        style = rr.Points3D.from_fields(
            radii=[0.012], colors=[palette.rgba(palette.RUN_ON_DARK)]
        )
        at = samples(time, _POINT_RATE)
        entity = f"world/now/{i + 1}"
        stream.log(entity, style, static=True)
        columns = rr.Points3D.columns(positions=path[at])
        stream.send_columns(entity, seconds(time[at]), columns)


def _summary(fit: FitRecording) -> str:
    """What was fitted, as Markdown."""
    limits = fit.joint_limits is not None
    lines = [f"# {fit.title}", "", joints_title(True, limits, position="reproduction")]
    worst = [
        1e3 * np.abs(r - d).max() for r, d in zip(fit.reproductions, fit.demos, strict=True)
    ]
    lines += ["", f"| demonstration | duration [s] | largest error [m{fit.unit}] |"]
    lines += ["|---|---|---|"]
    for i, (time, error) in enumerate(zip(fit.time, worst, strict=True)):
        lines.append(f"| {i + 1} | {time[-1] - time[0]:.2f} | {error:.3g} |")
    if fit.residual:
        lines += ["", "| basis functions | normalised RMS error |", "|---|---|"]
        for n, residual in sorted(fit.residual.items()):
            used = " (used)" if n == fit.n_basis else ""
            lines.append(f"| {n}{used} | {residual:.3g} |")
    return "\n".join(lines)


def _blueprint(fit: FitRecording, tabs: list[Tab]) -> rrb.Blueprint:
    left: list[rrb.View] = []
    if fit.demo_paths or fit.reproduction_paths:
        every = np.concatenate([*fit.demo_paths, *fit.reproduction_paths])
        left.append(
            rrb.Spatial3DView(
                origin="/world",
                name="Paths: demonstrations (grey), reproductions (blue, dots: now)",
                eye_controls=frame_view(every, base=bool(fit.boxes)),
            )
        )
    left.append(rrb.TextDocumentView(origin="/summary", name="Fit"))
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(contents=left, row_shares=[1, 1][: len(left)]),
            rrb.Tabs(contents=[tab_view(tab) for tab in tabs], active_tab=0),
            column_shares=[2, 3],
        ),
        rrb.TimePanel(state="collapsed", timeline=TIMELINE),
        collapse_panels=True,
    )


# Learning in rounds as one Rerun recording: convergence, neurons on their way, errors.

ROUND = "round"
"""The timeline: every round one step."""

_COLUMNS = 2
_THICKNESS = 0.002  # of the error map's cells [m]


def record_learning(path: str | os.PathLike[str], learning: LearningRecording) -> None:
    """Write it as an .rrd file with its layout; `rerun FILE` shows it.

    Args:
        path: File to write; it appears only when complete.
        learning: What was learned, and how.
    """
    tab = learning_tab(learning)
    with rrd_file(path, learning.title, _learning_blueprint(learning, tab)) as stream:
        summary = rr.TextDocument(_learning_summary(learning), media_type="text/markdown")
        stream.log("summary", summary, static=True)
        _send_world(stream, learning)
        for plot in tab.plots:
            curve, kept = plot.curves
            stream.log(curve.path, style(curve), static=True)
            send_rows(stream, _rounds(np.arange(len(curve.values))), curve)
            stream.log(kept.path, _dot(kept), static=True)
            send_rows(stream, _rounds(np.array([learning.best])), kept)


def learning_tab(learning: LearningRecording) -> Tab:
    """A plot for each curve, with a dot at the round that was kept."""
    plots = []
    for name, values in learning.curves.items():
        path, kept = f"learning/{slug(name)}", values[[learning.best]]
        curve = single(path, name, values, palette.RUN_ON_DARK)
        dot = single(f"{path}/kept", "kept", kept, palette.LIMIT)
        plots.append(Plot(title=name, curves=(curve, dot)))
    return Tab(title="Convergence over rounds, red: kept", plots=tuple(plots), columns=_COLUMNS)


def _send_world(stream: rr.RecordingStream, learning: LearningRecording) -> None:
    if learning.paths:
        strips = [thin(path) for path in learning.paths]
        grey = palette.rgba(palette.DEMO)
        drawn = rr.LineStrips3D(strips, radii=0.0008, colors=[grey])
        stream.log("world/demonstrations", drawn, static=True)
    if learning.errors is not None:
        stream.log("world/errors", _cells(learning.errors), static=True)
    rounds, neurons, _ = learning.centers.shape
    if neurons:
        look = rr.Points3D.from_fields(radii=[0.008], colors=[palette.rgba(palette.ORANGE)])
        stream.log("world/neurons", look, static=True)
        columns = rr.Points3D.columns(positions=learning.centers.reshape(-1, 3))
        when = _rounds(np.arange(rounds))
        stream.send_columns("world/neurons", when, columns.partition([neurons] * rounds))


def _rounds(numbers: np.ndarray) -> list[rr.TimeColumn]:
    return [rr.TimeColumn(ROUND, sequence=numbers)]


def _dot(curves: Curves) -> rr.SeriesPoints:
    return rr.SeriesPoints(names=curves.names, colors=curves.colours, marker_sizes=[6.0])


def _cells(errors: ErrorMap) -> rr.Boxes3D:
    """Flat boxes, the darker the larger the error, with the error in percent on them."""
    x, y = np.meshgrid(_middles(errors.x), _middles(errors.y), indexing="ij")
    half = np.meshgrid(np.diff(errors.x) / 2, np.diff(errors.y) / 2, indexing="ij")
    known = np.isfinite(errors.share)
    share, flat = errors.share[known], np.full(int(known.sum()), _THICKNESS)
    shades = matplotlib.colormaps["Blues"](0.15 + 0.5 * share / share.max(initial=1e-12))
    return rr.Boxes3D(
        centers=np.stack([x[known], y[known], errors.z + 0 * flat], axis=-1),
        half_sizes=np.stack([half[0][known], half[1][known], flat], axis=-1),
        colors=(255 * shades).astype(np.uint8),
        labels=[f"{100 * value:.1f} %" for value in share],
        show_labels=True,
        fill_mode=rr.components.FillMode.Solid,
    )


def _middles(edges: np.ndarray) -> np.ndarray:
    return (edges[:-1] + edges[1:]) / 2


def _learning_summary(learning: LearningRecording) -> str:
    """What came of it, as Markdown."""
    lines = [f"# {learning.title}", ""]
    if learning.curves:
        last = len(learning.centers) - 1
        lines += [f"Round {learning.best} of {last} was kept: the dots.", ""]
    lines += ["| measured | value |", "|---|---|"]
    lines += [f"| {n.replace('_', ' ')} | {v:.4g} |" for n, v in learning.measured.items()]
    return "\n".join(lines)


def _learning_blueprint(learning: LearningRecording, tab: Tab) -> rrb.Blueprint:
    left: list[rrb.View] = [rrb.TextDocumentView(origin="/summary", name="Fit")]
    every = learning.paths or [path for path in learning.centers if len(path)]
    if every:
        left.insert(
            0,
            rrb.Spatial3DView(
                origin="/world",
                name="End effector (grey), neurons (orange), held-out error (blue)",
                eye_controls=_look_down(np.concatenate(every)),
            ),
        )
    columns: list[rrb.Container | rrb.View] = [
        rrb.Vertical(contents=left, row_shares=[3, 2][: len(left)])
    ]
    if tab.plots:
        columns.append(tab_view(tab))
    return rrb.Blueprint(
        rrb.Horizontal(contents=columns, column_shares=[1] * len(columns)),
        rrb.TimePanel(state="collapsed", timeline=ROUND),
        collapse_panels=True,
    )


def _look_down(points: np.ndarray) -> rrb.EyeControls3D:
    """An eye above the workspace, so near and steep that every cell can be read."""
    low, high = points.min(axis=0), points.max(axis=0)
    middle, reach = (low + high) / 2, max(float(np.linalg.norm(high - low)), 0.2)
    return rrb.EyeControls3D(
        position=middle + reach * np.array([0.75, 0.2, 1.0]),
        look_target=middle,
        eye_up=(0.0, 0.0, 1.0),
    )
