"""Colours as bytes, pale, for white paper and for fractions."""

import numpy as np
import pytest
from matplotlib.colors import to_rgb

from hrc_learn.viz import palette

COLOURS = [
    *sorted({*palette.SERIES, *palette.SERIES_ON_DARK}),
    palette.BLACK,
    "#010203",
    "#fefdfc",
]


@pytest.mark.parametrize("colour", COLOURS)
def test_bytes_of_a_colour_are_those_of_matplotlib(colour):
    *channels, alpha = palette.rgba(colour)
    assert channels == [round(255 * channel) for channel in to_rgb(colour)]
    assert alpha == 255


@pytest.mark.parametrize("colour", COLOURS)
def test_a_pale_colour_is_a_mixture_with_white_of_the_same_hue(colour):
    *pale, alpha = palette.lighten(colour)
    given = 255 * np.array(to_rgb(colour))
    np.testing.assert_allclose(pale, 0.45 * given + 0.55 * 255, atol=0.5)
    assert alpha == 255


def test_a_fraction_has_the_nearest_of_five_colours_from_vermilion_to_green():
    steps = [palette.followed_colour(k / 4) for k in range(5)]
    assert len({*steps}) == 5
    assert steps[::2] == [palette.VERMILION, palette.ORANGE, palette.GREEN]
    for k, colour in enumerate(steps):
        for off in (-0.12, 0.12):
            assert palette.followed_colour(k / 4 + off) == colour
    assert palette.followed_colour(-3.0) == steps[0]
    assert palette.followed_colour(7.0) == steps[4]


def test_each_curve_on_a_dark_screen_has_one_on_white_paper():
    for dark, light in zip(palette.SERIES_ON_DARK, palette.SERIES, strict=True):
        for mixed in (palette.rgba, palette.lighten):
            shown = palette.on_white(mixed(dark))
            np.testing.assert_allclose(shown, np.array(mixed(light)) / 255)
    other = palette.on_white((10, 20, 30, 255))
    np.testing.assert_allclose(other, np.array([10, 20, 30, 255]) / 255)
