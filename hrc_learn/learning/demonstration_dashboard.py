"""Rerun recording of a dataset: the arm, its cameras and curves, episode by episode.

Each episode has its own timeline, named after the episode, so one layout serves all episodes.
The timeline "time" shows the first episode.
"""

import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
import torch
from jaxtyping import Float

from hrc_learn.demos import Demonstration
from hrc_learn.demos.dataset_views import DatasetArm, demonstration_charts, own_unit
from hrc_learn.demos.read.units import UnitDecision
from hrc_learn.demos.videos import CameraImages
from hrc_learn.kinematics.drawing import arm_bodies
from hrc_learn.log import JointRanges
from hrc_learn.viz import palette, rerun_stream
from hrc_learn.viz.panels import Plot, Tab, limit_curves, several, slug

_CODECS = {
    "av1": rr.VideoCodec.AV1,
    "h264": rr.VideoCodec.H264,
    "hevc": rr.VideoCodec.H265,
    "vp9": rr.VideoCodec.VP9,
}


@dataclass(frozen=True, kw_only=True)
class ShownDataset:
    """Demonstrations of a dataset, with the arm, units and images needed to show them."""

    title: str
    demos: Sequence[Demonstration]
    """Demonstrations of one robot, read one by one."""
    arm: DatasetArm | None = None
    """Arm to draw; None draws the path of the end effector alone."""
    units: Mapping[str, UnitDecision] = field(default_factory=dict)
    """Units on disk by role. Joints are plotted in their unit on disk, or in rad if the units
    are not given."""
    images: Callable[[Demonstration], Mapping[str, CameraImages]] = lambda demo: {}
    """Images of a demonstration by camera."""
    cameras: Sequence[str] = ()
    """Names of all cameras."""
    notes: Sequence[str] = ()
    """Remarks of the dataset reader."""


def record_demonstrations(path: str | os.PathLike[str], shown: ShownDataset) -> float:
    """Write demonstrations as an .rrd file with its layout; `rerun FILE` shows it.

    Args:
        path: File to write; it appears only when complete.
        shown: The demonstrations.

    Returns:
        Duration of all demonstrations together [s].
    """
    with rerun_stream.rrd_file(path, shown.title, demonstration_layout(shown)) as stream:
        return sum(demo.duration for demo in send_demonstrations(stream, shown))


def demonstration_layout(shown: ShownDataset) -> rrb.Blueprint:
    """Layout with arm and cameras on the left and curves on the right."""
    first = shown.demos[0]
    left: list[rrb.View | rrb.Container] = []
    path = tool_path(shown, first)
    if path is not None:
        name, points = "Paths of the end effector (dots: current position)", path
        if (arm := shown.arm) is not None and first.joint_position is not None:
            name = f"{arm.arm.name} and the paths of its tool (dots: current position)"
            q = torch.from_numpy(arm.positions(first.joint_position))
            points = np.concatenate([path, arm.arm.joint_origins(q).flatten(0, 1).numpy()])
        eye = rerun_stream.frame_view(points, direction=(0.85, 0.5, 0.4), nearest=0.3)
        left.append(rrb.Spatial3DView(origin="/world", name=name, eye_controls=eye))
    if shown.cameras:
        views = [
            rrb.Spatial2DView(origin=f"/cameras/{slug(name)}", name=name)
            for name in shown.cameras
        ]
        left.append(rrb.Grid(contents=views, grid_columns=min(3, len(views))))
    task = rrb.TextDocumentView(origin="/task", name="Task")
    episodes = rrb.TextDocumentView(origin="/summary", name="Episodes")
    tabs = [rerun_stream.tab_view(_episode_tab(shown, first)), episodes]
    right = rrb.Vertical(rrb.Tabs(contents=tabs, active_tab=0), task, row_shares=(9, 1))
    # Without arm, path and cameras, the curves fill the whole screen.
    return rerun_stream.dashboard(left, [right], row_shares=(3, 2), column_shares=(1, 1))


def send_demonstrations(
    stream: rr.RecordingStream, shown: ShownDataset
) -> Iterator[Demonstration]:
    """Send the demonstrations one by one, and yield each one that was sent.

    Args:
        stream: Stream to a file or viewer that has the layout of `demonstration_layout`.
        shown: The demonstrations.
    """
    rerun_stream.begin(stream, shown.title)
    rows = []
    for k, demo in enumerate(shown.demos):
        timelines = [f"episode {demo.episode}", *[rerun_stream.TIMELINE] * (k == 0)]
        _send_arm(stream, shown, demo, timelines, first=k == 0)
        _send_images(stream, shown.images(demo), timelines)
        for plot in _episode_tab(shown, demo).plots:
            for curves in plot.curves:
                rerun_stream.send_curves(stream, demo.time, curves, timelines)
        task = rr.TextDocument.columns(text=[f"Episode {demo.episode}: {demo.task}"])
        stream.send_columns("task", rerun_stream.seconds(demo.time[:1], timelines), task)
        path = _send_path(stream, shown, demo, k)
        rows.append((demo.episode, demo.task, f"{demo.duration:.2f}", len(demo), path))
        yield demo
    rerun_stream.send_summary(stream, _summary(shown, rows))


