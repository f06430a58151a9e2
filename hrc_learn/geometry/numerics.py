"""Functions that are delicate near a removable singularity, in one place.

Each is a function of the *squared* length: a Euclidean norm has no second derivative at
zero, its square has all of them. On either side of a threshold a Taylor series or the
closed form is chosen by `where`, and the form that is not chosen is evaluated at a harmless
argument, because a NaN there would reach the gradient as 0 * NaN.
"""

import torch
from jaxtyping import Float
from torch import Tensor

# Below it the series are exact to rounding in float64 (next term < 1e-16) while the closed
# forms lose second derivatives to cancellation, which grows as 1 / threshold^2.
_SINC_THRESHOLD = 1e-2
_ARCTAN_THRESHOLD = 1e-3


def cos_and_sinc(square: Float[Tensor, "*batch"]) -> tuple[Tensor, Tensor]:
    """Cosine of x and sin(x) / x from x squared; smooth at zero.

    Args:
        square: x squared [rad^2], not negative.

    Returns:
        cos(x) and sin(x) / x, each of the shape of `square`.
    """
    small = square < _SINC_THRESHOLD
    x = torch.sqrt(torch.where(small, 1.0, square))
    near = square.clamp_max(_SINC_THRESHOLD)
    cos_series = polynomial(near, (1.0, -1 / 2, 1 / 24, -1 / 720, 1 / 40320))
    sinc_series = polynomial(near, (1.0, -1 / 6, 1 / 120, -1 / 5040, 1 / 362880))
    return torch.where(small, cos_series, torch.cos(x)), torch.where(
        small, sinc_series, torch.sin(x) / x
    )


def arctan_ratio(
    sine_square: Float[Tensor, "*batch"], cosine: Float[Tensor, "*batch"]
) -> Tensor:
    """atan2(s, c) / s from s squared and c; smooth at s = 0 for c > 0.

    Only the direction of (s, c) enters the angle, so a common scale of both divides the result.

    Args:
        sine_square: s squared, not negative.
        cosine: c, not negative, and positive where s = 0.

    Returns:
        The ratio, 1 / c at s = 0.
    """
    small = sine_square < _ARCTAN_THRESHOLD * cosine * cosine
    s = torch.sqrt(torch.where(small, 1.0, sine_square))
    c = torch.where(small, cosine, 1.0)
    tangent_square = sine_square / (c * c)  # where not small it only has to be finite
    series = polynomial(tangent_square, (1.0, -1 / 3, 1 / 5, -1 / 7, 1 / 9)) / c
    return torch.where(small, series, torch.atan2(s, cosine) / s)


def safe_norm(vector: Float[Tensor, "*batch n"]) -> Float[Tensor, "*batch"]:
    """Euclidean norm whose derivatives at zero are zero instead of NaN."""
    square = (vector * vector).sum(-1)
    zero = square == 0
    return torch.where(zero, 0.0, torch.sqrt(torch.where(zero, 1.0, square)))


def polynomial(x: Tensor, coefficients: tuple[float, ...]) -> Tensor:
    """Value of a polynomial, the constant term first, by Horner's rule."""
    *rest, last_but_one, last = coefficients
    value = x * last + last_but_one
    for coefficient in reversed(rest):
        value = value * x + coefficient
    return value


def minimum_jerk(x: float) -> tuple[float, float]:
    """Progress 0 to 1 of a minimum-jerk motion and its slope (Flash and Hogan 1985).

    Args:
        x: Fraction of the duration. Outside 0 to 1 the motion rests at the start or the end.
    """
    x = min(max(x, 0.0), 1.0)
    return x**3 * (10 - 15 * x + 6 * x**2), 30 * x**2 * (1 - x) ** 2
