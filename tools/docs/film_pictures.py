"""Parts of the films in docs/images: views, still backgrounds, titles and the file."""

from collections.abc import Callable, Iterator, Sequence
from itertools import repeat
from pathlib import Path

import numpy as np
from readme_film import RATE, moving_picture, titled

from hrc_learn.vision import CameraModel
from hrc_learn.viz.film import Picture

IMAGES = Path(__file__).parents[2] / "docs" / "images"
SECONDS, FIRST, LAST = 17.0, 1.0, 2.0
"""Longest duration of a film between its titles, and durations of the titles [s]."""
_NOISE = 9
"""Change of a grey level that counts as noise of the camera; it would fill the file."""


def view(
    size: tuple[int, int],
    eye: Sequence[float],
    towards: Sequence[float],
    focal: float,
) -> CameraModel:
    """Camera at `eye` that looks at `towards` [m].

    Args:
        size: Width and height of the pictures [px].
        eye: Position of the camera [m].
        towards: Point in the middle of the pictures [m].
        focal: Focal length by the height of the pictures.
    """
    width, height = size
    return CameraModel(
        width=width,
        height=height,
        focal=(focal * height, focal * height),
        principal=((width - 1) / 2, (height - 1) / 2),
    ).look_at(np.array(eye), np.array(towards))


def still(pictures: Iterator[Picture]) -> Iterator[Picture]:
    """Pictures in which a pixel changes only if it changes by more than noise."""
    shown = None
    for picture in pictures:
        if shown is None:
            shown = picture.copy()
        changed = np.abs(picture.astype(np.int16) - shown).max(axis=-1) > _NOISE
        shown = np.where(changed[..., None], picture, shown)
        yield shown


def write_film(
    path: Path,
    picture: Callable[[float], Picture],
    times: tuple[float, float, float],
    titles: tuple[str, str],
) -> None:
    """Write a film with a title at both ends; some pages show its first picture only.

    Args:
        path: File .webp.
        picture: Function that makes the picture of a time [s].
        times: Time of the first picture, and begin and end of the film [s].
        titles: Titles of the first and of the last picture.
    """
    telling, begin, end = times

    def pictures() -> Iterator[Picture]:
        yield from repeat(titled(picture(telling), titles[0]), round(RATE * FIRST))
        for time in np.linspace(begin, end, round(RATE * min(end - begin, SECONDS))).tolist():
            shown = picture(time)
            yield shown
        yield from repeat(titled(shown, titles[1]), round(RATE * LAST))

    content = moving_picture(still(pictures()))
    path.write_bytes(content)
    print(f"{path}: {len(content) / 1e6:.1f} MB")