def tool_path(shown: ShownDataset, demo: Demonstration) -> Float[np.ndarray, "time 3"] | None:
    """Path of the end effector, recorded or computed from the joints [m]; None if unknown."""
    if demo.position is not None or shown.arm is None or demo.joint_position is None:
        return demo.position
    q = torch.from_numpy(shown.arm.positions(demo.joint_position))
    return shown.arm.arm.forward(q).position.numpy()


def _send_arm(
    stream: rr.RecordingStream,
    shown: ShownDataset,
    demo: Demonstration,
    timelines: Sequence[str],
    first: bool,
) -> None:
    if shown.arm is None or demo.joint_position is None:
        return
    q = shown.arm.positions(demo.joint_position)
    at = rerun_stream.samples(demo.time, rerun_stream.POSE_RATE)
    opening = shown.arm.opening(demo)
    opened = None if opening is None else opening[at]
    for body in arm_bodies(shown.arm.arm, q[at], opened):
        if first:
            rerun_stream.send_shapes(stream, body)
        rerun_stream.send_poses(stream, demo.time[at], body, np.arange(len(at)), timelines)


def _send_images(
    stream: rr.RecordingStream, images: Mapping[str, CameraImages], timelines: Sequence[str]
) -> None:
    for name, camera in images.items():
        path, index = f"cameras/{slug(name)}", rerun_stream.seconds(camera.time, timelines)
        if camera.codec in _CODECS:
            stream.log(path, rr.VideoStream(codec=_CODECS[camera.codec]), static=True)
            columns = rr.VideoStream.columns(sample=camera.samples)
        else:
            kinds = ["image/jpeg"] * len(camera.samples)
            columns = rr.EncodedImage.columns(blob=camera.samples, media_type=kinds)
        stream.send_columns(path, index, columns)


def _episode_tab(shown: ShownDataset, demo: Demonstration) -> Tab:
    """One plot for each recorded quantity of an episode, with commanded and measured values."""
    limits, plots = _limits(shown), []
    for chart in demonstration_charts(demo, shown.units):
        path, is_joint = f"episode/{chart.key}", chart.key.startswith("joint_")
        values = np.stack([*chart.lines.values()], axis=1)
        curves = [several(path, chart.lines, values)]
        if is_joint and limits is not None:
            joint = int(chart.key.removeprefix("joint_"))
            curves.append(limit_curves(f"{path}/limits", limits, joint, len(demo)))
        title = f"{chart.title} [{chart.unit}]"
        legend = not is_joint and len(chart.lines) > 1
        plots.append(Plot(title=title, curves=tuple(curves), legend=legend))
    title = "Episode: measured blue, commanded orange, limits red"
    return Tab(title=title, plots=tuple(plots), columns=1 + (len(plots) > 3))


def _limits(shown: ShownDataset) -> JointRanges | None:
    """Joint limits of the arm for each joint of the dataset, in the dataset's units."""
    if shown.arm is None:
        return None
    count = len(shown.demos[0].joint_names)
    lower, upper = np.full(count, np.nan), np.full(count, np.nan)
    for joint, column in enumerate(shown.arm.columns):
        unit, factor = own_unit(shown.units, "joint_position", column)
        if unit in ("rad", "deg"):  # a fraction of the joint's range needs no limit curves
            lower[column] = float(shown.arm.arm.limits.lower[joint]) / factor
            upper[column] = float(shown.arm.arm.limits.upper[joint]) / factor
    return JointRanges(lower=lower, upper=upper)


def _send_path(
    stream: rr.RecordingStream, shown: ShownDataset, demo: Demonstration, k: int
) -> str:
    """Draw the path of an episode's tool; returns the path length [m] as text."""
    path = tool_path(shown, demo)
    if path is None:
        return ""
    colour = palette.SERIES_ON_DARK[k % len(palette.SERIES_ON_DARK)]
    rerun_stream.send_strips(stream, f"world/paths/{demo.episode}", [path], colour, 0.003)
    rerun_stream.send_dot(stream, str(demo.episode), demo.time, path, colour)
    return f"{np.linalg.norm(np.diff(path, axis=0), axis=1).sum():.2f}"


def _summary(shown: ShownDataset, rows: Iterable[Sequence[object]]) -> str:
    """List of the demonstrations, as Markdown."""
    heads = ("episode", "task", "duration [s]", "frames", "path [m]")
    choose = "Choose the timeline of an episode in the time panel, at the bottom."
    notes = [f"- {note}" for note in shown.notes]
    table = rerun_stream.markdown_table(heads, rows)
    return "\n".join([f"# {shown.title}", "", choose, "", *table, "", *notes])
