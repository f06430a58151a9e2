"""Batches of primitives: selection, stacking and concatenation."""

from collections.abc import Iterable, Sequence
from typing import Any

import torch
from torch import Tensor

from hrc_learn.dmp.motion_primitive import MotionPrimitive


def stack[P: MotionPrimitive](primitives: Sequence[P]) -> P:
    """Batch of primitives of one kind, basis and spring, along a new first axis.

    If timestamps differ, each primitive keeps its own, with the last one repeated as padding.
    The result has a fit report if all primitives have one.

    Raises:
        ValueError: The list is empty, or the primitives differ; the message says in what.
    """
    if not primitives:
        raise ValueError("there are no primitives to stack")
    first, *others = (_description(primitive) for primitive in primitives)
    for i, other in enumerate(others, start=1):
        _check_equal(first, other, f"primitive {i}")
    tensors = [primitive.tensors() for primitive in primitives]
    common = set.intersection(*(set(each) for each in tensors))
    columns = {name: [each[name] for each in tensors] for name in tensors[0] if name in common}
    return primitives[0].with_tensors(
        {
            name: _padded(rows) if name == "timestamps" else torch.stack(rows)
            for name, rows in columns.items()
        }
    )


def concatenate[P: MotionPrimitive](batches: Iterable[P], samples: int) -> P:
    """Batches of primitives of one kind, joined along their first axis.

    They are read one by one and released after copying. Because demonstrations may have
    different timestamps, those of the result, for its default rollout, are evenly spaced.

    Args:
        batches: Batches that agree in the axes after the first.
        samples: Number of timestamps of the result.

    Raises:
        ValueError: There is no batch, or they differ; the message says in what.
    """
    first, described = None, {}
    parts: list[dict[str, Tensor]] = []
    for batch in batches:
        own = _description(batch)
        own["shape of the weights"] = own["shape of the weights"][1:]
        if first is None:
            # A copy, so that the memory behind the batch is released.
            first, described = batch[:1], own
        _check_equal(described, own, f"batch {len(parts)}")
        parts.append({name: x.detach().clone() for name, x in batch.tensors().items()})
    if first is None:
        raise ValueError("there are no primitives to concatenate")
    common = set.intersection(*(set(part) for part in parts)) - {"timestamps"}
    joined = {name: torch.cat([part[name] for part in parts]) for name in common}
    joined["timestamps"] = torch.linspace(0, 1, samples).to(first.motion.timestamps)
    return first.with_tensors(joined)


def _check_equal(first: dict[str, Any], other: dict[str, Any], label: str) -> None:
    for name, value in first.items():
        if other[name] != value:
            raise ValueError(
                f"primitives of one batch must be alike, but {name} of {label} is "
                f"{other[name]}, of the first {value}"
            )


def _padded(rows: list[Tensor]) -> Tensor:
    """One grid of timestamps if all are equal, else one row each."""
    if all(x.shape == rows[0].shape and torch.equal(x, rows[0]) for x in rows):
        return rows[0].clone()
    T = max(x.shape[-1] for x in rows)
    rows = [
        torch.cat([x, x[..., -1:].expand(*x.shape[:-1], T - x.shape[-1])], -1) for x in rows
    ]
    return torch.stack(torch.broadcast_tensors(*rows))


def _description(primitive: MotionPrimitive) -> dict[str, Any]:
    return {
        "kind": type(primitive).__name__,
        **primitive.motion.config(),
        "shape of the weights": tuple(primitive.motion.weights.shape),
    }
