"""Places and sizes of what figures and films draw."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image
from sample_runs import sample_run

from hrc_learn.geometry import Box
from hrc_learn.geometry.shapes import Line
from hrc_learn.vision import CameraModel
from hrc_learn.viz import palette
from hrc_learn.viz.figures import (
    JointCurves,
    draw_limits,
    frame_space,
    joint_grid_figure,
    plots_figure,
    space,
    stack_panels,
)
from hrc_learn.viz.film import annotated, camera_inset, draw_run
from hrc_learn.viz.panels import Plot, single

# Stand-ins are not of the annotated types.
pytestmark = pytest.mark.simulation

TIME = np.linspace(0, 1, 11)
POINTS = np.array([[0.1, 0.2, 0.3], [0.5, 0.0, 0.4]])


def test_space_shows_22_centimetres_about_its_points_at_one_scale():
    figure = Figure()
    axes = space(figure, (2, 3, 4))
    assert axes.get_subplotspec().get_geometry()[:3] == (2, 3, 3)
    assert (axes.elev, axes.azim) == (24, 35)
    labels = (axes.get_xlabel(), axes.get_ylabel(), axes.get_zlabel())
    assert labels == ("x [m]", "y [m]", "z [m]")
    frame_space(axes, POINTS)
    limits = np.array([axes.get_xlim3d(), axes.get_ylim3d(), axes.get_zlim3d()])
    low, high = POINTS.min(axis=0) - 0.22, POINTS.max(axis=0) + 0.22
    np.testing.assert_allclose(limits, np.stack([low, high], axis=1))
    box = axes._box_aspect
    np.testing.assert_allclose(box / box[0], (high - low) / (high - low)[0])


def test_boxes_are_cut_at_the_surroundings_and_left_out_beyond():
    inside = Box(centre=(0.3, 0.1, 0.35), half_size=(0.1, 0.1, 0.05), colour=(1, 0, 0, 1))
    large = Box(centre=(0.3, 0.1, -1.0), half_size=(5.0, 0.05, 1.2), colour=(0, 1, 0, 1))
    low, high = POINTS.min(axis=0) - 0.22, POINTS.max(axis=0) + 0.22
    touching = Box(centre=(high[0] + 0.1, 0.1, 0.3), half_size=(0.1, 0.1, 0.1))
    beyond = Box(centre=(0.3, 2.0, 0.3), half_size=(0.1, 0.1, 0.1))
    axes = space(Figure())
    frame_space(axes, POINTS, (inside, large, touching, beyond))
    small, cut = (np.array(edges._segments3d) for edges in axes.collections)
    assert small.shape == cut.shape == (12, 2, 3)
    corners = np.abs(small.reshape(-1, 3) - inside.centre)
    np.testing.assert_allclose(corners, np.broadcast_to(inside.half_size, (24, 3)))
    np.testing.assert_allclose(cut.min(axis=(0, 1)), [low[0], 0.05, low[2]])
    np.testing.assert_allclose(cut.max(axis=(0, 1)), [high[0], 0.15, 0.2])


@pytest.mark.parametrize(("spread", "around"), [(0.2, 0.25), (1.0, 0.25), (4.0, 0.6)])
def test_a_joint_that_hardly_moves_has_a_quarter_of_a_radian_about_it(spread, around):
    axes = Figure().subplots()
    axes.plot([0, 1], [1.0, 1.0 + spread])
    draw_limits(axes, -9.0, 9.0)
    np.testing.assert_allclose(axes.get_ylim(), (1 - around, 1 + spread + around))


def plot(title="a", legend=False, **more):
    curves = tuple(
        single(name, name, values, palette.BLUE, 2.0)
        for name, values in {"up": TIME, "down": -TIME, "up again": TIME}.items()
    )
    return Plot(title=title, curves=curves, legend=legend, **more)


@pytest.mark.parametrize(
    ("count", "columns", "rows", "hidden"), [(3, 1, 3, 0), (3, 2, 2, 1), (4, 2, 2, 0)]
)
def test_a_figure_has_a_row_for_each_columns_plots(count, columns, rows, hidden):
    figure = plots_figure(TIME, [plot()] * count, columns=columns)
    np.testing.assert_allclose(figure.get_size_inches(), (7.2, 0.6 + 1.6 * rows))
    assert len(figure.axes) == rows * columns
    assert sum(not axes.axison for axes in figure.axes) == hidden
    sizes = {axes._left_title.get_fontsize() for axes in figure.axes[:count]}
    assert sizes == {10 if columns == 1 else 8}
    assert figure.get_supxlabel() == "time [s]"
    assert figure._supxlabel.get_fontsize() == 9
    line = figure.axes[0].get_lines()[0]
    assert line.get_linewidth() == pytest.approx(1.6)
    assert figure.axes[0].margins()[0] == 0


@pytest.mark.parametrize("columns", [1, 2])
def test_a_legend_covers_no_curve(columns):
    figure = plots_figure(TIME, [plot(legend=True), plot()], columns=columns)
    figure.draw_without_rendering()
    legend = figure.axes[0].get_legend()
    axes, box = figure.axes[0].get_window_extent(), legend.get_window_extent()
    assert (box.x0 >= axes.x1 - 1) == (columns == 1)
    middle = (box.y0 + box.y1) / 2
    if columns == 1:
        assert middle == pytest.approx((axes.y0 + axes.y1) / 2, abs=2)
    else:
        assert box.y1 < axes.y0 + 1
    assert legend._ncols == (1 if columns == 1 else 4)
    assert figure.axes[1].get_legend() is None


def test_equal_names_are_one_entry_of_the_legend():
    twice = tuple(single("", "same", k * TIME, palette.BLUE) for k in (1, 2))
    other = single("", "other", TIME, palette.GREEN)
    figure = plots_figure(TIME, [Plot(title="a", curves=(*twice, other), legend=True)])
    texts = [text.get_text() for text in figure.axes[0].get_legend().get_texts()]
    assert texts == ["same", "other"]


def test_curves_may_have_a_time_of_their_own():
    later = TIME + 5
    motions = [
        JointCurves("a", TIME, np.stack([TIME, -TIME], axis=1)),
        JointCurves("b", later, np.stack([TIME, -TIME], axis=1), palette.GREEN, 3.0),
    ]
    limits: Any = SimpleNamespace(lower=(-1.0, -2.0), upper=(1.5, 2.5))
    figure = joint_grid_figure(["one", "two"], motions, limits, "m")
    for axes, name, ends in zip(
        figure.axes, ("one", "two"), ((-1, 1.5), (-2, 2.5)), strict=True
    ):
        a, b = axes.get_lines()[:2]
        np.testing.assert_array_equal(a.get_xdata(), TIME)
        np.testing.assert_array_equal(b.get_xdata(), later)
        assert axes.get_title("left") == f"{name} [m]"
        assert [line.get_ydata()[0] for line in axes.get_lines()[2:]] == list(ends)
    assert [axes.get_legend() is not None for axes in figure.axes] == [True, False]


def test_panels_of_a_phone_stand_above_one_another_at_their_height():
    figure = plots_figure(TIME, [plot("words " * 20, legend=True), plot("b")] * 2, columns=2)
    figure.set_layout_engine("none")
    figure.draw_without_rendering()
    height = figure.get_size_inches()[1]
    before = [axes.get_position().height * height for axes in figure.axes]
    stack_panels(figure)
    np.testing.assert_allclose(figure.get_size_inches(), (3.7, sum(before) + 0.65 * 4 + 0.3))
    places = [axes.get_subplotspec() for axes in figure.axes]
    assert [place.get_geometry()[2] for place in places] == [0, 1, 2, 3]
    np.testing.assert_allclose(places[0].get_gridspec().get_height_ratios(), before)
    title = figure.axes[0].get_title("left").splitlines()
    assert max(map(len, title)) <= 50 < max(map(len, title)) + 6
    legend = figure.axes[0].get_legend()
    assert [text.get_text() for text in legend.get_texts()] == ["up", "down", "up again"]
    assert (legend._ncols, legend._fontsize) == (2, 8)
    figure.draw_without_rendering()
    assert legend.get_window_extent().y1 <= figure.axes[0].get_window_extent().y0
    assert figure.axes[1].get_legend() is None


def test_title_labels_and_legend_of_a_view_in_space_fit_a_phone():
    figure = Figure(figsize=(7.2, 5.2), layout="constrained")
    axes = space(figure)
    axes.plot([0, 0.1, -0.5], [-0.7, 0.1, 0.7], [-0.1, 0.3, 0.5], label="demonstration")
    axes.plot([0, 0.2], [0, 0.1], [0, 0.1], label="path: box")
    axes.plot([0, 0.2], [0, 0.3], [0, 0.1], label="carried: box")
    axes.legend(loc="upper right")
    axes.set_title("Paths of the tool centre point (square: release)", loc="left")
    frame_space(axes, np.array([[0.05, -0.6, 0.0], [0.6, 0.6, 0.48]]))
    figure.draw_without_rendering()
    stack_panels(figure)
    figure.draw_without_rendering()
    texts = [axis.label for axis in (axes.xaxis, axes.yaxis, axes.zaxis)]
    _, _, width, height = figure.bbox.bounds
    for drawn in (*texts, axes._left_title, axes.get_legend()):
        extent = drawn.get_window_extent()
        assert 0 <= extent.x0 < extent.x1 <= width, drawn
        assert 0 <= extent.y0 < extent.y1 <= height, drawn
        assert extent.height > 1


def test_views_in_space_keep_their_proportions_on_a_phone():
    figure = Figure(figsize=(7.2, 4.0))
    space(figure)
    figure.draw_without_rendering()
    area = figure.axes[0].get_position()
    row = min(1.0, 3.7 / 7.2 / area.width) * 4.0 * area.height
    stack_panels(figure)
    np.testing.assert_allclose(figure.get_size_inches(), (3.7, row + 0.65 + 0.3))
    flat = Figure(figsize=(7.2, 4.0))
    stack_panels(flat)  # without panels nothing changes
    np.testing.assert_allclose(flat.get_size_inches(), (7.2, 4.0))


WHITE = np.full((300, 400, 3), 255, np.uint8)


def dark(picture):
    """Rows and columns of what is shaded on white: first and last."""
    at = np.argwhere(picture.sum(axis=-1) < 400)
    return at.min(axis=0).tolist(), at.max(axis=0).tolist()


def test_the_bar_of_a_caption_is_36_pixels_high():
    shown = annotated(WHITE, "", "")
    assert dark(shown) == ([264, 0], [299, 399])
    assert (shown[:264] == 255).all()
    words = annotated(WHITE, "HHH", "III") != shown
    rows, columns = np.nonzero(words.any(-1))
    assert (rows.min() + rows.max()) / 2 == pytest.approx(282, abs=2)
    assert columns.min() == pytest.approx(10, abs=2)
    assert columns.max() == pytest.approx(390, abs=2)


def test_entries_of_a_legend_are_22_pixels_apart():
    labels = [("one", "#112233"), ("another one", "#445566")]
    shown = annotated(WHITE, "", "", labels)[:264]
    (top, left), (bottom, right) = dark(shown)
    assert (top, left, bottom) == (10, 10, 32 + 19)
    first = dark(shown[:31])[1]
    assert first[0] == 29
    assert first[1] < right
    for row, colour in ((10, (0x11, 0x22, 0x33)), (32, (0x44, 0x55, 0x66))):
        at = np.argwhere((shown == colour).all(-1))
        assert at.min(axis=0).tolist() == [row + 6, 16]
        assert at.max(axis=0).tolist() == [row + 13, 28]
    # The letters end 6 px before the shade does.
    letters = np.argwhere((shown > 200).all(-1) & (np.arange(400) < right)[None])
    inside = letters[(letters[:, 0] > 33) & (letters[:, 0] < 50) & (letters[:, 1] > 30)]
    assert 34 <= inside[:, 1].min() <= 36
    assert 4 <= right - inside[:, 1].max() <= 8
    middle = (inside[:, 0].min() + inside[:, 0].max()) / 2
    assert middle == pytest.approx((32 + bottom) / 2, abs=1.5)


def test_an_inset_has_a_frame_of_two_pixels():
    inset = np.full((40, 60, 3), 255, np.uint8)
    shown = annotated(WHITE, "", "", (), inset)[:264]
    assert dark(shown) == ([212, 328], [255, 391])
    assert (shown[214:254, 330:390] == 255).all()


def test_the_inset_of_a_camera_is_27_hundredths_wide_with_its_latest_image():
    model = CameraModel(width=200, height=120, focal=(120.0, 120.0), principal=(99.5, 59.5))
    images = np.stack([np.full((120, 200, 3), level, np.uint8) for level in (50, 100, 150)])
    points = np.array([[100.0, 40.0], [np.nan, np.nan], [60.0, 30.0]])
    camera: Any = SimpleNamespace(
        model=model,
        images=images,
        image_time=np.array([1.0, 2.0, 3.0]),
        target=np.full((3, 2), np.nan),
        feature=points,
    )
    at = camera_inset(camera, 1000)
    assert at(0, 1.0).shape == (162 + 18, 270, 3)
    for time, level in ((0.5, 50), (1.0, 50), (1.99, 50), (2.0, 100), (3.0, 150), (9.0, 150)):
        shown = at(1, time)
        assert (shown[:162] == level).all()  # the text covers nothing
        assert (shown[162:, -50:] < level).any()
    red = np.argwhere((at(0, 1.0) == palette.rgba(palette.VERMILION)[:3]).all(-1))
    scale = 0.27 * 1000 / 200
    np.testing.assert_allclose(red.mean(axis=0)[::-1], points[0] * scale, atol=1)
    np.testing.assert_allclose(np.ptp(red, axis=0), (10, 10), atol=1)
    # A ring: its middle shows the image.
    u, v = np.rint(points[0] * scale).astype(int)
    assert (at(0, 1.0)[v, u] == 50).all()
    assert (at(0, 1.0)[143:, 200:] == np.array(at(1, 1.0))[143:, 200:]).all()
    bar = np.argwhere((at(1, 3.0)[:, 200:] != 150).any(-1))
    assert bar[:, 0].min() == 162


def side():
    """A camera 2 m away that looks along -x, with z up."""
    model = CameraModel(width=200, height=100, focal=(120.0, 120.0), principal=(99.5, 49.5))
    return model.look_at(np.array([2.0, 0.0, 0.0]), np.zeros(3))


def drawn(*lines):
    run = sample_run(bodies=(), boxes=(), region=None, camera=None)
    return draw_run(run, 0, side(), lines)


def line(x, width, colour, half=0.3):
    ends = np.array([[x, -half, 0.0], [x, half, 0.0]])
    return Line(start=ends[0], end=ends[1], colour=(*colour, 1.0), width=width)


@pytest.mark.parametrize(("x", "width"), [(0.0, 0.2), (0.0, 0.1), (1.0, 0.1), (-1.0, 0.3)])
def test_a_line_is_as_thick_as_it_is_near_with_an_outline(x, width):
    picture = drawn(line(x, width, (1.0, 0.5, 0.2)))
    column = picture[:, 100]
    core = np.flatnonzero((column == (255, 128, 51)).all(-1))
    assert len(core) == pytest.approx(120 * width / (2 - x), abs=1.1)
    assert core.mean() == pytest.approx(49.5, abs=1.1)
    outline = np.flatnonzero((column == (89, 45, 18)).all(-1))  # 0.35 times as bright
    assert 2 <= len(outline) <= 4
    assert (picture[0, 0] == (228, 233, 238)).all()
    # Round ends reach half a width beyond, and no farther in any direction.
    size = 120 * np.array([width, 0.6 + width]) / (2 - x)
    colours = {0: (picture == (255, 128, 51)).all(-1), 3: (picture != picture[0, 0]).any(-1)}
    for more, shown in colours.items():
        off, half = np.argwhere(shown) - (49.5, 99.5), (size + more) / 2
        np.testing.assert_allclose(off.min(axis=0), -half, atol=1.6)
        np.testing.assert_allclose(off.max(axis=0), half, atol=1.6)


def test_lines_behind_the_camera_are_left_out():
    behind = line(3.0, 0.1, (1.0, 0.0, 0.0))
    assert (drawn(behind) == drawn()).all()


def test_nearer_boxes_cover_farther_ones_and_lines_cover_all():
    boxes = tuple(
        Box(centre=(x, 0.0, 0.0), half_size=(1e-3, 0.2, 1e-3), colour=colour)
        for x, colour in ((0.5, (1.0, 0, 0, 1)), (-0.5, (0, 1.0, 0, 1)))
    )
    over = line(-0.9, 0.02, (0.0, 0.0, 1.0))
    for order in (boxes, boxes[::-1]):
        run = sample_run(bodies=(), boxes=order, region=None, camera=None)
        assert draw_run(run, 0, side())[50, 100].tolist()[1] == 0
        assert draw_run(run, 0, side(), [over])[49, 100].tolist() == [0, 0, 255]


def test_pictures_are_arrays_that_others_may_open():
    assert Image.fromarray(drawn()).size == (200, 100)
