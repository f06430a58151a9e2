"""Rerun recordings of demonstrations and of models learned from them.

Demonstrations are shown together and one by one, primitives with their demonstrations, and
image Jacobians by the convergence and neurons of their learning rounds.
"""

import os
from dataclasses import dataclass

import matplotlib
import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from jaxtyping import Float

from hrc_learn.log.recordings import (
    DemonstrationsRecording,
    DemonstrationTrace,
    ErrorMap,
    FitRecording,
    LearningRecording,
)
from hrc_learn.viz import palette
from hrc_learn.viz.panels import (
    Curves,
    Plot,
    Tab,
    joint_plot,
    joints_title,
    limit_curves,
    several,
    single,
    slug,
)
from hrc_learn.viz.rerun_stream import (
    StaticShapes,
    dashboard,
    frame_view,
    markdown_table,
    rrd_file,
    samples,
    seconds,
    send_curves,
    send_poses,
    send_rows,
    send_shapes,
    send_summary,
    send_tab,
    style,
    tab_view,
    thin,
)

# Poses and dots sent a second: as many as the eye sees.
_POSE_RATE = 30.0

Timed = tuple[Float[np.ndarray, "_"], Curves]
"""Curves, and the times of their samples [s]."""
DemonstrationView = tuple[Tab, list[Timed]]
"""A tab, and all that is drawn in it."""


def record_demonstrations(
    path: str | os.PathLike[str], shown: DemonstrationsRecording, *, most: int = 8
) -> None:
    """Write demonstrations as an .rrd file with its layout; `rerun FILE` shows it.

    Args:
        path: File to write; it appears only when complete.
        shown: The demonstrations.
        most: Number of demonstrations with a tab of their own; all are drawn together.
    """
    views = [_together(shown), *(_alone(shown, d) for d in shown.demonstrations[:most])]
    left: list[rrb.View] = [rrb.TextDocumentView(origin="/summary", name="Demonstrations")]
    paths = [demo.position for demo in shown.demonstrations if demo.position is not None]
    first = shown.demonstrations[0]
    if paths:
        arm = f"; the arm in episode {first.episode}" if first.bodies else ""
        name, eye = (
            f"Paths of the end effector, dots: now{arm}",
            frame_view(np.concatenate(paths)),
        )
        left.insert(0, rrb.Spatial3DView(origin="/world", name=name, eye_controls=eye))
    pages: list[rrb.Container] = [tab_view(tab) for tab, _ in views]
    for k, demo in enumerate(shown.demonstrations[:most], start=1):
        if demo.images:
            pages[k] = _below_images(pages[k], f"Episode {demo.episode}", _cameras(demo))
    tabs = rrb.Tabs(contents=pages, active_tab=0)
    layout = dashboard(left, [tabs], row_shares=(2, 1), column_shares=(2, 3))
    with rrd_file(path, shown.title, layout) as stream:
        for k, demo in enumerate(shown.demonstrations):
            if demo.position is not None:
                colour = palette.rgba(_colour(k))
                strip = rr.LineStrips3D([thin(demo.position)], radii=[0.003], colors=[colour])
                stream.log(f"world/paths/{demo.episode}", strip, static=True)
                _send_dot(stream, str(demo.episode), demo.time, demo.position, _colour(k))
        still = StaticShapes(stream)
        for body in first.bodies:
            send_shapes(still, body)
            send_poses(stream, first.time, body, samples(first.time, _POSE_RATE))
        for demo in shown.demonstrations[:most]:
            _send_images(stream, _cameras(demo))
        send_summary(stream, _recorded(shown))
        for _, curves in views:
            for time, curve in curves:
                send_curves(stream, time, curve)


@dataclass(frozen=True)
class _Camera:
    """Images of a camera, and their entity path."""

    path: str
    name: str
    time: Float[np.ndarray, "_"]
    images: tuple[bytes, ...]


def _cameras(demo: DemonstrationTrace) -> list[_Camera]:
    return [
        _Camera(f"episode_{demo.episode}/cameras/{slug(name)}", name, time, images)
        for name, (time, images) in demo.images.items()
    ]


def _below_images(page: rrb.Container, title: str, cameras: list[_Camera]) -> rrb.Container:
    """Layout of a tab below the camera images."""
    views = [rrb.Spatial2DView(origin=f"/{seen.path}", name=seen.name) for seen in cameras]
    return rrb.Vertical(rrb.Horizontal(*views), page, row_shares=(1, 3), name=title)


