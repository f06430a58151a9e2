"""Colours of every dashboard and figure, which the colour-blind can tell apart.

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
"""One for each of up to seven joints or curves, on white paper."""

SERIES_ON_DARK = (SKY, ORANGE, GREEN, VERMILION, PURPLE, YELLOW, GREY)
"""The same for dark screens, where blue would sink."""

DEMO = GREY
"""Demonstrations."""
RUN = BLUE
"""What the robot did, on white paper."""
RUN_ON_DARK = SKY
LIMIT = VERMILION
"""Limits and targets that must not be crossed."""
TARGET = GREEN
"""Where something is wanted."""
PERSON = ORANGE
"""What a person did."""


def rgba(colour: str) -> tuple[int, int, int, int]:
    """Bytes of a "#RRGGBB" colour, opaque."""
    r, g, b = (int(colour[i : i + 2], 16) for i in (1, 3, 5))
    return r, g, b, 255


def followed_colour(share: float) -> str:
    """Of a push of which an arm follows a share, 0 to 1: green all, vermilion nothing of it.

    In five steps, each of which can be told from the next.
    """
    return (VERMILION, "#DE8000", ORANGE, "#A0A030", GREEN)[
        round(4 * min(max(share, 0.0), 1.0))
    ]


def lighten(colour: str) -> tuple[int, int, int, int]:
    """A colour mixed with white, for the curve that lies behind."""
    r, g, b, a = rgba(colour)
    return *(round(c + 0.55 * (255 - c)) for c in (r, g, b)), a  # pyright: ignore[reportReturnType]
