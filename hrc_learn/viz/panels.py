"""Which curves of a run are drawn where: one list that data and layout are both made from."""

import re
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Shaped

from hrc_learn.viz import palette
from hrc_learn.viz.recordings import JointLimits, RunRecording

Colour = tuple[int, int, int, int]


@dataclass(frozen=True, kw_only=True, eq=False)
class Curves:
    """Curves over time that share an entity and a unit."""

    path: str
    names: tuple[str, ...]
    values: Shaped[np.ndarray, "time curves"]
    colours: tuple[Colour, ...]
    width: float = 1.5


@dataclass(frozen=True, kw_only=True)
class Plot:
    """One coordinate system."""

    title: str
    """What is shown, with its unit: plots have no axis labels."""
    curves: tuple[Curves, ...]
    range: tuple[float, float] | None = None
    """Of the vertical axis; fits the data when None."""
    legend: bool = False
    """Where the title cannot name the colours."""
    share: float = 1.0
    """Height, in proportion to the other plots of the tab."""


@dataclass(frozen=True, kw_only=True)
class Tab:
    """Plots shown together."""

    title: str
    plots: tuple[Plot, ...]
    columns: int = 1


def run_tabs(run: RunRecording) -> list[Tab]:
    """Every tab that the run has data for."""
    tabs = [
        _servoing(run),
        _regions(run),
        _image_jacobian(run),
        _person(run),
        _worker(run),
        _joints(run),
        _safety(run),
    ]
    return [tab for tab in tabs if tab.plots]


def _servoing(run: RunRecording) -> Tab:
    if run.camera is None:
        return Tab(title="Pixel error", plots=())
    error = single("camera/error", "distance", run.camera.error, palette.RUN_ON_DARK)
    delta = run.camera.feature - run.camera.target
    parts = several("camera/error_uv", ("u (right)", "v (down)"), delta)
    plots = (
        Plot(title="Distance from feature to target [px]", curves=(error,)),
        Plot(title="Feature minus target: u blue, v orange [px]", curves=(parts,)),
    )
    return Tab(title="Pixel error", plots=plots)


def _regions(run: RunRecording) -> Tab:
    plots = tuple(
        Plot(
            title=f"Potential of the region: {name} [-]",
            curves=(single(f"regions/{slug(name)}", name, values, palette.RUN_ON_DARK),),
        )
        for name, values in run.potentials.items()
    )
    if run.potential_rate is not None:
        rate = single("regions/rate", "dV/dt", run.potential_rate, palette.PURPLE)
        title = "Rate of the potential, dV/dt, if the image Jacobian is as estimated [1/s]"
        plots += (Plot(title=title, curves=(rate,)),)
    return Tab(title="Regions", plots=plots)


def _image_jacobian(run: RunRecording) -> Tab:
    plots = []
    if run.image_jacobian is not None:
        for row, pixel in enumerate(("u", "v")):
            for half in ("linear", "angular"):
                plots.append(_jacobian_plot(run, row, pixel, half))
    if run.weight_norm is not None:
        norm = single("image_jacobian/weight_norm", "‖W‖", run.weight_norm, palette.PURPLE)
        plots.append(Plot(title="Norm of the learned weights [-]", curves=(norm,)))
    return Tab(title="Image Jacobian", plots=tuple(plots))


def _jacobian_plot(run: RunRecording, row: int, pixel: str, half: str) -> Plot:
    assert run.image_jacobian is not None
    columns, symbol, unit = (
        (slice(0, 3), "v", "px/m") if half == "linear" else (slice(3, 6), "ω", "px/rad")
    )
    path = f"image_jacobian/{pixel}_{half}"
    names = tuple(f"∂{pixel}/∂{symbol}{axis}" for axis in "xyz")
    curves = [several(f"{path}/estimate", names, run.image_jacobian[:, row, columns])]
    title = f"∂{pixel} / {half} velocity [{unit}]: x blue, y orange, z green"
    if run.true_image_jacobian is not None:
        true = run.true_image_jacobian[:, row, columns]
        names = tuple(f"{name} true" for name in names)
        # The viewer draws entities by name: the thin estimate has to come after it.
        curves.insert(0, several(f"{path}/actual", names, true, width=5.0, light=True))
        title += "; pale: true"
    return Plot(title=title, curves=tuple(curves))