def _send_images(stream: rr.RecordingStream, cameras: list[_Camera]) -> None:
    for camera in cameras:
        columns = rr.EncodedImage.columns(
            blob=camera.images, media_type=["image/jpeg"] * len(camera.images)
        )
        stream.send_columns(camera.path, seconds(camera.time), columns)


def _together(shown: DemonstrationsRecording) -> DemonstrationView:
    """Tab with every joint and the feature of all demonstrations together."""
    drawn = [
        (f"{name} [rad]", _limits(shown, j) + _over_one_another(shown, "joint_position", j))
        for j, name in enumerate(shown.joint_names)
    ]
    drawn += [
        (f"Feature {pixel} [px]", _over_one_another(shown, "feature", column))
        for column, pixel in enumerate("uv")
    ]
    plots = tuple(
        Plot(title=title, curves=tuple(curves for _, curves in timed))
        for title, timed in drawn
        if timed
    )
    title = "All: joints" + ", limits red" * (shown.joint_limits is not None)
    return Tab(title=title, plots=plots, columns=2), [t for _, timed in drawn for t in timed]


def _over_one_another(
    shown: DemonstrationsRecording, quantity: str, column: int
) -> list[Timed]:
    """Curves of one column of a quantity, for all demonstrations that have it."""
    timed = []
    for k, demo in enumerate(shown.demonstrations):
        values = getattr(demo, quantity)
        if values is not None:
            path = f"together/{quantity}_{column}/{demo.episode}"
            name = f"episode {demo.episode}"
            timed.append((demo.time, single(path, name, values[:, column], _colour(k))))
    return timed


def _limits(shown: DemonstrationsRecording, joint: int) -> list[Timed]:
    if shown.joint_limits is None:
        return []
    time = max((demo.time for demo in shown.demonstrations), key=lambda time: time[-1])
    path = f"together/limits_{joint}"
    return [(time, limit_curves(path, shown.joint_limits, joint, len(time)))]


def _colour(k: int) -> str:
    """Colour of demonstration k."""
    return palette.SERIES_ON_DARK[k % len(palette.SERIES_ON_DARK)]


def _alone(shown: DemonstrationsRecording, demo: DemonstrationTrace) -> DemonstrationView:
    """Tab with all recorded quantities of one demonstration."""
    plots = []
    for title, name, names, values in (
        ("Joints [rad]", "joints", shown.joint_names, demo.joint_position),
        ("Tool centre point [m]", "position", ("x", "y", "z"), demo.position),
        ("Feature in the image [px]", "feature", ("u (right)", "v (down)"), demo.feature),
        ("Effort of the person [N m]", "effort", shown.joint_names, demo.human_effort),
        ("Gripper [m]", "gripper", ("opening",), demo.gripper),
    ):
        if values is not None:
            columns = values.reshape(len(values), -1)
            curves = several(f"episode_{demo.episode}/{name}", names, columns)
            plots.append(Plot(title=title, curves=(curves,), legend=True))
    curves = [(demo.time, curves) for plot in plots for curves in plot.curves]
    return Tab(title=f"Episode {demo.episode}", plots=tuple(plots)), curves


def _send_dot(
    stream: rr.RecordingStream,
    name: str,
    time: Float[np.ndarray, " time"],
    path: Float[np.ndarray, "time 3"],
    colour: str,
) -> None:
    """Send a dot that moves along a path."""
    look = rr.Points3D.from_fields(radii=[0.012], colors=[palette.rgba(colour)])
    stream.log(f"world/now/{name}", look, static=True)
    at = samples(time, _POSE_RATE)
    columns = rr.Points3D.columns(positions=path[at])
    stream.send_columns(f"world/now/{name}", seconds(time[at]), columns)


def _recorded(shown: DemonstrationsRecording) -> str:
    """Summary of the demonstrations, as Markdown."""
    rows = [
        (
            demo.episode,
            demo.task,
            f"{demo.duration:.2f}",
            len(demo.time),
            "" if demo.length is None else f"{demo.length:.2f}",
        )
        for demo in shown.demonstrations
    ]
    heads = ("episode", "task", "duration [s]", "frames", "path [m]")
    notes = [f"- {note}" for note in shown.notes]
    return "\n".join([f"# {shown.title}", "", *markdown_table(heads, rows), "", *notes])


