"""Primitives of joints and positions."""

import numpy as np
import torch
from matplotlib.figure import Figure

from hrc_learn.dmp import (
    GaussianBasis,
    JointDMP,
    MovingGoalDMP,
    ProbabilisticDMP,
    SplineBasis,
    fit_rhythmic,
    learn,
)
from hrc_learn.viz import palette

from . import demonstrations
from .drawing import DEMO, ends, panels, plane


def joint(figure: Figure) -> None:
    """Reproduction, and new goals."""
    time, position = demonstrations.joints()
    dmp = JointDMP.fit(time, position)
    motion = dmp.rollout()
    left, right = panels(figure, 2)
    left.plot(time, position, **DEMO)
    for j, colour in enumerate((palette.BLUE, palette.VERMILION)):
        left.plot(motion.time, motion.position[:, j], color=colour, label=f"joint {j + 1}")
    left.plot([], [], label="demonstration", **DEMO)
    left.legend(loc="lower left")
    for offset in (-0.4, -0.2, 0.0, 0.2, 0.4):
        new = dmp.rollout(
            time=torch.linspace(0, 2.6, 200), goal=dmp.goal + torch.tensor([offset, 0.0])
        )
        right.plot(
            new.time, new.position[:, 0].detach(), color=palette.BLUE, alpha=0.9 - abs(offset)
        )
        right.plot(2.0, dmp.goal[0] + offset, "s", color=palette.TARGET, ms=4.5)
    left.set(xlabel="time [s]", ylabel="joint [rad]", title="Reproduced", ylim=(-0.6, None))
    right.set(xlabel="time [s]", ylabel="joint 1 [rad]", title="Sent to other goals")


def scalings(figure: Figure) -> None:
    """One stroke, three goals, four scalings of the forcing term."""
    time, position = demonstrations.stroke()
    goals = position[-1] + torch.tensor([[0.0, 0.0], [0.1, 0.1], [0.0, -0.25]])
    for axes, name in zip(
        panels(figure, 4),
        ("none", "amplitude", "paper", "rotation"),
        strict=True,
    ):
        dmp = JointDMP.fit(time, position, scaling=name)
        axes.plot(*position.T, **DEMO)
        for goal, colour in zip(
            goals, (palette.BLUE, palette.ORANGE, palette.VERMILION), strict=True
        ):
            path = dmp.rollout(goal=goal).position.detach()
            axes.plot(*path.T, color=colour)
            ends(axes, path[0], goal, colour)
        plane(axes, f'"{name}"')
        axes.set(xlim=(-0.08, 0.58), ylim=(-0.4, 0.5), adjustable="box")
        axes.set_ylabel("y [m]" if name == "none" else "")


def approach(figure: Figure) -> None:
    """A new goal taken up at once, as printed, and along a minimum-jerk curve."""
    time, position = demonstrations.joints()
    goal = position[-1] + 0.8
    where, how = panels(figure, 2)
    where.plot(time, position[:, 0], **DEMO)
    for share, colour in ((0.0, palette.VERMILION), (0.6, palette.ORANGE), (1.0, palette.BLUE)):
        motion = JointDMP.fit(time, position, approach=share).rollout(goal=goal)
        label = f"approach={share:g}"
        where.plot(motion.time, motion.position[:, 0], color=colour, label=label)
        how.plot(motion.time, motion.acceleration[:, 0], color=colour, label=label)
    where.plot(2.0, goal[0], "s", color=palette.TARGET, ms=5)
    where.set(xlabel="time [s]", ylabel="joint 1 [rad]", title="Joint, sent 0.8 rad farther")
    how.set(xlabel="time [s]", ylabel="acceleration [rad/s²]", title="Its acceleration")
    how.legend(loc="upper right")


