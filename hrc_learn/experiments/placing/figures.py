"""Figures of placing on several shelves, and rendered snapshots of the arm.

Each shelf has one colour throughout, demonstrations are grey.
"""

from collections.abc import Iterable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass

import matplotlib
import numpy as np
import torch
from jaxtyping import Float
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, NullFormatter, StrMethodFormatter

from hrc_learn.experiments.placing.arm_angle_ablation import SimulatedDemonstration
from hrc_learn.experiments.placing.trial import PlacingRun
from hrc_learn.experiments.snapshots import Image, viewpoint
from hrc_learn.geometry import Box
from hrc_learn.log import JointRanges
from hrc_learn.sim import OffscreenRenderer, World
from hrc_learn.sim.workplace import Workplace
from hrc_learn.viz import palette
from hrc_learn.viz.figure_parts import (
    STYLE,
    WIDTH,
    draw_box,
    draw_limits,
    frame_space,
    legend_in_free_cell,
    near,
    space,
)

type Snapshots = Mapping[str, Sequence[tuple[str, Image]]]
"""Rendered pictures with their titles, by what they show."""

_EYE, _TOWARDS = (1.30, 0.95, 1.10), (0.24, -0.30, 0.30)
# The object's x lies along the fingers' line of closing, its top towards the palm.
_IN_GRIPPER = np.array([[0.0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]])

_SHELF_COLOURS = (palette.ORANGE, palette.BLUE, palette.PURPLE, palette.GREEN)


@dataclass(frozen=True, kw_only=True, eq=False)
class Motion:
    """A motion of the arm."""

    time: Float[np.ndarray, " samples"]
    """[s]"""
    joint_position: Float[np.ndarray, "samples joints"]
    """[rad]"""
    path: Float[np.ndarray, "samples 3"]
    """Of the tool centre point [m]."""


def shelf_colours(shelves: Sequence[str]) -> dict[str, str]:
    """One for each, in order."""
    return dict(zip(shelves, _SHELF_COLOURS, strict=False))


def shelf_paths_figure(
    demonstration: Motion,
    motions: Mapping[str, Mapping[str, Motion]],
    boxes: tuple[Box, ...],
) -> Figure:
    """Paths of the end effector, one panel for each space of planning.

    Args:
        demonstration: The demonstrated motion.
        motions: By space of planning and shelf.
        boxes: What stands around.
    """
    everything = [m.path for by_shelf in motions.values() for m in by_shelf.values()]
    points = np.concatenate([demonstration.path, *everything])
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, 4.5))
        for i, (space_name, by_shelf) in enumerate(motions.items()):
            axes = space(figure, position=(1, len(motions), 1 + i))
            for box in near(boxes, points):
                draw_box(axes, box, "#8D8F94", alpha=0.08)
            axes.plot(*demonstration.path.T, color=palette.DEMO, lw=5, label="demonstration")
            for shelf, colour in shelf_colours(list(by_shelf)).items():
                path = by_shelf[shelf].path
                axes.plot(*path.T, color=colour, lw=1.8, label=f"{shelf} shelf")
                axes.plot(*path[-1], "s", color=colour, ms=4)
            axes.set_title(space_name.capitalize(), loc="left")
            frame_space(axes, points, zoom=1.0)
            axes.xaxis.set_major_locator(MaxNLocator(3))
            axes.view_init(elev=16, azim=62)
        _legend_above(figure)
    return figure


def shelf_joints_figure(
    names: Sequence[str],
    demonstration: Motion,
    motions: Mapping[str, Motion],
    limits: JointRanges,
) -> Figure:
    """Every joint over time: the demonstration, and the motion to each shelf.

    Args:
        names: Of the joints.
        demonstration: The demonstrated motion.
        motions: By shelf.
        limits: Of the joints.
    """
    rows = -(-len(names) // 2)
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, 1.45 * rows + 0.5))
        grid = figure.subplots(rows, 2, sharex=True, squeeze=False).ravel()
        for i, (axes, name) in enumerate(zip(grid, names, strict=False)):
            axes.plot(
                demonstration.time,
                demonstration.joint_position[:, i],
                color=palette.DEMO,
                lw=3.5,
                label="demo",
            )
            for shelf, colour in shelf_colours(list(motions)).items():
                motion = motions[shelf]
                position = motion.joint_position[:, i]
                axes.plot(motion.time, position, color=colour, label=f"{shelf} shelf")
            axes.set(title=name, ylabel="rad")
            axes.margins(x=0)
            draw_limits(axes, float(limits.lower[i]), float(limits.upper[i]))
        legend_in_free_cell(figure, grid, len(names))
    return figure


