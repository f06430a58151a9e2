"""Assignment of a run's curves to plots and tabs, by which data are sent and layouts built."""

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from itertools import compress

import numpy as np
from jaxtyping import Shaped

from hrc_learn.log import JointRanges, RunRecording
from hrc_learn.viz import palette

Colour = tuple[int, int, int, int]


@dataclass(frozen=True, kw_only=True, eq=False)
class Curves:
    """Curves over time with a common entity of Rerun and a common unit."""

    path: str
    names: tuple[str, ...]
    values: Shaped[np.ndarray, "time curves"]
    colours: tuple[Colour, ...]
    width: float = 1.5
    marks: bool = False
    """Draw points rather than lines, so that single steps are visible."""
    time: Shaped[np.ndarray, " time"] | None = None
    """Time of these curves in a figure [s]; None: the common time of all curves."""


@dataclass(frozen=True, kw_only=True)
class Plot:
    """One coordinate system."""

    title: str
    """Quantity with its unit: plots have no axis labels."""
    curves: tuple[Curves, ...]
    range: tuple[float, float] | None = None
    """Range of the vertical axis; None: the range of the data."""
    legend: bool = False
    """Show a legend, because the title does not explain the colours."""
    rows: bool = False
    """The curves are rows at heights 1, 2, ...; figures write their names there."""


@dataclass(frozen=True, kw_only=True)
class Tab:
    """Plots shown together."""

    title: str
    plots: tuple[Plot, ...]
    columns: int = 1


def with_values(plots: Iterable[Plot]) -> tuple[Plot, ...]:
    """Plots without curves that have no value, and without plots that have no curve."""
    filled = [
        replace(plot, curves=tuple(c for c in map(_filled, plot.curves) if c.names))
        for plot in plots
    ]
    return tuple(plot for plot in filled if plot.curves)


def _filled(curves: Curves) -> Curves:
    """Those of the curves that have a value."""
    seen = np.asarray(np.isfinite(curves.values).any(axis=0))
    names, colours = (tuple(compress(of, seen)) for of in (curves.names, curves.colours))
    return replace(curves, names=names, colours=colours, values=curves.values[:, seen])


_EFFORT = "Null-space effort d of the person, norm [N m]"
_ERROR = "Distance from feature to target [px]"
_DEVIATION = "Deviation of the end effector, position [mm]"
_WORKER = "Worker's distance from robot and load [mm]"
_NEAR = "Worker's distance, enlarged [mm]"
_STORY = (_ERROR, _EFFORT, _DEVIATION, _WORKER)
"""Plots of the overview, one for each topic."""


def run_tabs(run: RunRecording, finished: bool = False) -> list[Tab]:
    """All tabs that the run has data for, an overview first.

    Args:
        run: The run.
        finished: Leave out curves without a value: none will come.
    """
    tabs = [
        _servoing(run),
        Tab(title="Person", plots=tuple(person_plots(run)), columns=2),
        Tab(title="Worker", plots=tuple(worker_plots(run))),
        _primitive(run),
        _safety(run),
        _lyapunov(run),
    ]
    plots = {plot.title: plot for tab in tabs for plot in tab.plots}
    if run.nullspace_input is not None:
        norm = np.linalg.norm(run.nullspace_input, axis=1)
        curve = single("person/effort_norm", "norm", norm, palette.PERSON)
        plots[_EFFORT] = Plot(title=_EFFORT, curves=(curve,))
    tabs.insert(0, Tab(title="Story", plots=tuple(plots[t] for t in _STORY if t in plots)))
    if finished:
        tabs = [replace(tab, plots=with_values(tab.plots)) for tab in tabs]
    return [tab for tab in tabs if tab.plots]


def _servoing(run: RunRecording) -> Tab:
    if run.camera is None:
        return Tab(title="Servoing", plots=())
    error = single("camera/error", "distance", run.camera.error, palette.RUN_ON_DARK)
    delta = run.camera.feature - run.camera.target
    parts = several("camera/error_uv", ("u (right)", "v (down)"), delta)
    plots = [
        Plot(title=_ERROR, curves=(error,)),
        Plot(title="Distance to target, last 5 px [px]", curves=(error,), range=(0.0, 5.0)),
        Plot(title="Feature minus target [px]", curves=(parts,), legend=True),
        *image_jacobian_plots(run),
    ]
    return Tab(title="Servoing", plots=tuple(plots), columns=2)


