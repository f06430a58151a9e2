"""Report of a run: sections, and figures like those of the paper's Experiments 2 and 3.

Most figures take the recording of a run and, for each object, the time interval in which the
robot handled it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import matplotlib
import numpy as np
from jaxtyping import Bool, Float
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from hrc_learn.experiments.placing_metrics import PlacingRun
from hrc_learn.experiments.placing_trial import SPACES, demonstrated_path
from hrc_learn.experiments.run_measures import lasting
from hrc_learn.log import JointRanges, RunRecording
from hrc_learn.store import read_toml
from hrc_learn.viz import palette
from hrc_learn.viz.figures import (
    DEMO_LOOK,
    STYLE,
    WIDTH,
    JointCurves,
    active_intervals,
    frame_space,
    joint_grid_figure,
    joints_figure,
    plots_figure,
    space,
)
from hrc_learn.viz.panels import image_jacobian_plots, person_plots, with_values, worker_plots
from hrc_learn.viz.report import Picture, Section

Spans = Mapping[str, tuple[float, float]]
"""Start and end of the work on each object [s], by its name."""

CARRYING = ("transfer", "release")
"""Phases in which the end effector moves an object into the cabinet."""

_HIDDEN = "#8D8F94"
_SHELVES = (palette.ORANGE, palette.BLUE, palette.PURPLE, palette.GREEN)
"""Colours of the shelves, from bottom to top."""


@dataclass(frozen=True, kw_only=True)
class _SectionText:
    heading: str
    text: str
    captions: dict[str, str] = field(default_factory=dict)
    """Captions of the figures, by name."""


@dataclass(frozen=True, kw_only=True)
class _Texts:
    summary: dict[str, str]
    section: dict[str, _SectionText]


_TEXTS = read_toml(Path(__file__).with_name("run_report.toml"), _Texts)
SUMMARIES = _TEXTS.summary
"""Description of each experiment; blank lines separate paragraphs."""


def worded(topic: str, figures: Mapping[str, Figure], more: str = "") -> Section:
    """Section with the heading, the text and the captions of `run_report.toml`.

    Args:
        topic: Name of the section in this file.
        figures: Figures by the names of their captions.
        more: Text to append.
    """
    said = _TEXTS.section[topic]
    pictures = [Picture(name, drawn, said.captions[name]) for name, drawn in figures.items()]
    return Section(heading=said.heading, text=said.text + more, figures=pictures)


def run_sections(run: RunRecording, objects: Spans, notes: Sequence[str] = ()) -> list[Section]:
    """Report sections: timeline, servoing, person and worker if present, motion.

    Args:
        run: Recording of a run that servoed with a camera.
        objects: Start and end of the work on each object [s].
        notes: Recoveries, in words.
    """
    shown = {
        "job": {"timeline": timeline_figure(run, objects)},
        "servoing": {
            "marker": marker_figure(run, objects),
            "image_jacobian": image_jacobian_figure(run),
        },
    }
    if run.nullspace_input is not None and run.nullspace_input.any():
        shown["person"] = {"person": person_figure(run)}
    if run.worker_distance:
        shown["worker"] = {"worker": plots_figure(run.time, worker_plots(run))}
    shown["motion"] = {
        "trajectories": trajectories_figure(run, objects),
        "joints": joints_figure(run),
    }
    recoveries = {"job": f" {' '.join(notes) or 'No recovery was needed.'}"}
    return [worded(topic, drawn, recoveries.get(topic, "")) for topic, drawn in shown.items()]


def person_figure(run: RunRecording) -> Figure:
    """Effort of the person and its effects, from the first to the last action (shaded)."""
    assert run.nullspace_input is not None
    acting = np.asarray(run.nullspace_input.any(axis=1))
    present = acting
    if run.position_deviation is not None:  # known while a person is present
        present = acting | np.isfinite(run.position_deviation)
    return plots_figure(run.time, with_values(person_plots(run)), shown=present, shaded=acting)


def image_jacobian_figure(run: RunRecording) -> Figure:
    """Entries of the estimated image Jacobian, with the true entries if known."""
    assert run.image_jacobian is not None
    known = np.asarray(np.isfinite(run.image_jacobian).all(axis=(1, 2)))
    return plots_figure(run.time, image_jacobian_plots(run), columns=2, shown=known)


def trajectories_figure(run: RunRecording, objects: Spans) -> Figure:
    """Paths of the end effector while it handles each object, and the demonstrated path."""
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, 5.2))
        axes = space(figure)
        points = run.position
        if run.demo_path is not None:
            points = np.concatenate([points, run.demo_path])
            axes.plot(*run.demo_path.T, color=palette.DEMO, lw=5.0, label="demonstration")
        carried = np.zeros(len(run.time), dtype=bool)
        for event, end in lasting(run.phases, float(run.time[-1])):
            if event.text in CARRYING:
                carried |= _within(run.time, (event.time, end))
        for (name, span), colour in zip(objects.items(), palette.SERIES, strict=False):
            rows = _within(run.time, span)
            axes.plot(
                *run.position[rows].T, color=colour, lw=0.8, alpha=0.5, label=f"path: {name}"
            )
            path = run.position[rows & carried]
            if len(path):
                axes.plot(*path.T, color=colour, lw=2.0, label=f"carried: {name}")
                axes.plot(*path[-1], "s", color=colour, ms=5)
        axes.legend(loc="upper right")
        axes.set_title("Paths of the tool centre point", loc="left")
        frame_space(axes, points, run.boxes)
    return figure


def marker_figure(run: RunRecording, objects: Spans) -> Figure:
    """Paths of the gripper's marker in the image, and its distance from the target."""
    camera = run.camera
    if camera is None:
        raise ValueError("this figure needs the camera, which the recording does not have.")
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, 6.0))
        grid = figure.add_gridspec(2, 1, height_ratios=[2.1, 1])
        image, error = figure.add_subplot(grid[0]), figure.add_subplot(grid[1])
        if len(camera.images):
            image.imshow(camera.images[0], alpha=0.45)
        for (name, span), colour in zip(objects.items(), palette.SERIES, strict=False):
            rows = _within(run.time, span)
            seen = rows & np.isfinite(camera.feature).all(axis=1)
            if not seen.any():
                continue
            feature, target = camera.feature[seen], camera.target[seen]
            image.plot(*feature.T, color=colour, label=name)
            image.plot(*feature[0], "o", color=colour, ms=5)
            image.plot(*target[-1], "+", color=colour, ms=13, mew=2)
            error.plot(run.time[rows], camera.error[rows], color=colour)
        image.set(
            xlim=(0, camera.model.width),
            ylim=(camera.model.height, 0),
            aspect="equal",
            xlabel="u [px]",
            ylabel="v [px]",
            title="Path of the gripper's marker (dot: first seen, cross: target)",
        )
        if image.get_legend_handles_labels()[0]:  # none if the marker was never seen
            image.legend(loc="upper right")
        hidden = _out_of_sight(run)
        for first, last in active_intervals(hidden):
            error.axvspan(run.time[first], run.time[last], color=_HIDDEN, alpha=0.25, lw=0)
        error.set_yscale("log")
        error.margins(x=0)
        error.set(
            xlabel="time [s] (shaded: marker occluded)",
            ylabel="distance [px]",
            title="Distance to the target",
        )
        if (known := hidden | np.isfinite(camera.error)).any():
            error.set_xlim(run.time[known][0], run.time[known][-1])
    return figure


