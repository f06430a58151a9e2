"""Small images of a dataset's episodes: enough to see what was done."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from jaxtyping import Float

from hrc_learn.demos.demonstration import Demonstration
from hrc_learn.demos.issue import DatasetError
from hrc_learn.demos.read.images import ImageReader, jpeg

Thumbnails = dict[str, tuple[Float[np.ndarray, " images"], tuple[bytes, ...]]]
"""By camera: times [s], and a JPEG file for each."""

_RATE = 5.0
"""Images a second: a hand-guided arm moves by a few centimetres between two."""
_MOST = 200
"""Images of a camera in one episode: about 2 MB."""
_HEIGHT = 240
"""Of the tallest image [px]."""


def thumbnails(
    path: str | Path, demos: Iterable[Demonstration]
) -> tuple[dict[int, Thumbnails], list[str]]:
    """What the cameras of a dataset saw in some of its episodes.

    Args:
        path: The dataset's folder.
        demos: Of it, with all their frames or some that are spread evenly over them.

    Returns:
        Images by episode, for those that have any; and what could not be read, a line each.

    Raises:
        DatasetError: The metadata cannot be read.
    """
    reader, found, missing = ImageReader(path), {}, []
    for demo in demos:
        last = reader.length(demo.episode) - 1
        count = min(last + 1, _MOST, 1 + int(demo.duration * _RATE))
        frames = sorted({*np.linspace(0, last, count).astype(int).tolist()})
        time = np.interp(frames, np.linspace(0, last, len(demo)), demo.time)
        for camera in reader.available(demo.episode):
            try:
                size = _small(reader.size(camera))
                images = reader.stream(demo.episode, camera, frames, size)
                files = tuple(jpeg(image) for _, image in images)
            except DatasetError as error:
                missing.append(str(error))
            else:
                name = camera.rpartition(".")[2]
                found.setdefault(demo.episode, {})[name] = time, files
    return found, missing


def _small(size: tuple[int, int]) -> tuple[int, int]:
    """Height and width, scaled down: even numbers, as chroma is halved [px]."""
    scale = min(1.0, _HEIGHT / size[0]) / 2
    height, width = (2 * max(1, round(scale * side)) for side in size)
    return height, width