def _person(run: RunRecording) -> Tab:
    plots = []
    if run.nullspace_input is not None:
        effort = several("person/effort", run.joint_names, run.nullspace_input)
        title = "Null-space effort d of the person, by joint [N m]"
        plots.append(Plot(title=title, curves=(effort,), legend=True, share=2.0))
    if run.followed is not None:
        share = single("person/followed", "share", run.followed, palette.TARGET)
        title = "Share of the push that the arm follows [-]"
        plots.append(Plot(title=title, curves=(share,), range=(-0.05, 1.05)))
    if run.hindered:
        # A line at a height of its own for each, where it acts.
        rows = [np.where(on, k + 1.0, np.nan) for k, on in enumerate(run.hindered.values())]
        reasons = several("person/hindered", run.hindered, np.column_stack(rows), width=4.0)
        extent, title = (0.0, len(rows) + 1.0), "Why it does not follow, or only in part"
        plots.append(Plot(title=title, curves=(reasons,), range=extent, legend=True))
    moved, turned = run.position_deviation, run.rotation_deviation
    blue, deviation = palette.RUN_ON_DARK, "Deviation of the end effector"
    for path, values, unit, colour, title in (
        ("elbow", run.elbow_motion, 1e3, palette.PERSON, "Elbow moved by the person [mm]"),
        ("position_deviation", moved, 1e3, blue, f"{deviation}, position [mm]"),
        (
            "rotation_deviation",
            turned,
            180 / np.pi,
            palette.PURPLE,
            f"{deviation}, rotation [deg]",
        ),
    ):
        if values is not None:
            curve = single(f"person/{path}", path.split("_")[0], unit * values, colour)
            plots.append(Plot(title=title, curves=(curve,)))
    return Tab(title="Person", plots=tuple(plots))


def _worker(run: RunRecording) -> Tab:
    if not run.worker_distance:
        return Tab(title="Worker", plots=())
    values = 1e3 * np.column_stack(list(run.worker_distance.values()))
    distance = several("worker/distance", run.worker_distance, values)
    title = "Distance of the worker from the robot and its load [mm]"
    # What matters are the last few centimetres.
    near = several("worker/near", run.worker_distance, np.where(values < 300, values, np.nan))
    plots = (
        Plot(title=title, curves=(distance,), legend=True),
        Plot(title=f"{title}, below 300", curves=(near,), range=(-50.0, 300.0)),
    )
    return Tab(title="Worker", plots=plots)


def _joints(run: RunRecording) -> Tab:
    demo, limits = run.demo_joint_position, run.joint_limits
    plots = tuple(
        joint_plot("joints", name, i, run.joint_position, demo, limits)
        for i, name in enumerate(run.joint_names)
    )
    return Tab(title=joints_title(demo is not None, limits is not None), plots=plots, columns=2)


def joints_title(demo: bool, limits: bool, position: str = "position") -> str:
    """Title that says what the colours of `joint_plot` mean; its plots are too small for it."""
    return f"Joints: {position} blue" + ", demonstration grey" * demo + ", limits red" * limits


def joint_plot(
    root: str,
    name: str,
    i: int,
    position: np.ndarray,
    demo: np.ndarray | None,
    limits: JointLimits | None,
    unit: str = "rad",
) -> Plot:
    """Position of joint i over its demonstration and between its limits."""
    curves = []
    if limits is not None:
        curves.append(limit_curves(f"{root}/{name}/limits", limits, i, len(position)))
    if demo is not None:
        path = f"{root}/{name}/demonstration"
        curves.append(single(path, "demonstration", demo[:, i], palette.DEMO, width=5.0))
    path = f"{root}/{name}/position"
    curves.append(single(path, "position", position[:, i], palette.RUN_ON_DARK))
    return Plot(title=f"{name} [{unit}]", curves=tuple(curves))


def limit_curves(path: str, limits: JointLimits, i: int, steps: int) -> Curves:
    """Both limits of joint i."""
    bounds = np.broadcast_to([limits.lower[i], limits.upper[i]], (steps, 2))
    names, red = ("lower limit", "upper limit"), palette.rgba(palette.LIMIT)
    return Curves(path=path, names=names, values=bounds, colours=(red, red))


def _safety(run: RunRecording) -> Tab:
    plots = []
    for name, values in run.safety.items():
        values = values.astype(float)
        curves = single(f"safety/{slug(name)}", name, values, palette.LIMIT)
        # A guard that never acted is a line at the bottom, not in the middle.
        top = max(1.0, float(np.nanmax(values, initial=0.0)))
        room = (-0.05 * top, 1.05 * top)
        kind = name.replace("_", " ")
        plots.append(Plot(title=f"Safety filter: {kind}", curves=(curves,), range=room))
    return Tab(title="Safety", plots=tuple(plots), columns=2)


def slug(name: str) -> str:
    """A name as a part of an entity path, which slashes and blanks would break up."""
    return re.sub(r"\W+", "_", name).strip("_")


def single(path: str, name: str, values: np.ndarray, colour: str, width: float = 1.5) -> Curves:
    """One curve, from values of shape (T,)."""
    colours = (palette.rgba(colour),)
    return Curves(
        path=path, names=(name,), values=values[:, None], colours=colours, width=width
    )


def several(
    path: str,
    names: Iterable[str],
    values: np.ndarray,
    *,
    width: float = 1.5,
    light: bool = False,
) -> Curves:
    """A curve for each column, each in a colour of its own, pale where `light`."""
    names = tuple(names)
    colours = palette.SERIES_ON_DARK
    chosen = [colours[i % len(colours)] for i in range(len(names))]
    mixed = tuple(palette.lighten(c) if light else palette.rgba(c) for c in chosen)
    return Curves(path=path, names=names, values=values, colours=mixed, width=width)
