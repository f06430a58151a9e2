"""Primitives in closed loop."""

from collections.abc import Callable

import numpy as np
import torch
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from hrc_learn.dmp import JointDMP
from hrc_learn.dmp.coupling import (
    phase_stopping,
    repulsion,
    steering,
    velocity_coupling,
)
from hrc_learn.viz import palette

from . import demonstrations
from .drawing import DEMO, ends, panels, plane

DT = 0.004


def run(dmp: JointDMP, seconds: float, change: Callable[..., dict]) -> np.ndarray:
    """Positions (steps, D) of steps with what `change(time, state)` gives `step`."""
    state, path = dmp.initial_state(), []
    with torch.no_grad():
        for k in range(int(seconds / DT)):
            state = dmp.step(state, DT, **change(k * DT, state))
            path.append(state.position.numpy())
    return np.stack(path)


def goal_filter(figure: Figure) -> None:
    """A goal that jumps at half time, with and without a filter."""
    time, position = demonstrations.joints()
    dmp = JointDMP.fit(time, position[:, :1])
    goal = dmp.goal + 0.5
    where, how = panels(figure, 2)
    where.plot(time, position[:, 0], **DEMO)
    for rate, colour, label in (
        (None, palette.VERMILION, "at once"),
        (8.0, palette.BLUE, "goal_filter=8"),
    ):

        def change(now: float, _state, rate=rate) -> dict:
            return {"goal": goal, "goal_filter": rate} if now > 1.0 else {}

        path = run(dmp, 2.6, change)[:, 0]
        t = DT * np.arange(1, len(path) + 1)
        where.plot(t, path, color=colour, label=label)
        how.plot(t[1:-1], np.diff(path, 2) / DT**2, color=colour, label=label)
    where.plot(2.6, goal[0], "s", color=palette.TARGET, ms=5, clip_on=False)
    where.set(xlabel="time [s]", ylabel="joint [rad]", title="The goal jumps by 0.5 rad at 1 s")
    how.set(xlabel="time [s]", ylabel="acceleration [rad/s²]", title="Its acceleration")
    where.legend(loc="upper left")


def stopping(figure: Figure) -> None:
    """A robot held fast for a while: the motion waits for it, or runs away."""
    time, position = demonstrations.joints()
    dmp = JointDMP.fit(time, position[:, :1])
    for axes, gain, title in zip(
        panels(figure, 2, sharey=True),
        (0.0, 1500.0),
        ("The clock runs on", "Phase stopping"),
        strict=True,
    ):
        robot, followed = [dmp.start.clone()], []

        def change(now: float, state, gain=gain, robot=robot, followed=followed) -> dict:
            measured = robot[-1]
            if not 0.6 < now < 1.3:
                measured = measured + 100 * DT * (state.position - measured)
            robot.append(measured)
            followed.append(measured.item())
            return {"phase_stopping": phase_stopping(state.position, measured, gain)}

        path = run(dmp, 3.0, change)[:, 0]
        t = DT * np.arange(1, len(path) + 1)
        axes.axvspan(0.6, 1.3, color=palette.PERSON, alpha=0.13, lw=0)
        axes.plot(t, path, color=palette.BLUE, label="primitive")
        axes.plot(t, followed, color=palette.VERMILION, label="robot, held from 0.6 to 1.3 s")
        axes.set(xlabel="time [s]", title=title)
    figure.axes[0].set_ylabel("joint [rad]")
    figure.axes[1].legend(loc="lower right")


