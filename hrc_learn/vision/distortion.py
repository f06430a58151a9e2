"""Lens distortion of Brown (1966), in the parameter order of OpenCV: k1, k2, p1, p2, k3.

Everything here works on *normalised* image points: (x / z, y / z) in the camera frame.
"""

import numpy as np
from jaxtyping import Float

Coefficients = tuple[float, float, float, float, float]
"""(k1, k2, p1, p2, k3): radial k, tangential p."""

NONE: Coefficients = (0.0, 0.0, 0.0, 0.0, 0.0)


def distort(
    normalised: Float[np.ndarray, "*batch 2"], coefficients: Coefficients
) -> Float[np.ndarray, "*batch 2"]:
    """Where the lens puts points that a pinhole would put at `normalised`."""
    k1, k2, p1, p2, k3 = coefficients
    x, y = normalised[..., 0], normalised[..., 1]
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return np.stack(
        [
            x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
            y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
        ],
        axis=-1,
    )


def distort_jacobian(
    normalised: Float[np.ndarray, "*batch 2"], coefficients: Coefficients
) -> Float[np.ndarray, "*batch 2 2"]:
    """Derivative of `distort` with respect to its points."""
    k1, k2, p1, p2, k3 = coefficients
    x, y = normalised[..., 0], normalised[..., 1]
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 2.0 * (k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3))  # d radial / d x = slope * x
    mixed = slope * x * y + 2.0 * (p1 * x + p2 * y)
    return np.stack(
        [
            np.stack([radial + slope * x * x + 2.0 * p1 * y + 6.0 * p2 * x, mixed], axis=-1),
            np.stack([mixed, radial + slope * y * y + 6.0 * p1 * y + 2.0 * p2 * x], axis=-1),
        ],
        axis=-2,
    )


def undistort(
    distorted: Float[np.ndarray, "*batch 2"], coefficients: Coefficients, iterations: int = 10
) -> Float[np.ndarray, "*batch 2"]:
    """Inverse of `distort`, by Newton's method started at the distorted point.

    Args:
        distorted: Normalised points behind the lens.
        coefficients: (k1, k2, p1, p2, k3).
        iterations: Most Newton steps to take. Four reach machine precision for common lenses,
            and no number does where the distortion folds the image over.

    Returns:
        Normalised points of the pinhole.
    """
    if coefficients == NONE:
        return distorted.copy()
    points = distorted.copy()
    tolerance = 16 * np.finfo(points.dtype).eps
    for _ in range(iterations):
        residual = distort(points, coefficients) - distorted
        if np.abs(residual).max(initial=0.0) < tolerance:
            break
        J = distort_jacobian(points, coefficients)
        determinant = J[..., 0, 0] * J[..., 1, 1] - J[..., 0, 1] * J[..., 1, 0]
        points[..., 0] -= (
            J[..., 1, 1] * residual[..., 0] - J[..., 0, 1] * residual[..., 1]
        ) / determinant
        points[..., 1] -= (
            J[..., 0, 0] * residual[..., 1] - J[..., 1, 0] * residual[..., 0]
        ) / determinant
    return points
