"""Demonstrations as one Rerun recording: paths and arm in 3D, joints, features, the person."""

import os
from collections.abc import Iterator

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from jaxtyping import Float

from hrc_learn.viz import palette
from hrc_learn.viz.panels import Curves, Plot, Tab, limit_curves, several, single
from hrc_learn.viz.recordings import DemonstrationsRecording, DemonstrationTrace
from hrc_learn.viz.rerun_stream import (
    TIMELINE,
    StaticShapes,
    frame_view,
    rrd_file,
    samples,
    seconds,
    send_curves,
    send_poses,
    send_shapes,
    tab_view,
    thin,
)

_POINT_RATE = 30.0

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
        most: Of them that get a tab of their own; all are drawn in 3D and together.
    """
    tabs = [_together(shown), *(_alone(shown, d) for d in shown.demonstrations[:most])]
    with rrd_file(path, shown.title, _blueprint(shown, [tab for tab, _ in tabs])) as stream:
        _send_space(stream, shown)
        summary = rr.TextDocument(_summary(shown), media_type="text/markdown")
        stream.log("summary", summary, static=True)
        for _, curves in tabs:
            for time, curve in curves:
                send_curves(stream, time, curve)


def _together(shown: DemonstrationsRecording) -> DemonstrationView:
    """Every joint, and the feature, of all demonstrations over one another."""
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
    """A column of a quantity, of all demonstrations that have it."""
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
    """Of a demonstration."""
    return palette.SERIES_ON_DARK[k % len(palette.SERIES_ON_DARK)]


def _alone(shown: DemonstrationsRecording, demo: DemonstrationTrace) -> DemonstrationView:
    """Everything that was recorded of one demonstration."""
    plots = tuple(
        Plot(title=title, curves=(curves,), legend=True)
        for title, curves in _recorded(shown.joint_names, demo)
    )
    curves = [(demo.time, curves) for plot in plots for curves in plot.curves]
    return Tab(title=f"Episode {demo.episode}", plots=plots), curves


def _recorded(
    joint_names: tuple[str, ...], demo: DemonstrationTrace
) -> Iterator[tuple[str, Curves]]:
    root = f"episode_{demo.episode}"
    for title, name, names, values in (
        ("Joints [rad]", "joints", joint_names, demo.joint_position),
        ("Tool centre point [m]", "position", ("x", "y", "z"), demo.position),
        ("Feature in the image [px]", "feature", ("u (right)", "v (down)"), demo.feature),
        ("Effort of the person [N m]", "effort", joint_names, demo.human_effort),
        ("Gripper [m]", "gripper", ("opening",), demo.gripper),
    ):
        if values is not None:
            columns = values.reshape(len(values), -1)
            yield title, several(f"{root}/{name}", names, columns)


def _send_space(stream: rr.RecordingStream, shown: DemonstrationsRecording) -> None:
    for k, demo in enumerate(shown.demonstrations):
        if demo.position is None:
            continue
        colour = palette.rgba(_colour(k))
        strip = rr.LineStrips3D([thin(demo.position)], radii=[0.003], colors=[colour])
        stream.log(f"world/paths/{demo.episode}", strip, static=True)
        now = f"world/now/{demo.episode}"
        point = rr.Points3D.from_fields(radii=[0.012], colors=[colour])
        stream.log(now, point, static=True)
        at = samples(demo.time, _POINT_RATE)
        columns = rr.Points3D.columns(positions=demo.position[at])
        stream.send_columns(now, seconds(demo.time[at]), columns)
    first, still = shown.demonstrations[0], StaticShapes(stream)
    for body in first.bodies:
        send_shapes(still, body)
        send_poses(stream, first.time, body, samples(first.time, _POINT_RATE))


def _summary(shown: DemonstrationsRecording) -> str:
    """What was recorded, as Markdown."""
    lines = [f"# {shown.title}", "", "| episode | task | duration [s] | frames | path [m] |"]
    lines.append("|---|---|---|---|---|")
    for demo in shown.demonstrations:
        path = "" if demo.length is None else f"{demo.length:.2f}"
        cells = (demo.episode, demo.task, f"{demo.duration:.2f}", len(demo.time), path)
        lines.append(f"| {' | '.join(map(str, cells))} |")
    lines += ["", *(f"- {note}" for note in shown.notes)]
    return "\n".join(lines)


def _blueprint(shown: DemonstrationsRecording, tabs: list[Tab]) -> rrb.Blueprint:
    left: list[rrb.View] = []
    paths = [demo.position for demo in shown.demonstrations if demo.position is not None]
    if paths:
        first = shown.demonstrations[0]
        arm = f"; the arm in episode {first.episode}" if first.bodies else ""
        left.append(
            rrb.Spatial3DView(
                origin="/world",
                name=f"Paths of the end effector, dots: now{arm}",
                eye_controls=frame_view(np.concatenate(paths)),
            )
        )
    left.append(rrb.TextDocumentView(origin="/summary", name="Demonstrations"))
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(contents=left, row_shares=[2, 1][: len(left)]),
            rrb.Tabs(contents=[tab_view(tab) for tab in tabs], active_tab=0),
            column_shares=[2, 3],
        ),
        rrb.TimePanel(state="collapsed", timeline=TIMELINE),
        collapse_panels=True,
    )
