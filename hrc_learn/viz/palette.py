"""Colours of all dashboards and figures, distinguishable with colour blindness.

M. Okabe and K. Ito, Color Universal Design, 2008.
"""

BLUE = "#0072B2"
ORANGE = "#E69F00"
GREEN = "#009E73"
VERMILION = "#D55E00"
PURPLE = "#CC79A7"
SKY = "#56B4E9"
BLACK = "#222222"
GREY = "#9AA0A6"

YELLOW = "#F0E442"

SERIES = (BLUE, ORANGE, GREEN, VERMILION, PURPLE, SKY, GREY)
"""Colours of up to seven joints or curves, on white paper."""

SERIES_ON_DARK = (SKY, ORANGE, GREEN, VERMILION, PURPLE, YELLOW, GREY)
"""The same for dark screens, where blue would be hard to see."""

DEMO = GREY
"""Demonstrations."""
RUN = BLUE
"""Motion of the robot, on white paper."""
RUN_ON_DARK = SKY
LIMIT = VERMILION
"""Limits that must not be crossed."""
TARGET = GREEN
"""Targets and goals."""
PERSON = ORANGE
"""Actions of a person."""


def rgba(colour: str) -> tuple[int, int, int, int]:
    """Bytes of a "#RRGGBB" colour, opaque."""
    r, g, b = (int(colour[i : i + 2], 16) for i in (1, 3, 5))
    return r, g, b, 255


def followed_colour(fraction: float) -> str:
    """Colour for the fraction of a push that the arm follows: vermilion for 0, green for 1.

    The colour changes in five distinguishable steps.
    """
    return (VERMILION, "#DE8000", ORANGE, "#A0A030", GREEN)[
        round(4 * min(max(fraction, 0.0), 1.0))
    ]


def lighten(colour: str) -> tuple[int, int, int, int]:
    """A colour mixed with white, for the curve that lies behind."""
    r, g, b, a = rgba(colour)
    return *(round(c + 0.55 * (255 - c)) for c in (r, g, b)), a  # pyright: ignore[reportReturnType]


_ON_WHITE = {
    mixed(dark): mixed(light)
    for mixed in (rgba, lighten)
    for dark, light in zip(SERIES_ON_DARK, SERIES, strict=True)
}


def on_white(colour: tuple[int, int, int, int]) -> tuple[float, ...]:
    """Colour for white paper, in channels from 0 to 1, that replaces a colour for dark screens.

    Args:
        colour: Colour for dark screens, in bytes.
    """
    return tuple(channel / 255 for channel in _ON_WHITE.get(colour, colour))
