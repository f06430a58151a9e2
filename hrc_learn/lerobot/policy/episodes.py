"""Whole demonstrations of a dataset's folder, in the columns and units a policy trains on."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ...demos.choosing import choose_episodes
from ...demos.frames import read_frames
from ...demos.layout import open_folder

MOST = 256
"""Demonstrations that say enough of a motion to start from; more are spread evenly."""


def read_episodes(
    root: str | Path, keys: Sequence[str], episodes: Sequence[int] | None = None
) -> list[dict[str, Tensor]]:
    """Columns of whole episodes, (frames, components) each, just as they are on disk.

    Args:
        root: Folder of a LeRobot dataset.
        keys: Columns wanted.
        episodes: Indices; None: all. Of more than 256, that many are read.

    Raises:
        DatasetError: A `ValueError` that says what of the dataset cannot be read.
    """
    folder = open_folder(root)
    chosen = choose_episodes(folder, episodes)
    if len(chosen) > MOST:
        spread = np.linspace(0, len(chosen) - 1, MOST).round().astype(int)
        chosen = tuple(chosen[i] for i in spread)
    entries = sorted(chosen, key=lambda entry: (entry.file, entry.start))
    return [
        {key: torch.from_numpy(np.array(frames[key])) for key in keys}
        for _, frames in read_frames(folder, entries, keys)
    ]