def _lyapunov(run: RunRecording) -> Tab:
    plots = tuple(
        Plot(
            title=f"V, potential of the region: {name} [-]",
            curves=(single(f"regions/{slug(name)}", name, values, palette.RUN_ON_DARK),),
        )
        for name, values in run.potentials.items()
    )
    if run.potential_rate is not None:
        rate = single("regions/rate", "dV/dt", run.potential_rate, palette.PURPLE)
        title = "dV/dt predicted by the estimated image Jacobian [1/s]"
        plots += (Plot(title=title, curves=(rate,)),)
    return Tab(title="Lyapunov", plots=plots)


def image_jacobian_plots(run: RunRecording) -> list[Plot]:
    """Plots of the entries of the image Jacobian, with the true ones if known."""
    plots = []
    if run.image_jacobian is not None:
        for row, pixel in enumerate(("u", "v")):
            plots += [_jacobian_plot(run, row, pixel, half) for half in ("linear", "angular")]
    if run.weight_norm is not None:
        norm = single("image_jacobian/weight_norm", "‖W‖", run.weight_norm, palette.PURPLE)
        plots.append(Plot(title="Norm of the learned weights [-]", curves=(norm,)))
    return plots


def _jacobian_plot(run: RunRecording, row: int, pixel: str, half: str) -> Plot:
    assert run.image_jacobian is not None
    columns, symbol, unit = (
        (slice(0, 3), "v", "px/m") if half == "linear" else (slice(3, 6), "ω", "px/rad")
    )
    path = f"image_jacobian/{pixel}_{half}"
    names = tuple(f"∂{pixel}/∂{symbol}{axis}" for axis in "xyz")
    curves = [several(f"{path}/estimate", names, run.image_jacobian[:, row, columns])]
    title = f"Image Jacobian: ∂{pixel} / {half} velocity [{unit}]"
    if run.true_image_jacobian is not None:
        true = run.true_image_jacobian[:, row, columns]
        # One legend entry for all three true curves. The viewer draws entities in the order of
        # their names: "actual" comes first, so that the thin estimate is drawn over it.
        pale = several(f"{path}/actual", ("true",) * 3, true, width=5.0, light=True)
        curves.insert(0, pale)
    return Plot(title=title, curves=tuple(curves), legend=True)


def person_plots(run: RunRecording) -> list[Plot]:
    """Plots of what a person does, how far the arm follows, and how elbow and tool move."""
    plots = []
    if run.nullspace_input is not None:
        effort = several("person/effort", run.joint_names, run.nullspace_input)
        title = "Null-space effort d of the person, by joint [N m]"
        plots.append(Plot(title=title, curves=(effort,), legend=True))
    if run.followed is not None:
        share = single("person/followed", "fraction", run.followed, palette.TARGET)
        title = "Followed fraction of the push [-]"
        plots.append(Plot(title=title, curves=(share,), range=(-0.05, 1.05)))
    if run.hindered:
        title = "Reasons why the arm does not fully follow"
        plots.append(_rows("person/hindered", title, run.hindered))
    moved, turned = run.position_deviation, run.rotation_deviation
    turning = "Deviation of the end effector, rotation [deg]"
    for path, values, unit, colour, title in (
        ("elbow", run.elbow_motion, 1e3, palette.PERSON, "Elbow: displacement [mm]"),
        ("position_deviation", moved, 1e3, palette.RUN_ON_DARK, _DEVIATION),
        ("rotation_deviation", turned, 180 / np.pi, palette.PURPLE, turning),
    ):
        if values is not None:
            curve = single(f"person/{path}", path.split("_")[0], unit * values, colour)
            plots.append(Plot(title=title, curves=(curve,)))
    return plots


def worker_plots(run: RunRecording) -> list[Plot]:
    """Plots of the distances from a worker, one of them enlarged; none without a worker."""
    if not run.worker_distance:
        return []
    values = 1e3 * np.column_stack(list(run.worker_distance.values()))
    distance = several("worker/distance", run.worker_distance, values)
    # The second plot is enlarged, because the last few centimetres matter.
    near = several("worker/near", run.worker_distance, np.where(values < 300, values, np.nan))
    return [
        Plot(title=_WORKER, curves=(distance,), legend=True),
        Plot(title=_NEAR, curves=(near,), range=(-50.0, 300.0), legend=True),
    ]


def _primitive(run: RunRecording) -> Tab:
    demo, limits = run.demo_joint_position, run.joint_limits
    plots = [
        joint_plot("joints", name, i, run.joint_position, demo, limits)
        for i, name in enumerate(run.joint_names)
    ]
    # The legend of the first plot is valid for all plots, which are too small for a legend
    # each.
    plots[0] = replace(plots[0], legend=True)
    title = "Joints" if demo is None else "Primitive"
    return Tab(title=title, plots=tuple(plots), columns=2)


