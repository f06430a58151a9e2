"""Smooth values and rates of noisy samples at uneven stamps."""

import numpy as np
from jaxtyping import Float64


def local_polynomial(
    time: Float64[np.ndarray, " frames"],
    values: Float64[np.ndarray, "frames components"],
    *,
    window: float | int,
    degree: int = 3,
) -> tuple[Float64[np.ndarray, "frames components"], Float64[np.ndarray, "frames components"]]:
    """Fit a polynomial around each sample by least squares; its value and slope there.

    The filter of Savitzky and Golay (1964) for stamps that need not be even, as robots and
    cameras give them: each fit takes the same number of neighbours, at the times they really
    have. Near the ends the neighbours are those of the first and last full window. On even
    stamps this is that filter; a polynomial of the degree passes unchanged.

    Args:
        time: Increasing stamps [s].
        values: Samples.
        window: Width of the neighbourhood [s]; at least `degree + 2` samples are taken.
        degree: Degree of the polynomials.

    Returns:
        Values, and their rates [1/s].

    Raises:
        ValueError: There are no more samples than the degree, or the window is not positive.
    """
    if not window > 0 or degree < 1:
        raise ValueError(f"window and degree must be positive, got {window} s and {degree}")
    if len(time) <= degree:
        raise ValueError(
            f"{len(time)} samples do not determine a polynomial of degree {degree}"
        )
    neighbours = _neighbours(time, window, degree)
    offset = time[neighbours] - time[:, None]
    # Scaled to -1..1, for the powers to stay of one size.
    scale = np.abs(offset).max(1, keepdims=True)
    powers = (offset / scale)[..., None] ** np.arange(degree + 1)
    Q, R = np.linalg.qr(powers)
    coefficients = np.linalg.solve(R, Q.mT @ values[neighbours])
    return coefficients[:, 0], coefficients[:, 1] / scale


def _neighbours(
    time: Float64[np.ndarray, " frames"], window: float | int, degree: int
) -> np.ndarray:
    """Indices (frames, neighbours) of an odd number of samples around each."""
    count = round(window / float(np.median(np.diff(time))))
    count = min(max(count, degree + 2) | 1, len(time))
    first = np.clip(np.arange(len(time)) - count // 2, 0, len(time) - count)
    return first[:, None] + np.arange(count)