def timeline_figure(run: RunRecording, objects: Spans) -> Figure:
    """Phases of the task by object, with pushes and occlusions below."""
    events = [
        (event, end)
        for event, end in lasting(run.phases, float(run.time[-1]))
        if end > event.time
    ]
    names = list(dict.fromkeys(event.text for event, _ in events))
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, 0.9 + 0.26 * (len(names) + 2)))
        axes = figure.subplots()
        colours = dict(zip(objects, palette.SERIES, strict=False))
        for event, end in events:
            owner = next((n for n, (a, b) in objects.items() if a <= event.time < b), None)
            colour = palette.GREY if owner is None else colours[owner]
            bar = (event.time, max(end - event.time, 0.15))
            axes.broken_barh([bar], (names.index(event.text) - 0.38, 0.76), color=colour)
        effort = run.nullspace_input
        pushed = np.zeros(len(run.time), bool) if effort is None else effort.any(axis=1)
        rows = {
            "person pushes": (pushed, palette.PURPLE),
            "marker occluded": (_out_of_sight(run), _HIDDEN),
        }
        for k, (active, colour) in enumerate(rows.values(), start=len(names)):
            spells = active_intervals(active)
            bars = [(run.time[a], run.time[b] - run.time[a]) for a, b in spells]
            axes.broken_barh(bars, (k - 0.38, 0.76), color=colour)
        axes.set_yticks(range(len(names) + len(rows)), [*names, *rows])
        axes.invert_yaxis()
        axes.set(xlim=(run.time[0], run.time[-1]), xlabel="time [s]")
        axes.grid(axis="y", visible=False)
        handles = [axes.plot([], [], lw=6, color=c)[0] for c in colours.values()]
        figure.legend(handles, colours, loc="outside upper right", ncols=len(colours))
    return figure


