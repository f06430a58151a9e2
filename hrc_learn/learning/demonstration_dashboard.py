"""Rerun recording of demonstrations, drawn together and one by one."""

import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import chain

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
import torch
from jaxtyping import Float

from hrc_learn.demos import Demonstration, DemonstrationSet
from hrc_learn.kinematics import panda
from hrc_learn.kinematics.franka import panda_bodies
from hrc_learn.log import JointRanges
from hrc_learn.viz import palette
from hrc_learn.viz.panels import Curves, Plot, Tab, limit_curves, several, single, slug
from hrc_learn.viz.rerun_stream import (
    POSE_RATE,
    dashboard,
    frame_view,
    markdown_table,
    rrd_file,
    samples,
    seconds,
    send_curves,
    send_dot,
    send_poses,
    send_shapes,
    send_strips,
    send_summary,
    tab_view,
)

Images = Mapping[str, tuple[np.ndarray, tuple[bytes, ...]]]
"""Times [s] and JPEG files of the images of a demonstration, by camera."""
Timed = list[tuple[Float[np.ndarray, "_"], Curves]]
"""Curves, each with the times of its samples [s]."""


def panda_ranges(joint_names: Sequence[str]) -> JointRanges | None:
    """Joint ranges of a Panda, None for other joints."""
    if tuple(joint_names) != panda.joint_names:
        return None
    return JointRanges(lower=panda.limits.lower.numpy(), upper=panda.limits.upper.numpy())


def record_demonstrations(
    path: str | os.PathLike[str],
    demos: DemonstrationSet,
    title: str,
    images: Mapping[int, Images] | None = None,
    *,
    most: int = 8,
) -> None:
    """Write demonstrations as an .rrd file with its layout; `rerun FILE` shows it.

    A Panda is drawn as well, with the path of its end effector.

    Args:
        path: File to write; it appears only when complete.
        demos: Demonstrations of one robot.
        title: Title of the recording.
        images: Camera images by episode.
        most: Number of demonstrations with a tab of their own; all are drawn together.
    """
    limits, images = panda_ranges(demos[0].joint_names), images or {}
    shown = [_completed(demo) for demo in demos]
    first, alone = shown[0], shown[:most]
    arm = (
        panda_bodies(first.joint_position)
        if limits and first.joint_position is not None
        else ()
    )
    tabs = [_together(shown, limits), *(_alone(demo) for demo in alone)]
    pages: list[rrb.Container] = [tab_view(tab) for tab, _ in tabs]
    for k, demo in enumerate(alone, start=1):
        pages[k] = _below_images(pages[k], demo, images.get(demo.episode, {}))
    left: list[rrb.View] = [rrb.TextDocumentView(origin="/summary", name="Demonstrations")]
    if paths := [demo.position for demo in shown if demo.position is not None]:
        name = "Paths of the end effector, dots: now"
        name += f"; the arm in episode {first.episode}" * bool(arm)
        eye = frame_view(np.concatenate(paths))
        left.insert(0, rrb.Spatial3DView(origin="/world", name=name, eye_controls=eye))
    right = rrb.Tabs(contents=pages, active_tab=0)
    layout = dashboard(left, [right], row_shares=(2, 1), column_shares=(2, 3))
    with rrd_file(path, title, layout) as stream:
        for k, demo in enumerate(shown):
            if demo.position is not None:
                name, colour = str(demo.episode), _colour(k)
                send_strips(stream, f"world/paths/{name}", [demo.position], colour, 0.003)
                send_dot(stream, name, demo.time, demo.position, colour)
        for body in arm:
            send_shapes(stream, body)
            send_poses(stream, first.time, body, samples(first.time, POSE_RATE))
        for demo in alone:
            _send_images(stream, demo, images.get(demo.episode, {}))
        send_summary(stream, _summary(title, shown, map(str, demos.notes)))
        for time, curves in chain.from_iterable(timed for _, timed in tabs):
            send_curves(stream, time, curves)


def _completed(demo: Demonstration) -> Demonstration:
    """Demonstration with a Panda's path, and NaN for features that were not seen."""
    position, feature = demo.position, demo.feature
    if position is None and demo.joint_position is not None and panda_ranges(demo.joint_names):
        position = panda.forward(torch.from_numpy(demo.joint_position)).position.numpy()
    if feature is not None and demo.feature_visible is not None:
        feature = np.where(demo.feature_visible[:, None], feature, np.nan)
    return replace(demo, position=position, feature=feature)


