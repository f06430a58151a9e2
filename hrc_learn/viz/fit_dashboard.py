"""A fit as one Rerun recording: demonstrations beside their reproductions."""

import os

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from . import palette
from .panels import Plot, Tab, joint_plot, joints_title, several
from .recording import FitRecording
from .rerun_file import (
    TIMELINE,
    boxes,
    look_at_all,
    rrd_file,
    samples,
    seconds,
    send_curves,
    tab_view,
    thin,
)

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
                eye_controls=look_at_all(every, base=bool(fit.boxes)),
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