def record_fit(path: str | os.PathLike[str], fit: FitRecording, *, most: int = 6) -> None:
    """Write demonstrations and reproductions as an .rrd file with its layout.

    Args:
        path: File to write; it appears only when complete.
        fit: Demonstrations and reproductions.
        most: Demonstrations that get a tab of their own; all are drawn in 3D.
    """
    tabs = fit_tabs(fit, most)
    left: list[rrb.View] = [rrb.TextDocumentView(origin="/summary", name="Fit")]
    if every := [*fit.demo_paths, *fit.reproduction_paths]:
        name = "Paths: demonstrations (grey), reproductions (blue, dots: now)"
        eye = frame_view(np.concatenate(every), base=False)
        left.insert(0, rrb.Spatial3DView(origin="/world", name=name, eye_controls=eye))
    pages: list[rrb.Container] = [tab_view(tab) for tab in tabs]
    right = rrb.Tabs(contents=pages, active_tab=0)
    layout = dashboard(left, [right], row_shares=(1, 1), column_shares=(2, 3))
    with rrd_file(path, fit.title, layout) as stream:
        for name, paths, colour, radius in (
            ("demonstrations", fit.demo_paths, palette.DEMO, 0.004),
            ("reproductions", fit.reproduction_paths, palette.RUN_ON_DARK, 0.002),
        ):
            if paths:
                _send_strips(stream, name, paths, colour, radius)
        for i, (time, line) in enumerate(zip(fit.time, fit.reproduction_paths, strict=False)):
            _send_dot(stream, str(i + 1), time, line, palette.RUN_ON_DARK)
        send_summary(stream, _fitted(fit))
        for tab, time in zip(tabs, fit.time, strict=False):
            send_tab(stream, time, tab)


def fit_tabs(fit: FitRecording, most: int) -> list[Tab]:
    """One tab of joint plots for each of the first demonstrations."""
    tabs = []
    for i, (demo, reproduction) in enumerate(
        list(zip(fit.demos, fit.reproductions, strict=True))[:most], start=1
    ):
        root = f"demonstration_{i}"
        plots = [
            joint_plot(root, name, j, reproduction, demo, fit.joint_limits, fit.unit)
            for j, name in enumerate(fit.joint_names)
        ]
        error = several(f"{root}/error", fit.joint_names, 1e3 * (reproduction - demo))
        plots.append(Plot(title=f"Error, all together [m{fit.unit}]", curves=(error,)))
        tabs.append(Tab(title=f"Demonstration {i}", plots=tuple(plots), columns=2))
    return tabs


def _send_strips(
    stream: rr.RecordingStream,
    name: str,
    paths: tuple[Float[np.ndarray, "_ 3"], ...],
    colour: str,
    radius: float,
) -> None:
    """Send static lines [m]."""
    thinned, colours = [thin(path) for path in paths], [palette.rgba(colour)]
    strips = rr.LineStrips3D(thinned, radii=radius, colors=colours)
    stream.log(f"world/{name}", strips, static=True)


def _fitted(fit: FitRecording) -> str:
    """Summary of the fit, as Markdown."""
    limits = fit.joint_limits is not None
    rows = [
        (i, f"{time[-1] - time[0]:.2f}", f"{1e3 * np.abs(reproduction - demo).max():.3g}")
        for i, (time, demo, reproduction) in enumerate(
            zip(fit.time, fit.demos, fit.reproductions, strict=True), start=1
        )
    ]
    heads = ("demonstration", "duration [s]", f"largest error [m{fit.unit}]")
    lines = [f"# {fit.title}", "", joints_title(True, limits, position="reproduction"), ""]
    lines += markdown_table(heads, rows)
    if fit.residual:
        counts = [
            (f"{n} (used)" if n == fit.n_basis else n, f"{residual:.3g}")
            for n, residual in sorted(fit.residual.items())
        ]
        lines += ["", *markdown_table(("basis functions", "normalised RMS error"), counts)]
    return "\n".join(lines)


ROUND = "round"
"""Timeline of learning, with one step per round."""

_THICKNESS = 0.002  # of the error map's cells [m]


