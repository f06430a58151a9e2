"""Figures of placing, from motions whose shape is known."""

from io import BytesIO

import numpy as np
import pytest
from PIL import Image

from hrc_learn.experiments import placing_figures as draw
from hrc_learn.geometry import Box
from hrc_learn.log import JointRanges

SHELVES = ("lower", "middle", "upper")
BOX = Box(name="board", centre=(0.4, -0.6, 0.2), half_size=(0.3, 0.15, 0.01))
LIMITS = JointRanges(lower=np.full(7, -2.0), upper=np.full(7, 2.0))


def motion(height=0.4, duration=10.0, tremor=0.0, samples=400):
    share = np.linspace(0, 1, samples)
    s = share**3 * (10 - 15 * share + 6 * share**2)
    path = np.stack([0.6 - 0.2 * s, -0.6 * s, 0.3 + (height - 0.3) * s], axis=1)
    path[:, 0] += tremor * np.sin(2 * np.pi * 80 * share)
    joints = np.outer(s, np.linspace(-1, 1, 7)) + height
    return draw.Motion(time=duration * share, joint_position=joints, path=path)


def by_shelf():
    return {shelf: motion(0.2 + 0.2 * k) for k, shelf in enumerate(SHELVES)}


def pixels(figure):
    buffer = BytesIO()
    figure.savefig(buffer, format="png", dpi=50)
    return np.asarray(Image.open(buffer).convert("L"))


def labelled(axes):
    return {line.get_label(): np.asarray(line.get_ydata(), float) for line in axes.get_lines()}


def test_paths_have_a_panel_for_each_space_of_planning():
    figure = draw.shelf_paths_figure(
        motion(duration=15), {"joint space": by_shelf(), "task space": by_shelf()}, (BOX,)
    )
    assert [axes.get_title(loc="left") for axes in figure.axes] == ["Joint space", "Task space"]
    names = {line.get_label() for line in figure.axes[0].get_lines()}
    assert {"demonstration", "lower shelf", "middle shelf", "upper shelf"} <= names
    assert pixels(figure).std() > 5


def test_each_joint_shows_the_demonstration_and_every_shelf():
    names = [f"j{i}" for i in range(7)]
    figure = draw.shelf_joints_figure(names, motion(duration=15), by_shelf(), LIMITS)
    for i, axes in enumerate(figure.axes[:7]):
        lines = labelled(axes)
        np.testing.assert_array_equal(
            lines["upper shelf"], by_shelf()["upper"].joint_position[:, i]
        )
        assert "demonstration" in lines
        low, high = axes.get_ylim()
        assert low <= lines["lower shelf"].min()
        assert lines["upper shelf"].max() <= high
    assert figure.axes[0].get_xlim()[1] == pytest.approx(15.0)


def test_deviations_are_in_millimetres_below_or_above_the_bound():
    approach = draw.ApproachDistance(
        remaining=np.linspace(0.13, 0, 50), distance=np.full(50, 0.06)
    )
    figure = draw.approach_figure({"joint space": dict.fromkeys(SHELVES, approach)}, 0.012)
    lines = labelled(figure.axes[0])
    np.testing.assert_allclose(lines["upper shelf"], 60.0)
    np.testing.assert_allclose(lines["bound"], 12.0)


def test_a_tremor_shows_in_the_jerk_and_speed_or_size_do_not():
    steady = motion()
    figure = draw.smoothness_figure(motion(tremor=1e-3), steady)
    jerk = labelled(figure.axes[1])
    assert np.median(jerk["demonstration"]) > 20 * np.median(jerk["reproduction"])
    slow_and_large = draw.Motion(
        time=7 * steady.time, joint_position=steady.joint_position, path=3 * steady.path
    )
    again = labelled(draw.smoothness_figure(slow_and_large, steady).axes[1])
    np.testing.assert_allclose(again["demonstration"], again["reproduction"], rtol=1e-4)


def test_every_trial_is_a_dot():
    values = {"place error [mm]": {shelf: np.linspace(0.1, 1, 50) for shelf in SHELVES}}
    (axes,) = draw.trials_figure(values, {"place error [mm]": 2.0}).axes
    *dots, bound = axes.get_lines()
    assert [np.size(line.get_xdata()) for line in dots] == [50, 50, 50]
    assert all(np.ptp(line.get_xdata()) < 0.5 for line in dots)
    assert np.all(np.equal(bound.get_ydata(), 2.0))