def rhythm(figure: Figure) -> None:
    """A rhythm, then wider, then twice as fast."""
    t = torch.linspace(0, 3, 600, dtype=torch.float64)
    angle = 2 * torch.pi * t
    wave = 0.3 * torch.sin(angle) + 0.12 * torch.sin(2 * angle + 0.7)
    dmp = fit_rhythmic(t, wave[:, None], period=1.0)
    state, dt, path = dmp.initial_state(), 0.005, []
    with torch.no_grad():
        for k in range(1800):
            now = k * dt
            gain = 1.6 if now > 3 else 1.0
            state = dmp.step(state, dt * (2 if now > 6 else 1), forcing_gain=gain)
            path.append((now, state.position[0].item()))
    axes = figure.subplots()
    axes.plot(t, wave, **DEMO)
    axes.plot(*np.array(path).T, color=palette.RUN)
    top = axes.get_ylim()[1] + 0.14
    for begin, text in ((0, "as shown"), (3, "forcing_gain=1.6"), (6, "twice as fast")):
        axes.axvline(begin, color=palette.GREY, lw=0.8, ls=":")
        axes.text(begin + 0.08, top - 0.1, text)
    axes.set(xlabel="time [s]", ylabel="joint [rad]", ylim=(None, top), xlim=(0, 9))
    axes.set_title("One demonstration of three cycles, modulated while it runs")


def distribution(figure: Figure) -> None:
    """Several demonstrations, and what they say once a via point is known."""
    rng = torch.Generator().manual_seed(2)
    time, s = demonstrations.stamps(2.0, 120)

    def random(scale: float) -> torch.Tensor:
        return scale * torch.randn(12, 1, generator=rng, dtype=torch.float64)

    demos = demonstrations.rise(s) + random(0.12) * torch.sin(torch.pi * s)
    demos = demos + random(0.06) * torch.sin(2 * torch.pi * s) + random(0.05) * s
    known = ProbabilisticDMP.fit(JointDMP.fit(time.expand(12, -1), demos[..., None], 20))
    via = (1.0, 0.85)
    given = known.condition([via[0]], [[via[1]]], noise=0.005)
    for axes, belief, colour, title in zip(
        panels(figure, 2, sharey=True),
        (known, given),
        (palette.GREEN, palette.BLUE),
        ("Learned from twelve demonstrations", "Given one via point"),
        strict=True,
    ):
        mean, deviation = (x[:, 0].numpy() for x in belief.position(time))
        if belief is known:
            lines = axes.plot(time, demos.T, color=palette.DEMO, lw=0.8, alpha=0.8)
            lines[0].set_label("demonstrations")
        else:
            samples = belief.sample(8, rng).rollout(time=time).position[..., 0].detach()
            lines = axes.plot(time, samples.T, color=colour, lw=0.7, alpha=0.6)
            lines[0].set_label("samples")
            axes.plot(*via, "*", color=palette.LIMIT, ms=12, zorder=6)
        low, high = mean - 2 * deviation, mean + 2 * deviation
        spread = {"alpha": 0.2, "lw": 0, "label": "± 2 std. dev."}
        axes.fill_between(time, low, high, color=colour, **spread)
        axes.plot(time, mean, color=colour, lw=2, label="mean")
        axes.set(xlabel="time [s]", title=title)
        axes.legend(loc="lower right")
    figure.axes[0].set_ylabel("joint [rad]")


def via_points(figure: Figure) -> None:
    """Through given points exactly, all along or within a window."""
    time, position = demonstrations.stroke()
    dmp = JointDMP.fit(time, position)
    at, points = [0.8, 1.2], torch.tensor([[0.1, 0.2], [0.3, 0.05]], dtype=torch.float64)
    one = torch.tensor([[0.2, 0.28]], dtype=torch.float64)
    left, right = panels(figure, 2, sharey=True)
    for axes, changed, marks, title in (
        (left, dmp.condition(at, points), points, "Through two points"),
        (
            right,
            dmp.condition([1.0], one, within=(0.6, 1.5)),
            one,
            "Changed from 0.6 to 1.5 s only",
        ),
    ):
        path = changed.rollout().position.detach()
        axes.plot(*position.T, **DEMO)
        axes.plot(*path.T, color=palette.RUN)
        axes.plot(*marks.T, "*", color=palette.LIMIT, ms=12, zorder=6)
        ends(axes, path[0], path[-1], palette.RUN)
        plane(axes, title)
    left.set_ylim(top=0.31)  # the stars whole


