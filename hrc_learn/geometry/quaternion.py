"""Rotations as unit quaternions (w, x, y, z), and the rates of their rotation vectors.

q and -q represent the same rotation and give the same result. Every function (except `mean`)
takes any number of leading batch dimensions, follows the dtype and device of its input, and has
finite first and second derivatives everywhere, also at the identity and at half turns. No
function branches on data or writes in place, so all can be compiled, exported and vmapped.

Inputs must be unit quaternions: `normalize` external data.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.geometry.numerics import (
    Constant,
    arctan_ratio,
    cos_and_sinc,
    polynomial,
    safe_norm,
)

# Matrix P with p * q = P q: for each entry, the index of the component of p, and its sign.
_PRODUCT_INDEX = Constant(torch.tensor([0, 1, 2, 3, 1, 0, 3, 2, 2, 3, 0, 1, 3, 2, 1, 0]))
_SIGNS = [[1, -1, -1, -1], [1, 1, -1, 1], [1, 1, 1, -1], [1, -1, 1, 1]]
_PRODUCT_SIGN = Constant(torch.tensor(_SIGNS, dtype=torch.float64))
_CONJUGATE_SIGN = Constant(torch.tensor([1, -1, -1, -1], dtype=torch.float64))
# The sum of the signs with these weights has the sign of the first non-zero component.
_LEXICOGRAPHIC = Constant(torch.tensor([8, 4, 2, 1], dtype=torch.float64))
# Each entry of 4 q q^T - I is a sum of up to three entries of R with these signs. The entries
# of R are numbered row by row from 1; 0 stands for no entry.
_OUTER = torch.tensor([
    [1, 8, 3, 4, 8, 1, 2, 3, 3, 2, -1, 6, 4, 3, 6, -1],
    [5, -6, -7, -2, -6, -5, 4, 7, -7, 4, 5, 8, -2, 7, 8, -5],
    [9, 0, 0, 0, 0, -9, 0, 0, 0, 0, -9, 0, 0, 0, 0, 9],
])  # fmt: skip
_OUTER_INDEX, _OUTER_SIGN = Constant(_OUTER.abs() - 1), Constant(_OUTER.sign().double())
_OUTER_OFFSET = Constant(torch.eye(4, dtype=torch.float64).flatten())
_COMPONENTS = Constant(torch.arange(4))
# Below this angle [rad] an axis of rotation is rounding noise.
_AXIS_THRESHOLD = 1e-6


def multiply(
    p: Float[Tensor, "*#batch 4"], q: Float[Tensor, "*#batch 4"]
) -> Float[Tensor, "*batch 4"]:
    """Hamilton product: rotate by q, then by p."""
    if torch.compiler.is_compiling():
        return torch.stack(product_of_components(p.unbind(-1), q.unbind(-1)), dim=-1)
    # Sums instead of a matmul: TF32 tensor cores would round the product to three digits.
    left = p[..., _PRODUCT_INDEX.like(p)].unflatten(-1, (4, 4)) * _PRODUCT_SIGN.like(p)
    return (left * q[..., None, :]).sum(-1)


def conjugate(q: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 4"]:
    """Inverse rotation."""
    return q * _CONJUGATE_SIGN.like(q)


def normalize(q: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 4"]:
    """Scale to unit length. A zero quaternion is no rotation and gives NaN."""
    return q / torch.linalg.vector_norm(q, dim=-1, keepdim=True)


def canonical(q: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 4"]:
    """Choose the sign so that the first non-zero component is positive.

    With w >= 0, the quaternion belongs to the shortest rotation.
    """
    order = (torch.sign(q) * _LEXICOGRAPHIC.like(q)).sum(-1, keepdim=True)
    return q * torch.sign(order)


def log(q: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 3"]:
    """Rotation vector of the shortest rotation.

    Returns:
        Axis times the full angle [rad], of length 0 to pi. At exactly pi, two axes are
        possible; the result is the one whose first non-zero component is positive.
    """
    q = canonical(q)
    w, v = q[..., 0], q[..., 1:]
    return (2 * arctan_ratio(torch.linalg.vecdot(v, v), w))[..., None] * v


def exp(v: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 4"]:
    """Unit quaternion of a rotation vector [rad] of any length."""
    half = 0.5 * v
    cosine, sinc = cos_and_sinc((half * half).sum(-1, keepdim=True))
    return torch.cat([cosine, sinc * half], dim=-1)


def rotate(
    q: Float[Tensor, "*#batch 4"], v: Float[Tensor, "*#batch 3"]
) -> Float[Tensor, "*batch 3"]:
    """Rotate vectors."""
    w = q[..., :1]
    u, v = torch.broadcast_tensors(q[..., 1:], v)
    t = 2 * torch.linalg.cross(u, v)
    return v + w * t + torch.linalg.cross(u, t)


def to_matrix(q: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 3 3"]:
    """Rotation matrix."""
    basis = torch.eye(3, dtype=q.dtype, device=q.device)
    return rotate(q[..., None, :], basis).mT


def from_matrix(R: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 4"]:
    """Unit quaternion of a rotation matrix; its sign is arbitrary.

    The function builds the symmetric matrix 4 q q^T, which is linear in R, and normalises its
    largest row (Markley 2008, "Unit quaternion from rotation matrix"). The result is accurate
    at every angle, and a unit quaternion even if R is a rotation only up to rounding.
    """
    if torch.compiler.is_compiling():
        return _written_out_from_matrix(R)
    entries = R.flatten(-2)[..., _OUTER_INDEX.like(R)] * _OUTER_SIGN.like(R)
    outer = entries.sum(-2) + _OUTER_OFFSET.like(R)
    largest = outer[..., ::5].argmax(-1, keepdim=True)
    row = outer.gather(-1, 4 * largest + _COMPONENTS.like(R))
    return normalize(row)


def angle(
    p: Float[Tensor, "*#batch 4"], q: Float[Tensor, "*#batch 4"]
) -> Float[Tensor, "*batch"]:
    """Angle of the shortest rotation between two orientations [rad], 0 to pi."""
    difference = multiply(conjugate(p), q)
    return 2 * torch.atan2(safe_norm(difference[..., 1:]), difference[..., 0].abs())


def slerp(
    p: Float[Tensor, "*#batch 4"],
    q: Float[Tensor, "*#batch 4"],
    t: Float[Tensor, "*#batch"] | float,
) -> Float[Tensor, "*batch 4"]:
    """Rotate from p to q along the shortest rotation, at a constant rate.

    Args:
        p: Orientation at t = 0.
        q: Orientation at t = 1.
        t: Fraction of the rotation; values outside 0 to 1 extrapolate.
    """
    way = log(multiply(conjugate(p), q))
    fraction = t[..., None] if isinstance(t, Tensor) else t
    return multiply(p, exp(fraction * way))


def mean(q: Float[Tensor, "n 4"]) -> Float[Tensor, "4"]:
    """Mean rotation, differentiable once; the signs of the quaternions do not matter.

    It minimises the sum of squared Frobenius norms of the differences between its rotation
    matrix and those of the inputs (Markley et al. 2007, "Averaging quaternions").
    """
    q64 = q.double()
    A = q64.mT @ q64
    values, vectors = torch.linalg.eigh(A.detach())
    others, found = vectors[:, :-1], vectors[:, -1]
    # The correction is zero, but has the derivative of the eigenvector. The derivative of
    # `eigh` needs four different eigenvalues, which equal quaternions do not have.
    found = found + others @ ((others.mT @ A @ found) / (values[-1] - values[:-1]))
    return found.to(q) if q.is_floating_point() else found


def continuous(q: Float[Tensor, "*batch time 4"]) -> Float[Tensor, "*batch time 4"]:
    """Flip signs along time so that neighbours are at most a right angle apart in R^4.

    The first sign is kept. Use this before components are interpolated or filtered.
    """
    flip = torch.where((q[..., 1:, :] * q[..., :-1, :]).sum(-1) < 0, -1.0, 1.0).to(q)
    sign = torch.cat([torch.ones_like(q[..., :1, 0]), flip.cumprod(-1)], dim=-1)
    return q * sign[..., None]


def unwrap_log(v: Float[Tensor, "*batch time 3"]) -> Float[Tensor, "*batch time 3"]:
    """Rotation vectors along time, made continuous past half turns.

    `log` jumps to the opposite axis where the angle passes pi. This function adds whole turns
    about the axis of each sample, so that `exp` of the result is unchanged and neighbours are
    close. The first sample is kept. Neighbours must be less than half a turn apart.

    Args:
        v: Rotation vectors of consecutive orientations [rad].

    Returns:
        Rotation vectors [rad] of any length.
    """
    length = safe_norm(v)
    axis = v / torch.where(length > 0, length, 1.0)[..., None]
    # At the identity there is no axis: use the axis of the last sample that has one.
    step = torch.arange(v.shape[-2], device=v.device).expand(length.shape)
    seen = torch.where(length > _AXIS_THRESHOLD, step, 0).cummax(-1).values
    axis = torch.take_along_dim(axis, seen[..., None], dim=-2)

    # One axis that never reverses, and the signed angle about it.
    flip = torch.where((axis[..., 1:, :] * axis[..., :-1, :]).sum(-1) < 0, -1.0, 1.0).to(v)
    sign = torch.cat([torch.ones_like(length[..., :1]), flip.cumprod(-1)], dim=-1)
    signed = (sign * length).detach()
    turns = torch.round(signed.diff(dim=-1) / (2 * torch.pi)).cumsum(-1)
    turns = torch.cat([torch.zeros_like(length[..., :1]), turns], dim=-1)
    return v - (2 * torch.pi * turns * sign)[..., None] * axis


# Contribution of a turning axis to the rate of a rotation vector. For q = exp(-e) g with
# angular velocity -v, the rotation vector e has the rate
#
#     e' = v + n(e, v),   n = e x v / 2 + c(|e|) e x (e x v),   c(a) = (1 - a/2 cot(a/2)) / a^2
#
# (the inverse left Jacobian of SO(3); Barfoot 2017, "State estimation for robotics", section
# 7.1.5). n is unbounded as |e| approaches whole turns: there the axis of e cannot turn, and the
# component of v perpendicular to e is omitted. The inverse is
#
#     v = e' - h(|e|) e x e' + k(|e|) e x (e x e'),
#     h(a) = (1 - cos a) / a^2,   k(a) = (1 - sin a / a) / a^2

# Below this squared angle, the series are exact to rounding and the closed forms are not.
_SMALL = 0.1
# Ratio |v| / |e'| of the components perpendicular to e, below which n is singular.
SINGULAR = 1e-3


def axis_drift(
    e: Float[Tensor, "*batch 3"], v: Float[Tensor, "*batch 3"]
) -> Float[Tensor, "*batch 3"]:
    """Drift n(e, v) in the unit of v, as defined above; zero where v lies along e.

    At whole turns, n cancels the component of v perpendicular to e: v + n lies along e.
    """
    square = (e * e).sum(-1, keepdim=True)
    far = square.clamp_min(_SMALL)
    cosine, sinc = cos_and_sinc(far / 4)
    # |sinc(|e|/2)| is the ratio |v| / |e'| of the components perpendicular to e.
    singular = sinc.abs() < SINGULAR
    cosecant = torch.where(singular, 0.0, 1 / torch.where(singular, 1.0, sinc))
    series = polynomial(
        square.clamp_max(_SMALL), (1 / 12, 1 / 720, 1 / 30240, 1 / 1209600, 1 / 47900160)
    )
    c = torch.where(square < _SMALL, series, (1 - cosine * cosecant) / far)
    cross = torch.linalg.cross(e, v)
    return torch.where(singular, 0.0, cross / 2) + c * torch.linalg.cross(e, cross)


def drift_free_rate(
    e: Float[Tensor, "*batch 3"], rate: Float[Tensor, "*batch 3"]
) -> Float[Tensor, "*batch 3"]:
    """Solve e' = v + n(e, v) for v, given e' = `rate`; v is minus the angular velocity.

    The result is J_l(e)^T e', with the left Jacobian J_l. This product also converts a gradient
    with respect to small rotations to a gradient with respect to e.
    """
    square = (e * e).sum(-1, keepdim=True)
    cross = torch.linalg.cross(e, rate)
    return rate - _h(square) * cross + _k(square) * torch.linalg.cross(e, cross)


def drift_free_slope(
    e: Float[Tensor, "*batch 3"],
    rate: Float[Tensor, "*batch 3"],
    curvature: Float[Tensor, "*batch 3"],
) -> Float[Tensor, "*batch 3"]:
    """Solve for v', given e' = `rate` and e'' = `curvature`: minus the angular acceleration."""
    square = (e * e).sum(-1, keepdim=True)
    h, k = _h(square), _k(square)
    # h' = dh/da a' with a a' = e e', and likewise k'. At small a, the closed forms lose digits
    # to cancellation.
    far, near = square.clamp_min(_SMALL), square.clamp_max(_SMALL)
    _, sinc = cos_and_sinc(far)
    h_series = polynomial(near, (-1 / 12, 1 / 180, -1 / 6720, 1 / 453600, -1 / 47900160))
    k_series = polynomial(near, (-1 / 60, 1 / 1260, -1 / 60480, 1 / 4989600, -1 / 622702080))
    small, along = square < _SMALL, (e * rate).sum(-1, keepdim=True)
    h_rate = along * torch.where(small, h_series, (sinc - 2 * h) / far)
    k_rate = along * torch.where(small, k_series, (h - 3 * k) / far)
    cross, bend = torch.linalg.cross(e, rate), torch.linalg.cross(e, curvature)
    turning = torch.linalg.cross(e, k_rate * cross + k * bend)
    return curvature - h_rate * cross - h * bend + turning + k * torch.linalg.cross(rate, cross)


def _h(square: Tensor) -> Tensor:
    """(1 - cos a) / a^2 from a^2, computed from sin(a / 2) to avoid cancellation."""
    _, half = cos_and_sinc(square / 4)
    return half**2 / 2


def _k(square: Tensor) -> Tensor:
    """(1 - sin a / a) / a^2 from a squared."""
    far = square.clamp_min(_SMALL)
    _, sinc = cos_and_sinc(far)
    series = polynomial(
        square.clamp_max(_SMALL), (1 / 6, -1 / 120, 1 / 5040, -1 / 362880, 1 / 39916800)
    )
    return torch.where(square < _SMALL, series, (1 - sinc) / far)


# Compilers turn the functions below into one loop over the batch, while the indexing above
# costs a lookup per number. Also, inductor of torch 2.11 generates C++ for the `gather` in
# `from_matrix` that does not compile for a batch.


def product_of_components[T: (Tensor, float)](p: Sequence[T], q: Sequence[T]) -> list[T]:
    """Four components of the Hamilton product, as tensors or as numbers."""
    (a, b, c, d), (w, x, y, z) = p, q
    return [
        a * w - b * x - c * y - d * z,
        a * x + b * w + c * z - d * y,
        a * y - b * z + c * w + d * x,
        a * z + b * y - c * x + d * w,
    ]


def _written_out_from_matrix(R: Tensor) -> Tensor:
    """`from_matrix` component by component."""
    a, b, c, d, e, f, g, h, i = R.flatten(-2).unbind(-1)
    wx, wy, wz, xy, xz, yz = h - f, c - g, d - b, b + d, c + g, f + h
    row, *others = [
        [a + e + i + 1, wx, wy, wz],
        [wx, a - e - i + 1, xy, xz],
        [wy, xy, e - a - i + 1, yz],
        [wz, xz, yz, i - a - e + 1],
    ]
    largest = row[0]
    for k, other in enumerate(others, start=1):
        larger = other[k] > largest
        row = [torch.where(larger, new, old) for new, old in zip(other, row, strict=True)]
        largest = torch.where(larger, other[k], largest)
    return normalize(torch.stack(row, dim=-1))
