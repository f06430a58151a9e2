from io import BytesIO

import numpy as np
import pytest
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from PIL import Image
from sample_runs import NAMES, STEPS, sample_run

from hrc_learn.geometry import Box
from hrc_learn.viz import figures, palette
from hrc_learn.viz.figures import active_intervals, draw_limits, frame_space, space
from hrc_learn.viz.panels import image_jacobian_plots, person_plots


def person_figure(run, **options):
    return figures.plots_figure(run.time, person_plots(run), **options)


def jacobian_figure(run):
    return figures.plots_figure(run.time, image_jacobian_plots(run), columns=2)


FIGURES = [figures.joints_figure, person_figure, jacobian_figure]


def lines(axes) -> dict[str, np.ndarray]:
    return {line.get_label(): np.asarray(line.get_ydata(), float) for line in axes.get_lines()}


@pytest.mark.parametrize("draw", FIGURES)
def test_figures_are_drawn_with_units(draw):
    figure = draw(sample_run())
    buffer = BytesIO()
    figure.savefig(buffer, format="png", dpi=60)
    assert np.asarray(Image.open(buffer).convert("L")).std() > 10
    drawn = [axes for axes in figure.axes if axes.axison]
    assert all(axes.get_ylabel() or axes.get_title(loc="left") for axes in drawn)
    assert any("[s]" in text for text in _words(figure))


def _words(figure) -> list[str]:
    return [figure.get_supxlabel(), *(axes.get_xlabel() for axes in figure.axes)]


def test_joints_figure_shows_every_joint_with_its_limits():
    run = sample_run()
    axes = [a for a in figures.joints_figure(run).axes if a.axison]
    assert [a.get_title(loc="left") for a in axes] == [f"{name} [rad]" for name in NAMES]
    legends = [a.get_legend() for a in axes]
    assert [text.get_text() for text in legends[0].get_texts()] == ["demonstration", "run"]
    assert legends[1:] == [None] * (len(NAMES) - 1)
    for i, a in enumerate(axes):
        shown = lines(a)
        np.testing.assert_array_equal(shown["run"], run.joint_position[:, i])
        np.testing.assert_array_equal(shown["demonstration"], run.demo_joint_position[:, i])
        low, high = a.get_ylim()
        motions = [shown["run"], shown["demonstration"]]
        assert low < np.min(motions)
        assert high > np.max(motions)
        # Far from them, so that the motion fills the picture.
        assert a.get_title(loc="right") == "limits -2.90, 2.90"


def test_limits_are_drawn_within_the_panel_that_the_motion_fills():
    axes = Figure().subplots()
    axes.plot([0, 1, 2], [-1.0, 0.0, 1.0])
    draw_limits(axes, -1.05, 6.0)
    assert axes.get_ylim() == (-1.3, 1.3)
    assert [line.get_ydata()[0] for line in axes.get_lines()[1:]] == [-1.05, 6.0]
    assert axes.get_title(loc="right") == "limits -1.05, 6.00"


def test_shaded_intervals_and_curves_of_a_dashboard_are_drawn():
    run = sample_run()
    acting = run.nullspace_input.any(axis=1)
    plots = person_plots(run)
    figure = figures.plots_figure(run.time, plots, shaded=acting)
    for axes, plot in zip(figure.axes, plots, strict=True):
        assert axes.get_title(loc="left") == plot.title
        (curves,) = plot.curves
        drawn = [line.get_ydata() for line in axes.get_lines()]
        np.testing.assert_array_equal(np.transpose(drawn), curves.values)
        (span,) = axes.patches
        assert span.get_x() == pytest.approx(run.time[80])
        assert span.get_x() + span.get_width() == pytest.approx(run.time[119])
        assert (axes.get_legend() is not None) == (plot.legend and not plot.rows)
    assert figure.axes[1].get_ylim() == plots[1].range


def test_the_time_axis_can_be_limited_to_what_is_known():
    run = sample_run()
    acting = run.nullspace_input.any(axis=1)
    for shown in (None, np.zeros(STEPS, bool)):
        whole = person_figure(run, shown=shown).axes[-1].get_xlim()
        assert whole == (run.time[0], run.time[-1])
    spell = person_figure(run, shown=acting).axes[-1].get_xlim()
    assert spell == (run.time[80], run.time[119])


def test_jacobian_figure_shows_twelve_estimates_and_twelve_truths():
    run = sample_run()
    axes = jacobian_figure(run).axes
    assert [len(a.get_lines()) for a in axes] == [6, 6, 6, 6, 1, 0]
    assert [a.axison for a in axes] == [True] * 5 + [False]
    np.testing.assert_array_equal(lines(axes[3])["∂v/∂ωz"], run.image_jacobian[:, 1, 5])
    # One entry of the legend for the three true curves, which are pale.
    texts = [text.get_text() for text in axes[0].get_legend().get_texts()]
    assert texts == ["true", "∂u/∂vx", "∂u/∂vy", "∂u/∂vz"]
    pale, thin = (np.array(axes[0].get_lines()[k].get_color()) for k in (0, 3))
    assert thin == pytest.approx(to_rgba(palette.BLUE))
    assert (pale[:3] > thin[:3]).all()


def test_active_intervals_are_runs_of_true_samples():
    active = np.zeros(STEPS, dtype=bool)
    active[[0, 1, 5, 198, 199]] = True
    assert active_intervals(active) == [(0, 1), (5, 5), (198, 199)]
    assert active_intervals(np.zeros(4, dtype=bool)) == []


def test_boxes_are_cut_to_the_surroundings_of_the_paths():
    tall = Box(centre=(0.0, 0.0, 0.0), half_size=(0.1, 0.1, 5.0))
    far = Box(centre=(9.0, 0.0, 0.0), half_size=(0.1, 0.1, 0.1))
    axes = space(Figure())
    frame_space(axes, np.zeros((1, 3)), (tall, far))
    (edges,) = axes.collections
    corners = np.array(edges._segments3d)
    np.testing.assert_allclose(corners.min(axis=(0, 1)), [-0.1, -0.1, -0.22])
    np.testing.assert_allclose(corners.max(axis=(0, 1)), [0.1, 0.1, 0.22])


def test_reasons_stand_beside_their_rows_in_place_of_numbers():
    run = sample_run()
    figure = person_figure(run)
    (axes,) = (axes for axes in figure.axes if axes.get_title("left").startswith("Reasons"))
    named = {
        text.get_text(): height
        for height, text in zip(axes.get_yticks(), axes.get_yticklabels(), strict=True)
    }
    assert list(named) == [name.replace("_", " ") for name in run.hindered]
    assert axes.get_legend() is None
    for line in axes.get_lines():
        heights = line.get_ydata()
        name = line.get_label().split(" ", 1)[1]  # without its number
        assert set(heights[np.isfinite(heights)]) <= {named[name]}