def joint_plot(
    root: str,
    name: str,
    i: int,
    position: np.ndarray,
    demo: np.ndarray | None,
    limits: JointRanges | None,
    unit: str = "rad",
) -> Plot:
    """Position of joint i over its demonstration and between its limits."""
    curves, path = [], f"{root}/{slug(name)}"
    if limits is not None:
        curves.append(limit_curves(f"{path}/limits", limits, i, len(position)))
    if demo is not None:
        shown = f"{path}/demonstration"
        curves.append(single(shown, "demonstration", demo[:, i], palette.DEMO, width=5.0))
    curves.append(single(f"{path}/position", "position", position[:, i], palette.RUN_ON_DARK))
    return Plot(title=f"{name} [{unit}]", curves=tuple(curves))


def limit_curves(path: str, limits: JointRanges, i: int, steps: int) -> Curves:
    """Both limits of joint i."""
    return _bounds(path, (limits.lower[i], limits.upper[i]), steps)


def _bounds(path: str, values: tuple[float, float], steps: int) -> Curves:
    """A lower and an upper limit."""
    names, red = ("lower limit", "upper limit"), palette.rgba(palette.LIMIT)
    bounds = np.broadcast_to(values, (steps, 2))
    return Curves(path=path, names=names, values=bounds, colours=(red, red))


def _safety(run: RunRecording) -> Tab:
    plots = []
    limits, names = run.joint_limits, run.joint_names
    if limits is not None:
        middle, half = (limits.upper + limits.lower) / 2, (limits.upper - limits.lower) / 2
        fractions = (run.joint_position - middle) / half
        title = "Joint positions in their ranges: -1 lower limit, 1 upper limit [-]"
        plots.append(_within("safety/position", title, names, fractions))
        if limits.velocity is not None and run.joint_velocity is not None:
            fractions = run.joint_velocity / limits.velocity
            title = "Joint velocities, as fractions of their limits [-]"
            plots.append(_within("safety/velocity", title, names, fractions))
    if run.safety:
        plots.append(
            _rows("safety/acted", "Interventions of the safety filter", run.safety, marks=True)
        )
    return Tab(title="Safety", plots=tuple(plots))


def _rows(path: str, title: str, active: Mapping[str, np.ndarray], marks: bool = False) -> Plot:
    """Plot with a row for each name, which has a line or marks where its value is positive."""
    acted = [np.nan_to_num(np.asarray(on, dtype=float)) > 0 for on in active.values()]
    rows = np.column_stack([np.where(on, k, np.nan) for k, on in enumerate(acted, start=1)])
    # The number of a row in its name: the viewer writes no names along the axis.
    names = [f"{k} {name.replace('_', ' ')}" for k, name in enumerate(active, start=1)]
    curves = replace(several(path, names, rows, width=4.0), marks=marks)
    span = 0.0, len(acted) + 1.0
    return Plot(title=title, curves=(curves,), range=span, legend=True, rows=True)


def _within(
    path: str, title: str, names: Iterable[str], fractions: Shaped[np.ndarray, "time joints"]
) -> Plot:
    """Plot of fractions of limits, between -1 and 1."""
    bounds = _bounds(f"{path}/limits", (-1.0, 1.0), len(fractions))
    curves = (several(f"{path}/joints", names, fractions), bounds)
    return Plot(title=title, curves=curves, range=(-1.1, 1.1), legend=True)


def slug(name: str) -> str:
    """Name as a part of an entity path, without slashes and blanks."""
    return re.sub(r"\W+", "_", name).strip("_")


def single(
    path: str,
    name: str,
    values: np.ndarray,
    colour: str,
    width: float = 1.5,
    time: np.ndarray | None = None,
) -> Curves:
    """One curve, from values of shape (T,)."""
    colours, column = (palette.rgba(colour),), values[:, None]
    return Curves(
        path=path, names=(name,), values=column, colours=colours, width=width, time=time
    )


def several(
    path: str,
    names: Iterable[str],
    values: np.ndarray,
    *,
    width: float = 1.5,
    light: bool = False,
) -> Curves:
    """One curve for each column, each in a colour of its own, pale if `light`."""
    names = tuple(names)
    colours = palette.SERIES_ON_DARK
    chosen = [colours[i % len(colours)] for i in range(len(names))]
    mixed = tuple(palette.lighten(c) if light else palette.rgba(c) for c in chosen)
    return Curves(path=path, names=names, values=values, colours=mixed, width=width)
