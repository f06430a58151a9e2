"""Figures of runs and fits for reports and papers.

Plain matplotlib `Figure` objects: no pyplot, no global state, no window. Every function takes
the recording that the dashboards take, and raises ValueError where it lacks the data.
"""

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, StrMethodFormatter

from . import palette
from .figure_parts import (
    STYLE,
    WIDTH,
    draw_box,
    draw_limits,
    finite_span,
    frame_space,
    legend_in_free_cell,
    near,
    needed,
    scaled,
    shade,
    space,
)
from .recording import FitRecording, JointLimits, RunRecording


def image_figure(run: RunRecording) -> Figure:
    """Path of the feature over the image, and its distance from the target over time."""
    camera = needed(run.camera, "camera")
    servoing = np.isfinite(camera.error)
    if not servoing.any():
        raise ValueError("feature and target were never known together: nothing to draw.")
    path = np.where(servoing[:, None], camera.feature, np.nan)
    first, last = np.flatnonzero(servoing)[[0, -1]]
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, 2.9))
        image, error = figure.subplots(1, 2, width_ratios=[1.15, 1])
        if camera.images:
            final = np.searchsorted(camera.image_time, run.time[last], side="right") - 1
            image.imshow(camera.images[max(final, 0)], alpha=0.55)
        image.plot(*camera.feature.T, color=palette.RUN, alpha=0.3, lw=1.0)
        image.plot(*path.T, color=palette.RUN, label="feature")
        image.plot(*path[first], "o", color=palette.ORANGE, ms=5, label="start")
        image.plot(*camera.target[last], "+", color=palette.LIMIT, ms=13, mew=2, label="target")
        image.set(
            xlim=(0, camera.model.width),
            ylim=(camera.model.height, 0),
            aspect="equal",
            xlabel="u [px]",
            ylabel="v [px]",
            title="Path of the feature in the image",
        )
        image.legend(loc="best", frameon=True, framealpha=0.75, edgecolor="none")
        error.plot(run.time, camera.error, color=palette.RUN)
        error.set(xlabel="time [s]", ylabel="distance to target [px]", title="Pixel error")
        # From hundreds of pixels to a fraction of one: a linear scale would hide the end.
        error.set_yscale("log")
        error.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        finite_span(error, run.time, servoing)
    return figure


def paths_figure(run: RunRecording) -> Figure:
    """Path of the tool centre point in space, with the demonstration, boxes and region."""
    lines = [
        ("demonstration", run.demo_path, palette.DEMO, 4.0),
        ("plan", run.plan_path, palette.ORANGE, 3.0),
        ("run", run.position, palette.RUN, 1.4),
    ]
    shown = [line for line in lines if line[1] is not None]
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, 5.2))
        axes = space(figure)
        points = np.concatenate([path for _, path, _, _ in shown if path is not None])
        for box in near(run.boxes, points):
            draw_box(axes, box, "#8D8F94", alpha=0.10)
        if run.region is not None:
            draw_box(axes, run.region, palette.GREEN, alpha=0.15)
        for label, path, colour, width in shown:
            assert path is not None
            axes.plot(*path.T, color=colour, lw=width, label=label)
        axes.plot(*run.position[0], "o", color=palette.RUN, ms=4)
        axes.plot(*run.position[-1], "s", color=palette.RUN, ms=4)
        axes.legend(loc="upper left")
        axes.set_title("Path of the tool centre point (dot: start, square: end)", loc="left")
        frame_space(axes, points)
    return figure


def joints_figure(run: RunRecording) -> Figure:
    """Every joint over time, with its demonstration and its limits."""
    return _joints(
        run.joint_names,
        [(run.time, run.joint_position)],
        [] if run.demo_joint_position is None else [(run.time, run.demo_joint_position)],
        run.joint_limits,
        label="run",
    )


def fit_joints_figure(fit: FitRecording, most: int = 4) -> Figure:
    """Every joint of the first demonstrations and of their reproductions."""
    reproductions = list(zip(fit.time, fit.reproductions, strict=True))[:most]
    demos = list(zip(fit.time, fit.demos, strict=True))[:most]
    return _joints(
        fit.joint_names,
        reproductions,
        demos,
        fit.joint_limits,
        label="reproduction",
        unit=fit.unit,
    )


