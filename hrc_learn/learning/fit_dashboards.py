"""Rerun recordings and reports of fitted primitives and image Jacobians.

Primitives are shown with their demonstrations, image Jacobians with a map of their errors and
the convergence of their learning rounds.
"""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Any, cast

import matplotlib
import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from jaxtyping import Float
from torch import Tensor

from hrc_learn.jacobian import CellErrors, EvidenceResult
from hrc_learn.kinematics import panda
from hrc_learn.learning.primitive_fitting import FittedPrimitives
from hrc_learn.learning.visual_servo_fitting import Demonstrations, feature_trajectories
from hrc_learn.log import JointRanges
from hrc_learn.skills.visual_skill import VisualServoSkill
from hrc_learn.viz import palette
from hrc_learn.viz.figures import DEMO_LOOK, JointCurves, joint_grid_figure
from hrc_learn.viz.panels import Plot, Tab, joint_plot, several, single, slug
from hrc_learn.viz.report import Measurement, Picture, Report, Section, software_versions
from hrc_learn.viz.rerun_stream import (
    dashboard,
    frame_view,
    markdown_table,
    rrd_file,
    send_dot,
    send_rows,
    send_strips,
    send_summary,
    send_tab,
    style,
    tab_view,
)

_MOST_TABS = 6
_JOINT_UNITS = {"rad": "rad", "1": "of the range"}
_THOUSANDTHS = {"rad": "mrad", "m": "mm", "of the range": "1/1000 of the range"}


@dataclass(frozen=True, kw_only=True, eq=False)
class ShownFit:
    """Demonstrations and reproductions of the joints or, without joints, of the position."""

    title: str
    names: tuple[str, ...]
    """Names of the coordinates."""
    unit: str
    """Unit of the coordinates: "rad", "m" or "of the range"."""
    time: tuple[Float[np.ndarray, "_"], ...]
    """Time grid of each demonstration [s]."""
    demos: tuple[Float[np.ndarray, "_ coordinates"], ...]
    """Demonstrated coordinates."""
    reproductions: tuple[Float[np.ndarray, "_ coordinates"], ...]
    """Reproduced coordinates."""
    paths: tuple[Float[np.ndarray, "_ 3"], ...] = ()
    """Tool centre point of each demonstration [m]; empty if unknown."""
    reproduced_paths: tuple[Float[np.ndarray, "_ 3"], ...] = ()
    """Tool centre point of each reproduction [m]; empty if unknown."""
    limits: JointRanges | None = None
    n_basis: int
    """Number of basis functions."""
    residual: Mapping[int, float]
    """Held-out error of each number of basis functions tried; empty if the number was given."""


def shown_fit(fitted: FittedPrimitives, title: str) -> ShownFit:
    """Demonstrations and reproductions of a fit.

    Args:
        fitted: Primitives of the demonstrations.
        title: Title of recording and report.

    Raises:
        ValueError: Neither joints nor positions were learned.
    """
    channel = next((k for k in ("joint", "position", "pose") if k in fitted.each), None)
    if channel is None:
        raise ValueError("orientations alone cannot be shown: learn the pose or positions.")
    motions, lengths = fitted.motions, fitted.motions.demos.length.tolist()
    demos = motions.position(channel)
    made = cast(Any, fitted.each[channel].rollout()).position.detach()

    def cut(padded: Tensor) -> tuple[np.ndarray, ...]:
        return tuple(x[:n].double().numpy() for x, n in zip(padded, lengths, strict=True))

    limits, paths, reproduced = None, (), ()
    if channel != "joint":
        paths, reproduced = cut(demos), cut(made)
    elif (motions.joint_names, motions.joint_unit) == (panda.joint_names, "rad"):
        limits = JointRanges.of(panda.limits)
        paths = cut(panda.forward(demos.double()).position)
        reproduced = cut(panda.forward(made.double()).position)
    residual = {}
    if (selection := fitted.selection) is not None:
        residual = dict(zip(selection.candidates, selection.error.tolist(), strict=True))
    return ShownFit(
        title=title,
        names=motions.joint_names if channel == "joint" else ("x", "y", "z"),
        unit=_JOINT_UNITS[motions.joint_unit] if channel == "joint" else "m",
        time=cut(motions.demos.time),
        demos=cut(demos),
        reproductions=cut(made),
        paths=paths,
        reproduced_paths=reproduced,
        limits=limits,
        n_basis=fitted.n_basis,
        residual=residual,
    )


