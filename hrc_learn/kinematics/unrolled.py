"""Forward kinematics and Jacobian written out number by number, for compilers.

Products with the zeros and ones of which an arm's description mostly consists are left out, and
each number is a tensor over the batch alone, so that a compiler makes one loop over the batch
of it. Run eagerly, its thousand small operations take far longer than matrix products.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

type _Row = list[Tensor]


def transform_and_jacobian(
    q: Float[Tensor, "*batch joints"],
    mounts: Sequence[Sequence[Sequence[float]]],
    tip: Sequence[Sequence[float]],
) -> tuple[Float[Tensor, "*batch 3 4"], Float[Tensor, "*batch 6 joints"]]:
    """Transform (R | p) of the tool centre point and its geometric Jacobian.

    Args:
        q: Joint positions [rad].
        mounts: Frame of each joint at zero in the frame of the joint before (the base).
        tip: Tool centre point in the frame of the last joint.

    Returns:
        Both with the batch last in memory.
    """
    zero, one = torch.zeros_like(q[..., 0]), torch.ones_like(q[..., 0])
    frame = [[one if i == j else zero for j in range(4)] for i in range(3)]
    axes, origins = [], []
    for angle, mount in zip(q.unbind(-1), mounts, strict=True):
        frame = _turned(_product(frame, mount), torch.cos(angle), torch.sin(angle))
        axes.append([row[2] for row in frame])
        origins.append([row[3] for row in frame])
    frame = _product(frame, tip)
    point = [row[3] for row in frame]
    linear = [_cross(axis, _minus(point, o)) for axis, o in zip(axes, origins, strict=True)]
    rows = [[column[k] for column in part] for part in (linear, axes) for k in range(3)]
    return _matrix(frame), _matrix(rows)


def _product(frame: list[_Row], constant: Sequence[Sequence[float]]) -> list[_Row]:
    """(R | p) times a homogeneous transform."""
    return [
        [
            _combination([constant[k][j] for k in range(3)] + [float(j == 3)], row)
            for j in range(4)
        ]
        for row in frame
    ]


def _combination(factors: Sequence[float], terms: _Row) -> Tensor:
    products = [
        term if factor == 1 else factor * term
        for factor, term in zip(factors, terms, strict=True)
        if factor != 0
    ]
    total = products[0]
    for product in products[1:]:
        total = total + product
    return total


def _turned(frame: list[_Row], cosine: Tensor, sine: Tensor) -> list[_Row]:
    """A frame turned about its own z axis."""
    return [[x * cosine + y * sine, y * cosine - x * sine, z, p] for x, y, z, p in frame]


def _minus(a: _Row, b: _Row) -> _Row:
    return [x - y for x, y in zip(a, b, strict=True)]


def _cross(a: _Row, b: _Row) -> _Row:
    return [
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    ]


def _matrix(rows: list[_Row]) -> Tensor:
    batch = list(range(-rows[0][0].ndim, 0))
    flat = torch.stack([entry for row in rows for entry in row])
    return flat.unflatten(0, (len(rows), -1)).movedim(batch, list(range(len(batch))))
