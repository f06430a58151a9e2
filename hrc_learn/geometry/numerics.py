"""Numerically delicate functions: removable singularities, small matrices, fixed tensors.

The module also converts arrays of users to tensors and checks the ranges of settings.

Functions with a removable singularity take the *squared* length: a Euclidean norm has no
derivative at zero, but its square has all derivatives. `where` selects a Taylor series below a
threshold and the closed form above it. The form that is not selected is evaluated at a harmless
argument, because a NaN there would reach the gradient as 0 * NaN.
"""

import math
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import cache, lru_cache, wraps
from typing import Any, Literal, get_args, get_origin, get_type_hints

import numpy as np
import torch
from jaxtyping import Bool, Float, Real
from torch import Tensor
from torch.utils._python_dispatch import _disable_current_modes
from torch.utils._pytree import tree_leaves

type ArrayLike = Real[Tensor, "..."] | Real[np.ndarray, "..."] | Sequence | float
"""A tensor, a NumPy array, or a nested list of numbers."""

# Below these thresholds the series are exact to rounding in float64 (next term < 1e-16), while
# the second derivatives of the closed forms lose digits to cancellation, in proportion to
# 1/threshold^2.
_SINC_THRESHOLD = 1e-2
_ARCTAN_THRESHOLD = 1e-3


def as_tensor(values: ArrayLike, like: Tensor | None = None) -> Tensor:
    """Convert an array to a floating-point tensor; tensors of floats are returned unchanged.

    Args:
        values: Tensor, NumPy array, or nested list. Integers and lists become float64.
        like: Tensor with the dtype and device of the result; None keeps those of `values`.

    Returns:
        Tensor of the same shape.

    Raises:
        ValueError: The values are complex.
    """
    if not isinstance(values, Tensor):
        if isinstance(values, np.ndarray):
            # PyTorch accepts neither negative strides nor other byte orders.
            values = np.require(values, values.dtype.newbyteorder("="), ["C", "W"])
        values = torch.as_tensor(np.asarray(values))
    if values.is_complex():
        raise ValueError("values must be real numbers, but are complex")
    if not values.is_floating_point():
        values = values.double()
    return values if like is None else values.to(like)


def check_settings(
    settings: object,
    *,
    positive: Iterable[str] = (),
    not_negative: Iterable[str] = (),
    below_one: Iterable[str] = (),
    fraction: Iterable[str] = (),
) -> None:
    """Check that settings are in their ranges.

    Every number, also within a tuple, must be finite, unless its name is in the class attribute
    `unbounded`; NaN is in no range. A setting annotated with `Literal` must be one of its
    values. A dataclass without ranges can use this function as its `__post_init__`.

    Args:
        settings: Object with the settings as attributes; None is in every range.
        positive: Names of settings that must be positive.
        not_negative: Names of settings that must be zero or positive.
        below_one: Names of settings that must be in [0, 1).
        fraction: Names of settings that must be in (0, 1].

    Raises:
        ValueError: A setting is not in its range.
    """
    rules = (
        (positive, "must be positive", lambda x: x > 0),
        (not_negative, "must not be negative", lambda x: x >= 0),
        (below_one, "must be in [0, 1)", lambda x: 0 <= x < 1),
        (fraction, "must be in (0, 1]", lambda x: 0 < x <= 1),
    )
    for names, rule, holds in rules:
        for name in names:
            value = getattr(settings, name)
            if value is not None and not holds(value):
                raise ValueError(f"{name} {rule}, but is {value}")
    for name, known in _choices(type(settings)).items():
        check_choice(name, getattr(settings, name), known)
    for name, value in vars(settings).items():
        numbers = value if isinstance(value, tuple) else (value,)
        wrong = [x for x in numbers if isinstance(x, float) and not math.isfinite(x)]
        if wrong and (math.isnan(wrong[0]) or name not in getattr(settings, "unbounded", ())):
            raise ValueError(f"{name} must be finite, but is {value}")


def check_positive(settings: object) -> None:
    """`check_settings` for settings whose numbers must all be positive."""
    numbers = [name for name, value in vars(settings).items() if isinstance(value, float | int)]
    check_settings(settings, positive=numbers)