def record_fit(path: str | os.PathLike[str], fit: ShownFit) -> None:
    """Write demonstrations and reproductions as an .rrd file with its layout.

    Args:
        path: File to write; it appears only when complete.
        fit: Demonstrations and reproductions; each of the first `_MOST_TABS` demonstrations
            gets a tab.
    """
    tabs = [_tab(fit, i) for i in range(min(_MOST_TABS, len(fit.demos)))]
    left: list[rrb.View] = [rrb.TextDocumentView(origin="/summary", name="Fit")]
    if every := [*fit.paths, *fit.reproduced_paths]:
        name = "Paths: demonstrations (grey), reproductions (blue, dots: current position)"
        eye = frame_view(np.concatenate(every), base=False)
        left.insert(0, rrb.Spatial3DView(origin="/world", name=name, eye_controls=eye))
    views = [tab_view(tab, time) for tab, time in zip(tabs, fit.time, strict=False)]
    right = rrb.Tabs(contents=views, active_tab=0)
    layout = dashboard(left, [right], row_shares=(1, 1), column_shares=(2, 3))
    with rrd_file(path, fit.title, layout) as stream:
        send_strips(stream, "world/demonstrations", fit.paths, palette.DEMO, 0.004)
        colour = palette.RUN_ON_DARK
        send_strips(stream, "world/reproductions", fit.reproduced_paths, colour, 0.002)
        for i, (time, line) in enumerate(zip(fit.time, fit.reproduced_paths, strict=False)):
            send_dot(stream, str(i + 1), time, line, colour)
        send_summary(stream, _fit_summary(fit))
        for tab, time in zip(tabs, fit.time, strict=False):
            send_tab(stream, time, tab)


def _tab(fit: ShownFit, i: int) -> Tab:
    """Plots of each coordinate of demonstration i, and of its reproduction error."""
    root, demo, made = f"demonstration_{i + 1}", fit.demos[i], fit.reproductions[i]
    plots = [
        joint_plot(root, name, j, made, demo, fit.limits, fit.unit)
        for j, name in enumerate(fit.names)
    ]
    error = several(f"{root}/error", fit.names, 1e3 * (made - demo))
    title = f"Error of all coordinates [{_THOUSANDTHS[fit.unit]}]"
    plots.append(Plot(title=title, curves=(error,)))
    return Tab(title=f"Demonstration {i + 1}", plots=tuple(plots), columns=2)


def _fit_summary(fit: ShownFit) -> str:
    """Summary of the fit, as Markdown."""
    rows = [
        (i, f"{time[-1] - time[0]:.2f}", f"{1e3 * np.abs(made - demo).max():.3g}")
        for i, (time, demo, made) in enumerate(
            zip(fit.time, fit.demos, fit.reproductions, strict=True), start=1
        )
    ]
    heads = ("demonstration", "duration [s]", f"largest error [{_THOUSANDTHS[fit.unit]}]")
    # The plots are too small for legends.
    colours = "Joints: reproduction blue, demonstration grey" + ", limits red" * bool(
        fit.limits
    )
    lines = [f"# {fit.title}", "", colours, "", *markdown_table(heads, rows)]
    if fit.residual:
        counts = [
            (f"{n} (used)" if n == fit.n_basis else n, f"{residual:.3g}")
            for n, residual in sorted(fit.residual.items())
        ]
        lines += ["", *markdown_table(("basis functions", "normalised RMS error"), counts)]
    return "\n".join(lines)


def fit_report(
    fit: ShownFit,
    table: Sequence[Measurement],
    configuration: Mapping[str, object],
    command: str,
) -> Report:
    """Report of a fit: measured values and reproductions.

    Args:
        fit: Demonstrations and reproductions.
        table: Measured values.
        configuration: Options of the fit.
        command: Command line that repeats the fit.
    """
    shown = list(zip(fit.time, fit.demos, fit.reproductions, strict=True))[:4]
    motions = [JointCurves("demonstration", time, demo, *DEMO_LOOK) for time, demo, _ in shown]
    motions += [JointCurves("reproduction", time, made) for time, _, made in shown]
    joints = joint_grid_figure(fit.names, motions, fit.limits, fit.unit)
    caption = f"The first {len(shown)} of {len(fit.time)} demonstrations, with reproductions."
    figures = [Picture("position" if fit.unit == "m" else "joints", joints, caption)]
    return Report(
        title=fit.title,
        summary=f"A movement primitive of {fit.n_basis} basis functions for each "
        "demonstration, and their mean.",
        table=table,
        sections=[Section(heading="Reproductions", figures=figures)],
        configuration=configuration,
        versions=software_versions(),
        command=command,
    )


_MOST_PATHS = 30
"""Largest number of paths drawn; more would hide each other."""
_BELOW = 0.03
"""Distance of the error map below the lowest path, so that both are visible [m]."""
_THICKNESS = 0.002  # half the thickness of the error map's cells [m]
_ROUND = "round"
"""Timeline of learning, with one step per round."""


