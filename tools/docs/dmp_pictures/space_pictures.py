"""Primitives of orientations and poses."""

import numpy as np
import torch
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d import Axes3D

from hrc_learn.dmp import DualArmDMP, OrientationDMP, PoseDMP
from hrc_learn.geometry import Pose, quaternion
from hrc_learn.viz import palette

from . import demonstrations
from .drawing import plane

PUSHED = (0.7, 1.5)
"""From when to when a hand is pushed [s]."""

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
    space.set_title("Path of the hand with its frames", loc="left")
    space.legend(loc="upper left")
    over_time.set(xlabel="time [s]", ylabel="arm angle [rad]", title="The body keeps its shape")


def dual_arm(figure: Figure) -> None:
    """Two hands with one object, the first one pushed on the way: apart and coupled."""
    time, position, orientation = demonstrations.carried()
    grid = figure.add_gridspec(1, 3, width_ratios=[1, 1, 1.1])
    error = figure.add_subplot(grid[2])
    for k, (gain, colour, label) in enumerate(
        ((0.0, palette.VERMILION, "apart"), (25.0, palette.RUN, "coupled"))
    ):
        hands = figure.add_subplot(grid[k])
        dmp = DualArmDMP.fit(time, position, orientation, gain=gain)
        seconds, now, planned = _pushed(dmp)
        hands.plot(*planned.position[..., :2].movedim(-1, 0), color=palette.DEMO, lw=3)
        hands.plot(*now.position[..., :2].movedim(-1, 0), color=colour)
        for i in range(0, len(seconds), 12):
            hands.plot(*now.position[i, :, :2].T, "o-", color=palette.BLACK, lw=0.9, ms=2.5)
        plane(hands, f"Seen from above, {label}")
        apart, wanted = (p[..., 0].inverse() @ p[..., 1] for p in (now, planned))
        off = (apart.position - wanted.position).norm(dim=-1)
        error.plot(seconds, 100 * off, color=colour, label=label)
    error.axvspan(*PUSHED, color=palette.DEMO, alpha=0.3, lw=0, label="pushed")
    error.set(xlabel="time [s]", ylabel="distance [cm]", title="Relative position off plan")
    error.legend()


def _pushed(dmp: DualArmDMP) -> tuple[torch.Tensor, Pose, Pose]:
    """Times, poses of both hands and the planned ones, one hand pushed for a while."""
    dt, push = 0.02, torch.zeros(2, 6, dtype=torch.float64)
    push[0, 0] = -5.0
    seconds = dt * torch.arange(1, 176, dtype=torch.float64)
    states = [dmp.initial_state()]
    with torch.no_grad():
        for t in seconds:
            coupling = push if PUSHED[0] <= t < PUSHED[1] else None
            states.append(dmp.step(states[-1], dt, coupling=coupling))
    now, planned = (
        torch.stack([pose.vector() for pose in poses])
        for poses in ([s.pose for s in states[1:]], [s.planned.pose for s in states[1:]])
    )
    return seconds, Pose.from_vector(now), Pose.from_vector(planned)


def _draw_frame(axes: Axes3D, position: torch.Tensor, rotation: torch.Tensor) -> None:
    for direction, colour in zip(quaternion.to_matrix(rotation).T, FRAME, strict=True):
        tip = position + 0.05 * direction
        axes.plot(*torch.stack([position, tip]).T, color=colour, lw=1.0)