def _within(
    time: Float[np.ndarray, " time"], span: tuple[float, float]
) -> Bool[np.ndarray, " time"]:
    return (time >= span[0]) & (time < span[1])


def _out_of_sight(run: RunRecording) -> Bool[np.ndarray, " time"]:
    """True at steps in which the marker has a target but is not seen by the camera."""
    if run.camera is None:
        return np.zeros(len(run.time), dtype=bool)
    targeted = np.isfinite(run.camera.target).all(axis=1)
    return np.asarray(targeted & ~np.isfinite(run.camera.feature).all(axis=1))


def placing_paths_figure(run: PlacingRun, shelves: Sequence[str]) -> Figure:
    """Paths of the end effector to shelves, one panel for each planning space."""
    shown = demonstrated_path(run.scene.demonstration, run.scene.workplace.robot.chain)
    paths = {key: placed.path for key, placed in run.placings.items()}
    points = np.concatenate([shown, *paths.values()])
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, 4.5))
        for i, (planned, label) in enumerate(SPACES.items()):
            axes = space(figure, position=(1, len(SPACES), 1 + i))
            axes.plot(*shown.T, color=palette.DEMO, lw=5, label="demonstration")
            for shelf, colour in zip(shelves, _SHELVES, strict=False):
                path = paths[planned, shelf]
                axes.plot(*path.T, color=colour, lw=1.8, label=f"{shelf} shelf")
                axes.plot(*path[-1], "s", color=colour, ms=4)
            axes.set_title(label.capitalize(), loc="left")
            frame_space(axes, points, list(run.scene.workplace.scene.cabinet.boxes()))
            axes.xaxis.set_major_locator(MaxNLocator(3))
            axes.view_init(elev=16, azim=62)
        handles, labels = figure.axes[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper center", ncols=len(labels))
    return figure


def placing_joints_figure(run: PlacingRun, shelves: Sequence[str]) -> Figure:
    """Joint positions over time: the demonstration, and the motion to each shelf."""
    shown, chain = run.scene.demonstration, run.scene.workplace.robot.chain
    assert shown.joint_position is not None
    time = shown.time - shown.time[0]
    curves = [JointCurves("demonstration", time, shown.joint_position, *DEMO_LOOK)]
    for shelf, colour in zip(shelves, _SHELVES, strict=False):
        placed = run.placings["pose", shelf]
        name, position = f"{shelf} shelf", placed.joint_position
        curves.append(JointCurves(name, placed.time, position, colour))
    return joint_grid_figure(chain.joint_names, curves, JointRanges.of(chain.limits))
