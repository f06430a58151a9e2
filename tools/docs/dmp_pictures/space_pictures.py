"""Primitives of orientations and poses."""

import numpy as np
import torch
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d import Axes3D

from hrc_learn.dmp import OrientationDMP, PoseDMP
from hrc_learn.geometry import Pose, quaternion
from hrc_learn.viz import palette

from . import demonstrations

FRAME = (palette.VERMILION, palette.GREEN, palette.BLUE)
"""Colours of the axes x, y, z of a frame."""


def orientation(figure: Figure) -> None:
    """The path of the tool's axis on the sphere, to five goals."""
    time, swing = demonstrations.swing()
    dmp = OrientationDMP.fit(time, swing[:, 3:])
    sphere = figure.add_subplot(1, 2, 1, projection="3d", computed_zorder=False)
    turn = figure.add_subplot(1, 2, 2)
    assert isinstance(sphere, Axes3D)
    _draw_sphere(sphere)
    colours = (palette.RUN, palette.ORANGE, palette.GREEN, palette.PURPLE, palette.VERMILION)
    for angle, colour in zip((0, -40, 40, -80, 80), colours, strict=True):
        about = torch.tensor([0.0, np.deg2rad(angle), 0.0], dtype=torch.float64)
        goal = quaternion.multiply(quaternion.exp(about), dmp.goal)
        motion = dmp.rollout(goal=goal)
        axis = quaternion.rotate(motion.orientation, torch.tensor([1.0, 0, 0]).double())
        x, y, z = axis.detach().T
        sphere.plot(x, y, z, color=colour, lw=1.8)
        sphere.plot(x[-1:], y[-1:], z[-1:], "s", color=colour, ms=5)
        left = quaternion.angle(motion.orientation, goal).detach()
        label = f"{angle:+d}°" if angle else "demonstrated"
        turn.plot(motion.time, left.rad2deg(), color=colour, label=label)
    sphere.set_title("The tool's axis, goal turned about y", loc="left", y=0.98)
    turn.set(xlabel="time [s]", ylabel="angle [deg]", title="Distance to the goal")
    turn.legend(loc="upper right", title="goal")


def _draw_sphere(axes: Axes3D) -> None:
    u, v = np.meshgrid(np.linspace(0, 2 * np.pi, 37), np.linspace(0, np.pi, 19))
    points = np.cos(u) * np.sin(v), np.sin(u) * np.sin(v), np.cos(v)
    axes.plot_wireframe(*points, rstride=3, cstride=3, color="#D5D9DE", linewidth=0.5)
    axes.set_box_aspect((1, 1, 1), zoom=1.35)  # pyright: ignore[reportArgumentType]
    axes.view_init(elev=28, azim=40)
    axes.set_axis_off()


def pose(figure: Figure) -> None:
    """A pose and a body coordinate, to the demonstrated goal and to another."""
    time, swing = demonstrations.swing()
    body = 0.4 * torch.sin(torch.pi * demonstrations.rise(time / time[-1]))
    dmp = PoseDMP.fit(time, swing[:, :3], swing[:, 3:], body=body[:, None], approach=0.7)
    other = Pose(
        dmp.goal.position + torch.tensor([0.12, -0.05, 0.22], dtype=torch.float64),
        dmp.goal.orientation,
    )
    grid = figure.add_gridspec(1, 2, width_ratios=[1.25, 1])
    space = figure.add_subplot(grid[0], projection="3d", computed_zorder=False)
    over_time = figure.add_subplot(grid[1])
    assert isinstance(space, Axes3D)
    for goal, colour, label in (
        (None, palette.RUN, "demonstrated"),
        (other, palette.ORANGE, "another shelf"),
    ):
        motion = dmp.rollout(goal=goal)
        space.plot(*motion.position.detach().T, color=colour, lw=2, label=label)
        for k in range(0, len(time), 33):
            _draw_frame(space, motion.position[k].detach(), motion.orientation[k].detach())
        over_time.plot(
            motion.time,
            motion.body[:, 0].detach(),
            color=colour,
            label=label,
            lw=3 - bool(goal),
        )
    space.set(xlabel="x [m]", ylabel="y [m]", zlabel="z [m]", aspect="equal")
    space.view_init(elev=22, azim=-62)
    space.locator_params(nbins=4)
    space.set_title("Path of the tool with its frames", loc="left")
    space.legend(loc="upper left")
    over_time.set(
        xlabel="time [s]", ylabel="arm angle [rad]", title="Arm angle, the same for both"
    )


def _draw_frame(axes: Axes3D, position: torch.Tensor, rotation: torch.Tensor) -> None:
    for direction, colour in zip(quaternion.to_matrix(rotation).T, FRAME, strict=True):
        tip = position + 0.05 * direction
        axes.plot(*torch.stack([position, tip]).T, color=colour, lw=1.0)
