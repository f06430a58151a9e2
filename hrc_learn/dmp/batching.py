"""Batches of primitives: selection, stacking and concatenation."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from hrc_learn.dmp.fitting.samples import FitReport


def select[M: nn.Module](primitive: M, index: Any) -> M:
    """Part of a batch of primitives, `primitive[index]`, with memory of its own.

    Gradients flow through weights that are a buffer; a parameter is copied.

    Raises:
        IndexError: The index is out of range.
    """

    def chosen(path: str, x: Tensor) -> Tensor:
        x = x.detach() if isinstance(x, nn.Parameter) else x
        shared = _name(path) == "timestamps" and x.ndim == 1
        return x.clone() if shared else x[index].clone()

    return _changed(primitive, chosen)


def stack[M: nn.Module](primitives: Sequence[M]) -> M:
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
    tensors = [dict(_tensors(primitive)) for primitive in primitives]

    def stacked(path: str, x: Tensor) -> Tensor | None:
        found = [each.get(path) for each in tensors]
        present = [
            x.detach() if isinstance(x, nn.Parameter) else x for x in found if x is not None
        ]
        if len(present) < len(primitives):
            return None
        return _padded(present) if _name(path) == "timestamps" else torch.stack(present)

    return _changed(primitives[0], stacked)


def concatenate[M: nn.Module](batches: Iterable[M], samples: int) -> M:
    """Batches of primitives of one kind, joined along their first axis.

    They are read one by one and released after copying. Because demonstrations may have
    different timestamps, those of the result, for its default rollout, are evenly spaced.

    Args:
        batches: Batches that agree in the axes after the first.
        samples: Number of timestamps of the result.

    Raises:
        ValueError: There is no batch, or they differ; the message says in what.
    """
    first, described, count = None, {}, 0
    parts: dict[str, list[Tensor]] = {}
    for batch in batches:
        weights: Any = batch.motion.weights  # pyright: ignore[reportAttributeAccessIssue]
        own = _description(batch) | {"shape of the weights": weights.shape[1:]}
        if first is None:
            # A copy, so that the memory behind the batch is released.
            first, described = select(batch, slice(0, 1)), own
        _check_equal(described, own, f"batch {count}")
        count += 1
        for path, x in _tensors(batch):
            if _name(path) != "timestamps":
                parts.setdefault(path, []).append(x.detach().clone())
    if first is None:
        raise ValueError("there are no primitives to concatenate")

    def joined(path: str, x: Tensor) -> Tensor | None:
        if _name(path) == "timestamps":
            return torch.linspace(0, 1, samples, dtype=x.dtype, device=x.device)
        found = parts[path]
        return torch.cat(found) if len(found) == count else None

    return _changed(first, joined)


def _name(path: str) -> str:
    return path.rpartition(".")[2]


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


def _description(primitive: Any) -> dict[str, Any]:
    return {
        "kind": type(primitive).__name__,
        **primitive.motion.config(),
        **primitive._own_config(),
        "shape of the weights": tuple(primitive.motion.weights.shape),
    }


def _own_tensors(module: nn.Module) -> Iterator[tuple[str, Tensor]]:
    yield from module._parameters.items()  # pyright: ignore[reportReturnType]
    yield from module._buffers.items()  # pyright: ignore[reportReturnType]
    # In some kinds the report is a property that returns that of another module.
    if isinstance(report := vars(module).get("fit_report"), FitReport):
        yield from ((f"fit_report.{name}", x) for name, x in report.tensors().items())


def _tensors(module: nn.Module, prefix: str = "") -> Iterator[tuple[str, Tensor]]:
    for path, part in module.named_modules(prefix=prefix):
        for name, x in _own_tensors(part):
            yield f"{path}.{name}" if path else name, x


def _changed[M: nn.Module](
    module: M, change: Callable[[str, Tensor], Tensor | None], prefix: str = ""
) -> M:
    """Module with changed tensors; all other attributes are those of the original."""
    new = type(module).__new__(type(module))
    new.__dict__.update(vars(module))
    tensors = {name: change(prefix + name, x) for name, x in _own_tensors(module)}
    report = {k.partition(".")[2]: x for k, x in tensors.items() if k.startswith("fit_report.")}
    if report:
        known = {k: x for k, x in report.items() if x is not None}
        complete = {"rmse", "peak", "span"} <= known.keys()
        new.__dict__["fit_report"] = FitReport(**known) if complete else None
    new._buffers = {name: tensors[name] for name in module._buffers}
    new._parameters = {
        name: nn.Parameter(x) for name in module._parameters if (x := tensors[name]) is not None
    }
    new._modules = {
        name: None if part is None else _changed(part, change, f"{prefix}{name}.")
        for name, part in module._modules.items()
    }
    return new
