"""Layouts of Rerun's dashboards: viewpoints, shares of the screen, ranges and legends."""

from dataclasses import replace

import numpy as np
import pytest
from sample_runs import sample_run, until

from hrc_learn.viz import palette
from hrc_learn.viz.panels import Plot, Tab, run_tabs, several, single
from hrc_learn.viz.rerun_stream import (
    _cross,
    dashboard,
    frame_view,
    markdown_table,
    plot_view,
    samples,
    tab_view,
    thin,
)
from hrc_learn.viz.run_dashboard import run_layout


def vector(batch):
    return np.array(batch.as_arrow_array().to_pylist()[0])


@pytest.mark.parametrize(
    ("base", "middle", "extent"),
    [(True, (0.5, 1.0, 1.5), np.sqrt(1 + 4 + 9)), (False, (0.75, 1.5, 2.75), np.sqrt(1.5))],
)
def test_a_viewpoint_is_as_far_from_the_middle_as_the_path_is_long(base, middle, extent):
    path = np.array([[1.0, 2.0, 3.0], [0.5, 1.0, 2.5], [0.7, 1.5, 2.6]])
    view = frame_view(path, base=base)
    np.testing.assert_allclose(vector(view.look_target), middle, atol=1e-6)
    away = vector(view.position) - middle
    np.testing.assert_allclose(away, extent * np.array([1.05, 0.65, 0.6]), rtol=1e-5)
    np.testing.assert_allclose(vector(view.eye_up), (0, 0, 1))


def test_a_path_that_is_a_point_is_seen_from_a_distance():
    point = np.full((3, 3), 0.2)
    view = frame_view(point, base=False, direction=(1.0, 0.0, 0.0), nearest=0.7)
    np.testing.assert_allclose(vector(view.position), (0.9, 0.2, 0.2), atol=1e-6)
    usual = frame_view(point, base=False, direction=(0.0, 1.0, 0.0))
    np.testing.assert_allclose(vector(usual.position), (0.2, 0.7, 0.2), atol=1e-6)


CURVES = (single("a/b", "b", np.zeros(3), palette.RUN),)


@pytest.mark.parametrize("span", [None, (1.5, 4.0)])
@pytest.mark.parametrize("range_", [None, (-1.0, 3.0)])
@pytest.mark.parametrize("legend", [True, False])
def test_a_plot_has_its_range_its_legend_and_the_time_of_a_finished_run(span, range_, legend):
    view = plot_view(Plot(title="t", curves=CURVES, range=range_, legend=legend), span)
    assert (view.name, view.contents, view.origin) == ("t", ["/a/b"], "/")
    parts = view.properties
    assert parts["PlotLegend"].visible.as_arrow_array().to_pylist() == [legend]
    assert ("ScalarAxis" in parts) == (range_ is not None)
    if range_ is not None:
        assert parts["ScalarAxis"].range.as_arrow_array().to_pylist() == [list(range_)]
    assert ("TimeAxis" in parts) == (span is not None)
    if span is not None:
        (shown,) = parts["TimeAxis"].view_range.as_arrow_array().to_pylist()
        ends = [shown[end] for end in ("start", "end")]
        assert ends == [round(1e9 * t) for t in span]


def test_a_tab_shows_the_time_in_which_it_has_values():
    time, values = np.arange(6.0), np.full((2, 6), np.nan)
    values[0, 1:3], values[1, 2:5] = 1.0, np.inf
    values[1, 3] = 2.0
    plots = [Plot(title="t", curves=(single("a/b", "b", row, palette.RUN),)) for row in values]

    def shown(plots, time):
        for view in tab_view(Tab(title="tab", plots=tuple(plots)), time).contents:
            axis = view.properties.get("TimeAxis")
            (range_,) = [None] if axis is None else axis.view_range.as_arrow_array().to_pylist()
            yield range_ and [range_[end] for end in ("start", "end")]

    assert list(shown(plots, time)) == [[10**9, 3 * 10**9]] * 2
    absent = Plot(title="t", curves=(single("a/b", "b", 0.0 * time, palette.RUN),))
    assert list(shown([*plots, absent], time)) == [[10**9, 3 * 10**9]] * 3  # 0 is no action
    assert list(shown(plots, None)) == [None] * 2
    assert list(shown(plots[1:], time)) == [None]  # one value spans no time


@pytest.mark.parametrize(("columns", "end"), [(1, 113), (2, 136)])
def test_legends_stand_to_the_right_of_finished_curves(columns, end):
    values = np.ones((101, 2))
    plot = Plot(title="t", curves=(several("a", ("panda_joint1", "b"), values),), legend=True)
    tab = Tab(title="tab", plots=(plot, plot), columns=columns)
    for view in tab_view(tab, np.arange(101.0)).contents:
        (time,) = view.properties["TimeAxis"].view_range.as_arrow_array().to_pylist()
        assert [round(1e-9 * time[side]) for side in ("start", "end")] == [0, end]
        assert view.properties["PlotLegend"].corner.as_arrow_array().to_pylist() == [2]
    for view in tab_view(tab).contents:  # the newest data are at the right
        assert view.properties["PlotLegend"].corner.as_arrow_array().to_pylist() == [1]


