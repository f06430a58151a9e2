"""Bases, and what gradient training makes of them and of a motion."""

import torch
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from hrc_learn.dmp import GaussianBasis, JointDMP, LearnedGaussianBasis, SplineBasis
from hrc_learn.dmp.training import (
    Clearance,
    DescentConfig,
    Jerk,
    Sphere,
    Tracking,
    learn_basis,
    train,
)
from hrc_learn.kinematics import panda
from hrc_learn.viz import palette

from . import demonstrations
from .drawing import DEMO, ends, panels, plane


def bases(figure: Figure) -> None:
    """Ten functions each: everywhere, with local support, and where one wants them."""
    s = torch.linspace(0, 1.25, 700, dtype=torch.float64)
    uneven = torch.tensor([0.0, 0.2, 0.4, 0.5, 0.55, 0.6, 0.65, 0.75, 0.87, 1.0])
    gaps = uneven.diff(append=torch.tensor([1.13]))
    centres, widths = tuple(uneven.tolist()), tuple((0.6 * gaps).tolist())
    placed = LearnedGaussianBasis(centres=centres, widths=widths)
    for axes, basis in zip(
        panels(figure, 3, sharey=True),
        (GaussianBasis(count=10), SplineBasis(count=10), placed),
        strict=True,
    ):
        shares = basis.forcing(s) / basis.phase(s)[:, None]
        axes.plot(s, shares)
        axes.axvline(1.0, color=palette.GREY, lw=0.8, ls=":")
        axes.set(xlabel="s = t / duration", title=type(basis).__name__)
    figure.axes[0].set_ylabel("share of the forcing term")


def learned_basis(figure: Figure) -> None:
    """Centres and widths that found a sharp event, against equally spaced ones."""
    time, position = demonstrations.knock()
    uniform = JointDMP.fit(time, position, 14)
    result = learn_basis(time, position, 14, config=DescentConfig(steps=200))
    where, close, how = panels(figure, 3, width_ratios=[1.2, 1, 1])
    for axes in (where, close):
        axes.plot(time, position, **DEMO)
        for dmp, colour, label in (
            (uniform, palette.VERMILION, "equally spaced"),
            (result.dmp, palette.BLUE, "learned"),
        ):
            axes.plot(time, dmp.rollout().position.detach(), color=colour, label=label)
        axes.set_xlabel("time [s]")
    for dmp, colour, level in ((uniform, palette.VERMILION, -0.07), (result.dmp, "C0", -0.13)):
        centres = 2 * dmp.basis.centre_times()
        where.plot(centres, torch.full_like(centres, level), "|", color=colour, ms=7, mew=1.4)
    where.set(ylabel="joint [rad]", title="Motion and centres, N = 14")
    close.set(xlim=(1.0, 1.4), ylim=(0.45, 0.75), title="The knock")
    where.legend(loc="upper left")
    how.semilogy(result.history.criterion, color=palette.BLUE)
    how.axhline(result.history.criterion[0], color=palette.VERMILION, lw=1)
    how.set(xlabel="step", ylabel="held-out error / range", title="Training")


def obstacle_training(figure: Figure) -> None:
    """A stroke trained to clear two balls, its ends as they were."""
    time, position = demonstrations.stroke()
    dmp = JointDMP.fit(time, torch.nn.functional.pad(position, (0, 1)))
    balls = [
        Sphere(centre=(0.1, 0.13, 0.0), radius=0.04),
        Sphere(centre=(0.29, 0.21, 0.0), radius=0.05),
    ]
    path = dmp.rollout().position.detach()
    loss = Clearance(balls, margin=0.025) + 1e-2 * Tracking(path) + 1e-8 * Jerk()
    result = train(dmp, loss, DescentConfig(steps=250, learning_rate=0.1))
    trained = result.dmp.rollout().position.detach()
    axes, down = panels(figure, 2, width_ratios=[1.4, 1])
    for ball in balls:
        axes.add_patch(
            Circle(ball.centre[:2], ball.radius, color=palette.LIMIT, alpha=0.35, lw=0)
        )
    axes.plot(*path.T[:2], label="demonstrated", **DEMO)
    axes.plot(*trained.T[:2], color=palette.RUN, label="trained")
    ends(axes, trained[0, :2], trained[-1, :2], palette.RUN)
    plane(axes, "Two balls cleared by 25 mm")
    axes.legend(loc="lower right")
    down.semilogy(result.history.loss, color=palette.RUN)
    down.set(xlabel="step", ylabel="loss", title="Training")


def tool_training(figure: Figure) -> None:
    """Joints of a Panda trained until its tool moves on a straight line."""
    time, s = demonstrations.stamps(3.0, 60)
    home = torch.tensor([0, -0.3, 0, -2.2, 0, 2.0, 0.8], dtype=torch.float64)
    way = torch.tensor([1.0, 0.3, -0.2, 0.2, 0.1, 0.2, 0.0], dtype=torch.float64)
    q = home + demonstrations.rise(s)[:, None] * way

    def tool(joints: torch.Tensor) -> torch.Tensor:
        return panda.forward(joints).position

    start, goal = tool(q[0]), tool(q[-1])
    line = start + demonstrations.rise(s)[:, None] * (goal - start)
    dmp = JointDMP.fit(time, q, 20)
    loss = Tracking(line, task=tool) + 1e-8 * Jerk()
    trained = train(dmp, loss, DescentConfig(steps=200, learning_rate=0.1)).dmp
    above, off = panels(figure, 2)
    for each, colour, label in (
        (dmp, palette.VERMILION, "joints from A to B"),
        (trained, palette.BLUE, "trained"),
    ):
        path = tool(each.rollout().position).detach()
        above.plot(*path.T[:2], color=colour, label=label)
        off.semilogy(time, 1e3 * (path - line).norm(dim=-1), color=colour)
    above.plot(*line.T[:2], color=palette.TARGET, ls="--", lw=2, label="wanted")
    ends(above, start[:2], goal[:2], palette.TARGET)
    plane(above, "Path of the tool from above")
    above.legend(loc="best")
    off.set(
        xlabel="time [s]",
        ylabel="distance [mm]",
        title="From the wanted line",
        ylim=(1e-3, 2e2),
    )