@dataclass(frozen=True, kw_only=True, eq=False)
class ApproachDistance:
    """Distance of an approach path from the demonstrated one."""

    remaining: Float[np.ndarray, " samples"]
    """Distance left to the goal [m]."""
    distance: Float[np.ndarray, " samples"]
    """From the demonstrated path there [m]."""


def approach_figure(
    approaches: Mapping[str, Mapping[str, ApproachDistance]], bound: float
) -> Figure:
    """Deviation of the approach paths, one panel for each space of planning.

    Args:
        approaches: By space of planning and shelf.
        bound: Of a good placing [m].
    """
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, 2.9))
        panels = figure.subplots(1, len(approaches), sharey=True, squeeze=False)[0]
        for axes, (title, by_shelf) in zip(panels, approaches.items(), strict=True):
            for shelf, colour in shelf_colours(list(by_shelf)).items():
                approach = by_shelf[shelf]
                axes.plot(
                    1e3 * approach.remaining,
                    1e3 * approach.distance,
                    color=colour,
                    label=f"{shelf} shelf",
                )
            axes.axhline(1e3 * bound, color=palette.LIMIT, lw=1, ls="--", label="bound")
            axes.set(title=title.capitalize(), xlabel="distance left to the goal [mm]")
            axes.set_yscale("log")
            axes.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
            axes.set_ylim(0.1, 400)
            longest = max(a.remaining.max(initial=1e-3) for a in by_shelf.values())
            axes.set_xlim(1e3 * longest, 0)
        panels[0].set_ylabel("approach-path deviation [mm]")
        _legend_above(figure)
    return figure


def smoothness_figure(demonstration: Motion, reproduction: Motion) -> Figure:
    """Speed and jerk of the end effector, demonstrated and reproduced.

    Both are scaled by duration and length of the path, so that neither a faster nor a longer
    motion counts as less smooth.
    """
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, 2.9))
        speed, jerk = figure.subplots(1, 2)
        for label, motion, colour, width in (
            ("demonstration", demonstration, palette.DEMO, 1.2),
            ("reproduction", reproduction, palette.RUN, 1.6),
        ):
            fraction, first, third = _scaled_derivatives(motion)
            speed.plot(fraction, first, color=colour, lw=width, label=label)
            jerk.plot(fraction, third, color=colour, lw=width, label=label)
        speed.set(
            title="Speed of the end effector",
            ylabel="[path lengths / duration]",
            ylim=(0, None),
        )
        jerk.set(title="Jerk of the end effector", ylabel="[path lengths / duration³]")
        jerk.set_yscale("log")
        jerk.set_ylim(10, None)
        for axes in (speed, jerk):
            axes.set_xlabel("fraction of the motion")
            axes.margins(x=0)
        _legend_above(figure)
    return figure


def _legend_above(figure: Figure) -> None:
    """One legend for all panels, which show the same curves."""
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=len(labels))