def check_choice(name: str, value: object, known: Collection[object]) -> None:
    """Raise ValueError unless a value is among the known values."""
    if value not in known:
        text = " or ".join(x if isinstance(x, str) and x else repr(x) for x in known)
        raise ValueError(f"{name} must be {text}, but is {value!r}")


@cache
def _choices(kind: type) -> dict[str, tuple[object, ...]]:
    """Values of each attribute of a class that is annotated with `Literal`."""
    hints = {k: getattr(v, "__value__", v) for k, v in get_type_hints(kind).items()}
    return {k: get_args(v) for k, v in hints.items() if get_origin(v) is Literal}


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

    A common factor on s and c does not change the angle, so it divides the result.

    Args:
        sine_square: s squared, not negative.
        cosine: c, not negative, and positive where s = 0.

    Returns:
        The ratio, 1 / c at s = 0.
    """
    if may_branch(sine_square) and torch.is_inference_mode_enabled():
        # Without derivatives the closed form is exact down to the smallest sine.
        s = sine_square.clamp(min=torch.finfo(sine_square.dtype).tiny).sqrt()
        return torch.atan2(s, cosine) / s
    small = sine_square < _ARCTAN_THRESHOLD * cosine * cosine
    s = torch.sqrt(torch.where(small, 1.0, sine_square))
    c = torch.where(small, cosine, 1.0)
    tangent_square = sine_square / (c * c)  # if not small, it only has to be finite
    series = polynomial(tangent_square, (1.0, -1 / 3, 1 / 5, -1 / 7, 1 / 9)) / c
    return torch.where(small, series, torch.atan2(s, cosine) / s)


def safe_norm(vector: Float[Tensor, "*batch n"]) -> Float[Tensor, "*batch"]:
    """Euclidean norm whose derivatives at zero are zero instead of NaN."""
    square = (vector * vector).sum(-1)
    zero = square == 0
    return torch.where(zero, 0.0, torch.sqrt(torch.where(zero, 1.0, square)))


# Larger than any measurement in SI units; the square of this number fits into float32.
_LARGEST_VALID = 1e12


def is_number(x: Float[Tensor, "*shape"]) -> Bool[Tensor, "*shape"]:
    """True where x is usable in computations: not NaN, not infinite, not absurdly large."""
    return x.abs() < _LARGEST_VALID  # NaN compares false


def may_branch(x: Tensor) -> bool:
    """True if Python may branch on the values of a tensor, for example to skip work.

    Tracers and `vmap` cannot follow such a branch. On an accelerator, it would wait for data.
    """
    if torch.compiler.is_compiling() or x.device.type != "cpu":
        return False
    return torch._C._functorch.maybe_current_level() is None  # pyright: ignore


def everywhere(mask: Bool[Tensor, "*batch"]) -> bool:
    """True if Python may branch (`may_branch`) and the mask is true for the whole batch."""
    return may_branch(mask) and bool(mask.all())


def has_numbers(tree: Any) -> bool:
    """True if Python may branch and all floats of a pytree are valid numbers (`is_number`)."""
    values = [x.reshape(-1) for x in tree_leaves(tree) if x.is_floating_point()]
    return may_branch(values[0]) and bool(is_number(torch.cat(values)).all())


def polynomial(x: Tensor, coefficients: tuple[float, ...]) -> Tensor:
    """Value of a polynomial, the constant term first, by Horner's rule."""
    *rest, last_but_one, last = coefficients
    value = x * last + last_but_one
    for coefficient in reversed(rest):
        value = value * x + coefficient
    return value


def minimum_jerk[T: (float, Tensor)](x: T) -> tuple[T, T]:
    """Progress m(x), 0 to 1, of a minimum-jerk motion, and dm/dx (Flash and Hogan 1985).

    Args:
        x: Fraction of the duration. Outside 0 to 1 the motion rests at the start or the end.
    """
    x = x.clamp(0.0, 1.0) if isinstance(x, Tensor) else min(max(x, 0.0), 1.0)
    return x**3 * (10 - 15 * x + 6 * x**2), 30 * x**2 * (1 - x) ** 2


