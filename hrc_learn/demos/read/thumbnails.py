"""Small images of a dataset's episodes: enough to see what was done."""

import os
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
from jaxtyping import Float

from hrc_learn.demos.demonstration import Demonstration
from hrc_learn.demos.issue import DatasetError
from hrc_learn.demos.read.images import ImageReader, jpeg

Stamped = tuple[Float[np.ndarray, " images"], tuple[bytes, ...]]
"""Times [s], and a JPEG file for each."""
Thumbnails = dict[str, Stamped]
"""By camera, without what LeRobot puts before the name of each."""

_RATE = 5.0
"""Images a second: a hand-guided arm moves by a few centimetres between two."""
_HEIGHT = 240
"""Of the tallest image [px]."""


def thumbnails(
    path: str | Path, demos: Iterable[Demonstration], most: int = 200
) -> tuple[dict[int, Thumbnails], list[str]]:
    """What the cameras of a dataset saw in some of its episodes, decoded side by side.

    Args:
        path: The dataset's folder.
        demos: Of it, with all their frames or some that are spread evenly over them.
        most: Images of a camera in one episode: 200 take some 2 MB.

    Returns:
        Images by episode, for those that have any; and what could not be read, a line each.

    Raises:
        DatasetError: The metadata cannot be read.
    """
    reader, found, missing = ImageReader(path), {}, []
    wanted = [(demo, camera) for demo in demos for camera in reader.available(demo.episode)]
    with ThreadPoolExecutor(os.cpu_count()) as pool:  # PyAV decodes without the interpreter
        seen = pool.map(lambda of: _seen(reader, of[0], of[1], most), wanted)
        for (demo, camera), images in zip(wanted, seen, strict=True):
            if isinstance(images, DatasetError):
                missing.append(str(images))
            else:
                found.setdefault(demo.episode, {})[_name(camera)] = images
    return found, missing


def _seen(
    reader: ImageReader, demo: Demonstration, camera: str, most: int
) -> Stamped | DatasetError:
    """What one camera saw, or why that is not known."""
    last = reader.length(demo.episode) - 1
    count = min(last + 1, most, 1 + int(demo.duration * _RATE))
    frames = sorted({*np.linspace(0, last, count).astype(int).tolist()})
    try:
        images = reader.stream(demo.episode, camera, frames, _small(reader.size(camera)))
        files = tuple(jpeg(image) for _, image in images)
    except DatasetError as error:
        return error
    return np.interp(frames, np.linspace(0, last, len(demo)), demo.time), files


def _name(camera: str) -> str:
    # Not the last word alone: left.rgb and right.rgb are two.
    return camera.removeprefix("observation.images.")


def _small(size: tuple[int, int]) -> tuple[int, int]:
    """Height and width, scaled down: even numbers, as chroma is halved [px]."""
    scale = min(1.0, _HEIGHT / size[0]) / 2
    height, width = (2 * max(1, round(scale * side)) for side in size)
    return height, width
