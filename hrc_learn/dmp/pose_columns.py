"""A pose and the arm's body as columns of one linear primitive."""

import torch
from torch import Tensor

from hrc_learn.dmp.arrays import ArrayLike, to_tensor
from hrc_learn.dmp.fitting.samples import check_samples
from hrc_learn.dmp.rotation.error import error_rate

POSITION, ERROR, BODY = slice(0, 3), slice(3, 6), slice(6, None)
"""Columns of the coordinates that move under one phase."""


def demonstrated_columns(
    time: ArrayLike,
    position: ArrayLike,
    error: Tensor,
    body: ArrayLike | None,
    mask: ArrayLike | None,
) -> Tensor:
    """Checked samples (*B, T, 6 + K), in the dtype of the position.

    Raises:
        ValueError: Bad samples; says which.
    """
    checked = check_samples(time, position, mask=mask)
    if checked.position.shape[-2] != 3:
        raise ValueError(f"position must have 3 columns, got {checked.position.shape[-2]}")
    columns = [checked.columns, error.to(checked.position)]
    if body is not None:
        columns.append(check_samples(time, body, mask=mask, name="body").columns)
    try:
        return torch.cat(columns, dim=-1)
    except RuntimeError:
        shapes = ", ".join(str(tuple(column.shape)) for column in columns)
        raise ValueError(f"position, orientation error and body differ: {shapes}") from None


def joined(position: Tensor, error: Tensor, body: ArrayLike, like: Tensor) -> Tensor:
    """The columns of a linear primitive, broadcast and side by side."""
    columns = [to_tensor(part, like.dtype, like.device) for part in (position, error, body)]
    batch = torch.broadcast_shapes(*(column.shape[:-1] for column in columns))
    return torch.cat([column.expand(*batch, -1) for column in columns], dim=-1)


def pose_push(coordinates: Tensor, coupling: ArrayLike) -> Tensor:
    """The coupling of the linear primitive for an acceleration of position or pose."""
    coupling = to_tensor(coupling, coordinates.dtype, coordinates.device)
    push = replaced(torch.zeros_like(coordinates), POSITION, coupling[..., :3])
    if coupling.shape[-1] == 3:
        return push
    # The second derivative of the error is linear in the angular acceleration.
    return replaced(push, ERROR, error_rate(coordinates[..., ERROR], coupling[..., 3:]))


def replaced(values: Tensor, columns: slice, new: ArrayLike) -> Tensor:
    """`values` with some columns exchanged; differentiable in both."""
    new = to_tensor(new, values.dtype, values.device)
    stop = values.shape[-1] if columns.stop is None else columns.stop
    new = new.expand(*values.shape[:-1], stop - columns.start)
    return torch.cat([values[..., : columns.start], new, values[..., stop:]], dim=-1)