@contextmanager
def lasting() -> Iterator[None]:
    """Context in which to make tensors that are kept and that every later call can use.

    Autograd refuses tensors made in inference mode, and the placeholder tensors of a tracer are
    valid only during its trace.
    """
    with torch.inference_mode(False), _disable_current_modes():
        yield


def cached_tensors[**P, R](maxsize: int) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """`functools.lru_cache` for functions that make `lasting` tensors.

    Dynamo does not use the cache: it traces the function.

    Args:
        maxsize: Number of results that are kept.
    """

    def decorate(function: Callable[P, R]) -> Callable[P, R]:
        kept = lru_cache(maxsize)(lasting()(function))

        @wraps(function)
        def called(*args: P.args, **kwargs: P.kwargs) -> R:
            made = function if torch.compiler.is_dynamo_compiling() else kept
            return made(*args, **kwargs)

        return called

    return decorate


class Constant:
    """A fixed tensor, cached for each dtype and device that it is used with.

    Floating-point values are converted from float64; integers keep their dtype.
    """

    def __init__(self, value: Tensor):
        with lasting():
            self._value = value.clone()  # a tensor made in inference mode becomes a usual one
        self._ready: dict[tuple[torch.dtype, torch.device], Tensor] = {}

    def __getstate__(self) -> dict[str, object]:
        # The cache is not part of the constant.
        return {"_value": self._value, "_ready": {}}

    def like(self, x: Tensor) -> Tensor:
        """The tensor on the device of `x`; a floating-point one also takes the dtype of `x`."""
        dtype = x.dtype if self._value.is_floating_point() else self._value.dtype
        if torch.compiler.is_compiling():
            return self._value.to(device=x.device, dtype=dtype)
        key = (dtype, x.device)
        tensor = self._ready.get(key)
        if tensor is None:
            with lasting():
                tensor = self._value.to(device=x.device, dtype=dtype)
            if _outlives_the_call(tensor):
                self._ready[key] = tensor
        return tensor


def _outlives_the_call(tensor: Tensor) -> bool:
    """False for stand-ins that are valid only within a tracer or a functional transform."""
    functorch = torch._C._functorch  # pyright: ignore[reportAttributeAccessIssue]
    return type(tensor) is Tensor and not functorch.is_functorch_wrapped_tensor(tensor)


# Products and solutions with matrices of a few rows. In eager mode each call costs more than
# its arithmetic, so one call of BLAS or LAPACK is best. A compiler fuses sums of products with
# the surrounding operations, also across a batch, but has to leave its loop for each call of
# BLAS or LAPACK. So the branches for compilers write the sums out.


def matmul(
    A: Float[Tensor, "*#batch m k"], B: Float[Tensor, "*#batch k n"]
) -> Float[Tensor, "*batch m n"]:
    """Matrix product A B."""
    if not torch.compiler.is_compiling():
        return A @ B
    return (A.unsqueeze(-1) * B.unsqueeze(-3)).sum(-2)


def inverse_norm(A: Float[Tensor, "*batch n n"]) -> Float[Tensor, "*batch"]:
    """Frobenius norm of A^-1, for a symmetric positive definite A."""
    unit = torch.eye(A.shape[-1], dtype=A.dtype, device=A.device)
    return torch.linalg.vector_norm(solve_positive(A, unit.expand_as(A)), dim=(-2, -1))


def solve_positive(
    A: Float[Tensor, "*batch n n"], B: Float[Tensor, "*batch n k"]
) -> Float[Tensor, "*batch n k"]:
    """A^-1 B for a symmetric positive definite A."""
    if not torch.compiler.is_compiling():
        factor, _ = torch.linalg.cholesky_ex(A)
        return torch.cholesky_solve(B, factor)
    # Row by row from A = L D L^T, with unit lower triangular L.
    L, inverse_d = _factors(A)
    rows = list(B.unbind(-2))
    for i in range(len(rows)):  # L y = b
        for j in range(i):
            rows[i] = rows[i] - L[i][j].unsqueeze(-1) * rows[j]
    for i in reversed(range(len(rows))):  # L^T x = D^-1 y
        rows[i] = rows[i] * inverse_d[i].unsqueeze(-1)
        for j in range(i + 1, len(rows)):
            rows[i] = rows[i] - L[j][i].unsqueeze(-1) * rows[j]
    return torch.stack(rows, dim=-2)