def _camera(demo: Demonstration, name: str) -> str:
    """Entity of the images of a camera."""
    return f"episode_{demo.episode}/cameras/{slug(name)}"


def _below_images(page: rrb.Container, demo: Demonstration, images: Images) -> rrb.Container:
    """Layout of a tab below the camera images, if there are any."""
    if not images:
        return page
    views = [rrb.Spatial2DView(origin=f"/{_camera(demo, name)}", name=name) for name in images]
    row, title = rrb.Horizontal(*views), f"Episode {demo.episode}"
    return rrb.Vertical(row, page, row_shares=(1, 3), name=title)


def _send_images(stream: rr.RecordingStream, demo: Demonstration, images: Images) -> None:
    for name, (time, files) in images.items():
        kinds = ["image/jpeg"] * len(files)
        columns = rr.EncodedImage.columns(blob=files, media_type=kinds)
        stream.send_columns(_camera(demo, name), seconds(time), columns)


def _together(demos: Sequence[Demonstration], limits: JointRanges | None) -> tuple[Tab, Timed]:
    """Tab with every joint and the feature of all demonstrations, and its curves."""
    joints = demos[0].joint_names
    titles = [("joint_position", j, f"{name} [rad]") for j, name in enumerate(joints)]
    titles += [("feature", i, f"Feature {pixel} [px]") for i, pixel in enumerate("uv")]
    longest = max((demo.time for demo in demos), key=lambda time: time[-1])
    plots, every = [], []
    for quantity, column, title in titles:
        timed: Timed = []
        if limits is not None and quantity == "joint_position":
            bounds = limit_curves(f"together/limits_{column}", limits, column, len(longest))
            timed.append((longest, bounds))
        for k, demo in enumerate(demos):
            if (values := getattr(demo, quantity)) is not None:
                path = f"together/{quantity}_{column}/{demo.episode}"
                name = f"episode {demo.episode}"
                timed.append((demo.time, single(path, name, values[:, column], _colour(k))))
        if timed:
            plots.append(Plot(title=title, curves=tuple(curves for _, curves in timed)))
            every += timed
    title = "All: joints" + ", limits red" * (limits is not None)
    return Tab(title=title, plots=tuple(plots), columns=2), every


def _colour(k: int) -> str:
    """Colour of demonstration k."""
    return palette.SERIES_ON_DARK[k % len(palette.SERIES_ON_DARK)]


def _alone(demo: Demonstration) -> tuple[Tab, Timed]:
    """Tab with all recorded quantities of one demonstration, and its curves."""
    plots, every = [], []
    for title, name, names, values in (
        ("Joints [rad]", "joints", demo.joint_names, demo.joint_position),
        ("Tool centre point [m]", "position", ("x", "y", "z"), demo.position),
        ("Feature in the image [px]", "feature", ("u (right)", "v (down)"), demo.feature),
        ("Effort of the person [N m]", "effort", demo.joint_names, demo.human_effort),
        ("Gripper [m]", "gripper", ("opening",), demo.gripper),
    ):
        if values is not None:
            columns = values.reshape(len(values), -1)
            curves = several(f"episode_{demo.episode}/{name}", names, columns)
            plots.append(Plot(title=title, curves=(curves,), legend=True))
            every.append((demo.time, curves))
    return Tab(title=f"Episode {demo.episode}", plots=tuple(plots)), every


def _summary(title: str, demos: Sequence[Demonstration], notes: Iterable[str]) -> str:
    """List of the demonstrations, as Markdown."""
    rows = []
    for demo in demos:
        length = ""
        if demo.position is not None:
            steps = np.linalg.norm(np.diff(demo.position, axis=0), axis=1)
            length = f"{steps.sum():.2f}"
        rows.append((demo.episode, demo.task, f"{demo.duration:.2f}", len(demo), length))
    heads = ("episode", "task", "duration [s]", "frames", "path [m]")
    notes = [f"- {note}" for note in notes]
    return "\n".join([f"# {title}", "", *markdown_table(heads, rows), "", *notes])
