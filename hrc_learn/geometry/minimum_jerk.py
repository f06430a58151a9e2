"""The minimum-jerk profile of point-to-point motions (Flash and Hogan 1985)."""


def minimum_jerk(x: float) -> tuple[float, float]:
    """Progress 0 to 1 and its slope, at the fraction `x` of the duration.

    Outside 0 to 1 it rests at the start or at the end.
    """
    x = min(max(x, 0.0), 1.0)
    return x**3 * (10 - 15 * x + 6 * x**2), 30 * x**2 * (1 - x) ** 2