def record_learning(path: str | os.PathLike[str], learning: LearningRecording) -> None:
    """Write the rounds of learning as an .rrd file with its layout; `rerun FILE` shows it.

    Args:
        path: File to write; it appears only when complete.
        learning: Recording of the rounds.
    """
    tab = learning_tab(learning)
    left: list[rrb.View] = [rrb.TextDocumentView(origin="/summary", name="Fit")]
    if every := learning.paths or [path for path in learning.centers if len(path)]:
        name = "End effector (grey), neurons (orange), held-out error (blue)"
        eye = _look_down(np.concatenate(every))
        left.insert(0, rrb.Spatial3DView(origin="/world", name=name, eye_controls=eye))
    right = [tab_view(tab)] if tab.plots else []
    layout = dashboard(left, right, row_shares=(3, 2), timeline=ROUND)
    with rrd_file(path, learning.title, layout) as stream:
        send_summary(stream, _learned(learning))
        if learning.paths:
            _send_strips(stream, "demonstrations", learning.paths, palette.DEMO, 0.0008)
        if learning.errors is not None:
            stream.log("world/errors", _cells(learning.errors), static=True)
        _send_neurons(stream, learning.centers)
        for plot in tab.plots:
            curve, kept = plot.curves
            stream.log(curve.path, style(curve), static=True)
            send_rows(stream, _rounds(np.arange(len(curve.values))), curve)
            dot = rr.SeriesPoints(names=kept.names, colors=kept.colours, marker_sizes=[6.0])
            stream.log(kept.path, dot, static=True)
            send_rows(stream, _rounds(np.array([learning.best])), kept)


def learning_tab(learning: LearningRecording) -> Tab:
    """A plot for each curve, with a dot at the round that was kept."""
    plots = []
    for name, values in learning.curves.items():
        path, kept = f"learning/{slug(name)}", values[[learning.best]]
        curve = single(path, name, values, palette.RUN_ON_DARK)
        dot = single(f"{path}/kept", "kept", kept, palette.LIMIT)
        plots.append(Plot(title=name, curves=(curve, dot)))
    return Tab(title="Convergence over rounds, red: kept", plots=tuple(plots), columns=2)


def _send_neurons(
    stream: rr.RecordingStream, centers: Float[np.ndarray, "rounds neurons 3"]
) -> None:
    rounds, neurons, _ = centers.shape
    if neurons:
        look = rr.Points3D.from_fields(radii=[0.008], colors=[palette.rgba(palette.ORANGE)])
        stream.log("world/neurons", look, static=True)
        columns = rr.Points3D.columns(positions=centers.reshape(-1, 3))
        when = _rounds(np.arange(rounds))
        stream.send_columns("world/neurons", when, columns.partition([neurons] * rounds))


def _rounds(numbers: np.ndarray) -> list[rr.TimeColumn]:
    return [rr.TimeColumn(ROUND, sequence=numbers)]


def _cells(errors: ErrorMap) -> rr.Boxes3D:
    """Flat boxes, the darker the larger the error, with the error in percent on them."""
    x, y = (np.convolve(edges, (0.5, 0.5), mode="valid") for edges in (errors.x, errors.y))
    known = np.isfinite(errors.relative_error)
    relative, flat = errors.relative_error[known], np.full(int(known.sum()), _THICKNESS)
    middle = [grid[known] for grid in np.meshgrid(x, y, indexing="ij")]
    size = np.meshgrid(np.diff(errors.x), np.diff(errors.y), indexing="ij")
    # From a pale blue to one on which black figures can still be read.
    shades = matplotlib.colormaps["Blues"](0.15 + 0.5 * relative / relative.max(initial=1e-12))
    return rr.Boxes3D(
        centers=np.stack([*middle, np.full_like(flat, errors.z)], axis=-1),
        half_sizes=np.stack([*(grid[known] / 2 for grid in size), flat], axis=-1),
        colors=(255 * shades).astype(np.uint8),
        labels=[f"{100 * value:.1f} %" for value in relative],
        show_labels=True,
        fill_mode=rr.components.FillMode.Solid,
    )


def _learned(learning: LearningRecording) -> str:
    """Summary of the learning, as Markdown."""
    lines = [f"# {learning.title}", ""]
    if learning.curves:
        last = len(learning.centers) - 1
        lines += [f"Round {learning.best} of {last} was kept: the dots.", ""]
    rows = [(n.replace("_", " "), f"{value:.4g}") for n, value in learning.measured.items()]
    return "\n".join([*lines, *markdown_table(("measured", "value"), rows)])


def _look_down(points: np.ndarray) -> rrb.EyeControls3D:
    """An eye above the workspace, so near and steep that every cell can be read."""
    low, high = points.min(axis=0), points.max(axis=0)
    middle, reach = (low + high) / 2, max(float(np.linalg.norm(high - low)), 0.2)
    return rrb.EyeControls3D(
        position=middle + reach * np.array([0.75, 0.2, 1.0]),
        look_target=middle,
        eye_up=(0.0, 0.0, 1.0),
    )
