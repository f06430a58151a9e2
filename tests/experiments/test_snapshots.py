"""Rendered pictures and their figure."""

import numpy as np

from hrc_learn.experiments.snapshots import snapshots_figure, viewpoint


def test_what_a_viewpoint_is_towards_is_in_the_middle_upright():
    camera = viewpoint((1.3, 0.95, 1.1), (0.24, -0.3, 0.3))
    middle = np.array([[0.24, -0.3, 0.3], [0.24, -0.3, 0.4]])
    (x, y), (above_x, above_y) = camera.project(middle)
    np.testing.assert_allclose((x, y), ((camera.width - 1) / 2, (camera.height - 1) / 2))
    assert abs(above_x - x) < 1e-6
    assert above_y < y


def test_snapshots_keep_their_order_and_titles():
    pictures = [(name, np.full((30, 40, 3), 80 * k, np.uint8)) for k, name in enumerate("abc")]
    figure = snapshots_figure(pictures)
    assert [axes.get_title(loc="left") for axes in figure.axes] == ["a", "b", "c", ""]
    shown = [np.asarray(axes.get_images()[0].get_array()) for axes in figure.axes[:3]]
    assert [image.max() for image in shown] == [0, 80, 160]