def _scaled_derivatives(motion: Motion) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Fraction of the duration, and size of the first and third derivative by it."""
    fraction = (motion.time - motion.time[0]) / (motion.time[-1] - motion.time[0])
    path = motion.path / np.linalg.norm(np.diff(motion.path, axis=0), axis=1).sum()
    sizes, values = [], path
    for _ in range(3):
        values = np.gradient(values, fraction, axis=0)
        sizes.append(np.linalg.norm(values, axis=1))
    return fraction, sizes[0], sizes[2]


def trials_figure(
    values: Mapping[str, Mapping[str, Float[np.ndarray, " trials"]]],
    bounds: Mapping[str, float],
) -> Figure:
    """Every trial as a dot, by shelf, one panel for each measure.

    Args:
        values: By measure (with its unit) and shelf.
        bounds: Of a good placing, by measure.
    """
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, 2.9))
        panels = figure.subplots(1, len(values), squeeze=False)[0]
        for axes, (measure, by_shelf) in zip(panels, values.items(), strict=True):
            for x, (shelf, colour) in enumerate(shelf_colours(list(by_shelf)).items()):
                dots = by_shelf[shelf]
                # Spread by the golden ratio: dots that hide each other cannot be counted.
                aside = 0.3 * (np.modf(np.arange(len(dots)) * 0.618)[0] - 0.5)
                axes.plot(x + aside, dots, ".", color=colour, ms=4, alpha=0.7)
            axes.axhline(bounds[measure], color=palette.LIMIT, lw=1, ls="--")
            axes.set(title=measure, xticks=range(len(by_shelf)), xticklabels=list(by_shelf))
            axes.set_xlim(-0.6, len(by_shelf) - 0.4)
            axes.set_yscale("log")
            known = np.concatenate([d[np.isfinite(d)] for d in by_shelf.values()])
            decade = 10.0 ** np.floor(np.log10(max(known.min(initial=1.0), 1e-6)))
            axes.set_ylim(decade, 3 * max(bounds[measure], known.max(initial=0.0)))
            axes.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
            axes.yaxis.set_minor_formatter(NullFormatter())
    return figure


class Photographer:
    """Puts the arm anywhere, with the object in the gripper, and takes a picture."""

    def __init__(self, workplace: Workplace):
        """Stand at the far corner of the table, looking at the cabinet.

        Raises:
            RenderingUnavailableError: If this machine cannot render without a screen.
        """
        self._world = World(workplace.scene)
        self._item = workplace.scene.objects[0]
        self._camera = viewpoint(_EYE, _TOWARDS)
        self._renderer = OffscreenRenderer(self._world, self._camera.width, self._camera.height)

    def picture(self, joints: Float[np.ndarray, "7"], touching: Iterable[str] = ()) -> Image:
        """The arm there; geoms that touch something stand out.

        Args:
            joints: Joint positions [rad].
            touching: Names of those geoms.
        """
        tool = self._world.arm.robot.chain.forward(torch.from_numpy(joints)).matrix().numpy()
        width = 2 * self._item.half_size[0]
        self._world.reset(joints, {self._item.name: tool @ _IN_GRIPPER}, gripper_width=width)
        return self._renderer.render(self._camera, touching=touching)

    def close(self) -> None:
        """Free the OpenGL context."""
        self._renderer.close()


def take_snapshots(run: PlacingRun) -> Snapshots:
    """Motion, shelves and null-space posture.

    Raises:
        RenderingUnavailableError: If this machine cannot render without a screen.
    """
    last = {
        shelf: run.placings["pose", shelf].joint_position[-1]
        for shelf in run.workplace.shelf_names()
    }
    with closing(Photographer(run.workplace)) as camera:
        return {
            "snapshots": _motion(run, camera),
            "shelves": [(f"{shelf} shelf", camera.picture(q)) for shelf, q in last.items()],
            "null_space_posture": _null_space_posture(run, camera),
        }


def _motion(run: PlacingRun, camera: Photographer) -> list[tuple[str, Image]]:
    """Two moments of the demonstration and two of its reproduction, as in the paper."""
    demonstration, reproduction = run.demonstration, run.reproduction
    assert demonstration.joint_position is not None
    moments = (
        ("(a) demonstration", demonstration.time, demonstration.joint_position, 0.35),
        ("(b) demonstration", demonstration.time, demonstration.joint_position, 0.80),
        ("(c) reproduction", reproduction.time, reproduction.joint_position, 0.35),
        ("(d) reproduction", reproduction.time, reproduction.joint_position, 1.0),
    )
    taken = []
    for title, time, joints, fraction in moments:
        wanted = time[0] + fraction * (time[-1] - time[0])
        k = min(int(np.searchsorted(time, wanted)), len(time) - 1)
        taken.append((f"{title}, t = {time[k] - time[0]:.1f} s", camera.picture(joints[k])))
    return taken


def _null_space_posture(run: PlacingRun, camera: Photographer) -> list[tuple[str, Image]]:
    """The arm when it hits the cabinet without the posture, and the same moment with it."""
    without, taught = run.ablation.without_posture, run.ablation.with_posture
    hits = without.arm_contacts
    moment = hits[0].start if hits else float(without.time[-1])

    def at(demonstration: SimulatedDemonstration) -> np.ndarray:
        step = int(np.searchsorted(demonstration.time, moment)) - 1
        return demonstration.joint_position[step]

    end = "the arm hits the door" if hits else "free"
    picture = camera.picture(at(without), {touch.first for touch in hits[:1]})
    return [
        (f"(a) without, t = {moment:.1f} s: {end}", picture),
        (f"(b) with null-space posture, t = {moment:.1f} s", camera.picture(at(taught))),
    ]