@pytest.mark.parametrize(
    ("low", "high", "range_"),
    [
        (0.0, 0.09, (0.0, 0.105)),  # tenths would be too dense to be labelled
        (0.0, 0.9, (0.0, 1.05)),
        (-6.5, 6.5, (-10.5, 10.5)),
        (-0.9, 0.0, (-1.05, 0.0)),
        (0.0, 3.0, None),  # labels at 1, 2, 3
        (40.0, 1330.0, None),  # a label at 1000
        (-2.9, 2.9, None),
        (2.0, 2.0, None),
    ],
)
def test_a_finished_plot_has_another_label_than_zero(low, high, range_):
    values = np.array([low, np.nan, high])
    plot = Plot(title="t", curves=(single("a", "b", values, palette.RUN),))
    tab = Tab(title="tab", plots=(plot,))
    (view,) = tab_view(tab, np.arange(3.0)).contents
    shown = view.properties.get("ScalarAxis")
    if range_ is None:
        assert shown is None
    else:
        np.testing.assert_allclose(shown.range.as_arrow_array().to_pylist()[0], range_)
    (view,) = tab_view(tab).contents
    assert "ScalarAxis" not in view.properties


@pytest.mark.parametrize(
    ("plots", "columns", "grid"), [(1, 3, 1), (3, 3, 3), (5, 2, 2), (0, 2, 1)]
)
def test_a_tab_has_no_more_columns_than_plots(plots, columns, grid):
    plot = Plot(title="t", curves=CURVES)
    view = tab_view(Tab(title="tab", plots=(plot,) * plots, columns=columns))
    assert (view.grid_columns, view.name, len(view.contents)) == (grid, "tab", plots)


@pytest.mark.parametrize(
    ("left", "rows", "columns"),
    [(0, None, (2, 3)), (1, (5,), (1, 2, 3)), (2, (5, 4), (1, 2, 3))],
)
def test_views_stand_left_of_the_columns_with_their_shares(left, rows, columns):
    view = plot_view(Plot(title="t", curves=CURVES))
    made = dashboard([view] * left, [view] * 2, row_shares=(5, 4), column_shares=(1, 2, 3))
    root = made.root_container
    assert root.column_shares == columns
    assert len(root.contents) == 2 + bool(left)
    if left:
        assert root.contents[0].row_shares == rows
        assert len(root.contents[0].contents) == left
    assert made.collapse_panels


@pytest.mark.parametrize("camera", [True, False])
@pytest.mark.parametrize("phases", [True, False])
def test_a_run_has_its_camera_below_the_robot_and_its_phases_below_the_tabs(camera, phases):
    run = sample_run()
    if not camera:
        run = replace(run, camera=None)
    if not phases:
        run = replace(run, phases=())
    left, right = run_layout(run).root_container.contents
    assert len(left.contents) == 1 + camera
    assert tuple(left.row_shares) == (3, 2)[: 1 + camera]
    assert len(right.contents) == 1 + phases
    assert list(right.row_shares) == [5, 1][: 1 + phases]
    assert right.contents[0].active_tab == 0


@pytest.mark.parametrize(("steps", "finished"), [(200, True), (200, False), (1, True)])
def test_only_a_finished_run_has_a_fixed_time(steps, finished):
    run = until(sample_run(), steps)
    _, right = run_layout(run, finished).root_container.contents
    tabs = right.contents[0].contents
    views = [view for tab in tabs for view in tab.contents]
    fixed = {"TimeAxis" in view.properties for view in views}
    assert fixed == {finished and steps > 1}
    if not finished:
        # Plots that are empty yet stay: they will fill.
        assert len(tabs) == len(run_tabs(run))


def test_samples_come_at_the_rate_with_both_ends():
    time = np.linspace(2.0, 4.0, 201)
    for rate, count in ((5.0, 11), (1.0, 3), (0.1, 2), (1000.0, 201)):
        found = samples(time, rate)
        assert (found[0], found[-1]) == (0, 200)
        assert abs(len(found) - count) <= 1
        gaps = np.diff(time[found])[:-1]
        if rate <= 5.0:
            np.testing.assert_allclose(gaps, 1 / rate, atol=0.011)
    assert samples(time[:1], 5.0).tolist() == [0]


@pytest.mark.parametrize("count", [1, 2, 300, 5000])
def test_a_thinned_path_has_few_points_in_order(count):
    path = np.arange(2.0 * count).reshape(count, 2)
    made = thin(path)
    assert len(made) <= 500
    assert len(made) == count or len(made) > 100
    assert (made[0] == path[0]).all()
    assert (made[-1] == path[-1]).all()
    assert (np.diff(made[:, 0]) > 0).all()


def test_a_cross_has_strokes_of_120_pixels():
    across, down = _cross(np.array([100.0, 200.0]))
    np.testing.assert_array_equal(across, [[40.0, 200.0], [160.0, 200.0]])
    np.testing.assert_array_equal(down, [[100.0, 140.0], [100.0, 260.0]])
    assert _cross(np.array([np.nan, 1.0])) == []


def test_a_table_is_written_in_markdown():
    lines = markdown_table(["a", "b"], [(1, "x"), (2.5, "y")])
    assert lines == ["| a | b |", "| --- | --- |", "| 1 | x |", "| 2.5 | y |"]


@pytest.mark.parametrize("light", [True, False])
def test_curves_repeat_the_colours_of_the_palette(light):
    count = len(palette.SERIES_ON_DARK) + 2
    names = [f"n{k}" for k in range(count)]
    made = several("p", names, np.zeros((4, count)), light=light, width=2.5)
    assert made.names == tuple(names)
    assert made.colours[0] == made.colours[-2] != made.colours[-1]
    first = palette.SERIES_ON_DARK[0]
    assert made.colours[0] == (palette.lighten(first) if light else palette.rgba(first))
    assert made.width == 2.5
