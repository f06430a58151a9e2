"""Dynamic time warping: which moments of two sequences belong together."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64


@dataclass(frozen=True, kw_only=True, eq=False)
class WarpingPath:
    """A cheapest monotone pairing of two sequences, from both beginnings to both ends."""

    first: Int64[np.ndarray, " _pairs"]
    """Indices into the first sequence."""
    second: Int64[np.ndarray, " _pairs"]
    """Indices into the second."""
    cost: float
    """Sum of the pairs' costs."""


def warp(
    cost: Float64[np.ndarray, "_first _second"], band: float | int | None = None
) -> WarpingPath:
    """Pair two sequences by dynamic time warping (Sakoe and Chiba 1978, symmetric form P = 0).

    D[i, j] = cost[i, j] + min(D[i-1, j-1], D[i-1, j], D[i, j-1])

    Entries of one anti-diagonal depend on earlier ones only, so each is computed as a whole:
    exact, at some 20 ms for 1000 samples against 1000.

    Args:
        cost: Cost of pairing sample i of the first with sample j of the second.
        band: Largest distance from the diagonal, as a fraction of the length (0 to 1); None:
            any.

    Raises:
        ValueError: A cost is not finite, a sequence is empty, or the band is no fraction.
    """
    rows, columns = cost.shape
    if not cost.size or not np.isfinite(cost).all():
        raise ValueError("warping needs finite costs of at least one pair")
    if band is not None and not 0 <= band <= 1:
        raise ValueError(f"band must be a fraction from 0 to 1, got {band}")
    allowed = _within_band(cost, band)
    total = np.full((rows + 1, columns + 1), np.inf)
    total[0, 0] = 0.0
    for diagonal in range(rows + columns - 1):
        i = np.arange(max(0, diagonal - columns + 1), min(rows, diagonal + 1))
        j = diagonal - i
        before = np.minimum(np.minimum(total[i, j], total[i, j + 1]), total[i + 1, j])
        total[i + 1, j + 1] = allowed[i, j] + before
    return _trace(total)


def _within_band(cost: np.ndarray, band: float | int | None) -> np.ndarray:
    if band is None:
        return cost
    rows, columns = cost.shape
    # Measured between the relative places; one step is allowed always, or no path is left.
    place = np.arange(rows)[:, None] / max(rows - 1, 1) - np.arange(columns) / max(
        columns - 1, 1
    )
    widest = max(band, 1 / max(min(rows, columns) - 1, 1))
    return np.where(np.abs(place) <= widest + 1e-12, cost, np.inf)


def _trace(total: np.ndarray) -> WarpingPath:
    """The way back along the cheapest predecessors; ties go along the diagonal."""
    i, j = total.shape[0] - 1, total.shape[1] - 1
    path = [(i, j)]
    while (i, j) != (1, 1):
        steps = ((i - 1, j - 1), (i - 1, j), (i, j - 1))
        i, j = min(steps, key=lambda place: total[place])
        path.append((i, j))
    pairs = np.array(path[::-1], dtype=np.int64) - 1
    return WarpingPath(first=pairs[:, 0], second=pairs[:, 1], cost=float(total[-1, -1]))