def context(figure: Figure) -> None:
    """Learned at five heights of a shelf, asked for heights in between."""
    time, s = demonstrations.stamps(2.0, 120)
    heights = torch.linspace(0.1, 0.5, 5, dtype=torch.float64)[:, None]

    def reach(h: torch.Tensor) -> torch.Tensor:
        lift = h * demonstrations.rise(1.4 * s) + 0.08 * torch.sin(torch.pi * s) ** 2
        return torch.stack([(0.4 * demonstrations.rise(s)).expand_as(lift), lift], -1)

    model = learn([(time, path) for path in reach(heights)], context=heights)
    where, when = panels(figure, 2)
    when.plot([], [], label="demonstrated", **DEMO)
    for path in reach(heights):
        where.plot(*path.T, **DEMO)
        when.plot(time, path[:, 1], **DEMO)
    for k, h in enumerate((0.15, 0.25, 0.35, 0.45)):
        motion = model.at(context=[h]).rollout()
        path = motion.position.detach()
        where.plot(*path.T, color=palette.RUN)
        where.plot(0.4, path[-1, 1], "s", color=palette.RUN, ms=4.5)
        label = None if k else "predicted, in between"
        when.plot(motion.time.detach(), path[:, 1], color=palette.RUN, label=label)
    plane(where, "One primitive for every height of a shelf")
    when.set(xlabel="time [s]", ylabel="y [m]", title="Height over time", ylim=(None, 0.75))
    when.legend(loc="upper left", ncols=2)


def moving_goal(figure: Figure) -> None:
    """One motion that passes its goal at three velocities."""
    time, position = demonstrations.joints()
    moving = MovingGoalDMP(JointDMP.fit(time, position[:, :1]))
    where, fast = panels(figure, 2)
    where.plot(time, position[:, 0], **DEMO)
    fast.plot(time, position[:, 0].diff(prepend=position[:1, 0]) / time[1], **DEMO)
    for v, colour in ((0.0, palette.BLUE), (0.5, palette.ORANGE), (1.0, palette.VERMILION)):
        motion = moving.rollout(torch.linspace(0, 2.0, 200), end_velocity=[v])
        where.plot(motion.time, motion.position[:, 0], color=colour)
        fast.plot(motion.time, motion.velocity[:, 0], color=colour, label=f"{v:g} rad/s")
        fast.plot(2.0, v, "s", color=colour, ms=4.5)
    where.plot(2.0, position[-1, 0], "s", color=palette.TARGET, ms=5)
    where.set(xlabel="time [s]", ylabel="joint [rad]", title="The goal is met at the end ...")
    fast.set(xlabel="time [s]", ylabel="velocity [rad/s]", title="... at a given velocity")
    fast.legend(loc="lower right")


def bases(figure: Figure) -> None:
    """Ten basis functions each: Gaussians, which act everywhere, and splines."""
    s = torch.linspace(0, 1.25, 700, dtype=torch.float64)
    for axes, basis in zip(
        panels(figure, 2, sharey=True),
        (GaussianBasis(count=10), SplineBasis(count=10)),
        strict=True,
    ):
        axes.plot(s, basis.forcing(s) / basis.phase(s)[:, None])
        axes.axvline(1.0, color=palette.GREY, lw=0.8, ls=":")
        axes.set(xlabel="s = t / duration", title=type(basis).__name__)
    figure.axes[0].set_ylabel("forcing term per weight")