def obstacles(figure: Figure) -> None:
    """The same motion past the same ball, from five starts, steered and repelled."""
    time, position = demonstrations.stroke()
    flat = torch.zeros_like(position[:, :1])
    ball, radius = torch.tensor([0.2, 0.1, 0.0], dtype=torch.float64), 0.045
    dmp = JointDMP.fit(time, torch.cat([position * torch.tensor([1.0, 0.45]), flat], -1))

    def steer(_now: float, state) -> dict:
        away = {"gain": 150.0, "sharpness": 1.0, "reach": 0.1}
        return {"coupling": steering(state.position, state.velocity, ball[None], **away)}

    def repel(_now: float, state) -> dict:
        away = state.position - ball
        near = (ball + away * (radius / away.norm()).clamp_max(1))[None]
        return {"coupling": repulsion(state.position, near, reach=0.1, gain=1e-4)}

    for axes, change, title in zip(
        panels(figure, 2, sharey=True), (steer, repel), ("Steering", "Repulsion"), strict=True
    ):
        axes.add_patch(Circle((0.2, 0.1), radius, color=palette.LIMIT, alpha=0.35, lw=0))
        for offset in (-0.05, -0.025, 0.0, 0.025, 0.05):
            shift = torch.tensor([0.0, offset, 0.0], dtype=torch.float64)
            moved = JointDMP.fit(time, dmp.rollout().position.detach() + shift)
            free = moved.rollout().position.detach()
            path = run(moved, 2.6, change)
            axes.plot(*free.T[:2], **DEMO)
            axes.plot(*path.T[:2], color=palette.RUN)
            ends(axes, path[0, :2], path[-1, :2], palette.RUN)
        plane(axes, f"{title} around a ball")


def force(figure: Figure) -> None:
    """Left: learning to press with 8 N. Right: two arms that keep what they carry."""
    left, right = panels(figure, 2)
    _press(left)
    _carry(right)


def _press(axes) -> None:
    time, s = demonstrations.stamps(2.0)
    dmp = JointDMP.fit(time, 0.32 * demonstrations.rise(s)[:, None], units="m")
    stiffness, gain, steps, dt = 1000.0, 0.005, 400, 0.01
    t = dt * torch.arange(steps, dtype=torch.float64)
    wanted = 8.0 * demonstrations.rise((t - 1.5) / 0.5)[:, None]
    learned = torch.zeros_like(wanted)
    for repetition, colour in enumerate((palette.GREY, palette.SKY, palette.ORANGE, "C0")):
        state, forces = dmp.initial_state(), []
        with torch.no_grad():
            for k in range(steps):
                depth = state.position - 0.3
                pressed = stiffness * depth.clamp(min=0)
                rate = torch.where(depth > 0, stiffness * state.velocity, 0.0)
                push = velocity_coupling(
                    learned[k] + gain * (wanted[k] - pressed),
                    -gain * rate,
                    spring=dmp.spring,
                    duration=state.duration,
                )
                state = dmp.step(state, dt, coupling=push)
                forces.append(pressed)
        axes.plot(t, torch.stack(forces)[:, 0], color=colour, label=f"{repetition + 1}")
        missing = wanted - torch.stack(forces)
        learned = learned + gain * missing  # the feedback becomes feed-forward
    axes.plot(t, wanted[:, 0], color=palette.TARGET, ls="--", label="wanted")
    axes.set(xlabel="time [s]", ylabel="force [N]", title="Pressing on a wall, repeated")
    axes.set_xlim(1.2, 4.0)
    axes.legend(loc="lower right", ncols=2, title="repetition")


def _carry(axes) -> None:
    time, s = demonstrations.stamps(2.0)
    way = demonstrations.rise(s)[:, None] * torch.tensor([0.5, 0.1], dtype=torch.float64)
    start = torch.tensor([[0.0, 0.0], [0.0, 0.3]], dtype=torch.float64)
    bend = torch.sin(torch.pi * s)[:, None] * torch.tensor([0.0, 0.12], dtype=torch.float64)
    apart = torch.stack([start[0] + way - bend, start[1] + way + bend])
    dmp, offset = JointDMP.fit(time, apart, units="m"), start[1] - start[0]

    def change(_now: float, state) -> dict:
        position, velocity = state.position, state.velocity
        error, rate = offset - (position[1] - position[0]), velocity[0] - velocity[1]
        pair = torch.stack([-error, error]), torch.stack([-rate, rate])
        push = velocity_coupling(
            15 * pair[0], 15 * pair[1], spring=dmp.spring, duration=state.duration
        )
        return {"coupling": push}

    path = run(dmp, 2.0, change)
    for arm, colour in enumerate((palette.BLUE, palette.ORANGE)):
        axes.plot(*apart[arm].T, **DEMO)
        axes.plot(*path[:, arm].T, color=colour, label=f"arm {arm + 1}")
    for k in range(0, len(path), 55):
        axes.plot(*path[k].T, color=palette.BLACK, lw=0.7, alpha=0.6)
    plane(axes, "Two arms keep their offset")
