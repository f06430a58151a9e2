"""The minimum-jerk profile of point-to-point motions (Flash and Hogan 1985)."""


def minimum_jerk(x: float) -> tuple[float, float]:
    """Progress and its slope at share `x` of the duration (Flash and Hogan 1985)."""
    x = min(max(x, 0.0), 1.0)
    return x**3 * (10 - 15 * x + 6 * x**2), 30 * x**2 * (1 - x) ** 2