def person_figure(run: RunRecording) -> Figure:
    """Effort of the person, elbow motion, and what the end effector noticed of it.

    The spells in which the person acted are shaded.
    """
    effort = needed(run.human_effort, "human_effort")
    acting = np.linalg.norm(effort, axis=1) > 0
    rows = [
        ("effort d [N m]", "Null-space effort of the person, by joint", effort),
        ("elbow [mm]", "Elbow moved", scaled(run.elbow_motion, 1e3)),
        ("position [mm]", "Deviation of the end effector", scaled(run.position_deviation, 1e3)),
        ("rotation [deg]", "", scaled(run.rotation_deviation, 180 / np.pi)),
    ]
    shown = [row for row in rows if row[2] is not None]
    # Deviations are known while the person is about; without them the whole run is shown.
    known = [np.isfinite(values) for _, _, values in shown[1:] if values is not None]
    about = np.logical_or.reduce([acting, *known])
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, 1.0 + 1.35 * len(shown)))
        column = figure.subplots(len(shown), 1, sharex=True, squeeze=False)[:, 0]
        for axes, (label, title, values) in zip(column, shown, strict=True):
            assert values is not None
            shade(axes, run.time, acting)
            axes.plot(run.time, values, color=None if values.ndim == 2 else palette.RUN)
            axes.set(ylabel=label, title=title)
            axes.margins(x=0)
            if values.ndim == 1:
                axes.set_ylim(bottom=0)
        column[0].legend(
            column[0].get_lines(),
            run.joint_names,
            ncols=1,
            loc="center left",
            bbox_to_anchor=(1.0, 0.5),
        )
        finite_span(column[-1], run.time, about)
        column[-1].set_xlabel("time [s] (shaded: the person acts)")
        figure.align_ylabels()
    return figure


def image_jacobian_figure(run: RunRecording) -> Figure:
    """The twelve entries of the estimated image Jacobian, against the true ones if known."""
    estimate = needed(run.image_jacobian, "image_jacobian")
    true = run.true_image_jacobian
    known = np.asarray(np.isfinite(estimate).all(axis=(1, 2)))
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, 4.6))
        grid = figure.subplots(2, 2, sharex=True)
        for row, pixel in enumerate("uv"):
            for column, (symbol, unit) in enumerate((("v", "px/m"), ("ω", "px/rad"))):
                axes = grid[row, column]
                for k, axis in enumerate("xyz"):
                    colour, entry = palette.SERIES[k], 3 * column + k
                    if true is not None:
                        values = np.where(known, true[:, row, entry], np.nan)
                        axes.plot(run.time, values, color=colour, lw=4, alpha=0.3)
                    axes.plot(run.time, estimate[:, row, entry], color=colour, label=axis)
                of = "linear" if column == 0 else "angular"
                axes.set_title(f"∂{pixel} by {of} velocity {symbol}")
                axes.set_ylabel(unit)
                finite_span(axes, run.time, known)
        grid[0, 0].legend(ncols=3, loc="best")
        against = "" if true is None else " (wide and pale: true, thin: estimate)"
        for axes in grid[1]:
            axes.set_xlabel("time [s]")
        figure.suptitle(f"Image Jacobian{against}", x=0.01, ha="left", fontsize=10)
    return figure


def residual_figure(fit: FitRecording) -> Figure:
    """Residual of the fit against the number of basis functions."""
    if not fit.residual:
        raise ValueError("residual is empty: fit with several numbers of basis functions.")
    counts = sorted(fit.residual)
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(0.62 * WIDTH, 2.7))
        axes = figure.subplots()
        axes.plot(counts, [fit.residual[n] for n in counts], "o-", color=palette.RUN, ms=4)
        if fit.n_basis is not None and fit.n_basis in fit.residual:
            used = fit.residual[fit.n_basis]
            axes.plot(fit.n_basis, used, "o", color=palette.LIMIT, ms=8, mfc="none", mew=1.8)
            axes.annotate(
                f"used: {fit.n_basis}",
                (fit.n_basis, used),
                xytext=(8, 8),
                textcoords="offset points",
                color=palette.LIMIT,
            )
        axes.set(yscale="log", xlabel="basis functions N", ylabel="normalised RMS error [-]")
        axes.set_title("How well the primitive follows the demonstrations")
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    return figure


def _joints(
    names: tuple[str, ...],
    done: list[tuple[np.ndarray, np.ndarray]],
    demos: list[tuple[np.ndarray, np.ndarray]],
    limits: JointLimits | None,
    *,
    label: str,
    unit: str = "rad",
) -> Figure:
    rows = -(-len(names) // 2)
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, 1.45 * rows + 0.5))
        grid = figure.subplots(rows, 2, sharex=True, squeeze=False).ravel()
        for i, (axes, name) in enumerate(zip(grid, names, strict=False)):
            for time, values in demos:
                axes.plot(time, values[:, i], color=palette.DEMO, lw=3.5, label="demonstration")
            for time, values in done:
                axes.plot(time, values[:, i], color=palette.RUN, label=label)
            axes.set(title=name, ylabel=unit)
            axes.margins(x=0)
            if limits is not None:
                draw_limits(axes, float(limits.lower[i]), float(limits.upper[i]))
        legend_in_free_cell(figure, grid, len(names))
    return figure
