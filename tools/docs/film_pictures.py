"""Parts of the films in docs/images: views, still backgrounds, titles and the file."""

from collections.abc import Callable, Iterator, Sequence
from io import BytesIO
from itertools import repeat
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from hrc_learn.vision import CameraModel
from hrc_learn.viz.film import Picture

IMAGES = Path(__file__).parents[2] / "docs" / "images"
RATE, SECONDS, FIRST, LAST = 15.0, 17.0, 1.0, 2.0
"""Pictures per second [1/s]; longest duration between titles, and those of the titles [s]."""
BAR = 44
"""Height of a title [px]."""
_NOISE = 9
"""Change of a grey level that counts as noise of the camera; it would fill the file."""


def camera_at(
    size: tuple[int, int],
    eye: Sequence[float] | np.ndarray,
    towards: Sequence[float] | np.ndarray,
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


def titled(picture: Picture, text: str) -> Picture:
    """A picture with a title below, where it hides nobody."""
    image = Image.fromarray(picture)
    draw = ImageDraw.Draw(image, "RGBA")
    width, height = image.size
    draw.rectangle((0, height - BAR, width, height), fill=(24, 26, 30))
    middle = width // 2, height - BAR // 2
    draw.text(middle, text, font_size=30, fill="white", anchor="mm")
    return np.asarray(image)


def moving_picture(pictures: Iterator[Picture]) -> bytes:
    """Pictures as one that moves, which Markdown shows anywhere."""
    first, *others = [Image.fromarray(picture) for picture in pictures]
    buffer = BytesIO()
    first.save(
        buffer,
        "WEBP",
        save_all=True,
        append_images=others,
        duration=round(1000 / RATE),
        loop=0,
        quality=50,
        method=4,
    )
    return buffer.getvalue()
