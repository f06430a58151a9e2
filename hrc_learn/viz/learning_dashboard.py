"""Learning in rounds as one Rerun recording: convergence, neurons on their way, errors."""

import os

import matplotlib
import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from . import palette
from .learning_recording import ErrorMap, LearningRecording
from .panels import Curves, Plot, Tab, single, slug
from .rerun_file import rrd_file, send_rows, style, tab_view, thin

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
    with rrd_file(path, learning.title, _blueprint(learning, tab)) as stream:
        summary = rr.TextDocument(_summary(learning), media_type="text/markdown")
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


def _summary(learning: LearningRecording) -> str:
    """What came of it, as Markdown."""
    lines = [f"# {learning.title}", ""]
    if learning.curves:
        last = len(learning.centers) - 1
        lines += [f"Round {learning.best} of {last} was kept: the dots.", ""]
    lines += ["| measured | value |", "|---|---|"]
    lines += [f"| {n.replace('_', ' ')} | {v:.4g} |" for n, v in learning.measured.items()]
    return "\n".join(lines)


def _blueprint(learning: LearningRecording, tab: Tab) -> rrb.Blueprint:
    left: list[rrb.View] = [rrb.TextDocumentView(origin="/summary", name="Fit")]
    every = learning.paths or [path for path in learning.centers if len(path)]
    if every:
        left.insert(
            0,
            rrb.Spatial3DView(
                origin="/world",
                name="Hand (grey), neurons (orange), error on held-out image motion (blue)",
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
