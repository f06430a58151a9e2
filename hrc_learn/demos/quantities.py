"""Quantities picked out of raw columns, still in the units they have on disk."""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float64

from .explicit_mapping import Selection
from .frames import RawFrames

Quantities = dict[str, Float64[np.ndarray, "_frames _components"]]
"""Role -> values during one episode."""


def select_quantities(frames: RawFrames, selections: Mapping[str, Selection]) -> Quantities:
    """Values of every role, as float64."""
    return {role: _columns(frames, selection.columns) for role, selection in selections.items()}


def frame_step(time: Float64[np.ndarray, "frames 1"] | None, fps: float) -> float:
    """Usual step of true stamps as a multiple of the nominal period; 1 without stamps."""
    if time is None or len(time) < 2:
        return 1.0
    return float(np.median(np.diff(time[:, 0]))) * fps


def _columns(
    frames: RawFrames, columns: Sequence[tuple[str, int]]
) -> Float64[np.ndarray, "frames components"]:
    keys = {key for key, _ in columns}
    if len(keys) > 1:
        return np.stack([frames[key][:, index] for key, index in columns], axis=1).astype(float)
    values, indices = frames[keys.pop()], [index for _, index in columns]
    if indices == list(range(indices[0], indices[-1] + 1)):  # a view: converted in one go
        return values[:, indices[0] : indices[-1] + 1].astype(float)
    return values[:, indices].astype(float)