def null_projection(
    J: Float[Tensor, "*batch m n"], w: Float[Tensor, "*batch n"]
) -> Float[Tensor, "*batch n"]:
    """The null-space part N w of w, up to rounding: |J N w| is at most about 1e-14 |J| |w|.

    The function uses a Householder QR of J^T, which is as accurate for a singular J as for a
    regular J. Solving with J J^T would square the condition number. If the rank is below m, the
    projection still removes m directions: the range of J^T and some of the null space.

    Args:
        J: Jacobian; with m >= n, nothing but rounding is left of w.
        w: Vector to project.
    """
    if not torch.compiler.is_compiling():
        Q = torch.linalg.qr(J.mT).Q
        return w - (Q @ (Q.mT @ w.unsqueeze(-1))).squeeze(-1)
    # Apply the reflections that make J^T triangular, drop the first m entries, and reflect
    # back.
    m = min(J.shape[-2:])
    reflections = _reflections(J)
    for k, (v, factor) in enumerate(reflections):
        w = _reflected(w, k, v, factor)
    w = torch.cat([torch.zeros_like(w[..., :m]), w[..., m:]], dim=-1)
    for k in reversed(range(m)):
        w = _reflected(w, k, *reflections[k])
    return w


def orthonormal_basis(J: Float[Tensor, "*batch m n"]) -> Float[Tensor, "*batch n n"]:
    """An orthogonal matrix Q; J maps its last n - m columns (none if m >= n) to zero, up to
    rounding.

    The first m columns span the range of J^T and, if the rank of J is below m, some of the
    null space.
    """
    if not torch.compiler.is_compiling():
        return torch.linalg.qr(J.mT, mode="complete").Q
    n = J.shape[-1]
    Q = torch.eye(n, dtype=J.dtype, device=J.device).expand(*J.shape[:-2], n, n)
    for k, (v, factor) in enumerate(_reflections(J)):
        Q = _reflected(Q, k, v.unsqueeze(-2), factor.unsqueeze(-1))
    return Q


def _reflections(J: Tensor) -> list[tuple[Tensor, Tensor]]:
    """Householder vector v and factor 2 / |v|^2 for each row of J, to make J^T triangular."""
    columns = list(J.unbind(-2))
    reflections: list[tuple[Tensor, Tensor]] = []
    for k in range(min(J.shape[-2:])):
        x = columns[k][..., k:]
        norm = (x * x).sum(-1, keepdim=True).sqrt()
        # Both terms of the sum have the same sign, so no digits cancel.
        v = torch.cat([x[..., :1] + torch.copysign(norm, x[..., :1]), x[..., 1:]], dim=-1)
        square = (v * v).sum(-1, keepdim=True)
        # A column of zeros needs no reflection.
        factor = torch.where(square > 0, 2 / torch.where(square > 0, square, 1.0), 0.0)
        reflections.append((v, factor))
        for i in range(k + 1, len(columns)):
            columns[i] = _reflected(columns[i], k, v, factor)
    return reflections


def _reflected(x: Tensor, k: int, v: Tensor, factor: Tensor) -> Tensor:
    """Reflect the entries of x from index k on in the plane perpendicular to v."""
    rest = x[..., k:]
    rest = rest - factor * (rest * v).sum(-1, keepdim=True) * v
    return torch.cat([x[..., :k], rest], dim=-1)


def _factors(A: Tensor) -> tuple[list[list[Tensor]], list[Tensor]]:
    """L and 1/D of A = L D L^T; each row of L holds only the entries left of the diagonal."""
    n = A.shape[-1]
    L: list[list[Tensor]] = [[] for _ in range(n)]
    inverse_d: list[Tensor] = []
    for i in range(n):
        scaled: list[Tensor] = []  # L[i][j] D[j]
        for j in range(i):
            entry = A[..., i, j]
            for k in range(j):
                entry = entry - scaled[k] * L[j][k]
            scaled.append(entry)
            L[i].append(entry * inverse_d[j])
        d = A[..., i, i]
        for k in range(i):
            d = d - scaled[k] * L[i][k]
        inverse_d.append(1 / d)
    return L, inverse_d