def record_learning(
    path: str | os.PathLike[str], skill: VisualServoSkill, demos: Demonstrations, title: str
) -> None:
    """Write the fit of an image Jacobian as an .rrd file with its layout.

    Args:
        path: File to write; it appears only when complete.
        skill: Skill that was just fitted; a loaded skill has no held-out errors.
        demos: Demonstrations of the skill; the first `_MOST_PATHS` are drawn.
        title: Title of the recording.
    """
    assert skill.cells is not None
    watched = islice(feature_trajectories(demos), _MOST_PATHS)
    paths = [demo.pose.position.numpy() for demo in watched]
    tab = Tab(title="", plots=()) if skill.learned is None else _convergence(skill.learned)
    name = "End effector (grey), held-out error (blue)"
    # A near and steep view, in which every cell can be read.
    eye = frame_view(np.concatenate(paths), base=False, direction=(0.75, 0.2, 1.0), nearest=0.2)
    left = [
        rrb.Spatial3DView(origin="/world", name=name, eye_controls=eye),
        rrb.TextDocumentView(origin="/summary", name="Fit"),
    ]
    right = [tab_view(tab)] if tab.plots else []
    layout = dashboard(left, right, row_shares=(3, 2), timeline=_ROUND)
    with rrd_file(path, title, layout) as stream:
        send_summary(stream, _learning_summary(skill, title))
        send_strips(stream, "world/demonstrations", paths, palette.DEMO, 0.0008)
        lowest = min(float(path[:, 2].min()) for path in paths) - _BELOW
        stream.log("world/errors", _error_map(skill.cells, lowest), static=True)
        for plot in tab.plots:
            assert skill.learned is not None
            curve, kept = plot.curves
            stream.log(curve.path, style(curve), static=True)
            send_rows(stream, _rounds(np.arange(len(curve.values))), curve)
            dot = rr.SeriesPoints(names=kept.names, colors=kept.colours, marker_sizes=[6.0])
            stream.log(kept.path, dot, static=True)
            send_rows(stream, _rounds(np.array([skill.learned.best])), kept)


def _convergence(learned: EvidenceResult) -> Tab:
    """Plots of each quantity over the rounds, with a dot at the round that was kept."""
    rounds, configs = learned.rounds, [state.config for state in learned.rounds]
    plots = []
    for name, values in (
        ("Error on held-out demonstrations [px]", [s.held_out_error for s in rounds]),
        ("Negative log evidence per pair [-]", [s.evidence for s in rounds]),
        ("Width of the neurons [m, rad]", [float(s.neurons.width) for s in rounds]),
        ("Noise of the camera [px]", [c.pixel_noise for c in configs]),
        ("Prior deviation, common part [px/m]", [c.bias_std for c in configs]),
        ("Prior deviation, weights [px/m]", [c.weight_std for c in configs]),
    ):
        path, values = f"learning/{slug(name)}", np.array(values)
        curve = single(path, name, values, palette.RUN_ON_DARK)
        dot = single(f"{path}/kept", "kept", values[[learned.best]], palette.LIMIT)
        plots.append(Plot(title=name, curves=(curve, dot)))
    return Tab(
        title="Convergence over rounds (red: the round that was kept)",
        plots=tuple(plots),
        columns=2,
    )


def _rounds(numbers: np.ndarray) -> list[rr.TimeColumn]:
    return [rr.TimeColumn(_ROUND, sequence=numbers)]


def _error_map(cells: CellErrors, height: float) -> rr.Boxes3D:
    """Flat boxes labelled with the error in percent; a larger error is darker."""
    edges, errors = cells.edges.mT.numpy(), cells.relative.numpy()
    known = np.isfinite(errors)
    relative, flat = errors[known], np.full(int(known.sum()), _THICKNESS)
    middle = np.meshgrid(*((axis[1:] + axis[:-1]) / 2 for axis in edges), indexing="ij")
    size = np.meshgrid(*(np.diff(axis) for axis in edges), indexing="ij")
    # The darkest blue is limited so that black numbers on it can still be read.
    shades = matplotlib.colormaps["Blues"](0.15 + 0.5 * relative / relative.max(initial=1e-12))
    centers = [*(grid[known] for grid in middle), np.full_like(flat, height)]
    return rr.Boxes3D(
        centers=np.stack(centers, axis=-1),
        half_sizes=np.stack([*(grid[known] / 2 for grid in size), flat], axis=-1),
        colors=(255 * shades).astype(np.uint8),
        labels=[f"{100 * value:.1f} %" for value in relative],
        show_labels=True,
        fill_mode=rr.components.FillMode.Solid,
    )


def _learning_summary(skill: VisualServoSkill, title: str) -> str:
    """Summary of the learning, as Markdown."""
    lines = [f"# {title}", ""]
    if (learned := skill.learned) is not None:
        last = len(learned.rounds) - 1
        lines += [f"Round {learned.best} of {last} was kept (red dots).", ""]
    rows = [(n.replace("_", " "), f"{value:.4g}") for n, value in skill.metrics().items()]
    return "\n".join([*lines, *markdown_table(("measured", "value"), rows)])
